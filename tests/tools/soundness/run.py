"""Samples of any number, over any number of processes, with the same result."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from hrcreplay.human.model import HEIGHT, LimitSet
from hrcreplay.human.prediction import swept_volumes
from hrcreplay.human.prediction.swept_volumes import PRINTED
from hrcreplay.limits import load_limits
from hrcreplay.records import Floats, HumanStates, Ints, SweptVolumes
from hrcreplay.settings.sections import Prediction
from tests.human.predictions import MEMORY_S
from tests.tools.soundness.facets import distance_m, facets_of
from tests.tools.soundness.joint import bounds_of
from tests.tools.soundness.kinematics import CORNERS, POINTS
from tests.tools.soundness.motion import GROUPS
from tests.tools.soundness.sampler import BLOCK, ROUNDING_M, Corners, sample
from tests.tools.soundness.states import draw_estimate, states_of

#: States that are predicted at once and go to a process together.
_STATES_A_TASK = 8


@dataclass(frozen=True)
class Plan:
    """What is sampled."""

    method: str
    limits: str
    seed: int
    motions_a_state: int = 1000
    horizon_s: float = 0.377
    latency_s: float = 0.0
    sigmas: float = 0.0
    hand_m: float = 0.0
    unseen_s: float = 0.0  #: for how long nobody has seen the person [s]
    beyond: bool = False  #: also velocities above their bounds, and limits that bring joints to rest

    def __post_init__(self) -> None:
        if self.motions_a_state % BLOCK:
            raise ValueError(f"motions_a_state: found {self.motions_a_state}; take a multiple of {BLOCK}")

    @property
    def occupancy(self) -> Prediction:
        """That of the volumes, without what is the same on both sides: the thickness of limbs, and the residual.

        A body that is off the model by no more than the residual is inside a volume with that ball around it wherever
        the model is inside the volume without: so the model is held against the latter.
        """
        limbs = ("head", "thorax", "upper_arm", "lower_arm")
        return Prediction(
            method=self.method, residual=False, sigmas=self.sigmas, latency_s=self.latency_s, hand_m=self.hand_m
        ).model_copy(update={f"radius_{limb}_m": 0.0 for limb in limbs} | {"legs_radius_m": 0.0})

    @property
    def of_joints(self) -> LimitSet:
        """The limits without departures: tests/human/prediction/test_velocity_tube.py is about those."""
        return replace(load_limits(self.limits), departure=None)

    @property
    def obeyed(self) -> LimitSet:
        """What the motions keep to: under a printed method, which holds the pelvis's height, that stays as it is."""
        limits = self.of_joints
        if self.method not in PRINTED:
            return limits
        still = [np.append(rates[:HEIGHT], 0.0) for rates in (limits.v_min, limits.v_max)]
        return replace(limits, v_min=still[0], v_max=still[1])

    @property
    def coasted_s(self) -> float:
        """For how long the filter went on without measurements: at most for its memory."""
        return MEMORY_S if self.unseen_s > MEMORY_S else 0.0


@dataclass
class Result:
    """What the motions did; arrays are per limb, ``escapes`` has one entry more for motions that left any volume."""

    limbs: tuple[str, ...]
    states: int = 0
    motions: int = 0
    margin_m: Floats = field(default_factory=lambda: np.empty(0))  #: largest distance outside; negative: inside by
    state: Ints = field(default_factory=lambda: np.empty(0, np.int64))  #: the state where that was
    escapes: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    states_with_escapes: Ints = field(default_factory=lambda: np.empty(0, np.int64))

    def add(self, other: Result) -> None:
        """Takes in later states."""
        if self.states == 0:
            vars(self).update(vars(other))
            return
        worse = other.margin_m > self.margin_m
        self.margin_m, self.state = (
            np.where(worse, other.margin_m, self.margin_m),
            np.where(worse, other.state, self.state),
        )
        for name in ("states", "motions", "escapes", "states_with_escapes"):
            setattr(self, name, getattr(self, name) + getattr(other, name))


def corners_of(limbs: tuple[str, ...]) -> Corners:
    """The corners of the limbs in this order."""
    pairs = [(POINTS.index(point), k) for k, limb in enumerate(limbs) for point in CORNERS[limb]]
    points, owners = (np.array(column) for column in zip(*pairs, strict=True))
    groups = {"HD": "tz", "THX": "tz", "URA": "trz", "LRA": "trz", "ULA": "tlz", "LLA": "tlz", "LEGS": "z"}
    moved_by = np.array([[int(group in groups[limb]) for group in "trlz"] for limb in limbs])
    assert moved_by.shape[1] == len(GROUPS)
    return Corners(points, owners, moved_by)


def predict(states: HumanStates, plan: Plan) -> SweptVolumes:
    """The volumes under test. Limbs have no thickness, so their radii are what the method adds for other reasons."""
    return swept_volumes.predict(states, plan.of_joints, plan.occupancy, horizon_s=plan.horizon_s, memory_s=MEMORY_S)


def sample_states(plan: Plan, first: int, count: int) -> Result:
    """Samples the states of these numbers. Each has its own stream of chance, so any split gives the same."""
    limits = plan.obeyed
    generators = [np.random.default_rng([plan.seed, number]) for number in range(first, first + count)]
    estimates = [draw_estimate(rng, limits, plan.sigmas, plan.beyond, plan.coasted_s) for rng in generators]
    volumes = predict(states_of(estimates, plan.unseen_s), plan)
    corners, total = corners_of(volumes.limbs), Result(volumes.limbs)
    for i, (rng, estimate) in enumerate(zip(generators, estimates, strict=True)):
        clouds = [volumes.vertices(i, k) for k in range(len(volumes.limbs))]
        balls = volumes.radius_m[i]
        worst = sample(
            rng,
            estimate,
            bounds_of(limits),
            plan.unseen_s + plan.horizon_s + plan.latency_s,
            plan.hand_m,
            plan.beyond,
            corners,
            facets_of(clouds, balls),
            plan.motions_a_state,
        )
        escaped = worst.escapes > 0
        margin = worst.margin_m.copy()
        for k in np.flatnonzero(escaped[:-1]):
            margin[k] = max(margin[k], distance_m(clouds[k], worst.point_m[k]) - balls[k])
        number = np.full(len(clouds), first + i)
        total.add(Result(volumes.limbs, 1, plan.motions_a_state, margin, number, worst.escapes, escaped.astype(int)))
    return total


def run(plan: Plan, samples: int, processes: int, advance: Callable[[int], None] = lambda _: None) -> Result:
    """Samples at least so many motions.

    Args:
        plan: What is sampled.
        samples: How many motions; rounded up to whole states.
        processes: How many at a time. The result does not depend on it.
        advance: Told of every portion how many motions it was.
    """
    states = -(-samples // plan.motions_a_state)
    tasks = [(plan, first, min(_STATES_A_TASK, states - first)) for first in range(0, states, _STATES_A_TASK)]
    total = Result(())
    for result in _results(tasks, processes):
        total.add(result)
        advance(result.motions)
    return total


def _results(tasks: list[tuple[Plan, int, int]], processes: int) -> Iterator[Result]:
    if processes == 1:
        yield from (sample_states(*task) for task in tasks)
        return
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(sample_states, *zip(*tasks, strict=True))


def escaped(result: Result) -> bool:
    """Whether any point was outside its volume by more than rounding."""
    return bool(result.margin_m.max() > ROUNDING_M)
