"""What a crash of one of a session's processes leaves in the run folder: a file with its traceback.

The first line of ``crash_<part>.txt`` says which part failed, with what exception and where; that line is also what the
user is told and what run.json has. A part may be a process that ended without a word.
"""

from __future__ import annotations

import sys
import traceback
from contextlib import suppress
from pathlib import Path
from signal import Signals

import hrcreplay

#: The parts of a session. The first three processes are helpers of control.
PERSON, RECORDER, SCREEN, CONTROL, FOLDER = "human side", "recorder", "screen", "control", "run folder"

#: What the names of the files begin with.
PREFIX = "crash_"

_PACKAGE = Path(hrcreplay.__file__).parent


def said_of(error: BaseException) -> str:
    """An exception in one line: its kind, its message, and where in our code it arose."""
    message = " ".join(str(error).split())
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if Path(frame.filename).is_relative_to(_PACKAGE)]
    name = type(error).__name__ + (f": {message}" if message else "")
    for frame in (ours or frames)[-1:]:
        path = Path(frame.filename)
        where = path.relative_to(_PACKAGE.parent).as_posix() if ours else path.name
        return f"{name} ({where}:{frame.lineno}, in {frame.name})"
    return name


def end_of(code: int) -> str:
    """How a process ended that left nothing else: killed, or by an exit code."""
    if code >= 0:
        return f"ended with exit code {code}"
    with suppress(ValueError):
        return f"killed by {Signals(-code).name}"
    return f"killed by signal {-code}"


def write(folder: Path, part: str, error: BaseException | str) -> str:
    """Keeps a crash; one of the same part that came first stays first.

    Returns:
        What to say of it, as ``read`` gives it.
    """
    said = f"{part}: {error if isinstance(error, str) else said_of(error)}"
    trace = "" if isinstance(error, str) else "".join(traceback.format_exception(error))
    try:
        with _file(folder, part).open("a") as file:
            file.write(f"{said}\n\n{trace}")
    except OSError:
        sys.stderr.write(f"{said}\n{trace}")  # better there than nowhere
        sys.stderr.flush()
    return said


def read(folder: Path) -> list[str]:
    """What there is to say of the crashes that a session's folder holds, a line each."""
    lines = []
    for path in sorted(folder.glob(f"{PREFIX}*.txt")):
        text = path.read_text(errors="replace").splitlines()
        lines.append(text[0] if text else path.name)
    return lines


def left(folder: Path, part: str) -> bool:
    """Whether a part has left a file."""
    return _file(folder, part).exists()


def _file(folder: Path, part: str) -> Path:
    return folder / f"{PREFIX}{part.replace(' ', '_')}.txt"
