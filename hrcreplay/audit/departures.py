"""Departure of whole limbs from constant velocity on recordings, for the bounds that ``departure_fit`` fits.

The departure of the pelvis at a tick and horizon is its rise above, and sink below, its heights at the tick and at
constant velocity. The departure of a limb is the maximum distance of its recorded points from its tube
(``velocity_tube``) without the ball.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from hrcreplay.audit import baselines
from hrcreplay.audit.log_audit import SHORTER_S
from hrcreplay.evaluation.containment import RecordedFuture, body_radii_m, check_containment, recorded_future
from hrcreplay.evaluation.recorded_person import TRUTH
from hrcreplay.evaluation.recording import Recording
from hrcreplay.geometry.inflated_hull import InflatedHull, union_volume_m3
from hrcreplay.human.model import Departure
from hrcreplay.human.prediction.swept_volumes import limb_radii
from hrcreplay.human.prediction.velocity_tube import LEGS, NOISE_M, THORAX, limb_speeds, tubes
from hrcreplay.pipeline.surroundings import PredictionStage
from hrcreplay.records import BODY, LIMBS, Bools, Floats, HumanStates, Ints, SweptVolumes

#: Measured horizons; robots near people stop within about 10 to 100 ms, and below the first horizon nothing is known
#: [s].
_FIRST_S = 0.02
#: Smaller than any relevant number.
EXACT = 1e-12


@dataclass(frozen=True)
class LimbDepartures:
    """One log's departures at some ticks."""

    states: HumanStates  #: (n,) the fused person at the ticks
    horizon_s: Floats  #: (h,) [s]
    height_m: Floats  #: (2, h, n) rise and sink of the pelvis; NaN if not recorded [m]
    #: Function of a horizon's index, rise and sink [m]: (n, 7) departures of the limbs of BODY in addition to these
    #: [m]; NaN if a limb was not recorded near the horizon's end, or not seen recently.
    beyond_m: Callable[[int, float, float], Floats]
    residual_m: Floats  #: (n, 7)
    speed_m_per_s: Floats  #: (n, 7) of ``limb_speeds``
    settled: Bools  #: (n,) True: the filter has known the person for long enough to know all residuals
    true: bool  #: True: the log contains the ground truth

    def rows(self, which: Ints) -> LimbDepartures:
        """Selects some of the ticks."""
        return replace(
            self,
            states=self.states.rows(which),
            height_m=self.height_m[..., which],
            beyond_m=lambda k, rise_m, sink_m: self.beyond_m(k, rise_m, sink_m)[which],
            residual_m=self.residual_m[which],
            speed_m_per_s=self.speed_m_per_s[which],
            settled=self.settled[which],
        )

    def inside(self, departure: Departure, k: int) -> Floats:
        """(n,) 1 if all recorded limbs stayed within their departures at a horizon, else 0.

        NaN if none was recorded.
        """
        factors = self.factors(departure, k)
        held = ~(factors > 1.0 + EXACT).any(axis=1)
        return np.where(np.isfinite(factors).any(axis=1), held, np.nan)

    def factors(self, departure: Departure, k: int) -> Floats:
        """(n, 7) factors by which the lines at a horizon must be raised to contain each limb; 0 within the residual.

        NaN if a limb was not recorded.
        """
        beyond = self.beyond_m(k, float(departure.rise_m[k]), float(departure.sink_m[k]))
        apart = np.maximum(self.residual_m - NOISE_M, 0.0)
        needed = (beyond - apart) / self.lines_m(departure, k)
        return np.where(beyond <= self.residual_m, 0.0, needed)

    def lines_m(self, departure: Departure, k: int) -> Floats:
        """(n, 7) heights of the lines at a horizon, above 0 [m]."""
        line = departure.beyond_m[:, k] + departure.residuals[:, k] * np.minimum(self.residual_m, NOISE_M)
        if departure.swings_s is not None:
            line += departure.swings_s[:, k] * self.speed_m_per_s
        return np.maximum(line, EXACT)


