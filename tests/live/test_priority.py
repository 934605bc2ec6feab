"""The control loop's place before other processes: asked for, refused by name, and given back."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

_ASK = """
import os, pathlib
from hrcreplay.live.priority import raise_priority, restore_priority

def told():
    status = pathlib.Path("/proc/self/status").read_text()
    print(os.sched_getscheduler(0), int(status.partition("VmLck:")[2].split()[0]) > 0)

told()
print(raise_priority())
told()
restore_priority()
told()
"""


def test_the_loop_runs_before_others_and_gives_it_back() -> None:
    asked = subprocess.run([sys.executable, "-c", _ASK], capture_output=True, text=True, check=True)
    before, refused, during, after = asked.stdout.splitlines()
    policy = os.SCHED_OTHER if "real-time priority" in refused else os.SCHED_FIFO
    assert during == f"{policy} {'locked memory' not in refused}"
    assert before == after == f"{os.SCHED_OTHER} False"


_KEEP = """
import ctypes
from hrcreplay.live.priority import raise_priority

library = ctypes.CDLL(None)
library.sbrk.restype = library.malloc.restype = ctypes.c_void_p
library.malloc.argtypes, library.free.argtypes = [ctypes.c_size_t], [ctypes.c_void_p]

def moves():
    \"\"\"Whether the heap grows for 8 MB and shrinks again, when somebody has it trimmed.\"\"\"
    before = library.sbrk(0)
    block = library.malloc(8 << 20)
    grown = library.sbrk(0)
    library.free(block)
    return grown != before, bool(library.malloc_trim(0)) and library.sbrk(0) < grown

library.mallopt(-4, 0)  # blocks of any size are in the heap
print(*moves())
raise_priority()
print(*moves(), *moves())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries keep their heap in other ways")
def test_no_cycle_waits_for_memory_that_protobuf_had_given_back() -> None:
    asked = subprocess.run([sys.executable, "-c", _KEEP], capture_output=True, text=True, check=True)
    before, during = asked.stdout.splitlines()
    assert before == "True True", "what happens otherwise"
    assert during == "False False False False"
