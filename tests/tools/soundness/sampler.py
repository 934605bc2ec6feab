"""Many motions from one predicted state, and the worst that they do."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hrcreplay.records import DOF, LENGTHS, Floats, Ints
from tests.tools.soundness.compiled import copy, kernel
from tests.tools.soundness.facets import Facets, outside
from tests.tools.soundness.kinematics import POINTS, body
from tests.tools.soundness.motion import GROUPS, step
from tests.tools.soundness.truth import Estimate, draw_truth, vary_truth
from tests.tools.soundness.wishes import MUTATE, ORDER, PUSH, draw, mutate, push

#: Points and sides are good to about 1e-12 m. What is farther outside than this has escaped [m].
ROUNDING_M = 1e-10
#: Pieces of constant wish of a motion; it is measured at the start and after every piece.
PIECES = 8
#: Instants at which a motion is measured: one that meets a limit adds one, and if that happens oft, it ends.
INSTANTS = 1 + PIECES + 2 * len(GROUPS)
#: Motions followed side by side.
BLOCK = 40


class Corners(NamedTuple):
    """Which points of the body belong to which limb, and what moves a limb."""

    points: Ints  #: (c,) index into POINTS
    limbs: Ints  #: (c,) index into the limbs, ascending
    moved_by: Ints  #: (limbs, groups) 1 where a group of joints moves a limb


class Worst(NamedTuple):
    """What the motions from one state did, per limb."""

    margin_m: Floats  #: (limbs,) largest distance outside; negative: how far inside
    point_m: Floats  #: (limbs, 3) where
    motion: Ints  #: (limbs,) which motion
    time_s: Floats  #: (limbs,) when
    escapes: Ints  #: (limbs + 1,) motions that left a limb's volume; last: any


class Block(NamedTuple):
    """Motions side by side."""

    q: Floats  #: (b, 13) where they start
    v: Floats  #: (b, 13), first two in the body's frame
    lengths: Floats  #: (b, 7)
    wish: Floats  #: (b, PIECES, 13)
    cuts: Floats  #: (b, PIECES + 1) instants at which the wishes change [s]
    careful: Ints  #: (b,)
    points: Floats  #: (POINTS, INSTANTS, 3, b)
    times: Floats  #: (INSTANTS, b)
    alive: Ints  #: (groups, b) instants up to which a group was followed


@kernel
def block_of(count: int) -> Block:
    return Block(
        np.empty((count, DOF)),
        np.empty((count, DOF)),
        np.empty((count, len(LENGTHS))),
        np.empty((count, PIECES, DOF)),
        np.empty((count, PIECES + 1)),
        np.empty(count, np.int64),
        np.empty((len(POINTS), INSTANTS, 3, count)),
        np.empty((INSTANTS, count)),
        np.empty((len(GROUPS), count), np.int64),
    )


@kernel
def sample(
    rng: np.random.Generator,
    estimate: Estimate,
    bounds: Floats,
    horizon: float,
    hand: float,
    stops: bool,
    corners: Corners,
    facets: Facets,
    motions: int,
) -> Worst:
    """Follows motions through the horizon and measures how far the limbs come out of their volumes.

    Args:
        rng: Where all chance comes from.
        estimate: The state that was predicted from, and how far the truth may be from it.
        bounds: Limits that the motions obey.
        horizon: How long they are followed [s].
        hand: Length of the hand beyond the wrist [m].
        stops: Whether a limit brings a joint to rest, rather than ends the motion.
        corners: What belongs to which limb.
        facets: The volumes, one a limb.
        motions: How many, a multiple of BLOCK.
    """
    limbs = len(facets.first) - 1
    worst = Worst(
        np.full(limbs, -np.inf),
        np.zeros((limbs, 3)),
        np.zeros(limbs, np.int64),
        np.zeros(limbs),
        np.zeros(limbs + 1, np.int64),
    )
    best = block_of(limbs)  # the worst motion of each limb
    block = block_of(BLOCK)
    jacobians = _jacobians(estimate, hand)
    for start in range(0, motions, BLOCK):
        for i in range(BLOCK):
            _draw_motion(rng, start + i, block, i, best, worst, estimate, bounds, horizon, corners, facets, jacobians)
            _follow(block, i, hand, stops, bounds)
        _measure(start, block, best, worst, corners, facets)
    return worst


@kernel
def _draw_motion(
    rng: np.random.Generator,
    number: int,
    block: Block,
    i: int,
    best: Block,
    worst: Worst,
    estimate: Estimate,
    bounds: Floats,
    horizon: float,
    corners: Corners,
    facets: Facets,
    jacobians: Floats,
) -> None:
    """Writes start and wishes of the i-th motion of a block."""
    family = ORDER[number % len(ORDER)]
    limb = rng.integers(0, len(worst.margin_m))
    if family == MUTATE and np.isfinite(worst.margin_m[limb]):
        _take(best, int(limb), block, i)
        mutate(rng, bounds, block.wish[i])
        vary_truth(rng, estimate, bounds, block.q[i], block.v[i], block.lengths[i])
        return
    draw_truth(rng, estimate, bounds, block.q[i], block.v[i], block.lengths[i])
    for k in range(PIECES):
        block.cuts[i, k] = horizon * (k + (rng.random() - 0.5 if k else 0.0)) / PIECES
    block.cuts[i, PIECES] = horizon
    block.careful[i] = rng.random() < 0.5
    if family in (PUSH, MUTATE):
        corner = rng.integers(0, len(corners.points))
        limb = corners.limbs[corner]
        side = rng.integers(facets.first[limb], facets.first[limb + 1])
        push(facets.normals[side], jacobians[corners.points[corner]], bounds, block.wish[i])
    else:
        draw(rng, family, bounds, block.wish[i])


@kernel
def _take(of: Block, k: int, to: Block, i: int) -> None:
    """Makes the i-th motion of a block what the k-th of another is, before it is followed."""
    copy(of.q[k], to.q[i])
    copy(of.v[k], to.v[i])
    copy(of.lengths[k], to.lengths[i])
    copy(of.wish[k], to.wish[i])
    copy(of.cuts[k], to.cuts[i])
    to.careful[i] = of.careful[k]


@kernel
def _jacobians(estimate: Estimate, hand: float) -> Floats:
    """(POINTS, 3, 13) d point / d q by differences; x and y are forward and left."""
    q, span = estimate.q.copy(), 1e-5
    ahead, behind = np.empty((len(POINTS), 3)), np.empty((len(POINTS), 3))
    jacobians = np.zeros((len(POINTS), 3, DOF))
    c, s = np.cos(q[2]), np.sin(q[2])
    jacobians[:, 0, 0], jacobians[:, 1, 0], jacobians[:, 0, 1], jacobians[:, 1, 1] = c, s, -s, c
    for j in range(2, DOF):
        q[j] = estimate.q[j] + span
        body(q, estimate.lengths, hand, ahead)
        q[j] = estimate.q[j] - span
        body(q, estimate.lengths, hand, behind)
        q[j] = estimate.q[j]
        copy((ahead - behind) / (2.0 * span), jacobians[:, :, j])
    return jacobians


@kernel
def _follow(block: Block, i: int, hand: float, stops: bool, bounds: Floats) -> None:
    """Writes the points of the i-th motion at all its instants; what is not followed any more stays as at the start."""
    q, v, points = block.q[i].copy(), block.v[i].copy(), np.empty((len(POINTS), 3))
    ended, work = np.zeros(len(GROUPS), np.int64), np.empty((8, DOF))
    block.alive[:, i] = INSTANTS
    block.times[:, i] = 0.0
    body(q, block.lengths[i], hand, points)
    for instant in range(INSTANTS):
        copy(points, block.points[:, instant, :, i])
    t, piece, careful = 0.0, 0, block.careful[i] == 1
    for instant in range(1, INSTANTS):
        before, met = ended.copy(), False
        while piece < PIECES and not met:
            dt = block.cuts[i, piece + 1] - t
            moved, met = step(q, v, block.wish[i, piece], dt, (careful, stops), ended, bounds, work)
            t += moved
            if moved == dt:
                piece += 1
                break
        careful = careful or met
        body(q, block.lengths[i], hand, points)
        copy(points, block.points[:, instant, :, i])
        block.times[instant, i] = t
        for g in range(len(GROUPS)):
            if ended[g] and not before[g]:
                block.alive[g, i] = instant + 1
        if piece == PIECES:
            break


@kernel
def _measure(start: int, block: Block, best: Block, worst: Worst, corners: Corners, facets: Facets) -> None:
    """Compares the points of a block with the volumes."""
    count = len(block.q)
    margins, largest = np.empty(count), np.full((len(worst.margin_m), count), -np.inf)
    points = np.empty((3, count))
    for corner in range(len(corners.points)):
        point, limb = corners.points[corner], corners.limbs[corner]
        for instant in range(INSTANTS):
            _select(block, corners, point, limb, instant, points)
            margins[:] = -np.inf
            outside(facets, limb, points, min(ROUNDING_M, worst.margin_m[limb]), margins)
            copy(np.maximum(largest[limb], margins), largest[limb])
            i = int(margins.argmax())
            if margins[i] > worst.margin_m[limb]:
                worst.margin_m[limb], worst.motion[limb] = margins[i], start + i
                worst.time_s[limb] = block.times[instant, i]
                copy(points[:, i], worst.point_m[limb])
                _take(block, i, best, limb)
    for limb in range(len(worst.margin_m)):
        worst.escapes[limb] += (largest[limb] > ROUNDING_M).sum()
    for i in range(count):
        worst.escapes[-1] += largest[:, i].max() > ROUNDING_M


@kernel
def _select(block: Block, corners: Corners, point: int, limb: int, instant: int, points: Floats) -> None:
    """A point of all motions at one instant, (3, b); at the start where what moves its limb was not followed so far."""
    for i in range(len(block.q)):
        valid = True
        for g in range(len(GROUPS)):
            valid = valid and not (corners.moved_by[limb, g] and instant >= block.alive[g, i])
        for k in range(3):
            points[k, i] = block.points[point, instant if valid else 0, k, i]
