"""Compiled functions, kept for as long as no file of this folder changes: a kernel holds those that it calls."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
import numpy as np

from hrcreplay import kernels
from hrcreplay.records import Floats

F = TypeVar("F", bound=Callable[..., Any])

_HERE = Path(__file__).parent
_SOURCES = sorted(path for path in _HERE.glob("*.py") if not path.name.startswith("test_"))
_DIGEST = hashlib.sha256(b"".join(path.read_bytes() for path in _SOURCES)).hexdigest()[:16]


def kernel(function: F) -> F:
    """Compiles a function when it is first called."""
    others = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(kernels.folder() / f"soundness-{_DIGEST}")
    try:
        compiled: F = numba.njit(cache=True)(function)
    finally:
        numba.config.CACHE_DIR = others
    return compiled


@kernel
def copy(source: Floats, to: Floats) -> None:
    """Number by number: numba takes seconds to compile ``to[:] = source``, for the words of its errors."""
    for at in np.ndindex(source.shape):
        to[at] = source[at]
