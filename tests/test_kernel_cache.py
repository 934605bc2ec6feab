"""Compiled kernels of other sources are never used: numba itself looks only at a kernel's own file."""

from __future__ import annotations

import ast
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import hrcreplay
from hrcreplay import kernels

ASK = "from hrcreplay import kernels; print(kernels.folder())"


def _cache(package: Path, **environment: str) -> str:
    clean = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-c", ASK],
        cwd=package.parent,
        env={**clean, **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


def test_a_changed_source_gets_a_cache_of_its_own(tmp_path: Path) -> None:
    package = tmp_path / "hrcreplay"
    shutil.copytree(Path(hrcreplay.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    before = _cache(package)
    assert Path(before).is_relative_to(tmp_path)
    assert _cache(package) == before
    in_rooms = ("geometry/vectors.py", "human/fusion/kalman.py", "robot/model.py", "pipeline/batch/ticks.py")
    for name in (*in_rooms, "kernels.py"):
        source = package / name
        source.write_text(source.read_text() + "\n# changed\n")
        after = _cache(package)
        assert after != before
        before = after


def test_every_module_with_kernels_is_in_a_room_that_counts() -> None:
    package = Path(hrcreplay.__file__).parent
    with_kernels = [path for path in package.rglob("*.py") if "import njit" in path.read_text()]
    assert with_kernels
    rooms = [package / room for room in kernels.ROOMS]
    assert [path for path in with_kernels if not any(path.is_relative_to(room) for room in rooms)] == []


def test_in_the_folder_that_the_user_chose_each_version_has_its_own(tmp_path: Path) -> None:
    """A kernel of one version that calls one of another would crash the process, or decide as the other version did."""
    package = tmp_path / "hrcreplay"
    shutil.copytree(Path(hrcreplay.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    chosen = tmp_path / "chosen"
    before = _cache(package, NUMBA_CACHE_DIR=str(chosen))
    assert Path(before).parent == chosen
    kernel = package / "robot" / "control" / "qp_tick.py"
    kernel.write_text(kernel.read_text() + "\n# another version\n")
    after = _cache(package, NUMBA_CACHE_DIR=str(chosen))
    assert Path(after).parent == chosen
    assert after != before


def test_importing_the_package_changes_nothing_of_the_process() -> None:
    code = "import os, sys, time; before = dict(os.environ), set(sys.modules); begin = time.perf_counter()\n"
    code += "import hrcreplay\nimport builtins\n"
    code += "assert dict(os.environ) == before[0]\n"
    code += "assert not {'numpy', 'numba', 'hashlib', 'pandas', 'proxsuite'} & (set(sys.modules) - before[1])\n"
    code += "from hrcreplay.geometry import vectors\nimport numba\nassert numba.config.CACHE_DIR == ''\n"
    clean = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    subprocess.run([sys.executable, "-c", code], check=True, env=clean)


def _is_kernel(node: ast.AST, word: str = "njit") -> bool:
    return isinstance(node, ast.FunctionDef) and any(word in ast.unparse(one) for one in node.decorator_list)


def _calls_from_python(path: Path, module: str) -> set[str]:
    """Dotted names of functions that the Python code of a file names: its own, imported ones, those of modules."""
    tree = ast.parse(path.read_text())
    known = {node.name: f"{module}.{node.name}" for node in tree.body if isinstance(node, ast.FunctionDef)}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            known |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    found: set[str] = set()

    def visit(node: ast.AST) -> None:
        if _is_kernel(node) or (isinstance(node, ast.Attribute) and node.attr == "py_func"):  # that is plain Python
            return
        if isinstance(node, ast.Name) and node.id in known:
            found.add(known[node.id])
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in known:
            found.add(f"{known[node.value.id]}.{node.attr}")
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(tree)
    return found


def test_inner_kernels_are_called_by_kernels_alone() -> None:
    """A call from Python would crash the process: an inner kernel has no entry for it."""
    root = Path(hrcreplay.__file__).parents[1]
    inner, called = set(), set()
    for path in [*root.joinpath("hrcreplay").rglob("*.py"), *root.joinpath("tests").rglob("*.py")]:
        module = ".".join(path.relative_to(root).with_suffix("").parts)
        functions = [one for one in ast.parse(path.read_text()).body if isinstance(one, ast.FunctionDef)]
        inner |= {f"{module}.{one.name}" for one in functions if _is_kernel(one, "inner=True")}
        called |= _calls_from_python(path, module)
    assert len(inner) > 20
    assert not inner & called


LARGE = """
from math import sin
from hrcreplay.kernels import njit
@njit(cache=True{options})
def large(x):
    total = {start}
{steps}
    return total + {start}
@njit(cache=True)
def small(x):
    return 2.0 * x
"""
CALLER = """
from hrcreplay.kernels import njit
from large import large, small
@njit(cache=True)
def both(x):
    return large(x) + small(x)
"""
TELL = """
import caller, large
print(caller.both(1.5))
print(*(sum(one.stats.cache_hits.values()) for one in (caller.both, large.large)))
functions = list(list(caller.both.overloads.values())[0].library._final_module.functions)
print(*(one.name for one in functions if "5largeB" in one.name or "5smallB" in one.name))
print(*(one.is_declaration for one in functions if "5largeB" in one.name))
"""


def _write_large(folder: Path, start: float = 0.0, options: str = "") -> None:
    steps = "\n".join(f"    total = sin(total + {number} * x)" for number in range(100))
    (folder / "large.py").write_text(LARGE.format(start=start, steps=steps, options=options))


def _tell_both(folder: Path, before: str = "") -> tuple[float, list[str], list[str]]:
    """Calls ``both`` in a new process, after some other code.

    Returns:
        Its result, how often it and ``large`` were read from disk, and what its code names.
    """
    there = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "kept")}
    there["PYTHONPATH"] = os.pathsep.join([str(folder), str(Path(hrcreplay.__file__).parents[1])])
    done = subprocess.run([sys.executable, "-c", before + TELL], env=there, capture_output=True, text=True, check=True)
    result, hits, *code = done.stdout.splitlines()
    return float(result), hits.split(), code


def _result(start: float = 0.0) -> float:
    total = start
    for number in range(100):
        total = math.sin(total + number * 1.5)
    return total + start + 3.0


@pytest.fixture
def two_modules(tmp_path: Path) -> Path:
    """A caller, a large kernel and a small one, and the folder of what is compiled."""
    _write_large(tmp_path)
    (tmp_path / "caller.py").write_text(CALLER)
    (tmp_path / "kept").mkdir()
    return tmp_path


def test_a_large_kernel_is_no_part_of_its_callers(two_modules: Path) -> None:
    result, hits, (functions, declared) = _tell_both(two_modules)
    assert result == pytest.approx(_result(), abs=1e-15)
    assert hits == ["0", "0"]
    assert "5largeB" in functions  # named,
    assert declared == "1"  # and compiled elsewhere
    assert "5smallB" not in functions  # a copy of it was inlined
    from_python = f"import large; assert abs(large.large(1.5) + 3.0 - {result!r}) < 1e-12\n"
    again, hits, _code = _tell_both(two_modules, from_python)
    assert again == result
    assert hits == ["1", "1"]


def test_callers_find_a_large_kernel_that_was_lost_or_changed(two_modules: Path) -> None:
    result, _hits, _code = _tell_both(two_modules)
    for path in (two_modules / "kept").rglob("large.large-*"):
        path.unlink()
    assert _tell_both(two_modules)[:2] == (result, ["1", "0"])
    for path in (two_modules / "kept").rglob("caller.both-*"):
        path.unlink()
    assert _tell_both(two_modules)[:2] == (result, ["0", "1"])
    assert _tell_both(two_modules)[:2] == (result, ["1", "1"])  # it was compiled beside a large one read from disk
    _write_large(two_modules, start=0.25)
    changed, hits, _code = _tell_both(two_modules)
    assert changed == pytest.approx(_result(0.25), abs=1e-15)
    assert abs(changed - result) > 0.01
    assert hits == ["1", "0"]


def test_a_caller_is_compiled_again_where_its_large_kernel_has_another_name(two_modules: Path) -> None:
    """Loaded, it would name what is not there, and the process would crash."""
    result, _hits, _code = _tell_both(two_modules)
    _write_large(two_modules, options=", inner=True")
    assert _tell_both(two_modules)[:2] == (result, ["0", "0"])
    assert _tell_both(two_modules)[:2] == (result, ["1", "1"])  # which has no entry for calls from Python


def test_what_an_older_version_has_written_is_compiled_again(two_modules: Path) -> None:
    """It does not say which large kernels it names: numba alone copies all of them."""
    alone = "from hrcreplay import kernels; from numba.core.caching import CompileResultCacheImpl\n"
    alone += "kernels.KernelCache._impl_class = CompileResultCacheImpl\n"
    result, hits, _code = _tell_both(two_modules, alone)
    assert hits == ["0", "0"]
    assert _tell_both(two_modules)[:2] == (result, ["0", "0"])
    assert _tell_both(two_modules)[:2] == (result, ["1", "1"])
