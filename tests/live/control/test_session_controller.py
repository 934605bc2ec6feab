from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from hrcreplay.egm.codec import Correction
from hrcreplay.egm.link import JUMPED
from hrcreplay.egm.robot_double.faults import Fault
from hrcreplay.human.fusion import fuse
from hrcreplay.live.control import session_controller
from hrcreplay.live.control.setup import build_controller
from hrcreplay.live.control.stages import Observer, start_approach
from hrcreplay.live.record import codec
from hrcreplay.live.record.codec import PHASES, Signal
from hrcreplay.logs.cleaning import PersonMemory
from hrcreplay.logs.skeleton_pb2 import Skeleton
from hrcreplay.records import STATUSES, CameraFrames, Floats, HumanStates
from hrcreplay.robot.control.controllers import QpController
from hrcreplay.robot.kinematics import RobotPose
from hrcreplay.robot.model import RobotModel
from tests.live.flights import BEGIN_NS, CYCLE_S, Flight, far_away, is_a_stop, start, steps_keep_the_limits
from tests.tools.campaign import violations


def moved(flight: Flight, after: int = 0) -> bool:
    return bool(np.any([reply.dq for reply in flight.said()[after:]]))


def test_it_echoes_then_approaches_then_follows_without_a_jump() -> None:
    flight = Flight().fly(12.0)
    first = flight.said()[0]
    assert_allclose(first.q, flight.answers[0].measured, atol=1e-12)
    assert_array_equal(first.dq, 0.0)
    assert flight.phases()[0] == "echo"
    assert flight.phases()[-2:] == ["approach", "following"]
    steps_keep_the_limits(flight)
    q, _ = flight.commanded()
    assert (
        np.abs(q - flight.controller.setup.programme.q0).max(axis=1).min() < 0.05
    )  # it came past where the path begins
    assert moved(flight, after=-200)


def test_it_does_not_start_before_it_has_seen_the_person() -> None:
    flight = Flight(walk=lambda s: None if s < 1.0 else (3.0, 0.0)).fly(2.0)
    early = [answer for answer in flight.answers if answer.t_ns < BEGIN_NS + 1e9]
    assert {PHASES[answer.phase] for answer in early} == {"echo", "waiting"}
    assert not any(answer.row is not None and np.any(answer.row.dq) for answer in early)
    assert flight.phases()[-1] == "approach"
    assert not flight.controller.stops


def after_start(signal: Signal, at_s: float, for_s: float = np.inf) -> dict[str, Any]:
    return {"signals": lambda s: signal if at_s <= s < at_s + for_s else Signal.NONE}


STOPS: dict[str, dict[str, Any]] = {
    session_controller.INTERRUPTED: after_start(Signal.INTERRUPT, 2.0),
    session_controller.TERMINATED: after_start(Signal.TERMINATE, 2.0),
    session_controller.HUNG_UP: after_start(Signal.HANGUP, 2.0),
    session_controller.QUIT: after_start(Signal.QUIT, 2.0),
    session_controller.SUSPENDED: after_start(Signal.SUSPEND, 2.0),
    session_controller.OTHER_SIGNAL: after_start(Signal.OTHER, 2.0),
    session_controller.DISK_FULL: after_start(Signal.DISK, 2.0),
    session_controller.SESSION_OVER: after_start(Signal.DURATION, 2.0),
    session_controller.RECORDING_OVER: after_start(Signal.PERSON_ENDED, 2.0),
    session_controller.PERSON_DEAD: after_start(Signal.PERSON_DEAD, 2.0, 0.5),
    session_controller.PERSON_LATE: after_start(Signal.PERSON_LATE, 2.0, 0.5),
    session_controller.RECORDER_DEAD: after_start(Signal.RECORDER_DEAD, 2.0, 0.5),
    session_controller.OVERRUN: after_start(Signal.OVERRUN, 2.0, 0.004),
    session_controller.NO_FRAME: {"walk": lambda s: None if 2.0 < s < 3.0 else (3.0, 0.0)},
    session_controller.UNCERTAIN: {
        "overrides": ("live.uncertain_m=0.012", "fusion.fresh_s=9"),
        "walk": lambda s: None if 2.0 < s < 3.0 else (3.0, 0.0),
    },
    session_controller.TRACKING: {"overrides": ("live.tracking_rad=1e-4",)},
    JUMPED: {"faults": (Fault("teleport", 2.0, 0.5, angle_deg=20.0),)},
    "motors off": {"faults": (Fault("motors_off", 2.0, 0.5),)},
    "program stopped": {"faults": (Fault("program_stop", 2.0, 0.5),)},
    "EGM error": {"faults": (Fault("egm_error", 2.0),)},
}


