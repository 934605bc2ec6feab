"""Compiled code: choice of the library, and the folder that caches compiled functions between processes.

numba compares a cached kernel with its own source file, not with the files of the functions it calls: after an update,
new kernels would contain old code. So each version of the sources has its own folder.
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

#: The packages that contain kernels.
ROOMS = ("audit", "calibration", "geometry", "human", "robot")


def njit(**options: Any) -> Callable[[Any], Any]:
    """Numba's decorator; caches the compiled functions in ``folder()``, independent of the folder of other packages."""

    def compiled(function: Callable[..., Any]) -> Any:
        others = numba.config.CACHE_DIR
        numba.config.CACHE_DIR = str(folder())  # numba reads it while it decorates the function
        try:
            return numba.njit(**options)(function)
        finally:
            numba.config.CACHE_DIR = others

    return compiled


@cache
def folder() -> Path:
    """Folder of the compiled kernels: NUMBA_CACHE_DIR if that is set, else one named by the digest of the sources.

    It lies beside the package, or in the user's cache if that place is not writable.
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
    """Copies compiled kernels to another folder, for functions it lacks: an index and the files that it names."""
    for index in have.glob("*/*.nbi"):
        copy = lack / index.relative_to(have)
        if not copy.exists():
            copy.parent.mkdir(parents=True, exist_ok=True)
            for kernel in index.parent.glob(f"{index.stem}.*.nbc"):
                shutil.copy2(kernel, copy.parent)
            shutil.copy2(index, copy)


def forgo(module: str) -> None:
    """Blocks later imports of a module that is not loaded yet, so that importers use their alternative."""
    sys.modules.setdefault(module, None)  # type: ignore[arg-type]
