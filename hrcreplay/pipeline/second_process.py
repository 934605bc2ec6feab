"""A second process, on the other core, for work that does not depend on the rest of a run; it changes no result."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager

#: Least number of ticks of a run with a second process, which takes seconds to start.
MANY = 5000


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
            pool.shutdown(cancel_futures=True)
            raise
