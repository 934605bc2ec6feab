"""One tick of Alg. 3 on plain arrays, with the bounds on the fused state, Eq. (62)-(65).

The filter of Eq. (42)-(57) consists of 13 filters of four states, one per joint, and 7 of one state, one per length.
"""

from __future__ import annotations

import numpy as np

from hrcreplay.human.fusion.body_points import legs_sway, place
from hrcreplay.human.fusion.gating import validate_frame
from hrcreplay.human.fusion.inverse_kinematics import ROWS
from hrcreplay.human.fusion.kalman import (
    Filter,
    Frames,
    Gate,
    Rules,
    StateEstimate,
    Track,
    correct,
    delay,
    dot,
    predict,
)
from hrcreplay.human.fusion.model_residual import observe, write_residual, write_unseen_times
from hrcreplay.human.fusion.reported_deviations import add_innovation, autocorrelation, reset, write_deviations
from hrcreplay.human.model import LEFT_ARM, RIGHT_ARM, canonical_arm, clamp_row, nearest_arm, wrap
from hrcreplay.kernels import njit
from hrcreplay.records import DOF, Floats, Ints

#: Number of frames whose errors of a length are alike: a tracker that sees a bone too short does so for a while.
_ALIKE = 10.0
#: Hysteresis between the two forms of an arm's angles [rad].
_NAME_MARGIN = np.radians(20.0)


@njit(cache=True)
def run(ticks_ns: Ints, frames: Frames, filter_: Filter, rules: Rules, track: Track) -> None:
    """Runs Alg. 3 over the ticks, changing the filter in place. Frames must have arrived by the last tick.

    Args:
        ticks_ns: (n,) instants.
        frames: In order of arrival.
        filter_: The filter before the first tick; after the call, that after the last.
        rules: Settings and limits.
        track: Arrays for n ticks; receive the states and the counts of events.
    """
    row = 0
    for k in range(len(ticks_ns)):
        while row < len(frames.arrival_ns) and frames.arrival_ns[row] <= ticks_ns[k]:
            store(frames, row, filter_.gate, track.superseded)
            row += 1
        step(filter_, ticks_ns[k], rules, track, k)


@njit(inner=True, inline="always")  # passing the filter on would take longer than this
def step(filter_: Filter, now: int, rules: Rules, track: Track, k: int) -> None:
    """Runs one tick of Alg. 3 with the frames stored since the last one, and writes row ``k`` of the track.

    Without a valid row the a-priori estimate stays as it is, Eq. (50), (51).

    Args:
        filter_: The filter before the tick, changed in place.
        now: The tick [ns].
        rules: Settings and limits.
        track: Receives the row, and the counts of events.
        k: Index of the row.
    """
    write_unknown(track, k)
    track.camera_points[k] = np.nan
    damping = np.ones(DOF)
    dt = (now - filter_.estimate.tick_ns[0]) * 1e-9 if filter_.estimate.started[0] else 0.0
    if filter_.estimate.started[0]:
        _predict(filter_.estimate, now, rules, damping)
    fresh = filter_.gate.uses == 0
    for c in range(len(fresh)):
        if fresh[c]:
            validate_frame(filter_, c, now, rules, track.outliers, track.disbelieved[c])
    if filter_.estimate.started[0] and fresh.any():
        observe(filter_, fresh, now, rules, track.outliers)
    for c in range(len(fresh)):
        again = rules.reuse and filter_.gate.uses[c] > 0 and now - filter_.gate.capture_ns[c] <= rules.memory_ns
        if fresh[c] or again:
            track.valid[k, c] = _update(filter_, c, now, rules, track)
    filter_.estimate.tick_ns[0] = now
    if filter_.estimate.started[0]:
        _rename(filter_.estimate.mean)
        if saturate(filter_.estimate.mean, dt, rules):
            track.saturated[0] += 1
        _leave(filter_, k, rules, track, damping)
    elif len(track.cov) > 0:
        track.cov[k], track.damping[k], track.spread[k], track.autocorrelation[k] = np.nan, 1.0, np.nan, np.nan


@njit(cache=True, inner=True)
def write_unknown(track: Track, k: int) -> None:
    """Writes row ``k`` of a body whose joints are not known; its points as cameras show them stay as they are."""
    track.motion[:, k] = np.nan
    track.lengths[:, k] = np.nan
    track.valid[k] = False
    track.residual[k] = np.nan
    track.unseen[k] = np.inf
    track.frame_age[k] = np.inf
    track.points[k] = np.nan
    track.legs_sway[k] = np.nan


@njit(inner=True, inline="always")  # passing the filter on would take longer than this
def _predict(estimate: StateEstimate, now: int, rules: Rules, damping: Floats) -> None:
    """Computes the a-priori estimate, Eq. (48), (49).

    A joint unseen for longer than ``coast_ns`` decelerates to rest, as a polynomial with jerk diverges.
    """
    dt = (now - estimate.tick_ns[0]) * 1e-9
    for j in range(DOF):
        damping[j] = np.exp(-dt / rules.rest_s) if now - estimate.row_ns[j] > rules.coast_ns else 1.0
        predict(estimate.mean[j], estimate.cov[j], dt, damping[j], rules.sigma[j], rules.rest_std[j])


