"""The kernels of the kinematics against pinocchio, which computes every quantity in another way."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from hrcreplay.records import Floats
from hrcreplay.robot import irb140 as irb140_data
from hrcreplay.robot.model import RobotModel, Segment, from_urdf, irb140

#: Axes in any direction, also a tenth of a degree off z, and origins that turn and shift.
OBLIQUE = (
    ("0.3 -0.7 0.2", "0.1 0.0 0.4", "0.5 0.1 -0.3"),
    ("0 0 -1", "0.2 0.1 0.0", "1.4 -0.2 0.8"),
    ("0.001 0 1", "0.0 -0.1 0.3", "0 0 0"),
    ("-1 0 0", "0.3 0.0 0.0", "-2.0 1.0 0.1"),
    ("1 1 1", "0.0 0.0 0.2", "0.3 0.3 0.3"),
)


def oblique() -> str:
    """URDF of a robot with oblique axes."""
    joints = "".join(
        f"<joint name='j{i}' type='revolute'><parent link='l{i}'/><child link='l{i + 1}'/>"
        f"<origin xyz='{xyz}' rpy='{rpy}'/><axis xyz='{axis}'/>"
        "<limit lower='-3' upper='3' velocity='2' effort='1'/></joint>"
        for i, (axis, xyz, rpy) in enumerate(OBLIQUE)
    )
    links = "".join(f"<link name='l{i}'/>" for i in range(len(OBLIQUE) + 1))
    return f"<robot name='oblique'>{links}{joints}</robot>"


CAPSULES = (
    Segment("base", "l0", (0.0, 0.0, 0.0), (0.1, 0.0, 0.2), 0.1),
    Segment("middle", "l3", (0.1, -0.2, 0.0), (0.0, 0.3, 0.2), 0.1),
    Segment("hand", "l5", (0.0, 0.0, 0.1), (0.2, 0.1, 0.0), 0.1),
)


def placed() -> Floats:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("zyx", [0.7, 0.2, -0.1]).as_matrix(), (0.4, -1.2, 0.65)
    return T


def robots() -> list[tuple[RobotModel, str, str, float]]:
    """Robots with their URDF, the link of the tool, and the distance of the tool point along its z axis [m]."""
    tilted = from_urdf(oblique(), placed(), stop_s=0.5, segments=CAPSULES, tool_m=0.07)
    return [
        (irb140(placed(), stop_s=0.377, tool_m=0.17), irb140_data.urdf(), "flange", 0.17),
        (tilted, oblique(), "l5", 0.07),
    ]


class ByPinocchio:
    """The same robot, its base moved after the computation."""

    def __init__(self, robot: RobotModel, xml: str, tool: str, tool_m: float) -> None:
        self.model = pin.buildModelFromXML(xml)
        offsets = [(s.body, end) for s in robot.segments for end in (s.start_m, s.end_m)]
        self.points = [self._add(body, np.array(end, dtype=float)) for body, end in offsets]
        self.tcp = self._add(tool, np.array([0.0, 0.0, tool_m]))
        self.data, self.R, self.t = self.model.createData(), placed()[:3, :3], placed()[:3, 3]

    def _add(self, body: str, offset_m: Floats) -> int:
        frame = self.model.frames[self.model.getFrameId(body)]
        placement = frame.placement * pin.SE3(np.eye(3), offset_m)
        return int(self.model.addFrame(pin.Frame(f"p{self.model.nframes}", frame.parentJoint, placement, frame.type)))

    def run(self, q: Floats, dq: Floats) -> None:
        pin.forwardKinematics(self.model, self.data, q, dq, np.zeros_like(q))
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateFramePlacements(self.model, self.data)

    def jacobian(self, frame: int) -> Floats:
        J = pin.getFrameJacobian(self.model, self.data, frame, pin.LOCAL_WORLD_ALIGNED)
        return np.vstack([self.R @ J[:3], self.R @ J[3:]])

    def at(self, frame: int) -> Floats:
        return np.asarray(self.R @ self.data.oMf[frame].translation + self.t)

    def acceleration(self) -> Floats:
        a = pin.getFrameClassicalAcceleration(self.model, self.data, self.tcp, pin.LOCAL_WORLD_ALIGNED)
        return np.concatenate([self.R @ a.linear, self.R @ a.angular])


@pytest.mark.parametrize("index", [0, 1])
def test_poses_jacobians_and_drift_are_those_of_pinocchio(index: int) -> None:
    robot = robots()[index][0]
    theirs, rng = ByPinocchio(*robots()[index]), np.random.default_rng(3)
    for _ in range(200):
        q, dq = rng.uniform(-3.0, 3.0, robot.nv), rng.normal(size=robot.nv) * 2.0
        pose = robot.pose(q, dq)
        theirs.run(q, dq)
        assert_allclose(pose.T_world_tcp[:3, 3], theirs.at(theirs.tcp), rtol=0, atol=1e-12)
        turned = theirs.R @ theirs.data.oMf[theirs.tcp].rotation
        assert_allclose(pose.T_world_tcp[:3, :3], turned, rtol=0, atol=1e-12)
        assert_allclose(pose.J_tcp, theirs.jacobian(theirs.tcp), rtol=0, atol=1e-12)
        assert_allclose(pose.twist_tcp, theirs.jacobian(theirs.tcp) @ dq, rtol=0, atol=1e-11)
        assert_allclose(pose.dJdq_tcp, theirs.acceleration(), rtol=0, atol=1e-10)
        for n, point in enumerate(theirs.points):
            assert_allclose(pose.ends_m[n // 2, n % 2], theirs.at(point), rtol=0, atol=1e-12)
            assert_allclose(pose.J_ends[n // 2, n % 2], theirs.jacobian(point)[:3], rtol=0, atol=1e-12)


@pytest.mark.parametrize("index", [0, 1])
def test_ends_and_rotations_of_links_are_those_of_pinocchio(index: int) -> None:
    robot = robots()[index][0]
    theirs, rng = ByPinocchio(*robots()[index]), np.random.default_rng(4)
    q, dq = rng.uniform(-3.0, 3.0, (20, robot.nv)), rng.normal(size=(20, robot.nv))
    motion = robot.link_motion(q, dq)
    for i in range(20):
        theirs.run(q[i], dq[i])
        ends = np.array([theirs.at(point) for point in theirs.points]).reshape(-1, 2, 3)
        assert_allclose(robot.ends_m(q[i]), ends, rtol=0, atol=1e-12)
        assert_allclose(motion.ends_m[i], ends, rtol=0, atol=1e-12)
        turned = [theirs.R @ theirs.data.oMf[point].rotation for point in theirs.points[::2]]
        assert_allclose(robot.R_bodies(q[i]), turned, rtol=0, atol=1e-12)
        for s, point in enumerate(theirs.points[::2]):
            J = theirs.jacobian(point) @ dq[i]
            origin = J[:3] - np.cross(J[3:], theirs.at(point))  # of the link's point at the world's origin
            assert_allclose(motion.twist[i, s], [*origin, *J[3:]], rtol=0, atol=1e-11)


def test_a_table_whose_rows_are_read_only_compiles_no_kernel_again() -> None:
    from hrcreplay.robot.kinematics import pose_at

    robot, _, _, _ = robots()[0]
    table: Any = np.random.default_rng(5).normal(size=(4, 12))
    robot.pose(table[0, :6].copy(), table[0, 6:].copy())
    kinds = len(pose_at.signatures)
    table.flags.writeable = False
    robot.pose(table[1, :6], table[1, 6:])
    robot.pose(table[2, ::2], np.asfortranarray(table[:, :6])[3])
    assert len(pose_at.signatures) == kinds
