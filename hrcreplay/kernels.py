"""Compiled code: choice of the library, and the folder that caches compiled functions between processes.

numba compares a cached kernel with its own source file, not with the files of the functions it calls: after an update,
new kernels would contain old code. So each version of the sources has its own folder. numba also writes the index of a
function's compiled versions without a lock; here each process locks the folder while it writes.

numba also puts a copy of each called kernel into every caller, where it optimises and writes it again. Here that holds
for small kernels only, which are worth inlining: a large one is compiled once, and its callers name it. So a caller
that is read from the folder needs the large kernels it names, by names that do not depend on what else was compiled.
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
from typing import Any, NamedTuple

import numba
from llvmlite import binding
from numba.core import event, types
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.compiler import Compiler
from numba.experimental import structref

if "NUMBA_OPT" not in os.environ:  # compiles a fifth faster than level 3; only the fusion is then a fifth slower
    numba.config.OPT = type(numba.config.OPT)(1)

#: The packages that contain kernels.
ROOMS = ("audit", "calibration", "geometry", "human", "pipeline/batch", "robot")

#: A kernel of more instructions is not copied into its callers. All kernels compile in about the same time for any
#: value between 20 and 400.
_LARGE = 150


class _Apart(NamedTuple):
    """A version of a large kernel, which is compiled once, apart from the kernels that call it."""

    module: str
    name: str
    arguments: tuple[Any, ...]

    def symbol(self) -> str:
        """Name of the compiled function, which is loaded, or compiled if it is not in the folder."""
        kernel = getattr(import_module(self.module), self.name)
        kernel.compile(self.arguments)
        return str(kernel.overloads[self.arguments].fndesc.llvm_func_name)


#: The large kernels that this process has loaded or compiled, by the names of their compiled functions.
_APART: dict[str, _Apart] = {}


class _Compiler(Compiler):
    """Names compiled functions alike in all processes; numba numbers them in the order of their compilation."""

    def define_pipelines(self) -> Any:
        self.state.func_id.unique_id = 0
        return super().define_pipelines()


#: Number of parts of what ``_Stored`` writes; numba alone writes more.
_PARTS = 3


class _Stored(CompileResultCacheImpl):
    """What lies on disk of a compiled version: itself if it is large, the large kernels that it names, and its code."""

    def reduce(self, cres: Any) -> tuple[_Apart | None, dict[str, _Apart], tuple[Any, ...]]:
        """Returns what is to be written."""
        named = sorted(one.name for one in cres.library._final_module.functions if one.is_declaration)  # noqa: SLF001
        calls = {name: _APART[name] for name in named if name in _APART}
        return _APART.get(cres.fndesc.llvm_func_name), calls, super().reduce(cres)

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        """Loads a version and before it what it names; None, so that numba compiles it, if it no longer fits.

        That is so if a name has changed, and for what numba alone or an older version has written.
        """
        if len(payload) != _PARTS:
            return None
        itself, calls, code = payload
        if any(one.symbol() != name for name, one in calls.items()):
            return None
        if itself:
            names = code[1].llvm_func_name, code[1].llvm_cpython_wrapper_name
            # numba looks for the names in what it would copy into callers.
            target_context.codegen()._engine._defined_symbols.update(names)  # noqa: SLF001
            _APART[names[0]] = itself
        return super().rebuild(target_context, code)


class KernelCache(FunctionCache):
    """The compiled versions of one function on disk."""

    _impl_class = _Stored

    def save_overload(self, sig: Any, data: Any) -> None:
        """Writes a compiled version; locked, as another process may add a version to the same index."""
        symbol = data.fndesc.llvm_func_name
        if _is_large(data.library._final_module):  # noqa: SLF001 (numba has no public way to choose what callers copy)
            data.library._shared_module = _declaration(data.library._final_module, symbol)  # noqa: SLF001 (as above)
            _APART[symbol] = _Apart(self._py_func.__module__, self._py_func.__name__, tuple(data.signature.args))
        with _locked():
            super().save_overload(sig, data)

    @property
    def compiled(self) -> bool:
        """True once a version of the function is compiled from its present source file."""
        return bool(self._cache_file._load_index())  # noqa: SLF001 (as above)


def _is_large(module: Any) -> bool:
    """True if a module has more than ``_LARGE`` instructions, without the wrapper for calls from Python."""
    bodies = (one for one in module.functions if not one.is_declaration and not one.name.startswith("_ZN7cpython"))
    return sum(1 for body in bodies for block in body.blocks for _ in block.instructions) > _LARGE


def _declaration(module: Any, symbol: str) -> Any:
    """Returns a module that names a function of another one and does not contain it."""
    returned, _, arguments = str(module.get_function(symbol).global_value_type).partition(" (")
    layout = f'target datalayout = "{module.data_layout}"\ntarget triple = "{module.triple}"\n'
    return binding.parse_assembly(f'{layout}declare {returned} @"{symbol}"({arguments}\n')


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
            kernel = numba.njit(pipeline_class=_Compiler, **options)(function)
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
    folder().mkdir(parents=True, exist_ok=True)
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
    """Digest of the sources of the packages that contain kernels, and of this file, which says what is stored."""
    digest, here = hashlib.sha256(Path(__file__).read_bytes()), Path(__file__).parent
    for source in sorted(path for room in ROOMS for path in (here / room).rglob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


@cache
def folder() -> Path:
    """Folder of the compiled kernels, named by the digest of the sources: another version must not read them.

    It lies in NUMBA_CACHE_DIR if that is set, else beside the package, or in the user's cache if that place is not
    writable.
    """
    name = f"kernels-{_sources()}"
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(chosen) / name
    here = Path(__file__).parent
    beside = here / "__pycache__"
    if not os.access(beside if beside.exists() else here, os.W_OK):
        beside = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hrcreplay"
    return beside / name


def forgo(module: str) -> None:
    """Blocks later imports of a module that is not loaded yet, so that importers use their alternative."""
    sys.modules.setdefault(module, None)  # type: ignore[arg-type]


@structref.register
class _HeldType(types.StructRef):  # type: ignore[name-defined]
    """Numba's type of ``Held``."""


class Held(structref.StructRefProxy):
    """A value as kernels have it, for what stays the same: to convert a tuple of 30 arrays takes 10 us in every call.

    A kernel reads it as ``held.value``.
    """


structref.define_constructor(Held, _HeldType, ["value"])
structref.define_boxing(_HeldType, Held)


@njit(cache=True)
def hold(value: Any) -> Held:
    """Converts a value, such as tuples of arrays and numbers, once; the arrays are not copied."""
    return Held(value)
