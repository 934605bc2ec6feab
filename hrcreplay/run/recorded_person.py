"""The person as recorded: ground truth where the log has it, else the fused person smoothed over the whole run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hrcreplay.human import body_capsules
from hrcreplay.human.fusion import fuse
from hrcreplay.human.model import skeleton
from hrcreplay.logs.clean import PersonMemory
from hrcreplay.logs.reader import Log
from hrcreplay.records import Bools, Floats, HumanStates, Ints
from hrcreplay.run import build, stages
from hrcreplay.run.job import Job
from hrcreplay.store.columns import read_states, state_columns
from hrcreplay.store.run_folder import RunWriter

#: Between samples of the recorded person further apart nothing is known [s].
GAP_S = 0.1
_TICKS = 4096


@dataclass(frozen=True)
class RecordedPerson:
    """Body points over time, from one source."""

    source: str  #: "truth", or "smoothed"
    t_ns: Ints  #: (n,) increasing
    points_m: Floats  #: (n, 20, 3) POINTS, world [m]; NaN where they are not known

    def part_axes(self, at_ns: Ints, hand_m: float) -> Floats:
        """(m, 10, 2, 3) axes of the capsules of ``body_capsules.PARTS`` at some instants [m]."""
        points_m = body_capsules.at_instants(self.t_ns, self.points_m, at_ns, GAP_S)
        return body_capsules.part_axes(points_m, hand_m)


def recorded_person(job: Job, log: Log, writer: RunWriter) -> RecordedPerson:
    """The person of a run. Without ground truth and smooth.parquet the log is fused again, and smooth.parquet written.

    Args:
        job: What was asked for.
        log: Log of the job.
        writer: Run folder, its tables complete.
    """
    if log.header.has_truth:
        parts = list(log.truth())
        t_ns, first = np.unique(np.concatenate([part.t_ns for part in parts]), return_index=True)
        return RecordedPerson("truth", t_ns, np.concatenate([part.points_m for part in parts])[first])
    path = writer.partial / "smooth.parquet"
    if path.exists():
        states = HumanStates.join(list(read_states(path, _TICKS)))
    else:
        states = _smoothed(job, log, _ticks_of(writer))
        writer.table("smooth", state_columns(states))
    return from_states(states, job.settings.fusion.memory_s)


def from_states(states: HumanStates, memory_s: float) -> RecordedPerson:
    """The smoothed person, but for where no camera saw them: there is nothing to smooth.

    Args:
        states: The smoothed states.
        memory_s: Between two ticks that used a camera further apart than this, nothing is known [s].
    """
    points_m = skeleton(states.p, states.lengths_m)
    points_m[~_seen(states, memory_s)] = np.nan
    return RecordedPerson("smoothed", states.t_ns, points_m)


def _seen(states: HumanStates, memory_s: float) -> Bools:
    """(n,) ticks that lie between two ticks with a camera not further apart than ``memory_s`` [s], both included."""
    used = np.flatnonzero(states.valid.any(axis=1))
    if not len(used):
        return np.zeros(len(states), dtype=np.bool_)
    ticks = np.arange(len(states))
    before = used[np.maximum(np.searchsorted(used, ticks, side="right") - 1, 0)]
    after = used[np.minimum(np.searchsorted(used, ticks, side="left"), len(used) - 1)]
    apart_s = (states.t_ns[after] - states.t_ns[before]) * 1e-9
    return np.asarray((before <= ticks) & (ticks <= after) & (apart_s <= memory_s))


def _ticks_of(writer: RunWriter) -> Ints:
    """The ticks of the fused person."""
    return np.concatenate([states.t_ns for states in read_states(writer.partial / "state.parquet", _TICKS)])


def _smoothed(job: Job, log: Log, ticks_ns: Ints) -> HumanStates:
    """The person fused and smoothed, where the stage was not run or was taken over."""
    fusion_stage, cameras = build.fusion_stage(job, log), log.header.cameras
    state, memory = fuse.start(cameras), PersonMemory()
    passed = []
    for ticks, seen in stages.batches(log.frames(int(ticks_ns[0]), int(ticks_ns[-1]) + 1), ticks_ns, _TICKS):
        measured = stages.no_frames(cameras)
        if seen is not None:
            memory, measured, _ = fusion_stage.measure(seen, memory)
        state, states, _, trace = fuse.fuse(
            state, ticks, measured, fusion_stage.filter, fusion_stage.limits, traced=True
        )
        passed.append((states, trace))
    return stages.smoothed(passed, fusion_stage.filter)
