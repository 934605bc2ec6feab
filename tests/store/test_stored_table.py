"""A table read from its file column by column, beside the same table in pandas."""

from __future__ import annotations

import gc
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hrcreplay.store import stored_table
from hrcreplay.store.stored_table import RunTable, StoredTable, in_parts, number_columns, rows_where, text_column

N, GROUP = 1000, 64


@pytest.fixture
def tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[StoredTable, pd.DataFrame]:
    """The same table stored in groups of rows, few of which are read together, and in memory."""
    monkeypatch.setattr(stored_table, "_GROUPS", 3)
    rng = np.random.default_rng(3)
    frame = pd.DataFrame(
        {
            "t_ns": np.arange(N, dtype=np.int64) * 4_000_000,
            "person": np.arange(N, dtype=np.int64) % 3 + 1,
            "distance_m": np.where(rng.random(N) < 0.1, np.nan, rng.normal(size=N)),
            "limb": np.array(["HD", "THX", None])[rng.integers(0, 3, N)],
            "moving": rng.random(N) < 0.5,
        }
    )
    path = tmp_path / "table.parquet"
    pq.write_table(pa.Table.from_pandas(frame, preserve_index=False), path, row_group_size=GROUP)
    return StoredTable(path), pq.read_table(path).to_pandas()


def same(stored: RunTable, frame: pd.DataFrame) -> None:
    """All columns, names, types and values."""
    assert list(stored.columns) == list(frame.columns)
    assert len(stored) == len(frame)
    assert stored.empty == frame.empty
    pd.testing.assert_frame_equal(stored[list(frame.columns)], frame.reset_index(drop=True))
    for name in frame:
        pd.testing.assert_series_equal(stored[str(name)], frame[name].reset_index(drop=True))


def test_it_is_the_table_that_was_stored(tables: tuple[StoredTable, pd.DataFrame]) -> None:
    stored, frame = tables
    same(stored, frame)
    assert "limb" in stored
    assert "link" not in stored
    with pytest.raises(KeyError, match="link"):
        stored["link"]


@pytest.mark.parametrize("share", [0.0, 0.002, 0.3, 1.0])
def test_a_mask_of_a_mask_keeps_the_same_rows(tables: tuple[StoredTable, pd.DataFrame], share: float) -> None:
    stored, frame = tables
    mask = np.random.default_rng(4).random(N) < share
    same(stored[mask], frame[mask])
    inner = frame["moving"].to_numpy()[mask]
    same(stored[mask][inner], frame[mask][inner])
    assert stored[mask][inner].iloc[:3].equals(frame[mask][inner].iloc[:3].reset_index(drop=True))


def test_a_mask_of_few_groups_reads_the_same_as_one_of_all(tables: tuple[StoredTable, pd.DataFrame]) -> None:
    stored, frame = tables
    for first, last in ((0, 10), (60, 70), (500, 640), (0, N), (N - 1, N)):
        mask = (np.arange(N) >= first) & (np.arange(N) < last)
        same(stored[mask], frame[mask])


def test_the_parts_of_a_table_follow_each_other(tables: tuple[StoredTable, pd.DataFrame]) -> None:
    stored, frame = tables
    few, none = (np.arange(N) % 5 == 0) & (np.arange(N) > 400), np.zeros(N, dtype=np.bool_)
    names = ["moving", "distance_m"]
    for table, whole in ((stored, frame), (stored[few], frame[few]), (stored[none], frame[none]), (frame, frame)):
        parts = list(in_parts(table, names))
        assert all(list(part.columns) == names for part in parts)
        assert max(map(len, parts)) <= (len(frame) if isinstance(table, pd.DataFrame) else 3 * GROUP)
        pd.testing.assert_frame_equal(pd.concat(parts, ignore_index=True), whole[names].reset_index(drop=True))
    for table, absent in ((stored, "link"), (stored.assign(limb="HD"), "limb"), (frame, "link")):
        with pytest.raises(KeyError, match=absent):
            list(in_parts(table, ["moving", absent]))


