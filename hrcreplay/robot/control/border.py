"""The border of a watched area as obstacles: walls that come in from its sides as fast as people walk.

Behind a wall is a half-space. A robot only reaches a part of it, and the vertices of a volume bound its speed the more
the further away they are, Eq. (16), so a wall is a box that is as large as the robot's reach and no larger.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hrcreplay.geometry.polygon import ConvexPolygon
from hrcreplay.records import Floats, Ints
from hrcreplay.robot.control.separation import Obstacles, boxes
from hrcreplay.robot.model import RobotModel

#: Thickness of a wall that the robot cannot touch [m].
THIN_M = 0.05
_CORNERS = np.array([(across, up) for across in (-1.0, 1.0) for up in (-1.0, 1.0)])


@dataclass(frozen=True)
class Border:
    """The sides of a convex polygon around a robot, each a wall from below its reach to above."""

    normals: Floats  #: (k, 3) unit vectors that point outwards, horizontal
    room_m: Floats  #: (k,) from the robot's base to each side; negative where the base is outside [m]
    base_m: Floats  #: (3,) world [m]
    reach_m: float  #: no point of a link's axis is further from the base [m]

    @classmethod
    def around(cls, robot: RobotModel, polygon: ConvexPolygon) -> Border:
        """The border of an area around a robot."""
        base_m = robot.T_world_base[:3, 3]
        normals = np.column_stack((polygon.normals, np.zeros(len(polygon.normals))))
        return cls(normals, np.asarray(polygon.offsets_m - normals @ base_m), base_m, robot.span_m)

    def walls(self, depth_m: float) -> Floats:
        """(8 k, 3) vertices, wall after wall, that have come in by ``depth_m`` [m].

        A wall is deep enough that no point which the robot can reach lies behind it, wherever it has come to.
        """
        front = self.room_m - depth_m
        back = np.maximum(front + THIN_M, self.reach_m)
        across = np.column_stack((-self.normals[:, 1], self.normals[:, 0], np.zeros(len(self.normals))))
        faces = self.reach_m * (_CORNERS[:, :1] * across[:, None] + _CORNERS[:, 1:] * np.array([0.0, 0.0, 1.0]))
        ends = np.stack((front, back), axis=1)[:, :, None, None] * self.normals[:, None, None]
        return np.asarray((self.base_m + ends + faces[:, None]).reshape(-1, 3))

    def obstacles(self, depth_m: float, horizon_s: float, person: Obstacles | int) -> Obstacles:
        """The walls alone, or behind the volumes of a person.

        Args:
            depth_m: How far they have come in. One that has come to the robot's base says no more than that nothing is
                known [m].
            horizon_s: Until when that holds, from the tick on [s].
            person: The person's volumes; or how many of them there would be, where nobody is there.
        """
        count = len(self.normals)
        if not depth_m < self.room_m.min():
            depth_m = np.nan  # and so are the vertices
        vertices, offsets, radius = self.walls(depth_m), np.arange(0, 8 * count + 1, 8), np.zeros(count)
        if isinstance(person, int):
            return _obstacles(vertices, offsets, radius, horizon_s, person)
        return _obstacles(
            np.concatenate((person.vertices_m, vertices)),
            np.concatenate((person.offsets, person.offsets[-1] + offsets[1:])),
            np.concatenate((person.radius_m, radius)),
            horizon_s,
            0,
        )


def _obstacles(vertices: Floats, offsets: Ints, radius: Floats, horizon_s: float, first: int) -> Obstacles:
    for array in (vertices, radius):  # as those of a person alone, or numba would compile all kernels again
        array.setflags(write=False)
    around, known = boxes(vertices, offsets, radius)
    return Obstacles(vertices, offsets, radius, around, known, horizon_s, first)
