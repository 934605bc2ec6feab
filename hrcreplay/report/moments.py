"""Instants of a run: when its clock starts, and the moments that figures show."""

from __future__ import annotations

import numpy as np
import pandas as pd

from hrcreplay.records import JOINTS, Ints
from hrcreplay.report.metrics import columns, times
from hrcreplay.store.run_folder import Run

#: Columns of the arms' joints.
_ARMS = [i for i, joint in enumerate(JOINTS) if joint.startswith("a")]


def start_ns(run: Run) -> int:
    """The instant that the report's clock counts from: the first tick, else the first frame [ns]."""
    if run.state is not None and len(run.state):
        return int(times(run.state)[0])
    if run.motion is not None and len(run.motion):
        return int(times(run.motion)[0])
    if run.measurements is not None and len(run.measurements):
        return int(times(run.measurements, "capture_ns").min())
    return 0


def known_ticks_ns(run: Run) -> Ints:
    """Ticks at which the person is known [ns]."""
    if run.state is None:
        return np.zeros(0, dtype=np.int64)
    return times(run.state)[np.isfinite(columns(run.state)).all(axis=1)]


def moment_ns(run: Run) -> int | None:
    """The tick with the smallest separation of the plan or, without one, the fastest arm [ns]; None without a person.

    The person is known there.
    """
    known_ns = known_ticks_ns(run)
    if run.state is None or not len(known_ns):
        return None
    if run.motion is not None and run.motion["distance_m"].notna().any():
        moment = int(times(run.motion)[nearest_tick(run.motion)])
    else:
        speed = np.abs(columns(run.state, "_vel")[:, _ARMS]).sum(axis=1)
        moment = int(times(run.state)[int(np.argmax(np.where(np.isfinite(speed), speed, -1.0)))])
    return int(known_ns[int(np.argmin(np.abs(known_ns - moment)))])


def instants(run: Run, count: int = 4, step_s: float = 1.0) -> Ints:
    """(count,) ticks for Fig. 17, ``step_s`` apart, that end one step after the nearest or liveliest moment [ns].

    Empty where the person is not known at that many ticks.
    """
    moment, known_ns = moment_ns(run), known_ticks_ns(run)
    if moment is None or len(known_ns) < 2:
        return np.zeros(0, dtype=np.int64)
    step_ns = round(step_s * 1e9)
    first_ns = max(moment - (count - 2) * step_ns, int(known_ns[0]))
    wanted_ns = first_ns + step_ns * np.arange(count)
    nearest = np.clip(np.searchsorted(known_ns, wanted_ns), 0, len(known_ns) - 1)
    found = known_ns[nearest]
    return found if len(np.unique(found)) == count else np.zeros(0, dtype=np.int64)


def nearest_tick(motion: pd.DataFrame) -> int:
    """Row of the smallest separation of a plan; the first where none is known."""
    distance_m = motion["distance_m"].to_numpy(dtype=float)
    return int(np.argmin(np.where(np.isnan(distance_m), np.inf, distance_m)))
