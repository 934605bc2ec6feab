"""Calibration of a log's cameras from the skeletons of one person: poses, clock offsets and a common world frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from typing import Any, NamedTuple

import numpy as np

from hrcreplay.calibration.cell import LEVEL_VIEW, Cell, Floor, Residual, find_floor, floor_frame, up_direction
from hrcreplay.calibration.registration import Registration, disagreement, register, transform
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.logs.camera_checks import CameraChecks, agreement_lines, body_line
from hrcreplay.logs.cleaning import PersonMemory, select_person
from hrcreplay.logs.reader import Log
from hrcreplay.records import POINTS, Bools, CameraFrames, Floats, SkeletonTrack
from hrcreplay.settings.sections import Logs

_WINDOW_S = 10.0  # s, length of the windows into which a long log is divided, long enough for clock offsets
_WINDOWS = 60  # number of evenly spaced windows: ten minutes in all, so a log of any length fits in memory
_TOGETHER_S = 0.1  # s, maximum time between two frames that count as simultaneous
_FEW = 30  # with fewer simultaneous frames there is no registration
_TILTED_RAD = np.radians(4.0)  # a larger uncertainty of the upward direction gives a remark
#: Maximum median distance between two cameras after registration. Real sensors of one movement differ by 17 to 50 mm;
#: recordings of different movements, fitted by a rigid transform and an offset, by 38 to 450 mm.
_APART_M, _DOUBTFUL_M = 0.15, 0.06


class Survey(NamedTuple):
    """A calibration, the person's position in its world, and the agreement of the cameras."""

    cell: Cell
    lines: tuple[str, ...]  #: main figures, and for --base the person's position and the directions of the axes


class Pair(NamedTuple):
    """Two cameras, by index."""

    a: int
    b: int


def calibrate(log: Log, *given: Any, **options: Any) -> Cell:
    """Returns the cell that ``survey`` finds; same arguments and errors."""
    return survey(log, *given, **options).cell


def survey(
    log: Log,
    reference: str | None = None,
    up: Sequence[float] | None = None,
    height_m: float | None = None,
    *,
    jump_m: float = Logs().person_jump_m,
    memory_s: float = Logs().person_memory_s,
    search_s: float = 2.0,
) -> Survey:
    """Estimates the poses of a log's cameras and the offsets of their clocks.

    The world's origin is the floor under the reference camera, z is up and x the camera's viewing direction along the
    floor. Each camera is linked to the reference through the pairs with the most simultaneous frames.

    Args:
        log: A log whose cameras saw one person.
        reference: Camera that defines the world; None for the first.
        up: (3,) up in the reference camera's frame; None to find it from the person.
        height_m: Reference camera's origin above the floor [m]; None to find it from the feet.
        jump_m: A body further than this from the person's last position is another person [m].
        memory_s: After this time without the person, the nearest body becomes the person [s].
        search_s: Clock offsets are searched within plus and minus this, extended by the difference of the two cameras'
            delays from stamp to arrival [s].

    Returns:
        Poses of all cameras, clock offsets, and residuals of every pair that saw the person together.

    Raises:
        SettingsError: The camera is unknown, ``up`` is not a direction, or ``height_m`` is not a height.
        LogError: The cameras did not see one person together, what they saw is not a person, or the floor and the
            upward direction cannot be determined.
    """
    cameras = log.header.cameras
    root = _root(cameras, reference, log)
    direction = _direction(up)
    if height_m is not None and not 0.0 <= height_m < np.inf:
        raise SettingsError(f"height: found {height_m:g}; would be right: metres above the floor, 0 or more")
    tracks = collect_tracks(log, jump_m, memory_s)
    ties = _tree(tracks, root)
    found = {root: Registration(np.eye(4), 0.0)}
    for pair in ties:
        found[pair.b] = _tie(tracks, pair, found[pair.a], search_s, log)
    lost = [name for i, name in enumerate(cameras) if i not in found]
    if lost:
        raise LogError(
            f"{log.header.path}: camera {lost[0]} hardly saw the person together with another one; "
            f"would be right: {_FEW} frames of both within {_TOGETHER_S:g} s"
        )
    floor = _floor(tracks, found, root, direction, height_m, log)
    T_world_root = floor_frame(floor)
    poses = {name: T_world_root @ found[i].T_a_b for i, name in enumerate(cameras)}
    residuals = _residuals(cameras, tracks, found)
    cell = Cell(
        T_world_camera=poses,
        clock_offset_s={name: found[i].offset_s for i, name in enumerate(cameras)},
        residuals=residuals,
    )
    checks = _checks(cell, tracks)
    bodies, agreements = checks.figures()
    notes = (*_notes(floor, cameras[root]), *checks.remarks(), *_doubts(residuals))
    lines = (*person_positions(cell, tracks, cameras[root]), *map(body_line, bodies), *agreement_lines(agreements))
    return Survey(replace(cell, notes=notes), lines)


