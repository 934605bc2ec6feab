"""Since when a watched area is without people, against a search through all frames of the past."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest

from hrcreplay.geometry.polygon import ConvexPolygon
from hrcreplay.human.fusion.vacancy import VacancyState, WatchedArea, start, watch
from hrcreplay.records import NOBODY, Bools, CameraFrames, Floats, HumanStates
from tests.human.people import states as people

AREA = WatchedArea(
    ConvexPolygon.of_corners(np.array([[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]])),
    margin_m=0.1,
    clear_s=0.5,
    gap_s=0.3,
    speed_m_per_s=1.6,
)
MS = 1_000_000
CAMERAS = ("left", "right")
IDS = {"nobody": NOBODY, "person": 1, "other": 7}


class Scene:
    """Frames of two cameras as they come; a row is capture, arrival, camera, who and where."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, int, int, str, Floats]] = []

    def add(self, capture_ms: float, camera: int, who: str, x_m: float = np.nan, delay_ms: float = 20.0) -> None:
        """A frame with ``who``: 'nobody', 'person', 'other'; a body whose place is NaN has no point.

        A camera's frames arrive in the order of their captures; the reader drops others.
        """
        points = np.full((20, 3), np.nan)
        if who != "nobody":
            points[3] = x_m, 0.0, 1.7
        capture_ns = round(capture_ms * MS)
        before_ns = max((row[1] for row in self.rows if row[2] == camera), default=0)
        self.rows.append((capture_ns, max(before_ns, capture_ns + round(delay_ms * MS)), camera, who, points))

    def table(self) -> tuple[CameraFrames, Bools]:
        """All rows in order of arrival, and which are the person's."""
        rows = sorted(self.rows, key=lambda row: row[1])
        captured, arrived, camera = (np.array([row[i] for row in rows], dtype=np.int64) for i in range(3))
        points = np.array([row[4] for row in rows])
        body = np.array([IDS[row[3]] for row in rows], dtype=np.int64)
        confidence = np.isfinite(points[..., 0]).astype(float)
        return CameraFrames(captured, arrived, camera, body, points, confidence, CAMERAS), body == IDS["person"]


def ticks(count: int, every_ms: float = 4.0) -> HumanStates:
    """So many ticks from 0 on."""
    blank = people(np.zeros((count, 13)), np.zeros((count, 13)))
    return replace(blank, t_ns=np.round(np.arange(count) * every_ms * MS).astype(np.int64))


def watched(scene: Scene, of: HumanStates, area: WatchedArea = AREA, *, batch: int = 10**9) -> tuple[HumanStates, int]:
    """The states with their vacancies, and the count of refuting frames; ``batch`` ticks at a time."""
    state: VacancyState = start(2)
    frames, mine = scene.table()
    parts, refuting, last_ns = [], 0, -1
    for first in range(0, len(of), batch):
        part = of.rows(slice(first, first + batch))
        due = (frames.arrival_ns > last_ns) & (frames.arrival_ns <= part.t_ns[-1])
        last_ns = int(part.t_ns[-1])
        state, found, counts = watch(state, part, frames.rows(due), mine[due], area)
        parts.append(found)
        refuting += counts["watched_frames_refuting"]
    return HumanStates.join(parts), refuting


