"""``make benchmark`` or ``pytest --benchmark-only``: a pose beside the bare pinocchio calls it cannot do without."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from hrcreplay.robot import irb140 as description
from hrcreplay.robot.model import irb140
from hrcreplay.robot.path import plan_programme
from hrcreplay.robot.task import parse_task

Q, DQ = np.array([0.3, 0.2, -0.4, 0.5, 0.6, -0.7]), np.array([1.0, -0.5, 0.4, 2.0, -1.0, 3.0])


@pytest.mark.benchmark(group="pose")
def test_pose(benchmark: Any) -> None:
    robot = irb140(np.eye(4), stop_s=0.377)
    robot.pose(Q, DQ)
    pose = benchmark(robot.pose, Q, DQ)
    assert np.isfinite(pose.J_ends).all()


@pytest.mark.benchmark(group="pose")
def test_bare_pinocchio(benchmark: Any) -> None:
    """The same quantities by one pinocchio call each: eleven frames, their Jacobians and one acceleration."""
    model = pin.buildModelFromXML(description.urdf())
    data = model.createData()
    still = np.zeros(6)
    frames = [model.getFrameId(f"link_{i}") for i in (1, 1, 2, 2, 3, 3, 5, 5, 6, 6, 6)]

    def calls() -> list[Any]:
        pin.forwardKinematics(model, data, Q, DQ, still)
        pin.computeJointJacobians(model, data, Q)
        pin.updateFramePlacements(model, data)
        found = [pin.getFrameClassicalAcceleration(model, data, frames[0], pin.LOCAL_WORLD_ALIGNED).vector]
        for frame in frames:
            found += [
                pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED),
                data.oMf[frame].translation.copy(),
            ]
        return found

    assert len(benchmark(calls)) == 23


@pytest.mark.benchmark(group="reference")
def test_sample(benchmark: Any) -> None:
    task = parse_task({"waypoints": [{"joints_deg": [0] * 6}, {"joints_deg": [90, 0, 0, 0, 0, 0]}]})
    reference = plan_programme(task, irb140(np.eye(4), stop_s=0.377))
    assert np.isfinite(benchmark(reference.sample, 0.5).twist).all()
