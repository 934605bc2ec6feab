"""All motions of a run judged by the recorded people, in two processes: contact, severity, and the body for drawing."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from hrcreplay.evaluation.contact import (
    STRETCH,
    Coverages,
    JudgedMotion,
    Predicted,
    compute_full_coverage,
    compute_own_coverage,
    write_rows,
)
from hrcreplay.evaluation.recorded_person import BodyTrack, RecordedPeople, SmoothedPeople
from hrcreplay.evaluation.recording import gather, read_people
from hrcreplay.evaluation.severity import severity_table
from hrcreplay.human.model import PARTS
from hrcreplay.logs.reader import Log
from hrcreplay.pipeline import assembly, stages
from hrcreplay.pipeline.people_smoother import PeopleSmoother
from hrcreplay.pipeline.person_fuser import PersonFuser
from hrcreplay.pipeline.run_config import RunConfig
from hrcreplay.pipeline.second_process import read_apart, write_apart
from hrcreplay.pipeline.seen_bodies import SeenBodies
from hrcreplay.records import JOINTS, LENGTHS, RECORDED, Bools, Floats, HumanStates, Ints
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.recorded import RecordedCapsules
from hrcreplay.store.columns import Columns, body_columns
from hrcreplay.store.memory import release_freed_memory
from hrcreplay.store.run_folder import RunWriter, TableWriter
from hrcreplay.store.stored_table import StoredTable

#: Rate of the rows of body.parquet, for drawing [Hz], and number of them that are made together.
_BODY_HZ, _BATCH = 25.0, 4096


def read_recorded_people(
    run_config: RunConfig,
    log: Log,
    writer: RunWriter,
    seen: SeenBodies | None = None,
    folder: Path | None = None,
) -> RecordedPeople:
    """Reads all people in the log of a run; writes smooth.parquet if it and the ground truth are missing.

    Args:
        run_config: The run.
        log: Log of the run.
        writer: Run folder with complete tables.
        seen: The bodies that stage 1 saw; None: the log is read again for them.
        folder: Folder for files of the people's points, as long as they are needed; None: they stay in memory.
    """
    ticks_ns = np.unique(StoredTable(writer.partial / "state.parquet")["t_ns"].to_numpy())
    fusion_stage = assembly.fusion_stage(run_config, log)
    path = writer.partial / "smooth.parquet"

    def smoothed() -> SmoothedPeople:
        if not path.exists():
            for part in _smooth(run_config, log, ticks_ns):
                stages.write_smoothed(part, writer)
            writer.close_tables()
        return _read_smoothed(path, folder)

    return read_people(log, ticks_ns, fusion_stage, smoothed, seen, folder)


def _read_smoothed(path: Path, folder: Path | None) -> SmoothedPeople:
    """Reads what is needed of smooth.parquet; joints and lengths go to files in the folder, some rows at a time."""
    table = StoredTable(path)
    p, lengths_m = (gather(_read_columns(path, names), folder) for names in (JOINTS, LENGTHS))
    used = table[[name for name in table.columns if name.startswith("valid_")]].to_numpy(dtype=bool)
    person = table["person"].to_numpy() if "person" in table else None
    return SmoothedPeople(table["t_ns"].to_numpy(), p, lengths_m, np.asarray(used.any(axis=1)), person)


def _read_columns(path: Path, names: Sequence[str]) -> Iterator[Floats]:
    """Reads columns of numbers (m, k), some rows at a time."""
    with pq.ParquetFile(path, pre_buffer=False) as file:
        for batch in file.iter_batches(batch_size=STRETCH, columns=list(names), use_threads=False):
            yield np.column_stack([batch.column(name).to_numpy() for name in names])


def _smooth(run_config: RunConfig, log: Log, ticks_ns: Ints) -> Iterator[HumanStates]:
    """Fuses and smooths the people, if the stage was not run or was reused."""
    fusion_stage, cameras = assembly.fusion_stage(run_config, log), log.header.cameras
    fuser = PersonFuser(replace(fusion_stage, watched=None), cameras, traced=True)
    smoother = PeopleSmoother(fusion_stage.filter)
    for ticks, seen in stages.batches(log.frames(int(ticks_ns[0]), int(ticks_ns[-1]) + 1), ticks_ns, _BATCH):
        fused, _ = fuser.update(ticks, seen)
        yield from smoother.add(fused.states, fused.trace)
    yield from smoother.finish()


def write_contact(
    run_config: RunConfig,
    log: Log,
    writer: RunWriter,
    T_world_base: Floats,
    second: Executor | None = None,
    seen: SeenBodies | None = None,
) -> None:
    """Writes contact.parquet and severity.parquet for every motion of a run, and the recorded body for drawing.

    Args:
        run_config: The run.
        log: Log of the run.
        writer: Run folder with complete tables.
        T_world_base: (4, 4) robot base in the world.
        second: A second process, which takes every other motion beside the chosen one; None: no such process.
        seen: The bodies that stage 1 saw; None: the log is read again for them.
    """
    with TemporaryDirectory(prefix=".people_", dir=writer.partial) as folder:
        people = read_recorded_people(run_config, log, writer, seen, Path(folder))
        judged = _JudgedRun(run_config, T_world_base, people, writer.partial)
        found = _judge(judged, log, writer, second)
    del people, judged  # in a long run many
    release_freed_memory()
    for rows, meetings in found:
        writer.table("severity", meetings)
        _move_rows(rows, writer)
    writer.close_tables()


def _judge(judged: _JudgedRun, log: Log, writer: RunWriter, second: Executor | None) -> list[tuple[Path, Columns]]:
    """Writes the body, and the rows of contact of each motion to a file; returns these files and rows of severity."""
    release_freed_memory()
    paths = sorted(writer.partial.glob("motion*.parquet"))
    coverages, there = judged.coverages, {}
    if second is not None:
        write_apart(judged.path, judged)
        second.submit(_take_there, judged.path)
        coverages = second.submit(_coverages_there).result
        every_other = [path for path in paths[1:] if path.stem != f"motion_{RECORDED}"][::2]
        there = {path: second.submit(_judge_there, path) for path in every_other}
    meetings: dict[Path, Columns] = {}
    here = [path for path in paths if path not in there]
    for path in sorted(here, key=lambda path: path.stem == "motion"):  # last, as it needs both coverages
        capsules = None
        if path.stem == "motion":
            _write_body(judged, StoredTable(path)["t_ns"].to_numpy(), writer)
        if path.stem == f"motion_{RECORDED}" and StoredTable(path)["q1"].isna().all():
            capsules, _ = assembly.recorded_capsules(log, judged.T_world_base)
        meetings[path] = judged.judge(path, capsules, coverages)
    meetings |= {path: judging.result() for path, judging in there.items()}
    if second is not None:
        second.submit(_forget_there)
    return [(judged.rows_of(path), meetings[path]) for path in paths]


def _write_body(judged: _JudgedRun, ticks_ns: Ints, writer: RunWriter) -> None:
    """Writes the recorded body at some of the ticks."""
    settings, people = judged.run_config.settings, judged.people
    shown_ns = ticks_ns[:: max(1, round(settings.fusion.rate_hz / _BODY_HZ))]
    size = -(-_BATCH // len(people.people))
    for first in range(0, len(shown_ns), size):
        before = min(first, 1)
        some_ns = shown_ns[first - before : first + size]
        writer.table("body", body_table(people, some_ns, settings.prediction.hand_m, before))


def _move_rows(path: Path, writer: RunWriter) -> None:
    """Appends the rows of a motion to contact.parquet and removes their file."""
    with pq.ParquetFile(path, pre_buffer=False) as file:
        for batch in file.iter_batches(batch_size=TableWriter.ROWS):  # with many people, many columns
            writer.table("contact", dict(zip(batch.schema.names, batch.columns, strict=True)))
    path.unlink()


@dataclass(frozen=True)
class _JudgedRun:
    """A run whose motions are judged; either process makes robot and volumes again."""

    run_config: RunConfig
    T_world_base: Floats  #: (4, 4) robot base in the world
    people: RecordedPeople
    folder: Path

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles what the other process needs to make the rest."""
        return _JudgedRun, (self.run_config, self.T_world_base, self.people, self.folder)

    @cached_property
    def robot(self) -> RobotModel:
        """The robot at its base pose in the world."""
        return assembly.robot(self.run_config, self.T_world_base)

    @cached_property
    def predicted(self) -> Predicted:
        """Volumes of any tick."""
        return Predicted(assembly.prediction_stage(self.run_config), self.folder / "state.parquet")

    def coverages(self) -> tuple[Coverages, Coverages]:
        """Coverage by the volumes that the chosen method used, and by those until the braking time."""
        run = self.run_config, self.people, self.predicted
        return compute_own_coverage(*run, StoredTable(self.folder / "motion.parquet")), compute_full_coverage(*run)

    @property
    def path(self) -> Path:
        """File of the run for the second process, until that has read it."""
        return self.folder / ".judged"

    def rows_of(self, path: Path) -> Path:
        """File of the rows of contact of a motion, until all motions are judged."""
        return self.folder / f".contact_{path.stem}.parquet"

    def judge(
        self,
        path: Path,
        capsules: RecordedCapsules | None = None,
        coverages: Callable[[], tuple[Coverages, Coverages]] | None = None,
    ) -> Columns:
        """Computes the rows of contact of a motion, which go to a file of their own, and those of severity.

        Args:
            path: Table of the motion; that of the chosen method is judged by the volumes, too.
            capsules: The robot as recorded by its capsules; None: no such robot.
            coverages: Gives ``coverages()``, for the chosen method.
        """
        run_config, people = self.run_config, self.people
        method = path.stem.removeprefix("motion").removeprefix("_") or run_config.settings.plan.method
        motion, own, full = StoredTable(path), None, None
        if path.stem == "motion":
            own, full = (coverages or self.coverages)()
        judged = JudgedMotion(run_config, self.robot, method, motion, people, self.predicted, own, full, capsules)
        rows = TableWriter(self.rows_of(path))
        meetings = write_rows(judged.rows(), rows.write)
        rows.close()
        return severity_table(run_config, self.robot, method, motion, meetings, people, capsules)


