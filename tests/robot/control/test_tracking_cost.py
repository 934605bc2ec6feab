from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hrcreplay.robot.control.qp_controller import pose_error, tracking_cost, with_posture
from hrcreplay.robot.model import irb140

DT_S = 0.004


def test_the_cost_is_eq_66a() -> None:
    robot = irb140(np.eye(4), stop_s=0.377)
    rng = np.random.default_rng(11)
    Q_p, Q_v = np.repeat([0.3, 0.2], 3), np.repeat([1.5, 0.7], 3)
    for _ in range(20):
        q, dq, error, twist = rng.normal(size=(4, 6)) * 0.5
        pose = robot.pose(q, dq)
        J, dJdq = pose.J_tcp, pose.dJdq_tcp
        H, g = tracking_cost(error, J, dJdq, dq, twist, (0.3, 0.2), (1.5, 0.7), 0.0, DT_S)

        w, w0 = dq + DT_S * rng.normal(size=6), dq
        costs = []
        for u in ((w - dq) / DT_S, (w0 - dq) / DT_S):
            x_next = error + DT_S * J @ dq + DT_S**2 / 2 * (dJdq + J @ u)
            dx_next = J @ dq + DT_S * (dJdq + J @ u)
            costs.append((dx_next - twist) ** 2 @ Q_v + x_next**2 @ Q_p)
        mine = 2 * (0.5 * w @ H @ w + g @ w) - 2 * (0.5 * w0 @ H @ w0 + g @ w0)
        assert mine == pytest.approx(costs[0] - costs[1], abs=1e-5)
        assert np.all(np.linalg.eigvalsh(H) > 0.0)


def test_the_error_in_pose_is_what_leads_back() -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        way, turn = rng.uniform(-1.7, 1.7, (2, 3))  # a turn of less than pi has one rotation vector
        T_ref, T = np.eye(4), np.eye(4)
        T_ref[:3, :3] = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
        T_ref[:3, 3] = rng.normal(size=3)
        T[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ T_ref[:3, :3]
        T[:3, 3] = T_ref[:3, 3] + way
        np.testing.assert_allclose(pose_error(T, T_ref), [*way, *turn], atol=1e-12)


def test_the_posture_costs_what_its_distance_from_the_way_back_does() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        root, g, away = rng.normal(size=(6, 6)), rng.normal(size=6), rng.normal(size=6)
        H = root @ root.T
        H_too, g_too = with_posture(H, g, away, 0.3)
        w, v = rng.normal(size=(2, 6))
        curvature = 0.3 * np.linalg.eigvalsh(H).mean()
        costs = []
        for x in (w, v):
            back = x + away  # at 1/s of the way
            costs.append(0.5 * x @ H @ x + g @ x + 0.5 * curvature * back @ back)
        mine = (0.5 * w @ H_too @ w + g_too @ w) - (0.5 * v @ H_too @ v + g_too @ v)
        assert mine == pytest.approx(costs[0] - costs[1], rel=1e-9)
        as_before = with_posture(H, g, away, 0.0)
        np.testing.assert_array_equal(as_before[0], H)
        np.testing.assert_array_equal(as_before[1], g)
