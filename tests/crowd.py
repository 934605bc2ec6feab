"""Several simulated people before the cameras of the demo, who cross and hide each other, with the truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from datasets.recipe import cameras, scene, worker
from datasets.recipe.curves import Move, follow
from datasets.recipe.sensors import Sensor, observe
from hrcreplay.logs.writer import LogWriter
from hrcreplay.records import POINTS, Bools, CameraFrames, Floats, Ints

START_NS = 1_600_000_000_000_000_000
#: Both cameras of the demo from the start on.
SENSORS = tuple(replace(sensor, first_s=0.3) for sensor in cameras.SENSORS)
#: Radius of a trunk and of a head that hide what is behind them [m].
_WIDE_M = (0.16, 0.11)
_SPINE = [POINTS.index(name) for name in ("pelvis", "chest", "neck")]
_HEAD = POINTS.index("head")
_MIRROR = {"l": "r", "r": "l"}

#: Who walks where: start, then moves of start [s], duration [s], x, y [m]. They cross before and behind each other.
FIRST = (
    (2.10, -0.95),
    ((1.5, 2.5, 1.75, 0.75), (5.5, 2.6, 2.05, -0.85), (9.5, 2.4, 1.70, 0.60), (13.0, 2.6, 2.2, -0.8)),
)
SECOND = (
    (2.45, 0.90),
    ((1.8, 2.6, 2.50, -0.70), (5.8, 2.4, 2.35, 0.70), (10.0, 2.6, 2.60, -0.6), (14.0, 2.0, 2.4, 0.5)),
)


class Crowd(NamedTuple):
    """Frames of all people, and who is who."""

    frames: CameraFrames
    owner: Ints  #: (n,) index of the person whom each row shows
    t_ns: Ints  #: (m,) instants of the truth
    truth_m: tuple[Floats, ...]  #: of each person, (m, 20, 3) world [m]


def walker(t_s: Floats, start: tuple[float, float], way: tuple[tuple[float, ...], ...], seed: int) -> Floats:
    """(n, 20, 3) somebody who walks from place to place with swinging arms, world [m]."""
    axes = [follow(t_s, start[i], [Move(m[0], m[1], m[2 + i]) for m in way]) for i in (0, 1)]
    turns, now = [], None
    for m, before in zip(way, (start, *(m[2:] for m in way)), strict=False):
        to = float(np.arctan2(m[3] - before[1], m[2] - before[0]))
        now = to if now is None else now + (to - now + np.pi) % (2.0 * np.pi) - np.pi
        turns.append(Move(m[0] - 0.8, 1.0, now))
    heading = follow(t_s, turns[0].value, turns)
    return worker.body(t_s, np.column_stack(axes), heading, ((), ()), np.random.default_rng(seed))


def people(count: int, until_s: float) -> tuple[Floats, list[Floats]]:
    """(n,) instants [s], and the points of the demo's worker and of one or two who walk about."""
    t_s, first = worker.simulate(2024)
    t_s = t_s[t_s <= until_s]
    others = [walker(t_s, *way, seed=7 + k) for k, way in enumerate((FIRST, SECOND))]
    return t_s, [first[: len(t_s)], *others][:count]


def there_and_back(t_s: Floats, bodies: list[Floats], until_s: float) -> tuple[Floats, list[Floats]]:
    """The motions of people, then backwards, then again, without a leap.

    Args:
        t_s: (n,) regular instants from 0 [s].
        bodies: (n, 20, 3) true points of each person, world [m].
        until_s: Last instant [s].
    """
    step_s, last = t_s[1] - t_s[0], len(t_s) - 1
    ticks = np.arange(int(until_s / step_s) + 1)
    rows = last - np.abs(last - ticks % (2 * last))
    return ticks * step_s, [points[rows] for points in bodies]


