"""Faults against the controller in counted time: what must never happen does not. The long campaign is campaign.py."""

from __future__ import annotations

import subprocess
import sys

import pytest

from hrcreplay.egm.robot_double.faults import KINDS, LINK_FAULTS, Fault
from tests.live.flights import CYCLE_S
from tests.tools.campaign import session, violations

#: Stops that a fault of 0.4 s must lead to; of the others a robot may take no notice.
EXPECTED = {
    "stall": "robot silent",
    "silence": "robot silent",
    "nan": "robot silent",  # joints that are no numbers are not answered
    "teleport": "joints jump",
    "motors_off": "motors off",
    "program_stop": "program stopped",
    "egm_error": "EGM error",
}


@pytest.mark.parametrize("kind", KINDS)
def test_each_fault_by_itself(kind: str) -> None:
    direction = {"direction": "both"} if kind in LINK_FAULTS else {}
    fault = Fault(kind, 1.2, 0.4, delay_s=0.03, angle_deg=40.0, **direction)  # type: ignore[arg-type]
    flight = session(1 + KINDS.index(kind), (fault,), seconds=2.2)
    assert violations(flight) == []
    reasons = {reason for _, reason in flight.controller.stops}
    assert EXPECTED.get(kind) in {None, *reasons}
    assert len(flight.said()) * CYCLE_S > 1.2


@pytest.mark.parametrize("seed", range(1000, 1010))
def test_random_faults(seed: int) -> None:
    assert violations(session(seed, seconds=3.0)) == []


def test_nothing_is_compiled_while_a_robot_waits() -> None:
    done = subprocess.run([sys.executable, "-m", "tests.live.compiled"], capture_output=True, text=True, check=True)
    assert done.stdout == ""
