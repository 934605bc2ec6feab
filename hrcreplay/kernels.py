"""Compiled code: choice of the library, and the folder that caches compiled functions between processes.

numba compares a cached kernel with its own source file, not with the files of the functions it calls: after an update,
new kernels would contain old code. So each version of the sources has its own folder. numba also writes the index of a
function's compiled versions without a lock; here each process locks the folder while it writes.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numba
from llvmlite import binding
from numba.core import event
from numba.core.caching import FunctionCache

if "NUMBA_OPT" not in os.environ:  # compiles a fifth faster than level 3; only the fusion is then a fifth slower
    numba.config.OPT = type(numba.config.OPT)(1)

#: The packages that contain kernels.
ROOMS = ("audit", "calibration", "geometry", "human", "pipeline/batch", "robot")


class KernelCache(FunctionCache):
    """The compiled versions of one function on disk."""

    def save_overload(self, sig: Any, data: Any) -> None:
        """Writes a compiled version; locked, as another process may add a version to the same index."""
        with _locked():
            super().save_overload(sig, data)

    @property
    def compiled(self) -> bool:
        """True once a version of the function is compiled from its present source file."""
        return bool(self._cache_file._load_index())  # noqa: SLF001 (as above)


#: The caches of all functions decorated so far.
_CACHES: list[KernelCache] = []


def njit(*, inner: bool = False, **options: Any) -> Callable[[Any], Any]:
    """Numba's decorator; caches the compiled functions in ``folder()``, independent of the folder of other packages.

    Args:
        inner: True: compiled code alone calls the function. It then compiles faster, and a call from Python would crash
            the process, so a test looks for such calls.
        options: Options of numba.
    """
    options |= {"no_cpython_wrapper": inner, "no_cfunc_wrapper": True}  # C calls none of them

    def compiled(function: Callable[..., Any]) -> Any:
        others = numba.config.CACHE_DIR
        numba.config.CACHE_DIR = str(folder())  # numba reads it while it decorates the function
        try:
            kernel = numba.njit(**options)(function)
            kernel.get_call_template = partial(_find_template, kernel.get_call_template)
            if options.get("cache"):
                _CACHES.append(KernelCache(function))
                kernel._cache = _CACHES[-1]  # noqa: SLF001 (numba has no public way to choose the cache)
            return kernel
        finally:
            numba.config.CACHE_DIR = others

    return compiled


def _find_template(whole: Callable[..., Any], args: tuple[Any, ...], kws: dict[str, Any]) -> Any:
    """What a kernel calls: the version for any number; numba would compile one more for each number in the source."""
    plain = tuple(map(numba.types.unliteral, args))
    return whole(plain, {name: numba.types.unliteral(of) for name, of in kws.items()})


@contextmanager
def _locked() -> Iterator[None]:
    """Waits until no other process writes into the folder, and keeps others from it."""
    with (folder() / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


class _Compilation(event.Listener):
    """Names of the kernels under compilation; a kernel is compiled within the one that calls it."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def on_start(self, event: Any) -> None:
        self.names.append(event.data["dispatcher"].py_func.__name__)

    def on_end(self, event: Any) -> None:  # noqa: ARG002
        self.names.pop()


_COMPILATION = _Compilation()
event.register("numba:compile", _COMPILATION)


def under_way() -> str:
    """Name of the kernel that this process is compiling; empty if none."""
    return _COMPILATION.names[0] if _COMPILATION.names else ""


def load_all() -> None:
    """Imports every module with kernels, so that ``progress`` counts all of them."""
    package = Path(__file__).parent
    for path in sorted(path for room in ROOMS for path in (package / room).rglob("*.py")):
        if "@njit(" in path.read_text("utf-8"):
            import_module(".".join(("hrcreplay", *path.relative_to(package).with_suffix("").parts)))


@cache
def target() -> str:
    """Digest of what compiled code is of and for: sources, versions of numba and Python, processor and its features."""
    parts = (numba.__version__, *sys.version_info[:2], binding.get_host_cpu_name(), binding.get_host_cpu_features())
    return hashlib.sha256(repr([_sources(), *map(str, parts)]).encode()).hexdigest()[:16]


def progress() -> tuple[int, int]:
    """Returns how many kernels of the modules imported so far are compiled, and how many there are."""
    return sum(one.compiled for one in _CACHES), len(_CACHES)


@cache
def _sources() -> str:
    """Digest of the sources of the packages that contain kernels."""
    digest, here = hashlib.sha256(), Path(__file__).parent
    for source in sorted(path for room in ROOMS for path in (here / room).rglob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


@cache
def folder() -> Path:
    """Folder of the compiled kernels: NUMBA_CACHE_DIR if that is set, else one named by the digest of the sources.

    It lies beside the package, or in the user's cache if that place is not writable.
    """
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(chosen)
    here = Path(__file__).parent
    beside = here / "__pycache__"
    if not os.access(beside if beside.exists() else here, os.W_OK):
        beside = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hrcreplay"
    return beside / f"kernels-{_sources()}"


def forgo(module: str) -> None:
    """Blocks later imports of a module that is not loaded yet, so that importers use their alternative."""
    sys.modules.setdefault(module, None)  # type: ignore[arg-type]
