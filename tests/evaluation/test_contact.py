"""Robot against recorded person: constructed contacts at known ticks, and runs with and without ground truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from hrcreplay.commands import replay, report
from hrcreplay.evaluation import contact
from hrcreplay.evaluation.contact import VOLUME_OF, Volumes
from hrcreplay.evaluation.containment import Coverage
from hrcreplay.evaluation.judging import body_table
from hrcreplay.evaluation.recorded_person import BodyTrack, RecordedPeople, RecordedPerson, SmoothedPeople, from_states
from hrcreplay.human.model import PARTS, skeleton
from hrcreplay.logs import reader
from hrcreplay.logs.log_files import Truth
from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.run_config import read_run_config
from hrcreplay.records import LIMBS, POINTS, Floats, HumanStates, SweptVolume
from hrcreplay.reporting import verdict
from hrcreplay.robot.model import RobotModel, from_urdf
from hrcreplay.store import run_folder
from hrcreplay.store.columns import read_states
from tests.robot.test_model import ONE_AXIS
from tests.undrawn import undrawn

RADII_M = np.full(len(PARTS), 0.05)
LRA = PARTS.index("LRA")
ELBOW, WRIST = POINTS.index("elbow_r"), POINTS.index("wrist_r")
DT_NS = 4_000_000


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    """One axis along y, which turns a bar of 0.4 m about its middle at (0, 0, 0.5)."""
    return from_urdf(ONE_AXIS, np.eye(4), stop_s=0.4)


def turning(robot: RobotModel, q: Floats, dq: Floats) -> pd.DataFrame:
    """A motion table with what contact reads of it."""
    n = len(q)
    table = {"t_ns": np.arange(n) * DT_NS, "q1": q, "dq1": dq, "tcp_speed": np.abs(dq), "horizon_s": np.full(n, 0.04)}
    return pd.DataFrame(table | {"status": ["tracking"] * n})


def standing_beside(point_m: Floats, ticks: int, source: str = "ground truth") -> BodyTrack:
    """A body of which only the right elbow and wrist are known, along y, at every tick."""
    points = np.full((ticks, len(POINTS), 3), np.nan)
    points[:, [ELBOW, WRIST]] = point_m + np.array([[0.0, -0.2, 0.0], [0.0, 0.2, 0.0]])
    return BodyTrack(source, np.arange(ticks) * DT_NS, points)


def surface_distance(robot: RobotModel, q: float, points_m: Floats) -> float:
    """Between robot and forearm by points sampled on both axes."""
    shares = np.linspace(0.0, 1.0, 400)[:, None]
    least = np.inf
    for segment, ends in zip(robot.segments, robot.ends_m(np.array([q])), strict=True):
        a = ends[0] + shares * (ends[1] - ends[0])
        b = points_m[ELBOW] + shares * (points_m[WRIST] - points_m[ELBOW])
        gap = np.linalg.norm(a[:, None] - b[None], axis=2).min() - segment.radius_m - RADII_M[LRA]
        least = np.fmin(least, gap)
    return float(least)


def near(robot: RobotModel, motion: pd.DataFrame, *tracks: BodyTrack) -> contact.Nearest:
    """The nearest of some bodies, without a hand."""
    return contact.nearest(robot, motion, (tracks,), RADII_M, 0.0)[0]


def around(q: float, away_m: float = 0.33) -> Floats:
    """A point so far from the axis, where the bar points at ``q``."""
    return np.array([away_m * np.sin(q), 0.0, 0.5 + away_m * np.cos(q)])


def test_a_bar_that_swings_past_a_forearm_touches_at_the_ticks_worked_out(robot: RobotModel) -> None:
    q = np.linspace(-0.8, 0.8, 81)
    dq = np.full(81, 5.0)
    dq[60:] = 0.0
    body = standing_beside(around(0.0), 81)
    body = dataclasses.replace(body, points_m=np.where(np.arange(81)[:, None, None] == 45, np.nan, body.points_m[:]))
    found = near(robot, turning(robot, q, dq), body)
    expected = [surface_distance(robot, q[i], body.points_m[:][i]) if i != 45 else np.nan for i in range(81)]
    np.testing.assert_allclose(found.distance_m, expected, atol=2e-3)
    touching = np.flatnonzero(np.array(expected) <= 0.0)
    assert len(touching) > 5
    np.testing.assert_array_equal(np.flatnonzero(found.distance_m <= 0.0), touching)
    assert set(found.part[np.isfinite(found.distance_m)]) == {LRA}
    assert found.part[45] == found.link[45] == found.track[45] == -1


def test_the_speed_is_that_of_the_surface_that_touches(robot: RobotModel) -> None:
    q, dq = np.linspace(-0.5, 0.5, 21), np.full(21, 2.0)
    body = standing_beside(around(0.3, 0.5), 21)
    found = near(robot, turning(robot, q, dq), body)
    for i in range(21):
        ends = robot.ends_m(q[i : i + 1])[found.link[i]]
        radius_m = robot.segments[found.link[i]].radius_m
        shares = np.linspace(0.0, 1.0, 2001)[:, None]
        a, b = (e[0] + shares * (e[1] - e[0]) for e in (ends, body.points_m[:][i, [ELBOW, WRIST]]))
        gaps = np.linalg.norm(a[:, None] - b[None, ::100], axis=2)
        row, column = np.unravel_index(np.argmin(gaps), gaps.shape)
        towards = b[100 * column] - a[row]
        at = a[row] + radius_m * towards / np.linalg.norm(towards) - (0.0, 0.0, 0.5)
        assert found.speed[i] == pytest.approx(2.0 * float(np.hypot(at[0], at[2])), rel=5e-3)


def test_of_several_sources_the_nearest_counts(robot: RobotModel) -> None:
    """One camera shows the forearm where the bar goes, the other and the mean of both do not."""
    q, dq = np.linspace(-0.8, 0.8, 81), np.full(81, 5.0)
    tracks = [standing_beside(around(0.0, away), 81, name) for away, name in ((0.9, "mean"), (0.33, "a"), (1.4, "b"))]
    motion = turning(robot, q, dq)
    found = near(robot, motion, *tracks)
    alone = near(robot, motion, tracks[1])
    assert (alone.distance_m <= 0.0).sum() > 5
    assert (near(robot, motion, tracks[0], tracks[2]).distance_m > 0.0).all()
    np.testing.assert_array_equal(found.distance_m, alone.distance_m)
    assert set(found.track) == {1}


@pytest.mark.parametrize("part", PARTS)
def test_every_part_of_a_body_counts(robot: RobotModel, part: str) -> None:
    """The two points of one part alone, on the bar's way."""
    n = 5
    points = np.full((n, len(POINTS), 3), np.nan)
    ends = {
        "HD": ("neck", "head"),
        "THX": ("pelvis", "neck"),
        "URA": ("shoulder_r", "elbow_r"),
        "LRA": ("elbow_r", "wrist_r"),
        "ULA": ("shoulder_l", "elbow_l"),
        "LLA": ("elbow_l", "wrist_l"),
        "THIGH_R": ("hip_r", "knee_r"),
        "SHANK_R": ("knee_r", "ankle_r"),
        "THIGH_L": ("hip_l", "knee_l"),
        "SHANK_L": ("knee_l", "ankle_l"),
        "HAND_R": ("wrist_r", "hand_r"),
        "HAND_L": ("wrist_l", "hand_l"),
        "FOOT_R": ("ankle_r", "foot_r"),
        "FOOT_L": ("ankle_l", "foot_l"),
    }[part]
    away_m = around(0.0)
    half_m = np.array([0.0, 0.2, 0.0])
    points[:, POINTS.index(ends[0])] = away_m - half_m
    points[:, POINTS.index(ends[1])] = away_m + half_m
    motion = turning(robot, np.zeros(n), np.ones(n))
    found = near(robot, motion, BodyTrack("cam", np.arange(n) * DT_NS, points))
    assert (found.distance_m < 0.0).all()
    points[:, POINTS.index(ends[1])] = np.nan
    points[:, POINTS.index(ends[0])] = away_m  # one end of it is all that is seen
    found = near(robot, motion, BodyTrack("cam", np.arange(n) * DT_NS, points))
    assert (found.distance_m < 0.0).all()


