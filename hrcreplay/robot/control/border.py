"""The border of a watched area as obstacles: walls that move inwards from its sides at walking speed.

Everything behind a wall is a half-space, but the robot reaches only a part of it. By Eq. (16) a vertex bounds the
robot's speed more if it is further away. Therefore a wall is a box that is only as large as the robot's reach.
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
    """The sides of a convex polygon around a robot, as walls over the full height of the robot's reach."""

    normals: Floats  #: (k, 3) unit vectors that point outwards, horizontal
    room_m: Floats  #: (k,) distance from the robot's base to each side; negative if the base is outside [m]
    base_m: Floats  #: (3,) world [m]
    reach_m: float  #: upper bound of the distance from the base to a point of a link's axis [m]

    @classmethod
    def around(cls, robot: RobotModel, polygon: ConvexPolygon) -> Border:
        """The border of an area around a robot."""
        base_m = robot.T_world_base[:3, 3]
        normals = np.column_stack((polygon.normals, np.zeros(len(polygon.normals))))
        return cls(normals, np.asarray(polygon.offsets_m - normals @ base_m), base_m, robot.span_m)

    def walls(self, depth_m: float) -> Floats:
        """(8 k, 3) vertices of the walls, wall after wall, after they have moved inwards by ``depth_m`` [m].

        Every wall is so thick that the robot cannot reach a point behind it.
        """
        front = self.room_m - depth_m
        back = np.maximum(front + THIN_M, self.reach_m)
        across = np.column_stack((-self.normals[:, 1], self.normals[:, 0], np.zeros(len(self.normals))))
        faces = self.reach_m * (_CORNERS[:, :1] * across[:, None] + _CORNERS[:, 1:] * np.array([0.0, 0.0, 1.0]))
        ends = np.stack((front, back), axis=1)[:, :, None, None] * self.normals[:, None, None]
        return np.asarray((self.base_m + ends + faces[:, None]).reshape(-1, 3))

    def obstacles(self, depth_m: float, horizon_s: float, person: Obstacles | int) -> Obstacles:
        """The walls as obstacles, alone or after the volumes of a person.

        Args:
            depth_m: Distance by which the walls have moved inwards; if a wall reaches the robot's base, the obstacles
                are unknown [m].
            horizon_s: Time from the tick on for which the walls are valid [s].
            person: The person's volumes; without a person, the number of volumes that a person has.
        """
        count = len(self.normals)
        if not depth_m < self.room_m.min():
            depth_m = np.nan  # the vertices become NaN, too
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
    around, known = boxes(vertices, offsets, radius)
    return Obstacles(vertices, offsets, radius, around, known, horizon_s, first)
