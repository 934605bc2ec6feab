"""The control loop's place before other processes: asked for, refused by name, and given back."""

from __future__ import annotations

import os
import subprocess
import sys

_ASK = """
import os, pathlib
from hrcreplay.live.processes import raise_priority, restore_priority

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
