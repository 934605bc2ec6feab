"""The robot's kinematics in the world frame. The only module that imports pinocchio.

The module opens no file itself. If a URDF has meshes, pinocchio opens their files, because its geometry model takes
paths and not bytes; this happens once, when the robot is built. pinocchio reads the shapes and their placements and
locks joints; ``robot.urdf`` reads the parts of a URDF that pinocchio does not report.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from hrcreplay.errors import SettingsError
from hrcreplay.geometry.vectors import dot_n, norm_n
from hrcreplay.records import AxisFrame, Bools, Floats, Ints
from hrcreplay.robot import irb140 as irb140_data
from hrcreplay.robot.kinematics import Arm, Chain, RobotPose, axis_frames, ends_at, motion_of_links, pose_at
from hrcreplay.robot.link_capsules import Extent, Segment, Vector, capsules, distance_m
from hrcreplay.robot.urdf import Description, describe, own_extent, unreadable, with_shapes
from hrcreplay.settings.sections import Robot

__all__ = ["RobotModel", "RobotPose", "Segment", "from_urdf", "irb140"]


class LinkMotion(NamedTuple):
    """Segments at many instants, in the world frame."""

    ends_m: Floats  #: (n, s, 2, 3) ends of the segments [m]
    twist: Floats  #: (n, s, 6) velocity of the link's point at the world's origin, and angular velocity

    def speed(self, link: Ints, points_m: Floats) -> Floats:
        """(n,) speed of points (n, 3) [m] that are fixed to links, given as (n,) indices of segments [m/s]."""
        twist = self.twist[np.arange(len(link)), link]
        return np.asarray(np.linalg.norm(twist[:, :3] + np.cross(twist[:, 3:], points_m), axis=1))


#: A TCP further than this from all capsules is not guarded [m].
_OUTSIDE_M = 1e-3
_TOOL_RADIUS_M = 0.05  # radius of the capsule that the remark proposes; fits a gripper


@dataclass(frozen=True)
class RobotModel:
    """A serial robot on its base. Arrays are (nv,) [rad] and derivatives; an endless axis has infinite ``q_max``."""

    name: str
    joint_names: tuple[str, ...]
    q_min: Floats
    q_max: Floats
    dq_max: Floats
    ddq_max: Floats
    segments: tuple[Segment, ...]
    T_world_base: Floats  #: (4, 4)
    shoulder_m: Floats  #: (3,) origin of the first axis, world [m]
    reach_m: float  #: upper bound of the distance from ``shoulder_m`` to the TCP [m]
    span_m: float  #: upper bound of the distance from the base's origin to a point of a segment's axis [m]
    base_frame: str  #: link that stands on ``T_world_base``
    tcp_frame: str  #: link that carries the tool
    locked: tuple[str, ...]  #: joints off the chain, locked at zero or at the nearest end of their range
    axis_frames: tuple[AxisFrame, ...]  #: links at both sides of each axis
    tcp_in_frame_m: Floats  #: (3,) TCP in the frame of that link [m]
    tcp_outside_m: float  #: distance from the TCP to the capsules of the last link; 0 inside one, NaN without one [m]
    moves: Bools  #: (s, nv) axes that move each segment
    axis_reach_m: Floats  #: (nv, s) upper bound of the distance from an axis of rotation to a segment's axis [m]
    chain: Chain = field(repr=False, compare=False)  #: axes, TCP, and both ends of each segment
    turns: Floats = field(repr=False, compare=False)  #: (s, 3, 3) rotations from the segments' bodies to their axes
    _inertia: _Inertia = field(repr=False, compare=False)

    @property
    def nv(self) -> int:
        """Number of axes."""
        return len(self.joint_names)

    @cached_property
    def arm(self) -> Arm:
        """The robot as numbers for kernels."""
        radius_m = np.array([segment.radius_m for segment in self.segments], dtype=float)
        limits = self.q_min, self.q_max, self.dq_max, self.ddq_max
        return Arm(self.chain, radius_m, self.axis_reach_m, *limits)

    @property
    def unguarded_tool(self) -> str | None:
        """Remark if the TCP is outside every capsule, with the setting that guards it; else None."""
        if not self.tcp_outside_m > _OUTSIDE_M:
            return None
        end = ", ".join(f"{at:.4g}" for at in (self.tcp_in_frame_m + 0.0).tolist())
        capsule = f'{{name = "mounted", body = "{self.tcp_frame}", start_m = [0.0, 0.0, 0.0], end_m = [{end}]'
        return (
            f"robot {self.name}: the TCP lies {self.tcp_outside_m:.3f} m outside the capsules of the last link, and "
            f"what is mounted there is not guarded; a capsule to it guards it: robot.tool_links = [{capsule}, "
            f"radius_m = {_TOOL_RADIUS_M}}}]"
        )

    def pose(self, q: Floats, dq: Floats) -> RobotPose:
        """Forward kinematics, Jacobians and Jdot dq of Eq. (66b), corrected, and Eq. (66c) at one instant.

        The printed Eq. (66b) has two dots on J; one dot is correct, see docs/paper.md.

        Args:
            q: (nv,) [rad].
            dq: (nv,) [rad/s].
        """
        return pose_at(self.chain, _writable(q), _writable(dq))

    def ends_m(self, q: Floats) -> Floats:
        """(s, 2, 3) ends of the segments in the world [m], for joint positions (nv,) [rad]."""
        return ends_at(self.chain, _writable(q))

    def R_bodies(self, q: Floats) -> Floats:
        """(s, 3, 3) rotations from the segments' bodies to the world, for joint positions (nv,) [rad]."""
        frames, carriers = axis_frames(self.chain, _writable(q)), self.chain.carriers[::2]
        turned = frames[carriers, :, :3] @ self.turns
        return np.where((carriers < 0)[:, None, None], self.turns, turned)

    @property
    def inertial(self) -> bool:
        """Whether every axis of the URDF moves a mass; without, the robot's inertia is not known."""
        return self._inertia.inertial

    @property
    def moving_mass_kg(self) -> float:
        """Mass of everything that the axes move, by the inertias of the URDF; NaN without them [kg]."""
        return self._inertia.moving_mass_kg if self.inertial else math.nan

    def effective_mass_kg(
        self, q: Floats, link: int, point_m: Floats, normal: Floats, payload_kg: float = 0.0
    ) -> float:
        """Mass that a contact meets along its normal: 1 / (n^T J M^-1 J^T n), Khatib (1995), with free axes.

        The inertia of the motors behind their gears is in no URDF, and not in it.

        Args:
            q: (nv,) [rad].
            link: Segment that is hit.
            point_m: (3,) point of contact, world [m].
            normal: (3,) unit vector, world.
            payload_kg: Point mass at the TCP [kg].

        Returns:
            inf for a direction in which the robot cannot give way; NaN without inertias in the URDF.
        """
        if not self.inertial:
            return math.nan
        gives_way = self._inertia.mobility(q, link, (point_m, normal), payload_kg)
        return 1.0 / gives_way if gives_way > 0.0 else math.inf

    def link_motion(self, q: Floats, dq: Floats) -> LinkMotion:
        """Positions and velocities of the segments at many instants.

        Args:
            q: (n, nv) [rad].
            dq: (n, nv) [rad/s].
        """
        return LinkMotion(*motion_of_links(self.chain, _writable(q), _writable(dq)))


