"""Stage 2 with its settings, and the obstacles of a robot: people's volumes, and the border of a watched area."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial

import numpy as np

from hrcreplay.human.fusion.vacancy import WatchedArea
from hrcreplay.human.model import LimitSet
from hrcreplay.human.prediction import swept_volumes
from hrcreplay.pipeline.batch.ticks import KNOWN, LEFT, TOO_OLD, PeopleAhead, hulls_of
from hrcreplay.records import BORDER, Bools, Floats, HumanStates, Ints, SweptVolumes, volume_name
from hrcreplay.robot.control.border import Border
from hrcreplay.robot.control.controllers import Predict
from hrcreplay.robot.control.separation import Obstacles, join_obstacles, obstacles, unknown_obstacles
from hrcreplay.settings.sections import Prediction


@dataclass(frozen=True)
class PredictionStage:
    """Stage 2: limit set, horizon, radii, margins and method of the swept volumes."""

    limits: LimitSet
    settings: Prediction
    memory_s: float  #: time for which the filter continues without a measurement [s]

    @property
    def horizon_s(self) -> float:
        """Braking time T_s of the robot [s]."""
        return self.settings.stop_s

    @property
    def method(self) -> str:
        """Method of the prediction."""
        return self.settings.method

    @property
    def limbs(self) -> tuple[str, ...]:
        """Limbs that have volumes."""
        return swept_volumes.limbs_of(self.settings)

    def by(self, method: str) -> PredictionStage:
        """Returns the stage with another method."""
        return replace(self, settings=self.settings.model_copy(update={"method": method}))

    def reachable(self, states: HumanStates) -> swept_volumes.Reach:
        """Computes the reachable interval of every joint at every tick."""
        return swept_volumes.reachable(
            states, self.limits, self.settings, horizon_s=self.horizon_s, memory_s=self.memory_s
        )

    def volumes(
        self, states: HumanStates, horizon_s: float | None = None, *, method: str | None = None
    ) -> SweptVolumes:
        """Computes the swept volumes of every tick, for replay, live and audit alike.

        Args:
            states: The fused person.
            horizon_s: Time after each tick until which they hold; None: the braking time T_s [s].
            method: None: as in the settings.
        """
        if method is not None:
            return self.by(method).volumes(states, horizon_s)
        horizon_s = self.horizon_s if horizon_s is None else horizon_s
        return self.predictor.prepare(states).volumes(horizon_s)

    @cached_property
    def predictor(self) -> swept_volumes.Predictor:
        """The stage's predictor, for volumes of the same people at several horizons."""
        return swept_volumes.Predictor(self.limits, self.settings, self.memory_s)


@dataclass(frozen=True)
class WatchedBorder:
    """The border of a watched area around the robot, and the speed of people who enter."""

    area: WatchedArea
    border: Border
    latency_s: float  #: from the newest capture to the robot's reaction [s]

    def depth_m(self, since_s: float, horizon_s: float) -> float:
        """Depth that a person outside ``since_s`` [s] ago can reach within ``horizon_s`` [m]."""
        return float(self.area.reached_m(since_s + horizon_s + self.latency_s))