def record(
    t_s: Floats, bodies: list[Floats], seed: int = 5, *, ids: str = "restart", swap_sides: bool = False
) -> Crowd:
    """The frames of both cameras: who stands behind somebody is hidden, point by point.

    Args:
        t_s: (n,) instants of the truth [s].
        bodies: (n, 20, 3) true points of each person, world [m].
        seed: Of all noise.
        ids: restart: a body that was hidden gets a new id; swapped: ids change hands with every frame.
        swap_sides: True: in every seventh frame of a body left and right are exchanged.
    """
    tables, owners = [], []
    for index, sensor in enumerate(SENSORS):
        rng = np.random.default_rng([seed, index])
        taken_s = np.arange(sensor.first_s, t_s[-1] - 0.09, 1.0 / sensor.rate_hz)
        arrival_s = np.maximum.accumulate(taken_s + sensor.late_s + rng.gamma(2.0, 0.005, len(taken_s)))
        there = [cameras.between(taken_s, t_s, points) for points in bodies]
        for k, points in enumerate(there):
            view = observe(sensor, taken_s, points, rng)
            hidden = np.zeros((len(taken_s), len(POINTS)), dtype=np.bool_)
            for other in [*there[:k], *there[k + 1 :]]:
                hidden |= _hidden_by(sensor, points, other)
            view.points_m[hidden] = np.nan
            view.confidence[hidden] = 0.0
            seen = np.isfinite(view.points_m[..., 0])
            shown = (seen.sum(axis=1) >= 7) & seen[:, _SPINE].any(axis=1)
            body = _ids(shown, k, len(bodies), ids)
            if swap_sides:
                _mirror(view.points_m, view.confidence, np.arange(k, len(taken_s), 7))
            tables.append(_table(index, taken_s, arrival_s, body, view.points_m, view.confidence).rows(shown))
            owners.append(np.full(int(shown.sum()), k))
    frames, owner = CameraFrames.join(tables), np.concatenate(owners)
    order = np.lexsort((frames.body, frames.camera, frames.arrival_ns))
    t_ns = START_NS + np.round(t_s * 1e9).astype(np.int64)
    return Crowd(frames.rows(order), owner[order], t_ns, tuple(bodies))


def write(path: Path, crowd: Crowd, T_world_base: Floats = scene.T_WORLD_BASE) -> Path:
    """Writes the frames as a log with the demo's robot and task, without the truth."""
    with LogWriter(path) as log:
        for sensor in SENSORS:
            log.camera(sensor.name, np.round(sensor.T_world_camera, 9))
        log.base(T_world_base)
        log.task(scene.TASK)
        log.frames(crowd.frames)
    return path


def _hidden_by(sensor: Sensor, points_m: Floats, other_m: Floats) -> Bools:
    """(n, 20) True where trunk or head of another person is between the camera and a point."""
    eye = sensor.T_world_camera[:3, 3]
    spine = other_m[:, _SPINE]
    balls = np.concatenate([spine, 0.5 * (spine[:, :2] + spine[:, 1:]), other_m[:, [_HEAD]]], axis=1)
    radius = np.array([_WIDE_M[0]] * 5 + [_WIDE_M[1]])
    sight = points_m - eye
    length = np.linalg.norm(sight, axis=2)
    along = np.einsum("npj,nbj->npb", sight / length[..., None], balls - eye)
    away = np.sqrt(np.maximum(((balls - eye) ** 2).sum(axis=2)[:, None] - along**2, 0.0))
    return np.asarray(np.any((away < radius) & (along > 0.0) & (along < length[..., None]), axis=2))


def _ids(shown: Bools, k: int, count: int, how: str) -> Ints:
    """(n,) the tracker's ids of person ``k``."""
    if how == "swapped":
        return (k + np.arange(len(shown))) % count + 1
    again = np.cumsum(np.diff(shown.astype(np.int64), prepend=0) > 0)
    return 1 + k + count * again


def _mirror(points_m: Floats, confidence: Floats, rows: Ints) -> None:
    order = [POINTS.index(n[:-1] + _MIRROR[n[-1]]) if n[-2:] in ("_l", "_r") else i for i, n in enumerate(POINTS)]
    points_m[rows] = points_m[rows][:, order]
    confidence[rows] = confidence[rows][:, order]


def _table(index: int, taken_s: Floats, arrival_s: Floats, body: Ints, points_m: Floats, sure: Floats) -> CameraFrames:
    return CameraFrames(
        capture_ns=START_NS + np.round(taken_s * 1e6).astype(np.int64) * 1000,
        arrival_ns=START_NS + np.round(arrival_s * 1e6).astype(np.int64) * 1000,
        camera=np.full(len(taken_s), index),
        body=body.astype(np.int64),
        points_m=np.round(points_m, 4),
        confidence=sure,
        cameras=tuple(sensor.name for sensor in SENSORS),
    )