def test_columns_of_a_long_run_leave_nothing_freed_behind(
    tables: tuple[StoredTable, pd.DataFrame], monkeypatch: pytest.MonkeyPatch
) -> None:
    stored, frame = tables
    given_back: list[int] = []
    monkeypatch.setattr(stored_table, "release_freed_memory", lambda: given_back.append(1))
    monkeypatch.setattr(stored_table, "_LAST", stored_table._LastColumns())
    assert stored["t_ns"].tolist() == frame["t_ns"].tolist()
    assert not given_back
    monkeypatch.setattr(stored_table, "_LONG_BYTES", 8 * N - 1)
    for _ in range(2):  # the second time it is kept
        assert stored["person"].tolist() == frame["person"].tolist()
        assert len(given_back) == 1


def test_nobody_changes_a_column_that_is_kept(tables: tuple[StoredTable, pd.DataFrame]) -> None:
    stored, frame = tables
    for name in ("t_ns", "distance_m", "moving"):
        with pytest.raises(ValueError, match="read-only"):
            stored[name].to_numpy()[0] = 1
        changed = stored[[name]]
        changed.iloc[0, 0] = frame[name].iloc[1]
        pd.testing.assert_series_equal(stored[name], frame[name])


def test_parts_of_an_empty_table_have_its_columns(tmp_path: Path) -> None:
    schema = pa.schema({"t_ns": pa.int64(), "x": pa.float64()})
    pq.write_table(schema.empty_table(), tmp_path / "rows.parquet")
    pq.ParquetWriter(tmp_path / "groups.parquet", schema).close()
    for path in (tmp_path / "rows.parquet", tmp_path / "groups.parquet"):
        parts = list(in_parts(StoredTable(path), ["x"]))
        assert sum(map(len, parts)) == 0
        assert all(list(part.columns) == ["x"] for part in parts)
        assert len(StoredTable(path)["x"]) == 0


def test_rows_by_their_places(tables: tuple[StoredTable, pd.DataFrame]) -> None:
    stored, frame = tables
    mask = frame["person"].to_numpy() == 2
    for table, whole in ((stored, frame), (stored[mask], frame[mask])):
        for places in (slice(5, 9), slice(None, None, 100), slice(-3, None), np.array([0, 63, 64, 300])):
            pd.testing.assert_frame_equal(table.iloc[places], whole.iloc[places].reset_index(drop=True))
        for place in (0, 64, -1):
            assert table.iloc[place].to_dict() == pytest.approx(whole.iloc[place].to_dict(), nan_ok=True)
    with pytest.raises(IndexError):
        stored.iloc[N]
    for places in (slice(None, None, -1), np.array([3, 3])):
        with pytest.raises(IndexError, match="ascend"):
            stored.iloc[places]


def test_columns_left_out_and_columns_made(tables: tuple[StoredTable, pd.DataFrame]) -> None:
    stored, frame = tables
    same(stored.drop(columns="person").reset_index(drop=True), frame.drop(columns="person"))
    named = np.array([f"row {i}" for i in range(N)], dtype=object)
    made, whole = stored.assign(limb=named.tolist()), frame.assign(limb=named)
    mask = frame["moving"].to_numpy()
    assert made["limb"].tolist() == named.tolist()
    assert made[mask]["limb"].tolist() == whole[mask]["limb"].tolist()
    assert made[["limb", "t_ns"]].iloc[7].to_dict() == whole[["limb", "t_ns"]].iloc[7].to_dict()
    assert made.iloc[3:5]["limb"].tolist() == ["row 3", "row 4"]
    assert made[mask].iloc[2]["limb"] == whole[mask].iloc[2]["limb"]
    new: dict[str, Any] = {"tcp_speed": 0.25, "overlap_m": np.linspace(0.0, 1.0, N)}
    same(stored.assign(**new), frame.assign(**new))
    same(stored[mask].assign(distance_m=0.5), frame[mask].assign(distance_m=0.5))


