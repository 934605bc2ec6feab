"""The Kalman filter of one joint with the states p, v, a, j, Eq. (42)-(57); corrections: docs/paper.md.

The arrays that the kernels of the fusion share are defined here too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hrcreplay.kernels import njit
from hrcreplay.records import Bools, Floats, Ints

#: Time before every tick, for events that have not occurred yet [ns].
NEVER_NS = -(2**62)
#: Maximum age of the observation of a point, a few frames of any camera; an older hand or leg is unknown [ns].
SHOWN_NS = 200_000_000


class StateEstimate(NamedTuple):
    """Estimate of the person: joints, lengths, and how well they fit their frames."""

    tick_ns: Ints  #: (1,) the last tick
    started: Bools  #: (1,) True if there is a person
    mean: Floats  #: (13, 4) p, v, a, j
    cov: Floats  #: (13, 4, 4)
    lengths: Floats  #: (7,)
    lengths_var: Floats  #: (7,)
    row_ns: Ints  #: (20,) tick at which a row (JOINTS, then LENGTHS) was last valid
    acquired_ns: Ints  #: (20,) tick at which a row restarted
    bone_ns: Ints  #: (7,) tick at which a camera last saw a length that agreed with the filter
    innovation: Floats  #: (c, 13) each joint's last normalised innovation by a camera
    squares: Floats  #: (13,) running sum of the squares of these
    products: Floats  #: (13,) running sum of their products with the same camera's one before
    spread: Floats  #: (13,) maximum square, decaying


class Gate(NamedTuple):
    """Frame held for each camera, and which of its rows and points are valid."""

    point_ns: Ints  #: (20,) tick at which a body point last agreed with the filter
    refused_ns: Ints  #: (c, 20) tick since which a camera has shown a point at another place
    refused_at: Floats  #: (c, 20, 3) last such place
    apart: Floats  #: (c, 6) maximum distance of these places from the filter's estimate, per limb; 0 without one [m]
    capture_ns: Ints  #: (c,) capture of the stored frame of each camera
    uses: Ints  #: (c,) number of ticks that used this frame; -1 without one
    newest_ns: Ints  #: (1,) capture of the newest frame of any camera that entered the filter
    z: Floats  #: (c, 20) its rows
    z_var: Floats  #: (c, 20) sigma_z^2
    points: Floats  #: (c, 20, 3)
    confidence: Floats  #: (c, 20)
    valid: Bools  #: (c, 20) True for its used rows
    shows: Bools  #: (c, 6) True for limbs that it shows, together with all limbs that carry them
    trusted: Bools  #: (c, 20) True for its points that agree with the filter, or were relearnt, and count
    wrong: Floats  #: (c, 20) share of the recent frames with evidence against a point
    judged_ns: Ints  #: (c,) tick of the last frame that was judged
    disbelieved: Bools  #: (c, 20) True for points that it shows wrong, while another camera shows them


class ModelResidual(NamedTuple):
    """Distances of the body from its model, and body points beside the model."""

    residuals: Floats  #: (7, BINS) weights of the residuals of each limb of BODY, by their size
    weight: Floats  #: (7,) sum of these weights
    samples: Ints  #: (7,) number of residuals so far
    sampled_ns: Ints  #: (7,) tick of the last residual
    residual: Floats  #: (7,) their quantile [m]
    peak: Floats  #: (7,) maximum of the recent residuals [m]
    peak_ns: Ints  #: (7,) tick of this maximum
    offset: Floats  #: (20, 3) running mean of the points' offsets from the model, in the torso's frame [m]
    offset_weight: Floats  #: (20,) sum of the weights in that mean
    offset_ns: Ints  #: (20,) tick of the last sample
    carried: Floats  #: (c, 20, 3) each camera's hands from the wrist, legs from below the pelvis, others from the model
    carried_ns: Ints  #: (c, 20) capture of that observation
    leg_bones: Floats  #: (c, 4) mean length of the thighs, then shanks, right and left, that a camera shows [m]
    leg_bones_seen: Ints  #: (c, 4) number of observations in that mean
    leg_bones_ns: Ints  #: (c, 4) tick at which one last agreed with it
    sway: Floats  #: (c, 8) mean square of the recent ways of LEG_POINTS beside the pelvis [m^2]
    sway_from: Floats  #: (c, 8, 3) where the way under way began, from below the pelvis [m]
    sway_ns: Ints  #: (c, 8) capture of that
    foot: Floats  #: (2, 3) last observed offset of the right and left foot from the ankle, in the body's heading [m]


class Filter(NamedTuple):
    """State of the fusion between two ticks."""

    estimate: StateEstimate
    gate: Gate
    model: ModelResidual


class Frames(NamedTuple):
    """Frames in order of arrival."""

    capture_ns: Ints
    arrival_ns: Ints
    camera: Ints
    z: Floats
    z_var: Floats
    points: Floats
    confidence: Floats


class Rules(NamedTuple):
    """Settings and limits as the kernels need them."""

    sigma: Floats  #: (13, 4) of Eq. (44)
    reuse: bool
    compensate: bool
    delay_max_s: float
    confidence_min: float
    outlier_m: float
    bone_m: float
    memory_ns: int
    relearn_ns: int
    bone_memory_ns: int
    coast_ns: int
    residual_quantile: float
    residual_memory_s: float
    residual_hold_ns: int
    offset_memory_s: float
    spread_memory_s: float
    spread_least: float
    spread_most: float
    rest_s: float
    rest_std: Floats  #: (13, 3) standard deviations of v, a, j of a joint unseen for a long time
    p_min: Floats
    p_max: Floats
    v_min: Floats
    v_max: Floats
    a_min: Floats
    a_max: Floats
    coupled: bool


class Track(NamedTuple):
    """Output of the ticks: n rows, and the counts of events."""

    motion: Floats  #: (6, n, 13) p, v, a, j, and the reported deviations of p and v
    lengths: Floats  #: (2, n, 7) and their deviations
    valid: Bools  #: (n, c)
    residual: Floats  #: (n, 7)
    unseen: Floats  #: (n, 7)
    frame_age: Floats  #: (n,)
    points: Floats  #: (n, 20, 3)
    camera_points: Floats  #: (n, c, 20, 3)
    legs_sway: Floats  #: (n,)
    cov: Floats  #: (n or 0, 13, 4, 4)
    damping: Floats  #: (n or 0, 13) of the derivatives, on the way to the tick
    spread: Floats  #: (n or 0, 13) of the filter
    autocorrelation: Floats  #: (n or 0, 13) of the innovations
    outliers: Ints  #: (c,)
    disbelieved: Ints  #: (c, 20)
    superseded: Ints  #: (c,)
    reacquired: Ints  #: (1,)
    saturated: Ints  #: (1,)


@njit(inner=True, inline="always")  # passing the filter on would take longer than this
def one_of(filters: Filter, k: int) -> Filter:
    """The filter of one person, of filters whose arrays have one more axis, that of the people, before all others."""
    estimate, gate, model = filters
    # fmt: off
    return Filter(
        StateEstimate(
            estimate.tick_ns[k], estimate.started[k], estimate.mean[k], estimate.cov[k], estimate.lengths[k],
            estimate.lengths_var[k], estimate.row_ns[k], estimate.acquired_ns[k], estimate.bone_ns[k],
            estimate.innovation[k], estimate.squares[k], estimate.products[k], estimate.spread[k],
        ),
        Gate(
            gate.point_ns[k], gate.refused_ns[k], gate.refused_at[k], gate.apart[k], gate.capture_ns[k],
            gate.uses[k], gate.newest_ns[k], gate.z[k], gate.z_var[k], gate.points[k], gate.confidence[k],
            gate.valid[k], gate.shows[k], gate.trusted[k], gate.wrong[k], gate.judged_ns[k], gate.disbelieved[k],
        ),
        ModelResidual(
            model.residuals[k], model.weight[k], model.samples[k], model.sampled_ns[k], model.residual[k],
            model.peak[k], model.peak_ns[k], model.offset[k], model.offset_weight[k], model.offset_ns[k],
            model.carried[k], model.carried_ns[k], model.leg_bones[k], model.leg_bones_seen[k],
            model.leg_bones_ns[k], model.sway[k], model.sway_from[k], model.sway_ns[k], model.foot[k],
        ),
    )
    # fmt: on


@njit(cache=True, inner=True)
def delay(capture_ns: int, now: int, rules: Rules) -> float:
    """Age of a frame [s]; 0 if delays are ignored.

    Args:
        capture_ns: Its capture [ns].
        now: The tick [ns].
        rules: Compensation of delays, and the maximum delay [s].
    """
    if not rules.compensate:
        return 0.0
    return max(0.0, min((now - capture_ns) * 1e-9, rules.delay_max_s))


@njit(cache=True, inner=True)
def predict(mean: Floats, P: Floats, dt: float, damping: float, sigma: Floats, rest_std: Floats) -> None:
    """Eq. (42), (48), (49) over dt seconds, mean (4,) and P (4, 4) in place.

    x, y and heading are joints like the others, with independent world velocities: the linear model of Eq. (31). F is
    upper triangular, so each row is computed before the rows it needs change. With a damping below 1 the derivatives
    also decay towards rest, with standard deviations ``rest_std`` (3,).

    Args:
        mean: (4,) p, v, a, j [m or rad, and these per s, s^2, s^3].
        P: (4, 4) its covariance.
        dt: Length of the step [s].
        damping: Factor on the derivatives over the step, in (0, 1].
        sigma: (4,) of Eq. (44) for p, v, a, j [m or rad per s^2, s^2.5, s^3, s^3.5].
        rest_std: (3,) standard deviations of v, a, j of an unseen joint [m or rad per s, s^2, s^3].
    """
    taylor = (1.0, dt, dt**2 / 2.0, dt**3 / 6.0)  # F of Eq. (43), corrected: s is p, v, a, j
    kept = (1.0, damping, damping, damping)
    for a in range(4):
        for k in range(a + 1, 4):
            mean[a] += taylor[k - a] * mean[k]
        mean[a] *= kept[a]
        for b in range(4):
            for k in range(a + 1, 4):
                P[a, b] += taylor[k - a] * P[k, b]
            P[a, b] *= kept[a]
    for a in range(4):
        for b in range(a, 4):
            for k in range(b + 1, 4):
                P[a, b] += taylor[k - b] * P[a, k]
            P[a, b] *= kept[b]
            P[b, a] = P[a, b]
    for a in range(4):
        P[a, a] += process_variance(a, dt, damping, sigma, rest_std)


@njit(cache=True, inner=True)
def correct(mean: Floats, P: Floats, h: Floats, z: float, R: float) -> float:
    """Eq. (52)-(57) for one joint and one scalar row; returns the normalised innovation, over its standard deviation.

    A row whose innovation has zero variance, or one that overflows, is ignored.

    Args:
        mean: (4,) p, v, a, j [m or rad, and these per s, s^2, s^3], changed in place.
        P: (4, 4) its covariance, changed in place.
        h: (4,) row of H of Eq. (45), (46).
        z: The measured value [m or rad].
        R: Its variance [m^2 or rad^2].
    """
    Ph = np.empty(4)
    for a in range(4):
        Ph[a] = dot(P[a], h)
    S = dot(h, Ph) + R  # Eq. (53): K = Ph / S
    innovation = z - dot(h, mean)  # Eq. (52)
    if not (0.0 < S < np.inf and np.isfinite(innovation)):
        return 0.0
    for a in range(4):
        mean[a] += Ph[a] / S * innovation  # Eq. (54), (56)
        for b in range(4):
            P[a, b] -= Ph[a] * Ph[b] / S  # Eq. (55), corrected: (I - K H) P; Eq. (57)
    return innovation / np.sqrt(S)


@njit(cache=True)
def process_variance(a: int, dt: float, damping: float, sigma: Floats, rest_std: Floats) -> float:
    """Entry a of the diagonal of G of Eq. (44), corrected; with a damping, also the variance of the decay.

    Args:
        a: 0, 1, 2, 3 for p, v, a, j.
        dt: Length of the step [s].
        damping: Factor on the derivatives over the step, in (0, 1].
        sigma: (4,) of Eq. (44) for p, v, a, j [m or rad per s^2, s^2.5, s^3, s^3.5].
        rest_std: (3,) standard deviations of v, a, j of an unseen joint [m or rad per s, s^2, s^3].
    """
    remainder = (dt**4 / 24.0, dt**3 / 6.0, dt**2 / 2.0, dt)
    forgotten = (1.0 - damping**2) * rest_std[a - 1] ** 2 if a > 0 else 0.0
    return sigma[a] ** 2 * remainder[a] + forgotten


@njit(cache=True, inner=True)
def extrapolate_back(mean: Floats, d: float) -> Floats:
    """Extrapolates joint positions (13,) d seconds back, by the Taylor polynomial of Eq. (43)."""
    return mean[:, 0] - d * mean[:, 1] + d**2 / 2.0 * mean[:, 2] - d**3 / 6.0 * mean[:, 3]


@njit(cache=True, inner=True)
def dot(a: Floats, b: Floats) -> float:
    """The scalar product of (4,) and (4,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
