"""Reads the people in a recording: from its ground truth, else by stage 1, its smoother and what cameras show."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hrcreplay.errors import LogError
from hrcreplay.evaluation.recorded_person import (
    CAMERAS,
    GAP_S,
    HOLD_S,
    SMOOTHED,
    TRUTH,
    BodyTrack,
    CameraPoints,
    ModelPoints,
    RecordedPeople,
    RecordedPerson,
    SmoothedPeople,
    at_instants,
    from_states,
    with_middle_neck,
)
from hrcreplay.human.fusion import fuse, inverse_kinematics
from hrcreplay.human.model import skeleton
from hrcreplay.logs.reader import Log
from hrcreplay.pipeline.fusion_stage import FusionStage, as_frames
from hrcreplay.pipeline.people_smoother import PeopleSmoother
from hrcreplay.pipeline.person_fuser import PersonFuser
from hrcreplay.pipeline.seen_bodies import Bodies, SeenBodies
from hrcreplay.pipeline.stages import batches
from hrcreplay.records import LENGTHS, POINTS, Bools, CameraFrames, Floats, HumanStates, Ints, Measurements
from hrcreplay.store.stored_array import Rows, StoredArray

#: Points outside the model -> the point to which they are attached and the maximum length of that bone [m].
_HANGING = {
    "hand": ("wrist", 0.30),
    "hip": ("pelvis", 0.30),
    "knee": ("hip", 0.65),
    "ankle": ("knee", 0.65),
    "foot": ("ankle", 0.40),
}
#: Points of the model from the root on, the start of their bone, and its length as a multiple of one of LENGTHS.
_BONES: tuple[tuple[str, str, str, float], ...] = (
    ("shoulder_r", "shoulder_l", "pi_half_shoulder", 2.0),
    ("shoulder_l", "shoulder_r", "pi_half_shoulder", 2.0),
    ("pelvis", "neck", "pi_torso", 1.0),
    ("head", "neck", "pi_head", 1.0),
    *((f"elbow_{side}", f"shoulder_{side}", f"pi_upper_arm_{side}", 1.0) for side in "rl"),
    *((f"wrist_{side}", f"elbow_{side}", f"pi_forearm_{side}", 1.0) for side in "rl"),
)
#: Maximum difference between a bone and the person's bone length; people differ from the model [m].
_BONE_M = 0.08
#: Number of ticks fused, or of frames selected, per batch.
_BATCH = 15_000


@dataclass(frozen=True)
class Recording:
    """A log in the form that an audit needs."""

    states: HumanStates  #: the fused person at every tick, from the frames that had arrived
    t_ns: Ints  #: (m,) instants of the recorded points, increasing
    points_m: Floats  #: (m, 20, 3) POINTS, world [m]; NaN if not recorded or rejected
    joints_t_ns: Ints  #: (k,) instants of the recorded joints, increasing
    joints: Floats  #: (k, 13) JOINTS [m, m, rad..., m]
    source: str  #: TRUTH, CAMERAS or SMOOTHED
    counts: dict[str, int]


def read_people(
    log: Log,
    ticks_ns: Ints,
    fusion_stage: FusionStage,
    smoothed_people: Callable[[], SmoothedPeople],
    bodies: SeenBodies | None = None,
    folder: Path | None = None,
) -> RecordedPeople:
    """Reads all people in a log within a span.

    Args:
        log: Log to read.
        ticks_ns: (n,) ticks of the span, increasing [ns].
        fusion_stage: Cameras, and settings of stage 1.
        smoothed_people: Returns the smoothed people at these ticks; called for people without ground truth.
        bodies: The bodies that stage 1 saw in the span, which are taken and closed; None: it is run again for them.
        folder: Folder for files of the people's points, as long as they are needed; None: they stay in memory.
    """
    bodies = _see_bodies(log, ticks_ns, fusion_stage, folder) if bodies is None else bodies
    seen, beside = bodies.take()
    others = None if beside is None else beside.rows(slice(None))
    truth = _truth(log, ticks_ns, folder)
    of_truth = 1 if truth is None or seen is None else _nearest_to(truth, seen)
    people = []
    if truth is not None:
        people.append(RecordedPerson(of_truth, TRUTH, truth.t_ns, truth.points_m, (truth,)))
    rest = [number for number in _numbers(seen) if truth is None or number != of_truth]
    best = smoothed_people() if rest else None
    for number in rest:
        own = best.of_person(number) if best is not None else None
        mine = seen
        if seen is not None and not (seen.about.body == number).all():
            mine = seen.some(np.flatnonzero(seen.about.body == number))
        if own is not None and mine is not None and number > 1:  # bodies that were not yet a person
            known = np.isfinite(own.p[:][:, 0])
            since_ns = int(own.t_ns[known][0]) if known.any() else 2**62
            early = mine.about.capture_ns < since_ns
            before = mine.rows(np.flatnonzero(early))
            others = CameraFrames.join([*([] if others is None else [others]), before])
            mine = mine.some(np.flatnonzero(~early))
            if not known.any():
                continue
        if own is not None:
            people.append(_recorded_person(number, mine, own, fusion_stage, folder))
    if truth is not None:
        chosen = []
        if seen is not None:
            chosen = [_renamed(seen.rows(np.flatnonzero(seen.about.body == of_truth)), _CHOSEN)]
        tracks = _people_off(truth, [*chosen, *([] if others is None else [others])], fusion_stage)
    else:
        tracks = tuple(_tracks_of(others, fusion_stage)) if others is not None else ()
    bodies.close()
    return RecordedPeople(tuple(sorted(people, key=lambda one: one.number)), tracks)


def _see_bodies(log: Log, ticks_ns: Ints, fusion_stage: FusionStage, folder: Path | None) -> SeenBodies:
    """Runs stage 1 for the bodies in a span."""
    fuser, bodies = PersonFuser(replace(fusion_stage, watched=None), log.header.cameras), SeenBodies(folder)
    for ticks, due in batches(log.frames(int(ticks_ns[0]), int(ticks_ns[-1]) + 1), ticks_ns, _BATCH):
        if due is not None or fusion_stage.people != "nearest":
            bodies.add(fuser.update(ticks, due)[1])
    return bodies


def _renamed(bodies: CameraFrames, body: int) -> CameraFrames:
    return replace(bodies, body=np.full(len(bodies), body))


def _numbers(seen: Bodies | None) -> list[int]:
    return sorted({1, *seen.about.body.tolist()}) if seen is not None else [1]


def _nearest_to(truth: BodyTrack, seen: Bodies) -> int:
    """Number of the person whom the ground truth shows: the nearest to it in the median."""
    apart_m = np.empty(len(seen))
    for first in range(0, len(seen), _BATCH):
        rows = slice(first, first + _BATCH)
        there = at_instants(truth.t_ns, truth.points_m, seen.about.capture_ns[rows], GAP_S)
        off = np.linalg.norm(seen.points_m[rows] - there, axis=2)
        known = np.isfinite(off)
        mean = np.where(known, off, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
        apart_m[rows] = np.where(known.any(axis=1), mean, np.nan)
    found = {
        number: float(np.median(apart_m[mine]))
        for number in _numbers(seen)
        if (mine := (seen.about.body == number) & np.isfinite(apart_m)).any()
    }
    return min(found, key=lambda number: (found[number], number), default=1)


def _recorded_person(
    number: int, seen: Bodies | None, best: SmoothedPeople, fusion_stage: FusionStage, folder: Path | None
) -> RecordedPerson:
    """A person without ground truth: the smoothed states and the believed points of each camera."""
    smoothed = from_states(best, fusion_stage.filter.memory_s)
    if seen is None or not len(seen):
        return RecordedPerson(number, SMOOTHED, smoothed.t_ns, smoothed.points_m, (smoothed,))
    order = np.argsort(seen.about.capture_ns, kind="stable")
    batches_of = (order[first : first + _BATCH] for first in range(0, len(order), _BATCH))
    points_m = gather((_select_accepted(seen.rows(rows), best, fusion_stage)[0] for rows in batches_of), folder)
    parts = (points_m[first : first + _BATCH] for first in range(0, len(order), _BATCH))
    shown: Bools = np.concatenate([np.isfinite(part).any(axis=(1, 2)) for part in parts])
    if not shown.any():
        every = ModelPoints(best.p, best.lengths_m, np.ones(len(best), dtype=np.bool_))
        return RecordedPerson(number, SMOOTHED, smoothed.t_ns, every, (smoothed,))
    t_ns, camera = seen.about.capture_ns[order], seen.about.camera[order]
    cameras = [
        BodyTrack(name, t_ns[mine], CameraPoints(points_m, mine), HOLD_S)
        for c, name in enumerate(seen.about.cameras)
        for mine in [np.flatnonzero(camera == c)]
        if shown[mine].any()
    ]
    return RecordedPerson(number, CAMERAS, t_ns, points_m, (smoothed, *cameras))


def gather(parts: Iterable[Floats], folder: Path | None) -> Rows:
    """The rows of all parts, of which there is one or more, in a file in the folder or, without one, in memory."""
    if folder is None:
        return np.concatenate(list(parts))
    found: StoredArray | None = None
    for part in parts:
        found = StoredArray(folder, part.shape[1:]) if found is None else found
        found.append(part)
    assert found is not None  # noqa: S101 - for the type checker
    return found


def _truth(log: Log, ticks_ns: Ints, folder: Path | None = None) -> BodyTrack | None:
    """Reads the ground truth within a span; None if the log has none there."""
    if not log.header.has_truth:
        return None
    t_ns = [np.zeros(0, np.int64)]

    def parts() -> Iterator[Floats]:
        yield np.empty((0, len(POINTS), 3))
        for part in log.truth():
            here = (part.t_ns >= ticks_ns[0]) & (part.t_ns <= ticks_ns[-1])
            t_ns.append(part.t_ns[here])
            yield part.points_m[here]

    points_m = gather(parts(), folder)
    return BodyTrack(TRUTH, np.concatenate(t_ns), points_m) if points_m.shape[0] else None


def _track(source: str, t_ns: Ints, points_m: Floats) -> BodyTrack:
    """Makes a camera's track, in order of capture; the neck is the middle of the shoulders, if they are known."""
    order = np.argsort(t_ns, kind="stable")
    return BodyTrack(source, t_ns[order], with_middle_neck(points_m[order]), HOLD_S)


