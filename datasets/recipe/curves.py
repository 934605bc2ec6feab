"""Building blocks of motion: minimum-jerk transitions, slow sway, smoothing, rotations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hrcreplay.records import Floats


@dataclass(frozen=True)
class Move:
    """A minimum-jerk transition of one channel to ``value``."""

    start_s: float
    duration_s: float
    value: float


def ease(t_s: Floats, start_s: float, duration_s: float) -> Floats:
    """(n,) minimum-jerk progress from 0 to 1 between ``start_s`` and ``start_s + duration_s``."""
    s = np.clip((t_s - start_s) / duration_s, 0.0, 1.0)
    return np.asarray(s**3 * (10.0 - 15.0 * s + 6.0 * s**2))


def follow(t_s: Floats, first: float, moves: Sequence[Move]) -> Floats:
    """(n,) a channel that starts at ``first`` and makes the moves one after another."""
    value = np.full(len(t_s), first)
    for move in moves:
        value = value + (move.value - value) * ease(t_s, move.start_s, move.duration_s)
    return value


def bump(t_s: Floats, start_s: float, end_s: float, rise_s: float) -> Floats:
    """(n,) 0, up to 1 within ``rise_s``, and back to 0 at ``end_s``."""
    return ease(t_s, start_s, rise_s) - ease(t_s, end_s - rise_s, rise_s)


def sway(t_s: Floats, rng: np.random.Generator, std: float, slowest_hz: float, fastest_hz: float) -> Floats:
    """(n,) aimless smooth motion of the given standard deviation: seven sinusoids of random phase, slower is larger."""
    frequencies = slowest_hz * (fastest_hz / slowest_hz) ** np.linspace(0.0, 1.0, 7)
    phases = rng.uniform(0.0, 2.0 * np.pi, 7)
    weights = (slowest_hz / frequencies) ** 0.5
    weights *= std * np.sqrt(2.0) / np.sqrt(np.sum(weights**2))
    return np.asarray(np.sin(2.0 * np.pi * t_s[:, None] * frequencies + phases) @ weights)


def smooth(values: Floats, sigma_rows: float) -> Floats:
    """(n, ...) ``values`` under a Gaussian of that width along time; the ends are held."""
    reach = int(np.ceil(4.0 * sigma_rows))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma_rows) ** 2)
    kernel /= kernel.sum()
    flat = np.pad(values.reshape(len(values), -1), ((reach, reach), (0, 0)), mode="edge")
    columns = [np.convolve(column, kernel, mode="valid") for column in flat.T]
    return np.stack(columns, axis=1).reshape(values.shape)


def rot_x(angle: Floats) -> Floats:
    """(n, 3, 3) rotations about x by (n,) angles [rad]."""
    return _rotation(angle, 1, 2)


def rot_y(angle: Floats) -> Floats:
    """(n, 3, 3) rotations about y by (n,) angles [rad]."""
    return _rotation(angle, 2, 0)


def rot_z(angle: Floats) -> Floats:
    """(n, 3, 3) rotations about z by (n,) angles [rad]."""
    return _rotation(angle, 0, 1)


def _rotation(angle: Floats, first: int, second: int) -> Floats:
    R = np.zeros((len(angle), 3, 3))
    R[:] = np.eye(3)
    R[:, first, first] = R[:, second, second] = np.cos(angle)
    R[:, second, first] = np.sin(angle)
    R[:, first, second] = -R[:, second, first]
    return R


def turn(R: Floats, vector: Floats | Sequence[float | Floats]) -> Floats:
    """(n, 3) ``R`` (n, 3, 3) times a vector whose components are numbers or (n,) channels."""
    components = [np.broadcast_to(np.asarray(c, dtype=np.float64), (len(R),)) for c in np.asarray(vector, dtype=object)]
    return np.asarray(np.einsum("nij,nj->ni", R, np.stack(components, axis=1)))


def unit(vectors: Floats) -> Floats:
    """Vectors of length one along the last axis."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
