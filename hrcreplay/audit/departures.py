"""How far whole limbs depart from constant velocity on recordings: the fit of ``human.model.Departure``.

At a tick the pelvis departs until a horizon by how far it rises above, and sinks below, its heights at the tick and
where its velocity takes it, and a limb by how far its recorded points get from its tube (``velocity_tube``) without the
ball, at worst. First rise and sink are fitted: a quantile, for the whole body moves with the pelvis. Then each pair of
limbs and horizon gets a line over the limb's residual, by quantile regression: of all lines above the wanted share of
the departures, the one that is least above them. The lines are then raised by one factor a horizon, until whole people
are inside, not limbs one by one, in the wanted share of the ticks of every log.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import coo_array, eye_array, hstack

from hrcreplay.audit import baselines
from hrcreplay.audit.log_audit import SHORTER_S, RecordedFuture, check_containment, flesh_m, recorded_future
from hrcreplay.audit.measures import InflatedHull, union_volume_m3
from hrcreplay.audit.recording import Recording
from hrcreplay.human.model import Departure
from hrcreplay.human.prediction.swept_volumes import limb_radii
from hrcreplay.human.prediction.velocity_tube import LEGS, NOISE_M, THORAX, tubes
from hrcreplay.records import BODY, Bools, Floats, HumanStates, Ints, SweptVolumes
from hrcreplay.run.build import PredictionStage

#: Limbs that share a line: both sides of the body.
_PAIRS = ((0,), (1,), (2, 4), (3, 5), (6,))
#: Share of a pair's departures below its line before it is raised.
_BELOW = 0.995
#: No line is steeper: what is steeper rests on the few logs of much noise.
_STEEPEST = 1.0
#: The largest factor, and how often its interval is halved.
_MOST, _HALVINGS = 1.5, 12
#: How many times as many ticks of one log may miss as of all: where it was left out, and where it is fitted to.
EACH, _FITTED = 3.0, 2.5
#: Departures, their growth, and rise and sink are rounded up to these [m], [1], [m]: with steps that coarse most folds
#: have the same rise and sink, beside which departures need to be measured once.
_MM, _HUNDREDTH, _CM = 1e-3, 1e-2, 1e-2


@dataclass(frozen=True)
class LimbDepartures:
    """One log's departures at some ticks."""

    states: HumanStates  #: (n,) the fused person at the ticks
    horizon_s: Floats  #: (h,) [s]
    height_m: Floats  #: (2, h, n) how far the pelvis rises and sinks; NaN where it was not recorded [m]
    #: Of a horizon's index, rise and sink [m]: (n, 7) how far limbs of BODY depart beside those [m]; NaN where a limb
    #: was not recorded near the horizon's end, or not seen lately.
    beyond_m: Callable[[int, float, float], Floats]
    residual_m: Floats  #: (n, 7)

    def rows(self, which: Ints) -> LimbDepartures:
        """The same at some of the ticks."""
        return replace(
            self,
            states=self.states.rows(which),
            height_m=self.height_m[..., which],
            beyond_m=lambda k, rise_m, sink_m: self.beyond_m(k, rise_m, sink_m)[which],
            residual_m=self.residual_m[which],
        )

    def inside(self, departure: Departure, k: int) -> Floats:
        """(n,) whether all limbs that were recorded stayed within their departures at a horizon.

        1, 0, or NaN where none was recorded.
        """
        beyond = self.beyond_m(k, float(departure.rise_m[k]), float(departure.sink_m[k]))
        noise = np.minimum(self.residual_m, NOISE_M)
        line = departure.beyond_m[:, k] + departure.residuals[:, k] * noise + (self.residual_m - noise)
        known = np.isfinite(beyond)
        held = (~known | (beyond <= np.maximum(line, self.residual_m))).all(axis=1).astype(float)
        return np.where(known.any(axis=1), held, np.nan)