@dataclass(frozen=True)
class Surroundings:
    """Obstacles of a robot: the people's volumes, and the border beyond which unseen people may be.

    A person whose newest frame is too old is unknown. No person is needed while the watched area is certainly empty.
    """

    prediction: PredictionStage
    fresh_s: float  #: maximum age of a person's newest frame, since its capture; an older person is unknown [s]
    watched: WatchedBorder | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the obstacles beside one person: the limbs that have volumes, then the sides of the border."""
        sides = 0 if self.watched is None else len(self.watched.border.normals)
        return (*self.prediction.limbs, *(BORDER,) * sides)

    def names_of(self, people: int) -> tuple[str, ...]:
        """Names of all obstacles beside so many people: ``names``, then the limbs of persons 2, 3, ..."""
        names, limbs = self.names, self.prediction.limbs
        return tuple(volume_name(i, names, limbs) for i in range(len(names) + (people - 1) * len(limbs)))

    def obstacles(self, states: HumanStates, rows: slice, people: Sequence[Obstacles]) -> Obstacles:
        """Returns the volumes of a tick and the border, as far as they are known.

        Args:
            states: The fused people.
            rows: Rows of the tick, one per person.
            people: Their volumes at that tick.
        """
        fresh = states.frame_age_s[rows] <= self.fresh_s
        numbers = [1] * len(fresh) if states.person is None else states.person[rows].tolist()
        if self.watched is None or states.nobody_s is None or states.nobody_else_s is None:
            found = join_obstacles(people)
            return self.numbered(found if all(fresh.tolist()) else found._replace(known=False), numbers)
        since_s = float(np.where(fresh, states.nobody_else_s[rows], states.nobody_s[rows]).max())
        horizon_s = people[0].horizon_s
        depth_m = self.watched.depth_m(since_s, horizon_s)
        known = [one for one, there in zip(people, fresh.tolist(), strict=True) if there]
        person = join_obstacles(known) if known else len(self.prediction.limbs)
        there = [number for number, is_fresh in zip(numbers, fresh.tolist(), strict=True) if is_fresh]
        return self.numbered(self.watched.border.obstacles(depth_m, horizon_s, person), there)

    def numbered(self, found: Obstacles, numbers: Sequence[int]) -> Obstacles:
        """The volumes of people and what follows them, with their places in ``names_of`` if that is needed."""
        if all(number == 1 for number in numbers):
            return found
        each = len(self.prediction.limbs)
        return found._replace(numbers=_places(tuple(numbers), len(self.names), each, len(found.radius_m)))


@lru_cache(maxsize=64)
def _places(people: tuple[int, ...], names: int, each: int, count: int) -> Ints:
    """(count,) places of the volumes of some people, and of what follows them, as ``Surroundings.names_of`` orders all.

    Args:
        people: Their numbers.
        names: Number of names beside one person.
        each: Number of limbs of a person.
        count: Number of volumes.
    """
    limbs = np.concatenate([(0 if one == 1 else names + (one - 2) * each) + np.arange(each) for one in people])
    found: Ints = np.concatenate([limbs, each + np.arange(count - len(limbs))])
    found.setflags(write=False)
    return found


@dataclass
class Forecast:
    """Obstacles of a batch of ticks, at any horizon."""

    around: Surroundings
    states: HumanStates
    most_ahead: int = 32  #: largest number of ticks after one whose volumes are computed with it

    def __post_init__(self) -> None:
        self.t_ns, self._first = self.states.ticks()
        self._last, self._lasted = (-1, 0.0), 0  # tick and horizon asked for last; ticks before it with that horizon
        self._ahead: dict[float, tuple[int, SweptVolumes]] = {}  # horizon -> first row, volumes from it on

    @cached_property
    def person(self) -> swept_volumes.PreparedPerson:
        """The people, prepared for volumes at any horizon."""
        return self.around.prediction.predictor.prepare(self.states)

    @cached_property
    def ahead(self) -> PeopleAhead | None:
        """The people as numbers for the kernel of whole batches; None if it cannot predict them.

        It predicts by ``sound`` alone, without a watched area. Ticks with people who count by their points, or whose
        torso is out of sight, are left to Python.
        """
        person, states = self.person, self.states
        if person.held is None or self.around.watched is not None:
            return None
        by_hand = np.logical_or.reduceat(person.by_points | person.partly_seen, self._first[:-1])
        return PeopleAhead(
            self._first,
            np.array(states.numbers),  # a copy, which is not protected
            np.where(self._too_old, TOO_OLD, np.where(by_hand, LEFT, KNOWN)),
            person.predictor.prediction.latency_s,
        )

    @cached_property
    def _too_old(self) -> Bools:
        """(k,) true for ticks with somebody whose newest frame is too old."""
        return np.logical_or.reduceat(~(self.states.frame_age_s <= self.around.fresh_s), self._first[:-1])

    @cached_property
    def full(self) -> SweptVolumes:
        """Volumes of all rows for the braking time T_s."""
        return self.person.volumes(self.around.prediction.horizon_s)

    def rows(self, tick: int) -> slice:
        """The rows of a tick, one per person."""
        return slice(int(self._first[tick]), int(self._first[tick + 1]))

    def obstacles(self, tick: int, horizon_s: float) -> Obstacles:
        """Obstacles of one tick up to ``horizon_s`` [s]."""
        if self.around.watched is None and self._too_old[tick]:
            return unknown_obstacles(horizon_s)
        if horizon_s == self.around.prediction.horizon_s:
            return self._of_rows(tick, horizon_s, 0, self.full)
        rows, self._lasted = self.rows(tick), self._lasted + 1 if self._last == (tick - 1, horizon_s) else 0
        self._last = tick, horizon_s
        first, found = self._ahead.get(horizon_s, (0, None))
        if found is None or not first <= rows.start <= rows.stop <= first + len(found):
            together = min(self._lasted, self.most_ahead, len(self.t_ns) - 1 - tick)
            if not together and self.ahead is not None and self.ahead.what[tick] == KNOWN:
                return self._alone(self.ahead, tick, horizon_s)
            first, found = rows.start, self.person.volumes(horizon_s, rows.start, self.rows(tick + together).stop)
            self._ahead[horizon_s] = first, found
        return self._of_rows(tick, horizon_s, first, found)

    def _of_rows(self, tick: int, horizon_s: float, first: int, volumes: SweptVolumes) -> Obstacles:
        """Obstacles of a tick from volumes that begin at row ``first``.

        They are those of as many ticks after another one as had its horizon before it: a robot that stands asks for one
        horizon, and to compute its ticks together is faster, and other methods ask, too.
        """
        rows = self.rows(tick)
        people = [obstacles(volumes, row - first, horizon_s) for row in range(rows.start, rows.stop)]
        return self.around.obstacles(self.states, rows, people)

    def _alone(self, ahead: PeopleAhead, tick: int, horizon_s: float) -> Obstacles:
        """Obstacles of a tick alone, in one kernel: in half the time, and the same numbers."""
        rows, until_s = self.rows(tick), (horizon_s, horizon_s + ahead.latency_s)
        hulls = hulls_of(self.person.held, rows.start, rows.stop, until_s, True)
        found = Obstacles(hulls.vertices, hulls.offsets, hulls.radius, hulls.boxes, hulls.known, horizon_s)
        return self.around.numbered(found, ahead.number[rows].tolist())

    def until(self, horizon_s: Floats) -> list[Obstacles]:
        """Obstacles of every tick, each until its own horizon (n,) after it [s]."""
        volumes, found = self.person.volumes(np.repeat(horizon_s, np.diff(self._first))), []
        for tick, until_s in enumerate(horizon_s.tolist()):
            rows = self.rows(tick)
            people = [obstacles(volumes, row, until_s) for row in range(rows.start, rows.stop)]
            found.append(self.around.obstacles(self.states, rows, people))
        return found

    def predict(self, tick: int) -> Predict:
        """Obstacles of one tick as a function of the horizon."""
        return partial(self.obstacles, tick)
