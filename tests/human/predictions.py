"""Predictions by a method's name, with the defaults of the settings beside."""

from __future__ import annotations

from typing import Any

from hrcreplay.human.model import LimitSet
from hrcreplay.human.prediction import swept_volumes
from hrcreplay.human.prediction.swept_volumes import Reach
from hrcreplay.records import HumanStates, SweptVolumes
from hrcreplay.settings.sections import Fusion, Prediction

MEMORY_S = Fusion().memory_s


def margins(**changes: Any) -> Prediction:
    """Settings whose estimates are wide: 3 standard deviations, unless another number is given."""
    return Prediction(**({"sigmas": 3.0} | changes))


def predict(
    people: HumanStates, limits: LimitSet, *, horizon_s: float, method: str, margins: Prediction | None = None
) -> SweptVolumes:
    """See swept_volumes.predict."""
    occupancy = (margins or Prediction()).model_copy(update={"method": method})
    return swept_volumes.predict(people, limits, occupancy, horizon_s=horizon_s, memory_s=MEMORY_S)


def reachable(
    people: HumanStates, limits: LimitSet, horizon_s: float, method: str, margins: Prediction | None = None
) -> Reach:
    """See swept_volumes.reachable."""
    occupancy = (margins or Prediction()).model_copy(update={"method": method})
    return swept_volumes.reachable(people, limits, occupancy, horizon_s=horizon_s, memory_s=MEMORY_S)
