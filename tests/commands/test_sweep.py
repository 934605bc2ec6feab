"""A sweep makes the same runs as single commands, on workers that die and on a scheduler by its address."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from hrcreplay.commands import replay, sweep
from hrcreplay.commands.sweep_worker import FAILED, FUSED, RUNS
from hrcreplay.errors import EXIT_INTERRUPTED, LogError, SettingsError
from hrcreplay.reporting import sweep_report
from hrcreplay.reporting.sweep_report import SweepRow, select_front
from hrcreplay.store.results import WORK

SPAN: Any = {"start_s": 8.0, "end_s": 12.0}
GRID = ["plan.method=qp,scaling"]
LOG = str(replay.demo_log())


def outputs(folder: Path) -> dict[str, str]:
    found: dict[str, str] = json.loads((folder / "run.json").read_text())["outputs"]
    return found


def test_a_grid_gives_every_combination_once() -> None:
    found = sweep.combine("plan", ["plan.method=qp, scaling,qp", "fusion.rate_hz=100,250"], ["1,0,0,90", "2,0,0,0"])
    assert [tuple(one.values.values()) for one in found] == [
        (method, rate, base)
        for method in ("qp", "scaling")
        for rate in ("100", "250")
        for base in ("1,0,0,90", "2,0,0,0")
    ]
    last = found[-1].run_config
    assert (last.settings.plan.method, last.settings.fusion.rate_hz) == ("scaling", 250.0)
    assert last.cell is not None
    np.testing.assert_allclose(
        np.asarray(last.cell.T_world_base), [[1, 0, 0, 2], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    )
    assert len({one.name for one in found}) == len(found)


def test_runs_go_log_by_log_and_the_longest_first() -> None:
    settings = sweep.combine("plan", ["plan.method=none,qp,ssm", "plan.clearance_m=0,0.05"], [])
    tasks = sweep.make_tasks(["b.mcap", "a.mcap"], settings, 250)
    found = [(task.log, task.run_config.settings.plan.method) for task in sweep.in_order(tasks)]
    assert found == [
        (log, method) for log in ("b.mcap", "a.mcap") for method in ("qp", "ssm", "none") for _ in range(2)
    ]
    assert sorted(task.name for task in sweep.in_order(tasks)) == sorted(task.name for task in tasks)


def test_values_with_commas_inside_stay_whole() -> None:
    found = sweep.combine("plan", ['plan.baselines=["none","scaling"],["ssm"]'], [])
    assert [one.run_config.settings.plan.baselines for one in found] == [("none", "scaling"), ("ssm",)]


@pytest.mark.parametrize(
    "grid", [["plan.method"], ["method=qp"], ["plan.method=qp", "plan.method=none"], ["plan.method=fly"], ["plan.x=1"]]
)
def test_a_grid_that_cannot_be_used_is_refused(grid: list[str], tmp_path: Path) -> None:
    with pytest.raises(SettingsError):
        sweep.run([LOG], grid=grid, out=str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_missing_log_is_refused_before_anything_starts(tmp_path: Path) -> None:
    with pytest.raises(LogError):
        sweep.run([LOG, str(tmp_path / "no.mcap")], grid=GRID, out=str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_the_front_holds_what_nothing_beats() -> None:
    points = np.random.default_rng(1).integers(0, 12, (60, 2)).astype(float)
    front = select_front([None, *map(tuple, points.tolist())])
    for i, point in enumerate(points):
        beaten = any((other >= point).all() and (other > point).any() for other in points)
        assert (i + 1 in front) is not beaten


def test_a_setting_that_lacks_the_hardest_log_is_not_on_the_front() -> None:
    paces = {"easy": (0.9, 0.5), "hard": (0.2, 0.4)}
    for missing, best in ((None, [1, 0]), (("hard", 0), [1]), (("broken", None), [1, 0])):
        rows = []
        for log, pace in {**paces, "broken": (None, None)}.items():
            for setting in (0, 1):
                lacks = log == "broken" or missing == (log, setting)
                given = {**dict.fromkeys(field.name for field in sweep_report.FIELDS), "touch_ticks": 0}
                given |= {"ticks": 10, "known_ticks": 9, "pace": pace[setting], "nearest_moving_m": 0.1 + 0.1 * setting}
                rows.append(SweepRow(log, setting, f"{log}/{setting}", None if lacks else given, None, "bad" * lacks))
        totals = [  # as means over the logs that are there
            {
                **dict.fromkeys(field.name for field in sweep_report.FIELDS),
                "touch_ticks": 0,
                "ticks": 20,
                "known_ticks": 18,
                "pace": float(np.mean([row.figures["pace"] for row in rows if row.setting == n and row.figures])),
                "nearest_moving_m": 0.1 + 0.1 * n,
            }
            for n in (0, 1)
        ]
        front = sweep_report.find_front(rows, totals)
        assert front == best
        page = sweep_report.render(rows, [{"plan.method": "qp"}, {"plan.method": "ssm"}], totals, front, "<svg></svg>")
        assert ("lack a log" in page) == (missing == ("hard", 0))
        assert "known at 36 of 40 ticks" in page
        assert "touched somebody" not in page


def test_costs_are_told_per_hour_of_log() -> None:
    costs = [
        {"seconds": 30.0, "log_seconds": 60.0, "peak_mb": 600.0, "bytes": 5e6},
        {"seconds": 60.0, "log_seconds": 120.0, "peak_mb": 800.4, "bytes": 15e6},
        None,
    ]
    rows = [SweepRow("log", n, f"log/{n}", None, cost, "") for n, cost in enumerate(costs)]
    told = "an hour of log with one setting costs 0.50 hours of a worker and 0.40 GB of results"
    told = f"beside the fusion that settings share, {told}"
    assert sweep_report.cost_text(rows) == f"{told}; a worker needs at most 800 MB"
    assert sweep_report.cost_text(rows[2:]) == ""


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, str]]:
    """Digests of single runs, by method."""
    folder = tmp_path_factory.mktemp("single")
    return {
        method: outputs(
            replay.run("plan", Path(LOG), out=folder / method, overrides=(f"plan.method={method}",), **SPAN)
        )
        for method in ("qp", "scaling")
    }


def runs_of(out: Path) -> dict[str, dict[str, str]]:
    return {
        method: outputs(out / RUNS / "demo" / f"plan.method={method}")
        for method in ("qp", "scaling")
        if (out / RUNS / "demo" / f"plan.method={method}").exists()
    }


def test_runs_equal_single_runs_and_failed_ones_stop_nothing(single: dict[str, Any], tmp_path: Path) -> None:
    broken, out = tmp_path / "broken.mcap", tmp_path / "out"
    broken.write_bytes(b"no log" * 100)
    found = sweep.run([str(broken), LOG], grid=GRID, command="plan", out=str(out), workers=2, **SPAN)
    assert set(found.failed) == {"broken/plan.method=qp", "broken/plan.method=scaling"}
    assert runs_of(out) == single
    assert (out / FAILED / "broken" / "plan.method=qp.txt").read_text().startswith(str(broken))
    assert not (out / FUSED).exists() or not list((out / FUSED / "demo").iterdir())
    assert not (out / WORK).exists()
    rows = list(csv.DictReader((out / "sweep.csv").open()))
    assert [(row["log"], row["plan.method"], bool(row["error"])) for row in rows] == [
        *(("broken", method, True) for method in single),
        *(("demo", method, False) for method in single),
        *(("all", method, False) for method in single),
    ]
    assert rows[2]["pace"] == rows[4]["pace"] != ""
    page = (out / "sweep.html").read_text()
    assert "plan.method=qp" in page
    assert "contact was not looked at" in page, "these are runs of plan"
    made = {path: path.stat().st_mtime_ns for path in (out / RUNS).rglob("run.json")}
    again = sweep.run([str(broken), LOG], grid=GRID, command="plan", out=str(out), workers=1, **SPAN)
    assert set(again.failed) == set(found.failed)
    assert {path: path.stat().st_mtime_ns for path in (out / RUNS).rglob("run.json")} == made
    with pytest.raises(SettingsError, match="span_s"):
        sweep.run([LOG], grid=GRID, command="plan", out=str(out), workers=1, start_s=8.0, end_s=11.0)


def start(*arguments: str) -> subprocess.Popen[str]:
    code = "from hrcreplay.cli.app import main; main()"
    return subprocess.Popen(
        [sys.executable, "-c", code, "sweep", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def wait_for_work(out: Path, process: subprocess.Popen[str]) -> None:
    """Waits until a worker is making a run."""
    for _ in range(1200):
        if process.poll() is not None or list(out.glob(f"{WORK}/*/run.partial")):
            return
        time.sleep(0.05)


def test_a_killed_worker_loses_no_run(single: dict[str, Any], tmp_path: Path) -> None:
    out = tmp_path / "out"
    plain = [LOG, "--grid", GRID[0], "--command", "plan", "--start", "8", "--end", "12", "--out", str(out)]
    process = start(*plain, "--workers", "1")
    wait_for_work(out, process)
    assert process.poll() is None
    workers = [
        child for child in psutil.Process(process.pid).children(recursive=True) if not child.children() and busy(child)
    ]
    assert workers
    for worker in workers:
        worker.send_signal(signal.SIGKILL)
    _, told = process.communicate(timeout=300)
    assert process.returncode == 0, told
    assert runs_of(out) == single
    assert not (out / WORK).exists()


def busy(process: psutil.Process) -> bool:
    """True for the processes of workers, not for the helper of multiprocessing that watches shared resources."""
    return "spawn_main" in " ".join(process.cmdline())


def test_ctrl_c_leaves_whole_runs_and_the_next_call_makes_the_rest(single: dict[str, Any], tmp_path: Path) -> None:
    out = tmp_path / "out"
    plain = [LOG, "--grid", GRID[0], "--command", "plan", "--start", "8", "--end", "12", "--out", str(out)]
    process = start(*plain, "--workers", "1")
    wait_for_work(out, process)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=300)
    assert process.returncode == EXIT_INTERRUPTED, told
    assert all(single[method] == found for method, found in runs_of(out).items())
    assert not list(out.glob(f"{RUNS}/demo/*.partial"))
    assert not sweep.run([LOG], grid=GRID, command="plan", out=str(out), workers=1, **SPAN).failed
    assert runs_of(out) == single


@contextmanager
def cluster(folder: Path) -> Iterator[str]:
    """The address of a scheduler with one worker, each a process of its own."""
    file = folder / "scheduler.json"
    quiet: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": folder, "env": os.environ}
    commands = (["dask_scheduler", "--port", "0"], ["dask_worker", "--nworkers", "1", "--nthreads", "1"])
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{name}", *how, "--no-dashboard", "--scheduler-file", str(file)],
            **quiet,
        )
        for name, *how in commands
    ]
    try:
        while not file.exists():
            time.sleep(0.1)
        yield json.loads(file.read_text())["address"]
    finally:
        for process in reversed(processes):
            process.terminate()
            process.wait()


def test_a_scheduler_by_its_address_and_results_by_url(single: dict[str, Any], tmp_path: Path) -> None:
    out = tmp_path / "out"
    with cluster(tmp_path) as address:
        found = sweep.run([f"file://{LOG}"], grid=GRID, command="plan", out=f"file://{out}", scheduler=address, **SPAN)
    assert not found.failed
    assert runs_of(out) == single
    assert (out / "sweep.html").exists()


def test_no_scheduler_at_an_address_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep, "_ANSWER_S", 1)
    with pytest.raises(SettingsError, match="--scheduler"):
        sweep.run([LOG], grid=GRID, out=str(tmp_path / "out"), scheduler="tcp://127.0.0.1:9", **SPAN)
