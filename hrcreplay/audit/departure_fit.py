"""The fit of ``human.model.Departure`` to the departures of whole limbs from constant velocity on recordings.

First rise and sink are fitted by a quantile, as the whole body moves with the pelvis. Then quantile regression gives
each pair of limbs and horizon a line over the limb's residual: the lowest line above the required share of the
departures. The lines are then raised by one factor per horizon, until whole people, not single limbs, are inside in the
required share of the ticks of every log. Last, people with ground truth are included almost completely, by raising the
lines that cost the least volume, as their misses are not camera errors. Simulated people, with an unlimited number of
ticks, do not count in totals over the ticks of all logs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import compress

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import coo_array, eye_array, hstack

from hrcreplay.audit.departures import EXACT, LimbDepartures
from hrcreplay.human.model import Departure
from hrcreplay.human.prediction.velocity_tube import NOISE_M
from hrcreplay.records import BODY, Floats

#: Limbs that share a line: both sides of the body.
_PAIRS = ((0,), (1,), (2, 4), (3, 5), (6,))
#: Share of a pair's departures below its line before the line is raised.
_BELOW = 0.995
#: Maximum slope of a line; a larger slope comes from the few logs with much noise.
_STEEPEST = 1.25
#: Maximum common factor of all lines, number of bisection steps, and maximum factor of one line after that.
_MOST, _HALVINGS, _MOST_AGAIN = 1.5, 12, 1.5
#: Factors on the requested share of misses: for a log that was left out; in the fit, for each log, for each log with
#: ground truth, and for all logs together. The last is below 1, as people outside the fit have more misses.
EACH, _FITTED, _TRUE, _TOGETHER = 3.0, 2.25, 0.3, 0.6
#: Departures, their slopes, and rise and sink are rounded up to multiples of these [m], [1], [m]. With steps this
#: coarse most folds have the same rise and sink, so that departures are measured only once.
_MM, _HUNDREDTH, _CM = 1e-3, 1e-2, 1e-2


def fit(samples: Sequence[LimbDepartures], share: float) -> Departure:
    """Fits the departures that contain whole people of some logs.

    Args:
        samples: One per log, with the same horizons.
        share: Required share of the ticks of other logs at each horizon, in (0, 1). Allowed misses in the fit, relative
            to its complement: 0.6 times over all ticks, 2.25 times in one log, 0.3 times in one with ground truth.
    """
    horizon_s = samples[0].horizon_s
    rise_m, sink_m = (_rise(horizon_s, [s.height_m[way] for s in samples]) for way in range(2))
    lines = np.zeros((len(BODY), len(horizon_s), 2))
    for k in range(len(horizon_s)):
        beyond = [s.beyond_m(k, float(rise_m[k]), float(sink_m[k])) for s in samples]
        for pair in _PAIRS:
            logs = zip(beyond, samples, strict=True)
            lines[list(pair), k] = _line([(b[:, pair], np.minimum(s.residual_m[:, pair], NOISE_M)) for b, s in logs])
    plain = Departure(horizon_s, _up(lines[..., 0], _MM), _up(lines[..., 1], _HUNDREDTH), rise_m, sink_m)
    recorded = list(compress(samples, counted(samples)))
    common = np.array([_factor(recorded, plain, k, share) for k in range(len(horizon_s))])
    raised = _times(plain, common)
    true = [s for s in samples if s.true]
    if true:
        raised = _times(raised, np.column_stack([_raise(true, raised, k, share) for k in range(len(horizon_s))]))
    beyond_m, residuals = _up(raised.beyond_m, _MM), _up(raised.residuals, _HUNDREDTH)
    return replace(raised, beyond_m=beyond_m, residuals=residuals)


def counted(samples: Sequence[LimbDepartures]) -> list[bool]:
    """Marks the logs that count in totals over all ticks: those without ground truth, else all."""
    all_true = all(sample.true for sample in samples)
    return [all_true or not sample.true for sample in samples]


def _times(departure: Departure, factor: Floats) -> Departure:
    """Returns the lines raised by factors that broadcast to (7, h)."""
    return replace(departure, beyond_m=factor * departure.beyond_m, residuals=factor * departure.residuals)


def _rise(horizon_s: Floats, logs: Sequence[Floats]) -> Floats:
    """(h,) maximum rise, or sink, of the pelvis in nearly all ticks; input: (h, n) of each log [m].

    Before the last horizon, at most that of a constant acceleration until then; the rest is noise, which the ball
    covers.
    """
    last = _often([log[-1] for log in logs])
    evenly = last * (horizon_s / horizon_s[-1]) ** 2
    return _up(np.array([min(_often([log[k] for log in logs]), evenly[k]) for k in range(len(horizon_s))]), _CM)


def _often(logs: Sequence[Floats]) -> float:
    """Returns the quantile _BELOW of all heights [m]; a log's weight is the root of its number of ticks."""
    known = [log[np.isfinite(log)] for log in logs]
    height = np.concatenate(known)
    if not len(height):
        return 0.0
    weight = np.concatenate([np.full(len(log), max(1, len(log)) ** -0.5) for log in known])
    order = np.argsort(height, kind="stable")
    below = np.cumsum(weight[order])
    return float(height[order][np.searchsorted(below, _BELOW * below[-1])])