class Known:
    """Volumes of any tick: a ball around one point."""

    def __init__(self, centre_m: Floats, radius_m: float) -> None:
        self.solid = {"LRA": SweptVolume(centre_m + 1e-3 * np.vstack([np.zeros(3), np.eye(3)]), radius_m)}
        self.asked: list[tuple[int, float]] = []

    def volumes(self, asked: Sequence[tuple[int, float, int]]) -> list[Volumes]:
        assert {person for _, _, person in asked} == {1}
        self.asked += [(t_ns, horizon_s) for t_ns, horizon_s, _ in asked]
        return [self.solid] * len(asked)


def test_a_contact_is_laid_at_the_door_of_robot_or_prediction(robot: RobotModel) -> None:
    q, dq = np.linspace(-0.8, 0.8, 81), np.full(81, 5.0)
    at = around(0.0)
    body = standing_beside(at, 81)
    motion = turning(robot, q, dq)
    found = near(robot, motion, body)
    touching = np.flatnonzero(found.distance_m <= 0.0)
    motion.loc[touching[2] - 3 : touching[-1], "status"] = "braking"  # what was decided before goes on
    alone = RecordedPeople((RecordedPerson(1, body.source, body.t_ns, body.points_m[:], (body,)),), ())
    for ball_m, sign in ((0.5, -1.0), (0.1, 1.0)):
        known = Known(at, ball_m)
        outside = contact.by_volume(motion, contact.Decisions.of(motion), found, alone, RADII_M, 0.0, known)  # type: ignore[arg-type]
        np.testing.assert_array_equal(np.flatnonzero(np.isfinite(outside)), touching)
        np.testing.assert_allclose(outside[touching], 0.2 + 0.05 - ball_m, atol=3e-3)
        assert (np.sign(outside[touching]) == sign).all()
        decided, known_before = touching[2] - 4, len(known.asked)
        assert known.asked[-1] == (decided * DT_NS, 0.04)
        decisions, parts = contact.Decisions.of(motion), []
        for rows in (
            slice(0, int(touching[1])),
            slice(int(touching[1]), int(touching[4])),
            slice(int(touching[4]), 81),
        ):
            some = contact.Nearest(*(getattr(found, name)[rows] for name in found.__dataclass_fields__))
            given: Any = motion.iloc[rows], decisions.by_rows(rows), some, alone, RADII_M, 0.0, known
            parts.append(contact.by_volume(*given))
        np.testing.assert_array_equal(np.concatenate(parts), outside)  # what was decided in an earlier stretch goes on
        assert set(known.asked[known_before:]) == set(known.asked[:known_before])
    no_legs = Known(at, 0.5)
    no_legs.solid = {"LEGS": no_legs.solid["LRA"]}
    assert np.isnan(contact.by_volume(motion, contact.Decisions.of(motion), found, alone, RADII_M, 0.0, no_legs)).all()  # type: ignore[arg-type]


