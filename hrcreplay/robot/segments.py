"""Link segments: the capsules that stand for a robot's links."""

from __future__ import annotations

from dataclasses import dataclass

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Segment:
    """A capsule around one link. Both ends are fixed on the same body, as the derivation of Eq. (5) needs."""

    name: str
    body: str  #: URDF link or joint whose frame the ends are given in
    start_m: Vector  #: first end in the body's frame [m]
    end_m: Vector  #: second end in the body's frame [m]
    radius_m: float
