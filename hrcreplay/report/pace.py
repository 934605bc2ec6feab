"""The pace that a robot kept: how far it came itself along its programme, in the programme's own time.

The reference may run ahead of the robot (by the leash, or without end where it does not wait), so its time says nothing
of the way that was made. Counted is the robot's foot on the programmed path: the nearest point of the next stretch of
it, which never goes back and never passes the reference. What the programme takes to the foot is the time reached.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from hrcreplay.records import Floats, Ints
from hrcreplay.report.series import times

#: Less way than this is rounding [m].
_ROUNDING_M = 1e-9
#: Where the programme stands, a TCP this near is there, and its standing counts [m].
_THERE_M = 1e-3
#: The foot is sought anew when the TCP has gone so far: a robot that waits costs no time [m].
_STEP_M = 1e-3


@dataclass(frozen=True)
class Programme:
    """The programmed path as far as the reference went, without the points at which it stood."""

    points_m: Floats  #: (m, 3) world [m]
    way_m: Floats  #: (m,) along the path from its first point [m]
    from_s: Floats  #: (m,) programmed time of the arrival at a point [s]
    until_s: Floats  #: (m,) and of the departure; later where the programme stands there [s]
    at: Ints  #: (n,) the reference's point at each tick


def programme(ref_m: Floats, programme_s: Floats) -> Programme:
    """The path that references (n, 3) [m] of programmed times (n,) [s] went along; at least one row, all finite."""
    steps = np.linalg.norm(np.diff(ref_m, axis=0), axis=1)
    moved = np.concatenate([[True], steps > _ROUNDING_M])
    first = np.flatnonzero(moved)
    last = np.append(first[1:], len(ref_m)) - 1
    points = ref_m[first]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return Programme(points, way, programme_s[first], programme_s[last], np.cumsum(moved) - 1)


def foot(path: Programme, tcp_m: Floats, ahead_m: float) -> tuple[int, float]:
    """How far along the path a TCP came in the end.

    Args:
        path: The programmed path.
        tcp_m: (n, 3) the TCP at the ticks of ``path.at`` [m].
        ahead_m: The foot is sought on the next so much of the way, so that it does not pass over a part of the
            programme that was left out to where the path comes by again [m].

    Returns:
        The point of the path that was passed last, and the share of the way to the next one.
    """
    passed, share, before = 0, 0.0, tcp_m[0]
    for tick, (tcp, reference) in enumerate(zip(tcp_m, path.at.tolist(), strict=True), start=1):
        waits = tick < len(tcp_m) and ((tcp - before) ** 2).sum() < _STEP_M**2
        if waits or passed == reference:
            continue
        before = tcp
        here_m = path.way_m[passed] + share * (path.way_m[passed + 1] - path.way_m[passed])
        end = min(reference, max(passed + 1, int(np.searchsorted(path.way_m, here_m + ahead_m))))
        start = path.points_m[passed:end]
        along = path.points_m[passed + 1 : end + 1] - start
        part = np.clip(((tcp - start) * along).sum(axis=1) / (along**2).sum(axis=1), 0.0, 1.0)
        part[0] = max(part[0], share)
        nearest = int(np.argmin(((start + part[:, None] * along - tcp) ** 2).sum(axis=1)))
        passed, share = passed + nearest, float(part[nearest])
        if share == 1.0:
            passed, share = passed + 1, 0.0
    return passed, share


def reached_s(path: Programme, passed: int, share: float) -> float:
    """Programmed time from the start to a foot [s]; exactly 0 for a robot that made no way."""
    if passed + 1 == len(path.way_m):
        made_m, time_s = path.way_m[passed], path.until_s[passed]
    else:
        made_m = path.way_m[passed] + share * (path.way_m[passed + 1] - path.way_m[passed])
        time_s = path.until_s[passed] + share * (path.from_s[passed + 1] - path.until_s[passed])
        near = np.flatnonzero((path.way_m >= made_m) & (path.way_m <= made_m + _THERE_M))
        stands = near[path.until_s[near] > path.from_s[near]]
        time_s = max(time_s, *path.until_s[stands], -np.inf)
    return float(time_s - path.from_s[0]) if made_m > _ROUNDING_M else 0.0


def pace(motion: pd.DataFrame, ahead_m: float) -> tuple[float, float] | None:
    """Programmed time that the robot reached, and the time that it had [s]; None where its programme only stands.

    Args:
        motion: A table of motion.
        ahead_m: As for ``foot``: the leash [m].
    """
    names = ["programme_s", *(f"{what}_{axis}" for what in ("ref", "tcp") for axis in "xyz")]
    rows = motion[names].to_numpy(dtype=float)
    rows, t_ns = rows[np.isfinite(rows).all(axis=1)], times(motion)
    if len(rows) < 2:
        return None
    given_s = float(t_ns[-1] - t_ns[0]) * 1e-9
    path = programme(rows[:, 1:4], rows[:, 0])
    waited_s = given_s - (rows[-1, 0] - rows[0, 0])
    if len(path.way_m) == 1 and waited_s < 1e-6:
        return None
    return min(reached_s(path, *foot(path, rows[:, 4:], ahead_m)), given_s), given_s