class _Inertia:
    """pinocchio's model and data, for masses."""

    def __init__(self, model: Any, points: Sequence[int], tcp: int) -> None:
        self._model, self._data = model, model.createData()
        self._J = self._data.J.reshape(6, model.nv)  # pinocchio gives (6,) when nv == 1
        self._tcp = self._data.oMf[tcp].translation
        self._moves = np.array([_support(model, frame) for frame in points]).reshape(len(points), model.nv)

    @property
    def inertial(self) -> bool:
        return all(inertia.mass > 0.0 for inertia in list(self._model.inertias)[1:])

    @property
    def moving_mass_kg(self) -> float:
        return float(sum(inertia.mass for inertia in list(self._model.inertias)[1:]))

    def mobility(self, q: Floats, link: int, contact: tuple[Floats, Floats], payload_kg: float) -> float:
        """Inverse of the effective mass at a contact [1/kg].

        Args:
            q: (nv,) [rad].
            link: Segment that is hit.
            contact: (3,) point in the world [m], and (3,) unit vector of the normal.
            payload_kg: Point mass at the TCP [kg].
        """
        point, normal = contact
        M = np.triu(pin.crba(self._model, self._data, q))
        M = M + np.triu(M, 1).T
        pin.computeJointJacobians(self._model, self._data, q)
        pin.updateFramePlacements(self._model, self._data)
        J_tcp = self._J[:3] + np.cross(self._J[3:], self._tcp, axis=0)
        M += payload_kg * J_tcp.T @ J_tcp
        J = (self._J[:3] + np.cross(self._J[3:], point, axis=0)) * self._moves[2 * link]
        along = normal @ J
        return float(along @ np.linalg.solve(M, along))


