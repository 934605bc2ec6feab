"""Joint centres from rigid targets on the skin: the point that stays fixed on both of two neighbouring segments.

The symmetrical centre of rotation estimation of Ehrig et al. (2006), A survey of formal methods for determining the
centre of rotation of ball joints, J. Biomech. 39, 2798-2809; with a weak pull of the centre towards both targets,
which decides along the axis of a hinge, where the movement does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hrcreplay.records import Floats

_PULL = 0.04  # skin movement (4 mm) over the usual distance of a target from the centre (0.1 m)
_SWING = 0.05  # rad: two segments that turn less against one another tell no centre


@dataclass(frozen=True)
class Pivot:
    """A joint centre in the frames of the targets above and below it [m]."""

    above_m: Floats  # (3,)
    below_m: Floats  # (3,)

    def at(self, turn_a: Floats, place_a: Floats, turn_b: Floats, place_b: Floats) -> Floats:
        """The centre (3,) when the targets have these rotations (3, 3) and places (3,): midway of what both say."""
        return 0.5 * (turn_a @ self.above_m + place_a + turn_b @ self.below_m + place_b)


def rotations(quaternions: Floats) -> Floats:
    """Rotation matrices (n, 3, 3) of quaternions (n, 4) in the order x y z w."""
    x, y, z, w = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.moveaxis(np.array(rows), 2, 0)


def find_pivot(turns_a: Floats, places_a: Floats, turns_b: Floats, places_b: Floats) -> Pivot | None:
    """Centre about which two targets turn, least squares over a recording.

    Args:
        turns_a: (n, 3, 3) rotations of the target above, NaN where not seen.
        places_a: (n, 3) [m].
        turns_b: (n, 3, 3) of the target below.
        places_b: (n, 3) [m].

    Returns:
        The pivot, or None where the segments hardly turn against one another.
    """
    seen = np.isfinite(places_a).all(axis=1) & np.isfinite(places_b).all(axis=1)
    if seen.sum() < 10:
        return None
    A = np.concatenate([turns_a[seen], -turns_b[seen]], axis=2).reshape(-1, 6)
    y = (places_b[seen] - places_a[seen]).ravel()
    # A hinge turns two of the three directions: the fifth singular value tells whether there was a swing at all.
    if np.linalg.svd(A, compute_uv=False)[4] < _SWING * np.sqrt(seen.sum()):
        return None
    pull = _PULL * np.sqrt(seen.sum())
    centre = np.linalg.lstsq(np.vstack([A, pull * np.eye(6)]), np.concatenate([y, np.zeros(6)]), rcond=None)[0]
    return Pivot(centre[:3], centre[3:])
