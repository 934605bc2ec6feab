"""What is stored of the volumes: which ticks, which rows, and whose."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from hrcreplay.pipeline.stored_volumes import StoredVolumes, select_stored_ticks, store_volumes
from hrcreplay.records import SweptVolumes


class Kept:
    """The rows of tables, in memory."""

    def __init__(self) -> None:
        self.columns: dict[str, list[Any]] = {}

    def table(self, name: str, columns: Mapping[str, Any], /) -> None:
        assert name == "occupancy"
        for key, values in columns.items():
            part = values.to_pylist() if hasattr(values, "to_pylist") else np.asarray(values).tolist()
            self.columns.setdefault(key, []).extend(part)


def balls(first_ns: int) -> SweptVolumes:
    """Three ticks with a head and a trunk, each a ball 2 m above the floor; the second tick's trunk is not known."""
    vertices_m = np.arange(6.0)[:, None] + np.array([0.0, 0.0, 2.0])
    vertices_m[3] = np.nan
    radius_m = np.array([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]])
    t_ns = first_ns + np.arange(3, dtype=np.int64)
    return SweptVolumes(t_ns, np.arange(7), vertices_m, radius_m, ("HD", "THX"), "sound")


def test_rows_parts_people_and_horizons_are_those_asked_for() -> None:
    kept = Kept()
    first = StoredVolumes(balls(100), 0.2, person=np.array([1, 2, 3]), rows=np.array([1, 2]))
    store_volumes([first, StoredVolumes(balls(200), 0.3, person=np.array([4, 5, 6]))], kept)
    assert kept.columns["t_ns"] == [101, 102, 102, 200, 200, 201, 202, 202], "a limb that is not known has no row"
    assert kept.columns["limb"] == ["HD", "HD", "THX", "HD", "THX", "HD", "HD", "THX"]
    assert kept.columns["person"] == [2, 3, 3, 4, 4, 5, 6, 6]
    assert kept.columns["horizon_s"] == [0.2] * 3 + [0.3] * 5
    radius_m = np.array([0.3, 0.5, 0.6, 0.1, 0.2, 0.3, 0.5, 0.6])
    assert kept.columns["radius_m"] == radius_m.tolist()
    np.testing.assert_allclose(kept.columns["volume_m3"], 4.0 / 3.0 * np.pi * radius_m**3, rtol=1e-12)
    assert kept.columns["vertices"][0] == [2.0, 2.0, 4.0]


def test_one_person_has_no_number_and_nobody_has_no_rows() -> None:
    kept = Kept()
    store_volumes([StoredVolumes(balls(0), 0.2, rows=np.zeros(0, np.int64))], kept)
    assert not kept.columns
    store_volumes([StoredVolumes(balls(0), 0.2)], kept)
    assert "person" not in kept.columns
    assert len(kept.columns["t_ns"]) == 5


@pytest.mark.parametrize("every", [1.0, 2.5, 10.0, np.inf])
def test_ticks_are_stored_evenly_whatever_the_batches(every: float) -> None:
    whole = select_stored_ticks(0, 100, every).tolist()
    parts = [first + k for first, size in ((0, 7), (7, 60), (67, 33)) for k in select_stored_ticks(first, size, every)]
    assert parts == whole
    assert len(whole) == (0 if np.isinf(every) else round(100 / every))
