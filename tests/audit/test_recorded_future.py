"""The recorded future of a tick, and the comparison of volumes with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hrcreplay.audit.log_audit import joint_travel, joints_inside
from hrcreplay.evaluation import recorded_person, recording
from hrcreplay.evaluation.containment import RecordedFuture, check_containment, recorded_future
from hrcreplay.evaluation.recorded_person import SmoothedPeople
from hrcreplay.evaluation.recording import Recording
from hrcreplay.human.prediction import swept_volumes
from hrcreplay.records import BODY, DOF, JOINTS, LIMBS, POINTS, Floats, HumanStates, Measurements, SweptVolumes
from tests.human.people import states


def _recording(points: Floats, joints: Floats, people: HumanStates) -> Recording:
    t_ns = people.t_ns[0] + np.arange(len(points)) * 100_000_000
    return Recording(people, t_ns, points, t_ns, joints, recorded_person.TRUTH, {})


def _future(points: Floats, people: HumanStates) -> RecordedFuture:
    """Of the first tick, 0.4 s."""
    recorded = _recording(points, np.zeros((10, DOF)), people)
    return recorded_future(recorded.t_ns, recorded.points_m, people.rows(np.array([0])), 0.4)


def _balls(people: HumanStates, radius_m: float, limbs: tuple[str, ...] = LIMBS) -> SweptVolumes:
    """A ball at the world's origin for every limb."""
    n = len(people) * len(limbs)
    radius = np.full((len(people), len(limbs)), radius_m)
    return SweptVolumes(people.t_ns, np.arange(n + 1), np.zeros((n, 3)), radius, limbs, "balls")


def test_the_future_is_after_the_tick_and_within_the_horizon() -> None:
    """A point that moves 1 m a sample along x, sampled every 0.1 s."""
    people = states(np.zeros((1, DOF)), np.zeros((1, DOF)))
    points = np.zeros((10, len(POINTS), 3))
    points[:, :, 0] = np.arange(10)[:, None]
    future = _future(points, people)
    flesh = dict.fromkeys(BODY, 0.07)
    outcome = check_containment(_balls(people, 1.5), future, flesh, np.array([True]))
    np.testing.assert_allclose(outcome.beyond_m, 4.0)  # the sample at the horizon counts, the next does not
    np.testing.assert_allclose(outcome.escape_m(points_alone=True), 2.5)
    np.testing.assert_allclose(outcome.escape_m()[0], [2.5 + flesh[limb] for limb in LIMBS])
    assert outcome.union_m3[0] == pytest.approx(4.0 / 3.0 * np.pi * 1.5**3, rel=0.05)
    points[4, POINTS.index("wrist_l")] = np.nan  # not seen near the end: the lower arm cannot be audited
    future = _future(points, people)
    outcome = check_containment(_balls(people, 1.5), future, dict.fromkeys(BODY, 0.0), np.array([False]))
    assert np.isnan(outcome.beyond_m[0]).tolist() == [limb == "LLA" for limb in LIMBS]
    assert outcome.worst_m()[0] == pytest.approx(2.5)
    assert not future.checked("LLA")[0]
    assert future.points()["LLA"] == {"hand_l": 0}  # seen, but its limb is not checked
    assert future.points()["LRA"] == {"hand_r": 1}
    points[4, POINTS.index("hand_r")] = np.nan
    assert _future(points, people).points()["LRA"] == {"hand_r": 0}
    assert np.isnan(outcome.union_m3[0])


def test_a_joint_stays_inside_whatever_its_name_and_turn() -> None:
    people = states(np.zeros((2, DOF)), np.zeros((2, DOF)))
    people = replace(people, t_ns=np.array([0, 300_000_000]))
    joints = np.zeros((8, DOF))
    joints[:, 2] = 2.0 * np.pi + 0.01 * np.arange(8)  # heading, a turn later
    joints[:, 4] = 0.02 * np.arange(8)
    joints[6:, 5] = np.nan
    low, high = np.full((2, DOF), -0.05), np.full((2, DOF), 0.05)
    recording = _recording(np.zeros((8, len(POINTS), 3)), joints, people)
    inside = joints_inside(recording, people, swept_volumes.Reach(people.t_ns, low, high), 0.2)
    assert inside[0, JOINTS.index("theta")] == 1.0  # 0.01, 0.02
    assert inside[1, JOINTS.index("theta")] == 1.0  # 0.04, 0.05
    assert inside[0, 4] == 1.0  # 0.02, 0.04
    assert inside[1, 4] == 0.0  # 0.08, 0.10
    late = joints_inside(
        recording, replace(people, t_ns=people.t_ns + 600_000_000), swept_volumes.Reach(people.t_ns, low, high), 0.2
    )
    assert late[0, 4] == 0.0
    assert np.isnan(late[1]).all()  # the recording is over
    assert joint_travel(joints[:6])[4] == pytest.approx(0.09)


