"""Fusion of several cameras into one moving person, Alg. 3; corrections: docs/paper.md."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cache

import numpy as np

from hrcreplay.human.fusion.body_points import FOOT_M
from hrcreplay.human.fusion.inverse_kinematics import ROWS
from hrcreplay.human.fusion.kalman import (
    NEVER_NS,
    Filter,
    Frames,
    Gate,
    ModelResidual,
    Rules,
    StateEstimate,
    Track,
    process_variance,
)
from hrcreplay.human.fusion.kernel import run
from hrcreplay.human.fusion.model_residual import BINS
from hrcreplay.human.fusion.reported_deviations import FIRST_SPREAD
from hrcreplay.human.model import LEG_POINTS, LimitSet
from hrcreplay.records import BODY, DOF, LENGTHS, LIMBS, POINTS, Bools, Floats, HumanStates, Ints, Measurements
from hrcreplay.settings.sections import Fusion

#: Prior of an unmeasured person: upright with hanging arms, and its standard deviation [m, m, rad..., m].
_NEUTRAL = (0.0, 0.0, 0.0, 0.1, 0.1, 0.3, 0.0, 2.6, 0.1, 0.3, 0.0, 2.6, 0.94)
_NEUTRAL_STD = (0.5, 0.5, 1.5, 0.5, *(0.7, 0.7, 1.5, 0.7) * 2, 0.3)
#: LENGTHS of the median man (upper arm 0.36 m, shoulders at 1.44 m), and their standard deviation [m]: statures of men
#: and women differ by 0.09 m (ANSUR II, 2012), bones by 0.13 to 0.29 of that (Drillis and Contini, 1966), and the joint
#: centres of trackers by some centimetres more.
MEDIAN_LENGTHS_M = (0.50, 0.20, 0.18, 0.36, 0.36, 0.29, 0.29)
_LENGTHS_STD_M = (0.06, 0.06, 0.04, 0.05, 0.05, 0.04, 0.04)
#: Standard deviations of v, a, j of an unseen joint: of x, y and z [m/s...], of an angle [rad/s...].
_REST_STD = np.array([[0.3, 2.0, 20.0]] * 2 + [[0.5, 5.0, 50.0]] * 10 + [[0.3, 2.0, 20.0]])
#: Type of a joint: x or y (0), an angle (1) or z (2).
_KIND = np.repeat((0, 1, 2), (2, 10, 1))

FusionState = Filter


@dataclass(frozen=True)
class Trace:
    """Further input of the smoother: P of every tick, and the factors of its prediction. No rows unless traced."""

    cov: Floats  #: (n, 13, 4, 4) covariance of p, v, a, j
    damping: Floats  #: (n, 13) damping of the derivatives up to the tick; 1 unless the joint was unseen
    spread: Floats  #: (n, 13) highest normalised innovation squared, decaying
    autocorrelation: Floats  #: (n, 13) autocorrelation of the innovations, at lag 1

    def rows(self, which: slice | Ints | Bools) -> Trace:
        """Selects the trace of some of the ticks."""
        return Trace(*(getattr(self, f.name)[which] for f in fields(Trace)))

    @staticmethod
    def join(parts: Sequence[Trace]) -> Trace:
        """Concatenates the traces of consecutive ticks."""
        return Trace(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Trace)))


def start(cameras: tuple[str, ...]) -> FusionState:
    """Makes the filter before the first frame of any camera."""
    c = len(cameras)
    mean, cov = np.zeros((DOF, 4)), np.zeros((DOF, 4, 4))
    mean[:, 0] = _NEUTRAL
    for j in range(DOF):
        cov[j] = np.diag([_NEUTRAL_STD[j], *_REST_STD[j]]) ** 2
    return Filter(
        estimate=StateEstimate(
            tick_ns=np.full(1, NEVER_NS),
            started=np.zeros(1, dtype=np.bool_),
            mean=mean,
            cov=cov,
            lengths=np.array(MEDIAN_LENGTHS_M),
            lengths_var=np.array(_LENGTHS_STD_M) ** 2,
            row_ns=np.full(ROWS, NEVER_NS),
            acquired_ns=np.full(ROWS, NEVER_NS),
            bone_ns=np.full(len(LENGTHS), NEVER_NS),
            innovation=np.zeros((c, DOF)),
            squares=np.zeros(DOF),
            products=np.zeros(DOF),
            spread=np.full(DOF, FIRST_SPREAD),
        ),
        gate=Gate(
            point_ns=np.full(len(POINTS), NEVER_NS),
            refused_ns=np.full((c, len(POINTS)), NEVER_NS),
            refused_at=np.full((c, len(POINTS), 3), np.nan),
            apart=np.zeros((c, len(LIMBS))),
            capture_ns=np.full(c, NEVER_NS),
            uses=np.full(c, -1),
            newest_ns=np.full(1, NEVER_NS),
            z=np.full((c, ROWS), np.nan),
            z_var=np.full((c, ROWS), np.nan),
            points=np.full((c, len(POINTS), 3), np.nan),
            confidence=np.zeros((c, len(POINTS))),
            valid=np.zeros((c, ROWS), dtype=np.bool_),
            shows=np.zeros((c, len(LIMBS)), dtype=np.bool_),
            trusted=np.zeros((c, len(POINTS)), dtype=np.bool_),
            wrong=np.zeros((c, len(POINTS))),
            judged_ns=np.full(c, NEVER_NS),
            disbelieved=np.zeros((c, len(POINTS)), dtype=np.bool_),
        ),
        model=ModelResidual(
            residuals=np.zeros((len(BODY), BINS)),
            weight=np.zeros(len(BODY)),
            samples=np.zeros(len(BODY), dtype=np.int64),
            sampled_ns=np.full(len(BODY), NEVER_NS),
            residual=np.full(len(BODY), np.nan),
            peak=np.zeros(len(BODY)),
            peak_ns=np.full(len(BODY), NEVER_NS),
            offset=np.zeros((len(POINTS), 3)),
            offset_weight=np.zeros(len(POINTS)),
            offset_ns=np.full(len(POINTS), NEVER_NS),
            carried=np.full((c, len(POINTS), 3), np.nan),
            carried_ns=np.full((c, len(POINTS)), NEVER_NS),
            leg_bones=np.zeros((c, 4)),
            leg_bones_seen=np.zeros((c, 4), dtype=np.int64),
            leg_bones_ns=np.full((c, 4), NEVER_NS),
            sway=np.zeros((c, len(LEG_POINTS))),
            sway_from=np.zeros((c, len(LEG_POINTS), 3)),
            sway_ns=np.full((c, len(LEG_POINTS)), NEVER_NS),
            foot=np.tile(FOOT_M, (2, 1)),
        ),
    )


def copied(state: FusionState) -> FusionState:
    """The same numbers in arrays of their own."""
    estimate, gate, model = ([array.copy() for array in part] for part in state)
    return Filter(StateEstimate._make(estimate), Gate._make(gate), ModelResidual._make(model))


def fuse(
    state: FusionState,
    ticks_ns: Ints,
    measurements: Measurements,
    settings: Fusion,
    limits: LimitSet,
    *,
    traced: bool = False,
) -> tuple[FusionState, HumanStates, Counter[str], Trace]:
    """Alg. 3: one tick after another, each with the frames that arrived in (previous tick, tick].

    The filter is that of Eq. (42)-(57) with Eq. (44) corrected: per joint p, v, a, j under Eq. (43), per length a
    constant; rows that are not valid are switched off in H. After each tick the state is saturated by Eq. (62)-(65) and
    fed back; P is not changed by it. Where ``delay`` is compensated, a row measures p - d v + d^2/2 a - d^3/6 j, d the
    age of the frame at the tick. The angles of each arm take the form nearest to the estimate (``human.model``),
    heading takes the nearest turn, so neither jumps. A joint unseen for ``coast_s`` has its derivatives damped and its
    covariance growing; unseen for ``memory_s`` it is lost and restarts from its next valid row. All values are finite
    from the first valid row on: joints not seen yet have a neutral posture with a large standard deviation. The
    distance of the body from its model and the time since each limb was seen are stored with the filter and do not
    change it.

    Args:
        state: From ``start`` or the previous call. It is not changed.
        ticks_ns: (n,) instants, after those of the previous call.
        measurements: Rows in order of arrival, none after ``ticks_ns[-1]`` and none given before.
        settings: Of the filter.
        limits: Bounds for the saturation.
        traced: True: keep the input of ``smooth``, 1.5 kB per tick; changes no state.

    Returns:
        The filter after the last tick, the states (n ticks; NaN before the first valid row), counts of events:
        ``outlier_points_<camera>``, ``disbelieved_<point>_<camera>`` if there are any (``disbelief``),
        ``superseded_frames_<camera>`` (a newer frame had come), ``joints_reacquired``, ``ticks_saturated``, and the
        trace of the n ticks, which has no rows unless ``traced``. The bits of the states do not depend on the division
        of ticks into calls.
    """
    after = copied(state)
    track = empty_track(len(ticks_ns), len(measurements.cameras), traced=traced)
    run(np.array(ticks_ns), as_frames(measurements), after, as_rules(settings, limits), track)
    return after, *written(track, len(ticks_ns), ticks_ns, None, measurements.cameras)


def written(
    track: Track, n: int, t_ns: Ints, person: Ints | None, cameras: tuple[str, ...]
) -> tuple[HumanStates, Counter[str], Trace]:
    """What the kernel has written: the first ``n`` rows as states, the counts of events, and the trace.

    Args:
        track: After the ticks.
        n: Number of rows written.
        t_ns: (n,) instants of the rows.
        person: (n,) numbers of their people; None: person 1.
        cameras: Names of the cameras.
    """
    p, v, a, j, p_std, v_std = track.motion[:, :n]
    lengths, lengths_std = track.lengths[:, :n]
    states = HumanStates(
        t_ns=t_ns,
        p=p,
        v=v,
        a=a,
        j=j,
        p_std=p_std,
        v_std=v_std,
        lengths_m=lengths,
        lengths_std_m=lengths_std,
        valid=track.valid[:n],
        residual_m=track.residual[:n],
        unseen_s=track.unseen[:n],
        frame_age_s=track.frame_age[:n],
        points_m=track.points[:n],
        cameras=cameras,
        camera_points_m=track.camera_points[:n],
        legs_sway_m=track.legs_sway[:n],
        person=person,
    )
    trace = Trace(track.cov[:n], track.damping[:n], track.spread[:n], track.autocorrelation[:n])
    return states, _count_events(track, cameras), trace


def _count_events(track: Track, cameras: tuple[str, ...]) -> Counter[str]:
    happened = (track.reacquired, track.saturated, track.outliers, track.superseded)
    counts = Counter(dict(zip(_event_names(cameras), np.concatenate(happened).tolist(), strict=True)))
    if track.disbelieved.any():
        for c, k in np.argwhere(track.disbelieved).tolist():
            counts[f"disbelieved_{POINTS[k]}_{cameras[c]}"] = int(track.disbelieved[c, k])
    return counts


@cache
def _event_names(cameras: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the events of which there is a count even if they never happen."""
    of_cameras = (f"{event}_{camera}" for event in ("outlier_points", "superseded_frames") for camera in cameras)
    return ("joints_reacquired", "ticks_saturated", *of_cameras)


