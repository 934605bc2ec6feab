"""Points that a camera shows wrong over time lose their weight while another camera shows them, and it is told."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from hrcreplay.human.fusion.disbelief import disbelieved
from hrcreplay.human.fusion.fuse import fuse, start
from hrcreplay.human.fusion.inverse_kinematics import measure
from hrcreplay.records import BODY, LENGTHS, POINTS, Bools, CameraFrames, Floats, HumanStates, Measurements
from hrcreplay.settings.sections import Fusion
from tests.human import rising
from tests.human.filtered import WIDE, ticks, until

ONE, TWO, THREE, FOUR = (tuple("abcd"[:n]) for n in range(1, 5))
LEG, ARM = ("knee_l", "ankle_l", "foot_l"), ("elbow_r", "wrist_r")
ASIDE_M = (0.25, 0.35, 0.0)
END_S = 5.5


def standing(cameras: tuple[str, ...]) -> Measurements:
    """Somebody whom cameras see standing up, then standing still."""
    found, _ = rising.seen(1.0, "chair", 3, cameras=cameras)
    return found.rows(found.arrival_ns <= round(END_S * 1e9))


def moved(seen: Measurements, names: tuple[str, ...], by_m: tuple[float, ...], which: Bools) -> Measurements:
    """The same with some points elsewhere, in some of the frames."""
    points: Floats = seen.points_m.copy()
    points[np.flatnonzero(which)[:, None], [POINTS.index(name) for name in names]] += np.array(by_m)
    frames = CameraFrames(
        seen.capture_ns, seen.arrival_ns, seen.camera, np.zeros_like(seen.camera), points, seen.confidence, seen.cameras
    )
    return measure(frames, np.tile(np.eye(4), (len(seen.cameras), 1, 1)), Fusion())


def fused(seen: Measurements, end_s: float = END_S) -> tuple[HumanStates, Counter[str]]:
    t_ns = ticks(end_s)
    _, states, counts, _ = fuse(start(seen.cameras), t_ns, until(seen, int(t_ns[-1])), Fusion(), WIDE)
    return states, counts


def farthest_m(states: HumanStates, name: str, true: Floats, from_s: float, to_s: float) -> float:
    """Largest distance of what the volumes hold of a point from where it is, in some of the time."""
    assert states.camera_points_m is not None
    held = np.concatenate([states.points_m[:, None], states.camera_points_m], axis=1)[:, :, POINTS.index(name)]
    rows = slice(round(250 * from_s), round(250 * to_s))
    return float(np.nanmax(np.linalg.norm(held[rows] - true[rows, None, POINTS.index(name)], axis=2)))


def truth(end_s: float = END_S) -> Floats:
    return rising.body(ticks(end_s).astype(np.float64) * 1e-9, 1.0, "chair")


@pytest.mark.parametrize("names", [LEG, ARM])
def test_two_cameras_that_agree_outvote_a_third_one_after_a_while(names: tuple[str, ...]) -> None:
    seen = standing(THREE)
    wrong, counts = fused(moved(seen, names, ASIDE_M, seen.camera == 2))
    assert farthest_m(wrong, names[1], truth(), 4.0, END_S) < 0.1
    if names is LEG:  # until then nobody knows
        assert farthest_m(wrong, names[1], truth(), 0.5, 1.0) > 0.35
    told = {name for name in counts if name.startswith("disbelieved")}
    assert told == {f"disbelieved_{name}_c" for name in names}
    plain, _ = fused(seen)
    legs = BODY.index("LEGS")
    assert wrong.residual_m[-1, legs] == pytest.approx(plain.residual_m[-1, legs], abs=0.02)
    shown = int((seen.camera == 2).sum())
    assert all(0.6 * shown < counts[name] < shown for name in told)


def test_legs_that_only_a_disbelieved_camera_throws_do_not_sway() -> None:
    seen = standing(THREE)
    thrown = moved(seen, LEG, ASIDE_M, seen.camera == 2)
    thrown = moved(thrown, LEG, (0.2, 0.0, 0.0), (seen.camera == 2) & (np.arange(len(seen)) // 3 % 2 == 0))
    (states, _), (plain, _) = fused(thrown), fused(seen)
    assert states.legs_sway_m is not None
    assert plain.legs_sway_m is not None
    assert states.legs_sway_m[250] > 0.05
    assert states.legs_sway_m[-1] == pytest.approx(plain.legs_sway_m[-1], abs=0.003)


def test_the_first_camera_is_outvoted_even_though_the_filter_began_with_it() -> None:
    """Before, its arm kept the two others out for ever, and they made the arm's volume thick."""
    seen = standing(THREE)
    late = (seen.camera == 2) | (seen.capture_ns > 1_000_000_000)
    seen = moved(seen, ARM, (0.0, 0.0, 0.35), seen.camera == 2).rows(late)
    states, _ = fused(seen)
    ends = slice(round(250 * 4.5), None)
    for name in ("elbow_r", "wrist_r"):
        assert farthest_m(states, name, truth(), 4.5, END_S) < 0.15
    assert states.residual_m is not None
    assert states.residual_m[ends, 2:4].max() < 0.2


def test_a_point_below_the_floor_counts_only_while_no_other_camera_shows_it() -> None:
    seen = standing(TWO)
    foot = ("ankle_l", "foot_l")
    low = moved(seen, foot, (0.0, 0.0, -0.25), seen.camera == 1)
    gone_s = 4.0
    low = low.rows((low.camera == 1) | (low.capture_ns < gone_s * 1e9))
    states, counts = fused(low)
    assert counts["disbelieved_foot_l_b"] > 50
    assert counts["disbelieved_knee_l_b"] == counts["disbelieved_foot_r_b"] == 0
    assert farthest_m(states, "foot_l", truth(), 0.3, 1.0) > 0.2
    assert farthest_m(states, "foot_l", truth(), 3.0, gone_s) < 0.1
    assert states.points_m[-1, POINTS.index("foot_l"), 2] == pytest.approx(-0.25, abs=0.03)


