"""The greatest step that was ever sent, from log.mcap alone: ``python -m tests.live.attacks.checker LOG...``

Reads the commands with the library of the file format and the protocol's message, nothing of ours beside its schema,
and holds them against the axes of the IRB 140's product specification.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.reader import make_reader

from hrcreplay.egm import motion_link_pb2 as messages
from hrcreplay.egm.robot_double.servo import IRB140

_TOPIC = "/egm/correction"
_CYCLE_S = 0.004032


class Step(NamedTuple):
    """One command after another."""

    t_ns: int
    axis: int
    step_deg: float
    share: float  #: of what the axis can go from the last command, in the time since or a cycle; at most 1 is right


def steps(log: Path) -> Iterator[Step]:
    """Every step that was sent."""
    speed = np.array(IRB140.speed_deg_per_s)
    with log.open("rb") as stream:
        sent = [
            (message.log_time, np.array(messages.SensorMessage.FromString(message.data).planned.joints.joints))
            for _, _, message in make_reader(stream).iter_messages(topics=[_TOPIC])
        ]
    for (before_ns, before), (now_ns, now) in pairwise(sent):
        step = np.abs(now - before)
        shares = step / (speed * max(_CYCLE_S, (now_ns - before_ns) * 1e-9))
        axis = int(np.argmax(shares))
        yield Step(now_ns, axis, float(step[axis]), float(shares[axis]))


def greatest(log: Path) -> Step:
    """The step with the largest share."""
    return max(steps(log), key=lambda step: step.share)


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m tests.live.attacks.checker", description=__doc__)
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG")
    worst = 0.0
    for log in parser.parse_args().logs:
        found = greatest(log)
        worst = max(worst, found.share)
        sys.stdout.write(
            f"{log}: greatest step {found.step_deg:.4f} deg of joint {found.axis + 1}, "
            f"{found.share:.3f} of what it can go\n"
        )
    return int(worst > 1.0 + 1e-6)


if __name__ == "__main__":
    sys.exit(main())
