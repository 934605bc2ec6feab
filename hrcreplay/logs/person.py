"""The person of interest among several bodies whose ids change: whoever is where the person last was."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from hrcreplay.records import POINTS, Bools, CameraFrames, Floats, Ints

_TORSO = [POINTS.index(name) for name in ("pelvis", "chest", "neck", "shoulder_l", "shoulder_r", "hip_l", "hip_r")]


@dataclass(frozen=True)
class Sighting:
    """Where and when the person was last seen."""

    position_m: tuple[float, float, float]
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
    places_m = _places(frames, T_world_camera)
    spaces = ["world" if np.isfinite(T).all() else name for name, T in zip(frames.cameras, T_world_camera, strict=True)]
    sightings, bodies = dict(memory.sightings), dict(memory.bodies)
    counts: Counter[str] = Counter()
    keep = np.zeros(len(frames), dtype=np.bool_)
    for rows in _by_frame(frames):
        camera = int(frames.camera[rows[0]])
        space, name = spaces[camera], frames.cameras[camera]
        now_ns = int(frames.arrival_ns[rows[0]])
        eye_m = T_world_camera[camera, :3, 3] if space == "world" else np.zeros(3)
        row = _choose(rows, places_m[rows], sightings.get(space), eye_m, now_ns, jump_m, memory_s)
        counts["person_bodies_dropped"] += len(rows) - (row is not None)
        if row is None:
            counts["person_frames_without"] += 1
            continue
        keep[row] = True
        x, y, z = places_m[row].tolist()
        sightings[space] = Sighting((x, y, z), now_ns)
        body = int(frames.body[row])
        counts["person_id_switches"] += bodies.get(name, body) != body
        bodies[name] = body
    carried = replace(memory, sightings=tuple(sorted(sightings.items())), bodies=tuple(sorted(bodies.items())))
    return carried, frames.rows(keep), +counts


def _choose(
    rows: Ints, places_m: Floats, last: Sighting | None, eye_m: Floats, now_ns: int, jump_m: float, memory_s: float
) -> int | None:
    whole = np.isfinite(places_m).all(axis=1)
    if not whole.any():
        return None
    here_m = np.array(last.position_m) if last else eye_m
    apart_m = np.where(whole, np.linalg.norm(places_m - here_m, axis=1), np.inf)
    nearest = int(np.argmin(apart_m))
    remembered = last is not None and now_ns - last.arrival_ns <= memory_s * 1e9
    return None if remembered and apart_m[nearest] > jump_m else int(rows[nearest])


def _by_frame(frames: CameraFrames) -> list[Ints]:
    """Row numbers of each frame, frames in order of their first row."""
    key = np.stack([frames.camera, frames.capture_ns], axis=1)
    _, first, group = np.unique(key, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    by_group = np.argsort(group.ravel(), kind="stable")
    parts = np.split(by_group, np.cumsum(np.bincount(group.ravel(), minlength=len(first)))[:-1])
    return [parts[i] for i in order] if len(frames) else []


def _places(frames: CameraFrames, T_world_camera: Floats) -> Floats:
    """(n, 3) middle of each body's torso, of all its points where no torso was seen; world where known, else camera."""
    seen: Bools = np.asarray(np.isfinite(frames.points_m).all(axis=2) & (frames.confidence > 0))
    torso: Bools = np.zeros(seen.shape, dtype=np.bool_)
    torso[:, _TORSO] = seen[:, _TORSO]
    use: Bools = torso | (seen & ~torso.any(axis=1, keepdims=True))
    count = use.sum(axis=1, keepdims=True).astype(np.float64)
    total = np.where(use[..., None], frames.points_m, 0.0).sum(axis=1)
    middle = total / np.where(count > 0, count, np.nan)
    T = np.where(np.isfinite(T_world_camera).all(axis=(1, 2), keepdims=True), T_world_camera, np.eye(4))
    T = T[frames.camera]
    return np.einsum("nij,nj->ni", T[:, :3, :3], middle) + T[:, :3, 3]
