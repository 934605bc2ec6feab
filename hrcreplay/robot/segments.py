"""Link segments: the capsules that stand for a robot's links."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hrcreplay.robot.capsule import capsule_m3

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Segment:
    """A capsule around one link. Both ends are fixed on the same body, as the derivation of Eq. (5) needs."""

    name: str
    body: str  #: URDF link or joint whose frame the ends are given in
    start_m: Vector  #: first end in the body's frame [m]
    end_m: Vector  #: second end in the body's frame [m]
    radius_m: float
    shape_m3: float = math.nan  #: volume of the collision shape's convex hull inside it; NaN where it was given [m^3]

    @property
    def volume_m3(self) -> float:
        """Volume of the capsule [m^3]."""
        return capsule_m3(math.dist(self.start_m, self.end_m), self.radius_m)