def _tracks_of(bodies: CameraFrames, fusion_stage: FusionStage) -> Iterator[BodyTrack]:
    """Makes a track for each camera and body id, with the points of sufficient confidence."""
    trusted = (bodies.confidence > 0.0) & (bodies.confidence >= fusion_stage.filter.confidence_min)
    points_m = np.where(trusted[..., None], bodies.points_m, np.nan)
    shown = np.isfinite(points_m).any(axis=(1, 2))
    keys = sorted(set(zip(bodies.camera[shown].tolist(), bodies.body[shown].tolist(), strict=True)))
    for camera, body in keys:
        mine = shown & (bodies.camera == camera) & (bodies.body == body)
        yield _track(f"{bodies.cameras[camera]}, body {body}", bodies.capture_ns[mine], points_m[mine])


def _people_off(truth: BodyTrack, tables: Sequence[CameraFrames], fusion_stage: FusionStage) -> tuple[BodyTrack, ...]:
    """Makes the tracks of all bodies away from the ground truth, selected as its person or not."""
    if not tables:
        return ()
    bodies = CameraFrames.join(tables)
    there = at_instants(truth.t_ns, truth.points_m, bodies.capture_ns, GAP_S)
    shown = np.isfinite(bodies.points_m).all(axis=2) & (bodies.confidence > 0.0) & np.isfinite(there).all(axis=2)
    apart = np.where(shown, np.linalg.norm(bodies.points_m - there, axis=2), 0.0).sum(axis=1)
    apart_m = apart / np.maximum(shown.sum(axis=1), 1)
    known = shown.any(axis=1)
    off = np.where(known, apart_m > fusion_stage.person_jump_m, bodies.body != _CHOSEN)
    return tuple(_tracks_of(bodies.rows(np.asarray(off)), fusion_stage))


