"""Random people, and Alg. 2 written plainly: matrices, no reduction."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from hrcreplay.human.model import LimitSet, clamp, skeleton
from hrcreplay.records import BODY, DOF, LIMBS, Floats, HumanStates

LENGTHS_M = np.array([0.5, 0.21, 0.19, 0.33, 0.34, 0.26, 0.27])


def states(p: Floats, v: Floats, lengths_m: Floats = LENGTHS_M) -> HumanStates:
    """States with the given postures and velocities, (n, 13) each."""
    zeros, lengths = np.zeros_like(p), np.tile(lengths_m, (len(p), 1))
    valid = np.ones((len(p), 1), dtype=bool)
    return HumanStates(
        t_ns=np.arange(len(p)) * 4_000_000,
        p=p,
        v=v,
        a=zeros,
        j=zeros,
        p_std=zeros,
        v_std=zeros,
        lengths_m=lengths,
        lengths_std_m=0 * lengths,
        valid=valid,
        residual_m=np.zeros((len(p), len(BODY))),
        unseen_s=np.zeros((len(p), len(BODY))),
        frame_age_s=np.zeros(len(p)),
        points_m=skeleton(p, lengths),
        cameras=("camera",),
    )


def random_states(limits: LimitSet, count: int, seed: int) -> HumanStates:
    """Postures and velocities all over the admissible range."""
    rng = np.random.default_rng(seed)
    p = rng.uniform(np.maximum(limits.p_min, -4.0), np.minimum(limits.p_max, 4.0), (count, DOF))
    v = rng.uniform(limits.v_min, limits.v_max, (count, DOF))
    c, s = np.cos(p[:, 2]), np.sin(p[:, 2])
    v[:, 0], v[:, 1] = c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1]
    return states(clamp(p, limits), v)


def raw_cloud(limb: str, low: Floats, high: Floats, lengths_m: Floats = LENGTHS_M) -> Floats:
    """Every point that Alg. 2 makes for a limb, triangles of at most 60 degrees with all their corners."""
    torso, head, half_shoulder, upper_l, upper_r, fore_l, fore_r = lengths_m
    side, arm = (1.0, slice(8, 12)) if limb in ("ULA", "LLA") else (-1.0, slice(4, 8))
    upper, fore = (upper_l, fore_l) if side > 0 else (upper_r, fore_r)
    (l1, l2, l3, l4), (h1, h2, h3, h4) = low[arm], high[arm]
    shoulder, pelvis = np.array([0, side * half_shoulder, torso]), np.array([0, 0, low[12]])
    if limb == "HD":
        points = np.array([[0, 0, torso], [0, 0, torso + head]])
    elif limb == "THX":
        points = np.array([[0, 0, 0], [0, 0, torso], [0, -half_shoulder, torso], [0, half_shoulder, torso]])
    else:
        elbow = np.array([0, 0, -upper])
        points = np.array([[0, 0, 0], elbow])
        if limb in ("LRA", "LLA"):
            points = _turn(np.array([[0, 0, 0], [0, 0, -fore]]), "y", -(np.pi - l4), -(np.pi - h4))
            points = elbow + _turn(points, "z", side * l3, side * h3)
        points = shoulder + _turn(_turn(points, "y", -l2, -h2), "x", side * l1, side * h1)
    points = _turn(pelvis + _turn(points, "y", low[3], high[3]), "z", low[2], high[2])
    return np.concatenate([points + np.array([x, y, 0]) for x in (low[0], high[0]) for y in (low[1], high[1])])


def _turn(points: Floats, axis: str, start: float, end: float) -> Floats:
    pieces = max(1, int(np.ceil(abs(end - start) / (np.pi / 3) - 1e-12)))
    cuts = np.linspace(start, end, pieces + 1)
    along = np.array([name == axis for name in "xyz"], dtype=float)
    clouds = [Rotation.from_euler(axis, angle).apply(points) for angle in cuts]
    for a, b in pairwise(cuts):
        stretched = (points - points * along) / np.cos((b - a) / 2) + points * along
        clouds.append(Rotation.from_euler(axis, (a + b) / 2).apply(stretched))
    return np.concatenate(clouds)


def directions(count: int, seed: int) -> Floats:
    """(count + 26, 3) random unit vectors, and the axes and diagonals."""
    grid = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)])
    vectors = np.concatenate([np.random.default_rng(seed).normal(size=(count, 3)), grid])
    unit: Floats = vectors / np.linalg.norm(vectors, axis=1)[:, None]
    return unit


def limb_points(skeleton: Floats, limb: str) -> Floats:
    """The ends of a limb among POINTS: (k, 3) of (20, 3)."""
    rows = {
        "HD": (2, 3),
        "THX": (0, 2, 4, 8),
        "URA": (8, 9),
        "LRA": (9, 10),
        "ULA": (4, 5),
        "LLA": (5, 6),
    }
    assert set(rows) == set(LIMBS)
    return skeleton[list(rows[limb])]
