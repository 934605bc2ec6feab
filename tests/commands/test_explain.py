"""Why the robot stopped: every answer against distances by coal, rows written down, and other solvers."""

from __future__ import annotations

import json
import re
import shutil
from itertools import pairwise
from pathlib import Path
from typing import Any

import daqp
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from hrcreplay.cli.app import app
from hrcreplay.commands import explain
from hrcreplay.commands.explain import Record
from hrcreplay.errors import SettingsError
from hrcreplay.pipeline import assembly
from hrcreplay.records import Floats, HumanStates
from hrcreplay.robot.control import active_constraints
from hrcreplay.robot.control.active_constraints import LinearRows
from hrcreplay.robot.control.metric_rows import Problem
from hrcreplay.robot.control.row_search import SLACK
from hrcreplay.store import run_folder
from hrcreplay.store.columns import read_states
from hrcreplay.store.run_folder import Run
from tests.facts import facts, tells
from tests.robot.checker import RADII, links
from tests.robot.distances import axis_distance
from tests.robot.plain_rows import LinkSegment, approach_rows

SLOW = 0.001


@pytest.fixture(scope="module")
def record(demo_folder: Path) -> Record:
    return explain.open_record(demo_folder)


def gaps(record: Record, q: Floats, around: Any) -> Floats:
    """(5, l) distance of the surfaces of links and volumes by DH table and coal; of the axes where they overlap [m]."""
    base = np.array(run_folder.read_meta(record.folder)["T_world_base"])
    ends, _ = links(q[None], np.zeros((1, 6)), base, 0.10)
    offsets = around.offsets
    hulls = [around.vertices_m[a:b] for a, b in pairwise(offsets)]
    axes = np.array([[axis_distance(a, b, hull, [0]) for hull in hulls] for a, b in ends[0]])
    return axes - np.array(RADII)[:, None] - around.radius_m


def names(record: Record) -> tuple[list[str], tuple[str, ...]]:
    return [s.name for s in record.controller.robot.segments], assembly.prediction_stage(record.run_config).limbs


def every_row(task: Problem) -> tuple[Floats, Floats, list[tuple[int, int, int, int]]]:
    """All approach rows of a problem as speeds, and which they are: link, limb, row of Eq. (12), vertex."""
    of, A, b, which = task.rows, [], [], []
    for link in range(len(of.ends_m)):
        for limb in range(len(of.offsets) - 1):
            vertices = of.vertices_m[of.offsets[limb] : of.offsets[limb + 1]]
            segment = LinkSegment(*of.ends_m[link], *of.J_ends[link])
            rows = approach_rows(segment, vertices, 1.0, clearance_m=0.0, stop_s=of.stop_s)
            A.append(rows.A / of.per_speed[link, limb])
            b.append(np.full(len(rows.A), of.rhs_m2[link, limb] / of.per_speed[link, limb]))
            which += [(link, limb, end, j) for end in (0, 1) for j in range(len(vertices))]
    return np.concatenate(A), np.concatenate(b), which


