"""Commented files to begin with: a cell, a task, and the settings."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from hrcreplay.errors import SettingsError
from hrcreplay.settings.listing import as_toml
from hrcreplay.store.run_folder import write_whole


def write_templates(folder: Path) -> list[Path]:
    """Write commented files to begin with; returns their paths.

    Args:
        folder: Folder for the files; created if missing.

    Raises:
        SettingsError: One of the files exists or cannot be written.
    """
    shipped = resources.files("hrcreplay.commands")
    head = "# Settings: remove the '# ' from those to change. Use with --config settings.toml.\n\n"
    texts = {
        "cell.toml": (shipped / "cell_template.toml").read_text("utf-8"),
        "task.toml": (shipped / "task_template.toml").read_text("utf-8"),
        "settings.toml": head + as_toml(commented=True),
    }
    paths = {folder / name: text for name, text in texts.items()}
    for path in paths:
        if path.exists():
            raise SettingsError(f"{path}: exists already; name another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SettingsError(f"{folder}: cannot be made ({error.strerror}); name another folder") from error
    for path, text in paths.items():
        write_whole(path, text)
    return list(paths)
