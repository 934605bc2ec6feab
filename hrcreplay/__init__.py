"""Replays recorded human-robot sessions through a safety-aware trajectory generator."""

import hashlib
import os
import shutil
import sys
from pathlib import Path

__version__ = "0.1.0"

_WITH_KERNELS = ("audit", "calibration", "geometry", "human", "robot")


def _keep_kernels_apart() -> None:
    """Gives the compiled kernels of each state of the sources a folder of their own.

    numba compares a cached kernel with the file that it stands in, not with those of the functions it calls: after an
    update it would go on with old code inside new. So the folder's name is a digest of all rooms that hold kernels.
    """
    here = Path(__file__).parent
    digest = hashlib.sha256()
    for source in sorted(path for room in _WITH_KERNELS for path in (here / room).rglob("*.py")):
        digest.update(source.read_bytes())
    cache = here / "__pycache__"
    if not os.access(cache if cache.exists() else here, os.W_OK):
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hrcreplay"
    os.environ.setdefault("NUMBA_CACHE_DIR", str(cache / f"kernels-{digest.hexdigest()[:16]}"))


def share_kernels(have: Path, lack: Path) -> None:
    """Copies the compiled kernels of functions of which another folder has none: an index, and the files it names."""
    for index in have.glob("*/*.nbi"):
        copy = lack / index.relative_to(have)
        if not copy.exists():
            copy.parent.mkdir(parents=True, exist_ok=True)
            for kernel in index.parent.glob(f"{index.stem}.*.nbc"):
                shutil.copy2(kernel, copy.parent)
            shutil.copy2(index, copy)


def _choose_one_proxsuite() -> None:
    """Has proxsuite take its AVX2 library where the processor would do AVX-512, too.

    It comes in three, takes the widest and rounds otherwise in each: a robot would move otherwise by the last bits on
    every other computer. Without the name of one of them it takes the next.
    """
    sys.modules.setdefault("proxsuite.proxsuite_pywrap_avx512", None)  # type: ignore[arg-type]


_keep_kernels_apart()
_choose_one_proxsuite()
