"""An array in a file, beside the same array in memory."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.store.stored_array import StoredArray


def test_its_rows_are_those_that_were_appended(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    parts = [np.asfortranarray(rng.normal(size=(n, 4, 3))) for n in (3, 0, 1, 20)]
    whole, stored = np.concatenate(parts), StoredArray(tmp_path, (4, 3))
    for part in parts:
        stored.append(part)
    assert len(stored) == len(whole) == 24
    assert stored.shape == whole.shape
    for rows in (slice(None), slice(2, 7), slice(5, 5), slice(20, 90), slice(-3, None), np.array([23, 0, 7, 7])):
        np.testing.assert_array_equal(stored[rows], whole[rows])
    found = stored[:]
    found[0] = 7.0
    np.testing.assert_array_equal(stored[:1], whole[:1], "a copy")


def test_another_process_reads_the_same_file(tmp_path: Path) -> None:
    stored = StoredArray(tmp_path, (2,))
    stored.append(np.array([[1.0, np.nan], [-0.0, 2.0]]))
    sent = pickle.dumps(stored)
    assert len(sent) < 300, "not its rows"
    np.testing.assert_array_equal(pickle.loads(sent)[:], stored[:])  # noqa: S301 - our own


def test_without_rows_it_is_empty(tmp_path: Path) -> None:
    stored = StoredArray(tmp_path, (20, 3))
    assert stored.shape == (0, 20, 3)
    assert stored[:].shape == stored[np.zeros(0, np.int64)].shape == (0, 20, 3)


def test_rows_of_another_shape_are_refused(tmp_path: Path) -> None:
    stored = StoredArray(tmp_path, (20, 3))
    with pytest.raises(ValueError, match=r"rows of shape \(19, 3\); would be right: \(20, 3\)"):
        stored.append(np.zeros((5, 19, 3)))
    assert len(stored) == 0