def _line(logs: Sequence[tuple[Floats, Floats]]) -> Floats:
    """(2,) offset >= 0 and slope, up to _STEEPEST, of the line with the minimum quantile loss.

    The weight of a log is the root of its number of ticks.
    """
    far, near, weight = [], [], []
    for beyond, residual in logs:
        known = np.isfinite(beyond)
        far.append(beyond[known])
        near.append(residual[known])
        weight.append(np.full(known.sum(), max(1, known.sum()) ** -0.5))
    y, x, w = np.concatenate(far), np.concatenate(near), np.concatenate(weight)
    if not len(y):
        return np.array([0.0, 1.0])
    n, w = len(y), w / w.mean()
    unknowns = coo_array(np.column_stack([np.ones(n), x]))
    found = linprog(
        np.concatenate([[0.0, 0.0], _BELOW * w, (1.0 - _BELOW) * w]),
        A_eq=hstack([unknowns, eye_array(n), -eye_array(n)]).tocsr(),
        b_eq=y,
        bounds=[(0.0, None), (0.0, _STEEPEST)] + [(0.0, None)] * (2 * n),
        method="highs",
    )
    line: Floats = found.x[:2]
    return line


def _factor(samples: Sequence[LimbDepartures], plain: Departure, k: int, share: float) -> float:
    """Returns the smallest factor on the lines at a horizon that contains the people of all logs together and of each.

    A log whose people exceed even the largest factor, as with a camera that loses the legs, is ignored.
    """
    needed = [of.max(axis=1) for of in _needed(samples, plain, k)]
    if not any(len(of) for of in needed):
        return 1.0
    least = 1.0 - _FITTED * (1.0 - share)

    def shares(factor: float) -> tuple[Floats, float]:
        hits = [of <= factor + EXACT for of in needed]
        return np.array([hit.mean() if len(hit) else 1.0 for hit in hits]), float(np.concatenate(hits).mean())

    each, together = shares(_MOST)
    asks, wanted = each >= least, min(1.0 - _TOGETHER * (1.0 - share), together)

    def enough(factor: float) -> bool:
        each, together = shares(factor)
        return bool((each[asks] >= least).all() and together >= wanted)

    low, high = 1.0, _MOST
    if enough(low):
        return low
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high


def _needed(samples: Sequence[LimbDepartures], departure: Departure, k: int) -> list[Floats]:
    """(n, 7) per log: ``factors`` at the ticks at which any limb was recorded, 0 for unrecorded limbs."""
    factors = [s.factors(departure, k) for s in samples]
    return [np.nan_to_num(of[np.isfinite(of).any(axis=1)]) for of in factors]


def _raise(samples: Sequence[LimbDepartures], departure: Departure, k: int, share: float) -> Floats:
    """(7,) factors on the lines at a horizon that contain the people of each of the logs with ground truth.

    The limbs of a pair share a factor. The ticks outside are included one after the other, the one that costs the least
    volume first, until enough are inside or only ticks beyond the largest factors remain.
    """
    needed = _needed(samples, departure, k)
    log = np.repeat(np.arange(len(samples)), [len(of) for of in needed])
    pairs = np.column_stack([np.concatenate(needed)[:, list(pair)].max(axis=1) for pair in _PAIRS])
    wanted = (1.0 - _TRUE * (1.0 - share)) * np.bincount(log, minlength=len(samples))
    weight, found = _weights(samples, departure, k), np.ones(len(_PAIRS))
    while True:
        held = (pairs <= found + EXACT).all(axis=1)
        short = np.bincount(log[held], minlength=len(samples)) < wanted - EXACT
        outside = pairs[(pairs <= _MOST_AGAIN).all(axis=1) & ~held & short[log]]
        if not len(outside):
            break
        raised = np.maximum(outside, found)
        found = raised[np.argmin((raised**2 - found**2) @ weight)]
    factors = np.ones(len(BODY))
    for pair, factor in zip(_PAIRS, found, strict=True):
        factors[list(pair)] = factor
    return factors


def _weights(samples: Sequence[LimbDepartures], departure: Departure, k: int) -> Floats:
    """(pairs,) costs of the tubes of a pair: their cross-sections, which grow with the square of the radius."""
    noise = np.minimum(np.concatenate([s.residual_m for s in samples]), NOISE_M)
    radius_m = departure.beyond_m[:, k] + departure.residuals[:, k] * noise.mean(axis=0)
    return np.array([(radius_m[list(pair)] ** 2).sum() for pair in _PAIRS])


def _up(values: Floats, step: float) -> Floats:
    return np.round(np.ceil(values / step - 1e-9) * step, 6) + 0.0  # avoids -0.0
