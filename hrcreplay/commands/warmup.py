"""What each process of ``warmup`` runs so that the kernels of all commands are compiled.

The robot does not wait for the fusion: it moves beside a person that is written down. So the two processes have about
the same amount to compile. What both call is compiled by the one that comes to it first, and found by the other.
"""

from __future__ import annotations

import gc
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numpy as np

from hrcreplay.calibration.registration import find_clock_offset
from hrcreplay.commands import replay
from hrcreplay.geometry.convex_hull import above, visible_front
from hrcreplay.geometry.distances import farthest_at_most
from hrcreplay.geometry.inflated_hull import InflatedHull
from hrcreplay.geometry.polyline import advance_foot, follow_nearer, nearest_vertices
from hrcreplay.geometry.small_matrices import multiply
from hrcreplay.human.fusion.fuse import MEDIAN_LENGTHS_M
from hrcreplay.human.model import skeleton
from hrcreplay.human.prediction import swept_volumes
from hrcreplay.logs.reader import Log, open_log
from hrcreplay.pipeline import assembly, stages
from hrcreplay.pipeline.progress import NO_PROGRESS
from hrcreplay.pipeline.run_config import RunConfig, resolve
from hrcreplay.records import BODY, DOF, POINTS, HumanStates, SkeletonTrack
from hrcreplay.robot.control.minimiser import compile_second_tries
from hrcreplay.robot.control.separation import no_obstacles
from hrcreplay.settings.sections import Plan
from hrcreplay.store.columns import read_states, state_columns
from hrcreplay.store.run_folder import RunWriter, Stopwatch

_SPAN: Any = {"start_s": 8.0, "end_s": 8.4}
_METHODS: tuple[str, ...] = get_args(Plan.model_fields["method"].annotation)
_SEARCH_S, _FRAMES = 0.01, 500  # of clock offsets
_HORIZON_S = 0.1
#: New objects before the collector of garbage looks: a compiler makes and keeps many, and a look takes long.
_GARBAGE = 1_000_000
#: Distance of the person from the robot's base at the first and the last tick [m].
_FAR_M, _NEAR_M = 2.0, 0.3


def compile_part(part: str) -> None:
    """Compiles one of ``kernel_build.PARTS`` in this process."""
    gc.set_threshold(_GARBAGE)
    with tempfile.TemporaryDirectory() as scratch:
        _PARTS[part](Path(scratch))


def _compile_person(scratch: Path) -> None:
    """Predictions, fusion and smoothing, and a robot on its path beside the recorded person.

    The sound prediction comes first: the other process needs it once its robot has moved with nobody there.
    """
    from hrcreplay.evaluation.judging import write_contact

    how: Any = {"cell_file": replay.demo_cell(), **_SPAN}
    ahead = resolve("plan", replay.demo_log(), **how)
    person = _approaching(ahead, open_log(ahead.log, ahead.settings.logs))
    assembly.prediction_stage(ahead).predictor.prepare(person).volumes(_HORIZON_S, last=1)
    fused = replay.run("fuse", replay.demo_log(), out=scratch / "fuse", smooth=True, **how)
    run_config = resolve("plan", fused, overrides=("plan.method=ssm", "plan.baselines=[]"))
    moved = replay.execute(run_config, scratch / "ssm")
    for method in swept_volumes.PRINTED:
        replay.run("predict", fused, out=scratch / method, overrides=(f"prediction.method={method}",))
    states = next(read_states(fused / "state.parquet", 50))
    for method in swept_volumes.METHODS:
        assembly.prediction_stage(run_config).by(method).reachable(states)
    _compile_rest(states)
    log = open_log(run_config.log, run_config.settings.logs)
    with RunWriter(scratch / "contact") as writer:
        for path in moved.glob("*.parquet"):
            writer.copy(path.name, moved)
        write_contact(run_config, log, writer, assembly.robot_base(run_config, log))


