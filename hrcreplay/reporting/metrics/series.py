"""The table of metrics.json, the time series functions that metrics and figures share, and a run's instants.

A metric has a value, a unit and a meaning; one that does not apply is null with a reason.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from hrcreplay.geometry.polyline import follow_nearer, nearest_vertices
from hrcreplay.human.model import nearest
from hrcreplay.records import JOINTS, Bools, Floats, Ints, find_neighbours
from hrcreplay.store.run_folder import Run
from hrcreplay.store.stored_table import RunTable, number_columns

Metric = dict[str, Any]


class MetricTable:
    """Collects metrics. A number that is not finite becomes null, with a reason."""

    def __init__(self) -> None:
        self._metrics: dict[str, Metric] = {}

    def add(self, name: str, value: float | str | None, unit: str, meaning: str, *, reason: str = "no samples") -> None:
        """Adds one metric; ``reason`` explains a null value.

        Args:
            name: Key in metrics.json.
            value: Number or text; None, or not finite: null.
            unit: Unit of the value, ``1`` for a count or a share.
            meaning: Its meaning, in a few words.
            reason: Reason for a null value.
        """
        if not isinstance(value, str) and value is not None:
            number = value.item() if isinstance(value, np.generic) else value
            value = number if np.isfinite(number) else None
        metric: Metric = {"value": value, "unit": unit, "meaning": meaning}
        if value is None:
            metric["reason"] = reason
        self._metrics[name] = metric

    def sorted(self) -> dict[str, Metric]:
        """All metrics, by name."""
        return dict(sorted(self._metrics.items()))


#: The ten angles of Eq. (37).
ANGLES = JOINTS[2:12]

#: True for columns of a (n, 13) table of JOINTS that are angles.
IS_ANGLE: Bools = np.array([joint in ANGLES for joint in JOINTS])


def wrap(angle_rad: Floats) -> Floats:
    """Wraps angles to [-pi, pi) [rad]."""
    return (angle_rad + np.pi) % (2.0 * np.pi) - np.pi


def difference(a: Floats, b: Floats) -> Floats:
    """Returns ``a - b`` of rows of JOINTS, (n, 13) [m, m, rad..., m]; arms in the same form, shortest angles."""
    apart = nearest(a, b) - b
    return np.where(IS_ANGLE, wrap(apart), apart)


def columns(table: RunTable, suffix: str = "") -> Floats:
    """Returns the (n, 13) columns of the JOINTS with a suffix."""
    return number_columns(table, [joint + suffix for joint in JOINTS])


def times(table: RunTable, name: str = "t_ns") -> Ints:
    """Returns a column of instants (n,) [ns]."""
    return table[name].to_numpy(dtype=np.int64)


def seconds_from(t_ns: Ints, t0_ns: int) -> Floats:
    """(n,) time since ``t0_ns`` [s]."""
    return np.asarray((t_ns - t0_ns) * 1e-9, dtype=np.float64)


def interpolate(t_ns: Ints, values: Floats, at_ns: Ints, *, angles: bool) -> Floats:
    """Interpolates rows of JOINTS, or of their rates, linearly between the two samples around each instant.

    Args:
        t_ns: (n,) instants of the samples, increasing [ns].
        values: (n, 13) samples [m, m, rad..., m].
        at_ns: (m,) requested instants [ns].
        angles: True: the columns of angles are angles, interpolated along the shortest way; False: they are rates.

    Returns:
        (m, 13); NaN outside the samples' span and where one of the two samples is NaN. An instant equal to that of a
        sample gets that sample, for any neighbours.
    """
    if not len(t_ns):
        return np.full((len(at_ns), values.shape[1]), np.nan)
    before, after, share, known = find_neighbours(t_ns, at_ns)
    change = difference(values[after], values[before]) if angles else values[after] - values[before]
    return np.where(known[:, None], values[before] + share[:, None] * change, np.nan)


def central_differences(t_ns: Ints, values: Floats) -> Floats:
    """Computes (n, 13) rates of rows of JOINTS by central differences [m/s, m/s, rad/s...]; NaN at both ends."""
    rate = np.full(values.shape, np.nan)
    if len(t_ns) > 2:
        rate[1:-1] = difference(values[2:], values[:-2]) / ((t_ns[2:] - t_ns[:-2]) * 1e-9)[:, None]
    return rate


def true_runs(mask: Bools) -> Ints:
    """Returns (k, 2) runs of True in ``mask``, each as [first, past the last)."""
    edges = np.diff(np.concatenate([[0], np.asarray(mask, dtype=np.int8), [0]]))
    return np.column_stack([np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)]).astype(np.int64)


def durations_s(t_ns: Ints) -> Floats:
    """(n,) duration of each tick until the next one; for the last one the median [s]."""
    if len(t_ns) < 2:
        return np.zeros(len(t_ns))
    steps = np.diff(t_ns) * 1e-9
    return np.append(steps, np.median(steps))


def break_at_gaps(x: Floats, y: Floats, gap: float) -> tuple[Floats, Floats]:
    """Inserts a NaN into a line at each step of its abscissa above ``gap``."""
    leaps = np.flatnonzero(np.diff(x) > gap) + 1
    return np.insert(x, leaps, x[leaps - 1]), np.insert(y, leaps, np.nan)


def envelope(x: Floats, y: Floats, bins: int = 700) -> tuple[Floats, Floats]:
    """Reduces a line to fewer points with the same appearance: the lowest and the highest of each bin, in order.

    Args:
        x: (n,) abscissae, increasing.
        y: (n,) ordinates; NaN breaks the line.
        bins: Number of bins; a table of at most 4 rows per bin is returned unchanged.

    Returns:
        ``x`` and ``y`` of the points kept. A bin without a finite value keeps one NaN.
    """
    if len(x) <= 4 * bins:
        return x, y
    size = -(-len(x) // bins)
    padded = np.full(size * bins, np.nan)
    padded[: len(y)] = y
    table = padded.reshape(bins, size)
    missing = np.isnan(table)
    first = np.arange(bins) * size
    lowest = first + np.argmin(np.where(missing, np.inf, table), axis=1)
    highest = first + np.argmax(np.where(missing, -np.inf, table), axis=1)
    gaps = (first + np.argmax(missing, axis=1))[missing.any(axis=1)]
    kept = np.unique(np.concatenate([lowest, highest, gaps]))
    kept = kept[kept < len(x)]
    return x[kept], y[kept]


def step_lengths(points: Floats) -> Floats:
    """Returns (n - 1,) the lengths of the steps between (n, d) points; of a long run in little more memory."""
    squares = np.zeros(max(0, len(points) - 1))
    for coordinate in points.T:
        squares += np.diff(coordinate) ** 2
    return np.sqrt(squares, out=squares)


def way_along(points: Floats) -> Floats:
    """Returns (n,) the way along a path from its first point to each of (n, d) points."""
    way = np.zeros(len(points))
    np.cumsum(step_lengths(points), out=way[1:])
    return way


def thin_path(points: Floats, tolerance: float) -> Floats:
    """Returns (m, d) a path with fewer of its (n, d) points: one per motion of ``tolerance``, and the last."""
    if len(points) < 3:
        return points
    motion = np.floor(way_along(points) / tolerance)
    kept = np.diff(motion, prepend=-1.0) > 0.0
    kept[-1] = True
    return points[kept]


def thin_stretches(points: Floats, tolerance: float) -> list[Floats]:
    """Returns the stretches of a path (n, d) between its unknown points, each thinned: no line crosses a gap."""
    known = np.isfinite(points).all(axis=1)
    edges = np.flatnonzero(np.diff(known, prepend=False, append=False)).reshape(-1, 2)
    return [thin_path(points[first:last], tolerance) for first, last in edges.tolist()]


#: Edge of the cells in which vertices of a path are searched together, and distance below which vertices are merged
#: [m].
_CELL_M, _SAME_M = 2e-4, 1e-6
#: Number of points whose feet are found together: all of a long run would be in memory ten times.
_TOGETHER = 65_536


def feet_in_turn(points: Floats, path: Floats) -> Iterator[tuple[Ints, Floats]]:
    """Yields rows of (n, 3) points and the nearest points to them on a (m, 3) polyline, all in one frame [m].

    Rows with an unknown point are left out. Searches the two segments at the nearest vertex, which is exact if vertices
    are dense relative to the curvature.
    """
    known, rows = np.isfinite(path).all(axis=1), np.flatnonzero(np.isfinite(points).all(axis=1))
    path = np.ascontiguousarray(thin_path(path if known.all() else path[known], _SAME_M))
    if not len(path) or not len(rows):
        return
    vertices = _vertices_apart(path)
    for first in range(0, len(rows), _TOGETHER):
        some = rows[first : first + _TOGETHER]
        at = np.ascontiguousarray(points[some])
        nearest = vertices[nearest_vertices(at, path[vertices])]
        follow_nearer(at, path, nearest)
        yield some, _feet_beside(at, path, nearest)


def _feet_beside(at: Floats, path: Floats, nearest: Ints) -> Floats:
    """Returns (n, 3) nearest points on the two segments at the nearest vertex (n,) of each of (n, 3) points [m]."""
    best = path[nearest]
    best_m = np.linalg.norm(at - best, axis=1)
    for other in (np.maximum(nearest - 1, 0), np.minimum(nearest + 1, len(path) - 1)):
        along = path[other] - path[nearest]
        length2 = (along**2).sum(axis=1)
        share = np.clip(((at - path[nearest]) * along).sum(axis=1) / np.where(length2 > 0, length2, 1.0), 0.0, 1.0)
        foot = path[nearest] + share[:, None] * along
        foot_m = np.linalg.norm(at - foot, axis=1)
        better = foot_m < best_m
        best, best_m = np.where(better[:, None], foot, best), np.where(better, foot_m, best_m)
    return best


def _vertices_apart(path: Floats) -> Ints:
    """Returns the indices of one vertex of a (m, 3) path in each cell, neighbours one after the other.

    A programme passes the same places in each cycle: from the nearest of these vertices a search follows the path while
    the distance decreases.
    """
    cell = np.zeros(len(path), np.int64)
    for coordinate in path.T:
        along = np.floor(coordinate / _CELL_M).astype(np.int64)
        along -= along.min()
        cell = cell * (along.max() + 1) + along
    _, first = np.unique(cell, return_index=True)
    vertices: Ints = first[cKDTree(path[first]).indices]
    return vertices


#: Columns of the arms' joints.
_ARMS = [i for i, joint in enumerate(JOINTS) if joint.startswith("a")]


def start_ns(run: Run) -> int:
    """Returns the zero of the report's clock: the first tick, else the first frame [ns]."""
    if run.state is not None and len(run.state):
        return int(times(run.state)[0])
    if run.motion is not None and len(run.motion):
        return int(times(run.motion)[0])
    if run.measurements is not None and len(run.measurements):
        return int(times(run.measurements, "capture_ns").min())
    return 0


