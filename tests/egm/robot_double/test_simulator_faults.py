"""What the robot double does with faults."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hrcreplay.egm import motion_link_pb2 as messages
from hrcreplay.egm.codec import Correction, Motors, Rapid, encode_correction
from hrcreplay.egm.robot_double.faults import KINDS, Datagram, Fault, random_faults
from hrcreplay.egm.robot_double.robot_simulator import SimulatedRobot, SimulatorSettings
from hrcreplay.egm.robot_double.servo import PERIOD_NS, ServoSettings
from tests.egm.rehearsals import HOME, Guide, T, ramp, ramp_until, rehearsed, shown


@pytest.mark.parametrize(
    ("kind", "field", "value"),
    [
        ("motors_off", "motors", Motors.OFF),
        ("program_stop", "rapid", Rapid.STOPPED),
        ("rapid_undefined", "rapid", Rapid.UNDEFINED),
    ],
)
def test_states_change_for_the_length_of_the_fault(kind: str, field: str, value: int) -> None:
    guide = Guide()
    rehearsed(2.0, guide, Fault(kind, 0.5, 1.0))
    times = [
        t_ns * 1e-9
        for (t_ns, _), packet in zip(guide.heard, guide.packets(), strict=True)
        if getattr(packet, field) == value
    ]
    assert times[0] == pytest.approx(0.5, abs=T)
    assert times[-1] == pytest.approx(1.5, abs=T)
    assert len(times) == pytest.approx(1.0 / T, abs=1)


def test_motors_that_come_back_make_the_old_target_live() -> None:
    guide = Guide(ramp_until(1.0, then=lambda t: ramp(1.0) if t < 1.01 else None))
    core = rehearsed(4.0, guide, Fault("motors_off", 1.02, 0.5), servo=ServoSettings(comm_timeout_s=9.0))
    rows = core.record.cycles()
    off = rows[rows["motors"] == Motors.OFF]
    assert np.all(off["planned_rad_per_s"][10:] == 0.0)
    assert off["planned_rad"][-1, 0] < 0.21
    assert rows["planned_rad"][-1, 0] == pytest.approx(0.2 + 0.2 / 5, abs=1e-4)


def test_an_egm_error_is_told_and_followed_by_a_new_session() -> None:
    guide = Guide(ramp)
    core = rehearsed(4.0, guide, Fault("egm_error", 1.0, 0.2))
    assert core.ends[0] == "EGM error"
    assert core.session == 2
    rows = core.record.cycles()
    assert np.all(rows["planned_rad_per_s"][(rows["t_ns"] > 1.6e9) & (rows["session"] == 1)] == 0.0)


def test_a_new_session_counts_from_0_and_holds_until_it_is_told() -> None:
    guide = Guide(ramp_until(1.0, then=lambda _t: None))
    core = rehearsed(2.0, guide, Fault("new_session", 1.004, 0.0))
    rows = core.record.cycles()
    again = rows[rows["session"] == 2]
    assert again["seqno"].tolist() == list(range(len(again)))
    assert np.all(np.isnan(again["ref_rad"]))
    assert np.all(np.abs(again["planned_rad_per_s"][50:]) < 1e-9)


def test_a_new_session_forgets_what_was_queued_or_under_way() -> None:
    late = Fault("delay", 0.0, 0.002, direction="in", delay_s=0.05)
    core = SimulatedRobot(SimulatorSettings(), [late, Fault("new_session", 3.5 * T, 0.0)])
    told = encode_correction(Correction(1, 0, *ramp(1.0)))
    core.cycle(0, [Datagram(0, told)])
    core.cycle(PERIOD_NS, [Datagram(PERIOD_NS, told)] * 9)
    for cycle in range(2, 30):
        core.cycle(cycle * PERIOD_NS, [])
    rows = core.record.cycles()
    assert rows["session"].tolist() == [1] * 4 + [2] * 26
    assert np.flatnonzero(rows["told_seqno"] >= 0).tolist() == [1, 2, 3]


def test_after_an_error_the_program_begins_again_only_with_motors() -> None:
    guide = Guide()
    core = rehearsed(5.0, guide, Fault("egm_error", 0.5, 0.0), Fault("motors_off", 1.0, 3.0))
    rows = core.record.cycles()
    assert rows["t_ns"][rows["session"] == 2][0] * 1e-9 == pytest.approx(4.0, abs=2 * T)


def test_falsified_joints_are_told_while_the_robot_stays_where_it_is() -> None:
    guide = Guide()
    core = rehearsed(2.0, guide, Fault("teleport", 0.5, 0.5, axis=2, angle_deg=-20.0), Fault("nan", 1.5, 0.1, axis=6))
    raw = np.array([list(messages.RobotMessage.FromString(data).feed_back.joints.joints) for _, data in guide.heard])
    shifted = np.flatnonzero(raw[:, 1] < -19.0)
    assert raw[shifted, 1] == pytest.approx(-20.0)
    assert len(shifted) == 124
    assert np.flatnonzero(np.isnan(raw[:, 5])).size == 24
    assert not np.isnan(raw[:, :5]).any()
    assert core.record.cycles()["planned_rad"] == pytest.approx(np.tile(HOME, (496, 1)))


def test_silence_sends_nothing_and_the_robot_moves_on() -> None:
    guide = Guide(ramp)
    core = rehearsed(1.2, guide, Fault("silence", 1.0, 0.1))
    rows = core.record.cycles()
    quiet = rows[rows["seqno"] == -1]
    assert len(quiet) == 24
    assert np.all(quiet["planned_rad_per_s"][:, 0] > 0.1)
    assert np.all(np.diff(rows["seqno"][rows["seqno"] >= 0]) == 1)


def test_a_stall_on_the_way_out_delivers_stale_packets_at_once() -> None:
    guide = Guide()
    core = rehearsed(1.0, guide, Fault("stall", 0.5, 0.1))
    times = [t_ns for t_ns, _ in guide.heard]
    assert times.count(600_000_000) == 24
    answers = shown(core).answers
    assert (answers.missed, answers.doubled) == (0, 0)  # one answer to the newest is all that is owed


def test_faults_on_the_way_in_leave_the_guide_unaware() -> None:
    guide = Guide(ramp)
    core = rehearsed(1.0, guide, Fault("loss", 0.5, 0.2, direction="in"))
    rows = core.record.cycles()
    unheard = rows[(rows["told_seqno"] == -1) & (rows["t_ns"] > 4e6)]
    assert len(unheard) == pytest.approx(50, abs=1)
    assert shown(core).answers.missed == 0
    assert len(guide.heard) == 248


def test_faults_on_the_way_out_leave_the_answers_alone() -> None:
    guide = Guide(ramp)
    core = rehearsed(1.0, guide, Fault("loss", 0.5, 0.2, probability=0.5))
    read = core.record.cycles()["told_seqno"]
    assert len(guide.heard) < 240
    assert np.sum(read >= 0) == guide.count - 1  # the last is still under way


@pytest.mark.parametrize("seed", range(8))
def test_the_same_seed_tells_the_same_and_nothing_brings_it_down(seed: int) -> None:
    faults = random_faults(seed, duration_s=3.0, count=8, after_s=0.2)
    first, second = (rehearsed(3.5, Guide(ramp), *faults, seed=seed) for _ in range(2))
    assert first.record.cycles().tobytes() == second.record.cycles().tobytes()
    assert first.record.arrivals().tobytes() == second.record.arrivals().tobytes()
    shown(first, *faults)


def test_every_kind_of_fault_has_a_test_here_or_with_the_channel() -> None:
    tests = "".join(path.read_text() for path in Path(__file__).parent.glob("test_*.py"))
    assert [kind for kind in KINDS if f'"{kind}"' not in tests] == []
