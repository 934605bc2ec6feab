"""Compilation of all kernels in two processes, into the folder that keeps them, with its progress.

numba compiles a function when it is first called. So each process sends a short piece of the demo through the code that
calls its kernels; ``commands/warmup.py`` says which.
"""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from hrcreplay import kernels
from hrcreplay.pipeline.progress import ProgressBar, print_note

#: Parts of the work, one process each.
PARTS = ("person", "robot")
_TITLE = "compiling kernels, once"
_EVERY_S = 5.0  # between two lines
_LOOK_S = 1.0  # between two looks at the processes
_WITHIN = "HRCREPLAY_COMPILING"  # variable of a process that compiles


def ensure_compiled() -> bool:
    """Compiles all kernels if that has not been done for this version; returns False if a process failed.

    Kernels that are then missing are compiled when they are first called.
    """
    done = kernels.folder() / f"compiled-{kernels.target()}"
    if done.exists() or _WITHIN in os.environ:
        return True
    done.parent.mkdir(parents=True, exist_ok=True)
    if not os.access(done.parent, os.W_OK):
        return False  # of an image: made for another processor, so each process compiles for itself
    kernels.load_all()
    have, number = kernels.progress()
    with ProgressBar(_TITLE, number, every_s=_EVERY_S) as bar, _alone(done.parent):
        if not done.exists():  # else another command has compiled them in the meantime
            if have < number:
                print_note(f"{_TITLE}: {have} of {number}")
            if failure := _compile(bar):
                print_note(f"{_TITLE}: {failure}; those that are missing follow when they are needed")
                return False
            done.touch()
    return True


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Waits until no other command compiles into the folder."""
    with (folder / "compiling").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _compile(bar: ProgressBar) -> str:
    """Runs the processes to their end; returns what failed."""
    told = 0
    with tempfile.TemporaryDirectory() as scratch, ExitStack() as running:
        processes = {part: running.enter_context(_start(part, Path(scratch))) for part in PARTS}
        while any(process.poll() is None for process in processes.values()):
            time.sleep(_LOOK_S)
            done, _ = kernels.progress()
            bar.advance(_TITLE, done - told)
            told = done
        for part, process in processes.items():
            if process.returncode:
                last = (Path(scratch) / part).read_text("utf-8", "replace").strip().splitlines()[-1:]
                return f"the process for {part} failed ({' '.join(last)})"
    return ""


@contextmanager
def _start(part: str, scratch: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Starts a process that compiles a part; ends it with the block."""
    code = (
        f"import sys; sys.path[:] = {sys.path!r}; from hrcreplay.commands import warmup; warmup.compile_part({part!r})"
    )
    with (scratch / part).open("wb") as told:
        process = subprocess.Popen(  # noqa: S603 (our own code)
            [sys.executable, "-c", code],
            stdin=subprocess.DEVNULL,
            stdout=told,
            stderr=told,
            env={**os.environ, _WITHIN: part},
        )
    try:
        yield process
    finally:
        process.terminate()
        process.wait()
