"""The place of the control process before others: its priority, and memory that no cycle has to wait for."""

from __future__ import annotations

import ctypes
import os
import resource
from contextlib import suppress

_RANK = 50  # of SCHED_FIFO, 1 to 99
_LOCK_CURRENT_AND_FUTURE = 3
_TRIM_THRESHOLD, _MMAP_MAX = -1, -4  # of mallopt
_SPARE = 16 << 20  #: free end of the heap, several times what a cycle needs [bytes]


def raise_priority() -> list[str]:
    """Asks the system to run this process before others and to keep it in memory; returns what was refused."""
    refused = []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_RANK))
    except (OSError, AttributeError):
        refused.append("real-time priority")
    library = ctypes.CDLL(None)
    if not hasattr(library, "mlockall") or library.mlockall(_LOCK_CURRENT_AND_FUTURE):
        refused.append("locked memory")
    if hasattr(library, "mallopt"):
        _keep_heap(library)
    return refused


def restore_priority() -> None:
    """Undoes ``raise_priority``."""
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    library = ctypes.CDLL(None)
    with suppress(AttributeError):
        library.munlockall()
    with suppress(AttributeError):
        library.mallopt(_TRIM_THRESHOLD, 128 << 10)
        library.mallopt(_MMAP_MAX, 1 << 16)


def _keep_heap(library: ctypes.CDLL) -> None:
    """Gives the heap of the C library a free end and keeps it, so that no cycle has to wait for memory of the system.

    The library returns the free end on its own, and because protobuf calls ``malloc_trim`` every 10,000 messages. It
    does not do so if somebody else has moved the program's break behind it.
    """
    malloc, free, sbrk = library.malloc, library.free, library.sbrk
    malloc.restype = sbrk.restype = ctypes.c_void_p
    malloc.argtypes, free.argtypes, sbrk.argtypes = [ctypes.c_size_t], [ctypes.c_void_p], [ctypes.c_ssize_t]
    library.mallopt(_MMAP_MAX, 0)  # large blocks come from the heap, too
    library.mallopt(_TRIM_THRESHOLD, -1)
    end, blocks = sbrk(0), list[int | None]()
    while sbrk(0) == end and len(blocks) < 64:  # the first ones may fit between others
        blocks.append(malloc(_SPARE))
    for block in blocks:
        free(block)
    sbrk(resource.getpagesize())
