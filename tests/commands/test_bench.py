"""``bench`` times every stage and every reference, and its dense problem is the one that it says it is."""

from __future__ import annotations

import json
from typing import Any

import daqp
import numpy as np
import pytest
from rich.console import Console
from scipy.optimize import minimize

from hrcreplay.commands import bench, replay
from hrcreplay.errors import SettingsError
from hrcreplay.robot.control.separation import obstacles
from hrcreplay.robot.model import irb140
from tests.robot.people import cloud, volumes


def test_every_stage_and_reference_is_timed() -> None:
    how: Any = {"seconds": 0.3, "start_s": 8.0, "cell_file": replay.demo_cell()}
    found = bench.run(replay.demo_log(), **how)
    rows = {row.name: row for row in found.rows}
    assert {"angles", "fuse", "predict", "plan qp", "plan none", "hulls"} <= set(rows)
    assert {"decision of qp", "volumes of a decision"} < set(rows)
    assert rows["volumes of a decision"].mean_us < rows["decision of qp"].mean_us, "a part of it"
    assert {"filterpy: dense filter", "filterpy: smoother", "smoother", "qhull: hulls of their vertices"} < set(rows)
    assert rows["fuse"].ticks == 76  # 0.3 s at 250 Hz, both ends
    assert rows["fuse"].batch_median_us == pytest.approx(rows["fuse"].mean_us), "all of it is one batch"
    for row in found.rows:
        assert 0.0 < row.median_us <= row.p99_us <= row.max_us
        assert row.real_time_factor == pytest.approx(4000.0 / row.mean_us)
        assert row.batch_median_us > 0.0
    assert found.peak_mb > 50.0
    assert json.loads(json.dumps(found.to_dict()))["rows"][0]["name"] == found.rows[0].name
    console = Console(width=160, record=True, quiet=False)
    bench.print_table(found, console)
    text = console.export_text()
    assert all(row.name in text for row in found.rows)


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), 1e9])
def test_a_length_that_cannot_be_used_is_refused(seconds: float) -> None:
    with pytest.raises(SettingsError, match="--seconds"):
        bench.run(replay.demo_log(), seconds=seconds)


def test_the_dense_problem_is_solved_as_by_another_solver() -> None:
    rng = np.random.default_rng(3)
    robot = irb140(np.eye(4), stop_s=0.4)
    q, dq = np.array([0.3, 0.2, -0.4, 0.5, 0.6, -0.7]), np.array([-0.4, 0.2, -0.3, -0.5, 0.4, -0.2])
    seen = obstacles(volumes([cloud(rng, 30, np.array([0.2, 0.2, 0.4])) + np.array([0.9, 0.1, 0.5])]), 0)
    H, g, A, top, low = bench.dense_problem(robot, q, dq, seen)
    pose = robot.pose(q, dq)
    assert len(A) == 2 * len(pose.ends_m) * len(seen.vertices_m)
    step = 1e-6
    for end in range(2):  # a row is half the rate of the squared distance from a vertex, against finite differences
        moved = robot.pose(q + step * dq, dq)
        for link in range(len(pose.ends_m)):
            of_end = A[(2 * link + end) * len(seen.vertices_m) :][: len(seen.vertices_m)]
            before, after = (seen.vertices_m - one.ends_m[link, end] for one in (pose, moved))
            rate = ((after**2).sum(axis=1) - (before**2).sum(axis=1)) / (2 * step)
            np.testing.assert_allclose(of_end @ dq, -rate, atol=1e-5)
    top[6:] = 0.02  # so that rows hold the solution back
    found = daqp.solve(H, g, A, top, low)
    assert found[2] == 1
    assert np.linalg.norm(found[0] - dq) > 0.1
    bounds = list(zip(low[:6], top[:6], strict=True))
    rows = {"type": "ineq", "fun": lambda w: top[6:] - A @ w, "jac": lambda _: -A}
    best = minimize(
        lambda w: 0.5 * w @ H @ w + g @ w,
        np.zeros(6),
        jac=lambda w: H @ w + g,
        bounds=bounds,
        constraints=rows,
        options={"ftol": 1e-14},
    )
    np.testing.assert_allclose(found[0], best.x, atol=1e-4)
