"""A second process, on the other core, for work that does not depend on the rest of a run; it changes no result."""

from __future__ import annotations

import multiprocessing
import pickle
import signal
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

#: Least number of ticks of a run with a second process, which takes seconds to start.
MANY = 5000

_T = TypeVar("_T")
_R = TypeVar("_R")


@contextmanager
def second_process() -> Iterator[ProcessPoolExecutor]:
    """Starts a process that ignores Ctrl-C: the first process ends it."""
    spawn, others = multiprocessing.get_context("spawn"), set(multiprocessing.active_children())
    with ProcessPoolExecutor(1, spawn, initializer=signal.signal, initargs=(signal.SIGINT, signal.SIG_IGN)) as pool:
        try:
            yield pool
        except BaseException:
            for process in set(multiprocessing.active_children()) - others:  # it would continue to the end of its work
                process.terminate()
            # Python before 3.11.6 waits for ever for a large message that nobody reads any more.
            if (queue := pool._call_queue) is not None:  # type: ignore[attr-defined]  # noqa: SLF001 (None: it ends)
                queue._reader.close()  # noqa: SLF001 (as later versions do)
            pool.shutdown(cancel_futures=True)
            raise


def write_apart(path: Path, value: object) -> None:
    """Writes a value to a file for the other process. Sent in a message, large arrays would be in memory twice more."""
    buffers: list[pickle.PickleBuffer] = []
    content = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
    with path.open("wb") as file:
        pickle.dump((content, [buffer.raw().nbytes for buffer in buffers]), file)
        for buffer in buffers:
            file.write(buffer.raw())


def read_apart(path: Path) -> Any:
    """Reads what ``write_apart`` has written; arrays that were protected are so here."""
    with path.open("rb") as file:
        content, sizes = pickle.load(file)  # noqa: S301 - our own file
        buffers = [bytearray(size) for size in sizes]
        for buffer in buffers:
            file.readinto(buffer)
    return pickle.loads(content, buffers=buffers)  # noqa: S301


def share(
    tasks: Sequence[_T], here: Callable[[_T], _R], there: Callable[[_T], Future[_R]], busy: Future[Any]
) -> list[_R]:
    """Does tasks in both processes: here from the first one on, there from the last one on, until they meet.

    The second process gets one task at a time, as those in its queue cannot be taken back.

    Args:
        tasks: The tasks.
        here: Does a task in this process.
        there: Sends a task to the second process.
        busy: What the second process does before.

    Returns:
        The results, in the order of the tasks.
    """
    left, lock, sent, done = deque(range(len(tasks))), Lock(), dict[int, Future[_R]](), dict[int, _R]()

    def send(_before: Future[Any]) -> None:
        with lock:
            if not left:
                return
            try:
                sent[left[-1]] = there(tasks[left[-1]])
            except BrokenExecutor:  # it died: the task that it had tells so
                return
            last = left.pop()
        sent[last].add_done_callback(send)

    busy.add_done_callback(send)
    try:
        while True:
            with lock:
                if not left:
                    break
                first = left.popleft()
            done[first] = here(tasks[first])
    finally:
        with lock:
            left.clear()
    return [done[k] if k in done else sent[k].result() for k in range(len(tasks))]
