"""Text files that appear whole or not at all."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from hrcreplay.errors import SettingsError


def write_whole(path: Path, text: str) -> None:
    """Writes a new file beside its place and gives it its name when it is complete.

    Raises:
        SettingsError: The file exists, or its folder cannot be written.
    """
    if path.exists():
        raise SettingsError(f"{path}: exists already; name another file, or remove it")
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    except OSError as error:
        raise SettingsError(f"{path}: cannot be written ({error.strerror}); name a folder that can") from error
    temporary = Path(name)
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(text)
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)  # mkstemp's 0600 would hide the file from colleagues
        temporary.rename(path)
    finally:
        temporary.unlink(missing_ok=True)