def _compile_rest(states: HumanStates) -> None:
    """What only long runs, figures and pages call: clock check, contact with a smoothed person, pictures of hulls."""
    points_m = np.resize(skeleton(states.p, states.lengths_m), (_FRAMES, len(POINTS), 3))
    track = SkeletonTrack(4_000_000 * np.arange(_FRAMES), points_m, np.ones(points_m.shape[:2]))
    find_clock_offset(track, track, search_s=_SEARCH_S)
    hull = InflatedHull.around(np.vstack([np.zeros(3), np.eye(3)]), 0.1)
    hull.distances_m(np.ones((2, 3)))
    farthest_at_most(np.ones((2, 3)), hull.vertices_m, 0.1)
    above(hull.vertices_m, hull.faces, 0.1)
    turn, pixels_m = np.eye(3)[:, :2].copy(), np.linspace(-1.0, 1.0, 4)
    for corners_m in (np.asfortranarray(hull.vertices_m), np.ones((4, 6))[:, ::2]):  # of tables
        multiply(corners_m, turn)
    nearest_vertices(np.ones((2, 3)), np.eye(3))
    follow_nearer(np.ones((2, 3)), np.eye(3), np.zeros(2, np.int64))
    advance_foot(np.ones((2, 3)), np.eye(3), np.arange(3.0), np.arange(2), 1.0, 0.1)
    visible_front(hull.vertices_m[hull.faces], np.ones(len(hull.faces)), pixels_m, pixels_m)


def _compile_robot(scratch: Path) -> None:
    """Every controller, beside a person who comes up to the robot.

    Before that each of them moves with nobody there, so that the other process has compiled the prediction by then.
    """
    overrides = ("plan.method=qp", f"plan.baselines={[name for name in _METHODS if name != 'qp']}")
    how: Any = {"cell_file": replay.demo_cell(), "overrides": overrides, **_SPAN}
    run_config = resolve("plan", replay.demo_log(), **how)
    log = open_log(run_config.log, run_config.settings.logs)
    robot = assembly.robot(run_config, assembly.robot_base(run_config, log))
    programme = assembly.programme(run_config, log, robot)
    ticks_ns = stages.span_ticks(run_config, log)
    for planner in assembly.planners(run_config, programme, int(ticks_ns[0])).values():
        planner.controller.step(lambda _horizon_s: no_obstacles())
    with RunWriter(scratch / "robot") as writer:
        writer.table("state", state_columns(_approaching(run_config, log)))
        writer.close_tables()
        sink = stages.Sink(writer, Stopwatch(time.perf_counter_ns), NO_PROGRESS.advance)
        how = {"folder": writer.partial, "smooth": False}
        replay.run_stages(run_config, log, ticks_ns, len(ticks_ns), sink, ("fuse",), **how)
    compile_second_tries()


def _approaching(run_config: RunConfig, log: Log) -> HumanStates:
    """A person who comes up to the robot in x, known at all ticks."""
    ticks_ns, cameras = stages.span_ticks(run_config, log), log.header.cameras
    base_m = assembly.robot_base(run_config, log)[:3, 3]
    n, none = len(ticks_ns), np.zeros((len(ticks_ns), DOF))
    p = np.tile([0.0, base_m[1], np.pi, 0.1, *(0.1, 0.5, 0.0, 1.8) * 2, 0.94], (n, 1))
    p[:, 0] = base_m[0] + np.linspace(_FAR_M, _NEAR_M, n)
    lengths_m = np.tile(MEDIAN_LENGTHS_M, (n, 1))
    return HumanStates(
        t_ns=ticks_ns,
        p=p,
        v=none.copy(),
        a=none.copy(),
        j=none.copy(),
        p_std=none + 0.01,
        v_std=none + 0.05,
        lengths_m=lengths_m,
        lengths_std_m=np.full_like(lengths_m, 0.01),
        valid=np.ones((n, len(cameras)), dtype=bool),
        residual_m=np.full((n, len(BODY)), 0.02),
        unseen_s=np.zeros((n, len(BODY))),
        frame_age_s=np.zeros(n),
        points_m=skeleton(p, lengths_m),
        cameras=cameras,
    )


_PARTS: dict[str, Callable[[Path], None]] = {"person": _compile_person, "robot": _compile_robot}
