"""Robot against recorded person: constructed contacts at known ticks, and runs with and without ground truth."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from hrcreplay.human.model import PARTS
from hrcreplay.logs import reader
from hrcreplay.records import POINTS, Floats, HumanStates
from hrcreplay.robot.model import RobotModel, from_urdf
from hrcreplay.run import contact, replay
from hrcreplay.run.contact import VOLUME_OF, Body, RecordedPerson, Volumes, from_states
from hrcreplay.store import run_folder
from hrcreplay.store.columns import read_states
from tests.robot.test_model import ONE_AXIS
from tests.undrawn import undrawn

RADII_M = np.full(len(PARTS), 0.05)
LRA = PARTS.index("LRA")
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


def standing_beside(point_m: Floats, ticks: int) -> Body:
    """A body whose only known part is a right forearm along y."""
    axes = np.full((ticks, len(PARTS), 2, 3), np.nan)
    axes[:, LRA] = point_m + np.array([[0.0, -0.2, 0.0], [0.0, 0.2, 0.0]])
    return Body("truth", axes, RADII_M)


def surface_distance(robot: RobotModel, q: float, body: Body, tick: int) -> float:
    """Between robot and body by points sampled on all axes."""
    shares = np.linspace(0.0, 1.0, 400)[:, None]
    least = np.inf
    for segment, ends in zip(robot.segments, robot.ends_m(np.array([q])), strict=True):
        for part in range(len(PARTS)):
            other = body.axes_m[tick, part]
            a, b = ends[0] + shares * (ends[1] - ends[0]), other[0] + shares * (other[1] - other[0])
            gap = np.linalg.norm(a[:, None] - b[None], axis=2).min() - segment.radius_m - body.radius_m[part]
            least = np.fmin(least, gap)
    return float(least)


def around(q: float, away_m: float = 0.33) -> Floats:
    """A point so far from the axis, where the bar points at ``q``."""
    return np.array([away_m * np.sin(q), 0.0, 0.5 + away_m * np.cos(q)])


def test_a_bar_that_swings_past_a_forearm_touches_at_the_ticks_worked_out(robot: RobotModel) -> None:
    q = np.linspace(-0.8, 0.8, 81)
    dq = np.full(81, 5.0)
    dq[60:] = 0.0
    body = standing_beside(around(0.0), 81)
    body.axes_m[45] = np.nan  # not known at one tick
    found = contact.compare(robot, turning(robot, q, dq), body)
    expected = [surface_distance(robot, q[i], body, i) if i != 45 else np.nan for i in range(81)]
    np.testing.assert_allclose(found.distance_m, expected, atol=2e-3)
    touching = np.flatnonzero(np.array(expected) <= 0.0)
    assert len(touching) > 5
    np.testing.assert_array_equal(np.flatnonzero(found.distance_m <= 0.0), touching)
    np.testing.assert_array_equal(found.moving, dq != 0.0)
    assert set(found.part[np.isfinite(found.distance_m)]) == {LRA}
    assert found.part[45] == found.link[45] == -1


def test_the_speed_is_that_of_the_surface_that_touches(robot: RobotModel) -> None:
    q, dq = np.linspace(-0.5, 0.5, 21), np.full(21, 2.0)
    body = standing_beside(around(0.3, 0.5), 21)
    found = contact.compare(robot, turning(robot, q, dq), body)
    for i in range(21):
        ends = robot.ends_m(q[i : i + 1])[found.link[i]]
        radius_m = robot.segments[found.link[i]].radius_m
        shares = np.linspace(0.0, 1.0, 2001)[:, None]
        a, b = (e[0] + shares * (e[1] - e[0]) for e in (ends, body.axes_m[i, LRA]))
        gaps = np.linalg.norm(a[:, None] - b[None, ::100], axis=2)
        row, column = np.unravel_index(np.argmin(gaps), gaps.shape)
        towards = b[100 * column] - a[row]
        at = a[row] + radius_m * towards / np.linalg.norm(towards) - (0.0, 0.0, 0.5)
        assert found.speed[i] == pytest.approx(2.0 * float(np.hypot(at[0], at[2])), rel=5e-3)


class Known:
    """Volumes of any tick: a ball around one point."""

    def __init__(self, centre_m: Floats, radius_m: float) -> None:
        self.solid = {"LRA": (centre_m + 1e-3 * np.vstack([np.zeros(3), np.eye(3)]), radius_m)}
        self.asked: list[tuple[int, float]] = []

    def volumes(self, t_ns: int, horizon_s: float) -> Volumes:
        self.asked.append((t_ns, horizon_s))
        return self.solid


def test_a_contact_is_laid_at_the_door_of_robot_or_prediction(robot: RobotModel) -> None:
    q, dq = np.linspace(-0.8, 0.8, 81), np.full(81, 5.0)
    at = around(0.0)
    body = standing_beside(at, 81)
    motion = turning(robot, q, dq)
    found = contact.compare(robot, motion, body)
    touching = np.flatnonzero(found.distance_m <= 0.0)
    motion.loc[touching[2] - 3 : touching[-1], "status"] = "braking"  # what was decided before goes on
    for ball_m, sign in ((0.5, -1.0), (0.1, 1.0)):
        known = Known(at, ball_m)
        outside = contact.by_volume(motion, found, body, known)  # type: ignore[arg-type]
        np.testing.assert_array_equal(np.flatnonzero(np.isfinite(outside)), touching)
        np.testing.assert_allclose(outside[touching], 0.2 + 0.05 - ball_m, atol=3e-3)
        assert (np.sign(outside[touching]) == sign).all()
        decided = touching[2] - 4
        assert known.asked[-1] == (decided * DT_NS, 0.04)
    no_legs = Known(at, 0.5)
    no_legs.solid = {"LEGS": no_legs.solid["LRA"]}
    assert np.isnan(contact.by_volume(motion, found, body, no_legs)).all()  # type: ignore[arg-type]


def test_a_part_that_leaves_its_volume_before_the_horizon_is_found(robot: RobotModel) -> None:
    n = 40
    body = standing_beside(np.zeros(3), n)
    body.axes_m[:, LRA, :, 0] += 0.01 * np.arange(n)[:, None]  # 10 mm a tick
    found = contact.compare(robot, turning(robot, np.zeros(n), np.zeros(n)), body)
    column = np.array([[0.0, -0.2, 0], [0, 0.2, 0], [1e-4, 0, 0], [0, 0, 1e-4]])
    later = column + np.array([0.2, 0.0, 0.0])
    volumes = [(0, 0.04, {"LRA": (column, 0.10)}), (20 * DT_NS, 0.016, {"LRA": (later, 0.10)})]
    contact.mark_left(found, np.arange(n) * DT_NS, body, iter(volumes))
    assert np.flatnonzero(np.isfinite(found.left_m)).tolist() == [0, 20]
    assert found.left_m[0] == pytest.approx(0.10 + 0.05 - 0.10, abs=1e-3)  # ten ticks on
    assert found.left_m[20] == pytest.approx(0.04 + 0.05 - 0.10, abs=1e-3)  # four
    assert found.left_part[0] == found.left_part[20] == LRA


def test_legs_are_held_against_the_volume_of_the_lower_body() -> None:
    assert {name for name, volume in VOLUME_OF.items() if volume == "LEGS"} == set(PARTS[6:])
    assert all(VOLUME_OF[name] == name for name in PARTS[:6])


def test_nothing_is_known_in_a_gap_of_the_truth() -> None:
    t_ns = np.array([0, 10, 20, 320, 330], dtype=np.int64) * 10**6
    person = RecordedPerson("truth", t_ns, np.zeros((5, len(POINTS), 3)) + np.arange(20.0)[:, None])
    at_ns = np.arange(0, 340, 4, dtype=np.int64) * 10**6
    known = np.isfinite(person.part_axes(at_ns, 0.19)).all(axis=(1, 2, 3))
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
    assert set(run.contact["person"]) == {"truth"}
    assert set(run.contact["method"]) == {"qp", *run.baselines}
    assert len(run.contact) == len(run.motion) * (1 + len(run.baselines))
    assert run.contact["distance_m"].notna().all()
    assert "contact.parquet" in run.meta["outputs"]
    assert not (with_truth / "smooth.parquet").exists()
    own = run.contact[run.contact["method"] == "qp"]
    assert own["left_m"].notna().sum() == run.occupancy["t_ns"].nunique()  # type: ignore[index]
    page = (with_truth / "report.html").read_text()
    assert page.index("Had this controller been running, ") < page.index("Robot against the recorded person")


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
    assert set(table["person"]) == {"smoothed"}
    truth = pq.read_table(with_truth / "contact.parquet").to_pandas()
    assert table["distance_m"].notna().mean() > 0.9
    same = table["limb"] == truth["limb"]  # the smoothed person has no legs
    assert same.mean() > 0.3
    assert (table["distance_m"] - truth["distance_m"]).abs()[same].median() < 0.05
    assert "the smoothed person" in (fresh / "metrics.json").read_text()


def test_where_no_camera_saw_anybody_the_smoothed_person_is_not_known(with_truth: Path) -> None:
    (states,) = read_states(with_truth / "state.parquet", 10_000)
    valid = np.zeros_like(states.valid)
    valid[[40, 100, 180], 0] = True  # 0.24 s and 0.32 s apart
    seen: HumanStates = dataclasses.replace(states, valid=valid)
    known = np.isfinite(from_states(seen, 0.3).points_m[:, POINTS.index("wrist_r"), 0])
    expected = np.zeros(len(states), dtype=bool)
    expected[40:101] = True
    expected[180] = True
    np.testing.assert_array_equal(known, expected)