#: Body id of the person in each frame, independent of the tracker's ids.
_CHOSEN = -1


def read_recording(log: Log, ticks_ns: Ints, fusion_stage: FusionStage, progress: Callable[[int], None]) -> Recording:
    """Reads the recording of the nearest person alone; see ``read_recordings``.

    Args:
        log: Log to read.
        ticks_ns: (n,) ticks of the span, increasing [ns].
        fusion_stage: Cameras and settings of stage 1.
        progress: Called with the number of ticks done since the last call.

    Raises:
        LogError: No camera saw a person.
    """
    return read_recordings(log, ticks_ns, replace(fusion_stage, people="nearest"), progress)[1]


def read_recordings(
    log: Log, ticks_ns: Ints, fusion_stage: FusionStage, progress: Callable[[int], None]
) -> dict[int, Recording]:
    """Reads the recording of each person within the span of ``ticks_ns``.

    The recorded future is the ground truth if the log has it for this person, else the points of the cameras at their
    capture times, else the smoothed person. A camera point must have sufficient confidence (confidence 0: not seen). It
    must also be within the filter's outlier distance of the smoothed person, which includes later frames, or at the end
    of a bone of the person's length: the points of a person who squats or bends sideways leave the model but keep their
    bone lengths, and a marker that jumps away does not. Recorded joints are those of the truth, else of the smoothed
    person. Of people without truth in a log that has it for another, the fused person takes the place of the smoothed.

    Args:
        log: Log to read.
        ticks_ns: (n,) ticks of the span, increasing [ns].
        fusion_stage: Cameras and settings of stage 1.
        progress: Called with the number of ticks done since the last call.

    Returns:
        Number of the person -> recording, in the order of the numbers.

    Raises:
        LogError: No camera saw a person.
    """
    counts: Counter[str] = Counter()
    stretches = fuse_stretches(log, ticks_ns, fusion_stage, counts, progress)
    truth, smoother, seen, passed, best = _truth(log, ticks_ns), PeopleSmoother(fusion_stage.filter), [], [], []
    for measured, states, trace in stretches:
        seen.append(measured)
        passed.append(states)
        if truth is None:
            best += smoother.add(states, trace)
    fused, measurements = HumanStates.join(passed), Measurements.join(seen)
    best += smoother.finish() if truth is None else []
    smoothed = SmoothedPeople.of(fused if truth is not None else HumanStates.join(best))
    of_truth = 0 if truth is None else _nearest_to(truth, Bodies.of(as_frames(measurements)))
    known = np.isfinite(fused.p[:, 0])
    found = {}
    for number in sorted(set(fused.numbers[known].tolist())) or [1]:
        states, own = fused.of_person(number), smoothed.of_person(number)
        if truth is not None and number == of_truth:
            joints, _ = inverse_kinematics.inverse(truth.points_m[:])
            whole = _plain(log, counts)
            found[number] = Recording(states, truth.t_ns, truth.points_m[:], truth.t_ns, joints, TRUTH, whole)
            continue
        mine = measurements.rows(measurements.numbers == number)
        points, rejected = _select_accepted(mine, own, fusion_stage)
        source, t_ns, points_m = _recorded_points(mine, points, own)
        whole = _plain(log, counts + rejected)
        found[number] = Recording(states, t_ns, points_m, own.t_ns, own.p[:], source, whole)
    return found


