"""Who is who among several bodies: against the truth of simulated people who cross, and bodies made by hand."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from hrcreplay.human.fusion import fuse
from hrcreplay.human.fusion.assignment import apart, least_sum
from hrcreplay.human.fusion.inverse_kinematics import measure
from hrcreplay.human.fusion.kalman import Filter, one_of
from hrcreplay.human.fusion.people import PeopleRules, PeopleState, follow, start
from hrcreplay.human.model import skeleton
from hrcreplay.limits import load_limits
from hrcreplay.records import MIRROR, CameraFrames, Floats, HumanStates, Ints, Measurements
from hrcreplay.settings.sections import Fusion
from tests import crowd
from tests.human.fusion import tracked_one_by_one
from tests.human.sightings import CAMERAS, LENGTHS_M, NEUTRAL

MS = 1_000_000
POSES = np.array([sensor.T_world_camera for sensor in crowd.SENSORS])
STANDING = PeopleRules(0.8, 2.0, np.zeros((2, 3)))


class Found(NamedTuple):
    """Result of a run."""

    states: HumanStates
    numbers: Ints
    counts: Counter[str]


def track(
    measured: Measurements,
    bodies: Ints,
    rules: PeopleRules,
    ticks_ns: Ints,
    batch: int = 10**9,
    settings: Fusion = Fusion(),  # noqa: B008 (a constant)
) -> Found:
    """Tracks all frames, so many ticks at a time."""
    names = tuple(measured.cameras)
    state: PeopleState = start(names)
    parts, numbers, counts = [], [], Counter[str]()
    before = 0
    for first in range(0, len(ticks_ns), batch):
        ticks = ticks_ns[first : first + batch]
        until = int(np.searchsorted(measured.arrival_ns, ticks[-1], side="right"))
        due = slice(before, until)
        found = follow(state, ticks, measured.rows(due), bodies[due], rules, settings, load_limits("human"))
        state, before = found.state, until
        parts.append(found.states)
        numbers.append(found.numbers)
        counts.update(found.counts)
    return Found(HumanStates.join(parts), np.concatenate(numbers), counts)


@cache
def crossing(count: int, ids: str, *, swap_sides: bool, until_s: float = 8.0) -> tuple[crowd.Crowd, Measurements]:
    """So many simulated people who cross before and behind each other, and their measurements."""
    t_s, bodies = crowd.people(count, until_s)
    found = crowd.record(t_s, bodies, ids=ids, swap_sides=swap_sides)
    return found, measure(found.frames, POSES, Fusion())


def ticks_of(measured: Measurements, every_ms: float = 4.0) -> Ints:
    span_ns = int(measured.arrival_ns[-1] - measured.arrival_ns[0])
    return measured.arrival_ns[0] + np.arange(0, span_ns + 1, round(every_ms * MS))


@pytest.mark.parametrize(
    ("count", "ids", "swap_sides"),
    [(2, "restart", False), (2, "swapped", True), (3, "restart", True), (3, "swapped", False)],
)
def test_people_who_cross_keep_their_numbers(count: int, ids: str, swap_sides: bool) -> None:
    scene, measured = crossing(count, ids, swap_sides=swap_sides)
    numbers = track(measured, scene.frames.body, PeopleRules(0.8, 2.0, POSES[:, :3, 3]), ticks_of(measured)).numbers
    owner = scene.owner[: len(numbers)]
    most = [Counter(numbers[owner == k].tolist()).most_common(1)[0] for k in range(count)]
    assert sorted(number for number, _ in most) == list(range(1, count + 1))  # nobody else was born, none merged
    assert sum(frames for _, frames in most) >= 0.99 * len(numbers)


def test_the_cut_into_calls_changes_no_bit() -> None:
    scene, measured = crossing(3, "restart", swap_sides=False)
    first = measured.arrival_ns < measured.arrival_ns[0] + 3_000 * MS
    measured, bodies = measured.rows(first), scene.frames.body[first]
    rules = PeopleRules(0.8, 2.0, POSES[:, :3, 3])
    whole = track(measured, bodies, rules, ticks_of(measured))
    pieces = track(measured, bodies, rules, ticks_of(measured), batch=7)
    assert whole.numbers.tolist() == pieces.numbers.tolist()
    assert whole.counts == pieces.counts
    for name in ("t_ns", "p", "v", "p_std", "points_m", "unseen_s", "person"):
        assert getattr(whole.states, name).tobytes() == getattr(pieces.states, name).tobytes(), name


def at(x_m: float, y_m: float = 0.0) -> Floats:
    """(20, 3) somebody who stands there; a model's legs are missing."""
    p = NEUTRAL.copy()
    p[:2] = x_m, y_m
    return np.asarray(skeleton(p[None], LENGTHS_M[None])[0])


