"""An arm with known inertias, and what it does by itself when a spring pushes it."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from hrcreplay.records import Floats
from hrcreplay.robot import irb140

#: Mass [kg], centre [m] and moments of inertia about it [kg m^2] of each link; about those of an arm of 35 kg.
LINKS = (
    (12.0, (0.03, 0.0, -0.05), (0.12, 0.12, 0.10)),
    (10.0, (0.0, 0.02, 0.17), (0.15, 0.16, 0.03)),
    (6.0, (0.08, 0.0, 0.01), (0.02, 0.06, 0.06)),
    (3.5, (-0.10, 0.0, 0.0), (0.01, 0.02, 0.02)),
    (1.5, (0.0, 0.0, 0.0), (0.003, 0.003, 0.002)),
    (0.5, (0.02, 0.0, 0.0), (0.0008, 0.0005, 0.0005)),
)


def urdf(links: tuple[tuple[float, tuple[float, ...], tuple[float, ...]], ...] = LINKS) -> str:
    """The axes of the IRB 140 with these links."""
    text = irb140.urdf()
    for number, (mass, centre, moments) in enumerate(links, start=1):
        inertia = (
            f"<inertial><origin xyz='{' '.join(map(str, centre))}'/><mass value='{mass}'/>"
            f"<inertia ixx='{moments[0]}' iyy='{moments[1]}' izz='{moments[2]}' ixy='0' ixz='0' iyz='0'/></inertial>"
        )
        text = text.replace(f"<link name='link_{number}'/>", f"<link name='link_{number}'>{inertia}</link>")
    return text


class Arm:
    """The same arm as pinocchio has it alone, with free axes and without gravity."""

    def __init__(self, payload_kg: float = 0.0, tool_m: float = 0.1) -> None:
        self.model = pin.buildModelFromXML(urdf())
        self.model.gravity.linear = np.zeros(3)
        if payload_kg:
            flange = self.model.frames[self.model.getFrameId("flange")]
            point = flange.placement * pin.SE3(np.eye(3), np.array([0.0, 0.0, tool_m]))
            self.model.appendBodyToJoint(
                flange.parentJoint, pin.Inertia(payload_kg, np.zeros(3), np.zeros((3, 3))), point
            )
        self.data = self.model.createData()

    def push(
        self, q: Floats, dq: Floats, joint: int, offset_m: Floats, normal: Floats, person: tuple[float, float, float]
    ) -> float:
        """Lets a point of a link run against a body behind a spring; returns the most energy of the spring [J].

        Args:
            q: (6,) positions as it touches [rad].
            dq: (6,) velocities then [rad/s].
            joint: Joint that moves the link, from 1.
            offset_m: (3,) the point in that joint's frame [m].
            normal: (3,) direction from the link to the body, in which the body can move.
            person: Mass of the body [kg], spring constant [N/m], and its speed towards the link [m/s].
        """
        mass, stiffness, speed = person
        state = np.concatenate([q, dq, [0.0, -speed]])  # and way and velocity of the body along the normal
        start = self._point(q, joint, offset_m)
        most, step_s = 0.0, 2e-4

        def change(state: Floats) -> Floats:
            q, dq, way, velocity = state[:6], state[6:12], state[12], state[13]
            pressed = max(0.0, float((self._point(q, joint, offset_m) - start) @ normal) - way)
            force = stiffness * pressed
            R = self.data.oMi[joint].rotation.copy()
            pushed = pin.Force(R.T @ (-force * normal), np.cross(offset_m, R.T @ (-force * normal)))
            forces = [pin.Force.Zero() for _ in range(self.model.njoints)]
            forces[joint] = pushed
            ddq = pin.aba(self.model, self.data, q, dq, np.zeros(6), forces)
            return np.concatenate([dq, ddq, [velocity, force / mass]])

        for _ in range(4000):
            a = change(state)
            b = change(state + 0.5 * step_s * a)
            c = change(state + 0.5 * step_s * b)
            d = change(state + step_s * c)
            state = state + step_s / 6.0 * (a + 2.0 * b + 2.0 * c + d)
            pressed = float((self._point(state[:6], joint, offset_m) - start) @ normal) - state[12]
            if pressed <= 0.0:
                break
            most = max(most, 0.5 * stiffness * pressed**2)
        return most

    def _point(self, q: Floats, joint: int, offset_m: Floats) -> Floats:
        pin.forwardKinematics(self.model, self.data, q)
        return np.asarray(self.data.oMi[joint].act(offset_m))
