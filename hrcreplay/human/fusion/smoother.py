"""The offline smoother of Rauch, Tung and Striebel: each tick by the measurements before and after it.

It is a reference for the filter, and the recorded person where a log has no ground truth. A test compares it with
filterpy's, which takes one joint at a time; ``hrcreplay bench`` times both.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hrcreplay.geometry.small_matrices import solve
from hrcreplay.human.fusion.fuse import Trace, process_noise
from hrcreplay.human.fusion.kalman import dot
from hrcreplay.human.model import LEFT_ARM, RIGHT_ARM, nearest
from hrcreplay.kernels import njit
from hrcreplay.records import DOF, Floats, HumanStates, Ints
from hrcreplay.settings.sections import Fusion

#: Unit of time in the smoother, in which the four states have similar magnitudes [s].
_UNIT_S = 0.05
_SCALE = _UNIT_S ** np.arange(4.0)


def smooth(states: HumanStates, trace: Trace, settings: Fusion) -> HumanStates:
    """Smooths every tick with all measurements of the run, joint by joint.

    The angles of each arm keep one form through the run (``human.model``), so a smoothed angle does not jump. Lengths
    are constants, so the last estimate is the best for all ticks. Memory: 1.5 kB a tick for the trace.

    Args:
        states: States of one whole run.
        trace: Trace of the same ticks, from ``fuse``.
        settings: Settings of the run.

    Returns:
        The smoothed states; rows before the first measurement stay NaN.
    """
    live = np.flatnonzero(np.isfinite(states.p[:, 0]))
    if len(live) < 2:
        return states
    first = live[0]
    mean, cov = _one_name(states, first) * _SCALE, trace.cov[first:] * (_SCALE[:, None] * _SCALE)
    steps, of_tick = _steps(states.t_ns[first:], trace.damping[first:])
    Q = np.array([[process_noise(settings, j, *step) for j in range(DOF)] for step in steps]) * _SCALE**2
    _run(mean, cov, np.array([_transition(*step) for step in steps]), Q, of_tick)
    mean /= _SCALE
    std = np.sqrt(np.stack([cov[:, :, k, k] for k in range(2)])) / _SCALE[:2, None, None]
    return replace(
        states,
        p=_put(states.p, first, mean[:, :, 0]),
        v=_put(states.v, first, mean[:, :, 1]),
        a=_put(states.a, first, mean[:, :, 2]),
        j=_put(states.j, first, mean[:, :, 3]),
        p_std=_put(states.p_std, first, std[0]),
        v_std=_put(states.v_std, first, std[1]),
        lengths_m=_put(states.lengths_m, first, states.lengths_m[-1]),
        lengths_std_m=_put(states.lengths_std_m, first, states.lengths_std_m[-1]),
    )


def _steps(t_ns: Ints, damping: Floats) -> tuple[Floats, Ints]:
    """The different steps (k, 2) [s, damping], of which most ticks share a few, and the step (n, 13) to each tick."""
    each = np.empty(damping.shape, np.complex128)  # pairs that are sorted much faster than rows
    each.real, each.imag = (np.diff(t_ns, prepend=t_ns[0]) * 1e-9)[:, None], damping
    steps, which = np.unique(each, return_inverse=True)
    return np.column_stack([steps.real, steps.imag]), which.reshape(damping.shape).astype(np.int64)


def _transition(dt: float, damping: float) -> Floats:
    """F of Eq. (43) for one joint in the smoother's unit, (4, 4), its derivatives damped."""
    F = np.eye(4) + np.eye(4, k=1) * dt + np.eye(4, k=2) * dt**2 / 2.0 + np.eye(4, k=3) * dt**3 / 6.0
    F[1:] *= damping
    return np.asarray(F * (_SCALE[:, None] / _SCALE))


@njit(cache=True, error_model="numpy")
def _run(mean: Floats, cov: Floats, Fs: Floats, Qs: Floats, of_tick: Ints) -> None:
    """Smooths means (n, 13, 4) and covariances (n, 13, 4, 4) in place, from the last tick to the first.

    With F and Q of the step to the next tick: K = P F' (F P F' + Q)^-1, x += K (x_next - F x), P += K (P_next - F P F'
    - Q) K'.

    Args:
        mean: Of the filter.
        cov: Likewise.
        Fs: (k, 4, 4) transition of each different step.
        Qs: (k, 13, 4) diagonal of its noise.
        of_tick: (n, 13) the step to each tick.
    """
    predicted, FP, K, off = np.empty((4, 4)), np.empty((4, 4)), np.empty((4, 4)), np.empty(4)
    for i in range(len(mean) - 2, -1, -1):
        for j in range(mean.shape[1]):
            step = of_tick[i + 1, j]
            F, P = Fs[step], cov[i, j]
            _product(F, P, FP)
            _product(FP, F.T, predicted)
            for a in range(4):
                predicted[a, a] += Qs[step, j, a]
                off[a] = mean[i + 1, j, a] - dot(F[a], mean[i, j])
            for a in range(4):
                K[a] = solve(predicted, FP[:, a])
                mean[i, j, a] += dot(K[a], off)
            predicted[:] = cov[i + 1, j] - predicted
            _product(K, predicted, FP)
            _product(FP, K.T, predicted)
            P += predicted


@njit(cache=True, inner=True)
def _product(A: Floats, B: Floats, C: Floats) -> None:
    """Writes A B, all (4, 4), into C."""
    for a in range(4):
        for b in range(4):
            C[a, b] = A[a, 0] * B[0, b] + A[a, 1] * B[1, b] + A[a, 2] * B[2, b] + A[a, 3] * B[3, b]


def _one_name(states: HumanStates, first: int) -> Floats:
    """Converts means (n, 13, 4) so that each posture has the form nearest to the previous one."""
    mean = np.stack([states.p, states.v, states.a, states.j], axis=2)[first:]
    for k in range(1, len(mean)):
        p = nearest(mean[k : k + 1, :, 0], mean[k - 1 : k, :, 0])[0]
        mirrored = np.abs(np.sin(0.5 * (p - mean[k, :, 0]))) > 0.5  # alpha_1 moved by pi, not by a turn or not at all
        for first_of_arm in (RIGHT_ARM, LEFT_ARM):
            if mirrored[first_of_arm]:
                mean[k, first_of_arm + 1] *= -1.0
        mean[k, :, 0] = p
    return mean


def _put(whole: Floats, first: int, tail: Floats) -> Floats:
    changed = whole.copy()
    changed[first:] = tail
    return changed