def by_daqp(task: Problem) -> tuple[Floats, Floats, list[tuple[int, int, int, int]]]:
    """By daqp with all rows written down: least multipliers and room of the approach rows, and which they are.

    Rows that nearly repeat each other have many multipliers; those of the least squares are unique.
    """
    A, b, which = every_row(task)
    limits, n = task.limits, len(task.g)
    H, g, low, high, J = task.H, task.g, limits.low, limits.high, limits.J
    if task.soft:
        A, J = np.hstack([A, -np.ones((len(A), 1))]), np.hstack([J, np.zeros((len(J), 1))])
        H = np.block([[H, np.zeros((n, 1))], [np.zeros((1, n)), np.full((1, 1), SLACK)]])
        g, low, high = np.append(g, 0.0), np.append(low, 0.0), np.append(high, 1e30)
    A[np.abs(A) < 1e-13] = 0.0
    rows = np.ascontiguousarray(np.vstack([J, A]))
    upper = np.concatenate([high, limits.J_high, b])
    lower = np.concatenate([low, np.maximum(limits.J_low, -1e30), np.full(len(b), -1e30)])
    x, _, flag, _ = daqp.solve(H, g, rows, upper, lower, primal_tol=1e-11, dual_tol=1e-12)
    assert flag == 1
    every = np.vstack([np.eye(len(g)), -np.eye(len(g)), J, -J, A])
    left = np.concatenate([high - x, x - low, limits.J_high - J @ x, J @ x - limits.J_low, b - A @ x])
    active = np.flatnonzero(left <= active_constraints.ACTIVE)
    pull = -(H @ x + g)
    near, top = 1e-7 * np.abs(pull).max(), np.full(len(active), 1e30)
    held = np.ascontiguousarray(every[active].T)
    least, _, flag, _ = daqp.solve(
        np.eye(len(active)), np.zeros(len(active)), held, np.append(top, pull + near), np.append(0.0 * top, pull - near)
    )
    assert flag == 1
    lam = np.zeros(len(every))
    lam[active] = least
    return lam[len(every) - len(A) :], b - A @ x, which


def spied(monkeypatch: pytest.MonkeyPatch, name: str) -> list[Any]:
    """What is given to a function of ``active_constraints``."""
    seen: list[Any] = []
    own = getattr(active_constraints, name)

    def spy(first: Any, *rest: Any) -> Any:
        seen.append(first)
        return own(first, *rest)

    monkeypatch.setattr(active_constraints, name, spy)
    return seen


def assert_binding(found: dict[str, Any], task: Problem, record: Record) -> None:
    """The rows that hold are those of another solver with all rows, the heaviest first; so are the next ones."""
    at_links, at_limbs = names(record)
    lam, room, which = by_daqp(task)
    told = [(at_links.index(r["link"]), at_limbs.index(r["limb"]), r["end"], r["vertex"]) for r in found["binding"]]
    if not told:
        assert lam.max() <= 1e-4 * np.abs(task.g).max()
        return
    weight: dict[tuple[int, int, int], float] = {}
    for multiplier, (link, limb, end, _) in zip(lam, which, strict=True):
        weight[link, limb, end] = weight.get((link, limb, end), 0.0) + float(multiplier)
    most = max(weight.values())
    assert weight[told[0][:3]] >= 0.999 * most
    assert {row[:3] for row in told} >= {key for key, total in weight.items() if total > 0.02 * most}
    assert all(weight[row[:3]] > 0.0 for row in told)
    least: dict[tuple[int, int, int], float] = {}
    for left, (link, limb, end, _) in zip(room, which, strict=True):
        least[link, limb, end] = min(float(left), least.get((link, limb, end), np.inf))
    for row in (*found["binding"], *found["next"]):
        key = at_links.index(row["link"]), at_limbs.index(row["limb"]), row["end"]
        assert row["margin_m_per_s"] == pytest.approx(least[key], abs=2e-5)
    rest = sorted(value for key, value in least.items() if key not in {pair[:3] for pair in told})
    np.testing.assert_allclose([row["margin_m_per_s"] for row in found["next"]], rest[:3], atol=2e-5)


def assert_nearest(found: dict[str, Any], record: Record, tick: int) -> None:
    """The nearest pair is that by coal."""
    context = record.again(tick)
    assert context is not None
    at_links, at_limbs = names(record)
    gap = gaps(record, context.current_stop.q[0], context.seen.obstacles)
    link, limb = np.unravel_index(int(np.argmin(gap)), gap.shape)
    assert found["nearest"]["link"] == at_links[link]
    assert found["nearest"]["limb"] == at_limbs[limb]
    assert found["nearest"]["distance_m"] == pytest.approx(max(0.0, gap.min()), abs=1e-7)
    assert found["nearest"]["overlap_m"] == pytest.approx(max(0.0, -gap.min()), abs=1e-7)


