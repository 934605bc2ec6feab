"""The fit of ``human.model.Departure`` to how far whole limbs departed from constant velocity on recordings.

First rise and sink are fitted: a quantile, for the whole body moves with the pelvis. Then each pair of limbs and
horizon gets a line over the limb's residual, by quantile regression: of all lines above the wanted share of the
departures, the one that is least above them. The lines are then raised by one factor a horizon, until whole people are
inside, not limbs one by one, in the wanted share of the ticks of every log. Last, people whose truth is known are all
but wholly taken in, by raising what costs the least volume: of them no miss is a camera's. Simulated people, of whom
there are as many ticks as one likes, do not count where ticks of all logs are counted together.
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
#: Share of a pair's departures below its line before it is raised.
_BELOW = 0.995
#: No line is steeper: what is steeper rests on the few logs of much noise.
_STEEPEST = 1.25
#: The largest factor of all lines, how often its interval is halved, and the largest of one line after that.
_MOST, _HALVINGS, _MOST_AGAIN = 1.5, 12, 1.5
#: How many times as many ticks may miss as are asked for: of one log that was left out; and where it is fitted to, of
#: one log, of one that holds the truth, and of all logs together, for people who are not known miss more.
EACH, _FITTED, _TRUE, _TOGETHER = 3.0, 2.25, 0.3, 0.6
#: Departures, their growth, and rise and sink are rounded up to these [m], [1], [m]: with steps that coarse most folds
#: have the same rise and sink, beside which departures need to be measured once.
_MM, _HUNDREDTH, _CM = 1e-3, 1e-2, 1e-2


def fit(samples: Sequence[LimbDepartures], share: float) -> Departure:
    """The departures that hold whole people of some logs.

    Args:
        samples: One a log, with the same horizons.
        share: Of the ticks of other logs at each horizon, in (0, 1). Of all ticks fitted to, 0.6 times as many may
            miss, of one log's 2.25 times as many, of those of one with the truth 0.3 times as many.
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
    """Mark the logs that count where ticks of all are counted together: those without the truth, else all."""
    all_true = all(sample.true for sample in samples)
    return [all_true or not sample.true for sample in samples]


def _times(departure: Departure, factor: Floats) -> Departure:
    """Lines raised by factors that broadcast to (7, h)."""
    return replace(departure, beyond_m=factor * departure.beyond_m, residuals=factor * departure.residuals)


def _rise(horizon_s: Floats, logs: Sequence[Floats]) -> Floats:
    """(h,) how far the pelvis rises, or sinks, at most in nearly all ticks; of each log (h, n) how far it did [m].

    Before the last horizon no more than who accelerates evenly until then: the rest is noise, which the ball holds.
    """
    last = _often([log[-1] for log in logs])
    evenly = last * (horizon_s / horizon_s[-1]) ** 2
    return _up(np.array([min(_often([log[k] for log in logs]), evenly[k]) for k in range(len(horizon_s))]), _CM)


def _often(logs: Sequence[Floats]) -> float:
    """The height [m] that the share _BELOW of all ticks is not above; every log weighs as the root of its ticks."""
    known = [log[np.isfinite(log)] for log in logs]
    height = np.concatenate(known)
    if not len(height):
        return 0.0
    weight = np.concatenate([np.full(len(log), max(1, len(log)) ** -0.5) for log in known])
    order = np.argsort(height, kind="stable")
    below = np.cumsum(weight[order])
    return float(height[order][np.searchsorted(below, _BELOW * below[-1])])


def _line(logs: Sequence[tuple[Floats, Floats]]) -> Floats:
    """(2,) offset >= 0 and slope, up to _STEEPEST, of the line with the least quantile loss.

    Every log weighs as the root of its ticks.
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
    """The least factor on the lines at a horizon that holds the people of all logs together and of each.

    A log whose people not even the largest factor holds, as of a camera that loses the legs, asks for none.
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
    """(n, 7) a log: ``factors`` at the ticks at which any limb was recorded, 0 for those that were not."""
    factors = [s.factors(departure, k) for s in samples]
    return [np.nan_to_num(of[np.isfinite(of).any(axis=1)]) for of in factors]


def _raise(samples: Sequence[LimbDepartures], departure: Departure, k: int, share: float) -> Floats:
    """(7,) factors on the lines at a horizon that hold the people of each of the logs, whose truth is known.

    The limbs of a pair have one. Of the ticks that are outside the one is taken in that costs the least volume, until
    enough are inside, or only some that not even the largest factors hold.
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
    """(pairs,) what the tubes of a pair cost: their cross-sections, which grow with the square of the radius."""
    noise = np.minimum(np.concatenate([s.residual_m for s in samples]), NOISE_M)
    radius_m = departure.beyond_m[:, k] + departure.residuals[:, k] * noise.mean(axis=0)
    return np.array([(radius_m[list(pair)] ** 2).sum() for pair in _PAIRS])


def _up(values: Floats, step: float) -> Floats:
    return np.round(np.ceil(values / step - 1e-9) * step, 6) + 0.0  # no -0.0