def test_of_all_files_it_keeps_no_more_than_it_may(
    tables: tuple[StoredTable, pd.DataFrame], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored, frame = tables
    path = tmp_path / "other.parquet"
    pq.write_table(pa.Table.from_pandas(frame, preserve_index=False), path)
    other, last = StoredTable(path), stored_table._LastColumns()
    number = {id(stored._file): "stored", id(other._file): "other"}
    monkeypatch.setattr(stored_table, "_KEPT_BYTES", 2 * 8 * N)
    monkeypatch.setattr(stored_table, "_LAST", last)

    def kept() -> list[tuple[str, str]]:
        return [(number[file], name) for file, name in last._kept]

    for name in [*frame.columns, *frame.columns[::-1]]:
        for table in (stored, other):
            pd.testing.assert_series_equal(table[name], frame[name])
            assert sum(column.nbytes for column in last._kept.values()) <= 2 * 8 * N or len(kept()) == 1
    assert kept() == [("stored", "t_ns"), ("other", "t_ns")]
    assert stored["t_ns"].tolist() == frame["t_ns"].tolist()
    assert other["person"].tolist() == frame["person"].tolist()
    assert kept() == [("stored", "t_ns"), ("other", "person")], "other t_ns was asked for before"


def test_columns_of_a_closed_table_are_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    last = stored_table._LastColumns()
    monkeypatch.setattr(stored_table, "_LAST", last)
    pq.write_table(pa.table({"t_ns": np.arange(5)}), tmp_path / "table.parquet")
    table = StoredTable(tmp_path / "table.parquet")
    assert table["t_ns"].tolist() == [0, 1, 2, 3, 4]
    assert len(last._kept) == 1
    rows = table[np.array([True, False, True, False, False])]
    del table
    gc.collect()
    assert len(last._kept) == 1, "the file is still open for the rows"
    del rows
    gc.collect()
    assert len(last._kept) == 0


def test_tables_of_one_file_share_it_and_one_written_anew_is_read_anew(tmp_path: Path) -> None:
    path = tmp_path / "table.parquet"
    pq.write_table(pa.table({"t_ns": np.arange(5)}), path)
    one, other = StoredTable(path), StoredTable(path)
    assert one._file is other._file
    before = one["t_ns"].tolist()
    path.unlink()
    pq.write_table(pa.table({"t_ns": np.arange(7)}), path)
    assert StoredTable(path)["t_ns"].tolist() == list(range(7)) != before


def test_tables_read_in_turn_are_each_their_own(tables: tuple[StoredTable, pd.DataFrame], tmp_path: Path) -> None:
    """Only the description of the file that was read last is kept; groups of rows of the two differ."""
    stored, frame = tables
    other = frame.iloc[::-1].reset_index(drop=True)
    pq.write_table(pa.Table.from_pandas(other, preserve_index=False), tmp_path / "other.parquet", row_group_size=100)
    reverse, few = StoredTable(tmp_path / "other.parquet"), np.arange(N) % 200 == 7
    for _ in range(2):
        same(stored[few], frame[few])
        same(reverse[few], other[few])
    assert stored_table._description.cache_info().currsize == 1


def test_a_table_of_some_rows_takes_a_bit_a_row(tables: tuple[StoredTable, pd.DataFrame]) -> None:
    """In a long run with many visitors each of them has such tables."""
    stored, frame = tables
    kept = [stored[frame["person"].to_numpy() == 1] for _ in range(100)]
    gc.collect()
    tracemalloc.start()
    kept += [stored[frame["person"].to_numpy() == 2] for _ in range(100)]
    taken, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(kept[-1]) == (frame["person"] == 2).sum()
    assert taken < 100 * N


def test_columns_of_numbers_are_those_of_the_table(tables: tuple[StoredTable, pd.DataFrame]) -> None:
    stored, frame = tables
    names = ["distance_m", "t_ns"]
    for table in (stored, frame):
        found = number_columns(table, names)
        np.testing.assert_array_equal(found, frame[names].to_numpy(dtype=float))
        assert found.flags.f_contiguous, "as pandas has them: sums of rows depend on it"
    with pytest.raises(KeyError, match="link"):
        number_columns(stored, ["link"])


def test_a_column_of_texts_has_each_text_once(tables: tuple[StoredTable, pd.DataFrame]) -> None:
    stored, frame = tables
    want = ["" if pd.isna(limb) else limb for limb in frame["limb"]]
    for table in (stored, frame):
        found = text_column(table, "limb")
        assert found.tolist() == want
        assert len({id(text) for text in found}) == 3


def test_the_rows_with_a_text_are_found_in_parts(tables: tuple[StoredTable, pd.DataFrame]) -> None:
    stored, frame = tables
    some = np.arange(N) % 7 < 3
    for table, whole in ((stored, frame), (stored[some], frame[some]), (frame, frame)):
        for text in ("HD", "THX", "nobody's"):
            found = rows_where(table, "limb", text)
            assert found["t_ns"].tolist() == whole.loc[whole["limb"] == text, "t_ns"].tolist()
    with pytest.raises(KeyError, match="link"):
        rows_where(stored, "link", "HD")