class Frames:
    """Bodies as cameras at the world's origin show them; a row is when, which camera, which id, where."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, int, int, Floats]] = []

    def add(self, at_ms: float, camera: int, *bodies: Floats, first_id: int = 1) -> None:
        """A frame."""
        self.rows += [(round(at_ms * MS), camera, first_id + k, body) for k, body in enumerate(bodies)]

    def every(self, first_ms: int, last_ms: int, camera: int, *bodies: Floats) -> None:
        """A frame every 33 ms of people who stand."""
        for at_ms in range(first_ms, last_ms, 33):
            self.add(at_ms, camera, *bodies)

    def measured(self, late_ms: Ints | int = 0) -> tuple[Measurements, Ints]:
        """All rows in order of arrival, which is 20 ms after the capture and so much later, and the ids."""
        t_ns, camera, body = (np.array([row[i] for row in self.rows], dtype=np.int64) for i in range(3))
        points = np.array([row[3] for row in self.rows])
        sure = np.isfinite(points[..., 0]).astype(float)
        arrival_ns = t_ns + (20 + late_ms) * MS
        frames = CameraFrames(t_ns, arrival_ns, camera, body, points, sure, CAMERAS)
        order = np.argsort(arrival_ns, kind="stable")
        return measure(frames.rows(order), np.array([np.eye(4)] * 2), Fusion()), body[order]

    def track(self, until_ms: int, rules: PeopleRules = STANDING) -> Found:
        """Everybody in them, at a tick every 4 ms."""
        return track(*self.measured(), rules, np.arange(0, until_ms, 4) * MS)


def test_one_body_gives_the_states_of_the_filter_alone() -> None:
    scene, measured = crossing(2, "restart", swap_sides=True)
    mine = scene.owner == 0
    alone, ticks = measured.rows(mine), ticks_of(measured)
    found = track(alone, scene.frames.body[mine], PeopleRules(0.8, 2.0, POSES[:, :3, 3]), ticks)
    alone = alone.rows(alone.arrival_ns <= ticks[-1])
    _, states, counts, _ = fuse.fuse(fuse.start(alone.cameras), ticks, alone, Fusion(), load_limits("human"))
    assert found.states.person is None
    assert found.states.p.tobytes() == states.p.tobytes()
    assert found.states.points_m.tobytes() == states.points_m.tobytes()
    assert +counts == Counter({name: n for name, n in found.counts.items() if name in counts})


def assert_same(found: Found, expected: tracked_one_by_one.Found) -> None:
    """Fails unless numbers and counts are the same, and all states have the same bits."""
    assert found.numbers.tolist() == expected.numbers.tolist()
    assert +found.counts == expected.counts
    states = replace(found.states, person=found.states.numbers)
    for name, value in vars(expected.states).items():
        same = getattr(states, name)
        assert value.tobytes() == same.tobytes() if isinstance(value, np.ndarray) else value == same, name


@pytest.mark.parametrize(("count", "swap_sides"), [(1, False), (3, True)])
def test_people_are_followed_as_one_by_one(count: int, swap_sides: bool) -> None:
    scene, measured = crossing(count, "swapped", swap_sides=swap_sides, until_s=4.0)
    ticks, rules = ticks_of(measured, 20.0), PeopleRules(0.8, 2.0, POSES[:, :3, 3])
    come = measured.arrival_ns <= ticks[-1]
    measured, bodies = measured.rows(come), scene.frames.body[come]
    expected = tracked_one_by_one.follow(ticks, measured, bodies, rules, Fusion(), load_limits("human"))
    assert_same(track(measured, bodies, rules, ticks), expected)


@pytest.mark.parametrize("seed", range(8))
def test_bodies_at_random_are_followed_as_one_by_one(seed: int) -> None:
    """Bodies come, go, jump, are shown twice, without points, in two parts of a frame, late and in any order."""
    rng = np.random.default_rng(seed)
    frames, places = Frames(), rng.uniform([1.0, -1.5], [4.0, 1.5], (4, 2))
    for at_ms in range(0, 3500, 33):
        places += rng.normal(0.0, 0.02, places.shape)
        places[rng.random(4) < 0.01] = rng.uniform(0.5, 4.0, 2)
        for camera in range(2):
            shown = [
                at(*places[k]) + rng.normal(0.0, 0.03, (20, 3))
                for k in range(4)
                if rng.random() < (0.9, 0.6, 0.3, 0.1)[k]
            ]
            shown += [body + 0.05 for body in shown if rng.random() < 0.05]
            for body in shown:
                body[rng.random(20) < (1.0 if rng.random() < 0.03 else 0.1)] = np.nan
            order = rng.permutation(len(shown))
            cut = int(rng.integers(0, len(shown) + 1))
            frames.add(at_ms + 10 * camera, camera, *(shown[k] for k in order[:cut]), first_id=int(rng.integers(1, 3)))
            frames.add(at_ms + 10 * camera, camera, *(shown[k] for k in order[cut:]), first_id=5)
    measured, bodies = frames.measured(rng.integers(0, 3, len(frames.rows)) * 20)
    unsure = rng.random(measured.confidence.shape) < 0.03  # points that a tracker gives without a confidence
    measured = replace(measured, confidence=np.where(unsure, 0.0, measured.confidence))
    ticks, rules = np.arange(0, 4200, 12) * MS, PeopleRules(0.8, 0.5, np.zeros((2, 3)))
    settings = Fusion(fresh_s=0.1)
    expected = tracked_one_by_one.follow(ticks, measured, bodies, rules, settings, load_limits("human"))
    assert len(set(expected.states.numbers.tolist())) > 3  # not a scene without events
    assert (
        min(expected.counts[name] for name in ("person_bodies_dropped", "bodies_seen_briefly", "person_id_switches"))
        > 0
    )
    assert_same(track(measured, bodies, rules, ticks, settings=settings), expected)
    assert_same(track(measured, bodies, rules, ticks, batch=5, settings=settings), expected)


@pytest.mark.parametrize("seed", range(4))
def test_the_chosen_columns_have_the_smallest_sum(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(200):
        n = int(rng.integers(1, 7))
        cost = rng.random((n, n + int(rng.integers(0, 5))))
        cost[rng.random(cost.shape) < 0.4] = 1e6  # not allowed
        chosen = least_sum(cost)
        assert len(set(chosen.tolist())) == n
        rows, columns = linear_sum_assignment(cost)
        assert cost[range(n), chosen].sum() == pytest.approx(cost[rows, columns].sum(), rel=1e-12)


def test_one_person_before_two_cameras_is_one_person_and_a_body_shown_twice_too() -> None:
    frames = Frames()
    frames.every(0, 2000, 0, at(1.5), at(1.55, 0.05))  # the tracker shows somebody twice
    frames.every(10, 2000, 1, at(1.6, -0.1))
    found = frames.track(2000)
    assert found.states.person is None
    assert set(found.numbers.tolist()) == {1, -1}


def test_two_people_whom_one_camera_each_shows_side_by_side_are_two() -> None:
    frames = Frames()
    frames.every(0, 2000, 0, at(1.5))
    frames.every(10, 2000, 1, at(1.5, 0.7))
    found = frames.track(2000)
    assert set(found.states.numbers.tolist()) == {1, 2}
    for number, y_m in ((1, 0.0), (2, 0.7)):
        last = found.states.of_person(number).p[-1]
        assert last[:2] == pytest.approx([1.5, y_m], abs=0.03)


def test_a_newcomer_counts_by_its_points_until_it_is_a_person() -> None:
    frames = Frames()
    frames.every(0, 2000, 0, at(1.5))
    frames.every(1000, 2000, 1, at(3.0, 2.0))
    found = frames.track(2000)
    new = found.states.of_person(2)
    assert new.t_ns[0] == 1020 * MS  # the tick of the first frame's arrival
    by_points = np.isnan(new.p[:, 0])
    born_ns = new.t_ns[~by_points][0]
    assert 1320 * MS <= born_ns <= 1360 * MS  # shown for 0.3 s
    assert by_points[new.t_ns < born_ns].all()
    assert not by_points[new.t_ns >= born_ns].any()
    np.testing.assert_allclose(new.points_m[by_points][0], at(3.0, 2.0), atol=1e-9)
    assert new.frame_age_s[0] == pytest.approx(0.020)


def test_a_body_seen_for_a_moment_is_forgotten_and_its_number_used_again() -> None:
    frames = Frames()
    frames.every(0, 3000, 0, at(1.5))
    frames.add(1000, 1, at(4.0))
    frames.every(2000, 3000, 1, at(4.0, 2.0))
    found = frames.track(3000)
    new = found.states.of_person(2)
    first = new.rows(new.t_ns < 1500 * MS)
    assert np.isnan(first.p).all()
    assert 1290 * MS <= first.t_ns[-1] <= 1300 * MS  # until the frame is fusion.fresh_s old
    assert found.counts["bodies_seen_briefly"] == 1
    assert set(found.states.numbers.tolist()) == {1, 2}


def test_a_person_who_leaves_is_unknown_for_the_memory_and_the_last_one_for_ever() -> None:
    frames = Frames()
    frames.every(0, 2000, 0, at(1.5), at(3.0, 1.0))
    found = frames.track(8000)
    gone = found.states.of_person(2)
    last_ns = 2000 * MS - (2000 - 1980) * MS + 20 * MS  # arrival of the last frame
    assert gone.t_ns[-1] == last_ns + 2000 * MS
    assert gone.frame_age_s[-1] > 1.9
    assert found.states.of_person(1).t_ns[-1] == 7996 * MS


def test_the_filter_of_a_person_has_each_field_of_that_slot() -> None:
    start_ = fuse.start(CAMERAS)
    slots = Filter(*(type(part)(*(np.stack([array, array]) for array in part)) for part in start_))  # type: ignore[arg-type]
    of_second = one_of.py_func(slots, 1)
    for part, second in zip(slots, of_second, strict=True):
        for array, mine in zip(part, second, strict=True):
            assert np.shares_memory(mine, array[1])
            assert mine.shape == array.shape[1:]


def test_the_first_person_is_the_one_nearest_to_the_camera() -> None:
    frames = Frames()
    frames.every(0, 500, 0, at(3.0, 1.0), at(2.0, -1.0), at(2.5))
    found = frames.track(600)
    assert found.numbers[:3].tolist() == [2, 1, 3]


def test_whoever_comes_after_the_memory_is_the_person_who_stayed() -> None:
    frames = Frames()
    frames.every(0, 1000, 0, at(1.5))
    frames.every(4000, 5000, 0, at(4.0, 1.0))
    assert set(frames.track(5000).numbers.tolist()) == {1}


def test_the_person_seen_last_is_the_one_who_stays() -> None:
    frames = Frames()
    frames.every(0, 1000, 0, at(1.5))
    frames.every(0, 2000, 1, at(3.0, 1.0))
    states = frames.track(7000).states
    assert states.of_person(1).t_ns[-1] < 3100 * MS
    assert states.of_person(2).t_ns[-1] == 6996 * MS


@pytest.mark.parametrize("until_ms", [240, 244])
def test_rows_are_enough_whenever_somebody_comes(until_ms: int) -> None:
    """Rows are made for the people of now; here one more comes at any tick of a call, and has a slot already."""
    ticks = np.arange(0, until_ms, 4) * MS
    for at_ms in range(40, 200, 4):
        frames = Frames()
        frames.add(0, 0, at(1.5))
        frames.add(20, 1, at(3.0, 2.0), at(3.05, 2.0))  # one is the other shown twice, so a slot is left
        frames.add(at_ms, 0, at(1.5, 2.5), first_id=7)
        measured, bodies = frames.measured()
        whole = track(measured, bodies, STANDING, ticks)
        pieces = track(measured, bodies, STANDING, ticks, batch=1)
        assert set(whole.states.numbers.tolist()) == {1, 2, 3}
        assert whole.numbers.tolist() == pieces.numbers.tolist()
        for name in ("t_ns", "numbers", "points_m"):
            assert getattr(whole.states, name).tobytes() == getattr(pieces.states, name).tobytes(), (at_ms, name)


def test_a_hidden_person_is_expected_where_the_last_steps_lead() -> None:
    """Two people walk towards each other, are hidden while they pass, and come out on the other side."""
    frames = Frames()
    for k in range(120):
        s = k / 30.0
        one, two = at(2.0, -1.5 + 0.9 * s), at(2.2, 2.0 - 0.9 * s)
        if not 1.4 <= s < 2.3:
            frames.add(1e3 * s, 0, *((one, two) if k % 2 else (two, one)))  # the ids change hands with every frame
    found = frames.track(4000)
    ends = [found.states.of_person(number).p[-1, 1] for number in (1, 2)]
    begins = [found.states.of_person(number).p[150, 1] for number in (1, 2)]
    assert set(found.states.numbers.tolist()) == {1, 2}
    assert all(np.sign(a) == -np.sign(b) for a, b in zip(begins, ends, strict=True))


def test_exchanged_sides_do_not_make_another_person() -> None:
    frames = Frames()
    for k, at_ms in enumerate(range(0, 2000, 33)):
        bodies = [body[list(MIRROR)] if (k + n) % 2 else body for n, body in enumerate((at(1.5), at(1.5, 0.6)))]
        frames.add(at_ms, 0, *bodies)
    found = frames.track(2000)
    assert set(found.states.numbers.tolist()) == {1, 2}
    assert (np.sort(found.numbers.reshape(-1, 2), axis=1) == [1, 2]).all()


def test_how_far_bodies_are_apart_is_the_mean_of_their_common_points_either_side_being_left() -> None:
    rng = np.random.default_rng(6)
    expected_m, points_m = rng.normal(size=(20, 3)), rng.normal(size=(4, 20, 3))
    points_m[1] = expected_m[list(MIRROR)] + [0.3, 0.0, 0.4]  # the sides exchanged
    points_m[2, 5:] = np.nan
    expected_m[2] = points_m[3] = np.nan
    found = [apart(points, expected_m, 7.0 + body) for body, points in enumerate(points_m)]
    for body, points in enumerate(points_m):
        means = []
        for order in (range(20), MIRROR):
            far = [np.sqrt(((points[i] - expected_m[k]) ** 2).sum()) for k, i in enumerate(order)]
            known = [one for one in far if np.isfinite(one)]
            means.append(sum(known) / len(known) if known else 7.0 + body)
        assert found[body] == pytest.approx(min(means))
    assert found[1] == pytest.approx(0.5)
    assert found[3] == 10.0


def test_a_body_that_jumps_is_another_until_the_first_is_forgotten() -> None:
    frames = Frames()
    frames.every(0, 1000, 0, at(1.5))
    frames.every(1000, 5000, 0, at(4.0))
    states = frames.track(5000).states
    assert set(states.numbers.tolist()) == {1, 2}
    at_s = {number: replace(states.of_person(number)).t_ns for number in (1, 2)}
    assert at_s[1][-1] < 3100 * MS < at_s[2][-1] == 4996 * MS