def irb140(
    T_world_base: Floats,
    *,
    stop_s: float,
    tool_m: float = Robot().tool_m,
    T_tool_tcp: Floats | None = None,
    tool_segments: Sequence[Segment] = (),
    acceleration: Sequence[float] = (),
) -> RobotModel:
    """The ABB IRB 140; its TCP lies ``tool_m`` beyond the flange, along the flange's z axis.

    Args:
        T_world_base: (4, 4) robot base in the world [m].
        stop_s: T_s of Eq. (70) [s].
        tool_m: Distance from the flange to the tool point along the flange's z axis [m].
        T_tool_tcp: (4, 4) TCP in the frame of the tool point; none: the tool point [m].
        tool_segments: Capsules of what is mounted on the flange, in addition to the robot's own.
        acceleration: (6,) limits [rad/s^2]; none: top speed / T_s, so that every axis can stop within T_s.
    """
    return from_urdf(
        irb140_data.urdf(),
        T_world_base,
        stop_s=stop_s,
        tcp_frame="flange",
        tool_m=tool_m,
        T_tool_tcp=T_tool_tcp,
        segments=[*(Segment(*capsule) for capsule in irb140_data.capsules(tool_m)), *tool_segments],
        acceleration=acceleration,
    )


def from_urdf(
    xml: str,
    T_world_base: Floats,
    *,
    stop_s: float,
    tcp_frame: str | None = None,
    base_frame: str | None = None,
    tool_m: float = 0.0,
    T_tool_tcp: Floats | None = None,
    segments: Sequence[Segment] = (),
    acceleration: Sequence[float] = (),
    meshes: Mapping[str, str] | None = None,
) -> RobotModel:
    """Builds a robot from URDF text.

    Joints that do not lie between base and tool are locked, at zero if their range contains zero.

    Args:
        xml: URDF text.
        T_world_base: (4, 4) robot base in the world [m].
        stop_s: T_s of Eq. (70) [s].
        tcp_frame: Link that carries the tool; none: the last link that revolute joints move.
        base_frame: Link that stands on ``T_world_base``; none: the URDF's root.
        tool_m: Distance from the tool's link to the tool point along the link's z axis [m].
        T_tool_tcp: (4, 4) TCP in the frame of the tool point; none: the tool point [m].
        segments: Link capsules; none: derived from the collision shapes.
        acceleration: (nv,) limits [rad/s^2]; none: top speed / T_s.
        meshes: File name in a collision mesh -> its path; pinocchio reads it if ``segments`` is empty.

    Raises:
        SettingsError: The URDF, a mesh, a segment's body or the number of accelerations cannot be used.
    """
    robot = describe(xml, tcp_frame, base_frame)
    ddq_max = _accelerations(robot, acceleration, stop_s)
    whole = _whole(robot)
    segments = tuple(segments) or capsules(robot.shapes, _extents(whole, robot, meshes or {}))
    model = _chain(whole, robot.joints)
    _place_base(model, robot.base, pin.SE3(T_world_base))
    offset = pin.SE3(np.eye(3), np.array([0.0, 0.0, tool_m])) * pin.SE3(np.eye(4) if T_tool_tcp is None else T_tool_tcp)
    tcp = _add_frame(model, robot.tcp, offset, "robot.tcp_frame")
    points = _add_ends(model, segments)
    return RobotModel(
        name=robot.name,
        joint_names=robot.joints,
        q_min=robot.q_min,
        q_max=robot.q_max,
        dq_max=robot.dq_max,
        ddq_max=ddq_max,
        segments=segments,
        T_world_base=np.array(T_world_base, dtype=float),
        shoulder_m=np.array(model.jointPlacements[1].translation),
        reach_m=_reach_m(model, tcp),
        span_m=_span_m(model, points, T_world_base),
        base_frame=robot.base,
        tcp_frame=robot.tcp,
        locked=robot.locked,
        axis_frames=robot.frames,
        tcp_in_frame_m=np.array(offset.translation),
        tcp_outside_m=_outside(model, segments, points, tcp),
        moves=np.array([_support(model, point) for point in points[::2]]).reshape(-1, model.nv),
        axis_reach_m=_axis_reach_m(model, points),
        chain=_serial(model, points, tcp),
        turns=np.array([_carried(model, point).rotation for point in points[::2]]).reshape(-1, 3, 3),
        _inertia=_Inertia(model, points, tcp),
    )


def _add_ends(model: Any, segments: Sequence[Segment]) -> list[int]:
    """Frames at both ends of each segment, in their order."""
    return [
        _add_frame(model, s.body, _shift(end), f"robot.links: {s.name}")
        for s in segments
        for end in (s.start_m, s.end_m)
    ]


