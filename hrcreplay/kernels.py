"""Compiled code: which library is taken, and where our own functions stay compiled from one process to the next.

numba compares a cached kernel with the file that it stands in, not with those of the functions it calls: after an
update it would go on with old code inside new. So each state of all sources that hold kernels has a folder of its own.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba

#: The rooms that hold kernels.
ROOMS = ("audit", "calibration", "geometry", "human", "robot")


def njit(**options: Any) -> Callable[[Any], Any]:
    """Numba's decorator; what it compiles is kept in ``folder()``, whatever folder others have for theirs."""

    def compiled(function: Callable[..., Any]) -> Any:
        others = numba.config.CACHE_DIR
        numba.config.CACHE_DIR = str(folder())  # read while the function is decorated
        try:
            return numba.njit(**options)(function)
        finally:
            numba.config.CACHE_DIR = others

    return compiled


@cache
def folder() -> Path:
    """Folder of this process's compiled kernels: NUMBA_CACHE_DIR where that is set, else by the digest of the sources.

    Beside the package, or in the user's cache where that cannot be written.
    """
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(chosen)
    here = Path(__file__).parent
    digest = hashlib.sha256()
    for source in sorted(path for room in ROOMS for path in (here / room).rglob("*.py")):
        digest.update(source.read_bytes())
    beside = here / "__pycache__"
    if not os.access(beside if beside.exists() else here, os.W_OK):
        beside = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hrcreplay"
    return beside / f"kernels-{digest.hexdigest()[:16]}"


def share(have: Path, lack: Path) -> None:
    """Copies the compiled kernels of functions of which another folder has none: an index, and the files it names."""
    for index in have.glob("*/*.nbi"):
        copy = lack / index.relative_to(have)
        if not copy.exists():
            copy.parent.mkdir(parents=True, exist_ok=True)
            for kernel in index.parent.glob(f"{index.stem}.*.nbc"):
                shutil.copy2(kernel, copy.parent)
            shutil.copy2(index, copy)


def forgo(module: str) -> None:
    """Has every import of a module fail from now on, if none has succeeded yet, so that importers take another."""
    sys.modules.setdefault(module, None)  # type: ignore[arg-type]
