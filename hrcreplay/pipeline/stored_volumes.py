"""The volumes of a run that are stored in occupancy.parquet, and at which ticks."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import product
from typing import NamedTuple

import numpy as np

from hrcreplay.geometry.inflated_hull import InflatedHull
from hrcreplay.pipeline.run_config import RunConfig
from hrcreplay.pipeline.surroundings import Forecast
from hrcreplay.records import FLOOR_Z_M, Floats, Ints, SweptVolumes
from hrcreplay.store.columns import occupancy_columns, with_person
from hrcreplay.store.run_folder import Tables


def store_every(run_config: RunConfig) -> float:
    """Number of ticks per tick whose volumes are stored."""
    store_hz = run_config.settings.prediction.store_hz
    return 1.0 if store_hz == "all" else max(1.0, run_config.settings.fusion.rate_hz / store_hz)


def select_stored_ticks(first: int, count: int, store_every: float) -> Ints:
    """Selects the ticks whose volumes are stored among ``count`` ticks from ``first`` on: one in ``store_every``."""
    if math.isinf(store_every):
        return np.zeros(0, np.int64)
    number = np.arange(first, first + count)
    return np.flatnonzero(np.floor(number / store_every) != np.floor((number - 1) / store_every))


class StoredVolumes(NamedTuple):
    """Volumes that are stored."""

    volumes: SweptVolumes  #: of any rows
    horizon_s: float  #: time after its tick until which each row holds [s]
    person: Ints | None = None  #: (n,) number of each row's person; None: person 1
    rows: Ints | None = None  #: rows to store; None: all


def store_volumes(parts: Iterable[StoredVolumes], tables: Tables) -> None:
    """Writes hull vertices and volume above the floor; a row without a person has none."""
    t_ns: list[int] = []
    limbs: list[str] = []
    radii: list[float] = []
    sizes: list[float] = []
    hulls: list[Floats] = []
    horizons: list[float] = []
    people: list[int] = []
    method, numbered = "", False
    for volumes, horizon_s, person, rows in parts:
        method, numbered = volumes.method, person is not None
        chosen = range(len(volumes)) if rows is None else rows.tolist()
        for row, (i, limb) in product(chosen, enumerate(volumes.limbs)):
            vertices = volumes.vertices(row, i)
            if np.isnan(vertices).any():
                continue
            solid = InflatedHull.around(vertices, float(volumes.radius_m[row, i]))
            t_ns.append(int(volumes.t_ns[row]))
            limbs.append(limb)
            radii.append(solid.radius_m)
            sizes.append(solid.volume_above_m3(FLOOR_Z_M))
            hulls.append(solid.vertices_m)
            horizons.append(horizon_s)
            people.append(1 if person is None else int(person[row]))
    if t_ns:
        columns = occupancy_columns(np.array(t_ns), limbs, method, radii, sizes, hulls, horizons)
        tables.table("occupancy", with_person(columns, np.array(people)) if numbered else columns)


def store_ticks(forecast: Forecast, stored: Ints, horizon_s: Floats, tables: Tables) -> None:
    """Writes the volumes of some ticks of a batch, each until its own horizon.

    Args:
        forecast: The batch.
        stored: (k,) index of each tick.
        horizon_s: (k,) horizon of each, after its tick [s].
        tables: Receives the rows.
    """
    person = forecast.states.person

    def volumes(tick: int, until_s: float) -> StoredVolumes:
        rows = forecast.rows(tick)
        found = forecast.person.volumes(until_s, rows.start, rows.stop)
        return StoredVolumes(found, until_s, None if person is None else person[rows])

    each = zip(stored.tolist(), horizon_s.tolist(), strict=True)
    store_volumes((volumes(tick, until_s) for tick, until_s in each), tables)
