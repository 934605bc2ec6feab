"""Since when nobody can be in an area that the cameras watch.

The area is vacant at an instant when every camera has shown it without a body for long enough, with no gap between its
frames. From then on nobody can be further inside than they walked since. A body counts wherever a camera shows one of
its points, whether it is the person that the filter follows or somebody else; a body without any point may be anywhere.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hrcreplay.geometry.polygon import ConvexPolygon
from hrcreplay.records import NOBODY, CameraFrames, Floats, HumanStates, Ints, Measurements


@dataclass(frozen=True)
class WatchedArea:
    """What the cameras see together: whoever has any point of the body in it is shown by one of them."""

    polygon: ConvexPolygon  #: on the floor; the area has any height
    margin_m: float  #: how far inside the border somebody may be who is not shown yet [m]
    clear_s: float  #: how long all cameras must show nobody before nobody is believed to be there [s]
    gap_s: float  #: a camera whose frames are further apart did not watch between them [s]
    speed_m_per_s: float  #: at which people walk in, ISO 13855

    def reached_m(self, since_s: float | Floats) -> float | Floats:
        """How far inside the border somebody can be who was outside ``since_s`` [s] ago; inf for inf [m]."""
        return self.margin_m + self.speed_m_per_s * since_s


class VacancyState(NamedTuple):
    """What is remembered between two tables of frames; instants are captures [ns]."""

    newest_ns: tuple[int, ...]  #: camera -> its newest frame; -1 before the first
    begin_ns: tuple[int, ...]  #: camera -> since when its frames have come without a gap
    last_ns: tuple[int, int]  #: the last frame with anybody in the area, and with anybody but the person
    vacant_ns: tuple[int, int]  #: when the area was last known to be without them; -1 before the first time


def start(cameras: int) -> VacancyState:
    """Before the first frame of so many cameras."""
    return VacancyState((-1,) * cameras, (-1,) * cameras, (-1, -1), (-1, -1))


@dataclass(frozen=True)
class _Frames:
    """Bodies in order of arrival."""

    arrival_ns: Ints
    capture_ns: Ints
    camera: Ints
    depth_m: Floats  #: (n,) of the body's deepest point; -inf for a frame of nobody, inf for a body without a point
    other: Ints  #: (n,) 1 for a body that is not the person


def _frames(measured: Measurements, others: CameraFrames, area: WatchedArea) -> _Frames:
    tables = []
    for table, other in ((measured, 1), (others, 0)):
        shown = np.isfinite(table.points_m).all(axis=2) & (table.confidence > 0.0)
        depth = np.where(shown, area.polygon.depth_m(table.points_m), -np.inf).max(axis=1, initial=-np.inf)
        tables.append((table, np.where(shown.any(axis=1), depth, np.inf), 1 - other))
    depth_m = np.concatenate([depth for _, depth, _ in tables])
    depth_m[len(measured) :][others.body == NOBODY] = -np.inf
    arrival_ns = np.concatenate([table.arrival_ns for table, _, _ in tables])
    order = np.argsort(arrival_ns, kind="stable")
    return _Frames(
        arrival_ns[order],
        np.concatenate([table.capture_ns for table, _, _ in tables])[order],
        np.concatenate([table.camera for table, _, _ in tables])[order],
        depth_m[order],
        np.concatenate([np.full(len(table), other) for table, _, other in tables])[order],
    )


def watch(
    state: VacancyState, states: HumanStates, measured: Measurements, others: CameraFrames, area: WatchedArea
) -> tuple[VacancyState, HumanStates, Counter[str]]:
    """Adds to each tick since when nobody, and nobody but the person, can be in the area.

    Args:
        state: From the table before; ``start`` at the beginning.
        states: The fused person at the ticks, increasing.
        measured: Frames of the person that arrived since the tick before the first, up to the last.
        others: All other bodies, and the frames that show nobody; their points in the world [m].
        area: What is watched.

    Returns:
        The new state; ``states`` with ``nobody_s`` and ``nobody_else_s``; and the count ``watched_frames_refuting``,
        of frames that show somebody further inside than anybody could have walked since the area was vacant.
    """
    found = _frames(measured, others, area)
    counts: Counter[str] = Counter()
    ages = np.empty((len(states), 2))
    last = np.searchsorted(found.arrival_ns, states.t_ns, side="right").tolist()
    row = 0
    for tick, t_ns in enumerate(states.t_ns.tolist()):
        for k in range(row, last[tick]):
            body = int(found.capture_ns[k]), float(found.depth_m[k]), bool(found.other[k])
            if body[1] > 0.0 and _refutes(state.vacant_ns[0], *body[:2], area):
                counts["watched_frames_refuting"] += 1
            state = _met(state, int(found.camera[k]), *body, round(area.gap_s * 1e9))
        row = last[tick]
        state = _judged(state, round(area.clear_s * 1e9))
        ages[tick] = [np.inf if at < 0 else (t_ns - at) / 1e9 for at in state.vacant_ns]
    return state, replace(states, nobody_s=ages[:, 0], nobody_else_s=ages[:, 1]), counts


def _refutes(vacant_ns: int, capture_ns: int, depth_m: float, area: WatchedArea) -> bool:
    """Whether a body is where nobody can have come since the area was vacant."""
    since_s = (capture_ns - vacant_ns) / 1e9
    return vacant_ns >= 0 and since_s >= 0.0 and np.isfinite(depth_m) and bool(depth_m > area.reached_m(since_s))


def _met(state: VacancyState, camera: int, capture_ns: int, depth_m: float, other: bool, gap_ns: int) -> VacancyState:
    """The state after a body, or a frame without one."""
    newest, begin = list(state.newest_ns), list(state.begin_ns)
    if newest[camera] < 0 or capture_ns - newest[camera] > gap_ns:
        begin[camera] = capture_ns
    newest[camera] = max(newest[camera], capture_ns)
    anybody, somebody_else = state.last_ns
    if depth_m > 0.0:
        anybody = max(anybody, capture_ns)
        somebody_else = max(somebody_else, capture_ns) if other else somebody_else
    return VacancyState(tuple(newest), tuple(begin), (anybody, somebody_else), state.vacant_ns)


def _judged(state: VacancyState, clear_ns: int) -> VacancyState:
    """The state after all frames of a tick: whether the area is vacant at the newest capture that all cameras have."""
    watched_ns, begin_ns = min(state.newest_ns), max(state.begin_ns)
    if watched_ns < 0:
        return state
    anybody, somebody_else = (
        max(vacant, watched_ns) if watched_ns - max(begin_ns, last) >= clear_ns else vacant
        for last, vacant in zip(state.last_ns, state.vacant_ns, strict=True)
    )
    return state._replace(vacant_ns=(anybody, somebody_else))
