"""Reads parts of a URDF before pinocchio does: the chain from base to tool, its limits, its meshes.

pinocchio's parser has one error message for every wrong file, rejects a limit without an effort, drops mimic
relations, sorts the joints by name, and needs the paths of the meshes. Therefore this module reads the tree and the
limits, and gives pinocchio a text that it can read: without shapes, or with the shapes that need capsules.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from hrcreplay.errors import SettingsError
from hrcreplay.geometry.vectors import norm_n
from hrcreplay.records import AxisFrame, Floats
from hrcreplay.robot.link_capsules import KINDS, Extent, Shape, shapes

_TURNING = ("revolute", "continuous")

#: Largest number of links of a URDF; humanoids with hands have about 150.
MOST_LINKS = 500


@dataclass(frozen=True)
class Description:
    """A URDF reduced to one chain of axes; every other joint is locked."""

    name: str
    text: str  #: URDF without shapes; the endless axes of the chain are revolute joints
    base: str  #: link that stands on ``T_world_base``
    tcp: str  #: link that carries the tool
    joints: tuple[str, ...]  #: from the base to the tool
    locked: tuple[str, ...]  #: joints of other kinds or other branches, in the file's order
    q_min: Floats  #: (nv,) [rad]; -inf for a continuous joint
    q_max: Floats  #: (nv,) [rad]; inf for a continuous joint
    dq_max: Floats  #: (nv,) [rad/s]
    shapes: tuple[Shape, ...]  #: collision shapes of the links that the chain moves
    frames: tuple[AxisFrame, ...] = ()  #: links at both sides of each axis


def describe(xml: str, tcp_frame: str | None = None, base_frame: str | None = None) -> Description:
    """Reads the chain from the base to the tool.

    Args:
        xml: URDF text.
        tcp_frame: Link that carries the tool, or the joint that moves it; none: the last link that revolute joints
            move. This is one of the links with the most axes of rotation before them: a link without a shape if there
            is one, then the furthest down the tree. If the axes fork into fingers, it is before the fork.
        base_frame: Link (or joint) that stands on the base; none: the root.

    Raises:
        SettingsError: The text is no URDF, the frame does not exist, or a joint of the chain does not rotate or has no
            limits.
    """
    robot = _parse(xml)
    tree = _Tree(robot)
    tcp = tree.link(tcp_frame, "robot.tcp_frame") if tcp_frame is not None else _last_turned(tree)
    base = tree.root if base_frame is None else tree.link(base_frame, "robot.base_frame")
    below = tree.joints(base)
    chain = [joint for joint in tree.joints(tcp) if joint not in below and joint.get("type") != "fixed"]
    if not chain:
        raise SettingsError(
            f"robot: no axis between {base!r} and {tcp!r}; name the tool's link with robot.tcp_frame"
            + (", or another robot.base_frame" if base_frame is not None else "")
        )
    limits = np.array([_limits(joint) for joint in chain]).T
    found = shapes([link for name, link in tree.links.items() if not set(chain).isdisjoint(tree.joints(name))])
    return Description(
        name=robot.get("name", "robot"),
        text=_bare(robot, dict(zip(chain, limits.T.tolist(), strict=True))),
        base=base,
        tcp=tcp,
        joints=tuple(str(joint.get("name")) for joint in chain),
        locked=tuple(
            str(joint.get("name"))
            for joint in robot.findall("joint")
            if joint not in chain and joint.get("type") != "fixed"
        ),
        q_min=limits[0],
        q_max=limits[1],
        dq_max=limits[2],
        shapes=found,
        frames=tuple(_frame(joint) for joint in chain),
    )


def _frame(joint: ET.Element) -> AxisFrame:
    """Links at both sides of an axis, and how they are turned; zeros for a vector that is no numbers."""
    parent, child = (str(joint.find(name).get("link")) for name in ("parent", "child"))  # type: ignore[union-attr]  # _parse has checked it
    origin, axis = joint.find("origin"), joint.find("axis")
    rpy = _vector(None if origin is None else origin.get("rpy"), (0.0, 0.0, 0.0))
    along = _vector(None if axis is None else axis.get("xyz"), (1.0, 0.0, 0.0))
    return AxisFrame(parent, child, Rotation.from_euler("xyz", rpy).as_matrix(), along / max(norm_n(along), 1e-12))


def _vector(text: str | None, default: tuple[float, float, float]) -> Floats:
    try:
        found = np.array([float(part) for part in text.split()] if text is not None else default)
    except ValueError:
        return np.zeros(3)  # pinocchio tells what is wrong with it
    return found if found.shape == (3,) and np.isfinite(found).all() else np.zeros(3)


def with_shapes(robot: Description, paths: Mapping[str, str]) -> tuple[str, dict[str, str]]:
    """The URDF with its collision shapes in a form that pinocchio's parser reads.

    The parser does not resolve package:// and does not know <capsule>, so a capsule is written as a cylinder, which
    has the same dimensions.

    Args:
        robot: Result of ``describe``.
        paths: File name in a mesh -> its path.

    Returns:
        URDF text, and the name of each shape -> its name in pinocchio's geometry model.

    Raises:
        SettingsError: The kind of a shape is unknown, or the path of a mesh is unknown.
    """
    root = ET.fromstring(robot.text)  # noqa: S314  our own text
    links = {str(link.get("name")): link for link in root.findall("link")}
    names = {}
    for shape in robot.shapes:
        _check(shape, paths)
        collision = copy.deepcopy(shape.collision)
        for geometry in list(collision.iter(shape.kind)):
            if shape.mesh is not None:
                geometry.set("filename", paths[shape.mesh])
            elif shape.kind == "capsule":
                geometry.tag = "cylinder"
        names[shape.name] = f"{shape.link}_{len(links[shape.link].findall('collision'))}"
        links[shape.link].append(collision)
    return ET.tostring(root, encoding="unicode"), names


def disabled_pairs(xml: str) -> tuple[tuple[str, str], ...]:
    """Pairs of links whose collisions an SRDF disables, in order.

    Args:
        xml: SRDF text.

    Raises:
        SettingsError: The text is no SRDF, or a pair lacks a link.
    """
    try:
        robot = ET.fromstring(xml)  # noqa: S314  the user's own file; expat bounds entity expansion
    except ET.ParseError as error:
        raise SettingsError(f"robot.srdf: not an SRDF ({error})") from error
    if robot.tag != "robot":
        raise SettingsError(f"robot.srdf: found <{robot.tag}>; an SRDF is a <robot> with disable_collisions")
    found = []
    for pair in robot.iter("disable_collisions"):
        one, two = pair.get("link1"), pair.get("link2")
        if one is None or two is None:
            raise SettingsError(f"robot.srdf: disable_collisions between {one} and {two}; name two links")
        found.append((one, two))
    return tuple(sorted(set(found)))


def own_extent(shape: Shape, geometry: Any) -> Extent:
    """Extent of a shape in its own frame.

    Args:
        shape: Shape in the URDF.
        geometry: The same shape, read by pinocchio.

    Raises:
        SettingsError: The shape has no size.
    """
    if shape.kind == "mesh":
        triangles = [[geometry.tri_indices(i)[k] for k in range(3)] for i in range(geometry.num_tris)]
        return Extent(np.asarray(geometry.vertices()), 0.0, np.array(triangles, dtype=np.int64).reshape(-1, 3))
    if shape.kind == "box":
        if not (geometry.halfSide > 0).all():
            raise no_size(shape)
        return Extent(np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * geometry.halfSide, 0.0)
    half_m = 0.0 if shape.kind == "sphere" else float(geometry.halfLength)
    if not (geometry.radius > 0 and half_m >= 0):
        raise no_size(shape)
    return Extent(np.array([[0.0, 0.0, -half_m], [0.0, 0.0, half_m]]), float(geometry.radius))


def unreadable(shape: Shape) -> SettingsError:
    """The error for a shape that pinocchio's parser left out."""
    if shape.mesh is None and shape.collision.find("origin") is None:
        return no_size(shape)
    return SettingsError(
        f"robot: the {shape.kind} of {shape.name} cannot be read; check the numbers of its <collision>"
    )