@pytest.mark.parametrize("reason", STOPS)
def test_every_reason_of_the_watchdog_goes_on_with_the_certified_stop_and_holds(reason: str) -> None:
    flight = Flight(**STOPS[reason]).fly(5.0)
    assert [why for _, why in flight.controller.stops] == [reason]
    stopped_ns = flight.controller.stops[0][0]
    robot, dt_s = flight.robot, flight.controller.setup.plan.dt_s
    later = [answer for answer in flight.answers if answer.t_ns >= stopped_ns and answer.row is not None]
    assert any(np.any(answer.row.dq) for answer in flight.answers if answer.row is not None)  # it was moving
    speeds = np.array([answer.row.dq for answer in later if answer.row is not None])
    assert is_a_stop(speeds, robot.ddq_max, dt_s)
    assert all(answer.row.certified for answer in later if answer.row is not None)
    still = np.flatnonzero(~np.any(speeds, axis=1))
    assert still[0] * CYCLE_S <= flight.start["settings"]["prediction"]["stop_s"] + 2 * CYCLE_S
    assert not np.any(speeds[still[0] :])  # and does not move again
    assert later[-1].reason == reason
    assert PHASES[later[-1].phase] in ("holding", "stopping", "echo")
    final = reason in (*session_controller._ENDINGS, *session_controller._FINAL)
    assert ("live.resume=true" in flight.controller.outlook) is not final
    assert len(flight.said()) >= 0.99 * len(flight.answers)  # it goes on answering


@pytest.mark.parametrize(
    "reason",
    [
        session_controller.NO_FRAME,
        session_controller.OVERRUN,
        "motors off",
        "program stopped",
        JUMPED,
    ],
)
def test_it_goes_on_by_a_setting_only_and_from_where_it_stands(reason: str) -> None:
    kept = STOPS[reason]
    flight = Flight(**{**kept, "overrides": (*kept.get("overrides", ()), "live.resume=true")}).fly(9.0)
    assert [why for _, why in flight.controller.stops] == [reason]
    names = flight.phases()
    assert "approach" in names[names.index("holding") :]
    assert flight.controller.stop == ""
    steps_keep_the_limits(flight)
    assert moved(flight, after=-100)


def test_it_tells_what_holds_it_once_another_reason_has_taken_over() -> None:
    def signals(s: float) -> Signal:
        return (Signal.RECORDER_DEAD if s >= 2.5 else Signal.NONE) | (Signal.INTERRUPT if s >= 4.0 else Signal.NONE)

    flight = Flight(
        walk=lambda s: None if 2.0 < s < 3.0 else (3.0, 0.0), signals=signals, overrides=("live.resume=true",)
    ).fly(5.0)
    assert [why for _, why in flight.controller.stops] == [session_controller.NO_FRAME]
    told = {answer.t_ns: answer.reason for answer in flight.answers if answer.row is not None}
    assert [reason for t_ns, reason in told.items() if t_ns < BEGIN_NS + 2.45e9][-1] == session_controller.NO_FRAME
    assert {reason for t_ns, reason in told.items() if t_ns > BEGIN_NS + 2.7e9} == {session_controller.RECORDER_DEAD}


def test_a_silent_robot_is_started_anew_by_an_echo() -> None:
    flight = Flight(faults=(Fault("silence", 2.0, 0.5),), overrides=("live.resume=true",)).fly(6.0)
    assert [why for _, why in flight.controller.stops] == [session_controller.SILENT]
    assert flight.phases().count("echo") == 2
    replies = [answer for answer in flight.answers if answer.phase == codec.ECHO]
    assert_array_equal([answer.row.dq for answer in replies if answer.row is not None], 0.0)
    steps_keep_the_limits(flight)


def test_a_robot_waits_for_few_poses_when_it_sets_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Counted, not timed: the way's greatest TCP speed from all of its 1,773 instants once cost each start 0.15 s."""
    flight = Flight(walk=lambda _s: None, overrides=("live.approach_speed=0.1",)).fly(0.1)
    motion, setup = flight.controller._motion, flight.controller.setup
    assert motion is not None
    poses: list[int] = []
    pose = RobotModel.pose

    def counted(self: RobotModel, *state: Floats) -> RobotPose:
        poses.append(1)
        return pose(self, *state)

    monkeypatch.setattr(RobotModel, "pose", counted)
    way = start_approach(setup, motion).controller
    assert len(poses) <= 12
    monkeypatch.undo()
    assert way is not None
    path = way.reference
    fastest = max(setup.robot.pose(q, dq).tcp_speed for q, dq in zip(path.q, path.dq, strict=True))
    assert fastest <= path.tcp_speed_max[0] <= 1.5 * fastest


