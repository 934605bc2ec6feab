"""Methods side by side: the same bytes however they were run, and the same numbers by a checker of its own."""

from __future__ import annotations

import csv
import json
import math
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from hrcreplay.commands import compare, replay
from hrcreplay.errors import SettingsError
from hrcreplay.evaluation.judging import read_recorded_people
from hrcreplay.evaluation.recorded_person import at_instants
from hrcreplay.human.model import skeleton
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.run_config import resolve
from hrcreplay.pipeline.surroundings import PredictionStage
from hrcreplay.records import JOINTS, LENGTHS, POINTS, Floats, HumanStates, Ints
from hrcreplay.reporting import comparison
from hrcreplay.reporting.comparison import FIELDS, Variant
from hrcreplay.reporting.figures import planning
from hrcreplay.reporting.severity import NUMBERS
from hrcreplay.settings.load import load_settings
from hrcreplay.store import run_folder
from hrcreplay.store.columns import read_states
from hrcreplay.store.run_folder import RunWriter
from tests.facts import facts, tells
from tests.robot.checker import RADII, links
from tests.robot.distances import axis_distance
from tests.test_recordings import TASK
from tests.tools import bases

SPAN: dict[str, Any] = {"start_s": 8.0, "end_s": 10.8}
METHODS = "none,ssm,shield,scaling,qp,qp:paper:fixed"
#: Axes and radii of the recorded body, Table 2 and the settings: ends, radius [m], whether a hand goes on.
BODY = (
    ("neck", "head", 0.12, False),
    ("pelvis", "neck", 0.15, False),
    *(("shoulder_" + s, "elbow_" + s, 0.07, False) for s in "rl"),
    *(("elbow_" + s, "wrist_" + s, 0.07, True) for s in "rl"),
    *(("hip_" + s, "knee_" + s, 0.08, False) for s in "rl"),
    *(("knee_" + s, "ankle_" + s, 0.08, False) for s in "rl"),
    *(("wrist_" + s, "hand_" + s, 0.07, False) for s in "rl"),
    *(("ankle_" + s, "foot_" + s, 0.08, False) for s in "rl"),
)
HAND_M, TOOL_M, NEAR_M, SLOW = 0.19, 0.10, 0.5, 0.001


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("compare") / "one"
    return compare.run([replay.demo_log()], methods=METHODS, out=out, processes=1, **SPAN)


def outputs(folder: Path) -> dict[str, str]:
    found: dict[str, str] = run_folder.read_meta(folder)["outputs"]
    return found


def test_two_processes_and_small_batches_give_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    again = compare.run([replay.demo_log()], methods=METHODS, out=tmp_path / "two", processes=2, chunk_ticks=60, **SPAN)
    assert outputs(again) == outputs(folder)
    assert {"compare.json", "compare.csv", "compare.md", "figures/compare.png", "demo/motion_none.parquet"} <= set(
        outputs(folder)
    )
    words = (folder / "compare.md").read_text()
    assert "86.44 % (scaling) and 30.06 % (QP)" in words
    assert not {str(folder.parent), "nan", "None"} & set(words.replace("|", " ").split())


