"""Live sessions of arms with seven axes: the seventh goes as an external joint, in the order that the settings say."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from hrcreplay.egm import motion_link_pb2 as egm
from hrcreplay.egm.codec import decode_correction
from hrcreplay.egm.robot_double.robot_simulator import SimulatorSettings
from hrcreplay.egm.robot_double.servo import ServoSettings, axes_of
from hrcreplay.egm.step_gate import StepGate
from hrcreplay.errors import SettingsError
from hrcreplay.live.control.loop import _brake
from hrcreplay.live.control.session_controller import TRACKING
from hrcreplay.live.control.setup import joint_order
from hrcreplay.live.record import codec, folder
from hrcreplay.live.record.codec import PHASES
from hrcreplay.live.verify import verify
from tests.commands.arms import ARMS
from tests.facts import facts
from tests.live import made
from tests.live.flights import BEGIN_NS, CYCLE_S, Flight, start

SEVEN = [1, 2, 4, 5, 6, 7, 3]


def flight_of(folder: Path, order: list[int], *, told: list[int] | None = None, seconds: float = 6.0) -> Flight:
    """An xArm 7 whose EGM sends the axes in ``order``; ``told``: the order that the settings say instead."""
    arm = ARMS["xarm7"]
    settings = (*arm.overrides(folder), "live.approach_speed=1.0", f"live.joint_order={told or order}")
    robot = Flight(settings).robot
    by_egm = np.array(order) - 1
    axes = axes_of(*(bound[by_egm] for bound in (robot.q_min, robot.q_max, robot.dq_max)))
    begin = tuple(np.array([float(angle) + 3.0 for angle in arm.home_deg])[by_egm].tolist())
    double = SimulatorSettings(servo=ServoSettings(axes=axes), start_deg=begin)
    return Flight(settings, twin=double).fly(seconds)


@pytest.mark.parametrize("order", [list(range(1, 8)), SEVEN], ids=["as they stand", "as of a YuMi"])
def test_an_arm_of_seven_axes_follows_its_programme(tmp_path: Path, order: list[int]) -> None:
    flight = flight_of(tmp_path, order)
    robot, by_egm = flight.robot, np.array(order) - 1
    assert robot.nv == 7
    assert flight.phases()[-1] == "following"
    assert not flight.controller.stops
    gate = StepGate(robot.dq_max[by_egm], CYCLE_S)
    for answer in flight.answers:
        assert answer.datagram is not None
        assert answer.row is not None
        message = egm.SensorMessage.FromString(answer.datagram)
        assert len(message.planned.joints.joints) == len(message.speed_reference.joints.joints) == 6
        assert len(message.planned.external_joints.joints) == 1
        gate.check(answer.datagram, answer.measured[by_egm], answer.t_ns)
    rows = [answer.row for answer in flight.answers if answer.row is not None]
    said = np.array([reply.q for reply in flight.said()])
    assert np.ptp(said, axis=0)[by_egm == 0] > 0.1  # it turns to and fro about its first axis
    # what the double measures is where the row says that it is, and it goes where it is told
    measured = np.array([answer.measured for answer in flight.answers if answer.row is not None])
    after = flight.core.record.cycles()["q_rad"]  # of the cycle before
    assert_allclose(measured[1:, by_egm], after[: len(rows) - 1], atol=1e-9)
    lag = np.abs(measured - np.array([row.q for row in rows])).max()
    assert lag < 0.15


def test_after_a_crash_the_fallback_goes_on_with_the_stop_in_the_order_of_egm(tmp_path: Path) -> None:
    flight = flight_of(tmp_path, SEVEN, seconds=3.0)
    last = flight.answers[-1]
    assert last.stop is not None
    assert last.stop.ticks > 3
    loop: Any = SimpleNamespace(sent=last.datagram, stop=last.stop, controller=flight.controller)
    fallback = _brake(loop)
    assert fallback is not None
    by_egm = np.array(SEVEN) - 1
    for row in range(1, last.stop.ticks + 1):
        told = decode_correction(fallback.step(0))
        assert_allclose(told.q, last.stop.q[row, by_egm], atol=1e-12)
        assert_allclose(told.dq, last.stop.dq[row, by_egm], atol=1e-12)
    assert fallback.at_rest
    fallback.dq, fallback.stop = [10.0] * 7, []
    fallback.step(0)  # and by itself, each axis by its own limit
    slower = 10.0 - np.degrees(flight.robot.ddq_max[by_egm]) * fallback.cycle_s
    assert_allclose(fallback.dq, np.maximum(slower, 0.0), atol=1e-9)


def test_another_order_than_the_robot_s_is_met_by_a_stop(tmp_path: Path) -> None:
    flight = flight_of(tmp_path, SEVEN, told=list(range(1, 8)), seconds=4.0)
    assert PHASES[flight.answers[-1].phase] in ("holding", "waiting") or TRACKING in {
        reason for _, reason in flight.controller.stops
    }


def test_a_session_of_seven_axes_comes_out_the_same_again(tmp_path: Path) -> None:
    flight = flight_of(tmp_path, SEVEN, seconds=3.0)
    partial = folder.make_partial(tmp_path / "session")
    end = {"what": "end", "reason": "Ctrl-C", "counts": {}, "dropped": 0, "looks_skipped": 0, "stops": []}
    begin = codec.encode_event(BEGIN_NS - 1, {"what": "start", **flight.start})
    messages = [begin, *flight.messages, codec.encode_event(BEGIN_NS + 10**10, end)]
    made.record(partial / "log.mcap", messages, chunk=500)
    assert verify(folder.finish(partial)).identical


def test_a_robot_of_six_axes_is_told_at_its_first_packet(tmp_path: Path) -> None:
    flight = Flight(ARMS["xarm7"].overrides(tmp_path)).fly(0.1)
    assert [reason for _, reason in flight.controller.stops] == ["axes"]
    assert flight.controller.stops[0][0] - BEGIN_NS < 10_000_000
    assert not flight.said()


@pytest.mark.parametrize(
    ("names", "given", "told"),
    [
        (("a", "b", "c"), (1, 2), "each of"),
        (("a", "b", "c"), (1, 2, 2), "each of"),
        (("a", "b", "c"), (0, 1, 2), "each of"),
        (("yumi_joint_1_r", "yumi_joint_2_r", "yumi_joint_7_r", "yumi_joint_3_r"), (), "No"),
        (("joint_1", "joint_2", "joint_4", "joint_3"), (), r"live\.joint_order=\[1, 2, 4, 3\], or \[1, 2, 3, 4\]"),
    ],
)
def test_an_order_that_cannot_be_is_refused(names: tuple[str, ...], given: tuple[int, ...], told: str) -> None:
    if told == "No":  # a number that is missing: the names say nothing
        assert_array_equal(joint_order("arm", names, given), [0, 1, 2, 3])
        return
    with pytest.raises(SettingsError, match=told):
        joint_order("arm", names, given)


def test_the_joints_of_a_yumi_have_to_be_ordered() -> None:
    names = [f"yumi_joint_{number}_r" for number in (1, 2, 7, 3, 4, 5, 6)]
    with pytest.raises(SettingsError, match=r"live\.joint_order=\[1, 2, 4, 5, 6, 7, 3\]"):
        joint_order("yumi", names, ())
    assert_array_equal(joint_order("yumi", names, tuple(SEVEN)), [0, 1, 3, 4, 5, 6, 2])


def test_an_arm_of_five_axes_is_no_robot_of_egm(tmp_path: Path) -> None:
    axes = "".join(
        f'<link name="l{i}"/><joint name="j{i}" type="revolute"><parent link="{f"l{i - 1}" if i else "base"}"/>'
        f'<child link="l{i}"/><origin xyz="0 0 0.2"/><axis xyz="0 {i % 2} {1 - i % 2}"/>'
        '<limit lower="-2" upper="2" velocity="2" effort="1"/></joint>'
        for i in range(5)
    )
    urdf = tmp_path / "five.urdf"
    urdf.write_text(f'<robot name="five"><link name="base"/>{axes}</robot>')
    links = "[{name='all', body='l4', start_m=[0, 0, 0], end_m=[0, 0, 0.1], radius_m=0.05}]"
    task = tmp_path / "task.toml"
    task.write_text("[[waypoints]]\njoints_deg = [0, 0, 0, 0, 0]\n[[waypoints]]\njoints_deg = [10, 0, 0, 0, 0]\n")
    with pytest.raises(SettingsError, match=facts("five", "5 axes", "6 to 14")):
        start(f"robot.urdf={urdf}", f"robot.links={links}", f"plan.task={task}")