@njit(cache=True, inner=True)
def store(frames: Frames, row: int, gate: Gate, superseded: Ints) -> None:
    """Stores a frame that has arrived for the next tick, unless a newer one of the same camera has come before.

    Args:
        frames: In order of arrival.
        row: Index of the frame.
        gate: Receives it.
        superseded: (c,) number of a camera's frames for which a newer one had come; it is counted here.
    """
    c = frames.camera[row]
    waiting = gate.uses[c] == 0
    late = gate.uses[c] >= 0 and frames.capture_ns[row] < gate.capture_ns[c]
    if waiting or late:
        superseded[c] += 1
    if not late:
        gate.capture_ns[c] = frames.capture_ns[row]
        gate.uses[c] = 0
        gate.z[c] = frames.z[row]
        gate.z_var[c] = frames.z_var[row]
        gate.points[c] = frames.points[row]
        gate.confidence[c] = frames.confidence[row]


@njit(cache=True, inner=True)
def _update(filter_: Filter, c: int, now: int, rules: Rules, track: Track) -> bool:
    """Applies Eq. (52)-(57) with the valid rows of one camera's frame, row by row; returns True if there was one.

    One scalar row at a time is exact because R of Eq. (47) is diagonal. R of a frame used for the n-th time is
    n sigma_z^2 (4.1.1). A row of H of Eq. (45), (46) is ``h``: the identity's where d = 0, else Eq. (43) backwards.
    A row that is not valid is left out, which is Eq. (58), corrected: docs/paper.md.
    """
    filter_.gate.uses[c] += 1
    if not filter_.gate.valid[c].any():
        return False
    if not filter_.estimate.started[0]:
        _start(filter_.estimate, filter_.gate.points[c])
    d = delay(filter_.gate.capture_ns[c], now, rules)
    h = np.array([1.0, -d, d**2 / 2.0, -(d**3) / 6.0])
    z = _named(filter_.estimate, filter_.gate, c, h)
    for row in range(ROWS):
        if not filter_.gate.valid[c, row]:
            continue
        R = filter_.gate.uses[c] * filter_.gate.z_var[c, row]
        if row >= DOF:
            R *= _ALIKE
            both = filter_.estimate.lengths_var[row - DOF] + R
            if both > 0.0:  # else the length is known exactly, and so is the row
                gain = filter_.estimate.lengths_var[row - DOF] / both
                filter_.estimate.lengths[row - DOF] += gain * (z[row] - filter_.estimate.lengths[row - DOF])
                filter_.estimate.lengths_var[row - DOF] *= 1.0 - gain
        elif now - filter_.estimate.row_ns[row] > rules.memory_ns:
            _acquire(filter_.estimate, row, z[row], R, rules.rest_std[row])
            filter_.estimate.acquired_ns[row] = now
            track.reacquired[0] += filter_.estimate.row_ns[row] >= 0  # the first time is not a reacquisition
        else:
            innovation = correct(filter_.estimate.mean[row], filter_.estimate.cov[row], h, z[row], R)
            add_innovation(filter_.estimate, c, row, innovation, now, rules.spread_memory_s)
        if filter_.gate.uses[c] == 1:
            filter_.estimate.row_ns[row] = now
    filter_.gate.newest_ns[0] = max(filter_.gate.newest_ns[0], filter_.gate.capture_ns[c])
    return True


@njit(cache=True, inner=True)
def _named(estimate: StateEstimate, gate: Gate, c: int, h: Floats) -> Floats:
    """Returns the rows (20,) of a camera's frame, arms in the form and heading in the turn nearest to the estimate."""
    z = gate.z[c].copy()
    expected, variance = np.empty(DOF), np.empty(DOF)
    for j in range(DOF):
        if not gate.valid[c, j]:
            z[j] = np.nan
        expected[j] = dot(h, estimate.mean[j])
        variance[j] = gate.z_var[c, j]
        for a in range(4):
            variance[j] += h[a] * dot(estimate.cov[j, a], h)
    z[2] = expected[2] + wrap(z[2] - expected[2])
    for first in (RIGHT_ARM, LEFT_ARM):
        arm = slice(first, first + 4)
        nearest_arm(z[arm], expected[arm], variance[arm])
    return z


@njit(cache=True, inner=True)
def _start(estimate: StateEstimate, points: Floats) -> None:
    """Starts the person, with the base under the seen ones of the points (20, 3) until the pelvis is seen."""
    estimate.started[0] = True
    for axis in range(2):
        estimate.mean[axis, 0] = np.nanmean(points[:, axis])


@njit(cache=True, inner=True)
def _acquire(estimate: StateEstimate, j: int, z: float, R: float, rest_std: Floats) -> None:
    """Starts a joint seen for the first time or after a loss; no earlier state is kept."""
    estimate.mean[j] = 0.0
    estimate.mean[j, 0] = z
    reset(estimate, j)
    estimate.cov[j] = 0.0
    estimate.cov[j, 0, 0] = R
    for k in range(3):
        estimate.cov[j, k + 1, k + 1] = rest_std[k] ** 2


