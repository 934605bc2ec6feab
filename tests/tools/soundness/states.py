"""People all over the admissible range, and what is known of them."""

from __future__ import annotations

import numpy as np

from hrcreplay.human.model import LimitSet, skeleton
from hrcreplay.records import BODY, DOF, LENGTHS, Floats, HumanStates
from tests.tools.soundness.joint import bounds_of, rates_of, stops_at
from tests.tools.soundness.motion import allowed
from tests.tools.soundness.truth import Estimate

#: Lengths of a grown person [m]; people are drawn within a quarter of them.
_LENGTHS_M = np.array([0.5, 0.2, 0.19, 0.3, 0.3, 0.27, 0.27])
_LENGTHS_SPREAD = 0.25
#: Places and headings are drawn up to this far from 0 [m, rad].
_FAR = 4.0
#: Shares of states: at rest, with some joints at a velocity bound, with some at a position limit, and with
#: velocities that need not allow to brake in time.
_AT_REST, _AT_SPEED, _AT_LIMIT, _RECKLESS = 0.1, 0.4, 0.15, 0.25
#: So much above their bounds velocities may be, where they may.
_BEYOND = 2.5
#: Standard deviations of estimates are up to these: places, angles, their rates, lengths.
_STD = np.array([0.03, 0.1, 0.3, 0.02])


def draw_estimate(
    rng: np.random.Generator, limits: LimitSet, sigmas: float = 0.0, beyond: bool = False, coasted_s: float = 0.0
) -> Estimate:
    """A person, and an estimate of them that is within so many standard deviations of the truth, entry by entry.

    Args:
        rng: Chance.
        limits: What the person keeps to.
        sigmas: How many standard deviations; 0 for an exact estimate.
        beyond: Whether velocities may be above their bounds.
        coasted_s: For how long the estimate has gone on without being measured, whatever the person did [s].
    """
    fastest = _BEYOND if beyond and rng.random() < 0.5 else 1.0
    q, v = _draw(rng, limits, fastest)
    lengths = _LENGTHS_M * rng.uniform(1.0 - _LENGTHS_SPREAD, 1.0 + _LENGTHS_SPREAD, len(LENGTHS))
    world = v.copy()
    c, s = np.cos(q[2]), np.sin(q[2])
    world[0], world[1] = c * v[0] - s * v[1], s * v[0] + c * v[1]
    std = np.concatenate([[_STD[0]] * 2, [_STD[1]] * 10, [_STD[0]], [_STD[2]] * DOF, [_STD[3]] * len(LENGTHS)])
    std = (std * rng.random() * rng.random(len(std))) if sigmas > 0.0 else 0.0 * std
    off = sigmas * std
    if coasted_s > 0.0:
        fast = np.maximum(limits.v_max, -limits.v_min)
        off[DOF : 2 * DOF] = 10.0 * fast.max()  # nothing is known
        fast[:2] = fast[:2].max() / np.sqrt(2.0)  # whatever the heading
        off[:DOF] += coasted_s * fast
    true = np.concatenate([q, world, lengths])
    estimated = true + off * rng.uniform(-1.0, 1.0, len(off))
    (p, v_world, pi), (p_off, v_off, pi_off) = (np.split(parts.copy(), [DOF, 2 * DOF]) for parts in (estimated, off))
    v_low, v_high = fastest * limits.v_min, fastest * limits.v_max
    return Estimate(p, v_world, pi, p_off, v_off, pi_off, v_low, v_high, q, v, lengths, std)


def _draw(rng: np.random.Generator, limits: LimitSet, fastest: float) -> tuple[Floats, Floats]:
    """An admissible posture (13,) and velocity (13,), the latter's first two forward and to the left."""
    bounds = bounds_of(limits)
    v_min, v_max = fastest * limits.v_min, fastest * limits.v_max
    q, v = np.empty(DOF), rng.uniform(v_min, v_max)
    speed, at_limit, reckless = rng.random(), rng.random() < _AT_LIMIT, rng.random() < _RECKLESS
    if speed < _AT_REST:
        v[:] = 0.0
    elif speed < _AT_REST + _AT_SPEED:
        v = np.where(rng.random(DOF) < 0.6, np.where(rng.random(DOF) < 0.5, v_min, v_max), v)
    for j in range(DOF):
        low, high = np.clip(allowed(j, q, q, bounds), -_FAR, _FAR)
        q[j] = rng.uniform(low, high)
        if at_limit and j >= 3 and rng.random() < 0.3:
            q[j] = low if rng.random() < 0.5 else high
        if j >= 3 and not reckless and not low <= stops_at(q[j], v[j], rates_of(bounds, j)) <= high:
            room = high - q[j] if v[j] > 0.0 else low - q[j]
            brake = limits.a_min[j] if v[j] > 0.0 else limits.a_max[j]
            v[j] = np.sign(v[j]) * np.sqrt(max(0.0, -2.0 * brake * room)) * rng.uniform(0.0, 0.999)
    return q, v


def states_of(estimates: list[Estimate], unseen_s: float = 0.0) -> HumanStates:
    """The estimates as fused states, a row each, of people that nobody has seen for so long."""
    n = len(estimates)
    zeros = np.zeros((n, DOF))
    p_std, v_std, lengths_std = np.split(np.array([e.std for e in estimates]), [DOF, 2 * DOF], axis=1)
    return HumanStates(
        t_ns=np.arange(n, dtype=np.int64) * 4_000_000,
        p=np.array([e.q for e in estimates]),
        v=np.array([e.v_world for e in estimates]),
        a=zeros,
        j=zeros,
        p_std=p_std,
        v_std=v_std,
        lengths_m=np.array([e.lengths for e in estimates]),
        lengths_std_m=lengths_std,
        valid=np.ones((n, 1), dtype=bool),
        residual_m=np.zeros((n, len(BODY))),
        unseen_s=np.full((n, len(BODY)), unseen_s),
        frame_age_s=np.full(n, unseen_s),
        points_m=skeleton(np.array([e.q for e in estimates]), np.array([e.lengths for e in estimates])),
        cameras=("camera",),
    )
