"""Run folders as input that were not left as ours are: made by an earlier version, or changed since."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from hrcreplay.commands import audit, replay
from hrcreplay.errors import LogError
from hrcreplay.pipeline.run_config import resolve
from hrcreplay.store import run_folder
from hrcreplay.store.columns import COLUMNS, missing_columns
from tests.facts import facts, tells

#: What tables of the version before had not.
NEW = {
    "state.parquet": [name for name in COLUMNS["state"] if name.startswith(("residual_", "unseen_"))],
    "motion.parquet": ["programme_s", "reason"],
    "motion_scaling.parquet": ["programme_s", "reason"],
}


@pytest.fixture(scope="module")
def planned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return replay.run(
        "plan", replay.demo_log(), out=tmp_path_factory.mktemp("run_config") / "run", start_s=9.0, end_s=10.0
    )


def _aged(folder: Path, to: Path, *names: str, new: Mapping[str, Sequence[str]] = NEW) -> Path:
    """The same run as if a version had made it that knew no ``new`` columns in those tables."""
    shutil.copytree(folder, to)
    meta = run_folder.read_meta(to)
    for name in names:
        pq.write_table(pq.read_table(to / name).drop_columns(list(new[name])), to / name)
        meta["outputs"][name] = run_folder.sha256(to / name)
    (to / "run.json").write_text(json.dumps(meta))
    return to


def test_the_arguments_of_a_run_are_the_same_however_it_was_asked_for(planned: Path, tmp_path: Path) -> None:
    """So a page that shows them has the same bytes; and they hold no folder."""
    shared: Any = {"cell_file": None, "start_s": 9.0, "end_s": 10.0}
    file = tmp_path / "settings.toml"
    file.write_text(f'[plan]\nleash_m = 0.2\n[limits]\nprediction = "{tmp_path / "own.toml"}"\n')
    (tmp_path / "own.toml").write_text((resources.files("hrcreplay.limits") / "people.toml").read_text())
    overrides = (f"limits.prediction={tmp_path / 'own.toml'}", "plan.max_reference_lead_m=0.2")
    asked = [
        resolve("report", replay.demo_log(), config=file, overrides=(), **shared),
        resolve("report", replay.demo_log(), config=None, overrides=overrides, **shared),
        resolve("report", planned, config=None, overrides=overrides, cell_file=None, start_s=None, end_s=None),
    ]
    told = "report demo.mcap --start 9 --end 10 --smooth --set limits.prediction=own.toml "
    told += "--set plan.max_reference_lead_m=0.2"
    for run_config in asked:
        assert run_config.arguments(smooth=True) == told.split()
    plain = run_folder.read_meta(planned)["arguments"]
    assert plain == ["plan", "demo.mcap", "--start", "9", "--end", "10"]


def test_our_tables_lack_nothing(planned: Path) -> None:
    tables = sorted(planned.glob("*.parquet"))
    assert {path.stem for path in tables} >= set(COLUMNS) - {"contact", "severity"}, "those are of a report"
    for path in tables:
        assert missing_columns(path) == ()
        of_the_cell = re.compile(r"valid_.*|.*_point_.*|(q|dq|u)\d")
        own = {name for name in pq.read_schema(path).names if not of_the_cell.fullmatch(name)}
        assert own == set(COLUMNS[path.stem.split("_")[0]]), path


@pytest.mark.parametrize(
    ("table", "again"), [("state.parquet", ("fuse", "predict", "plan")), ("motion_scaling.parquet", ("plan",))]
)
def test_tables_of_an_earlier_version_are_computed_again(
    planned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], table: str, again: tuple[str, ...]
) -> None:
    old = _aged(planned, tmp_path / "old", table)
    new = replay.run("plan", old, out=tmp_path / "new")
    said = capsys.readouterr().err
    for stage in ("fuse", "predict", "plan"):
        outcome = (str(old / table), NEW[table][0], "computed again") if stage in again else ("taken over", str(old))
        assert tells(said.splitlines(), stage, *outcome)
    assert run_folder.read_meta(new)["outputs"] == run_folder.read_meta(planned)["outputs"]


def test_states_that_tell_nothing_of_the_legs_are_computed_again(
    planned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = _aged(planned, tmp_path / "old", "state.parquet", new={"state.parquet": ["residual_LEGS"]})
    assert missing_columns(old / "state.parquet") == ("residual_LEGS",)
    again = replay.run("predict", old, out=tmp_path / "new")
    said = capsys.readouterr().err
    assert tells(said.splitlines(), str(old / "state.parquet"), "residual_LEGS", "computed again")
    fresh = replay.run("predict", replay.demo_log(), out=tmp_path / "fresh", start_s=9.0, end_s=10.0)
    for name in ("state.parquet", "occupancy.parquet"):
        assert run_folder.sha256(again / name) == run_folder.sha256(fresh / name)
    assert run_folder.sha256(again / "state.parquet") == run_folder.sha256(planned / "state.parquet")


def _changed(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


@pytest.mark.parametrize("harm", [Path.unlink, _changed])
def test_tables_that_were_changed_since_are_computed_again(
    planned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], harm: Callable[[Path], None]
) -> None:
    shutil.copytree(planned, tmp_path / "old")
    harm(tmp_path / "old" / "state.parquet")
    new = replay.run("plan", tmp_path / "old", out=tmp_path / "new")
    assert tells(capsys.readouterr().err.splitlines(), "fuse", "state.parquet", "computed again")
    assert run_folder.read_meta(new)["outputs"] == run_folder.read_meta(planned)["outputs"]


def test_an_audit_takes_an_old_run(planned: Path, tmp_path: Path) -> None:
    old = _aged(planned, tmp_path / "old", "state.parquet")
    found = json.loads((audit.run([old], out=tmp_path / "audit") / "audit.json").read_text())
    assert found["logs"][0]["log"] == "demo"


@pytest.mark.parametrize("key", ["inputs", "settings", "cell", "task", "span_s"])
def test_a_run_that_does_not_tell_how_it_was_made_is_refused(planned: Path, tmp_path: Path, key: str) -> None:
    shutil.copytree(planned, tmp_path / "old")
    meta = run_folder.read_meta(planned)
    del meta[key]
    (tmp_path / "old" / "run.json").write_text(json.dumps(meta))
    with pytest.raises(LogError, match=facts("old", "run.json", key, "log")):
        replay.run("plan", tmp_path / "old", out=tmp_path / "new")
    assert not (tmp_path / "new").exists()