@njit(cache=True, inner=True)
def _rename(mean: Floats) -> None:
    """Keeps the angles of each arm near the canonical form. The posture is unchanged: alpha_2 is mirrored, P stays."""
    for first in (RIGHT_ARM, LEFT_ARM):
        arm = mean[first : first + 4, 0].copy()
        if canonical_arm(arm, _NAME_MARGIN):
            mean[first + 1] *= -1.0
        mean[first : first + 4, 0] = arm


@njit(inner=True, inline="always")  # passing the filter on would take longer than this
def _leave(filter_: Filter, k: int, rules: Rules, track: Track, damping: Floats) -> None:
    now = filter_.estimate.tick_ns[0]
    for j in range(DOF):
        for a in range(4):
            track.motion[a, k, j] = filter_.estimate.mean[j, a]
    write_deviations(filter_.estimate, rules, track.motion[4:, k])
    track.lengths[0, k] = filter_.estimate.lengths
    track.lengths[1, k] = np.sqrt(filter_.estimate.lengths_var)
    write_residual(filter_.model, filter_.gate, now, rules, track.residual[k])
    write_unseen_times(now, filter_.estimate.row_ns, filter_.model.carried_ns, track.unseen[k])
    track.frame_age[k] = (now - filter_.gate.newest_ns[0]) * 1e-9
    track.legs_sway[k] = legs_sway(filter_.model, now)
    place(filter_.estimate, filter_.model, track.points[k], track.camera_points[k])
    if len(track.cov) > 0:
        track.cov[k] = filter_.estimate.cov
        track.damping[k] = damping
        track.spread[k] = filter_.estimate.spread
        for j in range(DOF):
            squares, products = filter_.estimate.squares[j], filter_.estimate.products[j]
            track.autocorrelation[k, j] = autocorrelation(squares, products)


@njit(cache=True, inner=True)
def saturate(mean: Floats, dt: float, rules: Rules) -> bool:
    """Eq. (62)-(65) on the state of all joints (13, 4), then the same for the accelerations, in place.

    That is Eq. (61), the solution of Eq. (59a), (59b), (60) for bounds that do not depend on each other.
    The filter continues from the saturated state; P is not changed by it. x and y are bounded along and across the
    body, Eq. (33), and turned back, Eq. (32). A joint's velocity may not carry it over its position bound within dt,
    its acceleration not over its velocity bound; without a dt yet (0) only the plain bounds hold.

    Returns:
        True if anything was changed.
    """
    low, high = np.empty(DOF), np.empty(DOF)
    before = mean[:, :3].copy()
    p = mean[:, 0].copy()
    clamp_row(p, rules.p_min, rules.p_max, rules.coupled, low, high)
    mean[:, 0] = p
    low[:2], high[:2] = -np.inf, np.inf  # bounds of x and y are the world's, those of their velocities the body's
    v = _into_body(mean[:, 1], p[2])
    v_out = _clip(v, p, low, high, rules.v_min, rules.v_max, dt)
    a = _into_body(mean[:, 2], p[2])
    a_out = _clip(a, v_out, rules.v_min, rules.v_max, rules.a_min, rules.a_max, dt)
    _write(mean[:, 1], v, v_out, p[2])
    _write(mean[:, 2], a, a_out, p[2])
    return bool((before != mean[:, :3]).any())


@njit(cache=True, inner=True)
def _clip(
    rate: Floats, value: Floats, low: Floats, high: Floats, rate_low: Floats, rate_high: Floats, dt: float
) -> Floats:
    """Eq. (63)-(65): the rates (13,) within their bounds and within those that keep the value in its bounds for dt."""
    clipped = np.empty(DOF)
    for j in range(DOF):
        least, most = rate_low[j], rate_high[j]
        if dt > 0.0:
            least = min(max(least, (low[j] - value[j]) / dt), most)
            most = max(min(most, (high[j] - value[j]) / dt), least)
        clipped[j] = max(least, min(rate[j], most))
    return clipped


@njit(cache=True, inner=True)
def _into_body(world: Floats, theta: float) -> Floats:
    """Eq. (33): returns the first two of (13,) as forward and to the left."""
    body = world.copy()
    c, s = np.cos(theta), np.sin(theta)
    body[0], body[1] = c * world[0] + s * world[1], -s * world[0] + c * world[1]
    return body


@njit(cache=True, inner=True)
def _write(world: Floats, body: Floats, clipped: Floats, theta: float) -> None:
    """Eq. (32): writes back only what was clipped, so that the rest keeps its bits."""
    world[2:] = clipped[2:]
    if body[0] != clipped[0] or body[1] != clipped[1]:
        c, s = np.cos(theta), np.sin(theta)
        world[0], world[1] = c * clipped[0] - s * clipped[1], s * clipped[0] + c * clipped[1]
