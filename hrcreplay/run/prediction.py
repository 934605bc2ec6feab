"""Stage 2: the swept volumes at any horizon, for replay, live session and audit alike, and what is stored of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hrcreplay.geometry import convex_hull
from hrcreplay.human.model import LimitSet
from hrcreplay.human.prediction import reachable_sets, swept_volumes
from hrcreplay.records import Floats, HumanStates, Ints, SweptVolumes
from hrcreplay.robot.control.separation import Obstacles, obstacles
from hrcreplay.settings.sections import Occupancy
from hrcreplay.store.columns import occupancy_columns
from hrcreplay.store.run_folder import RunWriter


@dataclass(frozen=True)
class PredictionStage:
    """Stage 2: limit set, horizon, radii, margins and method of the swept volumes."""

    limits: LimitSet
    occupancy: Occupancy
    memory_s: float  #: how long the filter goes on without a measurement [s]

    @property
    def horizon_s(self) -> float:
        """Braking time T_s of the robot [s]."""
        return self.occupancy.stop_s

    @property
    def method(self) -> str:
        """How the volumes are predicted."""
        return self.occupancy.method

    @property
    def limbs(self) -> tuple[str, ...]:
        """Limbs that have volumes."""
        return swept_volumes.limbs_of(self.occupancy)

    def by(self, method: str) -> PredictionStage:
        """The same by another method."""
        return replace(self, occupancy=self.occupancy.model_copy(update={"method": method}))

    def reachable(self, states: HumanStates) -> reachable_sets.Reach:
        """Reachable interval of every joint at every tick."""
        return reachable_sets.reachable(
            states, self.limits, self.occupancy, horizon_s=self.horizon_s, memory_s=self.memory_s
        )

    def volumes(
        self, states: HumanStates, horizon_s: float | None = None, *, method: str | None = None
    ) -> SweptVolumes:
        """Swept volumes of every tick: the one call by which replay, live and audit ask for them.

        Args:
            states: The fused person.
            horizon_s: Until when after each tick they hold; None: the braking time T_s [s].
            method: None: that of the settings.
        """
        if method is not None:
            return self.by(method).volumes(states, horizon_s)
        horizon_s = self.horizon_s if horizon_s is None else horizon_s
        return swept_volumes.predict(states, self.limits, self.occupancy, horizon_s=horizon_s, memory_s=self.memory_s)


@dataclass
class Forecast:
    """The volumes of a batch of ticks at any horizon."""

    stage: PredictionStage
    states: HumanStates

    @cached_property
    def full(self) -> SweptVolumes:
        """Those of all ticks that hold for the braking time T_s."""
        return self.stage.volumes(self.states)

    def obstacles(self, tick: int, horizon_s: float) -> Obstacles:
        """Those of one tick that hold for ``horizon_s`` [s]."""
        if horizon_s == self.stage.horizon_s:
            return obstacles(self.full, tick, horizon_s)
        return obstacles(self.stage.volumes(self.states.rows(slice(tick, tick + 1)), horizon_s), 0, horizon_s)

    def asking(self, tick: int, asked: dict[float, Obstacles] | None) -> Callable[[float], Obstacles]:
        """``obstacles`` of one tick; keeps those that are asked for, by their horizon, where they are wanted later."""

        def predict(horizon_s: float) -> Obstacles:
            found = self.obstacles(tick, horizon_s)
            if asked is not None:
                asked[horizon_s] = found
            return found

        return predict


def stored_ticks(first: int, count: int, store_every: float) -> Ints:
    """Which of ``count`` ticks from the ``first`` of a run on have their volumes stored: one in ``store_every``."""
    if math.isinf(store_every):
        return np.zeros(0, np.int64)
    number = np.arange(first, first + count)
    return np.flatnonzero(np.floor(number / store_every) != np.floor((number - 1) / store_every))


def store_volumes(volumes: SweptVolumes, ticks: Ints, horizon_s: Floats, run: RunWriter) -> None:
    """Writes hull vertices and size of some ticks' volumes; a tick without a person has none.

    Args:
        volumes: Of any ticks.
        ticks: Rows of ``volumes`` to write.
        horizon_s: (n,) how long after its tick each row holds [s].
        run: Where they go.
    """
    t_ns: list[int] = []
    limbs: list[str] = []
    radii: list[float] = []
    sizes: list[float] = []
    hulls: list[Floats] = []
    horizons: list[float] = []
    for tick in ticks.tolist():
        for i, limb in enumerate(volumes.limbs):
            vertices = volumes.vertices(tick, i)
            if np.isnan(vertices).any():
                continue
            corners, faces = convex_hull.hull(vertices)
            radius = float(volumes.radius_m[tick, i])
            t_ns.append(int(volumes.t_ns[tick]))
            limbs.append(limb)
            radii.append(radius)
            sizes.append(convex_hull.sphere_swept_volume_m3(corners, radius, faces))
            hulls.append(corners)
            horizons.append(float(horizon_s[tick]))
    if t_ns:
        run.table("occupancy", occupancy_columns(np.array(t_ns), limbs, volumes.method, radii, sizes, hulls, horizons))