def test_parts_are_held_against_the_volume_of_their_limb() -> None:
    assert {part for part in PARTS if VOLUME_OF[part] == "LEGS"} == {
        f"{part}_{side}" for part in ("THIGH", "SHANK", "FOOT") for side in "RL"
    }
    assert (VOLUME_OF["HAND_R"], VOLUME_OF["HAND_L"]) == ("LRA", "LLA")
    assert all(VOLUME_OF[name] == name for name in LIMBS)
    assert set(VOLUME_OF) == set(PARTS)


def test_nothing_is_known_in_a_gap_of_the_truth() -> None:
    t_ns = np.array([0, 10, 20, 320, 330], dtype=np.int64) * 10**6
    person = BodyTrack("ground truth", t_ns, np.zeros((5, len(POINTS), 3)) + np.arange(20.0)[:, None])
    at_ns = np.arange(0, 340, 4, dtype=np.int64) * 10**6
    known = np.isfinite(person.axes_m(at_ns, 0.19)).all(axis=(1, 2, 3))
    np.testing.assert_array_equal(known, (at_ns <= 20 * 10**6) | ((at_ns >= 320 * 10**6) & (at_ns <= 330 * 10**6)))


@pytest.fixture(scope="module")
def with_truth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("truth") / "run"
    with undrawn():
        return replay.run("report", replay.demo_log(), out=out, start_s=8.0, end_s=9.0)


def test_a_report_compares_every_method_with_the_truth(with_truth: Path) -> None:
    run = run_folder.read(with_truth)
    assert run.contact is not None
    assert run.motion is not None
    assert set(run.contact["person"]) == set(run.contact["source"]) == {"ground truth"}
    assert set(run.contact["method"]) == {"qp", *run.baselines}
    assert len(run.contact) == len(run.motion) * (1 + len(run.baselines))
    assert run.contact["distance_m"].notna().all()
    assert "contact.parquet" in run.meta["outputs"]
    assert not (with_truth / "smooth.parquet").exists()
    own = run.contact[run.contact["method"] == "qp"]
    assert own["left_full_m"].notna().sum() == pytest.approx(25 * (1.0 - 0.377), abs=1.5)
    page = (with_truth / "report.html").read_text()
    found = verdict.verdict(run, report.compute(run, near_m=0.5, stationary_m_per_s=0.001))
    assert found is not None
    assert page.index(found.sentences[0]) < page.index(found.table.title)