class Stepped(Flight):
    """The clock of the cameras' computer is set by an hour after 2 s; ours, which is monotonic, is not."""

    hours = 1

    def _skeleton(self, camera: str, place_m: tuple[float, float], t_ns: int, body: int = 1) -> bytes:
        message = Skeleton.FromString(super()._skeleton(camera, place_m, t_ns, body))
        if t_ns - BEGIN_NS > 2_000_000_000:
            message.capture_ns += self.hours * 3_600_000_000_000
        data: bytes = message.SerializeToString()
        return data


@pytest.mark.parametrize("hours", [-1, 1])
def test_a_clock_that_is_set_by_an_hour_hides_nobody_and_shows_nobody(hours: int) -> None:
    """Arrivals count from then on; who is in front of no camera is not known, whatever the clock says."""
    flight = Stepped(walk=lambda s: (3.0, 0.0) if s < 3.0 else None)
    flight.hours = hours
    flight.fly(4.0)
    age_s = {int(states.t_ns[0]) - BEGIN_NS: float(states.frame_age_s[0]) for states in flight.states}
    assert {0.0 <= age <= 0.15 for t_ns, age in age_s.items() if 0.1e9 < t_ns < 2.95e9} == {True}
    assert {age > 0.3 for t_ns, age in age_s.items() if t_ns > 3.4e9} == {True}
    assert [why for _, why in flight.controller.stops] == [session_controller.NO_FRAME]
    assert violations(flight) == []


class Suspended(Flight):
    """A control process that the machine stopped from 2 to 2.5 s: the controller gets no time-out meanwhile."""

    def _guide(self, t_ns: int, datagrams: list[bytes]) -> Iterator[bytes]:
        if not 2.0 <= (t_ns - BEGIN_NS) * 1e-9 < 2.5:
            yield from super()._guide(t_ns, datagrams)


@pytest.mark.parametrize("resume", [False, True])
def test_a_silence_that_only_the_next_packet_tells_of_stops_the_robot_too(resume: bool) -> None:
    flight = Suspended(overrides=(f"live.resume={str(resume).lower()}",)).fly(6.0)
    assert [why for _, why in flight.controller.stops] == [session_controller.SILENT]
    assert flight.phases().count("echo") == 2
    assert flight.phases().count("approach") == 1 + resume  # it goes on only where that was asked for
    steps_keep_the_limits(flight)


def test_a_person_in_the_way_stops_the_motion_but_not_the_session() -> None:
    """They walk up to the base and away again; the robot waits for them and goes on by itself."""
    flight = Flight(walk=lambda s: (max(0.3, abs(3.0 - 1.0 * max(0.0, s - 6.0)) if s < 9.0 else s - 9.0), 0.0)).fly(
        13.0
    )
    assert not flight.controller.stops
    held = [answer for answer in flight.answers if STATUSES[answer.status] != "tracking" and answer.row is not None]
    assert len(held) > 100
    assert np.nanmin([answer.row.distance_m for answer in held if answer.row is not None]) < 0.05
    tracked = [answer for answer in flight.answers[-100:] if STATUSES[answer.status] == "tracking"]
    assert len(tracked) == 100
    assert moved(flight, after=-100)


def test_a_robot_that_sends_radians_is_refused() -> None:
    flight = Flight()
    flight = Flight(twin=replace(flight.twin, radians=True)).fly(0.5)
    assert not flight.said()
    assert flight.controller.stop == "radians"


def test_the_same_events_give_the_same_bytes() -> None:
    faults = (Fault("loss", 1.0, 3.0, probability=0.2, direction="both"), Fault("garbage", 2.0, 0.5))
    walk = lambda s: (1.2 + 0.5 * np.cos(s), 0.2)  # noqa: E731
    one, two = (Flight(faults=faults, walk=walk).fly(5.0) for _ in range(2))
    assert one.messages == two.messages
    assert len(one.messages) > 4000


