"""Offline reference: the fused person once more, knowing what came after (Rauch, Tung, Striebel)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from filterpy.kalman import KalmanFilter

from hrcreplay.human.branches import nearest
from hrcreplay.human.fusion import FusionSettings, Trace, process_noise
from hrcreplay.records import Floats, HumanStates

#: Derivatives are smoothed in units of this time, where the four states have about the same size [s].
_UNIT_S = 0.05


def smooth(states: HumanStates, trace: Trace, settings: FusionSettings) -> HumanStates:
    """Every tick given all measurements of the run, by filterpy's smoother joint by joint.

    The arms are followed under one name through the run (see branches) and keep it: a smoothed angle does not jump.
    Lengths are constants, so the last estimate is the best for all ticks. About 0.5 ms a tick; memory 1.5 kB a tick
    for the trace and as much again for one joint at a time.

    Args:
        states: Of one whole run.
        trace: Of the same ticks, from ``fuse_traced``.
        settings: Those of the run.

    Returns:
        The smoothed states; rows before the first measurement stay NaN.
    """
    live = np.flatnonzero(np.isfinite(states.p[:, 0]))
    if len(live) < 2:
        return states
    first = live[0]
    dt = np.diff(states.t_ns[first:], prepend=states.t_ns[first]) * 1e-9
    mean, cov = _one_name(states, first), trace.cov[first:]
    smoothed, std = mean.copy(), np.empty((*mean.shape[:2], 2))
    for j in range(mean.shape[1]):
        smoothed[:, j], std[:, j] = _smooth_joint(mean[:, j], cov[:, j], dt, trace.damping[first:, j], settings, j)
    return replace(
        states,
        p=_put(states.p, first, smoothed[:, :, 0]),
        v=_put(states.v, first, smoothed[:, :, 1]),
        a=_put(states.a, first, smoothed[:, :, 2]),
        j=_put(states.j, first, smoothed[:, :, 3]),
        p_std=_put(states.p_std, first, std[:, :, 0]),
        v_std=_put(states.v_std, first, std[:, :, 1]),
        lengths_m=_put(states.lengths_m, first, states.lengths_m[-1]),
        lengths_std_m=_put(states.lengths_std_m, first, states.lengths_std_m[-1]),
    )


def _smooth_joint(
    mean: Floats, cov: Floats, dt: Floats, damping: Floats, settings: FusionSettings, j: int
) -> tuple[Floats, Floats]:
    """Smoothed mean (n, 4) and standard deviations of p and v (n, 2) of one joint."""
    scale = _UNIT_S ** np.arange(4.0)
    Fs, Qs = np.zeros_like(cov), np.zeros_like(cov)
    for k in range(1, len(dt)):
        Fs[k] = _transition(dt[k], damping[k])
        Qs[k] = np.diag(process_noise(settings, j, dt[k], damping[k]))
    both = scale[:, None] * scale
    x, P, _, _ = KalmanFilter(4, 1).rts_smoother(
        mean * scale, cov * both, list(Fs * (scale[:, None] / scale)), list(Qs * both)
    )
    return x / scale, np.sqrt(np.stack([P[:, k, k] for k in range(2)], axis=1)) / scale[:2]


def _transition(dt: float, damping: float) -> Floats:
    """F of Eq. (43) for one joint, (4, 4), its derivatives damped."""
    F = np.eye(4) + np.eye(4, k=1) * dt + np.eye(4, k=2) * dt**2 / 2.0 + np.eye(4, k=3) * dt**3 / 6.0
    F[1:] *= damping
    return F


def _one_name(states: HumanStates, first: int) -> Floats:
    """Means (n, 12, 4) with each posture by the name nearest to the one before."""
    mean = np.stack([states.p, states.v, states.a, states.j], axis=2)[first:]
    for k in range(1, len(mean)):
        p = nearest(mean[k : k + 1, :, 0], mean[k - 1 : k, :, 0])[0]
        mirrored = np.abs(np.sin(0.5 * (p - mean[k, :, 0]))) > 0.5  # alpha_1 moved by pi, not by a turn or not at all
        for first_of_arm in (4, 8):
            if mirrored[first_of_arm]:
                mean[k, first_of_arm + 1] *= -1.0
        mean[k, :, 0] = p
    return mean


def _put(whole: Floats, first: int, tail: Floats) -> Floats:
    changed = whole.copy()
    changed[first:] = tail
    return changed