def departures(stage: PredictionStage, recording: Recording, ticks: Ints) -> LimbDepartures:
    """Measures the departures of a recording.

    Args:
        stage: Radii, braking time and margins.
        recording: The log.
        ticks: (n,) rows of ``recording.states``, of a person whom the filter has found.
    """
    horizon_s = np.array([*(h for h in SHORTER_S if h < stage.horizon_s), stage.horizon_s])
    states, nothing = recording.states.rows(ticks), np.zeros(len(ticks), dtype=bool)
    futures = [recorded_future(recording, ticks, h) for h in horizon_s.tolist()]
    bare = tube_stage(stage, _bare(horizon_s, 0.0, 0.0), residual=False)
    unknown_m = bare.occupancy.residual_unknown_m
    at = [tubes(states, bare.limits, True, unknown_m, h, stage.memory_s) for h in horizon_s.tolist()]

    # seen so lately that a limb has departed for no longer
    asked = [tubed.usable & (tubed.reach_s <= h) for tubed, h in zip(at, horizon_s, strict=True)]

    @cache
    def beyond_m(k: int, rise_m: float, sink_m: float) -> Floats:
        volumes = tube_stage(stage, _bare(horizon_s, rise_m, sink_m), residual=False).volumes(states, horizon_s[k])
        found = check_containment(volumes, futures[k], flesh_m(stage), nothing).beyond_m
        found = np.where(asked[k], found, np.nan)
        found[~at[k].legs_shown, LEGS] = np.nan
        return found

    heights = [_heights(bare.volumes(states, h), future) for h, future in zip(horizon_s, futures, strict=True)]
    of_thorax = np.array([usable[:, THORAX] for usable in asked])
    return LimbDepartures(
        states, horizon_s, np.where(of_thorax, np.stack(heights, axis=1), np.nan), beyond_m, at[0].residual
    )


def _bare(horizon_s: Floats, rise_m: float, sink_m: float) -> Departure:
    """Tubes without a ball."""
    rows, same = (len(BODY), len(horizon_s)), np.ones(len(horizon_s))
    return Departure(horizon_s, np.zeros(rows), np.ones(rows), rise_m * same, sink_m * same)


def _heights(volumes: SweptVolumes, future: RecordedFuture) -> Floats:
    """(2, n) how far the pelvis gets above and below where the thorax's tube starts, the pelvis now and later [m]."""
    found = np.full((2, len(volumes)), np.nan)
    for i in range(len(volumes)):
        pelvis = volumes.vertices(i, THORAX)[:2, 2]
        seen = future.limbs[BODY[THORAX]][future.first[i] : future.last[i], 0, 2]
        seen = seen[np.isfinite(seen)]
        if len(seen):
            found[:, i] = max(0.0, seen.max() - pelvis.max()), max(0.0, pelvis.min() - seen.min())
    return found


def tube_stage(stage: PredictionStage, departure: Departure, *, residual: bool = True) -> PredictionStage:
    """The stage by ``sound`` with the lower body and these departures, from the tick on."""
    changed = {"method": "sound", "legs": True, "latency_s": 0.0, "residual": residual}
    limits = replace(stage.limits, departure=departure)
    return replace(stage, limits=limits, occupancy=stage.occupancy.model_copy(update=changed))


def fit(samples: Sequence[LimbDepartures], share: float) -> Departure:
    """The departures that hold whole people of some logs.

    Args:
        samples: One a log, with the same horizons.
        share: Of all ticks at each horizon, in (0, 1). Of one log's ticks two and a half times as many may miss.
    """
    horizon_s = samples[0].horizon_s
    rise_m, sink_m = (
        np.array([_often([s.height_m[way, k] for s in samples]) for k in range(len(horizon_s))]) for way in range(2)
    )
    lines = np.zeros((len(BODY), len(horizon_s), 2))
    for k in range(len(horizon_s)):
        beyond = [s.beyond_m(k, float(rise_m[k]), float(sink_m[k])) for s in samples]
        for pair in _PAIRS:
            logs = zip(beyond, samples, strict=True)
            lines[list(pair), k] = _line([(b[:, pair], np.minimum(s.residual_m[:, pair], NOISE_M)) for b, s in logs])
    plain = Departure(horizon_s, _up(lines[..., 0], _MM), _up(lines[..., 1], _HUNDREDTH), rise_m, sink_m)
    factor = np.array([_factor(samples, plain, k, share) for k in range(len(horizon_s))])
    raised = {name: factor * getattr(plain, name) for name in ("beyond_m", "residuals")}
    return replace(plain, beyond_m=_up(raised["beyond_m"], _MM), residuals=_up(raised["residuals"], _HUNDREDTH))