def test_looks_are_the_replay_tick_by_tick() -> None:
    """One fuse and one predict over all ticks give the bits that thousands of looks gave."""
    flight = Flight(walk=lambda s: (2.0 + 0.5 * np.sin(s), 0.3 * s)).fly(4.0)
    controller = build_controller(start())
    observer: Observer = controller.observer
    fusion_stage, prediction_stage = observer._fuser.stage, observer._surroundings.prediction
    ticks = np.array([int(states.t_ns[0]) for states in flight.states])
    frames = [observer._frames(t_ns, [data]) for t_ns, data in flight.frames]
    _, seen = fusion_stage.measure(CameraFrames.join([frame for frame in frames if frame is not None]), PersonMemory())
    before = fuse.start(observer._cameras)
    states = fuse.fuse(before, ticks, seen.measured, fusion_stage.filter, fusion_stage.limits)[1]
    live = HumanStates.join(flight.states)
    for name in ("p", "v", "a", "j", "p_std", "v_std", "lengths_m", "residual_m", "unseen_s", "valid"):
        assert_array_equal(getattr(live, name), getattr(states, name), err_msg=name)
    assert controller.perception is None
    last = flight.controller.perception
    assert last is not None
    volumes = prediction_stage.volumes(states, last.horizon_s)
    for limb in range(len(volumes.limbs)):
        assert_array_equal(last.volumes.vertices(0, limb), volumes.vertices(len(ticks) - 1, limb))


def test_what_the_watchdog_looks_up_of_fresh_people_is_what_it_would_compute() -> None:
    flight = Flight().fly(3.0)
    controller, rng = flight.controller, np.random.default_rng(20)
    look, setup = controller.perception, controller.setup
    assert look is not None
    told = set()
    for _ in range(2000):
        age_s = rng.choice([0.0, 0.05, setup.fresh_s, np.inf, np.nan], 2)
        away_s = rng.choice([0.0, 0.1, np.inf], 2) if rng.integers(2) else None
        states = look.states.rows(np.array([0, 0]))
        states = replace(
            states,
            frame_age_s=age_s,
            nobody_s=away_s,
            unseen_s=np.where(rng.random((2, 1)) < 0.2, np.inf, states.unseen_s),
            p_std=states.p_std * rng.choice([1.0, 50.0], (2, 1)),
            v=states.v * rng.choice([1.0, np.nan], (2, 1), p=[0.8, 0.2]),
        )
        seen = replace(look, states=states)
        fresh = session_controller._FreshPeople.of(seen, setup)
        t_ns = look.t_ns + int(rng.choice([-4, 0, 4, 40, 200])) * 1_000_000
        said = session_controller.reason_of_person(seen, t_ns, setup.fresh_s, setup.bounds)
        if fresh.is_so(t_ns, setup.fresh_s):
            assert fresh.reason == said
            told.add(said)
    assert told == {"", session_controller.UNCERTAIN, session_controller.NOT_FINITE}


@pytest.mark.parametrize(("further_rad", "share"), [(1e-4, 1.0), (0.0, 0.5)])
def test_a_reply_other_than_the_command_begins_a_new_stop(
    further_rad: float, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight = Flight().fly(3.0)
    controller, session = flight.controller, flight.controller._session
    reply = session.reply

    def limited(q: Floats, dq: Floats, t_ns: int) -> Correction:
        told = reply(q, dq, t_ns)
        return replace(told, q=told.q + further_rad, dq=share * told.dq)

    assert moved(flight, after=-5)
    monkeypatch.setattr(session, "reply", limited)
    flight.fly(2 * CYCLE_S)
    motion, told = controller._motion, flight.said()[-1]
    assert motion is not None
    assert_allclose(motion.state.q, told.q, atol=1e-12)
    assert_array_equal(motion.stop.q[0], motion.state.q)
    assert_array_equal(motion.stop.dq[0], motion.state.dq)


def test_a_bug_in_the_stages_brakes_the_robot_and_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = Flight().fly(3.0)
    assert moved(flight, after=-10)

    def broken(*_args: object) -> None:
        raise ZeroDivisionError("of the test")

    monkeypatch.setattr(QpController, "step", broken)
    before = len(flight.said())
    flight.fly(1.0)
    assert isinstance(flight.controller.fault, ZeroDivisionError)
    assert [why for _, why in flight.controller.stops] == [session_controller.FAULT]
    assert not moved(flight, after=before + 100)
    assert len(flight.said()) > before + 200


def test_scaling_drives_live_too() -> None:
    flight = Flight(overrides=("plan.method=scaling",), walk=far_away).fly(12.0)
    assert flight.phases()[-1] == "following"
    steps_keep_the_limits(flight)
    assert moved(flight, after=-200)


@pytest.mark.parametrize("method", ["scaling", "shield", "ssm"])
def test_a_robot_that_stays_on_its_path_takes_over_where_it_stands_and_never_leaps(method: str) -> None:
    flight = Flight(overrides=(f"plan.method={method}", "live.resume=true"), walk=far_away).fly(3.0)
    assert not flight.controller.stops
    steps_keep_the_limits(flight)
    assert moved(flight)
