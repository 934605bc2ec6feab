"""What a session compiles after its kernels were compiled: ``python -m tests.live.compiled``. None is right.

In a process of its own, because a kernel that anything else has compiled for the same arrays is not compiled again.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from numba.core.registry import CPUDispatcher

from hrcreplay.egm.robot_double.faults import random_faults
from hrcreplay.live.control.setup import compile_kernels
from tests.live.flights import Flight, start
from tests.tools import campaign
from tests.visits import cell_around

SECONDS = 4.0
OVERRIDES = ("live.approach_speed=1.0", "live.resume=true", "live.resume_s=0.1")


def walk(s: float) -> tuple[float, float] | None:
    """Somebody who comes near, and whom no camera sees for a while."""
    return None if 2.0 < s < 2.8 else campaign.walk(s)


def kernels() -> set[tuple[str, str]]:
    """Every kernel of ours with the kinds of arrays that it is compiled for."""
    modules = [(name, module) for name, module in sys.modules.items() if name.startswith("hrcreplay.")]
    return {
        (f"{name}.{kernel}", str(signature))
        for name, module in modules
        for kernel, found in vars(module).items()
        if isinstance(found, CPUDispatcher)
        for signature in found.signatures
    }


def late(sessions: int) -> Iterator[str]:
    """Kernels that sessions with faults compile while the robot waits, and one in a watched cell."""
    with TemporaryDirectory() as folder:
        cell = cell_around(Path(folder) / "cell.toml", 2.5, clear_s=0.5)
        compile_kernels(start(*OVERRIDES, cell=cell))
        before = kernels()
        for seed in range(sessions):
            Flight(OVERRIDES, walk, random_faults(seed, duration_s=SECONDS - 0.5, count=6), seed).fly(SECONDS)
        watched = Flight(OVERRIDES, lambda s: None if s < 2.0 else (4.0 - s, 0.2), cell=cell).fly(SECONDS)
    if "following" not in watched.phases() or watched.phases()[-1] == "waiting":
        yield "the robot in a watched cell did not move\n"
    for name, signature in sorted(kernels() - before):
        yield f"{name}: {signature}\n"


if __name__ == "__main__":
    sys.stdout.writelines(late(3))
