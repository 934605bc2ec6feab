"""What a run tells of its robot: the chain that was read from a URDF and the capsules around its links."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from hrcreplay.report.tables import PageTable
from hrcreplay.robot.model import RobotModel

_LITRES = 1000.0  # a cubic metre


def summary(robot: RobotModel) -> dict[str, Any]:
    """JSON form of the robot for run.json; volumes [m^3], null where a capsule was given and not derived."""
    return {
        "name": robot.name,
        "base_frame": robot.base_frame,
        "tcp_frame": robot.tcp_frame,
        "joints": list(robot.joint_names),
        "locked": list(robot.locked),
        "links": [
            {
                "name": segment.name,
                "body": segment.body,
                "start_m": list(segment.start_m),
                "end_m": list(segment.end_m),
                "radius_m": segment.radius_m,
                "capsule_m3": segment.volume_m3,
                "shape_m3": None if math.isnan(segment.shape_m3) else segment.shape_m3,
            }
            for segment in robot.segments
        ],
    }


def remarks(robot: RobotModel) -> tuple[str, ...]:
    """What a user should know of a robot from a URDF: its chain, its capsules, what is locked, what is not guarded."""
    found = []
    derived = [segment for segment in robot.segments if segment.shape_m3 > 0]
    if derived:
        shapes, capsules = (sum(values) for values in zip(*((s.shape_m3, s.volume_m3) for s in derived), strict=True))
        widest = max(derived, key=lambda segment: segment.volume_m3 - segment.shape_m3)
        found.append(
            f"robot {robot.name}: {robot.nv} axes from {robot.base_frame} to {robot.tcp_frame}; its {len(derived)} "
            f"capsules add {100 * (capsules / shapes - 1):.0f} % to the volume of the shapes in them, most at "
            f"{widest.name}: {_LITRES * widest.volume_m3:.1f} L around {_LITRES * widest.shape_m3:.1f} L"
        )
    if robot.locked:
        found.append(
            f"robot {robot.name}: locked at zero, or at the end of their range next to it: {', '.join(robot.locked)}"
        )
    if robot.tcp_outside_m > 1e-3:
        found.append(
            f"robot {robot.name}: the TCP lies {robot.tcp_outside_m:.3f} m outside the capsules of the last link, and "
            "what is mounted there is not guarded; give it in robot.links, or set robot.tool_m"
        )
    return tuple(found)


def robot_table(robot: Mapping[str, Any]) -> PageTable:
    """The capsules that stand for the links, and how much each adds to the hull of the shape inside it.

    Args:
        robot: What :func:`summary` made.
    """
    rows = []
    for link in robot["links"]:
        inside = link["shape_m3"]
        added = "\u2013" if not inside else f"{100 * (link['capsule_m3'] / inside - 1):+.0f} %"
        rows.append(
            (
                link["name"],
                f"{math.dist(link['start_m'], link['end_m']):.3f}",
                f"{link['radius_m']:.3f}",
                f"{_LITRES * link['capsule_m3']:.2f}",
                "\u2013" if inside is None else f"{_LITRES * inside:.2f}",
                added,
            )
        )
    locked = f" Locked: {', '.join(robot['locked'])}." if robot["locked"] else ""
    return PageTable(
        f"Capsules of the links: {robot['name']}",
        ("link", "length [m]", "radius [m]", "capsule [L]", "shape's hull [L]", "added"),
        tuple(rows),
        f"{len(robot['joints'])} axes from {robot['base_frame']} to {robot['tcp_frame']}.{locked} A dash: the capsule "
        "was given, not derived from a shape.",
    )