def _smoothed_points(best: SmoothedPeople) -> Floats:
    """(n, 20, 3) points of the smoothed person at every tick [m]."""
    return skeleton(best.p[:], best.lengths_m[:])


def _recorded_points(seen: Measurements, points: Floats, best: SmoothedPeople) -> tuple[str, Ints, Floats]:
    """Returns source, instants and points of the person: accepted camera points, else the smoothed person."""
    if not np.isfinite(points).any():
        return SMOOTHED, best.t_ns, _smoothed_points(best)
    order = np.argsort(seen.capture_ns, kind="stable")
    return CAMERAS, seen.capture_ns[order], points[order]


#: Measurements, fused states and trace.
Stretch = tuple[Measurements, HumanStates, fuse.Trace]


def fuse_stretches(
    log: Log, ticks_ns: Ints, fusion_stage: FusionStage, counts: Counter[str], progress: Callable[[int], None]
) -> Iterator[Stretch]:
    """Runs stage 1, traced, from the first stretch on in which a camera saw a person.

    Args:
        log: Log to read.
        ticks_ns: (n,) ticks, increasing [ns].
        fusion_stage: Cameras and settings of stage 1.
        counts: Receives the counts of events.
        progress: Called with the number of ticks done since the last call.

    Raises:
        LogError: No camera saw a person.
    """
    fusion_stage = replace(fusion_stage, watched=None)
    fuser, ever = PersonFuser(fusion_stage, log.header.cameras, traced=True), False
    for ticks, due in batches(log.frames(int(ticks_ns[0]), int(ticks_ns[-1]) + 1), ticks_ns, _BATCH):
        progress(len(ticks))
        ever = ever or due is not None
        if ever:
            fused, seen = fuser.update(ticks, due)
            counts.update(seen.counts)
            counts.update(fused.counts)
            yield seen.measured, fused.states, fused.trace
    log.check()
    if not ever:
        raise LogError(f"{log.header.path}: no camera saw anybody; an audit needs a person")


