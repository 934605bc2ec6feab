from __future__ import annotations

import hashlib
import json
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hrcreplay.errors import SettingsError
from hrcreplay.records import JOINTS
from hrcreplay.store import run_folder
from hrcreplay.store.run_folder import Run, TableWriter
from tests.facts import facts


def _columns(first: int, last: int) -> dict[str, np.ndarray]:
    t = np.arange(first, last)
    return {"t_ns": t, "x": np.sin(t / 7.0)}


@pytest.mark.parametrize("size", [1, 250, 5000, 10_000])
def test_table_bytes_do_not_depend_on_the_size_of_the_chunks(tmp_path: Path, size: int) -> None:
    def write(name: str, step: int) -> bytes:
        writer = run_folder.TableWriter(tmp_path / name)
        for first in range(0, 10_000, step):
            writer.write(_columns(first, min(first + step, 10_000)))
        writer.close()
        return (tmp_path / name).read_bytes()

    assert write("chunked", size) == write("whole", 777)


def test_every_nan_is_written_alike(tmp_path: Path) -> None:
    for name, nan in (("a", np.nan), ("b", -np.nan)):
        writer = run_folder.TableWriter(tmp_path / name)
        writer.write({"x": np.array([1.0, nan, 2.0])})
        writer.close()
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_digest_is_that_of_the_system_tool(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"abc" * 100_000)
    expected = subprocess.run(["sha256sum", str(path)], capture_output=True, text=True, check=True).stdout.split()[0]
    assert run_folder.sha256(path) == expected


def test_a_failed_run_leaves_no_empty_folders_but_those_of_others(tmp_path: Path) -> None:
    (tmp_path / "kept").mkdir()
    for name in ("kept/deep/run", "reports/log/run"):
        with pytest.raises(ZeroDivisionError), run_folder.RunWriter(tmp_path / name) as run:
            run.table("state", _columns(0, 10))
            raise ZeroDivisionError
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["kept"]
    with pytest.raises(ZeroDivisionError), run_folder.RunWriter(tmp_path / "reports/log/run"):
        (tmp_path / "reports/other").mkdir()  # by another run
        raise ZeroDivisionError
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["kept", "other", "reports"]


def test_a_run_appears_whole(tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "run"
    with run_folder.RunWriter(folder) as run:
        run.table("state", _columns(0, 10))
        run.text("figures/a.svg", "<svg/>")
        assert not folder.exists()
        assert json.loads((run.partial / "run.json").read_text())["complete"] is False
        run.finish({"command": "fuse"})
    meta = run_folder.read_meta(folder)
    assert meta["complete"] is True
    assert sorted(meta["outputs"]) == ["figures/a.svg", "state.parquet"]
    for name, digest in meta["outputs"].items():
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
    read = run_folder.read(folder)
    assert read.state is not None
    np.testing.assert_array_equal(read.state["x"], _columns(0, 10)["x"])
    assert read.motion is None


def test_a_failure_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), run_folder.RunWriter(tmp_path / "run") as run:
        run.table("state", _columns(0, 10))
        _ = 1 / 0
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_refused_untouched(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine").write_text("precious")
    with pytest.raises(SettingsError, match=facts("run", "exists", "--out")):
        run_folder.RunWriter(tmp_path / "run").__enter__()
    assert (tmp_path / "run" / "mine").read_text() == "precious"


def test_a_run_that_is_under_way_is_not_read_and_not_overwritten(tmp_path: Path) -> None:
    with run_folder.RunWriter(tmp_path / "run") as run:
        with pytest.raises(SettingsError, match=facts(run.partial.name, "did not end")):
            run_folder.read_meta(run.partial)
        with pytest.raises(SettingsError, match=facts("run.partial", "under way")):
            run_folder.RunWriter(tmp_path / "run").__enter__()


def test_stopwatch_spreads_a_call_over_its_ticks() -> None:
    now = iter([0, 10_000_000, 20_000_000, 50_000_000])
    watch = run_folder.Stopwatch(lambda: next(now))
    for ticks in (10, 1):
        with watch.stage("fuse", ticks):
            pass
    found = watch.summary(period_s=0.004)["fuse"]
    assert found["ticks"] == 11
    assert found["median_us"] == 1000.0  # 10 ticks shared 10 ms
    assert found["max_us"] == 30_000.0
    assert found["real_time_factor"] == pytest.approx(11 * 0.004 / 0.040)


@pytest.mark.parametrize("first", [0, 1, 4096, 9000])
def test_a_column_that_comes_late_gives_the_bytes_of_a_table_that_always_had_it(tmp_path: Path, first: int) -> None:
    """Rows before ``first`` are of person 1 and do not say so."""
    n = 10_000
    t_ns, person = np.arange(n), np.where(np.arange(n) < first, 1, 2)

    def write(path: Path, size: int, *, always: bool) -> bytes:
        table = TableWriter(path)
        for begin in range(0, n, size):
            rows = slice(begin, begin + size)
            named = always or (person[rows] != 1).any()
            columns = {"t_ns": t_ns[rows], "person": person[rows], "x": 0.5 * t_ns[rows]}
            table.write(columns if named else {name: columns[name] for name in ("t_ns", "x")})
        table.close()
        return path.read_bytes()

    late = write(tmp_path / "late.parquet", 250, always=False)
    assert late == write(tmp_path / "whole.parquet", 777, always=True)
    assert pq.read_table(tmp_path / "late.parquet")["person"].to_pylist() == person.tolist()


def test_a_column_that_comes_late_is_added_one_group_of_rows_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A whole table of an hour takes several gigabytes."""
    monkeypatch.setattr(TableWriter, "ROWS", 8)
    most, read = [0], pq.ParquetFile.read_row_group

    def counted(file: pq.ParquetFile, group: int) -> pa.Table:
        found = read(file, group)
        most[0] = max(most[0], len(found))
        return found

    monkeypatch.setattr(pq.ParquetFile, "read_row_group", counted)
    monkeypatch.setattr(pq, "read_table", lambda *_: pytest.fail("the whole table was read"))
    table = TableWriter(tmp_path / "late.parquet")
    for first in range(0, 100, 4):
        t_ns = np.arange(first, first + 4)
        table.write({"t_ns": t_ns} | ({"person": np.full(4, 2)} if first >= 90 else {}))
    table.close()
    assert most == [8]
    assert [path.name for path in tmp_path.iterdir()] == ["late.parquet"]
    with pq.ParquetFile(tmp_path / "late.parquet") as file:
        assert file.metadata.num_rows == 100
        assert file.read()["person"].to_pylist() == [1] * 92 + [2] * 8


def test_a_person_is_known_where_all_joints_are(tmp_path: Path) -> None:
    table = pd.DataFrame({"t_ns": np.arange(6), "person": [1, 2, 1, 2, 1, 2]} | dict.fromkeys(JOINTS, 0.5))
    table.loc[1, JOINTS[3]], table.loc[4, JOINTS[-1]] = np.nan, np.inf
    run = Run(tmp_path, {}, state=table)
    assert run.known.tolist() == [True, False, True, True, False, True]
    assert run.of_person(1).known.tolist() == [True, True, False]
    assert run.of_person(2).known.tolist() == [False, True, True]
    assert run.of_person(2) is run.of_person(2), "what it found is found once"
    assert Run(tmp_path, {}).known.tolist() == []
