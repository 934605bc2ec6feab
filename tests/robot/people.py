"""People made for tests of the controllers: limbs as clouds of points around segments, moving as a formula says."""

from __future__ import annotations

import numpy as np

from hrcreplay.records import LIMBS, Floats, SweptVolumes

RADII = np.array([0.12, 0.15, 0.07, 0.07, 0.07, 0.07])


def cloud(rng: np.random.Generator, points: int, size_m: Floats) -> Floats:
    """Points on an ellipsoid about the origin: every one a vertex of the hull."""
    unit = rng.normal(size=(points, 3))
    return unit / np.linalg.norm(unit, axis=1)[:, None] * size_m


def volumes(limbs: list[Floats], t_ns: int = 0) -> SweptVolumes:
    """One tick of up to six limbs from their vertices."""
    offsets = np.cumsum([0, *(len(limb) for limb in limbs)])
    return SweptVolumes(
        np.array([t_ns]),
        offsets,
        np.concatenate([np.reshape(limb, (-1, 3)) for limb in limbs]),
        RADII[None, : len(limbs)].copy(),
        LIMBS[: len(limbs)],
        "paper",
    )


def person(
    ticks: int, dt_s: float, at_m: tuple[float, float], sway_m: float, *, seed: int, points: int = 40
) -> SweptVolumes:
    """A person who sways towards the origin and back and waves an arm, a row a tick."""
    rng = np.random.default_rng(seed)
    shapes = [cloud(rng, points, rng.uniform(0.05, 0.25, 3)) for _ in LIMBS]
    home = np.array(
        [[0, 0, 1.7], [0, 0, 1.2], [-0.2, 0.25, 1.3], [-0.45, 0.2, 1.2], [-0.1, -0.25, 1.3], [-0.3, -0.3, 1.1]]
    )
    rows = []
    for tick in range(ticks):
        t = tick * dt_s
        centre = np.array([at_m[0] - sway_m * np.sin(1.7 * t) ** 2, at_m[1] + 0.2 * np.sin(0.9 * t), 0.0])
        wave = 0.25 * np.sin(2.3 * t) * np.array([-0.6, 0.4, 0.5])
        for limb, shape in enumerate(shapes):
            rows.append(shape + home[limb] + centre + (wave if LIMBS[limb] == "LRA" else 0.0))
    offsets = np.arange(len(rows) + 1) * points
    t_ns = (np.arange(ticks) * dt_s * 1e9).round().astype(np.int64)
    return SweptVolumes(t_ns, offsets, np.concatenate(rows), np.tile(RADII, (ticks, 1)), LIMBS, "paper")
