"""Recorded robot joints whose messages mean something else than they seem to: order, parts, units, clocks, gaps."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hrcreplay.errors import HrcReplayError, LogError, SettingsError
from hrcreplay.logs.info import as_json, lines, summarize
from hrcreplay.logs.joints import JointTrack
from hrcreplay.logs.reader import Log, open_log
from hrcreplay.records import AxisFrame, Floats, Ints
from hrcreplay.settings.sections import Logs
from tests.facts import facts, tells
from tests.logs.bags import KINDS, bag, header, make, write_openni

BEGIN = 1_700_000_000_000_000_000
MS, SECOND = 1_000_000, 1_000_000_000
AXES = ("base_turn", "lift", "elbow")
STATE = "sensor_msgs/msg/JointState"
TOPIC = "/robot/joint_states"

#: Arrival, stamp (both after BEGIN), joints with their positions, topic.
Sent = tuple[int, int, dict[str, float], str]


def true_q(t_ns: Ints | int) -> Floats:
    """(n, 3) where the axes of these tests are [rad], each at a pace of its own."""
    t_s = np.atleast_1d(np.asarray(t_ns, dtype=np.int64) - BEGIN) * 1e-9
    return np.column_stack([np.sin(1.1 * t_s), 0.4 + 0.3 * np.cos(0.7 * t_s), -0.8 + 0.2 * t_s])


def named(t_ns: int, names: Iterable[str] = AXES) -> dict[str, float]:
    row = dict(zip(AXES, true_q(BEGIN + t_ns)[0].tolist(), strict=True))
    return {name: row[name] for name in names}


def regular(n: int = 400, *, delay_ns: int = MS, period_ns: int = 10 * MS) -> list[Sent]:
    return [(i * period_ns + delay_ns, i * period_ns, named(i * period_ns), TOPIC) for i in range(n)]


def write(path: Path, sent: Iterable[Sent], *, kind: str = "mcap", names: bool = True) -> Path:
    """A bag with a person and these joint states."""
    with bag(path, kind) as (put, store):
        write_openni(put, store, frames=20, start_ns=BEGIN)
        for arrival_ns, stamp_ns, q, topic in sent:
            state = make(
                store,
                STATE,
                header=header(store, BEGIN + stamp_ns if stamp_ns is not None else 0),
                name=list(q) if names else [],
                position=np.array(list(q.values()), dtype=float),
            )
            put(topic, STATE, BEGIN + arrival_ns, state)
    return path


def read(path: Path, axes: tuple[str, ...] = AXES, **options: Any) -> tuple[Log, JointTrack]:
    log = open_log(path, Logs(**options))
    track = log.joints(axes)
    assert track is not None
    return log, track


def refusal(path: Path, axes: tuple[str, ...] = AXES, **options: Any) -> HrcReplayError:
    with pytest.raises(HrcReplayError) as caught:
        open_log(path, Logs(**options)).joints(axes)
    return caught.value


def error_rad(track: JointTrack) -> float:
    return float(np.abs(track.q - true_q(track.t_ns)).max())


# --- names, not order ---


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("order", [(0, 2, 1), (2, 1, 0)])
def test_names_decide_and_not_the_order_of_a_message(tmp_path: Path, kind: str, order: tuple[int, ...]) -> None:
    shuffled = [(a, s, {AXES[k]: q[AXES[k]] for k in order}, topic) for a, s, q, topic in regular(100)]
    log, track = read(write(tmp_path / ("a.bag" if kind == "ros1" else "a"), shuffled, kind=kind))
    assert track.names == AXES
    np.testing.assert_array_equal(track.t_ns, BEGIN + np.arange(100) * 10 * MS)
    np.testing.assert_array_equal(track.q, true_q(track.t_ns))
    assert log.joint_notes == ()


def _renamed(new: Callable[[str], str]) -> list[Sent]:
    return [(a, s, {new(name): value for name, value in q.items()}, topic) for a, s, q, topic in regular(60)]


def test_names_may_differ_in_case_and_in_what_is_no_letter(tmp_path: Path) -> None:
    path = write(tmp_path / "a", _renamed(lambda name: name.replace("_", "-").title()))
    log, track = read(path)
    assert error_rad(track) == 0.0
    (note,) = log.joint_notes
    assert "lift = Lift" in note
    assert "base_turn = Base-Turn" in note


def test_other_names_are_refused_until_the_setting_says_which_they_are(tmp_path: Path) -> None:
    path = write(tmp_path / "a", _renamed(lambda name: {"base_turn": "b", "lift": "c", "elbow": "a"}[name]))
    error = refusal(path)
    assert isinstance(error, LogError)
    assert all(word in str(error) for word in (*AXES, "b, c, a", "--set 'logs.joint_names=["))
    _, track = read(path, joint_names=("b", "c", "a"))
    assert error_rad(track) == 0.0


def test_names_with_a_prefix_are_offered_and_not_taken(tmp_path: Path) -> None:
    path = write(tmp_path / "a", _renamed(lambda name: f"left_{name}"))
    assert 'logs.joint_names=["left_base_turn", "left_lift", "left_elbow"]' in str(refusal(path))


@pytest.mark.parametrize(
    ("given", "words"), [(("lift", "elbow"), ("2 names", "3 axes")), (("lift", "elbow", "hip"), ("'hip'", "elbow"))]
)
def test_names_that_are_set_wrongly_are_an_error_of_the_settings(
    tmp_path: Path, given: tuple[str, ...], words: tuple[str, ...]
) -> None:
    error = refusal(write(tmp_path / "a", regular(30)), joint_names=given)
    assert isinstance(error, SettingsError)
    assert all(word in str(error) for word in words)


def test_one_joint_cannot_be_two_axes() -> None:
    with pytest.raises(ValueError, match=facts("'lift'", "two")):
        Logs(joint_names=("lift", "lift", "elbow"))


@pytest.mark.parametrize("first", [0, 2])
def test_a_log_that_counts_its_joints_otherwise_is_of_another_robot(tmp_path: Path, first: int) -> None:
    """Of joint_0 to joint_3 the axes joint_1 to joint_3 are all there, and each is another one."""
    axes = ("joint_1", "joint_2", "joint_3")
    counted = [(a, s, {f"joint_{first + k}": 0.1 * k for k in range(4)}, topic) for a, s, _, topic in regular(30)]
    path = write(tmp_path / "a", counted)
    error = refusal(path, axes)
    assert isinstance(error, LogError)
    assert f"joint_{0 if first == 0 else 4}" in str(error)
    _, track = read(path, axes, joint_names=tuple(f"joint_{first + k}" for k in (2, 0, 1)))
    np.testing.assert_array_equal(track.q[0], [0.2, 0.0, 0.1])


UR = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")


@pytest.mark.parametrize(
    ("axes", "names"),
    [
        (tuple(f"panda_joint{i}" for i in range(1, 8)), tuple(f"left_fr3_joint{i}" for i in range(1, 8))),
        (tuple(f"arm_{name}" for name in UR), UR),
        (UR, tuple(f"actual_q_{i}" for i in range(6))),
        (tuple(f"joint_a{i}" for i in range(1, 7)), tuple(f"A{i}" for i in range(1, 7))),
    ],
)
def test_the_names_of_a_maker_are_understood_in_any_order(
    tmp_path: Path, axes: tuple[str, ...], names: tuple[str, ...]
) -> None:
    n = len(names)
    order = [*range(1, n, 2), *range(0, n, 2)]
    extra = {"gripper": 0.0}
    sent: list[Sent] = [
        (a, s, {names[k]: 0.1 * k + 1e-3 * i for k in order} | extra, topic)
        for i, (a, s, _, topic) in enumerate(regular(30))
    ]
    log, track = read(write(tmp_path / "a", sent), axes)
    np.testing.assert_allclose(track.q[5], 0.1 * np.arange(n) + 5e-3, atol=1e-12)
    assert any(f"{axes[1]} = {names[1]}" in note for note in log.joint_notes)


@pytest.mark.parametrize(
    ("axes", "names"),
    [
        (UR, tuple(f"{side}_{name}" for side in ("left", "right") for name in UR)),  # two arms
        (tuple(f"panda_joint{i}" for i in range(1, 8)), tuple(f"fr3_joint{i}" for i in range(1, 7))),  # one is missing
        (tuple(f"joint_{i}" for i in range(1, 7)), tuple(f"actual_q_{i}" for i in range(6))),  # not a UR
        (tuple(f"joint_a{i}" for i in range(1, 7)), tuple(f"A{i}" for i in range(1, 8))),  # one axis more
    ],
)
def test_names_of_a_maker_that_do_not_fit_the_robot_are_refused(
    tmp_path: Path, axes: tuple[str, ...], names: tuple[str, ...]
) -> None:
    sent: list[Sent] = [(a, s, dict.fromkeys(names, 0.1), topic) for a, s, _, topic in regular(30)]
    assert isinstance(refusal(write(tmp_path / "a", sent), axes), LogError)


def test_positions_without_names_are_believed_in_their_order_and_told(tmp_path: Path) -> None:
    path = write(tmp_path / "a", regular(60), names=False)
    log, track = read(path)
    assert error_rad(track) == 0.0
    assert any("has no names" in note and "base_turn, lift, elbow" in note for note in log.joint_notes)
    assert "3 positions without names" in str(refusal(path, (*AXES, "wrist")))


# --- parts, grippers ---


def test_a_gripper_that_publishes_first_and_a_track_decide_nothing(tmp_path: Path) -> None:
    finger = [(i * 50 * MS, i * 50 * MS, {"finger": 0.04}, TOPIC) for i in range(80)]
    early = [(0, 0, {"tool": 1.0}, "/a_gripper/joint_states")]
    rail = [(a, s, {"rail": 0.1 * s / SECOND, **q}, topic) for a, s, q, topic in regular()]
    log, track = read(write(tmp_path / "a", sorted(early + finger + rail, key=lambda one: one[0])))
    np.testing.assert_array_equal(track.q, true_q(track.t_ns))
    assert len(track) == 400
    (note,) = log.joint_notes
    assert all(name in note for name in ("tool", "finger", "rail (moves by 0.399)"))


def test_messages_with_a_part_of_the_joints_are_joined_each_on_its_own_clock(tmp_path: Path) -> None:
    upper = [(i * 10 * MS + MS, i * 10 * MS, named(i * 10 * MS, AXES[:2]), TOPIC) for i in range(300)]
    lower = [
        (i * 7 * MS + 104 * MS, i * 7 * MS + 103 * MS, named(i * 7 * MS + 103 * MS, AXES[2:]), "/forearm")
        for i in range(300)
    ]
    path = write(tmp_path / "a", sorted(upper + lower, key=lambda one: one[0]))
    _, track = read(path)
    assert (track.t_ns[0], track.t_ns[-1]) == (BEGIN + 103 * MS, BEGIN + 103 * MS + 299 * 7 * MS), "all are known"
    assert error_rad(track) < 5e-5, "straight lines over 10 ms"
    assert len(track) > 450
    assert "elbow" in str(refusal(path, joints_topic=TOPIC)), "the topic that is named holds two of the three"


def test_two_topics_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    wanted = [(a + MS, s, {name: value + 0.2 for name, value in q.items()}, "/wanted") for a, s, q, _ in regular()]
    path = write(tmp_path / "a", sorted(regular() + wanted, key=lambda one: one[0]))
    error = refusal(path)
    assert isinstance(error, LogError)
    assert all(word in str(error) for word in (TOPIC, "/wanted", "11.5 deg", "logs.joints_topic"))
    _, track = read(path, joints_topic=TOPIC)
    assert error_rad(track) == 0.0


def test_of_two_topics_that_agree_the_denser_is_read(tmp_path: Path) -> None:
    thin = [(a + MS, s, q, "/a_copy") for a, s, q, _ in regular()[::5]]
    log, track = read(write(tmp_path / "a", sorted(regular() + thin, key=lambda one: one[0])))
    assert len(track) == 400
    assert any("/a_copy" in note for note in log.joint_notes)


def test_messages_that_are_no_good_are_left_out_and_counted(tmp_path: Path) -> None:
    sent = regular(100)
    sent[10] = (*sent[10][:2], {**sent[10][2], "lift": float("nan")}, TOPIC)
    sent[20] = (sent[20][0], sent[19][1], named(0), TOPIC)  # the stamp of the one before
    log, track = read(write(tmp_path / "a", sent))
    assert error_rad(track) < 5e-4
    assert (log.defects["joints_not_finite"], log.defects["joints_out_of_order"]) == (1, 1)
    assert BEGIN + 200 * MS not in track.t_ns


# --- units ---


def test_degrees_are_read_where_the_setting_says_so(tmp_path: Path) -> None:
    degrees = [(a, s, {n: float(np.degrees(v)) for n, v in q.items()}, topic) for a, s, q, topic in regular()]
    log, track = read(write(tmp_path / "a", degrees), joints_unit="deg")
    assert error_rad(track) < 1e-12
    assert log.joint_notes == ()


def test_radians_that_are_taken_for_degrees_are_told(tmp_path: Path) -> None:
    log, _ = read(write(tmp_path / "a", regular()), joints_unit="deg")
    (note,) = log.joint_notes
    assert "1.00 deg" in note


# --- clocks ---


@pytest.mark.parametrize("ahead_ns", [2 * SECOND, -3 * SECOND, -1_600_000_000 * SECOND])
def test_stamps_of_another_clock_are_shifted_by_the_least_delay(tmp_path: Path, ahead_ns: int) -> None:
    """Delays of 1 to 31 ms, anew for each message, beside an offset; arrivals would be wrong by up to 31 ms."""
    delays = np.random.default_rng(5).integers(MS, 31 * MS, 400).tolist()
    sent = [(s + delay, s + ahead_ns, q, topic) for (_, s, q, topic), delay in zip(regular(), delays, strict=True)]
    log, track = read(write(tmp_path / "a", sorted(sent, key=lambda one: one[0])))
    shift_s = summarize(log, axes=AXES).joints[0].clock.shift_s
    assert shift_s == pytest.approx(-ahead_ns / 1e9, abs=0.004)
    assert error_rad(track) < 1.1 * 0.004, "at most 1.1 rad/s"
    assert any("logs.joints_offset_s" in note for note in log.joint_notes)


def test_stamps_a_little_ahead_of_their_arrival_are_shifted_too(tmp_path: Path) -> None:
    log, track = read(write(tmp_path / "a", [(a, s + 40 * MS, q, topic) for a, s, q, topic in regular()]))
    assert error_rad(track) == pytest.approx(1.1e-3, rel=0.01), "1 ms at 1.1 rad/s"
    assert any("0.039 s ahead" in note for note in log.joint_notes)


def test_an_offset_that_is_set_is_taken_off_the_stamps(tmp_path: Path) -> None:
    late = [(a, s + 2 * SECOND, q, topic) for a, s, q, topic in regular(delay_ns=80 * MS)]
    log, track = read(write(tmp_path / "a", late), joints_offset_s=2.0)
    np.testing.assert_array_equal(track.q, true_q(track.t_ns))
    assert not any("clock" in note for note in log.joint_notes)
    log, track = read(tmp_path / "a", joints_offset_s=-1.0)
    assert any("joints_offset_s = -1" in note for note in log.joint_notes)
    assert track.t_ns[0] == BEGIN + 3 * SECOND


def test_a_simulation_at_another_pace_has_the_arrival_times(tmp_path: Path) -> None:
    slow = [(a, 5 * SECOND - BEGIN + s // 2, q, topic) for a, s, q, topic in regular()]
    log, track = read(write(tmp_path / "a", slow))
    np.testing.assert_array_equal(track.t_ns, BEGIN + np.arange(400) * 10 * MS + MS)
    assert any("pace" in note and "arrival" in note for note in log.joint_notes)


@pytest.mark.parametrize("by_ns", [-3 * SECOND, 3 * SECOND])
def test_a_clock_that_is_set_while_the_log_is_written_has_the_arrival_times(tmp_path: Path, by_ns: int) -> None:
    sent = [(a, s + (by_ns if i >= 250 else 0), q, topic) for i, (a, s, q, topic) in enumerate(regular())]
    log, track = read(write(tmp_path / "a", sent))
    assert len(track) == 400
    assert error_rad(track) < 1.2e-3
    assert any(f"jump by {by_ns / 1e9:.3f} s at 2.50 s" in note for note in log.joint_notes)


def test_a_stamp_alone_is_set_right_and_a_message_that_comes_late_keeps_its_own(tmp_path: Path) -> None:
    sent = regular()
    sent[300] = (sent[300][0], sent[300][1] + 9 * SECOND, *sent[300][2:])  # every later stamp would be 'out of order'
    sent[200] = (sent[200][0], -BEGIN, *sent[200][2:])  # zero
    sent[0] = (sent[0][0], SECOND - BEGIN, *sent[0][2:])  # of 1970: the track would last for 53 years
    sent = [
        (a + (390 * MS - s % (400 * MS) if 800 * MS <= s < 1200 * MS else 0), s, q, topic) for a, s, q, topic in sent
    ]
    log, track = read(write(tmp_path / "a", sent))
    np.testing.assert_array_equal(track.t_ns, BEGIN + np.arange(400) * 10 * MS)
    np.testing.assert_array_equal(track.q, true_q(track.t_ns))
    assert log.defects["joints_stamp_wrong"] == 3


def test_stamps_that_are_all_zero_have_the_arrival_times(tmp_path: Path) -> None:
    log, track = read(write(tmp_path / "a", [(a, -BEGIN, q, topic) for a, _, q, topic in regular()]))
    assert error_rad(track) < 1.2e-3
    assert any("zero" in note for note in log.joint_notes)


# --- gaps ---


def test_gaps_and_ends_are_told_with_where_and_how_long(tmp_path: Path) -> None:
    sent = [one for one in regular() if not 1000 * MS <= one[1] < 2500 * MS and one[1] < 3200 * MS]
    last = [(6 * SECOND, 6 * SECOND, {"finger": 0.0}, "/gripper")]
    log, track = read(write(tmp_path / "a", sent + last))
    gap, ends = (next(note for note in log.joint_notes if word in note) for word in ("gaps", "stands still"))
    assert "1, 1.51 s in all" in gap
    assert log.joint_defects["joint_gaps_ms"] == 1510
    assert "from 0.99 s" in gap
    assert "to 3.19 s" in ends
    assert len(track) == 100 + 70


# --- info ---


def test_info_says_which_joint_is_which_axis_and_how_the_clock_stands(tmp_path: Path) -> None:
    ahead = [(a, s + 2 * SECOND, {"finger": 0.0, **q}, topic) for a, s, q, topic in regular(delay_ns=5 * MS)]
    path = write(tmp_path / "a", ahead)
    summary = summarize(open_log(path), axes=AXES)
    (topic,) = summary.joints
    assert topic.axes == {"base_turn": 1, "lift": 2, "elbow": 3}
    assert topic.rate_hz == pytest.approx(100.0)
    assert topic.longest_gap_s == pytest.approx(0.01)
    assert topic.clock.delay_s[0] == pytest.approx(-1.995)
    text = "\n".join(lines(summary))
    assert "finger, base_turn = axis 1, lift = axis 2, elbow = axis 3" in text
    assert "-1995.0 ms" in text
    other = summarize(open_log(path), axes=("a", "b", "c"))
    assert other.joints[0].axes == {}
    assert any("logs.joint_names" in note for note in other.notes), "told, and the rest is described"


# --- links instead of joints ---

TF = "tf2_msgs/msg/TFMessage"
FRAMES = tuple(
    AxisFrame(
        ("base", "link_1", "link_2")[k],
        ("link_1", "link_2", "link_3")[k],
        Rotation.from_euler("xyz", [0.3 * k, -0.7 * k, 1.1]).as_matrix(),
        np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [0.6, 0.0, 0.8]][k]),
    )
    for k in range(3)
)


def write_links(path: Path, q_of: Callable[[int], Floats], *, links: int = 3, turned: bool = False) -> Path:
    """A bag with a person and the poses of a robot's links, each in the link before it, 50 a second."""
    with bag(path, "mcap") as (put, store):
        write_openni(put, store, frames=20, start_ns=BEGIN)
        for i in range(100):
            t_ns, q = BEGIN + 20 * MS * i, q_of(i)
            transforms = []
            for k, frame in enumerate(FRAMES[:links]):
                axis = np.roll(frame.axis, 1) if turned and k == 1 else frame.axis
                turn = Rotation.from_matrix(frame.R_parent_joint) * Rotation.from_rotvec(q[k] * axis)
                x, y, z, w = turn.as_quat().tolist()
                transform = make(
                    store,
                    "geometry_msgs/msg/Transform",
                    translation=make(store, "geometry_msgs/msg/Vector3", x=0.1, y=0.0, z=0.3),
                    rotation=make(store, "geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
                )
                names = {"header": header(store, t_ns, frame.parent), "child_frame_id": frame.child}
                transforms.append(make(store, "geometry_msgs/msg/TransformStamped", **names, transform=transform))
            put("/tf", TF, t_ns + MS, make(store, TF, transforms=transforms))
    return path


def test_the_poses_of_the_links_are_the_joints_where_a_log_has_no_joint_states(tmp_path: Path) -> None:
    def q_of(i: int) -> Floats:
        return np.array([0.05 * i, 0.4 * np.sin(0.1 * i), -1.0 + 0.01 * i])  # the first goes beyond half a turn

    log = open_log(write_links(tmp_path / "a", q_of))
    track = log.joints(AXES, FRAMES)
    assert track is not None
    np.testing.assert_array_equal(track.t_ns, BEGIN + 20 * MS * np.arange(100))
    np.testing.assert_allclose(track.q, [q_of(i) for i in range(100)], atol=1e-9)
    assert "from the poses of its links on /tf" in log.joint_notes[0]
    assert log.joints(AXES) is None


def test_info_tells_of_a_robot_that_only_the_poses_of_its_links_show(tmp_path: Path) -> None:
    path = write_links(tmp_path / "a", lambda i: np.array([0.01 * i, 0.2, -0.3]))
    found = summarize(open_log(path), axes=AXES, frames=FRAMES)
    (topic,) = found.joints
    assert (topic.topic, topic.names) == ("/tf", tuple(AXES))
    assert topic.axes == {axis: i for i, axis in enumerate(AXES, start=1)}
    assert topic.rate_hz == pytest.approx(50.0)
    assert found.recorded.startswith("by 3 joints: ")
    assert any("from the poses of its links on /tf" in note for note in found.notes)
    assert not any("task" in line for line in found.missing)  # its motion is the programme
    assert json.loads(as_json(found))["joints"][0]["axes"] == topic.axes
    without = summarize(open_log(path), axes=AXES)
    assert (without.joints, without.recorded) == ((), "")
    part = write_links(tmp_path / "b", lambda _: np.full(3, 0.3), links=2)
    assert summarize(open_log(part), axes=AXES, frames=FRAMES).joints == ()
    other = write_links(tmp_path / "c", lambda _: np.full(3, 0.3), turned=True)
    refused = summarize(open_log(other), axes=AXES, frames=FRAMES)
    assert refused.joints == ()
    assert tells(refused.notes, "link_2", "robot.urdf")


def test_links_that_are_not_all_there_are_no_robot_and_those_of_another_are_refused(tmp_path: Path) -> None:
    assert open_log(write_links(tmp_path / "a", lambda _: np.full(3, 0.3), links=2)).joints(AXES, FRAMES) is None
    other = write_links(tmp_path / "b", lambda _: np.full(3, 0.3), turned=True)
    with pytest.raises(LogError, match=facts("link_2", "lift", "robot.urdf")):
        open_log(other).joints(AXES, FRAMES)
