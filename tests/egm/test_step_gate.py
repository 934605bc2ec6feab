"""The last gate, by itself: whatever asks, no command leads further than the axes go."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hrcreplay.egm.codec import BadPacket, Correction, encode_correction
from hrcreplay.egm.step_gate import StepGate, UnsafeCommandError
from hrcreplay.records import Floats
from tests.egm.talks import CYCLE_NS, DQ_MAX, ZERO
from tests.facts import facts

CYCLE_S = CYCLE_NS * 1e-9
STEP = DQ_MAX * CYCLE_S


def command(q: Floats, dq: Floats = ZERO) -> bytes:
    return encode_correction(Correction(0, 0, q, dq))


def gate() -> StepGate:
    made = StepGate(DQ_MAX, CYCLE_S)
    made.check(command(ZERO), ZERO, 0)
    return made


def test_the_first_command_is_where_the_robot_is() -> None:
    with pytest.raises(UnsafeCommandError, match=facts("joint 1", "2.0769 rad")):
        StepGate(DQ_MAX, CYCLE_S).check(command(np.full(6, np.radians(119.0))), ZERO, 0)
    with pytest.raises(UnsafeCommandError, match="unknown"):
        StepGate(DQ_MAX, CYCLE_S).check(command(ZERO), None, 0)


def test_a_first_command_beside_a_joint_that_is_no_number_does_not_pass() -> None:
    for axis in range(6):
        for value in (np.nan, np.inf):
            measured = np.where(np.arange(6) == axis, value, 0.0)
            with pytest.raises(UnsafeCommandError, match="first command"):
                StepGate(DQ_MAX, CYCLE_S).check(command(ZERO), measured, 0)


@pytest.mark.parametrize("axis", range(6))
def test_a_step_of_a_cycle_passes_and_one_beyond_it_does_not(axis: int) -> None:
    step = np.where(np.arange(6) == axis, STEP, 0.0)
    gate().check(command(step), ZERO, CYCLE_NS)
    with pytest.raises(UnsafeCommandError, match=facts(f"joint {axis + 1}")):
        gate().check(command(1.001 * step), ZERO, CYCLE_NS)


def test_what_did_not_pass_counts_as_not_sent() -> None:
    one = gate()
    for cycle in (1, 2, 3):
        with pytest.raises(UnsafeCommandError):
            one.check(command(5.0 * STEP), ZERO, cycle * CYCLE_NS)
    one.check(command(4.0 * STEP), ZERO, 4 * CYCLE_NS)


def test_after_a_silence_the_axes_may_have_gone_on_for_as_long() -> None:
    gate().check(command(100.0 * STEP), ZERO, 100 * CYCLE_NS)
    with pytest.raises(UnsafeCommandError, match=r"after 0\.4032 s"):
        gate().check(command(100.1 * STEP), ZERO, 100 * CYCLE_NS)


def test_a_flood_does_not_hurry_the_robot() -> None:
    """A command a millisecond, each of a full cycle: they pass until the store is empty, then at the axes' speed."""
    one, passed, q = gate(), 0, ZERO
    for millisecond in range(1, 1001):
        try:
            one.check(command(q + STEP), ZERO, millisecond * 1_000_000)
        except UnsafeCommandError:
            continue
        q, passed = q + STEP, passed + 1
    assert passed <= 1.0 / CYCLE_S + StepGate.STORE
    assert passed > 200


def test_speeds_beyond_the_axes_and_what_is_no_command_do_not_pass() -> None:
    with pytest.raises(UnsafeCommandError, match=r"joint 3 .*-4\.6\d* rad/s"):
        gate().check(command(ZERO, np.array([0.0, 0.0, -1.02 * DQ_MAX[2], 0.0, 0.0, 0.0])), ZERO, CYCLE_NS)
    with pytest.raises(BadPacket):
        gate().check(b"", ZERO, CYCLE_NS)


@settings(max_examples=200)
@given(
    st.lists(
        st.tuples(st.floats(-0.2, 0.2), st.integers(0, 30_000_000)),
        min_size=1,
        max_size=60,
    )
)
def test_what_passes_keeps_the_axes_speeds(asked: list[tuple[float, int]]) -> None:
    """By a checker of its own, of each step and of the way over any span."""
    one, t_ns, sent = gate(), 0, [(0, 0.0)]
    for q, wait_ns in asked:
        t_ns += wait_ns
        try:
            one.check(command(np.full(6, q)), ZERO, t_ns)
        except UnsafeCommandError:
            continue
        sent.append((t_ns, q))
    speed = DQ_MAX.min()
    for i in range(len(sent) - 1):
        (before_ns, before), (now_ns, now) = sent[i], sent[i + 1]
        assert abs(now - before) <= speed * max(CYCLE_S, (now_ns - before_ns) * 1e-9) * (1 + 2e-6) + 2e-9
        way = 0.0
        for j in range(i + 1, len(sent)):
            way += abs(sent[j][1] - sent[j - 1][1])
            span_s = (sent[j][0] - sent[i][0]) * 1e-9
            assert way <= speed * (span_s + StepGate.STORE * CYCLE_S) * (1 + 2e-6) + 1e-7