def find_known_ticks(run: Run) -> Ints:
    """Returns the ticks at which the person is known [ns]."""
    return np.zeros(0, dtype=np.int64) if run.state is None else times(run.state)[run.known]


def moment_ns(run: Run) -> int | None:
    """Returns the tick with the smallest separation of the plan or, without one, the fastest arm [ns]; or None.

    The person is known at that tick; None without a person.
    """
    known_ns = find_known_ticks(run)
    if run.state is None or not len(known_ns):
        return None
    if run.motion is not None and run.motion["distance_m"].notna().any():
        moment = int(times(run.motion)[nearest_tick(run.motion)])
    else:
        speed = np.abs(columns(run.state, "_vel")[:, _ARMS]).sum(axis=1)
        moment = int(times(run.state)[int(np.argmax(np.where(np.isfinite(speed), speed, -1.0)))])
    return int(known_ns[int(np.argmin(np.abs(known_ns - moment)))])


def instants(run: Run, count: int = 4, step_s: float = 1.0) -> Ints:
    """Returns (count,) ticks for Fig. 17, ``step_s`` apart, that end one step after that of ``moment_ns`` [ns].

    Empty if the person is not known at enough ticks.
    """
    moment, known_ns = moment_ns(run), find_known_ticks(run)
    if moment is None or len(known_ns) < 2:
        return np.zeros(0, dtype=np.int64)
    step_ns = round(step_s * 1e9)
    first_ns = max(moment - (count - 2) * step_ns, int(known_ns[0]))
    wanted_ns = first_ns + step_ns * np.arange(count)
    nearest = np.clip(np.searchsorted(known_ns, wanted_ns), 0, len(known_ns) - 1)
    found = known_ns[nearest]
    return found if len(np.unique(found)) == count else np.zeros(0, dtype=np.int64)


def nearest_tick(motion: RunTable) -> int:
    """Returns the row of the smallest separation of a plan; the first if none is known."""
    distance_m = motion["distance_m"].to_numpy(dtype=float)
    return int(np.argmin(np.where(np.isnan(distance_m), np.inf, distance_m)))