def _accelerations(robot: Description, given: Sequence[float], stop_s: float) -> Floats:
    """(nv,) acceleration limits, which a URDF does not contain [rad/s^2]."""
    ddq_max = np.array(given, dtype=float) if len(given) else robot.dq_max / stop_s
    if ddq_max.shape != robot.dq_max.shape:
        raise SettingsError(f"robot.acceleration: found {len(given)} values; {robot.name} has {len(robot.joints)} axes")
    return ddq_max


def _whole(robot: Description) -> Any:
    """Pinocchio's model with every joint, including those off the chain."""
    try:
        return pin.buildModelFromXML(robot.text)
    except ValueError as error:
        raise SettingsError(f"robot: the URDF of {robot.name} cannot be read ({error}); check its numbers") from error


def _extents(whole: Any, robot: Description, meshes: Mapping[str, str]) -> dict[str, Extent]:
    """Extent of each collision shape in its link's frame, by the shape's name."""
    text, names = with_shapes(robot, meshes)
    if not names:
        return {}
    try:
        geometry = pin.buildGeomFromUrdfString(whole, text, pin.GeometryType.COLLISION)
    except (ValueError, RuntimeError) as error:
        reason = " ".join(str(error).partition("message: ")[2].partition("Hint: ")[0].split() or str(error).split())
        raise SettingsError(f"robot: a mesh of {robot.name} cannot be read ({reason}); give robot.links") from error
    found = {one.name: one for one in geometry.geometryObjects}
    extents = {}
    for shape in robot.shapes:
        if names[shape.name] not in found:  # pinocchio skips a shape that it cannot read, without an error
            raise unreadable(shape)
        one = found[names[shape.name]]
        T_link_shape = whole.frames[one.parentFrame].placement.inverse() * one.placement
        extent = own_extent(shape, one.geometry)
        points_m = extent.points_m @ T_link_shape.rotation.T + T_link_shape.translation
        extents[shape.name] = replace(extent, points_m=points_m)
    return extents


def _chain(whole: Any, joints: Sequence[str]) -> Any:
    """The model with the other joints locked at zero, or at the end of their range that is nearest to zero."""
    others = [i for i in range(1, whole.njoints) if whole.names[i] not in joints]
    q = pin.neutral(whole)
    for i in others:
        if whole.joints[i].nq == 1:
            at = whole.joints[i].idx_q
            q[at] = np.clip(0.0, whole.lowerPositionLimit[at], whole.upperPositionLimit[at])
    try:
        return pin.buildReducedModel(whole, others, q) if others else whole
    except ValueError as error:
        raise SettingsError(f"robot: no joint off the arm can be locked ({error}); rename joint or link") from error


def _place_base(model: Any, base: str, T_world_base: Any) -> None:
    """Moves everything below the root so that the base link is at ``T_world_base`` in pinocchio's world."""
    T_world_root = T_world_base * _body(model, base, "robot.base_frame").placement.inverse()
    for joint in range(1, model.njoints):
        if model.parents[joint] == 0:
            model.jointPlacements[joint] = T_world_root * model.jointPlacements[joint]
    for frame in model.frames:
        if frame.parentJoint == 0:
            frame.placement = T_world_root * frame.placement


def _add_frame(model: Any, body: str, offset: Any, where: str) -> int:
    """Adds a frame that is fixed to a link (or to a joint's frame) and returns its index."""
    frame = _body(model, body, where)
    name = f"point {model.nframes}"
    return int(model.addFrame(pin.Frame(name, frame.parentJoint, frame.placement * offset, pin.FrameType.OP_FRAME)))


def _body(model: Any, body: str, where: str) -> Any:
    known = {frame.name: i for i, frame in reversed(list(enumerate(model.frames)))}
    known |= {frame.name: i for i, frame in enumerate(model.frames) if frame.type == pin.FrameType.BODY}
    if body not in known:
        raise SettingsError(f"{where}: the robot has no link {body!r}; it has {', '.join(sorted(known))}")
    return model.frames[known[body]]