#: The run that is judged in the second process.
_THERE: list[_JudgedRun] = []


def _take_there(path: Path) -> None:
    release_freed_memory()
    _THERE[:] = [read_apart(path)]
    path.unlink()


def _coverages_there() -> tuple[Coverages, Coverages]:
    return _THERE[0].coverages()


def _judge_there(path: Path) -> Columns:
    return _THERE[0].judge(path)


def _forget_there() -> None:
    _THERE.clear()
    release_freed_memory()


def body_table(people: RecordedPeople, at_ns: Ints, hand_m: float, before: int = 0) -> Columns:
    """Returns the columns of body.parquet: the capsules of the people at each instant, in order of time.

    Of several people, those of whom anything is known then or was an instant before: an hour has many visitors.

    Args:
        people: The recorded people.
        at_ns: (m,) instants, increasing [ns].
        hand_m: Length of a hand beyond the wrist [m].
        before: Number of the first instants that have no rows.
    """
    numbers = np.array([one.number for one in people.people], dtype=np.int64)
    each = np.stack([body_axes(one.tracks, at_ns, hand_m) for one in people.people], axis=1)
    if len(numbers) == 1:
        person = None if numbers[0] == 1 else np.full(len(at_ns) - before, numbers[0])
        return body_columns(at_ns[before:], each[before:, 0], PARTS, person)
    there: Bools = np.asarray(np.isfinite(each).any(axis=(2, 3, 4)))
    there[1:] |= there[:-1].copy()
    there[:before] = False
    instant, which = np.nonzero(there)
    return body_columns(at_ns[instant], each[instant, which], PARTS, numbers[which])


def body_axes(person: Sequence[BodyTrack], at_ns: Ints, hand_m: float) -> Floats:
    """(m, 14, 2, 3) axes of the person's capsules; each part comes from the first source that has it [m]."""
    axes_m = person[0].axes_m(at_ns, hand_m)
    for track in person[1:]:
        axes_m = np.where(np.isnan(axes_m), track.axes_m(at_ns, hand_m), axes_m)
    return axes_m
