"""The stops of a method, and its contacts with the recorded body, as a list of events for the reader."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from hrcreplay.records import Bools, Ints
from hrcreplay.report.metrics import durations_s, times, true_runs
from hrcreplay.report.metrics_plan import is_moving, numeric_column

#: Two events of one kind that are nearer to each other are one [s].
_MERGED_S = 0.2


@dataclass(frozen=True)
class StopEvent:
    """A full stop, or a contact of the moving robot with the body."""

    kind: str  #: "stop" or "touch"
    at_s: float  #: by the report's clock [s]
    moving_s: float  #: braking with the robot still moving, or moving in contact [s]
    rest_s: float  #: at rest after a stop, before it moved again [s]
    speed_m_per_s: float  #: of the TCP where a stop began; the fastest contact
    distance_m: float  #: to the volumes where a stop began; to the body, deepest, in a contact; NaN: not known [m]
    link: str
    limb: str
    reason: str


def stop_events(
    motion: pd.DataFrame, contact: pd.DataFrame | None, t0_ns: int, slow_m_per_s: float
) -> tuple[StopEvent, ...]:
    """The events of a method, in order of time.

    Args:
        motion: The method's table.
        contact: Its rows of contact.parquet; None without a comparison.
        t0_ns: Instant of time zero [ns].
        slow_m_per_s: A TCP slower than this stands, where no joint turns [m/s].
    """
    found = _stops(motion, t0_ns, slow_m_per_s)
    if contact is not None and len(contact):
        found += _touches(contact, t0_ns)
    return tuple(sorted(found, key=lambda event: (event.at_s, event.kind)))


def _stops(motion: pd.DataFrame, t0_ns: int, slow: float) -> list[StopEvent]:
    t_ns, lasts_s = times(motion), durations_s(times(motion))
    moving = is_moving(motion, slow)
    braking = motion["status"].astype(str).to_numpy() == "braking"
    speed, distance = (numeric_column(motion, name) for name in ("tcp_speed", "distance_m"))
    stopping = braking & moving
    found = []
    for first, last in _merged(stopping, t_ns):
        goes_on = np.flatnonzero(moving[last:])
        again = last + int(goes_on[0]) if len(goes_on) else len(t_ns)
        row = motion.iloc[first]
        found.append(
            StopEvent(
                kind="stop",
                at_s=float((t_ns[first] - t0_ns) * 1e-9),
                moving_s=float(lasts_s[first:last][stopping[first:last]].sum()),
                rest_s=float(lasts_s[last:again].sum()),
                speed_m_per_s=float(speed[first]),
                distance_m=float(distance[first]),
                link=_text(row.get("link")),
                limb=_text(row.get("limb")),
                reason=_text(row.get("reason")),
            )
        )
    return found


def _touches(contact: pd.DataFrame, t0_ns: int) -> list[StopEvent]:
    t_ns, lasts_s = times(contact), durations_s(times(contact))
    distance, speed = (numeric_column(contact, name) for name in ("distance_m", "contact_speed"))
    touching = contact["moving"].to_numpy(dtype=bool) & (distance <= 0.0)
    found = []
    for first, last in _merged(touching, t_ns):
        at = first + int(np.nanargmin(np.where(touching[first:last], distance[first:last], np.inf)))
        row = contact.iloc[at]
        found.append(
            StopEvent(
                kind="touch",
                at_s=float((t_ns[first] - t0_ns) * 1e-9),
                moving_s=float(lasts_s[first:last][touching[first:last]].sum()),
                rest_s=0.0,
                speed_m_per_s=float(speed[first:last][touching[first:last]].max()),
                distance_m=float(distance[at]),
                link=_text(row.get("link")),
                limb=_text(row.get("limb")),
                reason="",
            )
        )
    return found


def _merged(mask: Bools, t_ns: Ints) -> list[tuple[int, int]]:
    """Runs of true as (first, past the last), short breaks between them left out."""
    found: list[tuple[int, int]] = []
    for first, last in true_runs(mask).tolist():
        if found and t_ns[first] - t_ns[found[-1][1] - 1] <= _MERGED_S * 1e9:
            found[-1] = (found[-1][0], last)
        else:
            found.append((first, last))
    return found


def _text(value: object) -> str:
    return value if isinstance(value, str) else ""