def _serial(model: Any, points: Sequence[int], tcp: int) -> Chain:
    """The chain for the kernels: each axis is the z axis of its frame."""
    if list(model.parents)[1:] != list(range(model.nv)):
        raise SettingsError(f"robot: the axes {', '.join(list(model.names)[1:])} do not follow one another")
    frames, before = np.empty((model.nv, 3, 4)), np.eye(3)
    for joint in range(1, model.njoints):
        placement, onto = model.jointPlacements[joint], _onto_axis(model, joint)
        frames[joint - 1, :, :3] = before.T @ placement.rotation @ onto
        frames[joint - 1, :, 3], before = before.T @ placement.translation, onto
    carried = [_carried(model, point) for point in points]
    hand = _carried(model, tcp)
    return Chain(
        frames=frames,
        tcp=np.column_stack((hand.rotation, hand.translation)),
        points_m=np.array([at.translation for at in carried]).reshape(-1, 3),
        carriers=np.array([model.frames[point].parentJoint - 1 for point in points], dtype=np.int64),
    )


def _onto_axis(model: Any, joint: int) -> Floats:
    """(3, 3) rotation from a frame whose z axis is the axis of a joint to the joint's own frame."""
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    z = np.array(data.oMi[joint].actInv(pin.Motion(data.J.reshape(6, model.nv)[:, joint - 1])).angular)
    most = int(np.argmax(np.abs(z)))
    x = np.eye(3)[(most + 1) % 3]
    x = x - z * dot_n(z, x)
    x /= norm_n(x)
    return np.column_stack((x, np.cross(z, x), z))


def _carried(model: Any, frame: int) -> Any:
    """Placement of a frame in the frame of its axis, whose z axis is the axis; in the world if no axis moves it."""
    one = model.frames[frame]
    if one.parentJoint == 0:
        return one.placement
    return pin.SE3(_onto_axis(model, one.parentJoint).T, np.zeros(3)) * one.placement


def _writable(array: Floats) -> Floats:
    """The array, or a copy of it where numba would compile its kernels again: read-only or not contiguous."""
    flags = array.flags
    return array if flags.writeable and flags.c_contiguous else np.array(array, dtype=np.float64, order="C")


def _reach_m(model: Any, tcp: int) -> float:
    """Length of the stretched arm: the sum of the offsets from the second joint to the TCP [m]."""
    links = (*model.jointPlacements[2:], model.frames[tcp].placement)
    return sum(norm_n(link.translation) for link in links)


def _span_m(model: Any, points: Sequence[int], T_world_base: Floats) -> float:
    """Length of the stretched arm from the base to the furthest end of a segment: the sum of the offsets [m]."""
    most = 0.0
    for point in points:
        frame = model.frames[point]
        joint, far, offset = frame.parentJoint, 0.0, frame.placement.translation
        while joint > 0:
            far, offset = far + norm_n(offset), model.jointPlacements[joint].translation
            joint = model.parents[joint]
        most = max(most, far + norm_n(offset - T_world_base[:3, 3]))
    return most


def _axis_reach_m(model: Any, points: Sequence[int]) -> Floats:
    """(nv, s) largest distance of each segment from each axis, over all positions of the axes between them [m].

    The offset next to an axis turns about this axis, so only its part perpendicular to the axis counts. The offsets
    further out may point anywhere, so their full length counts. The distance from a line is convex, so it is largest
    at an end of the segment.
    """
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    reach = np.zeros((model.nv, len(points)))
    for i, point in enumerate(points):
        frame = model.frames[point]
        joint, far, offset = frame.parentJoint, 0.0, frame.placement.translation
        while joint > 0:
            axis = data.oMi[joint].actInv(pin.Motion(data.J.reshape(6, model.nv)[:, joint - 1])).angular
            reach[joint - 1, i] = far + norm_n(offset - axis * dot_n(axis, offset))
            far, offset = far + norm_n(offset), model.jointPlacements[joint].translation
            joint = model.parents[joint]
    return reach.reshape(model.nv, -1, 2).max(axis=2)


def _shift(offset_m: Vector) -> Any:
    return pin.SE3(np.eye(3), np.array(offset_m, dtype=float))


def _outside(model: Any, segments: Sequence[Segment], points: Sequence[int], tcp: int) -> float:
    """Distance of the TCP from the nearest capsule on the same joint; NaN if there is no such capsule [m]."""
    tool = model.frames[tcp]
    away = [math.nan]
    for i, segment in enumerate(segments):
        ends = [model.frames[point] for point in points[2 * i : 2 * i + 2]]
        if ends[0].parentJoint == tool.parentJoint:
            at = [frame.placement.translation for frame in (tool, *ends)]
            away.append(max(0.0, float(distance_m(at[0][None], at[1], at[2])[0]) - segment.radius_m))
    return float(np.nanmin(away)) if len(away) > 1 else math.nan


def _support(model: Any, frame: int) -> list[bool]:
    """Axes that move a frame."""
    moving = set(model.supports[model.frames[frame].parentJoint])
    return [joint in moving for joint in range(1, model.njoints)]
