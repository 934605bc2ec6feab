"""Cleaning of recorded skeletons, and selection of the person of interest among several bodies.

Each kind of defect is handled here and counted under its name in DEFECTS. Body ids change, so the person is the body
nearest to the person's last position.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from math import dist, inf, isfinite, isnan
from typing import NamedTuple

import numpy as np

from hrcreplay.logs.clocks import CameraClock
from hrcreplay.logs.messages import RawSkeleton, missing_body
from hrcreplay.records import NOBODY, POINTS, Bools, CameraFrames, Floats, Ints

_TORSO = ("pelvis", "chest", "neck", "shoulder_l", "shoulder_r", "hip_l", "hip_r")
_IN_TORSO = np.isin(POINTS, _TORSO)

Place = tuple[float, float, float]


@dataclass(frozen=True)
class LastPosition:
    """Last position of the person, and its time."""

    position_m: Place
    arrival_ns: int


@dataclass(frozen=True)
class PersonMemory:
    """State of the person selection between two tables of frames.

    Cameras with known poses share the space "world"; every other camera has its own space.
    """

    sightings: tuple[tuple[str, LastPosition], ...] = ()  #: space -> last sighting
    bodies: tuple[tuple[str, int], ...] = ()  #: camera -> body id of the person


def select_person(
    frames: CameraFrames,
    memory: PersonMemory,
    T_world_camera: Floats,
    jump_m: float,
    memory_s: float,
) -> tuple[PersonMemory, Bools, Counter[str]]:
    """Finds the one body of each frame that continues the person in space.

    A body further than ``jump_m`` from the person's last position is another person. After ``memory_s`` without the
    person, the body nearest to that position becomes the person; the first person is the body nearest to its camera.

    Args:
        frames: All bodies, in order of arrival. All bodies of one frame (camera and capture time) are in one table;
            between frames, tables may be split anywhere.
        memory: From the previous table; ``PersonMemory()`` at the start.
        T_world_camera: (c, 4, 4), NaN for a camera of unknown pose.
        jump_m: Maximum distance from the last position [m].
        memory_s: Time for which the last position is used [s].

    Returns:
        The new memory; (n,) True for rows of the person, at most one per frame; and counts: ``person_bodies_dropped``,
        ``person_frames_beside_others`` (frames that show at least one other body), ``person_id_switches`` and
        ``person_frames_without`` (frames without a body near enough).
    """
    known: Bools = np.asarray(np.isfinite(T_world_camera).all(axis=(1, 2)))
    poses = np.where(known[:, None, None], T_world_camera, np.eye(4))
    spaces = ["world" if there else name for name, there in zip(frames.cameras, known.tolist(), strict=True)]
    eyes_m, places_m = poses[:, :3, 3].tolist(), _places(frames, poses).tolist()
    sightings, bodies = dict(memory.sightings), dict(memory.bodies)
    counts: Counter[str] = Counter()
    keep = np.zeros(len(frames), dtype=np.bool_)
    for (camera, _), rows in _by_frame(frames).items():
        space, name = spaces[camera], frames.cameras[camera]
        now_ns, last = int(frames.arrival_ns[rows[0]]), sightings.get(space)
        here_m = last.position_m if last else eyes_m[camera]
        apart_m, row = _nearest(rows, places_m, here_m)
        remembered = last is not None and now_ns - last.arrival_ns <= memory_s * 1e9
        found = isfinite(apart_m) and (not remembered or apart_m <= jump_m)
        counts["person_bodies_dropped"] += len(rows) - found
        others = [other for other in rows if not isnan(places_m[other][0]) and not (found and other == row)]
        counts["person_frames_beside_others"] += bool(others)
        if not found:
            counts["person_frames_without"] += 1
            continue
        keep[row] = True
        x, y, z = places_m[row]
        sightings[space] = LastPosition((x, y, z), now_ns)
        body = int(frames.body[row])
        counts["person_id_switches"] += bodies.get(name, body) != body
        bodies[name] = body
    carried = PersonMemory(tuple(sorted(sightings.items())), tuple(sorted(bodies.items())))
    return carried, keep, +counts


def _nearest(rows: list[int], places_m: list[Place], here_m: Place) -> tuple[float, int]:
    """Returns the distance of the nearest body from a position [m], inf if unknown, and its row."""
    return min((inf if isnan(apart_m := dist(places_m[row], here_m)) else apart_m, row) for row in rows)


def _by_frame(frames: CameraFrames) -> dict[tuple[int, int], list[int]]:
    """Returns the row numbers of each frame, frames in order of their first row."""
    found: dict[tuple[int, int], list[int]] = {}
    for row, frame in enumerate(zip(frames.camera.tolist(), frames.capture_ns.tolist(), strict=True)):
        found.setdefault(frame, []).append(row)
    return found


def _places(frames: CameraFrames, poses: Floats) -> Floats:
    """(n, 3) middle of each body's torso, or of all its points if no torso was seen, by the cameras' poses."""
    seen: Bools = np.asarray(np.isfinite(frames.points_m).all(axis=2) & (frames.confidence > 0))
    torso: Bools = np.asarray(seen & _IN_TORSO)
    use: Bools = np.where(torso.any(axis=1, keepdims=True), torso, seen)
    count = use.sum(axis=1, keepdims=True).astype(np.float64)
    total = np.where(use[..., None], frames.points_m, 0.0).sum(axis=1)
    middle = total / np.where(count > 0, count, np.nan)
    T = poses[frames.camera]
    return np.einsum("nij,nj->ni", T[:, :3, :3], middle) + T[:, :3, 3]


#: All names in ``Log.defects``, with the treatment of the defect. <camera> is replaced by a camera's name.
DEFECTS: Mapping[str, str] = {
    "chunks_unreadable": "damaged chunks of an MCAP file; left out",
    "files_damaged": "files of a ROS 2 bag that are damaged; the messages that can be read are used",
    "files_empty": "files of 0 bytes in a folder; left out",
    "files_missing": "files that metadata.yaml names and the folder lacks",
    "files_unreadable": "files of a folder that cannot be read; left out",
    "frames_<camera>": "no defect: rows delivered, one per body and frame",
    "frames_contradicting": "rows of the same camera, body and capture as the one before, with other points; dropped",
    "frames_duplicate": "rows of the same camera, body and capture as the one before; dropped",
    "frames_header_stamp_zero": "rows with a capture time of zero; their arrival is used",
    "frames_out_of_order": "rows captured before an earlier delivered one of the same camera and body; dropped",
    "frames_repeated": "rows with a new capture time and the very points of the row before; dropped, as not measured",
    "frames_stamp_ahead": "frames captured after their arrival by their stamp; arrival less usual delay used",
    "frames_stamp_far": "frames captured too far from their arrival by their stamp; arrival less usual delay used",
    "frames_stamp_set_back": "frames by a clock that was set back or stands still; arrival less usual delay used",
    "frames_trembling": "rows in which no point has moved for long, as of an old image with noise; dropped, as not new",
    "gaps_<camera>": "silences of a camera longer than logs.gap_s",
    "joints_malformed": "joint states with positions that do not go with their names; left out",
    "joints_not_finite": "joint positions that are no number; left out",
    "joints_out_of_order": "joint states not later than the one before; dropped",
    "joints_stamp_wrong": "joint states without a stamp, or with one far from their neighbours'; placed as those are",
    "messages_missing": "messages that metadata.yaml promises and the files do not give",
    "messages_undecodable": "messages that do not follow their type; left out",
    "points_at_origin": "points exactly in the camera itself, as trackers write 'not tracked'; made missing",
    "points_coincident": "points in one place with the other end of their bone; both made missing",
    "points_not_finite": "points with a coordinate that is no number; made missing, with confidence 0",
    "points_too_far": "points further away than a camera can see; made missing",
    "truncated_at_ns": "an instant: the last arrival before the file breaks off; what is whole is used",
    "unindexed": "a ROS 1 bag without a usable index; read by going through it",
}

#: Maximum coordinate measured by a depth camera in a robot's cell [m].
FAR_M = 100.0
#: Maximum motion of all points [m], and minimum time [s], of a repeated old image. In recordings of people who stand,
#: sit and work, by five trackers, the longest such time was 0.17 s.
STILL_M, STILL_S = 2e-3, 0.5
#: Distance below which the two ends of a bone coincide [m].
TOGETHER_M = 1e-3

#: Reason of ``CameraClock`` to reject a stamp -> its name in DEFECTS.
_REPLACED = {"ahead": "frames_stamp_ahead", "far": "frames_stamp_far", "set back": "frames_stamp_set_back"}

_ALWAYS = ("frames_duplicate", "frames_header_stamp_zero", "frames_out_of_order", "points_not_finite")
_CHUNK_NS = 10**9

#: The two ends of the bones that measure the person's model. Hands, hips and legs are not included: trackers without
#: hands place the hand at the wrist.
_PAIRS = (
    ("shoulder_l", "shoulder_r"),
    ("pelvis", "neck"),
    ("neck", "head"),
    *((f"shoulder_{side}", f"elbow_{side}") for side in "lr"),
    *((f"elbow_{side}", f"wrist_{side}") for side in "lr"),
)
_A, _B = (np.array([POINTS.index(pair[end]) for pair in _PAIRS]) for end in (0, 1))


class CleanedSkeleton(NamedTuple):
    """A cleaned row, and the defects found in its points."""

    row: RawSkeleton
    flaws: tuple[tuple[str, int], ...]  #: name in DEFECTS -> number of points


def clean_skeleton(row: RawSkeleton) -> CleanedSkeleton:
    """Marks every point as missing (NaN, confidence 0) that cannot belong to a body.

    If two ends of a bone coincide, both are rejected. A point of confidence 0 is missing by definition and not counted.
    """
    points, told = row.points_m, row.confidence > 0
    largest = np.abs(points).max(axis=1)  # NaN if a coordinate is
    there: Bools = (largest > 0.0) & (largest <= FAR_M)
    kept = np.where(there[:, None], points, np.nan)
    together = _together(kept)
    if len(together):
        there[together], kept[together] = False, np.nan
    confidence = np.where(there, np.fmin(np.fmax(row.confidence, 0.0), 1.0), 0.0)  # 0 also for NaN
    whole = row._replace(points_m=kept, confidence=confidence)
    if not (told > there).any() and not np.isinf(points).any():
        return CleanedSkeleton(whole, ())
    found = {
        "points_not_finite": np.isinf(points).any(axis=1) | (np.isnan(largest) & told),
        "points_at_origin": (largest == 0.0) & told,
        "points_too_far": (largest > FAR_M) & np.isfinite(largest) & told,
        "points_coincident": np.isin(np.arange(len(points)), together) & told,
    }
    return CleanedSkeleton(whole, tuple((name, int(which.sum())) for name, which in found.items() if which.any()))


def _together(points: Floats) -> Ints:
    """Indices of the points (20, 3) that coincide with the other end of one of _PAIRS."""
    apart = points[_A] - points[_B]
    same = np.flatnonzero((apart * apart).sum(axis=1) < TOGETHER_M**2)
    return np.concatenate([_A[same], _B[same]]) if len(same) else same


def _moved(before_m: Floats, now_m: Floats) -> bool:
    """Returns True if any point (20, 3) has moved by more than STILL_M, or without a common point."""
    by_m = np.sqrt(((now_m - before_m) ** 2).sum(axis=1))
    return bool((by_m > STILL_M).any() or not np.isfinite(by_m).any())


class RepeatedSkeleton(NamedTuple):
    """The longest time for which a camera repeated a skeleton, exactly or up to noise."""

    seconds: float
    begin_ns: int  #: its first arrival


def _keep_longest(found: dict[str, RepeatedSkeleton], camera: str, begin_ns: int, arrival_ns: int) -> None:
    lasted_s = (arrival_ns - begin_ns) / 1e9
    if lasted_s > found.get(camera, RepeatedSkeleton(0.0, 0)).seconds:
        found[camera] = RepeatedSkeleton(lasted_s, begin_ns)


class Cleaner:
    """Cleans rows in order of arrival and returns them as tables of at most one second."""

    def __init__(self, cameras: tuple[str, ...], gap_s: float, defects: Counter[str], *, nobody: bool = False) -> None:
        """Starts before the first row.

        Args:
            cameras: Names of the cameras.
            gap_s: A longer time without frames of a camera is a gap [s].
            defects: Receives the counts of defects.
            nobody: True: also return rows needed only for a watched area: frames without a body, and rows without
                points for bodies that are reported but not measured again.
        """
        self._cameras = cameras
        self._nobody = nobody
        self._index = {name: i for i, name in enumerate(cameras)}
        self._gap_ns = round(gap_s * 1e9)
        self._defects = defects
        self._newest: dict[tuple[str, int], int] = {}
        self._last: dict[
            tuple[str, int], tuple[RawSkeleton, int]
        ] = {}  # per body: its last new skeleton, and its arrival
        self._rows: list[tuple[int, int, RawSkeleton]] = []
        self.arrivals: dict[str, tuple[int, int]] = {}  #: camera -> first and last arrival
        self.seen: dict[str, Bools] = {}  #: camera -> (20,) True for points that ever had a position and a confidence
        self.points: Counter[str] = Counter()  #: camera -> number of points with a position and a confidence
        self.rows: Counter[str] = Counter()  #: camera -> number of rows
        self.flaws: Counter[tuple[str, str]] = Counter()  #: (camera, name in DEFECTS) -> number of points or rows
        self.frozen: dict[str, RepeatedSkeleton] = {}  #: camera -> its longest exact repetition
        self.trembling: dict[str, RepeatedSkeleton] = {}  #: camera -> its longest time without a movement
        self._still: dict[tuple[str, int], tuple[Floats, int]] = {}  # per body: its position, and since when
        self.clocks = {name: CameraClock() for name in cameras}
        for name in (*_ALWAYS, *(f"{kind}_{camera}" for kind in ("frames", "gaps") for camera in cameras)):
            defects[name] += 0

    def note_arrival(self, camera: str, arrival_ns: int) -> None:
        """Notes the arrival of a message of a camera, and counts a gap before it."""
        first, last = self.arrivals.get(camera, (arrival_ns, arrival_ns))
        if arrival_ns - last > self._gap_ns:
            self._defects[f"gaps_{camera}"] += 1
        self.arrivals[camera] = (first, arrival_ns)

    def add(self, row: RawSkeleton, arrival_ns: int) -> CameraFrames | None:
        """Adds a row; returns the table completed before it, if any."""
        self.note_arrival(row.camera, arrival_ns)
        if row.body == NOBODY:
            return self._add_nobody(row, arrival_ns) if self._nobody else None
        self._defects["frames_header_stamp_zero"] += row.stamp_zero
        capture_ns = self._captured(row, arrival_ns)
        newest_ns = self._newest.get((row.camera, row.body))
        self.rows[row.camera] += 1
        if newest_ns is not None and capture_ns <= newest_ns:
            if capture_ns < newest_ns:
                self._flaw(row.camera, "frames_out_of_order", 1)
            elif self._agrees(row):
                self._defects["frames_duplicate"] += 1
            else:
                self._flaw(row.camera, "frames_contradicting", 1)
                return self._add_unshown(row, capture_ns, arrival_ns)
            return None
        self._newest[(row.camera, row.body)] = capture_ns
        whole, flaws = clean_skeleton(row)
        for name, count in flaws:
            self._flaw(row.camera, name, count)
        if self._repeats(whole, arrival_ns) or self._trembles(whole, arrival_ns):
            return self._add_unshown(row, capture_ns, arrival_ns)
        known = whole.confidence > 0
        self.seen[row.camera] = self.seen.get(row.camera, False) | known
        self.points[row.camera] += int(known.sum())
        self._defects[f"frames_{row.camera}"] += 1
        return self._deliver(capture_ns, arrival_ns, whole)

    def _add_nobody(self, row: RawSkeleton, arrival_ns: int) -> CameraFrames | None:
        """Adds a frame without a body; without a stamp its capture is the arrival less the camera's usual delay."""
        clock, key = self.clocks[row.camera], (row.camera, NOBODY)
        capture_ns = arrival_ns - clock.usual_ns if row.capture_ns is None else self._captured(row, arrival_ns)
        if capture_ns <= self._newest.get(key, capture_ns - 1):
            return None
        self._newest[key] = capture_ns
        return self._deliver(capture_ns, arrival_ns, row)

    def _add_unshown(self, row: RawSkeleton, capture_ns: int, arrival_ns: int) -> CameraFrames | None:
        """Adds a body that a frame reports without a position."""
        if not self._nobody:
            return None
        points_m, confidence = missing_body()
        return self._deliver(capture_ns, arrival_ns, row._replace(points_m=points_m, confidence=confidence))

    def _deliver(self, capture_ns: int, arrival_ns: int, row: RawSkeleton) -> CameraFrames | None:
        chunk = self.flush() if self._rows and arrival_ns - self._rows[0][1] >= _CHUNK_NS else None
        self._rows.append((capture_ns, arrival_ns, row))
        return chunk

    def _agrees(self, row: RawSkeleton) -> bool:
        """Returns True if a row has the points of the last one of its body."""
        before, _ = self._last[(row.camera, row.body)]
        return np.array_equal(before.points_m, clean_skeleton(row).row.points_m, equal_nan=True)

    def _captured(self, row: RawSkeleton, arrival_ns: int) -> int:
        """Returns the capture time of a row; an estimate from its arrival if the stamp is wrong."""
        if row.capture_ns is None:
            return arrival_ns
        clock = self.clocks[row.camera]
        before = clock.replaced.copy()
        capture_ns = clock.capture_ns(row.capture_ns, arrival_ns)
        for why, count in (clock.replaced - before).items():
            self._flaw(row.camera, _REPLACED[why], count)
        return capture_ns

    def _repeats(self, row: RawSkeleton, arrival_ns: int) -> bool:
        """Returns True if the row repeats the previous skeleton exactly, which no sensor measures twice."""
        key = (row.camera, row.body)
        before = self._last.get(key)
        if (
            before is None
            or not row.confidence.any()
            or not (before[0].points_m == row.points_m).any()  # the usual case, found in a third of the time
            or not np.array_equal(before[0].points_m, row.points_m, equal_nan=True)
            or not np.array_equal(before[0].confidence, row.confidence)
        ):
            self._last[key] = (row, arrival_ns)
            return False
        self._flaw(row.camera, "frames_repeated", 1)
        _keep_longest(self.frozen, row.camera, before[1], arrival_ns)
        return True

    def _trembles(self, row: RawSkeleton, arrival_ns: int) -> bool:
        """Returns True if no point of the body has moved for so long that the image must be an old one."""
        key = (row.camera, row.body)
        before = self._still.get(key)
        if before is None or _moved(before[0], row.points_m):
            self._still[key] = (row.points_m, arrival_ns)
            return False
        if (arrival_ns - before[1]) / 1e9 <= STILL_S:
            return False
        self._flaw(row.camera, "frames_trembling", 1)
        _keep_longest(self.trembling, row.camera, before[1], arrival_ns)
        return True

    def _flaw(self, camera: str, name: str, count: int) -> None:
        self._defects[name] += count
        self.flaws[(camera, name)] += count

    def flush(self) -> CameraFrames | None:
        """Returns the remaining rows; None without any."""
        rows, self._rows = self._rows, []
        if not rows:
            return None
        return CameraFrames(
            capture_ns=np.array([capture_ns for capture_ns, _, _ in rows], dtype=np.int64),
            arrival_ns=np.array([arrival_ns for _, arrival_ns, _ in rows], dtype=np.int64),
            camera=np.array([self._index[row.camera] for _, _, row in rows], dtype=np.int64),
            body=np.array([row.body for _, _, row in rows], dtype=np.int64),
            points_m=np.array([row.points_m for _, _, row in rows], dtype=np.float64),
            confidence=np.array([row.confidence for _, _, row in rows], dtype=np.float64),
            cameras=self._cameras,
        )
