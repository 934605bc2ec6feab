"""The baselines of a run and the tables of people and volumes, in the second process, beside the rest in the first.

The first process sends each batch of fused people once its chosen method has used it.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Executor, Future
from dataclasses import replace
from pathlib import Path

from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.run_config import RunConfig
from hrcreplay.pipeline.stages import MethodsFollowing, Sink
from hrcreplay.pipeline.stored_volumes import store_ticks
from hrcreplay.pipeline.surroundings import Forecast
from hrcreplay.records import Floats, HumanStates, Ints
from hrcreplay.store.columns import state_columns
from hrcreplay.store.memory import release_after
from hrcreplay.store.run_folder import FolderTables, Stopwatch

#: Number of batches that may wait for the second process: 4 kB per tick and person, and no more is gained by more.
_MOST_WAITING = 16
#: Stage -> ticks and duration [ns] of each call.
Calls = dict[str, list[tuple[int, int]]]


class MethodsElsewhere:
    """Sends the batches of a run to the second process."""

    def __init__(
        self, second: Executor, run_config: RunConfig, start_ns: int, names: Sequence[str], folder: Path, *, fused: bool
    ) -> None:
        """Makes the robots of the second process.

        Args:
            second: The process.
            run_config: The run.
            start_ns: First tick of the run [ns].
            names: The methods; none is the chosen one.
            folder: Receives the tables.
            fused: True: the people are just fused, and their table is written, too.
        """
        self._second = second
        self._sent = deque[Future[None]]([second.submit(_start, run_config, start_ns, names, folder, fused)])

    def take(self, batch: HumanStates, stored: Ints, horizon_s: Floats) -> None:
        """Sends a batch; waits if too many are under way, and raises what a batch before has raised."""
        self._sent.append(self._second.submit(_take, batch, stored, horizon_s))
        while len(self._sent) > _MOST_WAITING:
            self._sent.popleft().result()

    def finish(self) -> Calls:
        """Waits for the last batch, and returns the times of the stages."""
        for sent in self._sent:
            sent.result()
        return self._second.submit(_finish).result()


class _Work:
    """What the second process does for a run."""

    def __init__(self, run_config: RunConfig, start_ns: int, names: Sequence[str], folder: Path, fused: bool) -> None:
        log, self._tables, self._fused = open_log(run_config.log, run_config.settings.logs), FolderTables(folder), fused
        self._sink = Sink(self._tables, Stopwatch(time.perf_counter_ns), lambda _, __: None)
        robot = assembly.robot(run_config, assembly.robot_base(run_config, log))
        self._surroundings = assembly.surroundings(run_config, robot)
        moved = assembly.followers(run_config, assembly.programme(run_config, log, robot), start_ns) if names else {}
        self._methods = MethodsFollowing(self._surroundings, {name: moved[name] for name in names}, self._sink)
        self._batches = 0

    def take(self, batch: HumanStates, stored: Ints, horizon_s: Floats) -> None:
        if self._fused:
            self._tables.table("state", state_columns(batch))
        forecast = Forecast(self._surroundings, replace(batch))  # sent records are not protected
        self._methods.take(forecast)
        with self._sink.watch.stage("hulls", len(forecast.t_ns)):
            store_ticks(forecast, stored, horizon_s, self._tables)
        release_after(self._batches)
        self._batches += 1

    def finish(self) -> Calls:
        self._tables.close_tables()
        return {name: calls for name, calls in self._sink.watch.calls.items() if name != "predict"}


def get_loaded() -> None:
    """Makes a process load this module, which takes a second: it is called there for nothing else."""


#: The work under way in this process, which is that of one run.
_UNDER_WAY: list[_Work] = []


def _start(run_config: RunConfig, start_ns: int, names: Sequence[str], folder: Path, fused: bool) -> None:
    _UNDER_WAY[:] = [_Work(run_config, start_ns, names, folder, fused)]


def _take(batch: HumanStates, stored: Ints, horizon_s: Floats) -> None:
    _UNDER_WAY[0].take(batch, stored, horizon_s)


def _finish() -> Calls:
    return _UNDER_WAY.pop().finish()
