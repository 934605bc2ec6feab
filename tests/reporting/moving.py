"""The made-up run of ``synthetic`` with a robot whose joints move, and the recorded body: what the 3-D replay shows."""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd

from hrcreplay.human.model import PARTS, part_axes, skeleton
from hrcreplay.records import Floats
from hrcreplay.reporting.metrics.series import start_ns
from hrcreplay.reporting.replay_scene import ReplayScene, replay_scene
from hrcreplay.robot.model import RobotModel, irb140
from hrcreplay.store.columns import body_columns
from hrcreplay.store.run_folder import Run
from tests.reporting.synthetic import LENGTHS_M, frame_of, make_run, pose

#: Radius of each capsule of the recorded body [m].
BODY_RADII_M = {part: 0.05 + 0.01 * i for i, part in enumerate(PARTS[:6])}


def robot(run: Run) -> RobotModel:
    """The IRB 140 where the run has it."""
    assert run.T_world_base is not None
    return irb140(run.T_world_base, stop_s=0.377)


def joints(t_s: Floats) -> tuple[Floats, Floats]:
    """(n, 6) joint positions and velocities in closed form [rad, rad/s]."""
    rate, phase = 0.3 + 0.1 * np.arange(6), np.arange(6)
    angle = t_s[:, None] * rate + phase
    return 0.7 * np.sin(angle), np.asarray(0.7 * rate * np.cos(angle), dtype=np.float64)


def moving_run(seconds: float = 8.0) -> Run:
    """A run with joints, stops of 0.2 s and a body at every tick, whose robot touches the body from 3.0 to 3.5 s."""
    run = make_run(seconds)
    assert run.motion is not None
    motion = _with_joints(frame_of(run.motion))
    t_ns = motion["t_ns"].to_numpy()
    t_s = (t_ns - t_ns[0]) * 1e-9
    axes = part_axes(skeleton(pose(t_s), np.tile(LENGTHS_M, (len(t_s), 1))), 0.1)[:, : len(BODY_RADII_M)]
    return dataclasses.replace(
        run,
        meta=run.meta | {"settings": run.meta["settings"] | {"plan": {"method": "qp", "certify": True}}},
        motion=motion,
        baselines={name: _with_joints(frame_of(table)) for name, table in run.baselines.items()},
        body=pd.DataFrame(body_columns(t_ns, axes, tuple(BODY_RADII_M))),
        contact=pd.concat([_contact(t_ns, t_s, method) for method in ("qp", *run.baselines)]),
    )


def moving_scene(run: Run) -> ReplayScene:
    """The replay of such a run."""
    scene = replay_scene(run, robot(run), start_ns(run), BODY_RADII_M)
    assert scene is not None
    return scene


def _with_joints(motion: pd.DataFrame) -> pd.DataFrame:
    t_s = (motion["t_ns"].to_numpy() - motion["t_ns"].iloc[0]) * 1e-9
    q, dq = joints(t_s)
    columns = {f"q{i + 1}": q[:, i] for i in range(6)} | {f"dq{i + 1}": dq[:, i] for i in range(6)}
    return motion.assign(**columns, tau_s=0.2, horizon_s=0.25, certified=True)


def _contact(t_ns: np.ndarray, t_s: Floats, method: str) -> pd.DataFrame:
    touching = (t_s >= 3.0) & (t_s < 3.5) & (method != "qp")
    distance_m = np.where(touching, -0.02 - 0.01 * (t_s - 3.0), 0.4)
    return pd.DataFrame(
        {
            "t_ns": t_ns,
            "method": method,
            "person": "ground truth",
            "moving": True,
            "distance_m": distance_m,
            "person_m": distance_m,
            "other_m": np.nan,
            "source": "ground truth",
            "limb": "LRA",
            "link": "tool",
            "tcp_speed": 0.3,
            "contact_speed": 0.2 + 0.1 * (t_s > 3.2),
            "outside_m": np.nan,
            "left_m": np.nan,
            "left_limb": None,
            "left_full_m": np.nan,
            "left_full_limb": None,
        }
    )


#: Where person 2 of ``two_people`` is beside person 1 [m].
SECOND_M = np.array([0.5, -0.25, 0.0])


def two_people(run: Run) -> Run:
    """The run with a second person who does all that the first does, somewhere else."""
    of_state, of_volumes, of_body = frame_of(run.state), frame_of(run.occupancy), frame_of(run.body)
    state = of_state.assign(**{axis: of_state[axis] + SECOND_M[k] for k, axis in enumerate("xy")})
    moved = [np.ravel(np.reshape(flat, (-1, 3)) + SECOND_M) for flat in of_volumes["vertices"]]
    ends = [str(name) for name in of_body.columns[1:]]
    body = {name: of_body[name] + SECOND_M["xyz".index(name[-1])] for name in ends}
    return dataclasses.replace(
        run,
        state=_both(of_state, state),
        occupancy=_both(of_volumes, of_volumes.assign(vertices=pd.Series(moved, of_volumes.index))),
        body=_both(of_body, of_body.assign(**body)),
    )


def _both(first: pd.DataFrame, second: pd.DataFrame) -> pd.DataFrame:
    whole = pd.concat([first.assign(person=1), second.assign(person=2)])
    return whole.sort_values(["t_ns", "person"], kind="stable").reset_index(drop=True)
