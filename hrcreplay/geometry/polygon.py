"""A convex polygon on the floor, and the depth of points in the vertical prism over it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hrcreplay.records import Floats


@dataclass(frozen=True)
class ConvexPolygon:
    """A convex polygon as the lines of its sides: ``normals @ p <= offsets_m`` holds inside."""

    normals: Floats  #: (k, 2) unit vectors that point outwards
    offsets_m: Floats  #: (k,) of each side's line along its normal [m]

    @classmethod
    def of_corners(cls, corners_m: Floats) -> ConvexPolygon:
        """Makes a polygon from its corners, in either direction.

        Args:
            corners_m: (k, 2) corners in order around the polygon [m].

        Raises:
            ValueError: There are fewer than three corners, or the polygon is not convex.
        """
        corners = np.asarray(corners_m, dtype=float)
        if len(corners) < 3:
            raise ValueError(f"{len(corners)} corners")
        sides = np.roll(corners, -1, axis=0) - corners
        following = np.roll(sides, -1, axis=0)
        turns = sides[:, 0] * following[:, 1] - sides[:, 1] * following[:, 0]
        once_around = np.arctan2(turns, (sides * following).sum(axis=1)).sum()  # a star turns one way, but twice
        same_way = (turns > 0.0).all() or (turns < 0.0).all()
        if not (np.isfinite(turns).all() and same_way and abs(abs(once_around) - 2.0 * np.pi) < 1e-6):
            raise ValueError("no convex polygon")
        outwards = np.sign(turns[0]) * np.column_stack((sides[:, 1], -sides[:, 0]))
        normals = outwards / np.linalg.norm(outwards, axis=1, keepdims=True)
        return cls(normals, (normals * corners).sum(axis=1))

    def depth_m(self, points_m: Floats) -> Floats:
        """(...) depth of points (..., 2 or more) inside, at any height; negative outside, NaN if unknown [m]."""
        across = points_m[..., 0, None] * self.normals[:, 0] + points_m[..., 1, None] * self.normals[:, 1]
        return np.asarray((self.offsets_m - across).min(axis=-1))
