"""Audit of the recorded motion alone: the first movements of limbs, and the errors of the filter's state."""

from __future__ import annotations

import numpy as np

from hrcreplay.evaluation.recorded_person import LIMB_POINTS
from hrcreplay.evaluation.recording import Recording
from hrcreplay.human.model import SHOWN_BY
from hrcreplay.records import POINTS, Floats, Ints, find_neighbours
from hrcreplay.reporting.metrics.series import difference

#: Distance of a limb's end from its first position that counts as a movement [m], and number of sightings whose median
#: is the first position.
_MOVED_M, _FIRST = 0.1, 10


def first_movements_ns(recording: Recording) -> dict[str, int | None]:
    """Limb -> time of its first movement [ns]; None if it never moved. The filter has seen no such movement before."""
    found: dict[str, int | None] = {}
    for limb, names in LIMB_POINTS.items():
        moved = np.zeros(len(recording.t_ns), dtype=bool)
        for name in names[:2]:
            points = recording.points_m[:, POINTS.index(name)]
            seen = points[np.isfinite(points).all(axis=1)]
            if len(seen):
                moved |= np.linalg.norm(points - np.median(seen[:_FIRST], axis=0), axis=1) > _MOVED_M
        found[limb] = int(recording.t_ns[np.argmax(moved)]) if moved.any() else None
    return found


#: Time difference for recorded velocities [ns], maximum gap between their recorded joints [s], and maximum time since
#: a camera saw the limb [s].
_ACROSS_NS, _GAP_S, _SEEN_S = 40_000_000, 0.1, 0.25


def errors_in_deviations(recording: Recording, ticks: Ints) -> Floats:
    """Computes the errors of the fused positions and velocities, in their standard deviations.

    Args:
        recording: The log.
        ticks: (n,) rows of ``recording.states``.

    Returns:
        (2, n, 13), positions before velocities; NaN if the joint was not recorded or not seen recently.
    """
    t_ns, joints, states = recording.joints_t_ns, recording.joints, recording.states.rows(ticks)

    def recorded(at_ns: Ints) -> Floats:
        before, after, share, known = find_neighbours(t_ns, at_ns, _GAP_S)
        between = joints[before] + share[:, None] * difference(joints[after], joints[before])
        return np.where(known[:, None], between, np.nan)

    later, earlier = recorded(states.t_ns + _ACROSS_NS // 2), recorded(states.t_ns - _ACROSS_NS // 2)
    velocity = difference(later, earlier) / (_ACROSS_NS * 1e-9)
    found = np.stack([difference(states.p, recorded(states.t_ns)) / states.p_std, (states.v - velocity) / states.v_std])
    return np.where((states.unseen_s <= _SEEN_S)[:, SHOWN_BY], found, np.nan)