def _often(logs: Sequence[Floats]) -> float:
    """What the wanted share of a pair's departures is below; every log weighs as the root of its ticks [m]."""
    known = [log[np.isfinite(log)] for log in logs]
    height = np.concatenate(known)
    if not len(height):
        return 0.0
    weight = np.concatenate([np.full(len(log), max(1, len(log)) ** -0.5) for log in known])
    order = np.argsort(height, kind="stable")
    below = np.cumsum(weight[order])
    found = height[order][np.searchsorted(below, _BELOW * below[-1])]
    return float(_up(np.array(found), _CM))


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
    """The least factor on the departures at a horizon that holds the people of all logs together and of each.

    A log whose people not even the largest factor holds, as of a camera that loses the legs, asks for none.
    """
    least = 1.0 - _FITTED * (1.0 - share)

    def shares(factor: float) -> tuple[Floats, float]:
        raised = replace(plain, beyond_m=factor * plain.beyond_m, residuals=factor * plain.residuals)
        hits = [inside[np.isfinite(inside)] for inside in (s.inside(raised, k) for s in samples)]
        return np.array([hit.mean() if len(hit) else 1.0 for hit in hits]), float(np.concatenate(hits).mean())

    if not any(np.isfinite(s.inside(plain, k)).any() for s in samples):
        return 1.0
    each, together = shares(_MOST)
    asks, wanted = each >= least, min(share, together)

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


def _up(values: Floats, step: float) -> Floats:
    return np.round(np.ceil(values / step - 1e-9) * step, 6) + 0.0  # no -0.0


def not_recorded(samples: Sequence[LimbDepartures]) -> list[str]:
    """Limbs of BODY that no log shows near a horizon's end, so that nothing is said of them."""
    return [limb for k, limb in enumerate(BODY) if not any(_recorded(s)[k] for s in samples)]


def _recorded(sample: LimbDepartures) -> Bools:
    """(7,) whether a limb was recorded near any horizon's end."""
    return np.any([np.isfinite(sample.beyond_m(k, 0.0, 0.0)).any(axis=0) for k in range(len(sample.horizon_s))], axis=0)


#: Ticks of a log whose volumes are counted out, and points for each.
_COUNTED, _POINTS = 24, 1024


def union_m3(stage: PredictionStage, sample: LimbDepartures, departure: Departure) -> list[float]:
    """Mean volume of all limbs, the lower body too, at each horizon [m^3]."""
    with_departures = tube_stage(stage, departure)
    states = _some(sample.states)
    return [_union_m3(with_departures.volumes(states, h)) for h in sample.horizon_s.tolist()]


def capsules_m3(stage: PredictionStage, sample: LimbDepartures) -> list[float]:
    """The same of capsules that grow by 2 m/s and 50 m/s^2, which have no lower body [m^3]."""
    radii, hand = limb_radii(stage.occupancy), stage.occupancy.hand_m
    states = _some(sample.states)
    return [
        _union_m3(baselines.predict(states, horizon_s=h, radii_m=radii, hand_m=hand, method="v2_a50"))
        for h in sample.horizon_s.tolist()
    ]


def _some(states: HumanStates) -> HumanStates:
    return states.rows(np.unique(np.linspace(0, len(states) - 1, min(_COUNTED, len(states))).astype(np.int64)))


def _union_m3(volumes: SweptVolumes) -> float:
    sizes = []
    for i in range(len(volumes)):
        limbs = [
            InflatedHull.around(volumes.vertices(i, k), float(volumes.radius_m[i, k]))
            for k in range(len(volumes.limbs))
            if np.isfinite(volumes.vertices(i, k)).all()
        ]
        sizes.append(union_volume_m3(limbs, _POINTS, _POINTS * i)[0])
    return float(np.mean(sizes)) if sizes else np.nan
