"""Installs hrcreplay as a newcomer would, and uses it: ``python -m tests.tools.newcomer``.

Builds the wheel from this checkout, installs it with pip into an empty environment and with uv as a tool, each with all
dependencies from the package index, and runs commands from an empty folder, so that nothing of the checkout is at hand.
A way whose program is not there is told, not passed over. Needs a network; the kernels compile anew, some minutes each.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[2]
#: What a newcomer types, with the files that it has to leave in the folder.
SESSION: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = (
    (("--version",), ()),
    (("-h",), ()),
    (("init", "new"), ("new/cell.toml", "new/task.toml", "new/settings.toml")),
    (("settings", "plan"), ()),
    (("info", "{demo}", "--json"), ()),
)
#: The same with compiled kernels.
REPORT = (("report", "{demo}", "--start", "8", "--end", "9", "--out", "run"), ("run/report.html", "run/scene.mcap"))


def main(arguments: Sequence[str] | None = None) -> int:
    """Tries the ways to install; returns 1 if one of them failed."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.tools.newcomer",
        description="Installs the wheel of this checkout as a newcomer would, and uses it.",
    )
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=list(WAYS), help="ways to try; default: all")
    parser.add_argument("--python", default=sys.executable, help="interpreter for the new environments")
    asked = parser.parse_args(arguments)
    failed = 0
    with tempfile.TemporaryDirectory() as made:
        wheel = build_wheel(Path(made))
        for way in asked.ways:
            began_s = time.monotonic()
            try:
                program = WAYS[way](wheel, Path(made) / way, asked.python)
                if program is None:
                    say(f"{way}: not there, so not tried")
                    continue
                use(program, Path(made) / f"{way}-work", (*SESSION, REPORT))
                say(f"{way}: installed and used in {time.monotonic() - began_s:.0f} s")
            except subprocess.CalledProcessError as error:
                say(f"{way}: failed: {' '.join(map(str, error.cmd))}\n{error.stdout}{error.stderr}")
                failed = 1
    return failed


def build_wheel(folder: Path) -> Path:
    """Builds the wheel of this checkout into a folder."""
    call([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)], ROOT)
    (wheel,) = folder.glob("*.whl")
    return wheel


def by_pip(wheel: Path, folder: Path, python: str) -> Path:
    """Installs a wheel with pip into an environment of its own; returns the program."""
    call([python, "-m", "venv", str(folder)], ROOT)
    call(
        [str(folder / "bin" / "python"), "-m", "pip", "install", "--quiet", "--only-binary", ":all:", str(wheel)],
        folder,
    )
    return folder / "bin" / "hrcreplay"


def by_uv(wheel: Path, folder: Path, python: str) -> Path | None:
    """Installs a wheel as a tool of uv; returns the program, None without uv."""
    uv = shutil.which("uv")
    if uv is None:
        return None
    folder.mkdir()
    os.environ["UV_TOOL_DIR"], os.environ["UV_TOOL_BIN_DIR"] = str(folder / "tools"), str(folder / "bin")
    call([uv, "tool", "install", "--quiet", "--python", python, "--no-build", str(wheel)], folder)
    return folder / "bin" / "hrcreplay"


WAYS = {"pip": by_pip, "uv": by_uv}


def link_wheel(wheel: Path, folder: Path) -> Path:
    """Installs a wheel alone, beside the libraries of this environment; returns the program.

    Args:
        wheel: Wheel of this project.
        folder: Environment to make.
    """
    venv.create(folder, with_pip=False)
    (site,) = (folder / "lib").glob("python*/site-packages")
    call([sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(site), str(wheel)], folder)
    libraries = next(path for path in map(Path, sys.path) if (path / "numba").is_dir())
    # behind the wheel's own files, and with the folders that libraries add in the same way
    (site / "libraries.pth").write_text(f"import site; site.addsitedir({str(libraries)!r})\n")
    program = folder / "bin" / "hrcreplay"
    program.write_text(f"#!{folder / 'bin' / 'python'}\nfrom hrcreplay.cli.app import main\nmain()\n")
    program.chmod(0o755)
    return program


def use(program: Path, folder: Path, session: Sequence[tuple[tuple[str, ...], tuple[str, ...]]]) -> list[str]:
    """Runs commands in a new folder; returns what each prints.

    Args:
        program: The installed program.
        folder: Folder to make.
        session: Arguments of each command, and the files that it has to leave; {demo} stands for the demo log.

    Raises:
        CalledProcessError: A command failed.
        FileNotFoundError: A command did not leave its files.
    """
    folder.mkdir()
    python = program.resolve().parent / "python"
    where = "import hrcreplay.commands.replay as r; print(r.demo_log())"
    demo = call([str(python), "-c", where], folder).strip()
    if not Path(demo).is_relative_to(python.parents[1]):
        raise FileNotFoundError(f"the demo log of the environment is that of {demo}")
    said = []
    for arguments, files in session:
        said.append(call([str(program), *(word.format(demo=demo) for word in arguments)], folder))
        for name in files:
            if not (folder / name).is_file():
                raise FileNotFoundError(f"hrcreplay {' '.join(arguments)} left no {name}")
    return said


def call(arguments: list[str], folder: Path) -> str:
    """Runs a program without this checkout on its path; returns its output."""
    kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "NUMBA_CACHE_DIR")}
    return subprocess.run(arguments, cwd=folder, env=kept, check=True, capture_output=True, text=True).stdout


def say(text: str) -> None:
    """Prints a line at once."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