def test_coverage_does_not_depend_on_the_parts_in_which_the_ticks_come(with_truth: Path) -> None:
    run_config = read_run_config(with_truth)
    stage, fusion = assembly.prediction_stage(run_config), run_config.settings.fusion
    truth = Truth.join(list(reader.open_log(run_config.log, run_config.settings.logs).truth()))
    (states,) = read_states(with_truth / "state.parquet", 10_000)
    person = RecordedPerson(1, "ground truth", truth.t_ns, truth.points_m, ())
    horizon_s = np.random.default_rng(7).uniform(0.05, 0.4, len(states))
    horizon_s[100:110] = np.nan
    outcomes = []
    for size in (len(states), 37, 5):
        check = Coverage(stage, person, fusion, int(states.t_ns[-1]))
        for first in range(0, len(states), size):
            rows = slice(first, first + size)
            check.add(states.rows(rows), horizon_s[rows])
        outcomes.append(check.outcome())
    whole, *others = outcomes
    assert whole is not None
    assert len(whole) > 10
    for other in others:
        assert other is not None
        for name in ("t_ns", "beyond_m", "radius_m"):
            np.testing.assert_array_equal(getattr(other, name), getattr(whole, name), name)


def test_both_coverages_of_a_report_are_those_of_their_horizons(tmp_path: Path) -> None:
    """While the robot is fast: a stop shorter than the time between two samples of the truth is not checked."""
    with undrawn():
        folder = replay.run("report", replay.demo_log(), out=tmp_path / "run", start_s=0.5, end_s=4.5)
    run, run_config = run_folder.read(folder), read_run_config(folder)
    assert run.contact is not None
    assert run.motion is not None
    stage, fusion = assembly.prediction_stage(run_config), run_config.settings.fusion
    truth = Truth.join(list(reader.open_log(run_config.log, run_config.settings.logs).truth()))
    (states,) = read_states(folder / "state.parquet", 10_000)
    truth = truth.rows(truth.t_ns <= states.t_ns[-1])
    person = RecordedPerson(1, "ground truth", truth.t_ns, truth.points_m, ())
    assert np.array_equal(states.t_ns, run.motion["t_ns"])
    rows = run.contact[run.contact["method"] == "qp"]
    used_s, full_s = run.motion["horizon_s"].to_numpy(dtype=float), np.full(len(states), stage.horizon_s)
    for name, horizon_s in (("left_m", used_s), ("left_full_m", full_s)):
        check = Coverage(stage, person, fusion, int(states.t_ns[-1]))
        check.add(states, horizon_s)
        outcome = check.outcome()
        assert outcome is not None
        found, wanted = rows[name].to_numpy(dtype=float), np.full(len(states), np.nan)
        wanted[np.searchsorted(states.t_ns, outcome.t_ns)] = outcome.worst_m()
        assert np.isfinite(wanted).sum() > 20
        np.testing.assert_array_equal(found, wanted, name)


def test_volumes_are_those_of_the_last_state_that_is_not_later(with_truth: Path) -> None:
    stage = assembly.prediction_stage(read_run_config(with_truth))
    (states,) = read_states(with_truth / "state.parquet", 10_000)
    rows, horizons_s = (120, 30, 30, len(states) - 1), (0.1, 0.2, 0.3, 0.05)
    at_ns = [int(states.t_ns[row]) + after for row, after in zip(rows, (0, 1000, 0, 10**9), strict=True)]
    asked = [(t_ns, horizon_s, 1) for t_ns, horizon_s in zip(at_ns, horizons_s, strict=True)]
    predicted = contact.Predicted(stage, with_truth / "state.parquet")
    *found, before = predicted.volumes([*asked, (int(states.t_ns[0]) - 1, 0.1, 1)])
    assert before == {}
    for volumes, row, horizon_s in zip(found, rows, horizons_s, strict=True):
        expected = stage.volumes(states.of_person(1).rows(slice(row, row + 1)), horizon_s).at(0)
        assert set(volumes) == set(expected)
        for limb, volume in volumes.items():
            np.testing.assert_array_equal(volume.vertices_m, expected[limb].vertices_m)
            assert volume.radius_m == expected[limb].radius_m
    assert predicted.volumes([(at_ns[0], 0.1, 2)]) == [{}], "nobody has that number"


