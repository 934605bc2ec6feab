"""A run by two processes writes the same bytes as by one."""

from __future__ import annotations

import json
import time
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hrcreplay.commands import replay
from hrcreplay.evaluation import contact
from hrcreplay.pipeline.run_config import resolve
from hrcreplay.pipeline.second_process import read_apart, second_process, share, write_apart


def _fail() -> None:
    raise LookupError("as it does")


def test_two_processes_write_the_same_bytes_as_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[str] = []

    class Watched:
        """Gives the second process its work, and notes which."""

        def __init__(self, pool: Any) -> None:
            self.pool = pool

        def submit(self, work: Any, *given: Any, **named: Any) -> Any:
            taken.append(work.__name__)
            return self.pool.submit(work, *given, **named)

        def shutdown(self, *, wait: bool) -> None:
            taken.append("shutdown")
            self.pool.shutdown(wait=wait)

    rest: Any = replay.complete

    def complete(*given: Any) -> None:
        *before, second, seen = given
        rest(*before, second and Watched(second), seen)

    run_stages: Any = replay.run_stages

    def stages(*given: Any, second: Any, **named: Any) -> Any:
        return run_stages(*given, second=second and Watched(second), **named)

    monkeypatch.setattr(replay, "MANY", 100)
    monkeypatch.setattr(replay, "complete", complete)
    monkeypatch.setattr(replay, "run_stages", stages)
    how: Any = {"cell_file": replay.demo_cell(), "start_s": 8.0, "end_s": 9.0}
    found = []
    stretch = contact.STRETCH
    for processes in (1, 2):
        assert not taken
        monkeypatch.setattr(contact, "STRETCH", 64 if processes == 1 else stretch)  # rows that are made together
        folder = replay.execute(
            resolve("report", replay.demo_log(), **how), tmp_path / str(processes), processes=processes
        )
        found.append(json.loads((folder / "run.json").read_text())["outputs"])
        assert {"plan none", "plan qp", "plan scaling"} <= set(json.loads((folder / "timing.json").read_text()))
    assert found[0] == found[1]
    assert {"contact.parquet", "severity.parquet", "motion_none.parquet", "motion_scaling.parquet"} <= set(found[0])
    assert set(taken) == {"_start", "_take", "_finish", "_take_there", "_coverages_there", "_judge_there"} | {
        "_forget_there",
        "_replay_there",
        "draw_there",
        "shutdown",
    }
    assert taken[-1] == "shutdown"


def test_a_value_goes_to_the_other_process_by_a_file(tmp_path: Path) -> None:
    shared, path = np.arange(12.0).reshape(3, 4), tmp_path / "value"
    shared.setflags(write=False)
    value = {
        "a": shared,
        "b": (shared, np.asfortranarray(shared + 1.0)),
        "c": np.arange(10)[::2],
        "d": np.empty((0, 3)),
    }
    write_apart(path, value)
    found = read_apart(path)
    assert found["a"] is found["b"][0], "once in memory"
    for one, other in ((found["a"], shared), (found["b"][1], shared + 1.0), (found["c"], np.arange(0, 10, 2))):
        np.testing.assert_array_equal(one, other)
        assert one.dtype == other.dtype
    assert found["d"].shape == (0, 3)
    assert not found["a"].flags.writeable  # protected here, so there: kernels are compiled for one kind of array
    found["b"][1][0, 0] = 7.0


def test_two_processes_share_tasks_until_they_meet() -> None:
    """The second one has at most one task at a time, begins after what it does before, and takes the last ones."""
    here: list[int] = []
    there: list[int] = []
    waiting: list[int] = []

    def work(task: int) -> str:
        time.sleep(0.01)
        there.append(task)
        return str(task)

    def send(task: int) -> Future[str]:
        waiting.append(task)
        assert len(waiting) <= len(there) + 1
        return pool.submit(work, task)

    def do(task: int) -> str:
        if task == 3:
            busy.set_result(None)
        assert task < 3 or waiting
        time.sleep(0.01)
        here.append(task)
        return str(task)

    busy: Future[None] = Future()
    with ThreadPoolExecutor(1) as pool:
        assert share(range(40), do, send, busy) == [str(task) for task in range(40)]
    assert sorted(here + there) == list(range(40))
    assert here == list(range(len(here)))
    assert there == list(range(39, len(here) - 1, -1))
    assert len(there) > 5


def test_nothing_is_sent_after_an_error_here() -> None:
    busy: Future[None] = Future()
    sent: list[int] = []

    def do(task: int) -> None:
        if task == 2:
            raise LookupError("as it does")

    def send(task: int) -> Future[None]:
        sent.append(task)
        return Future()

    with pytest.raises(LookupError, match="as it does"):
        share(range(9), do, send, busy)
    busy.set_result(None)
    assert not sent


def test_a_task_that_cannot_be_sent_is_done_here() -> None:
    """So that the task which the dead process had tells that it died."""
    busy: Future[None] = Future()
    died: Future[str] = Future()
    sent: list[int] = []
    here: list[int] = []

    def do(task: int) -> str:
        here.append(task)
        if task == 1:
            died.set_exception(BrokenExecutor("it died"))
        return ""

    def send(task: int) -> Future[str]:
        sent.append(task)
        if len(sent) > 1:
            raise BrokenExecutor("it is dead")
        return died

    busy.set_result(None)
    with pytest.raises(BrokenExecutor, match="it died"):
        share(range(5), do, send, busy)
    assert sent == [4, 3]
    assert here == [0, 1, 2, 3]


def test_an_error_there_is_raised_here() -> None:
    busy: Future[None] = Future()
    busy.set_result(None)
    with ThreadPoolExecutor(1) as pool, pytest.raises(LookupError, match="as it does"):
        share(range(2), lambda _: time.sleep(0.01), lambda _: pool.submit(_fail), busy)


def test_an_error_of_the_second_process_is_that_of_the_run() -> None:
    with pytest.raises(LookupError, match="as it does"), second_process() as pool:
        pool.submit(_fail).result()


def test_an_error_after_the_end_of_the_second_process_is_that_of_the_run() -> None:
    with pytest.raises(LookupError, match="as it does"), second_process() as pool:
        pool.submit(int).result()
        pool.shutdown(wait=False)
        _fail()
