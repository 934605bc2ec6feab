"""The fit of ``human.model.Departure`` to the departures of whole limbs from constant velocity on recordings.

First rise and sink are fitted by a quantile, as the whole body moves with the pelvis. Then quantile regression gives
each pair of limbs and horizon a multiple of the residual, which is where the limb is now, and where it can go from
there: an offset, and a slope over its present speed. The lines lie above most of the departures. Then the offsets
that cost the least volume are raised, until whole people, not single limbs, are inside in the required share of the
ticks of every log and of all together; of those with ground truth almost completely, as their misses are not camera
errors. It is the offsets, as those who leave the lines are mostly at rest and begin to move; slopes would widen what
moves already, and what is noisy. Simulated people, with an unlimited number of ticks, do not count in totals over the
ticks of all logs. Last, people whom no fit has seen depart further than those of the fit: by one factor per horizon
all lines are widened to what the people of each group need on lines that were fitted without them (``others_need``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import coo_array, eye_array, hstack

from hrcreplay.audit.departures import EXACT, LimbDepartures
from hrcreplay.human.model import Departure
from hrcreplay.human.prediction.velocity_tube import LEGS_BEGIN_M_PER_S2, NOISE_M
from hrcreplay.records import BODY, Bools, Floats

#: Limbs that share a line: both sides of the body.
_PAIRS = ((0,), (1,), (2, 4), (3, 5), (6,))
_LEGS = BODY.index("LEGS")
#: Share of a pair's departures below its line before its offset is raised. Less than is asked for: an offset raised for
#: those who begin to move takes less volume than a steep line that holds them.
_BELOW = 0.97
#: Share of all rises and sinks of the pelvis below theirs, and the delay of its fused velocity that they allow for [s].
#: Of who rises in 0.6 to 2 s it is late by 0.15 to 0.08 s; the balls hold the rest.
_RISEN, _LATE_S = 0.995, 0.05
#: Maximum multiple of the residual of each pair; a larger one comes from the few logs with much noise. The residual of
#: legs is their sway, a motion, of which a departure is several times as large.
_STEEPEST = (1.0, 1.0, 1.0, 1.0, 8.0)
#: Maximum slope over the speed: the time for which a limb's tube does not carry it, and for the filter's lag [s].
_SWINGS_S = 0.3
#: Maximum departure, as a multiple of the line, for which an offset is raised; larger ones come from the few ticks at
#: which a tracker throws a limb. In logs with ground truth none does.
_MOST = 1.4
#: Least and maximum factor for people who were not in the fit, and the step in which it is found.
_LEAST_OTHERS, _MOST_OTHERS, _STEP = 1.02, 1.5, 0.01
#: Factors on the requested share of misses: for a log that was left out; in the fit, for each log, for each log with
#: ground truth, and for all logs together.
EACH, _FITTED, _TRUE, _TOGETHER = 3.0, 2.25, 0.3, 1.2
#: The same for people outside the fit, who choose how far lines are widened: a margin up to a horizon within which
#: robots beside people have stopped [s]; none beyond it, where volumes are largest.
_OTHERS, _OTHERS_LATER, _SOON_S = 0.8, 1.0, 0.25
#: Departures, their slopes, and rise and sink are rounded up to multiples of these [m], [1], [m]. With steps this
#: coarse most folds have the same rise and sink, so that departures are measured only once.
_MM, _HUNDREDTH, _CM = 1e-3, 1e-2, 1e-2


def fit(samples: Sequence[LimbDepartures], share: float) -> Departure:
    """Fits the departures that contain whole people of some logs.

    Args:
        samples: One per log, with the same horizons.
        share: Required share of the ticks of other logs at each horizon, in (0, 1). Allowed misses in the fit, relative
            to its complement: 1.2 times over all ticks, 2.25 times in one log, 0.3 times in one with ground truth.
    """
    horizon_s = samples[0].horizon_s
    rise_m, sink_m = (_rise(horizon_s, [s.height_m[way] for s in samples]) for way in range(2))
    plain = _lines(samples, horizon_s, rise_m, sink_m)
    raised_m = [_raise(samples, plain, k, share) for k in range(len(horizon_s))]
    return _rounded(_begun(replace(plain, beyond_m=plain.beyond_m + np.column_stack(raised_m))))


def _lines(samples: Sequence[LimbDepartures], horizon_s: Floats, rise_m: Floats, sink_m: Floats) -> Departure:
    """Fits the lines, from the longest horizon down to the shortest, so that none is above that of a longer one."""
    now, goes, swings_s = np.zeros((3, len(BODY), len(horizon_s)))
    for pair, steepest in zip(map(list, _PAIRS), _STEEPEST, strict=True):
        residual = [np.minimum(s.residual_m[:, pair], NOISE_M) for s in samples]
        speed, most = [s.speed_m_per_s[:, pair] for s in samples], (np.inf, steepest, _SWINGS_S)
        for k in reversed(range(len(horizon_s))):
            beyond = [s.beyond_m(k, float(rise_m[k]), float(sink_m[k]))[:, pair] for s in samples]
            offset, times, slope = _line(beyond, [residual, speed], most).tolist()
            goes[pair, k], now[pair, k], swings_s[pair, k] = offset, times, slope
            most = (offset, steepest, slope)
    return _rounded(Departure(horizon_s, goes, now, rise_m, sink_m, swings_s))


def _begun(departure: Departure) -> Departure:
    """Raises the legs' lines to those of legs that begin to move, but not above that of the longest horizon."""
    beyond_m, last = departure.beyond_m.copy(), departure.beyond_m[_LEGS, -1]
    begun_m = np.minimum(0.5 * LEGS_BEGIN_M_PER_S2 * departure.horizon_s**2, last)
    beyond_m[_LEGS] = np.maximum(beyond_m[_LEGS], begun_m)
    return replace(departure, beyond_m=beyond_m)


