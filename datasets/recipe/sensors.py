"""What a depth camera's skeleton tracker makes of the worker: noise, occlusion, gross errors, confidences."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datasets.recipe.curves import smooth
from hrcreplay.records import POINTS, Bools, Floats, Ints

RIGHT_ARM = tuple(POINTS.index(f"{name}_r") for name in ("shoulder", "elbow", "wrist", "hand"))
LEFT_ARM = tuple(POINTS.index(f"{name}_l") for name in ("shoulder", "elbow", "wrist", "hand"))
SPINE = tuple(POINTS.index(name) for name in ("pelvis", "chest", "neck"))
HEAD = POINTS.index("head")

#: How hard a point is to find, against an elbow.
_HARD = {
    "pelvis": 0.8,
    "chest": 0.7,
    "neck": 0.7,
    "head": 0.8,
    "shoulder": 0.9,
    "wrist": 1.25,
    "hand": 1.8,
    "foot": 1.5,
}
HARD = np.array([_HARD.get(name.split("_")[0], 1.0) for name in POINTS])

CHEST_RADIUS_M = 0.125
HEAD_RADIUS_M = 0.10


@dataclass(frozen=True)
class Sensor:
    """A depth camera and its tracker."""

    name: str
    T_world_camera: Floats
    half_view_rad: tuple[float, float]  #: of the field of view, across and down
    range_m: float  #: nobody is tracked beyond
    white_m: float  #: noise across the line of sight at 2.5 m, new in every frame; grows with the square of the depth
    slow_m: float  #: noise that lasts for some frames
    slow_s: float  #: for so long
    along: float  #: noise along the line of sight, against across
    rate_hz: float
    first_s: float  #: when it starts
    late_s: float  #: latency, at least


@dataclass(frozen=True)
class View:
    """What one camera sees of one person, a row a frame: points in the camera's frame [m] and confidence."""

    t_s: Floats
    points_m: Floats
    confidence: Floats


def observe(sensor: Sensor, t_s: Floats, points_m: Floats, rng: np.random.Generator) -> View:
    """Skeletons with noise.

    Args:
        sensor: The camera.
        t_s: (n,) capture times [s].
        points_m: (n, 20, 3) true POINTS in the world at those times [m].
        rng: Source of the noise.
    """
    R, eye = sensor.T_world_camera[:3, :3], sensor.T_world_camera[:3, 3]
    true = (points_m - eye) @ R
    hidden = _hidden(points_m, eye)
    hidden_for_long = smooth(hidden.astype(np.float64), 2.0)
    loud = _loudness(t_s, true, hidden_for_long, rng)
    sigma = np.array([1.0, 1.0, sensor.along])
    white = rng.standard_normal(true.shape) * sensor.white_m
    slow = _correlated(t_s, true.shape[1:], sensor.slow_s, rng) * sensor.slow_m
    pulled = _correlated(t_s, true.shape[1:], 0.7, rng) * 0.02
    pulled += 0.20 * (true[:, list(SPINE)].mean(axis=1, keepdims=True) - true) * np.array([0.25, 0.1, 0.5])
    seen = true + (white + slow) * loud[:, :, None] * sigma + pulled * hidden_for_long[:, :, None]
    confidence = np.where(hidden, 0.5, 1.0)
    _lose(sensor, seen, confidence, rng)
    return View(t_s, seen, confidence)


def _loudness(t_s: Floats, true: Floats, hidden: Floats, rng: np.random.Generator) -> Floats:
    """(n, 20) what the noise is multiplied with: point, depth, speed, occlusion and the other camera's light."""
    depth = np.maximum(true[:, :, 2], 0.8)
    dt = np.gradient(t_s)[:, None]
    speed = np.linalg.norm(np.gradient(true, axis=0), axis=2) / dt
    loud = HARD * (depth / 2.5) ** 2 * (1.0 + 0.2 * np.minimum(speed, 2.0)) * (1.0 + 0.5 * hidden)
    start = t_s[0]
    while (start := start + rng.uniform(2.5, 7.0)) < t_s[-1]:
        loud[(t_s >= start) & (t_s < start + rng.uniform(0.25, 0.7))] *= 3.0  # interference
    return np.asarray(loud)


def _hidden(points_m: Floats, eye_m: Floats) -> Bools:
    """(n, 20): the trunk or the head stands between the camera and the point."""
    spine = points_m[:, list(SPINE)]
    shares = np.linspace(0.0, 1.0, 5)[:, None]
    low = spine[:, :1] + (spine[:, 1:2] - spine[:, :1]) * shares
    high = spine[:, 1:2] + (spine[:, 2:] - spine[:, 1:2]) * shares[1:]
    balls = np.concatenate([low, high, points_m[:, HEAD : HEAD + 1]], axis=1)
    radius = np.append(np.full(balls.shape[1] - 1, CHEST_RADIUS_M), HEAD_RADIUS_M)
    sight = points_m - eye_m
    length = np.linalg.norm(sight, axis=2)
    sight = sight / length[:, :, None]
    along = np.einsum("npj,nbj->npb", sight, balls - eye_m)
    away = np.linalg.norm((balls - eye_m)[:, None] - along[..., None] * sight[:, :, None], axis=3)
    behind = np.any((away < radius) & (along < length[:, :, None] - radius), axis=2)
    behind[:, [*SPINE, HEAD]] = False
    return np.asarray(behind)


def _lose(sensor: Sensor, seen: Floats, confidence: Floats, rng: np.random.Generator) -> None:
    """Points outside the view are missing; some are just not found."""
    across = np.abs(np.arctan2(seen[:, :, 0], seen[:, :, 2])) > sensor.half_view_rad[0]
    down = np.abs(np.arctan2(seen[:, :, 1], seen[:, :, 2])) > sensor.half_view_rad[1]
    missed = rng.random(confidence.shape) < np.where(confidence < 1.0, 0.06, 0.006 * HARD)
    gone = across | down | missed
    seen[gone] = np.nan
    confidence[gone] = 0.0


def _correlated(t_s: Floats, shape: tuple[int, ...], memory_s: float, rng: np.random.Generator) -> Floats:
    """(n, *shape) noise of standard deviation 1 that forgets itself over ``memory_s``: a first-order process."""
    noise = rng.standard_normal((len(t_s), *shape))
    keep = np.exp(-np.diff(t_s) / memory_s)
    for k in range(1, len(t_s)):
        noise[k] = keep[k - 1] * noise[k - 1] + np.sqrt(1.0 - keep[k - 1] ** 2) * noise[k]
    return noise


def swap_arms(view: View, rows: Ints, *, from_shoulder: bool) -> None:
    """Takes one arm for the other in these rows, from the shoulder or from the elbow on, as sure as ever."""
    right, left = (np.array(arm if from_shoulder else arm[1:]) for arm in (RIGHT_ARM, LEFT_ARM))
    for values in (view.points_m, view.confidence):
        picked = values[rows].copy()
        values[np.ix_(rows, right)] = picked[:, left]
        values[np.ix_(rows, left)] = picked[:, right]


def jump(view: View, rows: Ints, points: tuple[int, ...], by_m: Floats, confidence: float) -> None:
    """Puts points elsewhere in these rows, at most this sure of them."""
    where = np.ix_(rows, np.array(points))
    view.points_m[where] += by_m
    view.confidence[where] = np.minimum(view.confidence[where], confidence)