def _select_accepted(
    seen: Measurements | CameraFrames, best: SmoothedPeople, fusion_stage: FusionStage
) -> tuple[Floats, Counter[str]]:
    """Returns the accepted measured points (m, 20, 3), and the number of other points per camera and reason.

    A missing point or one with confidence 0 counts as not seen. A point counts as doubted if its confidence is too low,
    if it is attached to such a point, or if it was seen before the person was known. A point with sufficient confidence
    that fails a gate counts as jumping: it is rejected together with the points attached to it.
    """
    tick = np.clip(np.searchsorted(best.t_ns, seen.capture_ns), 0, len(best) - 1)
    lengths_m = best.lengths_m[tick]
    expected = skeleton(best.p[tick], lengths_m)
    measured: Bools = np.asarray(np.isfinite(seen.points_m).all(axis=2)) & (seen.confidence > 0.0)
    trusted = measured & (seen.confidence >= fusion_stage.filter.confidence_min)
    good, jumped = trusted.copy(), np.zeros_like(trusted)
    points = seen.points_m.copy()
    neck, right, left = (POINTS.index(name) for name in ("neck", "shoulder_r", "shoulder_l"))
    points[:, neck] = 0.5 * (points[:, left] + points[:, right])  # the neck of the model: the middle of the shoulders
    good[:, neck] = trusted[:, left] & trusted[:, right]
    off = np.linalg.norm(points - expected, axis=2)
    for name, start, length, part in _BONES:
        k, j = POINTS.index(name), POINTS.index(start)
        own = part * lengths_m[:, LENGTHS.index(length)]
        fits = np.abs(np.linalg.norm(points[:, k] - points[:, j], axis=1) - own) <= _BONE_M
        good[:, k] &= (off[:, k] <= fusion_stage.filter.outlier_m) | (fits & good[:, j])
        jumped[:, k] = trusted[:, k] & ~good[:, k] & np.isfinite(off[:, k])
    for name, (parent, longest_m) in _HANGING.items():
        for side in "lr":
            k = POINTS.index(f"{name}_{side}")
            j = POINTS.index(parent if parent in POINTS else f"{parent}_{side}")
            fits = np.linalg.norm(seen.points_m[:, k] - seen.points_m[:, j], axis=1) <= longest_m
            jumped[:, k] = trusted[:, k] & (jumped[:, j] | (good[:, j] & ~fits))
            good[:, k] &= good[:, j] & fits
    return np.where((good & measured)[..., None], seen.points_m, np.nan), _count_rejected(seen, measured, good, jumped)


def _count_rejected(seen: Measurements | CameraFrames, measured: Bools, good: Bools, jumped: Bools) -> Counter[str]:
    """Counts, per camera, the points not seen, doubted and jumping, and the frames with a jumping point."""
    counts: Counter[str] = Counter()
    for c, camera in enumerate(seen.cameras):
        mine = seen.camera == c
        counts[f"audit_unseen_points_{camera}"] = int((~measured[mine]).sum())
        counts[f"audit_doubted_points_{camera}"] = int((measured & ~good & ~jumped)[mine].sum())
        counts[f"audit_rejected_points_{camera}"] = int(jumped[mine].sum())
        counts[f"audit_rejected_frames_{camera}"] = int(jumped[mine].any(axis=1).sum())
    return counts


def _plain(log: Log, found: Counter[str]) -> dict[str, int]:
    return {name: int(count) for name, count in sorted((log.defects + found).items())}