def no_size(shape: Shape) -> SettingsError:
    """The error for a shape whose dimensions are missing or not positive."""
    return SettingsError(f"robot: the {shape.kind} of link {shape.link!r} has no size; give its measures in metres")


def _check(shape: Shape, paths: Mapping[str, str]) -> None:
    if shape.kind not in KINDS:
        raise SettingsError(
            f"robot: the collision shape of link {shape.link!r} is {shape.kind}; capsules are derived from "
            f"{', '.join(KINDS)}, so give robot.links"
        )
    if shape.mesh is not None and shape.mesh not in paths:
        raise SettingsError(
            f"robot: the collision shape of link {shape.link!r} is the mesh {shape.mesh!r}, whose file is not "
            "known; name the directory of its package in robot.packages, or give robot.links"
        )


class _Tree:
    """The links of a URDF, each with the joints below it."""

    def __init__(self, robot: ET.Element) -> None:
        self.links = {str(link.get("name")): link for link in robot.findall("link")}
        self._below = {str(joint.find("child").get("link")): joint for joint in robot.findall("joint")}  # type: ignore[union-attr]  # _parse has checked it
        self.root = next(name for name in self.links if name not in self._below)

    def joints(self, link: str) -> list[ET.Element]:
        """Joints from the root to a link."""
        found: list[ET.Element] = []
        while link in self._below:
            joint = self._below[link]
            if len(found) > len(self.links):
                raise SettingsError(f"robot: joint {joint.get('name')!r} closes a loop; a URDF is a tree")
            found.append(joint)
            link = str(joint.find("parent").get("link"))  # type: ignore[union-attr]  # _parse has checked it
        return found[::-1]

    def link(self, name: str, where: str) -> str:
        """The link with this name, or the child link of the joint with this name."""
        behind = {str(joint.get("name")): link for link, joint in self._below.items()}
        if name not in self.links and name not in behind:
            raise SettingsError(f"{where}: the URDF has no link {name!r}; it has {', '.join(self.links)}")
        return name if name in self.links else behind[name]


