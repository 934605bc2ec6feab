"""Motions of the model, integrated here by small steps, against the volumes of ``sound``."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from hrcreplay.human.margins import Margins
from hrcreplay.human.model import LimitSet, alpha_2_bounds, alpha_3_bounds, skeleton
from hrcreplay.human.occupancy import Radii, predict
from hrcreplay.limits import load_limits
from hrcreplay.records import LIMBS, Floats, HumanStates, SweptVolumes
from tests.human.people import limb_points, random_states

T = 0.377
PAPER, HUMAN = load_limits("paper"), load_limits("human")
BARE = Margins(sigmas=0.0, hand_m=0.0, legs=False)
STEPS = 40


def volumes(people: HumanStates, limits: LimitSet = PAPER, margins: Margins = BARE) -> SweptVolumes:
    return predict(people, limits, horizon_s=T, radii=Radii(), method="sound", margins=margins)


def uncertain(people: HumanStates, p_std: float, v_std: float, lengths_std_m: float) -> HumanStates:
    return dataclasses.replace(
        people,
        p_std=np.full_like(people.p, p_std) * np.where(np.arange(12) < 2, 0.3, 1.0),
        v_std=np.full_like(people.v, v_std),
        lengths_std_m=np.full_like(people.lengths_m, lengths_std_m),
    )


def stopped(p: Floats, limits: LimitSet) -> tuple[Floats, Floats]:
    """The stops of postures (n, 12): least and most, each (n, 12)."""
    least, most = np.tile(limits.p_min, (len(p), 1)), np.tile(limits.p_max, (len(p), 1))
    for i in range(len(p) if limits.coupled else 0):
        for a in (4, 8):
            a1 = min(max(p[i, a], least[i, a]), most[i, a])
            least[i, a + 1], most[i, a + 1] = alpha_2_bounds(a1, a1)
            a2 = min(max(p[i, a + 1], least[i, a + 1]), most[i, a + 1])
            least[i, a + 2], most[i, a + 2] = alpha_3_bounds(a1, a1, a2, a2)
    return least, most


def motions(
    rng: np.random.Generator, p: Floats, v: Floats, limits: LimitSet, count: int, sharp: bool
) -> list[tuple[Floats, Floats]]:
    """Postures (count, 12) of random motions from one true state at some instants; v of x and y in the body's frame.

    Bang-bang with a switch, or accelerations all over. The integral of a piece is never more than the model allows:
    velocities are integrated by the trapezoid of what the bounds let through. Stops end what goes into them.
    """
    q, w = np.tile(p, (count, 1)), np.tile(v, (count, 1))
    first, second = (rng.choice([0.0, 1.0], (count, 12)) if sharp else rng.random((count, 12)) for _ in range(2))
    switch = rng.uniform(0, 1.2, (count, 12))
    dt, seen = T / STEPS, [(q.copy(), w.copy())]
    for k in range(STEPS):
        share = np.where(k / STEPS < switch, first, second)
        a = limits.a_min + share * (limits.a_max - limits.a_min)
        after = np.clip(
            w + a * dt, np.minimum(limits.v_min, w + limits.a_max * dt), np.maximum(limits.v_max, w + limits.a_min * dt)
        )
        mean, w = 0.5 * (w + after), after
        turn = q[:, 2] + 0.5 * dt * mean[:, 2]
        q[:, 0] += dt * (np.cos(turn) * mean[:, 0] - np.sin(turn) * mean[:, 1])
        q[:, 1] += dt * (np.sin(turn) * mean[:, 0] + np.cos(turn) * mean[:, 1])
        q[:, 2:] += dt * mean[:, 2:]
        least, most = stopped(q, limits)
        held = q.copy()  # who starts beyond a stop gets no further out
        held[:, 3:] = np.clip(q, np.minimum(least, p), np.maximum(most, p))[:, 3:]
        w, q = np.where(held == q, w, 0.0), held
        if k % 8 == 7:
            seen.append((q.copy(), w.copy()))
    return seen


def worst(people: HumanStates, limits: LimitSet, margins: Margins, seed: int, count: int = 120) -> tuple[float, str]:
    """How far any sampled motion is out of its volume [m], and which."""
    rng = np.random.default_rng(seed)
    swept = volumes(people, limits, margins)
    k, largest, where = margins.sigmas, -np.inf, ""
    for i in range(len(people)):
        solids = [ConvexHull(swept.vertices(i, limb)).equations for limb in range(len(LIMBS))]
        room = swept.radius_m[i] - np.append(Radii().of_limbs(), np.zeros(len(swept.limbs) - 6))
        for sharp in (True, False):
            side = rng.choice([-1.0, 1.0], (3, 12)) if sharp else rng.uniform(-1, 1, (3, 12))
            p, v = people.p[i] + k * people.p_std[i] * side[0], people.v[i] + k * people.v_std[i] * side[1]
            c, s = np.cos(p[2]), np.sin(p[2])
            v[0], v[1] = c * v[0] + s * v[1], c * v[1] - s * v[0]
            lengths = people.lengths_m[i] + k * people.lengths_std_m[i] * side[2, :8]
            lengths[6:] += margins.hand_m
            for q, _ in motions(rng, p, v, limits, count, sharp):
                points = skeleton(q, np.tile(lengths, (count, 1)))
                for limb, name in enumerate(LIMBS):
                    reached = np.concatenate([limb_points(body, name) for body in points])
                    out = (reached @ solids[limb][:, :3].T + solids[limb][:, 3]).max() - room[limb]
                    if out > largest:
                        largest, where = out, f"row {i}, {name}, sharp {sharp}"
    return float(largest), where


@pytest.mark.parametrize("limits", [PAPER, HUMAN], ids=lambda limits: limits.name)
@pytest.mark.parametrize("std", [0.0, 0.1], ids=["known", "uncertain"])
def test_no_motion_leaves(limits: LimitSet, std: float) -> None:
    people = uncertain(random_states(limits, 40, 3), 0.5 * std, std, 0.05 * std)
    margins = BARE if std == 0.0 else Margins(sigmas=2.0, legs=False)
    out, where = worst(people, limits, margins, 1)
    assert out <= 0.0, where
