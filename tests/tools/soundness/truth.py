"""Where a person may truly be, given where they are estimated to be."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hrcreplay.records import Floats
from tests.tools.soundness.compiled import copy, kernel
from tests.tools.soundness.motion import GROUPS, allowed, within


class Estimate(NamedTuple):
    """An estimated state, how far the truth may be from it, and one truth that is not."""

    q: Floats  #: (13,) [m, m, rad...]
    v_world: Floats  #: (13,) the first two in the world [m/s, m/s, rad/s...]
    lengths: Floats  #: (8,) [m]
    q_off: Floats  #: (13,) largest distance of the truth
    v_off: Floats  #: (13,)
    lengths_off: Floats  #: (8,)
    v_low: Floats  #: (13,) velocities that a truth may have, the first two forward and to the left
    v_high: Floats  #: (13,)
    true_q: Floats  #: (13,) an admissible state within these distances
    true_v: Floats  #: (13,) the first two forward and to the left
    true_lengths: Floats  #: (8,)
    std: Floats  #: (32,) standard deviations of all of these, as the filter tells them


@kernel
def draw_truth(
    rng: np.random.Generator, estimate: Estimate, bounds: Floats, q: Floats, v: Floats, lengths: Floats
) -> None:
    """Writes an admissible state around the estimate: q (13,), v (13,) in the body's frame, lengths (8,)."""
    copy(estimate.true_q, q)
    copy(estimate.true_v, v)
    copy(estimate.true_lengths, lengths)
    _vary(rng, estimate, bounds, q, v, lengths, 1.0)


@kernel
def vary_truth(
    rng: np.random.Generator, estimate: Estimate, bounds: Floats, q: Floats, v: Floats, lengths: Floats
) -> None:
    """Draws a few entries of an admissible state anew."""
    if rng.random() < 0.5:
        _vary(rng, estimate, bounds, q, v, lengths, 0.15)


@kernel
def _vary(
    rng: np.random.Generator, estimate: Estimate, bounds: Floats, q: Floats, v: Floats, lengths: Floats, share: float
) -> None:
    """Draws a share of the entries anew, on the edge of what is possible or between; keeps what is not admissible."""
    if estimate.q_off.max() == 0.0 and estimate.v_off.max() == 0.0 and estimate.lengths_off.max() == 0.0:
        return
    new_q, new_v, c, s = q.copy(), v.copy(), math.cos(q[2]), math.sin(q[2])
    new_v[0], new_v[1] = c * v[0] - s * v[1], s * v[0] + c * v[1]
    edge = rng.random() < 0.7
    _redraw(rng, estimate.q, estimate.q_off, share, edge, new_q)
    _redraw(rng, estimate.v_world, estimate.v_off, share, edge, new_v)
    _redraw(rng, estimate.lengths, estimate.lengths_off, share, edge, lengths)
    for first, end in GROUPS:
        _clip(new_q, new_v, estimate, bounds, first, end)
        if within(new_q, new_q, first, end, bounds) and _near(new_q, estimate.q, estimate.q_off, first, end):
            copy(new_q[first:end], q[first:end])
        if _near(new_v, estimate.v_world, estimate.v_off, first, end):
            copy(new_v[first:end], v[first:end])
    c, s = math.cos(new_q[2]), math.sin(new_q[2])
    new_v[0], new_v[1] = c * new_v[0] + s * new_v[1], c * new_v[1] - s * new_v[0]
    for k in range(3):
        new_v[k] = max(estimate.v_low[k], min(new_v[k], estimate.v_high[k]))
    forward, left = new_v[0], new_v[1]
    world = np.array([c * forward - s * left, s * forward + c * left, new_v[2]])
    if _near(world, estimate.v_world, estimate.v_off, 0, 3):
        copy(new_q[:3], q[:3])
        copy(new_v[:3], v[:3])


@kernel
def _redraw(rng: np.random.Generator, middle: Floats, off: Floats, share: float, edge: bool, values: Floats) -> None:
    for j in range(len(values)):
        if rng.random() < share:
            unit = 2.0 * rng.random() - 1.0
            values[j] = middle[j] + off[j] * ((1.0 if unit > 0.0 else -1.0) if edge else unit)


@kernel
def _clip(q: Floats, v: Floats, estimate: Estimate, bounds: Floats, first: int, end: int) -> None:
    for j in range(first, end):
        least, most = allowed(j, q, q, bounds)
        q[j] = max(least, min(q[j], most))
        v[j] = max(estimate.v_low[j], min(v[j], estimate.v_high[j]))


@kernel
def _near(values: Floats, middle: Floats, off: Floats, first: int, end: int) -> bool:
    gaps = np.abs(values[first:end] - middle[first:end])
    return bool((gaps <= off[first:end] * (1.0 + 1e-9)).all())