def test_points_of_the_model_are_those_of_the_skeleton_where_the_person_is_known(with_truth: Path) -> None:
    (states,) = read_states(with_truth / "state.parquet", 10_000)
    track = from_states(SmoothedPeople.of(states), 0.3)
    expected = skeleton(states.p, states.lengths_m)
    np.testing.assert_array_equal(track.points_m[:], expected)
    np.testing.assert_array_equal(track.points_m[np.array([7, 3, 3])], expected[[7, 3, 3]])
    at_ns = states.t_ns[10] + np.arange(0, 40_000_000, 1_300_000)
    copied = BodyTrack(track.source, track.t_ns, expected)
    np.testing.assert_array_equal(track.axes_m(at_ns, 0.19), copied.axes_m(at_ns, 0.19))


def test_without_truth_it_is_the_smoothed_person(
    with_truth: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    header = reader._header
    monkeypatch.setattr(reader, "_header", lambda *a, **k: dataclasses.replace(header(*a, **k), has_truth=False))
    options = {"start_s": 8.0, "end_s": 9.0}
    with undrawn():
        fresh = replay.run("report", replay.demo_log(), out=tmp_path / "fresh", **options)  # type: ignore[arg-type]
        again = replay.run("report", with_truth, out=tmp_path / "again")  # stage 1 taken over: smoothed by itself
    for name in ("smooth.parquet", "contact.parquet"):
        assert (fresh / name).read_bytes() == (again / name).read_bytes()
    table = pq.read_table(fresh / "contact.parquet").to_pandas()
    assert set(table["person"]) == {"camera points"}
    assert set(table["source"]) <= {"smoothed estimate", "kinect", "xtion"}
    assert len(set(table["source"])) > 1
    truth = pq.read_table(with_truth / "contact.parquet").to_pandas()
    assert table["distance_m"].notna().mean() > 0.9
    off_m = table["distance_m"] - truth["distance_m"]
    assert off_m.abs().median() < 0.05
    assert off_m.median() < 0.01  # the nearest of three sources is seldom further off than the truth


def test_where_no_camera_saw_anybody_the_smoothed_person_is_not_known(with_truth: Path) -> None:
    (states,) = read_states(with_truth / "state.parquet", 10_000)
    valid = np.zeros_like(states.valid)
    valid[[40, 100, 180], 0] = True  # 0.24 s and 0.32 s apart
    seen: HumanStates = dataclasses.replace(states, valid=valid)
    known = np.isfinite(from_states(SmoothedPeople.of(seen), 0.3).points_m[:][:, POINTS.index("wrist_r"), 0])
    expected = np.zeros(len(states), dtype=bool)
    expected[40:101] = True
    expected[180] = True
    np.testing.assert_array_equal(known, expected)


def test_of_several_people_those_have_a_body_of_whom_anything_is_known() -> None:
    """And one more row, that they are gone; whatever instants are written together."""
    at_ns = DT_NS * np.arange(60)
    first, second = (standing_beside(around(0.3), 60), standing_beside(around(0.9), 60))
    some = slice(20, 30)
    visitor = BodyTrack(second.source, second.t_ns[some], second.points_m[some])
    people = RecordedPeople(
        tuple(
            RecordedPerson(k, one.source, one.t_ns, one.points_m[:], (one,)) for k, one in ((1, first), (2, visitor))
        ),
        (),
    )
    whole = body_table(people, at_ns, 0.0)
    of_second = whole["person"] == 2
    known = at_ns[(at_ns >= at_ns[20]) & (at_ns <= at_ns[29])]
    np.testing.assert_array_equal(whole["t_ns"][~of_second], at_ns)
    assert whole["t_ns"][of_second][: len(known)].tolist() == known.tolist()
    shown = np.isfinite(np.stack([whole[name][of_second] for name in list(whole)[2:]])).any(axis=0)
    assert shown.tolist() == [True] * len(known) + [False]
    parts = [body_table(people, at_ns[max(0, a - 1) : a + 25], 0.0, min(a, 1)) for a in range(0, 60, 25)]
    for name, column in whole.items():
        np.testing.assert_array_equal(np.concatenate([part[name] for part in parts]), column)
    alone = body_table(dataclasses.replace(people, people=people.people[1:]), at_ns, 0.0)
    assert alone["person"].tolist() == [2] * 60
