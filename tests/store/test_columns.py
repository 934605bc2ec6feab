from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.records import DOF, HumanStates
from hrcreplay.store import columns
from hrcreplay.store.columns import read_states, read_states_at, state_columns
from hrcreplay.store.run_folder import FolderTables, TableWriter
from tests.human.people import states

#: Fields of the states that are integers, booleans or names.
NOT_NUMBERS = ("t_ns", "valid", "cameras", "person")


def test_every_field_of_the_states_is_read_as_it_was_written(tmp_path: Path) -> None:
    rng = np.random.default_rng(9)
    plain = states(rng.normal(size=(30, DOF)), rng.normal(size=(30, DOF)))
    plain = replace(plain, legs_sway_m=plain.frame_age_s, camera_points_m=plain.points_m[:, None])
    plain = replace(plain, nobody_s=plain.frame_age_s, nobody_else_s=plain.frame_age_s, person=1 + np.arange(30))
    numbers = {name: rng.normal(size=np.shape(part)) for name, part in vars(plain).items() if name not in NOT_NUMBERS}
    written = replace(plain, **numbers)
    tables = FolderTables(tmp_path)
    tables.table("state", state_columns(written))
    tables.close_tables()
    found = HumanStates.join(list(read_states(tmp_path / "state.parquet", 1000)))
    for name, value in vars(written).items():
        assert value is not None, name
        np.testing.assert_array_equal(getattr(found, name), value, err_msg=name)


@pytest.mark.parametrize("people", [1, 2])
def test_the_states_of_some_ticks_are_read_from_any_group_of_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, people: int
) -> None:
    monkeypatch.setattr(TableWriter, "ROWS", 16)
    rng = np.random.default_rng(8)
    every = states(rng.normal(size=(120, DOF)), rng.normal(size=(120, DOF)))
    t_ns = 4_000_000 * (np.arange(120) // people)
    every = replace(every, t_ns=t_ns, person=None if people == 1 else 1 + np.arange(120) % 2)
    tables = FolderTables(tmp_path)
    tables.table("state", state_columns(every))
    tables.close_tables()
    path = tmp_path / "state.parquet"
    whole = HumanStates.join(list(read_states(path, 1000)))
    for wanted in ([0], [t_ns[17], t_ns[16], t_ns[95]], [t_ns[-1]], [1], t_ns.tolist()):
        found, right = read_states_at(path, np.array(wanted)), whole.rows(np.isin(whole.t_ns, wanted))
        assert vars(found).keys() == vars(right).keys()
        for name, value in vars(right).items():
            np.testing.assert_array_equal(getattr(found, name), value, err_msg=name)


@pytest.mark.parametrize("people", [1, 3])
@pytest.mark.parametrize("size", [1, 5, 1000])
def test_states_are_read_in_pieces_that_divide_no_tick(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, people: int, size: int
) -> None:
    """Ends of pieces, of what is read together and of groups of rows all lie within ticks."""
    monkeypatch.setattr(columns, "_ROWS", 7)
    monkeypatch.setattr(TableWriter, "ROWS", 16)
    rng = np.random.default_rng(5)
    every = states(rng.normal(size=(60, DOF)), rng.normal(size=(60, DOF)))
    t_ns, person = 4_000_000 * (np.arange(60) // people), 1 + np.arange(60) % 3
    every = replace(every, t_ns=t_ns, person=None if people == 1 else person)
    tables = FolderTables(tmp_path)
    tables.table("state", state_columns(every))
    tables.close_tables()
    pieces = list(read_states(tmp_path / "state.parquet", size))
    assert max(len(piece) for piece in pieces) < size + people
    firsts = [int(piece.t_ns[0]) for piece in pieces]
    assert all(before.t_ns[-1] < first for before, first in zip(pieces, firsts[1:], strict=False))
    found = HumanStates.join(pieces)
    np.testing.assert_array_equal(found.p, every.p)
    np.testing.assert_array_equal(found.t_ns, t_ns)
    np.testing.assert_array_equal(found.numbers, person if people > 1 else np.ones(60))
