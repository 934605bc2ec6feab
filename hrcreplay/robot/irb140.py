"""The ABB IRB 140: axes from the product specification 3HAC041346-001, link capsules from this project.

Zero position and signs are those of ABB's controller; at zero the upper arm points up and the forearm is level.
Nothing here comes from a community URDF. This is the only definition of the robot. The controller's model, the EGM
codec and the robot double read it, so this module imports nothing that is slow to load.
"""

from __future__ import annotations

import math
from typing import NamedTuple

Vector = tuple[float, float, float]


class Axis(NamedTuple):
    """One revolute axis."""

    offset_m: Vector  #: from the previous axis, at the zero position [m]
    direction: tuple[int, int, int]  #: at the zero position; x points forward, z up
    range_deg: tuple[int, int]
    speed_deg_per_s: int  #: top speed


AXES = (
    Axis((0.0, 0.0, 0.352), (0, 0, 1), (-180, 180), 200),
    Axis((0.070, 0.0, 0.0), (0, 1, 0), (-90, 110), 200),
    Axis((0.0, 0.0, 0.360), (0, 1, 0), (-230, 50), 260),
    Axis((0.380, 0.0, 0.0), (1, 0, 0), (-200, 200), 360),
    Axis((0.0, 0.0, 0.0), (0, 1, 0), (-115, 115), 360),
    Axis((0.065, 0.0, 0.0), (1, 0, 0), (-400, 400), 450),
)


#: Mass of the robot, and its largest payload, of the product specification [kg]. The mass of the moving parts, their
#: centres and their inertias are not published.
MASS_KG, PAYLOAD_KG = 98.0, 6.0


def urdf() -> str:
    """The robot as URDF text: links ``base``, ``link_1`` to ``link_6`` and ``flange`` (z out of the flange)."""
    rows = ["<robot name='irb140'>", "<link name='base'/>", "<link name='flange'/>"]
    parent = "base"
    for number, (offset_m, axis, range_deg, speed_deg_per_s) in enumerate(AXES, start=1):
        lower, upper, speed = (math.radians(value) for value in (*range_deg, speed_deg_per_s))
        rows += [
            f"<link name='link_{number}'/>",
            f"<joint name='joint_{number}' type='revolute'>",
            f"<parent link='{parent}'/><child link='link_{number}'/>",
            f"<origin xyz='{_triple(offset_m)}'/><axis xyz='{_triple(axis)}'/>",
            f"<limit lower='{lower!r}' upper='{upper!r}' velocity='{speed!r}' effort='0'/></joint>",
        ]
        parent = f"link_{number}"
    rows += [
        "<joint name='joint_flange' type='fixed'><parent link='link_6'/><child link='flange'/>",
        f"<origin rpy='0 {math.pi / 2!r} 0'/></joint></robot>",
    ]
    return "\n".join(rows)


def capsules(tool_m: float) -> tuple[tuple[str, str, Vector, Vector, float], ...]:
    """Link capsules of the robot; the last reaches from the flange to the TCP, ``tool_m`` beyond the flange [m].

    The base column does not move, so it has no capsule.
    """
    zero = (0.0, 0.0, 0.0)
    return (
        ("shoulder", "link_1", zero, AXES[1].offset_m, 0.219),
        ("upper_arm", "link_2", zero, AXES[2].offset_m, 0.152),
        ("forearm", "link_3", zero, AXES[3].offset_m, 0.118),
        ("wrist", "link_5", zero, AXES[5].offset_m, 0.077),
        ("tool", "flange", zero, (0.0, 0.0, tool_m), 0.045),
    )


def _triple(values: tuple[float, float, float] | tuple[int, int, int]) -> str:
    return " ".join(repr(value) for value in values)