def test_ten_stops_of_the_demo_are_told_as_brute_force_finds_them(
    record: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    tasks = spied(monkeypatch, "find_holding_rows")
    stops = explain.longest_stops(record.motion, SLOW)
    assert len(stops) == 10
    kinds = set()
    starts = stops[:, 0].tolist()
    assert (record.motion["tcp_speed"].iloc[starts] < SLOW).all()
    for first in (*starts, int((record.motion["status"] == "retreating").argmax())):
        tasks.clear()
        found = explain.facts(record, first)
        assert found is not None
        if found["reason"] == "no human state":
            assert "nearest" not in found
            continue
        assert_nearest(found, record, first)
        kinds.add((found["status"], found["reason"]))
        if tasks:
            assert_binding(found, tasks[0], record)
        else:
            assert found["reason"] == "inside a volume"
            assert found["nearest"]["overlap_m"] >= record.run_config.settings.plan.retreat_m
            assert "overlap by" in explain.cause(found)
    assert {("limited", "inside a volume"), ("retreating", "")} <= kinds


def test_moving_ticks_are_told_as_another_solver_finds_them(record: Record, monkeypatch: pytest.MonkeyPatch) -> None:
    tasks = spied(monkeypatch, "find_holding_rows")
    status, reason = (record.motion[name].fillna("").astype(str).to_numpy() for name in ("status", "reason"))
    speed = record.motion["tcp_speed"].to_numpy()
    held = 0
    rng = np.random.default_rng(4)
    for wanted in ("tracking", "limited", "retreating"):
        ticks = np.flatnonzero((status == wanted) & (reason == "") & (speed > 0.01))
        for tick in rng.choice(ticks, 6, replace=False).tolist():
            tasks.clear()
            found = explain.facts(record, tick)
            assert found is not None
            assert_nearest(found, record, tick)
            assert_binding(found, tasks[0], record)
            held += bool(found["binding"])
            assert bool(found["binding"]) or wanted != "limited"
    assert held >= 6


def test_a_refused_stop_is_told_where_it_comes_too_near(record: Record) -> None:
    reason = record.motion["reason"].fillna("").astype(str).to_numpy()
    ticks = np.flatnonzero(reason == "not certified")
    at_links, at_limbs = names(record)
    for tick in np.random.default_rng(5).choice(ticks, 6, replace=False).tolist():
        found = explain.facts(record, tick)
        context = record.again(tick)
        assert found is not None
        assert context is not None
        wanted, _ = active_constraints.propose_explained(record.controller, context)
        assert isinstance(wanted, list)
        assert len(found["refused"]) == len(wanted) == 2
        for one, (stop, _) in zip(found["refused"], wanted, strict=True):
            failed = round(one["failed_s"] / 0.004)
            q = (context.current_stop.q[0], *stop.q)
            for i in range(failed + 1):
                gap = gaps(record, q[i], context.seen.obstacles)
                assert (gap.min() <= 0.0) == (i == failed and one["why"] == "not clear")
            at = at_links.index(one["link"]), at_limbs.index(one["limb"])
            assert one["gap_m"] == pytest.approx(gap[at], abs=1e-7)
            moved, _ = links(np.array(q), np.zeros((len(q), 6)), np.eye(4), 0.10)
            if failed + 1 < len(q):
                way = np.linalg.norm(moved[failed + 1, at[0]] - moved[failed, at[0]], axis=1).max()
                assert way <= one["travel_m"] + 1e-12
            if one["why"] == "not clear":
                assert gap[at] == gap.min()
            elif one["why"] == "not proven until the next tick":
                assert 0.0 < one["gap_m"] <= one["travel_m"]


def feasible(A: Floats, b: Floats) -> bool:
    """Whether some velocity keeps all rows, by daqp."""
    n = A.shape[1]
    rows = np.ascontiguousarray(A / np.linalg.norm(A, axis=1, keepdims=True))
    high = np.concatenate([np.full(n, 1e6), b / np.linalg.norm(A, axis=1)])
    low = np.concatenate([np.full(n, -1e6), np.full(len(b), -1e30)])
    flag: int = daqp.solve(np.eye(n), np.zeros(n), rows, high, low, primal_tol=1e-10)[2]
    return flag == 1


def assert_minimal(rows: LinearRows, found: list[dict[str, Any]]) -> None:
    """A conflict is one, and without any of its rows it is none."""
    chosen = [next(i for i, name in enumerate(rows.names) if name == row) for row in found]
    assert 1 <= len(chosen) <= rows.A.shape[1] + 1
    assert not feasible(rows.A[chosen], rows.b[chosen])
    for i in chosen:
        rest = [j for j in chosen if j != i]
        assert not rest or feasible(rows.A[rest], rows.b[rest])


def test_rows_that_contradict_each_other_are_as_few_as_can_be() -> None:
    rng = np.random.default_rng(6)
    sizes = []
    for _ in range(200):
        m = int(rng.integers(8, 60))
        A, b = rng.normal(size=(m, 6)) * (rng.random((m, 6)) < 0.4), rng.normal(size=m) * 0.5 + 0.5
        A[np.arange(m), rng.integers(0, 6, m)] += 1.0
        rows = LinearRows(A, b, tuple({"kind": "row", "number": i} for i in range(m)))
        found = active_constraints.conflict(rows)
        assert bool(found) != feasible(A, b)
        if found:
            assert_minimal(rows, found)
        sizes.append(len(found))
    assert 20 < sum(size == 0 for size in sizes) < 180
    assert {3, 4, 5, 6, 7} <= set(sizes)


def test_a_row_that_nothing_can_keep_is_a_conflict_alone() -> None:
    rows = LinearRows(np.array([[1.0, 0.0], [0.0, 0.0]]), np.array([1.0, -1.0]), ({"n": 0}, {"n": 1}))
    assert active_constraints.conflict(rows) == [{"n": 1}]


def test_where_the_printed_method_has_no_solution_the_rows_are_named(
    printed: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = explain.open_record(printed.folder)
    seen = spied(monkeypatch, "conflict")
    reason = record.motion["reason"].fillna("").astype(str).to_numpy()
    at_links, at_limbs = names(record)
    for tick in np.random.default_rng(7).choice(np.flatnonzero(reason == "no solution"), 6, replace=False).tolist():
        seen.clear()
        found = explain.facts(record, tick)
        assert found is not None
        if found["unsolved"] != "infeasible":  # proxqp may find none where there is one
            continue
        plain = [
            {**row, "link": at_links.index(row["link"]), "limb": at_limbs.index(row["limb"])} if "link" in row else row
            for row in found["conflict"]
        ]
        assert_minimal(seen[0], plain)
        assert tells(explain.cause(found), "no velocity")


@pytest.mark.parametrize("method", ["scaling", "none"])
def test_baselines_are_made_again_too(demo_folder: Path, method: str) -> None:
    record = explain.open_record(demo_folder, method)
    for first, _ in explain.longest_stops(record.motion, SLOW, 3).tolist():
        found = explain.facts(record, first)
        assert found is not None
        assert found["method"] == method
    if method == "scaling":
        status = record.motion["status"].astype(str).to_numpy()
        reason = record.motion["reason"].fillna("").astype(str).to_numpy()
        tick = int(np.flatnonzero((status == "braking") & (reason == "no solution"))[0])
        found = explain.facts(record, tick)
        assert found is not None
        assert found["conflict"][0]["margin_m_per_s"] < 0.0
        assert tells(explain.cause(found), "braking", "path")


def test_people_are_those_of_the_tick_whatever_is_read_together(
    demo_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(explain, "_BATCH", 100)
    record, states = (
        explain.open_record(demo_folder),
        HumanStates.join(list(read_states(demo_folder / "state.parquet", 4096))),
    )
    ticks_ns, first = states.ticks()
    assert np.array_equal(record.ticks_ns, ticks_ns)
    for tick in (0, 99, 100, 101, 250, 199, len(ticks_ns) - 1):
        found, wanted = record.people(tick), states.rows(slice(int(first[tick]), int(first[tick + 1])))
        assert found.t_ns.tolist() == wanted.t_ns.tolist() == [ticks_ns[tick]] * len(wanted)
        np.testing.assert_array_equal(found.p, wanted.p)
        np.testing.assert_array_equal(found.numbers, wanted.numbers)
    assert record.names == record.surroundings.names_of(int(states.numbers.max()))


def test_the_longest_stops_stand_in_the_report(demo_folder: Path, record: Record) -> None:
    metrics = json.loads((demo_folder / "metrics.json").read_text())
    stops = explain.longest_stops(record.motion, SLOW)
    lengths = [metrics[f"plan_stop_{i:02}_duration_s"]["value"] for i in range(1, 11)]
    np.testing.assert_allclose(lengths, (stops[:, 1] - stops[:, 0]) * 0.004, atol=1e-9)
    assert lengths == sorted(lengths, reverse=True)
    page = (demo_folder / "report.html").read_text()
    assert "The longest stops" in page
    assert metrics["plan_stop_01_cause"]["value"].split(" ")[0] in page


def test_the_command_prints_the_cause_and_all_facts_as_json(demo_folder: Path, record: Record) -> None:
    first, past = explain.longest_stops(record.motion, SLOW)[0].tolist()
    at = f"{0.004 * (first + past) / 2:.3f}"
    said = CliRunner().invoke(app, ["why", str(demo_folder), "--at", at]).stdout.splitlines()
    assert re.match(r"\d+\.\d{3} s, tick \d+, qp: the robot stood, ", said[0])
    assert said[1].startswith("Cause: ")
    assert [line.split(":")[0] for line in said[-2:]] == ["Camera kinect", "Camera xtion"]
    facts = json.loads(CliRunner().invoke(app, ["why", str(demo_folder), "--at", at, "--json"]).stdout)
    assert first <= facts["tick"] < past
    state = pq.read_table(demo_folder / "state.parquet").to_pandas()
    frames = pq.read_table(demo_folder / "measurements.parquet").to_pandas()
    now_ns = int(state["t_ns"].unique()[facts["tick"]])
    state = state[state["t_ns"] <= now_ns]  # a row for each person at every tick
    for camera, ages in facts["cameras"].items():
        used_ns = int(state["t_ns"][state[f"valid_{camera}"]].iloc[-1])
        seen = frames[(frames["camera"] == camera) & (frames["arrival_ns"] <= now_ns)]
        assert ages["used_s_ago"] == pytest.approx((now_ns - used_ns) * 1e-9)
        assert ages["newest_frame_s_ago"] == pytest.approx((now_ns - int(seen["capture_ns"].max())) * 1e-9)


def test_a_tick_that_does_not_come_out_as_recorded_is_not_explained(demo_folder: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("run.json", "state.parquet", "measurements.parquet"):
        shutil.copyfile(demo_folder / name, folder / name)
    table = pq.read_table(demo_folder / "motion.parquet")
    u1 = table["u1"].to_numpy().copy()
    u1[6000] = np.nextafter(u1[6000], np.inf)
    pq.write_table(table.set_column(table.column_names.index("u1"), "u1", pa.array(u1)), folder / "motion.parquet")
    assert explain.explain(folder, 0.004 * 5000)["tick"] == 5000
    with pytest.raises(SettingsError, match=facts("24 s", "recorded")):
        explain.explain(folder, 24.0)
    with pytest.raises(SettingsError, match=facts("--at 61", "0 to 60.000")):
        explain.explain(folder, 61.0)
    with pytest.raises(SettingsError, match=facts("motion_shield.parquet", "plan", "report")):
        explain.explain(folder, 1.0, "shield")
