"""The robot of a scene as URDF text that viewers draw: a URDF without shapes gets the capsules of its links."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from hrcreplay.records import Floats
from hrcreplay.robot.model import Segment


def with_capsules(urdf: str, segments: Sequence[Segment]) -> str:
    """Returns a URDF with a shape to draw: itself if any link has one, else with the capsules of its links.

    Args:
        urdf: A URDF that pinocchio has read.
        segments: Capsules of the links.
    """
    robot = ET.fromstring(urdf)  # noqa: S314  read before, with the limits of robot.urdf
    if next(robot.iter("visual"), None) is not None or next(robot.iter("collision"), None) is not None:
        return urdf
    links = {str(link.get("name")): link for link in robot.iter("link")}
    for segment in segments:
        if segment.body in links:
            _add_capsule(links[segment.body], segment)
    return ET.tostring(robot, encoding="unicode")


def _add_capsule(link: ET.Element, segment: Segment) -> None:
    """Adds a cylinder and a ball at each end; their turns are about x, then y, then z."""
    start, end = np.array(segment.start_m), np.array(segment.end_m)
    x, y, z = (end - start).tolist()
    length, turn = math.dist(start.tolist(), end.tolist()), (0.0, math.atan2(math.hypot(x, y), z), math.atan2(y, x))
    if length > 0.0:
        size = {"radius": f"{segment.radius_m:.6g}", "length": f"{length:.6g}"}
        _add_visual(link, (0.5 * (start + end)).tolist(), turn, "cylinder", size)
    for at in (start, end):
        _add_visual(link, at.tolist(), (0.0, 0.0, 0.0), "sphere", {"radius": f"{segment.radius_m:.6g}"})


def _add_visual(
    link: ET.Element, at_m: Sequence[float], turn: Sequence[float], kind: str, size: dict[str, str]
) -> None:
    visual = ET.SubElement(link, "visual")
    origin = {name: " ".join(f"{value:.6g}" for value in values) for name, values in (("xyz", at_m), ("rpy", turn))}
    ET.SubElement(visual, "origin", origin)
    ET.SubElement(ET.SubElement(visual, "geometry"), kind, size)


class LinkFrame(NamedTuple):
    """Frame of a link of a URDF, with all axes at zero."""

    name: str
    parent: str  #: link that it hangs on; empty for the root
    axes: int  #: number of the robot's axes that move it
    T_root_link: Floats  #: (4, 4) in the frame of the root


def link_frames(urdf: str, joints: Sequence[str]) -> tuple[LinkFrame, ...]:
    """Returns the frames of all links of a URDF, a parent before its children.

    Args:
        urdf: A URDF that pinocchio has read.
        joints: Names of the robot's axes; other joints count as fixed at zero.
    """
    robot = ET.fromstring(urdf)  # noqa: S314  read before, with the limits of robot.urdf
    above = {_name(joint, "child"): joint for joint in robot.iter("joint") if joint.find("child") is not None}
    frames: dict[str, LinkFrame] = {}

    def add(name: str) -> LinkFrame:
        if name not in frames:
            joint = above.get(name)
            if joint is None:
                frames[name] = LinkFrame(name, "", 0, np.eye(4))
            else:
                parent = add(_name(joint, "parent"))
                axes = parent.axes + (joint.get("name") in joints)
                frames[name] = LinkFrame(name, parent.name, axes, parent.T_root_link @ _origin(joint))
        return frames[name]

    for link in robot.iter("link"):
        add(str(link.get("name")))
    return tuple(frames.values())


def _name(joint: ET.Element, end: str) -> str:
    found = joint.find(end)
    return "" if found is None else str(found.get("link"))


def _origin(joint: ET.Element) -> Floats:
    """Returns the pose (4, 4) that a joint gives to its child at zero."""
    T, origin = np.eye(4), joint.find("origin")
    if origin is not None:
        T[:3, 3] = [float(value) for value in origin.get("xyz", "0 0 0").split()]
        turn = [float(value) for value in origin.get("rpy", "0 0 0").split()]
        T[:3, :3] = Rotation.from_euler("xyz", turn).as_matrix()
    return T