def _checks(cell: Cell, tracks: list[SkeletonTrack]) -> CameraChecks:
    """Checks the tracks in the calibrated world on one clock, as ``info`` and a run do."""
    checks = CameraChecks(tuple(cell.T_world_camera))
    there = [
        replace(track, t_ns=track.t_ns - round(1e9 * offset_s), points_m=transform(T, track.points_m))
        for track, T, offset_s in zip(tracks, cell.T_world_camera.values(), cell.clock_offset_s.values(), strict=True)
    ]
    camera = np.repeat(np.arange(len(tracks)), [len(track) for track in tracks])
    checks.add(camera, SkeletonTrack.join(there))
    return checks


def person_positions(cell: Cell, tracks: list[SkeletonTrack], root: str) -> tuple[str, ...]:
    """Describes the person's position and the axes of the cell's world, for placing a robot's base."""
    looks_along = abs(cell.T_world_camera[root][2, 2]) <= LEVEL_VIEW
    x = f"x points where {root} looks, along the floor" if looks_along else f"x points along {root}'s own x"
    there = [transform(T, track.points_m) for T, track in zip(cell.T_world_camera.values(), tracks, strict=True)]
    pelvis = np.concatenate([points[:, POINTS.index("pelvis")] for points in there])
    head = np.concatenate([points[:, POINTS.index("head"), 2] for points in there])
    pelvis, head = pelvis[np.isfinite(pelvis).all(axis=1)], head[np.isfinite(head)]
    lines = [f"world: origin on the floor under {root}, z up, {x}, y to the left of x"]
    if len(pelvis):
        middle, (low, high) = np.median(pelvis, axis=0), np.percentile(pelvis, [5, 95], axis=0)
        tall = f", head {np.percentile(head, 90):.2f} m above the floor" if len(head) else ""
        lines.append(
            f"the person stood at x = {middle[0]:.2f}, y = {middle[1]:.2f} m (median; nine tenths within "
            f"x {low[0]:.2f} to {high[0]:.2f}, y {low[1]:.2f} to {high[1]:.2f}){tall}; --base is in this world"
        )
    for name, T in cell.T_world_camera.items():
        at = f"at x = {T[0, 3]:.2f}, y = {T[1, 3]:.2f}, z = {T[2, 3]:.2f} m"
        lines.append(f"{name}: {at}, clock {1e3 * cell.clock_offset_s[name]:+.1f} ms")
    return tuple(lines)


def collect_tracks(log: Log, jump_m: float, memory_s: float) -> list[SkeletonTrack]:
    """Collects the track of the person in each camera's frame; for a long log, in evenly spaced windows."""
    cameras = log.header.cameras
    alone = np.full((len(cameras), 4, 4), np.nan)  # poses are unknown: follow the person in each camera's frame
    memory = PersonMemory()
    kept: list[CameraFrames] = []
    for frames in log.frames():
        memory, which, _ = select_person(frames, memory, alone, jump_m, memory_s)
        mine = frames.rows(which)
        within = in_window(mine, log.header.start_ns, log.header.end_ns)
        if len(rows := mine.rows(within)):
            kept.append(rows)
    log.check()
    if not kept:
        raise LogError(f"{log.header.path}: no skeleton; would be right: a log with a person in it")
    table = CameraFrames.join(kept)
    return [track_of(table, i) for i in range(len(cameras))]


