"""The recorded motion of the person in a log, with which an audit compares the predictions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from hrcreplay.errors import LogError
from hrcreplay.human.fusion import fuse, inverse_kinematics
from hrcreplay.human.model import SHOWN_BY, skeleton
from hrcreplay.logs.clean import PersonMemory
from hrcreplay.logs.reader import Log
from hrcreplay.records import LENGTHS, POINTS, Bools, Floats, HumanStates, Ints, Measurements
from hrcreplay.report.metrics import difference
from hrcreplay.run.build import FusionStage
from hrcreplay.run.stages import batches

TRUTH, CAMERAS, SMOOTHED = "ground truth", "camera points", "smoothed estimate"

#: Recorded points of a limb. The first two, its ends, must have been seen near the end of the horizon, or the limb is
#: not checked.
LIMB_POINTS = {
    "HD": ("neck", "head"),
    "THX": ("pelvis", "shoulder_r", "shoulder_l"),
    "URA": ("shoulder_r", "elbow_r"),
    "LRA": ("elbow_r", "wrist_r", "hand_r"),
    "ULA": ("shoulder_l", "elbow_l"),
    "LLA": ("elbow_l", "wrist_l", "hand_l"),
    "LEGS": tuple(f"{part}_{side}" for part in ("hip", "knee", "ankle", "foot") for side in "rl"),
}
#: Points that the model has no say about -> the point they hang from and the longest a body makes that bone [m].
_HANGING = {
    "hand": ("wrist", 0.30),
    "hip": ("pelvis", 0.30),
    "knee": ("hip", 0.65),
    "ankle": ("knee", 0.65),
    "foot": ("ankle", 0.40),
}
#: Points of the model from the root on, where their bone starts, and its length: so many times one of LENGTHS.
_BONES: tuple[tuple[str, str, str, float], ...] = (
    ("shoulder_r", "shoulder_l", "pi_half_shoulder", 2.0),
    ("shoulder_l", "shoulder_r", "pi_half_shoulder", 2.0),
    ("pelvis", "neck", "pi_torso", 1.0),
    ("head", "neck", "pi_head", 1.0),
    *((f"elbow_{side}", f"shoulder_{side}", f"pi_upper_arm_{side}", 1.0) for side in "rl"),
    *((f"wrist_{side}", f"elbow_{side}", f"pi_forearm_{side}", 1.0) for side in "rl"),
)
#: A bone that is so near to the person's own length is that person's: people are not the model [m].
_BONE_M = 0.08
#: Ticks fused and smoothed at a time, since the trace takes 1.5 kB a tick; and how many of the next stretch a smoothed
#: stretch knows of: what comes later tells no more.
_STRETCH, _LATER = 15_000, 500


@dataclass(frozen=True)
class Recording:
    """A log as an audit needs it."""

    states: HumanStates  #: the fused person at every tick, knowing only what had arrived
    t_ns: Ints  #: (m,) instants of the recorded points, increasing
    points_m: Floats  #: (m, 20, 3) POINTS, world [m]; NaN where not recorded or not believed
    joints_t_ns: Ints  #: (k,) instants of the recorded joints, increasing
    joints: Floats  #: (k, 13) JOINTS [m, m, rad..., m]
    source: str  #: TRUTH, CAMERAS or SMOOTHED
    counts: dict[str, int]


#: A limb has moved once one of its ends is so far from where it was first, the middle of so many sightings [m].
_MOVED_M, _FIRST = 0.1, 10


def first_movements_ns(recording: Recording) -> dict[str, int | None]:
    """Limb -> when it first moved [ns]; None where it never did: a filter has seen no movement of its kind before."""
    found: dict[str, int | None] = {}
    for limb, names in LIMB_POINTS.items():
        moved = np.zeros(len(recording.t_ns), dtype=bool)
        for name in names[:2]:
            points = recording.points_m[:, POINTS.index(name)]
            seen = points[np.isfinite(points).all(axis=1)]
            if len(seen):
                moved |= np.linalg.norm(points - np.median(seen[:_FIRST], axis=0), axis=1) > _MOVED_M
        found[limb] = int(recording.t_ns[np.argmax(moved)]) if moved.any() else None
    return found


#: Recorded velocities are differences over so long, of joints recorded without a longer gap; a limb that no camera has
#: seen for longer is where nobody knows [ns], [s].
_ACROSS_NS, _GAP_NS, _SEEN_S = 40_000_000, 100_000_000, 0.25


def errors_in_deviations(recording: Recording, ticks: Ints) -> Floats:
    """How far the fused positions and velocities were from the recorded ones, in their standard deviations.

    Args:
        recording: The log.
        ticks: (n,) rows of ``recording.states``.

    Returns:
        (2, n, 13), positions before velocities; NaN where the joint was not recorded, or not seen lately.
    """
    t_ns, joints, states = recording.joints_t_ns, recording.joints, recording.states.rows(ticks)

    def recorded(at_ns: Ints) -> Floats:
        before = np.clip(np.searchsorted(t_ns, at_ns, side="right") - 1, 0, max(0, len(t_ns) - 2))
        after = np.minimum(before + 1, len(t_ns) - 1)
        apart = np.maximum(t_ns[after] - t_ns[before], 1)
        share = (at_ns - t_ns[before]) / apart
        known = (share >= 0.0) & (share <= 1.0) & (apart <= _GAP_NS)
        between = joints[before] + share[:, None] * difference(joints[after], joints[before])
        return np.where(known[:, None], between, np.nan)

    later, earlier = recorded(states.t_ns + _ACROSS_NS // 2), recorded(states.t_ns - _ACROSS_NS // 2)
    velocity = difference(later, earlier) / (_ACROSS_NS * 1e-9)
    found = np.stack([difference(states.p, recorded(states.t_ns)) / states.p_std, (states.v - velocity) / states.v_std])
    return np.where((states.unseen_s <= _SEEN_S)[:, SHOWN_BY], found, np.nan)


def read_recording(log: Log, ticks_ns: Ints, fusion_stage: FusionStage, progress: Callable[[int], None]) -> Recording:
    """Reads the span of ``ticks_ns``.

    The recorded future is the ground truth where the log has it. Else the points of the cameras, at their capture
    times, that the cameras trust (confidence 0 is not seen) and that are either within the filter's outlier distance of
    the smoothed person, who knows what came later, or at the end of a bone of the person's own length: who squats or
    bends sideways leaves the model, not the room, and must not be thrown out for it; a marker that jumps away takes no
    bone along. Else the smoothed person. Recorded joints are those of the truth, else of the smoothed person.

    Args:
        log: Log to read.
        ticks_ns: (n,) ticks of the span, increasing [ns].
        fusion_stage: Cameras and settings of stage 1.
        progress: Called with the number of ticks done since the last call.

    Raises:
        LogError: No camera saw anybody.
    """
    counts: Counter[str] = Counter()
    stretches = fused_stretches(log, ticks_ns, fusion_stage, counts, progress)
    truth = [part.rows((part.t_ns >= ticks_ns[0]) & (part.t_ns <= ticks_ns[-1])) for part in log.truth()]
    truth = [part for part in truth if len(part)]
    if truth:
        states = HumanStates.join([states for _, states, _ in stretches])
        t_ns = np.concatenate([part.t_ns for part in truth])
        points = np.concatenate([part.points_m for part in truth])
        joints, _ = inverse_kinematics.inverse(points)
        return Recording(states, t_ns, points, t_ns, joints, TRUTH, _plain(log, counts))
    states, seen, best = _smoothed(stretches, fusion_stage)
    points, rejected = _believed(seen, best, fusion_stage)
    counts.update(rejected)
    order = np.argsort(seen.capture_ns, kind="stable")
    t_ns, points, source = seen.capture_ns[order], points[order], CAMERAS
    if not np.isfinite(points).any():
        t_ns, points, source = best.t_ns, skeleton(best.p, best.lengths_m), SMOOTHED
    return Recording(states, t_ns, points, best.t_ns, best.p, source, _plain(log, counts))


#: What was measured, what was fused from it, and how.
Stretch = tuple[Measurements, HumanStates, fuse.Trace]


def fused_stretches(
    log: Log, ticks_ns: Ints, fusion_stage: FusionStage, counts: Counter[str], progress: Callable[[int], None]
) -> Iterator[Stretch]:
    """Stage 1, traced, from the first stretch on in which a camera saw somebody.

    Args:
        log: Log to read.
        ticks_ns: (n,) ticks, increasing [ns].
        fusion_stage: Cameras and settings of stage 1.
        counts: Receives the counts of events.
        progress: Called with the number of ticks done since the last call.

    Raises:
        LogError: No camera saw anybody.
    """
    state, memory = fuse.start(log.header.cameras), PersonMemory()
    measured: Measurements | None = None
    for ticks, due in batches(log.frames(int(ticks_ns[0]), int(ticks_ns[-1]) + 1), ticks_ns, _STRETCH):
        progress(len(ticks))
        if due is not None:
            memory, measured, found = fusion_stage.measure(due, memory)
            counts.update(found)
        elif measured is not None:
            measured = measured.rows(slice(0, 0))
        else:
            continue
        state, states, events, trace = fuse.fuse(
            state, ticks, measured, fusion_stage.filter, fusion_stage.limits, traced=True
        )
        counts.update(events)
        yield measured, states, trace
    log.check()
    if measured is None:
        raise LogError(f"{log.header.path}: no camera saw anybody; an audit needs a person")


def _smoothed(stretches: Iterator[Stretch], fusion_stage: FusionStage) -> tuple[HumanStates, Measurements, HumanStates]:
    """The states, the measurements and the smoothed states of all stretches."""
    seen, passed, best = [], [], []
    held: tuple[HumanStates, fuse.Trace] | None = None

    def finish(held: tuple[HumanStates, fuse.Trace], after: tuple[HumanStates, fuse.Trace] | None) -> None:
        states, trace = held
        if after is not None:
            states = HumanStates.join([states, after[0].rows(slice(0, _LATER))])
            trace = fuse.Trace.join([trace, after[1].rows(slice(0, _LATER))])
        best.append(fuse.smooth(states, trace, fusion_stage.filter).rows(slice(0, len(held[0]))))

    for measured, states, trace in stretches:
        seen.append(measured)
        passed.append(states)
        if held is not None:
            finish(held, (states, trace))
        held = states, trace
    if held is not None:
        finish(held, None)
    return HumanStates.join(passed), Measurements.join(seen), HumanStates.join(best)


def _believed(seen: Measurements, best: HumanStates, fusion_stage: FusionStage) -> tuple[Floats, Counter[str]]:
    """The measured points (m, 20, 3) that are believed, and how many per camera are not, by why.

    A missing point and one of confidence 0 were not seen. One that the camera trusts too little, that hangs from such a
    point, or that was seen before the person was known, is doubted: nobody can say whether it is right. One that the
    camera trusts and that fails a gate jumps off the person: it is rejected, with what hangs from it.
    """
    tick = np.clip(np.searchsorted(best.t_ns, seen.capture_ns), 0, len(best) - 1)
    expected = skeleton(best.p[tick], best.lengths_m[tick])
    measured: Bools = np.asarray(np.isfinite(seen.points_m).all(axis=2)) & (seen.confidence > 0.0)
    trusted = measured & (seen.confidence >= fusion_stage.filter.confidence_min)
    good, jumped = trusted.copy(), np.zeros_like(trusted)
    points = seen.points_m.copy()
    neck, right, left = (POINTS.index(name) for name in ("neck", "shoulder_r", "shoulder_l"))
    points[:, neck] = 0.5 * (points[:, left] + points[:, right])  # the model's: the middle of the shoulders
    good[:, neck] = trusted[:, left] & trusted[:, right]
    off = np.linalg.norm(points - expected, axis=2)
    for name, start, length, part in _BONES:
        k, j = POINTS.index(name), POINTS.index(start)
        own = part * best.lengths_m[tick, LENGTHS.index(length)]
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
    return np.where((good & measured)[..., None], seen.points_m, np.nan), _disbelieved(seen, measured, good, jumped)


def _disbelieved(seen: Measurements, measured: Bools, good: Bools, jumped: Bools) -> Counter[str]:
    """Per camera the points that were not seen, were doubted, or jump; and the frames with one that jumps."""
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