def _last_turned(tree: _Tree) -> str:
    """The link that carries the tool if the user names none; see ``describe``."""
    axes: dict[str, tuple[ET.Element, ...]] = {}
    for name in tree.links:
        moving = [joint for joint in tree.joints(name) if joint.get("type") != "fixed"]
        if not moving or moving[-1].get("type") in _TURNING:  # no tool behind a sliding finger
            axes[name] = tuple(joint for joint in moving if joint.get("type") in _TURNING)
    most = max(len(turning) for turning in axes.values())
    if most == 0:  # the check of the chain then reports the other joint types
        return max(tree.links, key=lambda name: len(tree.joints(name)))
    ends = [name for name, turning in axes.items() if len(turning) == most]
    shared = axes[ends[0]]
    for name in ends[1:]:
        same = [mine is other for mine, other in zip(shared, axes[name], strict=False)]
        shared = shared[: same.index(False)] if False in same else shared
    if 2 * len(shared) < most:
        raise SettingsError(
            f"robot: several chains of {most} axes, which end in {', '.join(ends)}; name the tool's link with "
            "robot.tcp_frame"
        )
    order = list(tree.links)

    def rank(name: str) -> tuple[bool, int, int]:
        link = tree.links[name]
        return link.find("visual") is None and link.find("collision") is None, len(tree.joints(name)), order.index(name)

    return max((name for name, turning in axes.items() if turning == shared), key=rank)


def _parse(xml: str) -> ET.Element:
    try:
        robot = ET.fromstring(xml)  # noqa: S314  the user's own file; expat bounds entity expansion
    except ET.ParseError as error:
        raise SettingsError(f"robot: not a URDF ({error})") from error
    if any("ros.org/wiki/xacro" in str(part.tag) for part in robot.iter()):
        raise SettingsError("robot: found xacro macros; make a URDF of them first: xacro FILE.xacro > FILE.urdf")
    if robot.tag != "robot" or robot.find("link") is None:
        raise SettingsError(f"robot: found <{robot.tag}> without links; a URDF is a <robot> of links and joints")
    links = [link.get("name") for link in robot.findall("link")]
    if len(links) > MOST_LINKS:
        raise SettingsError(
            f"robot: found {len(links)} links; at most {MOST_LINKS} are read, so leave out what is not the arm"
        )
    known, below = set(links), []
    for joint in robot.findall("joint"):
        ends = [None if end is None else end.get("link") for end in (joint.find("parent"), joint.find("child"))]
        if not set(ends) <= known:
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


def _bare(robot: ET.Element, axes: Mapping[ET.Element, Sequence[float]]) -> str:
    """URDF text of the kinematics only: without shapes, and with every axis of the chain as a revolute joint."""
    for link in robot.findall("link"):
        for shape in (*link.findall("visual"), *link.findall("collision")):
            link.remove(shape)
    for joint in robot.findall("joint"):
        if joint.get("type") not in (*_TURNING, "prismatic"):
            continue
        values = _limit(joint)
        low, high, speed = axes.get(joint, (values.get("lower", 0.0), values.get("upper", 0.0), 0.0))
        if joint in axes:
            joint.set("type", "revolute")
        for old in joint.findall("limit"):
            joint.remove(old)
        ends = {"lower": low, "upper": high} if math.isfinite(low) else {"lower": -1e9, "upper": 1e9}
        written = {name: repr(float(value)) for name, value in (ends | {"velocity": speed, "effort": 0.0}).items()}
        ET.SubElement(joint, "limit", written)
    return ET.tostring(robot, encoding="unicode")


def _limits(joint: ET.Element) -> tuple[float, float, float]:
    """Lower and upper end [rad] and top speed [rad/s] of an axis."""
    name, kind = joint.get("name"), joint.get("type")
    if kind not in _TURNING or joint.find("mimic") is not None:
        found = "a mimic joint" if joint.find("mimic") is not None else f"of type {kind}"
        raise SettingsError(
            f"robot: joint {name!r} between base and tool is {found}; only axes of rotation can be planned, so name "
            "another robot.tcp_frame or robot.base_frame"
        )
    values = _limit(joint)
    low, high = (-math.inf, math.inf) if kind == "continuous" else (values.get("lower", 0.0), values.get("upper", 0.0))
    speed = values.get("velocity", 0.0)
    if not (low < high and 0 < speed < math.inf):
        raise SettingsError(
            f"robot: joint {name!r} has range {low} to {high} rad and top speed {speed} rad/s; both must be positive"
        )
    return low, high, speed


def _limit(joint: ET.Element) -> dict[str, float]:
    limit = joint.find("limit")
    try:
        return {} if limit is None else {key: float(value) for key, value in limit.attrib.items()}
    except ValueError as error:
        raise SettingsError(f"robot: limits of joint {joint.get('name')!r} are no numbers ({error})") from error