def _rounded(departure: Departure) -> Departure:
    beyond_m, swings_s = (_up(of, _MM) for of in (departure.beyond_m, _swings(departure)))
    return replace(departure, beyond_m=beyond_m, residuals=_up(departure.residuals, _HUNDREDTH), swings_s=swings_s)


def _swings(departure: Departure) -> Floats:
    return np.zeros_like(departure.beyond_m) if departure.swings_s is None else departure.swings_s


def widen(departure: Departure, factors: Floats) -> Departure:
    """Returns the departures with the lines of each horizon raised by one of the factors (h,)."""
    return _rounded(_times(departure, factors))


def others_need(samples: Sequence[LimbDepartures], folds: Sequence[Departure], share: float) -> Floats:
    """(h,) factors on lines that were fitted to other people, above which enough of these people stay inside.

    Args:
        samples: One per log.
        folds: For each log, the departures fitted without its person and tracker.
        share: Required share of the ticks of all logs together at each horizon.
    """
    pooled = [pair for pair, counts in zip(zip(samples, folds, strict=True), counted(samples), strict=True) if counts]
    found = np.ones(len(folds[0].horizon_s))
    for k in range(len(found)):
        needed = np.concatenate([_of_pairs([one.factors(fold, k)]).max(axis=1) for one, fold in pooled])
        if len(needed):
            missed = _OTHERS if folds[0].horizon_s[k] <= _SOON_S else _OTHERS_LATER
            found[k] = np.quantile(needed, 1.0 - missed * (1.0 - share), method="higher")
    return np.clip(_up(found, _STEP), _LEAST_OTHERS, _MOST_OTHERS)


def counted(samples: Sequence[LimbDepartures]) -> list[bool]:
    """Marks the logs that count in totals over all ticks: those without ground truth, else all."""
    all_true = all(sample.true for sample in samples)
    return [all_true or not sample.true for sample in samples]


def _times(departure: Departure, factor: Floats) -> Departure:
    """Returns the lines raised by factors that broadcast to (7, h)."""
    beyond_m, residuals, swings_s = (
        factor * of for of in (departure.beyond_m, departure.residuals, _swings(departure))
    )
    return replace(departure, beyond_m=beyond_m, residuals=residuals, swings_s=swings_s)


def _rise(horizon_s: Floats, logs: Sequence[Floats]) -> Floats:
    """(h,) maximum rise, or sink, of the pelvis in nearly all ticks; input: (h, n) of each log [m].

    Before the last horizon, at most that of a constant acceleration until then, which the filter follows late; the rest
    is noise, which the ball covers.
    """
    last = _often([log[-1] for log in logs])
    evenly = last * ((horizon_s + _LATE_S) / (horizon_s[-1] + _LATE_S)) ** 2
    return _up(np.array([min(_often([log[k] for log in logs]), evenly[k]) for k in range(len(horizon_s))]), _CM)


def _often(logs: Sequence[Floats]) -> float:
    """Returns the quantile _RISEN of all heights [m]; a log's weight is the root of its number of ticks."""
    known = [log[np.isfinite(log)] for log in logs]
    height = np.concatenate(known)
    if not len(height):
        return 0.0
    weight = np.concatenate([np.full(len(log), max(1, len(log)) ** -0.5) for log in known])
    order = np.argsort(height, kind="stable")
    below = np.cumsum(weight[order])
    return float(height[order][np.searchsorted(below, _RISEN * below[-1])])


