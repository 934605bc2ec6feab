"""The ABB IRB 140: axes of the product specification 3HAC041346-001, link capsules of our own.

Zero is the controller's: upper arm up, forearm level; so are the signs. Nothing here is taken from a community URDF.
"""

from __future__ import annotations

import math

from hrcreplay.robot.link_capsules import Segment

#: Axis: offset from the axis before it, at zero [m]; direction at zero; range [deg]; top speed [deg/s].
_AXES = (
    ((0.0, 0.0, 0.352), (0, 0, 1), (-180, 180), 200),
    ((0.070, 0.0, 0.0), (0, 1, 0), (-90, 110), 200),
    ((0.0, 0.0, 0.360), (0, 1, 0), (-230, 50), 260),
    ((0.380, 0.0, 0.0), (1, 0, 0), (-200, 200), 360),
    ((0.0, 0.0, 0.0), (0, 1, 0), (-115, 115), 360),
    ((0.065, 0.0, 0.0), (1, 0, 0), (-400, 400), 450),
)


def urdf() -> str:
    """The robot as URDF text: links ``base``, ``link_1`` to ``link_6`` and ``flange`` (z out of the flange)."""
    rows = ["<robot name='irb140'>", "<link name='base'/>", "<link name='flange'/>"]
    parent = "base"
    for number, (offset_m, axis, range_deg, speed_deg_per_s) in enumerate(_AXES, start=1):
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


def segments(tool_m: float) -> tuple[Segment, ...]:
    """Its link capsules; the last reaches from the flange to the TCP, ``tool_m`` beyond it [m].

    The base column does not move and needs none.
    """
    zero = (0.0, 0.0, 0.0)
    return (
        Segment("shoulder", "link_1", zero, (0.070, 0.0, 0.0), 0.219),
        Segment("upper_arm", "link_2", zero, (0.0, 0.0, 0.360), 0.152),
        Segment("forearm", "link_3", zero, (0.380, 0.0, 0.0), 0.118),
        Segment("wrist", "link_5", zero, (0.065, 0.0, 0.0), 0.077),
        Segment("tool", "flange", zero, (0.0, 0.0, tool_m), 0.045),
    )


def _triple(values: tuple[float, float, float] | tuple[int, int, int]) -> str:
    return " ".join(repr(value) for value in values)
