"""Holds what was predicted at a tick against what the person did within the horizon."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hrcreplay.audit.recording import Recording
from hrcreplay.human.containment import Solid, union_volume_m3
from hrcreplay.human.reach import Reach
from hrcreplay.pipeline import Foresight
from hrcreplay.records import LIMBS, POINTS, Bools, Floats, HumanStates, Ints, SweptVolumes
from hrcreplay.report.audit_metrics import Outcome
from hrcreplay.report.series import difference

#: Recorded points of a limb. The first two, its ends, must have been seen near the end of the horizon, or the limb is
#: not checked.
LIMB_POINTS = {
    "HD": ("neck", "head"),
    "THX": ("pelvis", "shoulder_r", "shoulder_l"),
    "URA": ("shoulder_r", "elbow_r"),
    "LRA": ("elbow_r", "wrist_r", "hand_r"),
    "ULA": ("shoulder_l", "elbow_l"),
    "LLA": ("elbow_l", "wrist_l", "hand_l"),
    "LEGS": tuple(f"{part}_{side}" for part in ("hip", "knee", "ankle", "foot") for side in "rl"),
}
#: The end of the horizon: its last quarter. A limb that was last seen before could have left later.
_END = 0.75
#: Points with which the union of a tick's volumes is counted out.
_COUNT = 1024
_SHOULDERS = [POINTS.index(f"shoulder_{side}") for side in "lr"]


def standstill_s(foresight: Foresight) -> float:
    """How long the person must stay in what was predicted: until the robot has reacted and braked [s]."""
    return foresight.horizon_s + foresight.margins.latency_s


@dataclass(frozen=True)
class Window:
    """The recorded future of some ticks."""

    states: HumanStates  #: (n,) the fused person at the ticks
    limbs: dict[str, Floats]  #: limb -> (m, k, 3) its recorded points, world [m]
    first: Ints  #: (n,) row of the first recorded instant after the tick
    last: Ints  #: (n,) row past the last one within the horizon
    seen: dict[str, Bools]  #: limb -> (n, k) whether a point was seen in the last quarter of the horizon

    def rows(self, which: slice | Ints) -> Window:
        """The same for some of the ticks."""
        seen = {limb: part[which] for limb, part in self.seen.items()}
        return Window(self.states.rows(which), self.limbs, self.first[which], self.last[which], seen)

    def checked(self, limb: str) -> Bools:
        """(n,) whether the limb can be checked: both its ends were seen near the horizon's end."""
        return np.asarray(self.seen[limb][:, :2].all(axis=1))

    def points(self) -> dict[str, dict[str, int]]:
        """Limb -> each point beyond its ends -> at how many of the ticks that check the limb it was seen too."""
        return {
            limb: {
                point: int((self.seen[limb][:, 2 + k] & self.checked(limb)).sum()) for k, point in enumerate(names[2:])
            }
            for limb, names in LIMB_POINTS.items()
        }


def window(recording: Recording, ticks: Ints, horizon_s: float) -> Window:
    """The recorded future (t, t + T] of some ticks.

    Args:
        recording: The log.
        ticks: (n,) rows of ``recording.states``.
        horizon_s: T, T_s and the latency [s].
    """
    points = recording.points_m.copy()
    # the model's neck is the middle of the shoulders, not the bone that cameras call so
    points[:, POINTS.index("neck")] = 0.5 * (points[:, _SHOULDERS[0]] + points[:, _SHOULDERS[1]])
    limbs = {
        limb: np.ascontiguousarray(points[:, [POINTS.index(n) for n in names]]) for limb, names in LIMB_POINTS.items()
    }
    states = recording.states.rows(ticks)
    horizon_ns = round(horizon_s * 1e9)
    first = np.searchsorted(recording.t_ns, states.t_ns, side="right")
    last = np.searchsorted(recording.t_ns, states.t_ns + horizon_ns, side="right")
    end = np.searchsorted(recording.t_ns, states.t_ns + round(_END * horizon_ns), side="right")
    return Window(states, limbs, first, last, {limb: _seen(part, end, last) for limb, part in limbs.items()})


