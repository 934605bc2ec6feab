"""Compiled kernels of other sources are never used: numba itself looks only at a kernel's own file."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

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
    for name in ("geometry/vectors.py", "human/fusion/kalman.py", "robot/model.py", "audit/measures.py"):
        source = package / name
        source.write_text(source.read_text() + "\n# changed\n")
        after = _cache(package)
        assert after != before
        before = after


def test_every_module_with_kernels_is_in_a_room_that_counts() -> None:
    package = Path(hrcreplay.__file__).parent
    with_kernels = [path for path in package.rglob("*.py") if "import njit" in path.read_text()]
    assert with_kernels
    assert {path.relative_to(package).parts[0] for path in with_kernels} <= set(kernels.ROOMS)


def test_the_users_own_choice_stands(tmp_path: Path) -> None:
    assert _cache(Path(hrcreplay.__file__).parent, NUMBA_CACHE_DIR=str(tmp_path)) == str(tmp_path)


def test_importing_the_package_changes_nothing_of_the_process() -> None:
    code = "import os, sys, time; before = dict(os.environ), set(sys.modules); begin = time.perf_counter()\n"
    code += "import hrcreplay\nimport builtins\n"
    code += "assert dict(os.environ) == before[0]\n"
    code += "assert not {'numpy', 'numba', 'hashlib', 'pandas', 'proxsuite'} & (set(sys.modules) - before[1])\n"
    code += "from hrcreplay.geometry import vectors\nimport numba\nassert numba.config.CACHE_DIR == ''\n"
    clean = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    subprocess.run([sys.executable, "-c", code], check=True, env=clean)