def _line(departed: Sequence[Floats], over: Sequence[Sequence[Floats]], most: Sequence[float]) -> Floats:
    """Offset >= 0 and a slope over each of some quantities: the plane with the minimum quantile loss.

    The weight of a log is the root of its number of ticks.

    Args:
        departed: Departures of each log, NaN if unknown [m].
        over: The quantities at the same places, of each log.
        most: Maximum offset, and slope over each.
    """
    known = [np.isfinite(of) for of in departed]
    y = np.concatenate([of[k] for of, k in zip(departed, known, strict=True)])
    if not len(y):
        return np.zeros(len(most))
    n, w = len(y), np.concatenate([np.full(k.sum(), max(1, k.sum()) ** -0.5) for k in known])
    w = w / w.mean()
    each = [np.concatenate([of[k] for of, k in zip(one, known, strict=True)]) for one in over]
    unknowns = coo_array(np.column_stack([np.ones(n), *each]))
    found = linprog(
        np.concatenate([np.zeros(len(most)), _BELOW * w, (1.0 - _BELOW) * w]),
        A_eq=hstack([unknowns, eye_array(n), -eye_array(n)]).tocsr(),
        b_eq=y,
        bounds=[(0.0, None if limit == np.inf else limit) for limit in most] + [(0.0, None)] * (2 * n),
        method="highs",
    )
    line: Floats = found.x[: len(most)]
    return line


def _raise(samples: Sequence[LimbDepartures], departure: Departure, k: int, share: float) -> Floats:
    """(7,) additions to the offsets at a horizon that contain people of each log and of all recordings together [m].

    The limbs of a pair share one. The ticks outside are included one after the other, the one that costs the least
    volume first, until enough are inside or only those remain at which a tracker throws a limb away.
    """
    factors = [sample.factors(departure, k) for sample in samples]
    more_m = [(of - 1.0) * sample.lines_m(departure, k) for of, sample in zip(factors, samples, strict=True)]
    log = np.repeat(np.arange(len(samples)), [_recorded(of).sum() for of in factors])
    factor, more = _of_pairs(factors), _of_pairs(more_m)
    true, pooled = np.array([sample.true for sample in samples]), np.array(counted(samples))[log]
    wanted = (1.0 - np.where(true, _TRUE, _FITTED) * (1.0 - share)) * np.bincount(log, minlength=len(samples))
    together = (1.0 - _TOGETHER * (1.0 - share)) * pooled.sum()
    radius, found = _radii_m(samples, departure, k), np.zeros(len(_PAIRS))
    limbs = np.array([len(pair) for pair in _PAIRS])
    possible: Bools = np.asarray((factor <= np.where(true, np.inf, _MOST)[log][:, None]).all(axis=1))
    asks = np.bincount(log[possible], minlength=len(samples)) >= wanted - EXACT
    while True:
        held: Bools = np.asarray((more <= found + EXACT).all(axis=1))
        lacks = asks & (np.bincount(log[held], minlength=len(samples)) < wanted - EXACT)
        asked = possible & ~held
        outside = more[asked & lacks[log]]
        if not len(outside) and held[pooled].sum() < together - EXACT:
            outside = more[asked & pooled]
        if not len(outside):
            break
        raised = np.maximum(outside, found)
        found = raised[np.argmin(((radius + raised) ** 2 - (radius + found) ** 2) @ limbs)]
    added_m = np.zeros(len(BODY))
    for pair, added in zip(_PAIRS, found, strict=True):
        added_m[list(pair)] = added
    return added_m


def _of_pairs(of_limbs: Sequence[Floats]) -> Floats:
    """(n, pairs) the larger value of each pair at the ticks of all logs at which any limb was recorded.

    From (n, 7) per log, NaN for limbs that were not recorded; -inf if neither of a pair was.
    """
    every = np.concatenate([of[_recorded(of)] for of in of_limbs])
    every = np.where(np.isfinite(every), every, -np.inf)
    return np.column_stack([every[:, list(pair)].max(axis=1) for pair in _PAIRS])


def _recorded(of_limbs: Floats) -> Bools:
    """(n,) True at the ticks at which any limb was recorded."""
    return np.asarray(np.isfinite(of_limbs).any(axis=1))


def _radii_m(samples: Sequence[LimbDepartures], departure: Departure, k: int) -> Floats:
    """(pairs,) mean heights of the lines of each pair; a tube's cost grows with the square [m]."""
    mean = np.concatenate([sample.lines_m(departure, k) for sample in samples]).mean(axis=0)
    return np.array([mean[list(pair)].mean() for pair in _PAIRS])


def _up(values: Floats, step: float) -> Floats:
    return np.round(np.ceil(values / step - 1e-9) * step, 6) + 0.0  # avoids -0.0