def test_a_shank_of_another_length_is_disbelieved_while_another_camera_shows_the_leg() -> None:
    seen = standing(TWO)
    changed_s = 1.5
    which = (seen.camera == 1) & (seen.capture_ns > changed_s * 1e9)
    states, counts = fused(moved(seen, ("ankle_l", "foot_l"), (0.0, 0.0, 0.3), which))
    assert counts["disbelieved_ankle_l_b"] > 50
    assert farthest_m(states, "ankle_l", truth(), 2.0, 2.4) > 0.25
    assert farthest_m(states, "ankle_l", truth(), 4.0, END_S) < 0.1


def test_without_evidence_both_cameras_count() -> None:
    seen = standing(TWO)
    states, counts = fused(moved(seen, LEG, (0.0, 0.4, 0.0), seen.camera == 1))
    assert not [name for name in counts if name.startswith("disbelieved")]
    assert farthest_m(states, "ankle_l", truth(), 4.0, END_S) > 0.35


def test_where_both_cameras_are_wrong_both_count() -> None:
    seen, foot = standing(TWO), ("ankle_l", "foot_l")
    low = moved(seen, foot, (0.0, 0.0, -0.25), seen.camera >= 0)
    states, counts = fused(moved(low, foot, (0.0, 0.3, 0.0), seen.camera == 1))
    told = [count for name, count in counts.items() if name.startswith("disbelieved")]
    assert max(told, default=0) <= 2  # until there is evidence against the second one, too
    assert farthest_m(states, "foot_l", truth(), 4.0, END_S) > 0.35


def test_a_length_that_only_a_disbelieved_point_shows_is_forgotten() -> None:
    """Otherwise the forearm by which the filter began would exclude the true one for ever."""
    seen = standing(THREE)
    late = (seen.camera == 2) | (seen.capture_ns > 1_500_000_000)
    elbow, wrist = (truth()[-1, POINTS.index(name)] for name in ("elbow_r", "wrist_r"))
    fore = wrist - elbow
    aside = np.cross(fore, [0.0, 0.0, 1.0])
    by_m = 0.38 * aside / np.linalg.norm(aside)  # a forearm of 0.46 m instead of 0.26 m
    seen = moved(seen, ("wrist_r",), tuple(by_m), seen.camera == 2).rows(late)
    t_ns = ticks(END_S)
    _, states, _, _ = fuse(start(THREE), t_ns, until(seen, int(t_ns[-1])), Fusion(bone_memory_s=0.5), WIDE)
    forearm = states.lengths_m[:, LENGTHS.index("pi_forearm_r")]
    assert forearm[370] > 0.4
    assert forearm[-1] < 0.32
    assert farthest_m(states, "wrist_r", truth(), 5.0, END_S) < 0.1


def test_frames_of_cameras_that_have_stopped_are_no_evidence() -> None:
    """Somebody moves a foot while two cameras are away, and they show it there when they come back."""
    seen = standing(THREE)
    seen = moved(seen, ("ankle_l", "foot_l"), (0.0, 0.35, 0.0), seen.capture_ns > 3_200_000_000)
    away = (seen.camera < 2) & (seen.capture_ns > 3_100_000_000) & (seen.capture_ns < 5_000_000_000)
    _, counts = fused(seen.rows(~away))
    assert not [name for name in counts if name.startswith("disbelieved")]


def test_two_against_two_are_no_evidence() -> None:
    seen = standing(FOUR)
    _, counts = fused(moved(seen, LEG, ASIDE_M, seen.camera >= 2))
    assert not [name for name in counts if name.startswith("disbelieved")]


def test_a_camera_that_shows_most_of_the_body_elsewhere_may_see_somebody_else() -> None:
    seen = standing(THREE)
    most = tuple(name for name in POINTS if not name.startswith(("pelvis", "shoulder", "chest", "neck")))
    states, counts = fused(moved(seen, most, (0.0, 0.4, 0.0), seen.camera == 2))
    assert not [name for name in counts if name.startswith("disbelieved")]
    assert farthest_m(states, "ankle_l", truth(), 4.0, END_S) > 0.35


def test_a_point_is_believed_again_once_the_cameras_agree() -> None:
    seen = standing(THREE)
    until_s = 2.5
    wrong = (seen.camera == 2) & (seen.capture_ns < until_s * 1e9)
    seen = moved(seen, LEG, ASIDE_M, wrong)
    states, counts = fused(seen)
    assert 0 < counts["disbelieved_ankle_l_c"] < 0.6 * int((seen.camera == 2).sum())
    far = moved(seen, LEG, (0.0, 0.2, 0.0), (seen.camera == 2) & (seen.capture_ns > 5e9))  # within reach of any gate
    states, later = fused(far)
    assert later["disbelieved_ankle_l_c"] == counts["disbelieved_ankle_l_c"]
    assert farthest_m(states, "ankle_l", truth(), 5.2, END_S) == pytest.approx(0.2, abs=0.05)


def test_each_camera_is_told_with_its_points() -> None:
    counts = Counter({"disbelieved_knee_l_left": 1200, "disbelieved_foot_l_left": 3, "outlier_points_right": 7})
    assert disbelieved(counts) == {"left": {"knee_l": 1200, "foot_l": 3}}
    assert disbelieved(Counter({"disbelieved_knee_l_left": 0})) == {}