def by_search(scene: Scene, at_ns: int, *, but_the_person: bool) -> float:
    """The same by the definition, from all frames that have arrived."""
    best = -1
    for now_ns in sorted({-(-row[1] // (4 * MS)) * 4 * MS for row in scene.rows}):  # the ticks with something new
        if now_ns > at_ns:
            break
        rows = [row for row in scene.rows if row[1] <= now_ns]
        captures = [sorted(row[0] for row in rows if row[2] == camera) for camera in range(2)]
        if not all(captures):
            continue
        until = min(times[-1] for times in captures)
        begin = until - round(AREA.clear_s * 1e9)
        whole = all(
            times[0] <= begin and all(b - a <= AREA.gap_s * 1e9 for a, b in pairwise(times) if b > begin)
            for times in captures
        )
        inside = False
        for camera, who in product(range(2), ("other",) if but_the_person else ("other", "person")):
            sightings = [row for row in rows if row[2] == camera and row[3] == who]
            if sightings:
                last = max(sightings, key=lambda row: (row[0], row[1]))
                inside = inside or (last[0] >= begin and not abs(last[4][3, 0]) >= 2.0)  # NaN: anywhere
        if whole and not inside:
            best = max(best, until)
    return np.inf if best < 0 else (at_ns - best) / 1e9


@pytest.mark.parametrize("seed", range(12))
def test_a_search_through_all_frames_finds_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = Scene()
    for number in range(90):
        for camera in range(2):
            if rng.random() < (0.25 if 40 < number < 50 else 0.05):
                continue
            phase = (number // 15 + seed) % 4
            who = ("nobody", "person", "other", "nobody")[phase] if rng.random() < 0.9 else "nobody"
            x_m = float(rng.choice([0.5, 1.9, 2.5, np.nan], p=[0.4, 0.2, 0.35, 0.05]))
            scene.add(33.0 * number + rng.uniform(0.0, 9.0), camera, who, x_m, rng.uniform(5.0, 60.0))
    found, _ = watched(scene, ticks(800))
    assert found.nobody_s is not None
    assert found.nobody_else_s is not None
    assert np.isfinite(found.nobody_else_s).any()
    for tick in range(0, 800, 17):
        at_ns = int(found.t_ns[tick])
        assert found.nobody_s[tick] == by_search(scene, at_ns, but_the_person=False)
        assert found.nobody_else_s[tick] == by_search(scene, at_ns, but_the_person=True)


def test_batches_change_nothing() -> None:
    scene = Scene()
    for number in range(60):
        for camera in range(2):
            scene.add(33.0 * number, camera, "person" if 20 < number < 40 else "nobody", 2.5 - 0.1 * (number - 20))
    whole, refuting = watched(scene, ticks(500))
    parts, again = watched(scene, ticks(500), batch=7)
    for name in ("nobody_s", "nobody_else_s"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(parts, name))
    assert refuting == again


@pytest.mark.parametrize(("x_m", "refutes"), [(1.85, False), (1.0, True), (2.5, False)])
def test_somebody_who_is_further_inside_than_anybody_can_have_walked_refutes_the_area(
    x_m: float, refutes: bool
) -> None:
    scene = Scene()
    for number in range(31):
        for camera in range(2):
            scene.add(33.0 * number, camera, "nobody" if number < 30 else "other", x_m)
    _, refuting = watched(scene, ticks(300))  # 33 ms after the last vacant frames: 0.1 m + 1.6 m/s * 33 ms = 0.153 m
    assert refuting == (2 if refutes else 0)


@pytest.mark.parametrize(("out_m", "waits"), [(2.2, False), (1.8, True)])
def test_who_is_seen_to_leave_has_left_and_who_is_lost_inside_may_be_there(out_m: float, waits: bool) -> None:
    scene = Scene()
    for number in range(60):
        x_m = 1.0 if number < 25 else out_m
        for camera in range(2):
            scene.add(33.0 * number, camera, "person" if number < 30 else "nobody", x_m)
    found, _ = watched(scene, ticks(480))
    assert found.nobody_s is not None
    just_lost, later = round(30 * 33.0 / 4.0), round((30 * 33.0 + 600.0) / 4.0)
    assert (found.nobody_s[just_lost] > 0.9) == waits
    assert found.nobody_s[later] < 0.1


@pytest.mark.parametrize("clear_s", [0.0, 0.02])
def test_somebody_who_is_shown_inside_is_there_however_short_a_loss_counts(clear_s: float) -> None:
    scene = Scene()
    for number in range(40):
        for camera in range(2):
            scene.add(33.0 * number + 5.0 * camera, camera, "person" if 10 <= number < 30 else "nobody", 1.0)
    found, _ = watched(scene, ticks(330), replace(AREA, clear_s=clear_s))
    assert found.nobody_s is not None
    inside = (found.t_ns > 380 * MS) & (found.t_ns < 1000 * MS)
    np.testing.assert_allclose(np.diff(found.nobody_s[inside]), 0.004, atol=1e-9)
    assert found.nobody_s[found.t_ns > 1100 * MS].max() < 0.1


def test_one_camera_alone_makes_no_area_vacant() -> None:
    scene = Scene()
    for number in range(60):
        scene.add(33.0 * number, 0, "nobody")
    found, _ = watched(scene, ticks(500))
    assert found.nobody_s is not None
    assert np.isinf(found.nobody_s).all()