def process_noise(settings: Fusion, j: int, dt: float, damping: float) -> Floats:
    """Computes the diagonal (4,) of G of Eq. (44) for joint j and a step of dt seconds.

    Args:
        settings: Of the filter.
        j: Index into JOINTS.
        dt: Length of the step [s].
        damping: Factor on the derivatives over the step; 1 unless the joint is unseen.

    Returns:
        Variances that the step adds to p, v, a, j [m^2 or rad^2, and these per s^2, s^4, s^6].
    """
    sigma = _sigma(settings)[j]
    return np.array([process_variance(a, dt, damping, sigma, _REST_STD[j]) for a in range(4)])


def _sigma(settings: Fusion) -> Floats:
    return np.array((settings.sigma_position, settings.sigma_angle, settings.sigma_height))[_KIND]


def as_frames(measurements: Measurements) -> Frames:
    """Copies the measurements into the kernel's form, as the arrays of a record are read-only."""
    return Frames(
        capture_ns=np.array(measurements.capture_ns),
        arrival_ns=np.array(measurements.arrival_ns),
        camera=np.array(measurements.camera),
        z=np.array(measurements.z),
        z_var=measurements.z_std**2,
        points=np.array(measurements.points_m),
        confidence=np.array(measurements.confidence),
    )


def as_rules(settings: Fusion, limits: LimitSet) -> Rules:
    """The settings and limits as the kernel needs them."""
    return Rules(
        sigma=_sigma(settings),
        reuse=settings.stale == "reuse",
        compensate=settings.delay == "compensate",
        delay_max_s=settings.delay_max_s,
        confidence_min=settings.confidence_min,
        outlier_m=settings.outlier_m,
        bone_m=settings.bone_m,
        memory_ns=round(settings.memory_s * 1e9),
        relearn_ns=round(settings.relearn_s * 1e9),
        bone_memory_ns=round(settings.bone_memory_s * 1e9),
        coast_ns=round(settings.coast_s * 1e9),
        residual_quantile=settings.residual_quantile,
        residual_memory_s=settings.residual_memory_s,
        residual_hold_ns=round(settings.residual_hold_s * 1e9),
        offset_memory_s=settings.offset_memory_s,
        spread_memory_s=settings.spread_memory_s,
        spread_least=settings.spread_least,
        spread_most=settings.spread_most,
        rest_s=0.3 * settings.coast_s,
        rest_std=_REST_STD,
        p_min=limits.p_min,
        p_max=limits.p_max,
        v_min=limits.v_min,
        v_max=limits.v_max,
        a_min=limits.a_min,
        a_max=limits.a_max,
        coupled=limits.coupled,
    )


def empty_track(n: int, cameras: int, *, traced: bool) -> Track:
    """Makes the arrays for ``n`` rows, whose content is not defined until the kernel writes it, and counts of 0."""
    rows = n if traced else 0
    return Track(
        motion=np.empty((6, n, DOF)),
        lengths=np.empty((2, n, len(LENGTHS))),
        valid=np.empty((n, cameras), dtype=np.bool_),
        residual=np.empty((n, len(BODY))),
        unseen=np.empty((n, len(BODY))),
        frame_age=np.empty(n),
        points=np.empty((n, len(POINTS), 3)),
        camera_points=np.empty((n, cameras, len(POINTS), 3)),
        legs_sway=np.empty(n),
        cov=np.empty((rows, DOF, 4, 4)),
        damping=np.empty((rows, DOF)),
        spread=np.empty((rows, DOF)),
        autocorrelation=np.empty((rows, DOF)),
        outliers=np.zeros(cameras, dtype=np.int64),
        disbelieved=np.zeros((cameras, len(POINTS)), dtype=np.int64),
        superseded=np.zeros(cameras, dtype=np.int64),
        reacquired=np.zeros(1, dtype=np.int64),
        saturated=np.zeros(1, dtype=np.int64),
    )