def test_what_a_report_made_is_taken_over(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = replay.run("report", replay.demo_log(), out=tmp_path / "report", **SPAN)
    capsys.readouterr()
    again = compare.run([report], methods=METHODS, out=tmp_path / "again", processes=1)
    said = capsys.readouterr().err
    assert all(f"{label}: taken over" in said for label in ("none", "qp:sound:adaptive", "scaling:sound:adaptive"))
    assert "ssm:sound:adaptive: taken over" not in said
    assert "qp:paper:fixed: taken over" not in said
    assert outputs(again) == outputs(folder)
    for name, mine in (("motion", "qp_sound_adaptive"), ("motion_none", "none")):
        assert (folder / "demo" / f"motion_{mine}.parquet").read_bytes() == (report / f"{name}.parquet").read_bytes()
    metrics = json.loads((report / "metrics.json").read_text())
    ours = json.loads((folder / "compare.json").read_text())["logs"][0]["methods"]["qp:sound:adaptive"]
    assert ours["standing_share"] == metrics["plan_stationary_share"]["value"]
    assert ours["pace"] == pytest.approx(metrics["plan_progress_share"]["value"], rel=1e-12)


def test_another_setting_takes_no_motion_over(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = replay.run("plan", replay.demo_log(), out=tmp_path / "plan", start_s=8.0, end_s=8.4)
    capsys.readouterr()
    other = ("plan.lead_s=0.1",)
    compare.run([plan], methods="none,qp", out=tmp_path / "again", processes=1, overrides=other)
    said = capsys.readouterr().err
    assert "fuse: taken over" in said
    assert "qp:sound:adaptive: taken over" not in said


def test_terminal_files_hold_the_same_numbers(folder: Path) -> None:
    found = json.loads((folder / "compare.json").read_text())
    with (folder / "compare.csv").open() as file:
        rows = list(csv.DictReader(file))
    labels = list(dict.fromkeys(row["variant"] for row in rows))
    assert [row["variant"] for row in rows] == [*labels, *labels]
    assert [row["log"] for row in rows] == ["demo"] * len(labels) + ["all"] * len(labels)
    for row in rows[: len(labels)]:
        for field in FIELDS:
            value = found["logs"][0]["methods"][row["variant"]][field.name]
            assert (None if row[field.name] == "" else float(row[field.name])) == value
    lines = [line for line in (folder / "compare.md").read_text().splitlines() if line.startswith("| qp:sound")]
    assert f"| {100 * found['total']['qp:sound:adaptive']['pace']:.1f} |" in lines[0]


def points_of_truth(t_ns: Floats) -> Floats:
    """(n, 20, 3) the ground truth of the demo log between its samples [m]."""
    log = open_log(replay.demo_log(), load_settings().logs)
    parts = list(log.truth())
    at, points = np.concatenate([p.t_ns for p in parts]), np.concatenate([p.points_m for p in parts]).reshape(-1, 60)
    return np.column_stack([np.interp(t_ns, at, points[:, k]) for k in range(60)]).reshape(-1, 20, 3)


def segment_distance(a: Floats, b: Floats, c: Floats, d: Floats) -> Floats:
    """(n,) between segments a-b and c-d: the least of the four ends against the other, and of the lines between."""

    def to_segment(p: Floats, x: Floats, y: Floats) -> Floats:
        way = y - x
        share = np.clip(((p - x) * way).sum(1) / np.maximum((way * way).sum(1), 1e-30), 0.0, 1.0)
        return np.asarray(np.linalg.norm(p - x - share[:, None] * way, axis=1))

    least = np.fmin.reduce([to_segment(a, c, d), to_segment(b, c, d), to_segment(c, a, b), to_segment(d, a, b)])
    u, v, w = b - a, d - c, a - c
    uu, uv, vv, uw, vw = ((x * y).sum(1) for x, y in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    det = uu * vv - uv * uv
    with np.errstate(all="ignore"):
        s, t = (uv * vw - vv * uw) / det, (uu * vw - uv * uw) / det
        between = np.linalg.norm(w + s[:, None] * u - t[:, None] * v, axis=1)
    inside = (det > 1e-12) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    return np.where(inside, np.fmin(between, least), least)


def body_distance(motion: pd.DataFrame, sources: list[Floats], T_world_base: Floats) -> tuple[Floats, Floats, Floats]:
    """(n,) distance of the surfaces to the nearest source [m], and bounds on the speed of the link's surface [m/s]."""
    q, dq = (motion[[f"{name}{i}" for i in range(1, 7)]].to_numpy() for name in ("q", "dq"))
    ends, speeds = links(q, dq, T_world_base, TOOL_M)
    best = np.full(len(q), np.inf)
    slow, fast = np.full(len(q), np.nan), np.full(len(q), np.nan)
    turning = np.abs(dq).sum(axis=1)
    for link, radius in enumerate(RADII):
        for points, (first, last, around, hand) in product(sources, BODY):
            c, d = (points[:, POINTS.index(name)] for name in (first, last))
            if hand:
                d = d + HAND_M * (d - c) / np.linalg.norm(d - c, axis=1, keepdims=True)
            c, d = np.where(np.isnan(c), d, c), np.where(np.isnan(d), c, d)  # of one known end: a ball
            gap = segment_distance(ends[:, link, 0], ends[:, link, 1], c, d) - radius - around
            nearer = gap < best
            best[nearer] = gap[nearer]
            at_ends = np.linalg.norm(speeds[:, link], axis=2)
            slow[nearer] = (0.0 - turning * radius)[nearer]
            fast[nearer] = (at_ends.max(axis=1) + turning * radius)[nearer]
    return np.where(np.isfinite(best), best, np.nan), slow, fast


def checked(motion: pd.DataFrame, sources: list[Floats], T_world_base: Floats) -> dict[str, Any]:
    """What the table says of a motion, worked out from its table and the person's points alone."""
    gap, slow, fast = body_distance(motion, sources, T_world_base)
    dq, u = (motion[[f"{name}{i}" for i in range(1, 7)]].to_numpy() for name in ("dq", "u"))
    turns, known = (dq != 0).any(axis=1), np.isfinite(gap)
    touch = known & (gap <= 0)
    speed, near = motion["tcp_speed"].to_numpy(), motion["distance_m"].to_numpy() <= NEAR_M
    braking = (motion["status"] == "braking").to_numpy()
    begins = braking & ~np.concatenate([[False], braking[:-1]])
    moves = (speed >= SLOW) | (np.abs(dq) >= 1e-3).any(axis=1)
    ref, tcp = (motion[[f"{w}_{axis}" for axis in "xyz"]].to_numpy() for w in ("ref", "tcp"))
    off = [float(np.linalg.norm(ref - at, axis=1).min()) for at in tcp[::10]]
    return {
        "known_ticks": int(known.sum()),
        "touch_ticks": int((touch & turns).sum()),
        "touch_rest_ticks": int((touch & ~turns).sum()),
        "nearest_moving_m": float(gap[known & turns].min()) if (known & turns).any() else None,
        "nearest_rest_m": float(gap[known & ~turns].min()) if (known & ~turns).any() else None,
        "near_ticks": int(near.sum()),
        "null_speed_ticks": int((near & (speed < SLOW)).sum()),
        "braking_events": int((begins & moves).sum()),
        "jerk_rms_rad_per_s3": math.sqrt(float((np.diff(u, axis=0) ** 2).mean())) / 0.004,
        "ran_s": float(motion["programme_s"].iloc[-1] - motion["programme_s"].iloc[0]),
        "off_m": max(off),
        "speed": (float(slow[touch & turns].max()), float(fast[touch & turns].max()))
        if (touch & turns).any()
        else None,
    }


def assert_agrees(row: dict[str, Any], mine: dict[str, Any], method: str) -> None:
    for name in ("known_ticks", "near_ticks", "null_speed_ticks", "braking_events"):
        assert row[name] == mine[name], name
    for name in ("touch_ticks", "touch_rest_ticks"):
        assert abs(row[name] - mine[name]) <= 1, name  # a tick may touch by rounding
    for name, off in (("nearest_moving_m", 1e-6), ("nearest_rest_m", 1e-6), ("jerk_rms_rad_per_s3", 1e-6)):
        assert row[name] == (None if mine[name] is None else pytest.approx(mine[name], abs=off, rel=1e-9)), name
    assert row["deviation_max_m"] == pytest.approx(mine["off_m"], abs=0.01)
    if row["touch_speed_m_per_s"] is not None:
        assert mine["speed"][0] <= row["touch_speed_m_per_s"] <= mine["speed"][1]
    if method != "qp":  # who stays on the path is where its reference is
        assert row["made_s"] == pytest.approx(mine["ran_s"], abs=0.01)
    else:
        assert row["made_s"] <= mine["ran_s"] + 1e-6
    assert sum(row["braking_events_by_cause"].values()) == row["braking_events"]


def test_the_table_is_that_of_a_checker_of_its_own(folder: Path) -> None:
    found = json.loads((folder / "compare.json").read_text())
    run_config = resolve("plan", replay.demo_log())
    base = assembly.robot_base(run_config, open_log(run_config.log, run_config.settings.logs))
    rows = found["logs"][0]["methods"]
    for label, row in rows.items():
        motion = pq.read_table(folder / "demo" / f"motion_{label.replace(':', '_')}.parquet").to_pandas()
        assert_agrees(row, checked(motion, [points_of_truth(motion["t_ns"].to_numpy())], base), label.split(":")[0])
    assert rows["none"]["touch_ticks"] > 0
    assert rows["none"]["coverage"] is None
    assert all(row["touch_ticks"] == 0 for label, row in rows.items() if label != "none")
    assert set(run_folder.read_meta(folder)["methods"]) == set(rows)


def test_coverage_is_that_of_every_point_against_every_volume(folder: Path) -> None:
    row = json.loads((folder / "compare.json").read_text())["logs"][0]["methods"]["qp:paper:fixed"]
    run_config = compare.variant_run_config(resolve("plan", replay.demo_log(), **SPAN), Variant("qp", "paper", "fixed"))
    stage = assembly.prediction_stage(run_config)
    motion = pq.read_table(folder / "demo" / "motion_qp_paper_fixed.parquet").to_pandas()
    (states,) = read_states(folder / "demo" / "state.parquet", 100_000)
    truth = list(open_log(replay.demo_log()).truth())
    at_ns, points = (np.concatenate([getattr(part, name) for part in truth]) for name in ("t_ns", "points_m"))
    points[:, POINTS.index("neck")] = points[:, [POINTS.index(f"shoulder_{side}") for side in "lr"]].mean(axis=1)
    held = [
        inside
        for i in range(0, len(motion), 10)
        if motion["t_ns"].iloc[i] + round(1e9 * motion["horizon_s"].iloc[i]) <= motion["t_ns"].iloc[-1]
        if (inside := _all_inside(stage, states.rows(slice(i, i + 1)), motion["horizon_s"].iloc[i], at_ns, points))
        is not None
    ]
    assert row["checked_ticks"] == len(held) > 20
    assert row["held_ticks"] == sum(held)


#: Limb -> its ends, its other points, and its radius of Table 2 [m].
WHOLE = {
    "HD": (("neck", "head"), (), 0.12),
    "THX": (("pelvis", "shoulder_r"), ("shoulder_l",), 0.15),
    **{f"U{S}A": ((f"shoulder_{s}", f"elbow_{s}"), (), 0.07) for S, s in ("Rr", "Ll")},
    **{f"L{S}A": ((f"elbow_{s}", f"wrist_{s}"), (f"hand_{s}",), 0.07) for S, s in ("Rr", "Ll")},
}


def _all_inside(
    stage: PredictionStage, state: HumanStates, horizon_s: float, at_ns: Ints, points: Floats
) -> bool | None:
    """Whether every limb, point by point, is whole inside its volume until the horizon; None where none was seen."""
    now_ns, until_ns = int(state.t_ns[0]), round(1e9 * horizon_s)
    volumes = stage.volumes(state, float(horizon_s))
    if np.isnan(volumes.vertices_m).any():
        return None
    within = points[(at_ns > now_ns) & (at_ns <= now_ns + until_ns)]
    late = points[(at_ns > now_ns + 0.75 * until_ns) & (at_ns <= now_ns + until_ns)]
    found: list[bool] = []
    for limb, (ends, others, radius_m) in WHOLE.items():
        if not all(np.isfinite(late[:, POINTS.index(name)]).all(axis=1).any() for name in ends):
            continue
        at = volumes.limbs.index(limb)
        for name in (*ends, *others):
            for point in within[:, POINTS.index(name)]:
                if np.isfinite(point).all():
                    gap = axis_distance(point, point, volumes.vertices(0, at), [0]) + radius_m
                    found.append(gap - volumes.radius_m[0, at] <= 1e-9)
    return all(found) if found else None


def test_logs_add_up() -> None:
    hard: dict[str, Any] = {
        "transient_n": 50.0,
        "transient_limit_n": 100.0,
        "robot_speed": 1.0,
        "person_speed": None,
        "link": "tool",
    }
    one: dict[str, Any] = dict.fromkeys((field.name for field in FIELDS), 2.0) | {
        "ticks": 100,
        "braking_events_by_cause": {"a": 1},
    }
    one["worst_contact"] = hard | dict.fromkeys(NUMBERS.keys() - hard.keys())
    two = {**one, "ticks": 300, "nearest_moving_m": -1.0, "touch_speed_m_per_s": None, "deviation_mean_m": 6.0}
    two |= {"jerk_rms_rad_per_s3": 6.0, "made_s": 1.0, "given_s": 4.0, "braking_events_by_cause": {"a": 2, "b": 5}}
    two["worst_contact"] = one["worst_contact"] | {"transient_n": 10.0, "transient_limit_n": 15.0}
    both = comparison.total([one, two])
    assert both["ticks"] == 400
    assert both["touch_ticks"] == 4.0
    assert both["nearest_moving_m"] == -1.0
    assert both["touch_speed_m_per_s"] == 2.0
    assert both["deviation_mean_m"] == pytest.approx((100 * 2 + 300 * 6) / 400)
    assert both["jerk_rms_rad_per_s3"] == pytest.approx(math.sqrt((100 * 4 + 300 * 36) / 400))
    assert both["pace"] == pytest.approx(3.0 / 6.0)
    assert both["braking_events_by_cause"] == {"a": 3, "b": 5}
    assert both["worst_contact"] == two["worst_contact"]  # a larger share of a smaller limit
    assert comparison.total([one, {**two, "worst_contact": None}])["worst_contact"] == one["worst_contact"]


CELL = "T_world_base = { position_m = [1.28, 0.0, 0.65], yaw_deg = 0.0 }\n"


def test_a_report_and_a_comparison_tell_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The robot stands inside the person: said by both, in print and in what they leave behind."""
    cell = tmp_path / "cell.toml"
    span: dict[str, Any] = {"start_s": 8.0, "end_s": 9.3}
    cell.write_text(CELL)
    plan = replay.run("plan", replay.demo_log(), out=tmp_path / "plan", cell_file=cell, **span)
    first = capsys.readouterr().err.splitlines()
    both = "qp,scaling,none"
    out = compare.run([replay.demo_log()], methods=both, out=tmp_path / "one", processes=1, cell_file=cell, **span)
    again = compare.run([plan], methods=both, out=tmp_path / "two", processes=1)
    second = capsys.readouterr().err
    said = [line.removeprefix("hrcreplay: ") for line in first if not line.startswith("/")]
    assert tells(said, "inside", "T_world_base")
    notes = json.loads((out / "compare.json").read_text())["logs"][0]["notes"]
    assert notes == said
    assert notes == json.loads((again / "compare.json").read_text())["logs"][0]["notes"]
    assert all(f"hrcreplay: {line}" in second for line in said)
    assert all(f"- {line}" in (out / "compare.md").read_text().splitlines() for line in said)


def still(folder: Path) -> dict[str, Any]:
    """What a comparison says of two methods of which one is inside the volumes for all of the time."""
    cell = folder / "cell.toml"
    cell.write_text(CELL)
    span: dict[str, Any] = {"start_s": 8.0, "end_s": 9.3, "cell_file": cell}
    out = compare.run([replay.demo_log()], methods="none,scaling", out=folder / "one", processes=1, **span)
    found: dict[str, Any] = json.loads((out / "compare.json").read_text())
    return {**found, "folder": out}


def test_a_method_that_never_moved_is_not_taken_for_a_success(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found, label = still(tmp_path), "scaling:sound:adaptive"
    motion = pq.read_table(found["folder"] / "demo" / "motion_scaling_sound_adaptive.parquet").to_pandas()
    assert not motion[[f"dq{i}" for i in range(1, 7)]].to_numpy().any()
    for row in (found["logs"][0]["methods"][label], found["total"][label]):
        assert (row["touch_ticks"], row["still_logs"], row["stillness"]) == (0, 1, "never moved")
    assert found["total"]["none"]["stillness"] is None
    said = capsys.readouterr().err
    lines = said.splitlines()
    (at,) = [i for i, line in enumerate(lines) if label in line and "\u2013" in line]  # nothing is nearest in motion
    assert "(never moved)" in lines[at + 1]
    assert f"| {label} | 0 (never moved) |" in (found["folder"] / "compare.md").read_text()
    with (found["folder"] / "compare.csv").open() as file:
        assert {row["variant"]: row["stillness"] for row in csv.DictReader(file)} == {"none": "", label: "never moved"}
    legend = planning.methods(found).axes[0].get_legend()
    assert legend is not None
    assert any("scaling" in t.get_text() and "never moved" in t.get_text() for t in legend.get_texts())


def test_on_how_many_logs_a_method_made_no_way() -> None:
    row = {"still_logs": 1, "moving_ticks": 7}
    assert comparison.stillness(row, 1) == "made no progress"
    assert comparison.stillness({**row, "moving_ticks": 0}, 1) == "never moved"
    assert comparison.stillness(row, 3) == "no progress on 1 of 3 logs"
    assert comparison.stillness({**row, "still_logs": 3}, 3) == "made no progress"
    assert not comparison.stillness({"still_logs": 0, "moving_ticks": 900}, 3)


def test_brakings_are_counted_where_they_begin() -> None:
    status = ["tracking", "braking", "braking", "limited", "braking", "tracking", "braking"]
    table = pd.DataFrame(
        {"status": status, "reason": ["", "x", "y", "", "y", "", "x"], "tcp_speed": [1.0, 1, 0, 1, 0, 1, 1], "dq1": 0.0}
    )
    assert comparison.braking_events(table, 0.001) == {"x": 2}  # that of y began at rest


@pytest.mark.parametrize(
    ("text", "found_and_right"),
    [
        ("fast", ("'fast'", "qp", "scaling", "shield", "ssm", "none")),
        ("qp:all", ("'all'", "paper", "positions", "sound")),
        ("qp:sound:long", ("'long'", "adaptive", "fixed")),
        ("none:sound", ("none:sound", "METHOD")),
        ("qp:sound:fixed:4", ("qp:sound:fixed:4", "METHOD")),
    ],
)
def test_a_method_that_is_none_is_refused(text: str, found_and_right: tuple[str, ...]) -> None:
    with pytest.raises(SettingsError, match=facts("--methods", *found_and_right)):
        compare.parse(text, load_settings())


def test_the_preset_is_eight_methods() -> None:
    found = compare.parse(f"{compare.PRESET}, qp", load_settings())
    assert len(found) == 8
    assert found[4] == Variant("qp", "sound", "adaptive")


def smoothed_points(folder: Path) -> Floats:
    """(n, 20, 3) the smoothed person, NaN where no camera saw them lately."""
    table = pq.read_table(folder / "smooth.parquet").to_pandas()
    points = skeleton(table[list(JOINTS)].to_numpy(), table[list(LENGTHS)].to_numpy())
    seen = np.flatnonzero(table[[name for name in table if name.startswith("valid_")]].to_numpy().any(axis=1))
    t_ns, memory_ns = table["t_ns"].to_numpy(), 0.5e9
    for i in range(len(table)):
        before, after = seen[seen <= i], seen[seen >= i]
        if not len(before) or not len(after) or t_ns[after[0]] - t_ns[before[-1]] > memory_ns:
            points[i] = np.nan
    return points


class _Written(RunWriter):
    """A folder whose tables are there."""

    @property
    def partial(self) -> Path:
        return self.folder


@pytest.mark.parametrize("name", ["azure moving", "kinect 2 lines", "exp_box"])
def test_a_recording_with_the_robot_in_the_way_by_the_same_checker(tmp_path: Path, name: str) -> None:
    log, cell, config = bases.recorded(name, tmp_path)
    fused = replay.run("fuse", log, out=tmp_path / "fused", config=config, cell_file=cell, end_s=8.0)
    (states,) = read_states(fused / "state.parquet", 100_000)
    task = tmp_path / "task.toml"
    task.write_text(TASK)
    place = bases.with_base(cell, next(bases.bases(states)), tmp_path / "base.toml")
    out = compare.run(
        [fused],
        methods="none,scaling,shield,qp",
        out=tmp_path / "compared",
        processes=1,
        cell_file=place,
        overrides=(f"plan.task={task}",),
    )
    found = json.loads((out / "compare.json").read_text())
    (of_log,) = found["logs"]
    run_config = resolve("plan", fused, cell_file=place)
    base = assembly.robot_base(run_config, open_log(run_config.log, run_config.settings.logs))
    smoothed = smoothed_points(out / of_log["log"])
    people = read_recorded_people(
        run_config, open_log(run_config.log, run_config.settings.logs), _Written(out / of_log["log"])
    )
    assert {track.source for track in people.person} > {"smoothed estimate"}
    assert ("recorded" in of_log["methods"]) is name.startswith("exp_")  # by capsules: test_recorded_robot
    for label, row in of_log["methods"].items():
        if label == "recorded":
            continue
        motion = pq.read_table(out / of_log["log"] / f"motion_{label.replace(':', '_')}.parquet").to_pandas()
        cameras = [
            at_instants(track.t_ns, track.points_m, motion["t_ns"].to_numpy(), 0.1, 0.02) for track in people.person[1:]
        ]
        assert_agrees(row, checked(motion, [smoothed, *cameras], base), label.split(":")[0])
        assert label == "none" or row["touch_inside_ticks"] == 0
        assert row["uncertified_ticks"] == (row["moving_ticks"] if label == "none" else 0)
