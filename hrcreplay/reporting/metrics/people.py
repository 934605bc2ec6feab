"""Metrics of each of several people: when the person was known, how near the robot came, and how well it was held."""

from __future__ import annotations

import numpy as np
import pandas as pd

from hrcreplay.records import of_person
from hrcreplay.reporting.metrics.contact import method_prefixes
from hrcreplay.reporting.metrics.planning import numeric_column
from hrcreplay.reporting.metrics.series import MetricTable, times
from hrcreplay.store.run_folder import Run
from hrcreplay.store.stored_table import RunTable, rows_where

#: Name of the metric that counts them, where there are several.
TRACKED = "people_tracked"


def named_volumes(occupancy: RunTable | None) -> RunTable | None:
    """Returns the volumes of all people, each limb named with its person; the table itself for one person."""
    if occupancy is None or "person" not in occupancy:
        return occupancy
    limb, limbs = pd.factorize(occupancy["limb"])
    pairs, which = np.unique(occupancy["person"].to_numpy(dtype=np.int64) * len(limbs) + limb, return_inverse=True)
    names = [of_person(str(limbs[k % len(limbs)]), k // len(limbs)) for k in pairs.tolist()]
    return occupancy.assign(limb=np.array(names, dtype=object)[which])  # each name is in memory once


def most_tracked(run: Run, most: int) -> tuple[int, ...]:
    """Numbers of the first person and of the others who were tracked for longest, ``most`` in all."""
    if run.state is None or len(run.people) <= most:
        return run.people
    first, *others = run.people
    ticks = np.bincount(run.state["person"].to_numpy(dtype=np.int64))
    longest = sorted(others, key=lambda number: (-ticks[number], number))[: most - 1]
    return first, *sorted(longest)


def add_people(metrics: MetricTable, run: Run) -> None:
    """Adds the metrics of each person, and of all together; nothing for a run with one person.

    Args:
        metrics: Table that the metrics are added to.
        run: The run's tables, with all people.
    """
    if len(run.people) < 2 or run.state is None:
        return
    metrics.add(TRACKED, len(run.people), "1", "people tracked, each with a filter and volumes of its own")
    brief = run.counts.get("bodies_seen_briefly", 0)
    metrics.add(
        "bodies_seen_briefly", brief, "1", "bodies seen too briefly for that: they counted by their points alone"
    )
    prefixes, contact = method_prefixes(run), run.contact
    by_method = {} if contact is None else {method: rows_where(contact, "method", method) for method in prefixes}
    for number in run.people:
        _add_times(metrics, number, run.state[run.state["person"] == number], run.state)
        for method, rows in by_method.items():
            if prefixes[method] == "plan":
                _add_held(metrics, number, rows)
            _add_distance(metrics, f"{prefixes[method]}_person_{number}", rows, number)


def _add_times(metrics: MetricTable, number: int, rows: RunTable, state: RunTable) -> None:
    """Adds from when to when the person is there, and the share of these ticks with a fused state."""
    known = np.isfinite(numeric_column(rows, "x"))
    seconds = (times(rows) - times(state)[0]) * 1e-9
    for end, at_s in (("from", seconds[0]), ("until", seconds[-1])):
        metrics.add(
            f"person_{number}_{end}_s", float(at_s), "s", f"person {number} is tracked {end} then on this clock"
        )
    metrics.add(
        f"person_{number}_fused_share",
        float(known.mean()),
        "1",
        f"share of the ticks of person {number} with a fused state; at the others the body counts by its points alone",
    )


def _add_distance(metrics: MetricTable, stem: str, rows: RunTable, number: int) -> None:
    """Adds the smallest distance of the moving robot, and its contacts."""
    column = f"person_{number}_m"
    if column not in rows:
        return
    moving = rows["moving"].to_numpy(dtype=bool)
    apart = numeric_column(rows, column)
    near = apart[moving & np.isfinite(apart)]
    metrics.add(
        f"{stem}_distance_min_moving_m",
        float(near.min()) if len(near) else None,
        "m",
        f"smallest distance between the surfaces of the moving robot and person {number}",
        reason="the robot never moved while this person was known",
    )
    metrics.add(
        f"{stem}_touch_ticks",
        int((near <= 0.0).sum()),
        "1",
        f"ticks with a moving link in contact with person {number}",
    )


def _add_held(metrics: MetricTable, number: int, rows: RunTable) -> None:
    """Adds the share of the checked ticks at which the person stayed inside the volumes."""
    for name, column in (("volumes", "left_person"), ("volumes_full", "left_full_person")):
        if f"{column}_{number}_m" not in rows:
            continue
        out_m = numeric_column(rows, f"{column}_{number}_m")
        out_m = out_m[np.isfinite(out_m)]
        until = "the tick's horizon" if name == "volumes" else "the braking time T_s"
        reason = f"at no tick was a limb of person {number} seen near the end of {until}"
        checked = len(out_m) or None
        metrics.add(
            f"person_{number}_{name}_checked_ticks",
            checked,
            "1",
            f"as {name}_checked_ticks, of person {number}",
            reason=reason,
        )
        metrics.add(
            f"person_{number}_{name}_held_share",
            float((out_m <= 0.0).mean()) if len(out_m) else None,
            "1",
            f"share of those ticks at which every limb of person {number} that was seen stayed inside until {until}",
            reason=reason,
        )
