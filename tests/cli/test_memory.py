"""Commands give memory back to the system; a library's user keeps the allocator as it was."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

#: Frees every second of many arrays of two megabytes, and tells how much memory of all of them remains [MB].
HOLES = """
import numpy as np
def used():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 1e6
np.ones(3_000_000)  # once this is freed, glibc by itself keeps arrays of up to this size
before = used()
arrays = [np.ones(262_144) for _ in range(100)]
del arrays[::2]
print(used() - before)
"""
CHILD = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {HOLES!r}], check=True)\n"
GIVE_BACK = "from hrcreplay.cli.commands import give_back_memory; give_back_memory()\n"
ARROW = "import pyarrow as pa; print(pa.default_memory_pool().backend_name)\n"

glibc = pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library has no such limit")


def _tell(code: str, **environment: str) -> str:
    names = ("MALLOC_MMAP_THRESHOLD_", "ARROW_DEFAULT_MEMORY_POOL")
    clean = {name: value for name, value in os.environ.items() if name not in names}
    done = subprocess.run(
        [sys.executable, "-c", code], env={**clean, **environment}, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


@glibc
def test_what_is_freed_between_other_arrays_goes_back_to_the_system() -> None:
    kept = 50 * 2.097152
    assert float(_tell(HOLES)) > 1.8 * kept
    assert float(_tell(GIVE_BACK + HOLES)) < 1.2 * kept
    assert float(_tell(GIVE_BACK + CHILD)) < 1.2 * kept  # that of a process that it starts


@glibc
def test_an_allocator_that_the_user_chose_stays() -> None:
    assert float(_tell(GIVE_BACK + HOLES, MALLOC_MMAP_THRESHOLD_="33554432")) > 1.8 * 50 * 2.097152
    assert _tell(GIVE_BACK + ARROW, ARROW_DEFAULT_MEMORY_POOL="mimalloc") == "mimalloc"


def test_tables_use_the_memory_of_the_system() -> None:
    assert _tell(GIVE_BACK + ARROW) == "system"
    assert _tell(ARROW) != "system"