def _seen(recorded: Floats, first: Ints, last: Ints) -> Bools:
    """(n, k) whether each of the points (m, k, 3) was recorded in any row from ``first`` (n,) up to ``last`` (n,)."""
    count = np.zeros((len(recorded) + 1, recorded.shape[1]), np.int64)
    np.cumsum(np.isfinite(recorded).all(axis=2), axis=0, out=count[1:])
    return np.asarray(count[last] > count[first])


def hold(volumes: SweptVolumes, future: Window, counted: Bools, first_sample: int = 0) -> Outcome:
    """One method's volumes against the recorded future.

    Args:
        volumes: Of the n ticks.
        future: Of the same ticks.
        counted: (n,) the ticks whose union is counted out.
        first_sample: Number of ticks counted before, see ``union_volume_m3``.
    """
    n, limbs = len(volumes), volumes.limbs
    beyond, size = np.full((n, len(limbs)), np.nan), np.full((n, len(limbs)), np.nan)
    union, union_std, upper, upper_std = np.full((4, n), np.nan)
    checked = np.column_stack([future.checked(limb) for limb in limbs])
    for i in range(n):
        solids = []
        for k, limb in enumerate(limbs):
            vertices = volumes.vertices(i, k)
            if np.isnan(vertices).any():
                continue
            solid = Solid.around(vertices, float(volumes.radius_m[i, k]))
            size[i, k] = solid.volume_m3()
            solids.append(solid)
            if checked[i, k]:
                beyond[i, k] = _farthest(solid, future, i, limb)
        if counted[i] and len(solids) == len(limbs):
            upper[i], upper_std[i] = union_volume_m3(solids[: len(LIMBS)], _COUNT, _COUNT * (first_sample + i))
            union[i], union_std[i] = upper[i], upper_std[i]
            if len(limbs) > len(LIMBS):
                union[i], union_std[i] = union_volume_m3(solids, _COUNT, _COUNT * (first_sample + i))
    radius = np.array(volumes.radius_m)
    return Outcome(volumes.t_ns, beyond, radius, size, union, union_std, upper, upper_std, limbs)


def _farthest(solid: Solid, future: Window, tick: int, limb: str) -> float:
    """How far the recorded points of a limb, some of them seen, get from a hull [m]."""
    points = future.limbs[limb][future.first[tick] : future.last[tick]].reshape(-1, 3)
    return float(np.nanmax(solid.distances_m(points)))


def joints_inside(recording: Recording, states: HumanStates, reach: Reach, horizon_s: float) -> Floats:
    """(n, 12) whether each joint's recorded future stayed in its reachable interval: 1, 0, or NaN where not recorded.

    Args:
        recording: The log.
        states: (n,) the fused person at the ticks.
        reach: Of the same ticks.
        horizon_s: T, T_s and the latency [s].
    """
    t_ns = recording.joints_t_ns
    first = np.searchsorted(t_ns, states.t_ns, side="right")
    last = np.searchsorted(t_ns, states.t_ns + round(horizon_s * 1e9), side="right")
    count = last - first
    tick = np.repeat(np.arange(len(states)), count)
    row = np.arange(len(tick)) - np.repeat(np.cumsum(count) - count, count) + first[tick]
    moved = difference(recording.joints[row], states.p[tick])
    low, high = reach.low - states.p, reach.high - states.p
    out = ((moved < low[tick] - 1e-9) | (moved > high[tick] + 1e-9)).astype(float)
    known = np.isfinite(moved) & np.isfinite(low[tick])
    left, seen = np.zeros((len(states), 12)), np.zeros((len(states), 12))
    np.add.at(left, tick, np.where(known, out, 0.0))
    np.add.at(seen, tick, known.astype(float))
    return np.where(seen > 0.0, (left == 0.0).astype(float), np.nan)


def travel(joints: Floats) -> Floats:
    """(12,) how far each joint went, between the 5th and the 95th percentile of its values [m, m, rad...]."""
    known = joints[np.isfinite(joints).all(axis=1)]
    if len(known) < 2:
        return np.full(joints.shape[1], np.nan)
    from_first = difference(known, np.repeat(known[:1], len(known), axis=0))
    low, high = np.quantile(from_first, [0.05, 0.95], axis=0)
    found: Floats = high - low
    return found
