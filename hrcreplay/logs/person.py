"""The person of interest among several bodies whose ids change: whoever is where the person last was."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from math import dist, inf, isfinite, isnan

import numpy as np

from hrcreplay.records import POINTS, Bools, CameraFrames, Floats

_TORSO = ("pelvis", "chest", "neck", "shoulder_l", "shoulder_r", "hip_l", "hip_r")
_IN_TORSO = np.isin(POINTS, _TORSO)

Place = tuple[float, float, float]


@dataclass(frozen=True)
class Sighting:
    """Where and when the person was last seen."""

    position_m: Place
    arrival_ns: int


@dataclass(frozen=True)
class PersonMemory:
    """What is carried from one table of frames to the next.

    Cameras with known poses share the space "world"; every other camera is a space of its own.
    """

    sightings: tuple[tuple[str, Sighting], ...] = ()  #: space -> last sighting
    bodies: tuple[tuple[str, int], ...] = ()  #: camera -> body id of the person


def pick(
    frames: CameraFrames,
    memory: PersonMemory,
    T_world_camera: Floats,
    jump_m: float,
    memory_s: float,
) -> tuple[PersonMemory, CameraFrames, Counter[str]]:
    """Keeps the one body of each frame that continues the person in space.

    A body further than ``jump_m`` from where the person was last seen is somebody else. After ``memory_s`` without
    the person, the body nearest to that place becomes the person; the first person is the body nearest to its camera.

    Args:
        frames: All bodies, in order of arrival. The bodies of one frame (camera and capture time) stand in one
            table; between frames, tables may be cut anywhere.
        memory: From the table before; ``PersonMemory()`` at the start.
        T_world_camera: (c, 4, 4), NaN for a camera whose pose is not known.
        jump_m: [m].
        memory_s: [s].

    Returns:
        The new memory, the frames with at most one body each, and counts: ``person_bodies_dropped``,
        ``person_id_switches`` and ``person_frames_without`` (frames in which nobody was near enough).
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
        if not found:
            counts["person_frames_without"] += 1
            continue
        keep[row] = True
        x, y, z = places_m[row]
        sightings[space] = Sighting((x, y, z), now_ns)
        body = int(frames.body[row])
        counts["person_id_switches"] += bodies.get(name, body) != body
        bodies[name] = body
    carried = PersonMemory(tuple(sorted(sightings.items())), tuple(sorted(bodies.items())))
    return carried, frames.rows(keep), +counts


def _nearest(rows: list[int], places_m: list[Place], here_m: Place) -> tuple[float, int]:
    """How far the nearest body is from a place [m], inf where none's is known, and its row."""
    return min((inf if isnan(apart_m := dist(places_m[row], here_m)) else apart_m, row) for row in rows)


def _by_frame(frames: CameraFrames) -> dict[tuple[int, int], list[int]]:
    """Row numbers of each frame, frames in order of their first row."""
    found: dict[tuple[int, int], list[int]] = {}
    for row, frame in enumerate(zip(frames.camera.tolist(), frames.capture_ns.tolist(), strict=True)):
        found.setdefault(frame, []).append(row)
    return found


def _places(frames: CameraFrames, poses: Floats) -> Floats:
    """(n, 3) middle of each body's torso, of all its points where no torso was seen, by the cameras' poses."""
    seen: Bools = np.asarray(np.isfinite(frames.points_m).all(axis=2) & (frames.confidence > 0))
    torso: Bools = np.asarray(seen & _IN_TORSO)
    use: Bools = np.where(torso.any(axis=1, keepdims=True), torso, seen)
    count = use.sum(axis=1, keepdims=True).astype(np.float64)
    total = np.where(use[..., None], frames.points_m, 0.0).sum(axis=1)
    middle = total / np.where(count > 0, count, np.nan)
    T = poses[frames.camera]
    return np.einsum("nij,nj->ni", T[:, :3, :3], middle) + T[:, :3, 3]
