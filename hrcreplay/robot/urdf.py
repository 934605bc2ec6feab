"""What hrcreplay needs from a URDF: the chain of axes that moves the tool, its limits, capsules around its shapes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from xml.etree import ElementTree as ET

import numpy as np

from hrcreplay.errors import SettingsError
from hrcreplay.records import Floats
from hrcreplay.robot.rotation import from_rpy
from hrcreplay.robot.segments import Segment

_MOVING = ("revolute", "continuous")


@dataclass(frozen=True)
class Description:
    """A URDF reduced to one chain: every joint that does not move the tool is held at its zero."""

    name: str
    text: str  #: URDF with revolute joints on the chain and fixed joints elsewhere, without shapes
    tcp: str  #: link that carries the tool
    joints: tuple[str, ...]  #: from the base to the tool
    q_min: Floats  #: (nv,) [rad]; -inf for a continuous joint
    q_max: Floats  #: (nv,) [rad]; inf for a continuous joint
    dq_max: Floats  #: (nv,) [rad/s]


def describe(xml: str, tcp_frame: str | None) -> Description:
    """Reads the chain from the base to the tool.

    Args:
        xml: URDF text.
        tcp_frame: Link (or joint, for the link behind it) that carries the tool; none: the link behind the most axes,
            the last of them in the file.

    Raises:
        SettingsError: No URDF, no such frame, or a joint on the chain that is no axis of rotation or has no limits.
    """
    robot = _parse(xml)
    parents = {_child(joint): joint for joint in robot.findall("joint")}
    links = [str(link.get("name")) for link in robot.findall("link")]
    tcp = _tool_link(links, parents, tcp_frame)
    axes = [joint for joint in reversed(_ancestors(tcp, parents)) if joint.get("type") != "fixed"]
    if not axes:
        raise SettingsError(f"robot: no axis moves {tcp!r}; name the tool's link with robot.tcp_frame")
    limits = [_limits(joint) for joint in axes]
    for joint in parents.values():
        joint.set("type", "revolute" if joint in axes else "fixed")
    for joint, (low, high, speed) in zip(axes, limits, strict=True):
        for old in joint.findall("limit"):
            joint.remove(old)
        ends = {"lower": low, "upper": high} if math.isfinite(low) else {"lower": -1e9, "upper": 1e9}
        values = {name: repr(value) for name, value in (ends | {"velocity": speed, "effort": 0.0}).items()}
        ET.SubElement(joint, "limit", values)
    for link in robot.findall("link"):
        for shape in (*link.findall("visual"), *link.findall("collision")):
            link.remove(shape)
    low_high_speed = np.array(limits).T
    return Description(
        name=robot.get("name", "robot"),
        text=ET.tostring(robot, encoding="unicode"),
        tcp=tcp,
        joints=tuple(str(joint.get("name")) for joint in axes),
        q_min=low_high_speed[0],
        q_max=low_high_speed[1],
        dq_max=low_high_speed[2],
    )


def capsules(xml: str, tcp_frame: str | None) -> tuple[Segment, ...]:
    """A capsule around every collision shape of the links that move, named after the link.

    Raises:
        SettingsError: A moving link has a mesh, or no moving link has a shape.
    """
    robot = _parse(xml)
    parents = {_child(joint): joint for joint in robot.findall("joint")}
    links = [str(link.get("name")) for link in robot.findall("link")]
    chain = set(describe(xml, tcp_frame).joints)
    found = []
    for link, name in zip(robot.findall("link"), links, strict=True):
        if chain.isdisjoint(str(joint.get("name")) for joint in _ancestors(name, parents)):
            continue
        shapes = link.findall("collision")
        for number, shape in enumerate(shapes, start=1):
            found.append(_capsule(shape, name, name if len(shapes) == 1 else f"{name}_{number}"))
    if not found:
        raise SettingsError("robot: no moving link of the URDF has a collision shape; give its capsules in robot.links")
    return tuple(found)


def _parse(xml: str) -> ET.Element:
    try:
        robot = ET.fromstring(xml)  # noqa: S314  the user's own file; expat bounds entity expansion
    except ET.ParseError as error:
        raise SettingsError(f"robot: not a URDF ({error})") from error
    if robot.tag != "robot" or robot.find("link") is None:
        raise SettingsError(f"robot: found <{robot.tag}> without links; a URDF is a <robot> of links and joints")
    links = [link.get("name") for link in robot.findall("link")]
    below = []
    for joint in robot.findall("joint"):
        ends = [None if end is None else end.get("link") for end in (joint.find("parent"), joint.find("child"))]
        if not set(ends) <= set(links):
            raise SettingsError(
                f"robot: joint {joint.get('name')!r} is between {ends[0]} and {ends[1]}; name two links"
            )
        below.append(ends[1])
    roots = [str(link) for link in links if link not in below]
    if len(roots) != 1 or len(set(below)) != len(below):
        raise SettingsError(
            f"robot: found {len(roots)} links without a parent ({', '.join(roots)}); a URDF is one tree"
        )
    return robot


def _child(joint: ET.Element) -> str:
    return str(joint.find("child").get("link"))  # type: ignore[union-attr]  # _parse has checked it


def _ancestors(link: str, parents: dict[str, ET.Element]) -> list[ET.Element]:
    """Joints from the link down to the base."""
    joints: list[ET.Element] = []
    while link in parents:
        joint = parents[link]
        if joint in joints:
            raise SettingsError(f"robot: joint {joint.get('name')!r} closes a loop; a URDF is a tree")
        joints.append(joint)
        link = str(joint.find("parent").get("link"))  # type: ignore[union-attr]  # _parse has checked it
    return joints


def _tool_link(links: list[str], parents: dict[str, ET.Element], tcp_frame: str | None) -> str:
    if tcp_frame is None:

        def depth(link: str) -> tuple[int, int, int]:
            joints = _ancestors(link, parents)
            return sum(joint.get("type") != "fixed" for joint in joints), len(joints), links.index(link)

        return max(links, key=depth)
    behind = {str(joint.get("name")): link for link, joint in parents.items()}
    tcp = tcp_frame if tcp_frame in links else behind.get(tcp_frame)
    if tcp is None:
        raise SettingsError(f"robot.tcp_frame: the URDF has no link {tcp_frame!r}; it has {', '.join(links)}")
    return tcp


def _limits(joint: ET.Element) -> tuple[float, float, float]:
    """Lower and upper end [rad] and top speed [rad/s] of an axis."""
    name, kind = joint.get("name"), joint.get("type")
    if kind not in _MOVING or joint.find("mimic") is not None:
        found = "a mimic joint" if joint.find("mimic") is not None else f"of type {kind}"
        raise SettingsError(f"robot: joint {name!r} before the tool is {found}; only axes of rotation can be planned")
    limit = joint.find("limit")
    try:
        values = {} if limit is None else {key: float(value) for key, value in limit.attrib.items()}
    except ValueError as error:
        raise SettingsError(f"robot: limits of joint {name!r} are no numbers ({error})") from error
    low, high = (-math.inf, math.inf) if kind == "continuous" else (values.get("lower", 0.0), values.get("upper", 0.0))
    speed = values.get("velocity", 0.0)
    if not (low < high and 0 < speed < math.inf):
        raise SettingsError(
            f"robot: joint {name!r} has range {low} to {high} rad and top speed {speed} rad/s; both must be positive"
        )
    return low, high, speed


def _capsule(collision: ET.Element, link: str, name: str) -> Segment:
    """The capsule that encloses one collision shape, its axis along the shape's own or its longest side."""
    geometry = collision.find("geometry")
    shape = None if geometry is None else next(iter(geometry), None)
    kind = "nothing" if shape is None else shape.tag
    half = np.zeros(3)
    if shape is not None and kind in ("cylinder", "capsule"):
        half[2] = _measure(shape, "length") / 2
        radius = _measure(shape, "radius")
    elif shape is not None and kind == "sphere":
        radius = _measure(shape, "radius")
    elif shape is not None and kind == "box":
        sides = _floats(shape.get("size"))
        longest = int(np.argmax(sides))
        half[longest] = sides[longest] / 2
        radius = float(np.linalg.norm(np.delete(sides, longest))) / 2
    else:
        raise SettingsError(
            f"robot: the collision shape of link {link!r} is {kind}; capsules are derived from capsules, cylinders, "
            "spheres and boxes, so give robot.links"
        )
    if not (math.isfinite(radius) and radius > 0 and np.isfinite(half).all()):
        raise SettingsError(f"robot: the {kind} of link {link!r} has no size; give its measures in metres")
    origin = collision.find("origin")
    centre = _floats(None if origin is None else origin.get("xyz"))
    axis = from_rpy(_floats(None if origin is None else origin.get("rpy"))) @ half
    start, end = centre - axis, centre + axis
    return Segment(name, link, (start[0], start[1], start[2]), (end[0], end[1], end[2]), radius)


def _measure(shape: ET.Element, key: str) -> float:
    try:
        return float(shape.get(key, "nan"))
    except ValueError:
        return math.nan


def _floats(text: str | None) -> Floats:
    try:
        values = np.array([float(part) for part in text.split()] if text else [0.0, 0.0, 0.0])
    except ValueError as error:
        raise SettingsError(f"robot: {text!r} are no numbers; three are needed") from error
    if values.shape != (3,):
        raise SettingsError(f"robot: {text!r} are {len(values)} numbers; three are needed")
    return values