def departures(stage: PredictionStage, recording: Recording, ticks: Ints) -> LimbDepartures:
    """Measures the departures of a recording.

    Args:
        stage: Radii, braking time and margins.
        recording: The log.
        ticks: (n,) rows of ``recording.states`` with a person that the filter has found.
    """
    horizon_s = np.array([*(h for h in (_FIRST_S, *SHORTER_S) if h < stage.horizon_s), stage.horizon_s])
    states, nothing = recording.states.rows(ticks), np.zeros(len(ticks), dtype=bool)
    futures = [recorded_future(recording.t_ns, recording.points_m, states, h) for h in horizon_s.tolist()]
    bare = tube_stage(stage, _bare(horizon_s, 0.0, 0.0), residual=False)
    unknown_m = bare.settings.residual_unknown_m
    tubed = tubes(states, True, unknown_m, stage.memory_s)
    asked = tubed.usable & (tubed.late_s <= 0.0)  # seen recently enough for the time of a departure

    @cache
    def beyond_m(k: int, rise_m: float, sink_m: float) -> Floats:
        volumes = tube_stage(stage, _bare(horizon_s, rise_m, sink_m), residual=False).volumes(states, horizon_s[k])
        found = check_containment(volumes, futures[k], body_radii_m(stage), nothing).beyond_m
        found = np.where(asked, found, np.nan)
        found[:, LEGS] = np.where(tubed.legs_shown, np.maximum(0.0, found[:, LEGS] - tubed.legs_off_m), np.nan)
        return found

    heights = [_heights(bare.volumes(states, h), future) for h, future in zip(horizon_s, futures, strict=True)]
    return LimbDepartures(
        states,
        horizon_s,
        np.where(asked[:, THORAX], np.stack(heights, axis=1), np.nan),
        beyond_m,
        tubed.residual,
        limb_speeds(states),
        np.asarray(np.isfinite(states.residual_m[:, : len(LIMBS)]).all(axis=1)),
        recording.source == TRUTH,
    )


def _bare(horizon_s: Floats, rise_m: float, sink_m: float) -> Departure:
    """Makes tubes without a ball."""
    rows, same = (len(BODY), len(horizon_s)), np.ones(len(horizon_s))
    return Departure(horizon_s, np.zeros(rows), np.ones(rows), rise_m * same, sink_m * same)


def _heights(volumes: SweptVolumes, future: RecordedFuture) -> Floats:
    """(2, n) rise and sink of the pelvis beyond the start of the thorax's tube, the pelvis now and later [m]."""
    found = np.full((2, len(volumes)), np.nan)
    for i in range(len(volumes)):
        pelvis = volumes.vertices(i, THORAX)[:2, 2]
        seen = future.of_limb(BODY[THORAX], i)[:, 0, 2]
        seen = seen[np.isfinite(seen)]
        if len(seen):
            found[:, i] = max(0.0, seen.max() - pelvis.max()), max(0.0, pelvis.min() - seen.min())
    return found


def tube_stage(
    stage: PredictionStage, departure: Departure, *, residual: bool = True, legs: bool = True
) -> PredictionStage:
    """Makes a ``sound`` stage with some departures, which start at the tick.

    Args:
        stage: Radii, braking time and margins.
        departure: The departures.
        residual: True: use the distance from the model.
        legs: True: include the lower body.
    """
    changed = {"method": "sound", "legs": legs, "latency_s": 0.0, "residual": residual}
    limits = replace(stage.limits, departure=departure)
    return replace(stage, limits=limits, settings=stage.settings.model_copy(update=changed))


def find_unrecorded_limbs(samples: Sequence[LimbDepartures]) -> list[str]:
    """Returns the limbs of BODY that no log shows near a horizon's end, so that there is no result for them."""
    return [limb for k, limb in enumerate(BODY) if not any(_find_recorded(s)[k] for s in samples)]


def _find_recorded(sample: LimbDepartures) -> Bools:
    """(7,) True if a limb was recorded near any horizon's end."""
    return np.any([np.isfinite(sample.beyond_m(k, 0.0, 0.0)).any(axis=0) for k in range(len(sample.horizon_s))], axis=0)


#: Number of ticks of a log whose volumes are estimated, and number of points for each.
_COUNTED, _POINTS = 100, 1024


def union_m3(stage: PredictionStage, sample: LimbDepartures, departure: Departure, *, legs: bool = True) -> list[float]:
    """Computes the mean volume of all limbs at each horizon [m^3].

    Args:
        stage: Radii, braking time and margins.
        sample: The person.
        departure: The departures.
        legs: True: include the lower body.
    """
    with_departures = tube_stage(stage, departure, legs=legs)
    states = _some(sample.states)
    return [_union_m3(with_departures.volumes(states, h)) for h in sample.horizon_s.tolist()]


def capsules_m3(stage: PredictionStage, sample: LimbDepartures) -> list[float]:
    """Computes the same for capsules that grow by 2 m/s and 50 m/s^2, without a lower body [m^3]."""
    radii, hand = limb_radii(stage.settings), stage.settings.hand_m
    states = _some(sample.states)
    return [
        _union_m3(baselines.predict(states, horizon_s=h, radii_m=radii, hand_m=hand, method="v2_a50"))
        for h in sample.horizon_s.tolist()
    ]


def _some(states: HumanStates) -> HumanStates:
    """The ticks in the middle of equal parts; at the first one, cameras have shown the person once."""
    count = min(_COUNTED, len(states))
    return states.rows(((np.arange(count) + 0.5) * (len(states) / max(1, count))).astype(np.int64))


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