def in_window(frames: CameraFrames, start_ns: int, end_ns: int) -> Bools:
    """(n,) True for rows that arrived in one of the windows; all rows for a short log."""
    window_ns = round(_WINDOW_S * 1e9)
    every_ns = max(window_ns, (end_ns - start_ns) // _WINDOWS)
    return np.asarray((frames.arrival_ns - start_ns) % every_ns < window_ns)


def track_of(table: CameraFrames, camera: int) -> SkeletonTrack:
    """Returns the frames of one camera, in its own frame, in order of capture; all bodies count as one person."""
    mine = table.rows(table.camera == camera)
    _, first = np.unique(mine.capture_ns, return_index=True)  # in order of capture, without duplicate frames
    mine = mine.rows(first.astype(np.int64))
    delay_s = float(np.median(mine.arrival_ns - mine.capture_ns)) / 1e9 if len(mine) else 0.0
    return SkeletonTrack(mine.capture_ns, mine.points_m, mine.confidence, delay_s)


def _root(cameras: tuple[str, ...], reference: str | None, log: Log) -> int:
    if not cameras:
        raise LogError(f"{log.header.path}: no camera; would be right: a log with skeletons")
    if reference is None:
        return 0
    if reference not in cameras:
        raise SettingsError(f"reference camera: found {reference!r}; would be right: {', '.join(cameras)}")
    return cameras.index(reference)


def _direction(up: Sequence[float] | None) -> Floats | None:
    if up is None:
        return None
    vector = np.array(up, dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all() or not vector.any():
        raise SettingsError(f"up: found {list(up)!r}; would be right: x, y, z of a direction, e.g. 0, -1, 0")
    return np.asarray(vector / np.linalg.norm(vector))


def _together(a: SkeletonTrack, b: SkeletonTrack) -> int:
    """Returns the frames of a with a simultaneous frame of b."""
    if not len(a) or not len(b):
        return 0
    after = np.searchsorted(b.t_ns, a.t_ns).clip(1, max(1, len(b) - 1))
    before = after - 1
    nearest = np.minimum(abs(b.t_ns[before] - a.t_ns), abs(b.t_ns[np.minimum(after, len(b) - 1)] - a.t_ns))
    return int((nearest <= _TOGETHER_S * 1e9).sum())


def _tree(tracks: list[SkeletonTrack], root: int) -> list[Pair]:
    """Selects pairs that link every camera to the root, those with the most simultaneous frames first (Prim)."""
    tied: list[int] = [root]
    ties: list[Pair] = []
    while True:
        open_pairs = [Pair(a, b) for a in tied for b in range(len(tracks)) if b not in tied]
        best = max(open_pairs, key=lambda pair: _together(tracks[pair.a], tracks[pair.b]), default=None)
        if best is None or _together(tracks[best.a], tracks[best.b]) < _FEW:
            return ties
        ties.append(best)
        tied.append(best.b)


def _tie(tracks: list[SkeletonTrack], pair: Pair, known: Registration, search_s: float, log: Log) -> Registration:
    """Computes the pose of camera b relative to the root through camera a."""
    a, b = (tracks[i] for i in pair)
    search_s += round(abs(b.delay_s - a.delay_s), 1)
    names = " and ".join(log.header.cameras[i] for i in pair)
    found = register(a, b, search_s=search_s)
    rest = disagreement(a, b, found) if found is not None else None
    if found is None or rest is None:
        raise LogError(f"{log.header.path}: cameras {names} share too few points; would be right: 4 in each frame")
    width_s = float(np.median(np.diff(a.t_ns))) / 1e9  # the refinement may change the offset by this much
    if rest.median_m > _APART_M or abs(found.offset_s) > search_s + width_s:
        raise LogError(
            f"{log.header.path}: cameras {names} do not fit each other: {rest.median_m * 1e3:.0f} mm apart (median) at "
            f"a clock offset of {found.offset_s:+.2f} s; would be right: recordings of one person at one time, below "
            f"{_APART_M * 1e3:.0f} mm and within {search_s:g} s"
        )
    return Registration(known.T_a_b @ found.T_a_b, known.offset_s + found.offset_s)


def _notes(floor: Floor, camera: str) -> tuple[str, ...]:
    if floor.tilt_std_rad < _TILTED_RAD:
        return ()
    degrees = np.degrees(floor.tilt_std_rad)
    doubt = f"up is known to about {degrees:.0f} degrees only, as nobody walked or stood straight"
    return (f"{doubt}; give up in the frame of {camera} where it is known (--up)",)


def _doubts(residuals: tuple[Residual, ...]) -> Iterator[str]:
    for rest in residuals:
        if rest.median_m > _DOUBTFUL_M:
            yield (
                f"{rest.a} and {rest.b} stay {1e3 * rest.median_m:.0f} mm apart (median), where one movement leaves "
                "20 to 50 mm: did they see one person at one time?"
            )


def _residuals(
    cameras: tuple[str, ...], tracks: list[SkeletonTrack], found: dict[int, Registration]
) -> tuple[Residual, ...]:
    rests = []
    for a in range(len(cameras)):
        for b in range(a + 1, len(cameras)):
            if not len(tracks[a]) or len(tracks[b]) < 2:
                continue
            T_a_b = np.linalg.inv(found[a].T_a_b) @ found[b].T_a_b
            rest = disagreement(tracks[a], tracks[b], Registration(T_a_b, found[b].offset_s - found[a].offset_s))
            if rest is not None:
                rests.append(Residual(a=cameras[a], b=cameras[b], **asdict(rest)))
    return tuple(rests)


def _floor(
    tracks: list[SkeletonTrack],
    found: dict[int, Registration],
    root: int,
    up: Floats | None,
    height_m: float | None,
    log: Log,
) -> Floor:
    """Finds the floor in the root's frame, from the root's own frames or else from the next camera in order."""
    order = [root, *(i for i in found if i != root)]
    for i in order:
        T = found[i].T_a_b
        track = SkeletonTrack(tracks[i].t_ns, transform(T, tracks[i].points_m), tracks[i].confidence)
        floor = find_floor(track, up)
        if floor is not None and np.isfinite([*floor.up, floor.height_m]).all():
            return floor if height_m is None else replace(floor, height_m=height_m)
        if height_m is not None:
            guess = (up, 0.0) if up is not None else up_direction(track)
            if guess is not None:
                return Floor(guess[0], height_m, guess[1])
    raise LogError(
        f"{log.header.path}: no feet or no trunk seen for long enough to find the floor; "
        "give the reference camera's height above it (--height) and up in its frame (--up)"
    )