def test_every_camera_and_the_limbs_flesh_decide_whether_a_volume_held() -> None:
    """Two cameras show a wrist 0.1 m apart: what holds it for one of them, or without its flesh, does not hold it."""
    n = 8
    both = np.zeros((2 * n, len(POINTS), 3))
    both[1::2, POINTS.index("wrist_l"), 0] = 0.1
    t_ns = 50_000_000 * np.arange(2 * n)
    seen = Measurements(
        capture_ns=t_ns,
        arrival_ns=t_ns,
        camera=np.arange(2 * n) % 2,
        z=np.zeros((2 * n, 20)),
        z_std=np.zeros((2 * n, 20)),
        points_m=both,
        confidence=np.ones((2 * n, len(POINTS))),
        cameras=("one", "other"),
    )
    people = states(np.zeros((1, DOF)), np.zeros((1, DOF)))
    people = replace(people, t_ns=np.zeros(1, np.int64))
    arm = LIMBS.index("LLA")
    for cameras, farthest_m in (([0], 0.0), ([1], 0.1), ([0, 1], 0.1)):
        mine = np.isin(seen.camera, cameras)
        source, at_ns, points_m = recording._recorded_points(seen.rows(mine), both[mine], SmoothedPeople.of(people))
        assert source == recorded_person.CAMERAS
        future = recorded_future(at_ns, points_m, people, 0.4)
        outcome = check_containment(_balls(people, 0.12), future, dict.fromkeys(BODY, 0.05), np.array([False]))
        assert outcome.beyond_m[0, arm] == pytest.approx(farthest_m)
        assert outcome.escape_m()[0, arm] == pytest.approx(max(0.0, farthest_m + 0.05 - 0.12))


@pytest.mark.parametrize(
    ("point", "limbs"),
    [
        ("head", {"HD"}),
        ("pelvis", {"THX"}),
        *((f"shoulder_{side}", {"HD", "THX", upper}) for side, upper in (("r", "URA"), ("l", "ULA"))),
        *((f"elbow_{side}", {f"U{side.upper()}A", f"L{side.upper()}A"}) for side in "rl"),
        *((f"{end}_{side}", {f"L{side.upper()}A"}) for end in ("wrist", "hand") for side in "rl"),
        *((f"{part}_{side}", {"LEGS"}) for part in ("hip", "knee", "ankle", "foot") for side in "rl"),
    ],
)
def test_every_point_of_a_body_decides_whether_its_limbs_are_held(point: str, limbs: set[str]) -> None:
    """One point that is 1 m away once, and volumes of all limbs that hold the others; the neck is between shoulders."""
    people = states(np.zeros((1, DOF)), np.zeros((1, DOF)))
    points = np.zeros((10, len(POINTS), 3))
    points[3, POINTS.index(point)] = [0.0, 0.0, 1.0]
    volumes = _balls(people, 0.3, BODY)
    outcome = check_containment(volumes, _future(points, people), dict.fromkeys(BODY, 0.0), np.array([False]))
    assert {limb for limb, out_m in zip(BODY, outcome.escape_m()[0], strict=True) if out_m > 0.0} == limbs
    assert np.isfinite(outcome.escape_m()).all()


def test_an_upper_bound_is_enough_for_the_limbs_that_stay_inside() -> None:
    """Random hulls, some of which the recorded limbs leave: the same escapes, and bounds of the rest."""
    rng, flesh = np.random.default_rng(4), dict.fromkeys(BODY, 0.05)
    people, outside = states(np.zeros((1, DOF)), np.zeros((1, DOF))), 0
    for _ in range(40):
        future = _future(rng.normal(0.0, 0.3, (10, len(POINTS), 3)), people)
        vertices = rng.normal(0.0, 0.3, (6 * len(BODY), 3))
        offsets, radius_m = 6 * np.arange(len(BODY) + 1), rng.uniform(0.1, 1.2, (1, len(BODY)))
        volumes = SweptVolumes(people.t_ns, offsets, vertices, radius_m, BODY, "hulls")
        exact, enough = (
            check_containment(volumes, future, flesh, np.array([False]), sizes=False, exact=exact)
            for exact in (True, False)
        )
        np.testing.assert_array_equal(enough.escape_m(), exact.escape_m())
        left = exact.escape_m() > 0.0
        np.testing.assert_array_equal(enough.beyond_m[left], exact.beyond_m[left])
        assert (enough.beyond_m >= exact.beyond_m - 1e-9).all()
        assert (enough.beyond_m <= np.where(left, np.inf, radius_m - 0.05 + 1e-9)).all()
        outside += int(left.sum())
    assert 50 < outside < 40 * len(BODY) - 50
