"""How far whole limbs depart from constant velocity on recordings: the fit of ``human.model.Departure``.

At a tick a limb departs until a horizon by how far its recorded points get from the hull of the limb at the tick and
after the horizon, its ends moving on as they do (``velocity_tube``), at worst. It grows with the limb's residual. So
each pair of limbs and horizon gets a line over the residual, by quantile regression: of all lines above the wanted
share of the departures, the one that is least above them. The lines are then raised by one factor a horizon, until
whole people are inside, not limbs one by one, in the wanted share of the ticks of every log.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import coo_array, eye_array, hstack

from hrcreplay.audit import baselines
from hrcreplay.audit.log_audit import SHORTER_S, check_containment, flesh_m, recorded_future
from hrcreplay.audit.measures import InflatedHull, union_volume_m3
from hrcreplay.audit.recording import Recording
from hrcreplay.human.model import Departure
from hrcreplay.human.prediction.swept_volumes import limb_radii
from hrcreplay.human.prediction.velocity_tube import LEGS, NOISE_M, tubes
from hrcreplay.records import BODY, Floats, HumanStates, Ints, SweptVolumes
from hrcreplay.run.build import PredictionStage

#: Limbs that share a line: both sides of the body.
_PAIRS = ((0,), (1,), (2, 4), (3, 5), (6,))
#: Share of a pair's departures below its line before it is raised.
_BELOW = 0.995
#: The largest factor, how often its interval is halved, and how many times as many ticks of one log may miss as of all.
_MOST, _HALVINGS, EACH = 1.5, 12, 3.0
#: Departures and their growth are rounded up to these [m], [1].
_MM, _HUNDREDTH = 1e-3, 1e-2


@dataclass(frozen=True)
class LimbDepartures:
    """One log's departures at some ticks."""

    states: HumanStates  #: (n,) the fused person at the ticks
    horizon_s: Floats  #: (h,) [s]
    beyond_m: Floats  #: (h, n, 7) of BODY; NaN where a limb was not recorded near the horizon's end, or not seen lately
    residual_m: Floats  #: (n, 7)

    def rows(self, which: Ints) -> LimbDepartures:
        """The same at some of the ticks."""
        return replace(
            self, states=self.states.rows(which), beyond_m=self.beyond_m[:, which], residual_m=self.residual_m[which]
        )

    def inside(self, departure: Departure) -> Floats:
        """(h, n) whether all limbs that were recorded stayed within their departures: 1, 0, or NaN where none was."""
        noise = np.minimum(self.residual_m, NOISE_M)
        line = departure.beyond_m.T[:, None] + departure.residuals.T[:, None] * noise + (self.residual_m - noise)
        allowed = np.maximum(line, self.residual_m)
        known = np.isfinite(self.beyond_m)
        held = (~known | (self.beyond_m <= allowed)).all(axis=2).astype(float)
        return np.where(known.any(axis=2), held, np.nan)


def departures(stage: PredictionStage, recording: Recording, ticks: Ints) -> LimbDepartures:
    """Measures the departures of a recording.

    Args:
        stage: Radii, braking time and margins.
        recording: The log.
        ticks: (n,) rows of ``recording.states``, of a person whom the filter has found.
    """
    horizon_s = np.array([*(h for h in SHORTER_S if h < stage.horizon_s), stage.horizon_s])
    none = Departure(horizon_s, np.zeros((len(BODY), len(horizon_s))), np.ones((len(BODY), len(horizon_s))))
    bare = tube_stage(stage, none, residual=False)
    states, nothing = recording.states.rows(ticks), np.zeros(len(ticks), dtype=bool)
    found = np.empty((len(horizon_s), len(ticks), len(BODY)))
    for k, h in enumerate(horizon_s.tolist()):
        future = recorded_future(recording, ticks, h)
        measured = check_containment(bare.volumes(states, h), future, flesh_m(stage), nothing).beyond_m
        at = tubes(states, bare.limits, True, bare.occupancy.residual_unknown_m, h, stage.memory_s)
        lately = at.reach_s <= h  # seen so lately that it has departed for no longer
        found[k] = np.where(at.usable & lately, measured, np.nan)
        found[k, ~at.legs_shown, LEGS] = np.nan
    return LimbDepartures(states, horizon_s, found, at.residual)


def tube_stage(stage: PredictionStage, departure: Departure, *, residual: bool = True) -> PredictionStage:
    """The stage by ``sound`` with the lower body and these departures, from the tick on."""
    changed = {"method": "sound", "legs": True, "latency_s": 0.0, "residual": residual}
    limits = replace(stage.limits, departure=departure)
    return replace(stage, limits=limits, occupancy=stage.occupancy.model_copy(update=changed))


def fit(samples: Sequence[LimbDepartures], share: float) -> Departure:
    """The departures that hold whole people of some logs.

    Args:
        samples: One a log, with the same horizons.
        share: Of all ticks at each horizon, in (0, 1). Of one log's ticks three times as many may miss.
    """
    horizon_s = samples[0].horizon_s
    lines = np.zeros((len(BODY), len(horizon_s), 2))
    for k in range(len(horizon_s)):
        for pair in _PAIRS:
            lines[list(pair), k] = _line(
                [(s.beyond_m[k][:, pair], np.minimum(s.residual_m[:, pair], NOISE_M)) for s in samples]
            )
    plain = Departure(horizon_s, _up(lines[..., 0], _MM), _up(lines[..., 1], _HUNDREDTH))
    factor = np.array([_factor(samples, plain, k, share) for k in range(len(horizon_s))])
    return Departure(horizon_s, _up(plain.beyond_m * factor, _MM), _up(plain.residuals * factor, _HUNDREDTH))


def _line(logs: Sequence[tuple[Floats, Floats]]) -> Floats:
    """(2,) offset >= 0 and slope >= 0 of the line with the least quantile loss; every log weighs as the root of it."""
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
        bounds=[(0.0, None)] * (2 + 2 * n),
        method="highs",
    )
    line: Floats = found.x[:2]
    return line


def _factor(samples: Sequence[LimbDepartures], plain: Departure, k: int, share: float) -> float:
    """The least factor on the departures at a horizon that holds the people of all logs together and of each.

    A log whose people not even the largest factor holds, as of a camera that loses the legs, asks for none.
    """
    least = 1.0 - EACH * (1.0 - share)

    def shares(factor: float) -> tuple[Floats, float]:
        raised = replace(plain, beyond_m=factor * plain.beyond_m, residuals=factor * plain.residuals)
        hits = [inside[np.isfinite(inside)] for inside in (s.inside(raised)[k] for s in samples)]
        return np.array([hit.mean() if len(hit) else 1.0 for hit in hits]), float(np.concatenate(hits).mean())

    if not any(np.isfinite(s.inside(plain)[k]).any() for s in samples):
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
    return [limb for k, limb in enumerate(BODY) if not any(np.isfinite(s.beyond_m[..., k]).any() for s in samples)]


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
