"""The stages with their settings, and the robot, built from settings, cell and log.

The packages of the stages take whole sections of the settings and plain values for the rest; only drivers load them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from hrcreplay.calibration.cell import Cell
from hrcreplay.calibration.cell_objects import CellObject
from hrcreplay.calibration.hidden_areas import CameraView, hidden_floor, hidden_notes
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.human.fusion.vacancy import WatchedArea
from hrcreplay.logs.capsule_track import CapsuleTrack
from hrcreplay.logs.joints import JointTrack
from hrcreplay.logs.log_files import Header
from hrcreplay.pipeline.fusion_stage import FusionStage
from hrcreplay.pipeline.planner import Planner
from hrcreplay.pipeline.robot_mass import contact_speeds
from hrcreplay.pipeline.run_config import RunConfig, UrdfFiles, link_capsules
from hrcreplay.pipeline.surroundings import PredictionStage, Surroundings, WatchedBorder
from hrcreplay.records import ALLOWING_CONTACT, RECORDED, UNGUARDED, AxisFrame, Floats
from hrcreplay.robot.control.border import Border
from hrcreplay.robot.control.control_step import PlanSettings
from hrcreplay.robot.control.controllers import CONTROLLERS, Controller
from hrcreplay.robot.control.programme_check import check_programme
from hrcreplay.robot.control.recorded import RecordedCapsuleMotion, RecordedMotion
from hrcreplay.robot.control.static_obstacles import StaticHull, StaticObstacles, half_space
from hrcreplay.robot.model import RobotModel, Segment, from_urdf, irb140
from hrcreplay.robot.path import check_recorded, plan_programme, recorded_remarks, smooth_recorded
from hrcreplay.robot.recorded import RecordedCapsules, RecordedJoints, time_cut_ns, waiting_remarks
from hrcreplay.robot.task import Reference, Task, parse_task
from hrcreplay.settings.sections import Robot


class LogLike(Protocol):
    """The part of a log that the stages need; in a live session only a header."""

    @property
    def header(self) -> Header:
        """Cameras, task and robot base as far as they are known."""

    @property
    def joint_notes(self) -> tuple[str, ...]:
        """Remarks of the latest reading of the joints."""

    def joints(self, axes: Sequence[str], frames: Sequence[AxisFrame] = (), /) -> JointTrack | None:
        """The recorded track of the robot's axes, if there is one."""

    def capsules(self) -> CapsuleTrack | None:
        """The capsules of the recorded robot's links, if there are any."""


def fusion_stage(run_config: RunConfig, log: LogLike) -> FusionStage:
    """Makes stage 1 of a run. A camera pose of the cell file has priority over the log's.

    Raises:
        LogError: A camera's pose is in neither of them.
    """
    cell = run_config.cell or Cell()
    poses = {**log.header.poses_beside(cell.T_world_camera)[0], **cell.T_world_camera}
    for camera in log.header.cameras:
        if camera not in poses:
            raise LogError(
                f"{log.header.path}: the pose of camera {camera} is not known; "
                f"find it with: hrcreplay calibrate {log.header.path} --out cell.toml, then give --cell cell.toml"
            )
    unknown = sorted(set(cell.T_world_camera) - set(log.header.cameras))
    if unknown:
        raise SettingsError(
            f"cell: camera {unknown[0]} is not in the log; its cameras are {', '.join(log.header.cameras)}"
        )
    offsets_s = [cell.clock_offset_s.get(camera, 0.0) for camera in log.header.cameras]
    logs = run_config.settings.logs
    return FusionStage(
        T_world_camera=np.array([poses[camera] for camera in log.header.cameras]),
        clock_offset_ns=np.round(np.array(offsets_s) * 1e9).astype(np.int64),
        filter=run_config.settings.fusion,
        limits=run_config.tracking_limits,
        person_jump_m=logs.person_jump_m,
        person_memory_s=logs.person_memory_s,
        watched=watched_area(run_config),
        people=logs.people,
    )


def watched_area(run_config: RunConfig) -> WatchedArea | None:
    """Area that the cameras of a run see together, if its cell gives one."""
    given = None if run_config.cell is None else run_config.cell.watched
    if given is None:
        return None
    return WatchedArea(
        given.polygon, given.margin_m, given.clear_s, run_config.settings.fusion.fresh_s, given.speed_m_per_s
    )


def prediction_stage(run_config: RunConfig) -> PredictionStage:
    """Makes stage 2 of a run. For a live robot the latency includes ``live.reaction_s``, so the volumes are larger."""
    prediction = run_config.settings.prediction
    if run_config.command == "live":
        prediction = prediction.model_copy(
            update={"latency_s": prediction.latency_s + run_config.settings.live.reaction_s}
        )
    return PredictionStage(run_config.prediction_limits, prediction, run_config.settings.fusion.memory_s)


def surroundings(run_config: RunConfig, model: RobotModel) -> Surroundings:
    """Makes the obstacles of a run's robot.

    Raises:
        SettingsError: The robot's base lies outside the watched area of its cell.
    """
    stage, area = prediction_stage(run_config), watched_area(run_config)
    border = None
    if area is not None:
        border = WatchedBorder(area, Border.around(model, area.polygon), stage.settings.latency_s)
        if not border.border.room_m.min() > 0.0:
            base_m = np.round(model.T_world_base[:2, 3], 3).tolist()
            raise SettingsError(
                f"cell: watched.corners_m: the robot's base at {base_m} m lies outside; would be right: an area around "
                "the robot, in the world's coordinates"
            )
    return Surroundings(stage, run_config.settings.fusion.fresh_s, border)


def known_robot_base(run_config: RunConfig, log: LogLike) -> Floats | None:
    """(4, 4) pose of the robot's base in the world: from the cell file, else from the log; None if both lack it."""
    if run_config.cell is not None and run_config.cell.T_world_base is not None:
        return run_config.cell.T_world_base
    return log.header.poses_beside(run_config.cell.T_world_camera if run_config.cell is not None else {})[1]


def robot(run_config: RunConfig, T_world_base: Floats) -> RobotModel:
    """Makes the robot of a run at its base pose in the world.

    Raises:
        SettingsError: The URDF or a robot setting cannot be used.
    """
    return _robot(run_config.settings.robot, run_config.urdf, run_config.settings.prediction.stop_s, T_world_base)


def _robot(settings: Robot, files: UrdfFiles | None, stop_s: float, T_world_base: Floats) -> RobotModel:
    """Makes the robot from the parts of a run that it depends on."""
    T_tool_tcp = np.eye(4)
    T_tool_tcp[:3, :3] = Rotation.from_euler("xyz", settings.tcp_offset.rpy_deg, degrees=True).as_matrix()
    T_tool_tcp[:3, 3] = settings.tcp_offset.position_m
    tool_segments = tuple(Segment(**dict(link)) for link in settings.tool_links)
    if files is None:
        other = [key for key in ("links", "tcp_frame", "base_frame", "packages") if getattr(settings, key)]
        if other:
            raise SettingsError(f"robot.{other[0]}: found {other[0]} for the IRB 140; it goes with a robot.urdf")
        return irb140(
            T_world_base,
            stop_s=stop_s,
            tool_m=settings.tool_m,
            T_tool_tcp=T_tool_tcp,
            tool_segments=tool_segments,
            acceleration=settings.acceleration,
        )
    return from_urdf(
        files.text,
        T_world_base,
        stop_s=stop_s,
        tcp_frame=settings.tcp_frame,
        base_frame=settings.base_frame,
        tool_m=settings.tool_m,
        T_tool_tcp=T_tool_tcp,
        segments=(*link_capsules(settings, files), *tool_segments),
        acceleration=settings.acceleration,
    )


#: What gives the motion of a method.
Follower = Planner | RecordedMotion | RecordedCapsuleMotion
#: The robot as recorded.
Recorded = RecordedJoints | RecordedCapsules


@dataclass(frozen=True)
class RunProgramme:
    """The programmed path of a run, and the robot as recorded."""

    path: Reference
    notes: tuple[str, ...]  #: for the user
    begin_ns: int | None = None  #: instant at which the path starts, if the log gives one [ns]
    cuts_ns: tuple[tuple[int, int], ...] = ()  #: spans of the record that are not in the path [ns]
    recorded: Recorded | None = None  #: None: the log has neither joints of this robot nor capsules of one

    def start_s(self, start_ns: int) -> float:
        """Programmed time at the first tick [s]."""
        if self.begin_ns is None:
            return 0.0
        return (start_ns - self.begin_ns - time_cut_ns(self.cuts_ns, start_ns)) / 1e9


def programme(run_config: RunConfig, log: LogLike, model: RobotModel) -> RunProgramme:
    """Makes the programmed path: from the task file, else the log's task, else the log's joint track.

    With a task, joints of the log that do not fit the robot give a note.

    Raises:
        SettingsError: The task cannot be used, or there is none.
        LogError: Without a task: the joint track does not fit the robot.
    """
    own = (log.header.task, f"{log.header.path}: task")
    file = run_config.settings.plan.task
    table, where = (run_config.task, own[1] if file is None else str(file)) if run_config.task else own
    if table is not None:
        parts = run_config.settings.robot, run_config.urdf, run_config.settings.prediction.stop_s
        path = _programme(parse_task(table, where), where, *parts, model.T_world_base.tobytes())
        recorded, notes = _recorded_beside_task(log, model)
        return RunProgramme(replace(path, model=model), notes, recorded=recorded)
    track = log.joints(model.joint_names, model.axis_frames)
    if track is None:
        empty = f" ({', '.join(log.header.joint_topics)}: no positions that go with their names)"
        raise SettingsError(
            f"{log.header.path}: no task and no joint track{empty if log.header.joint_topics else ''}; "
            "name a task file with --set plan.task=FILE.toml"
        )
    recorded, least_s, begin_ns = _recorded(track, model), run_config.settings.plan.waiting_s, int(track.t_ns[0])
    cuts_ns = () if least_s == "keep" else recorded.waits(least_s)
    path = smooth_recorded(*recorded.without(cuts_ns), model)
    waiting = [] if least_s == "keep" else waiting_remarks(cuts_ns, begin_ns, least_s)
    notes = (*log.joint_notes, *waiting, *recorded_remarks(path))
    return RunProgramme(path, notes, begin_ns, cuts_ns, recorded)


def _recorded(track: JointTrack, model: RobotModel) -> RecordedJoints:
    """Makes the robot as recorded.

    Raises:
        LogError: The joint track does not fit the robot.
    """
    t_ns, q = check_recorded(track.t_ns, track.q, model)
    return RecordedJoints(t_ns, q, track.dq, track.gaps_ns)


def recorded_capsules(log: LogLike, T_world_base: Floats) -> tuple[RecordedCapsules | None, tuple[str, ...]]:
    """Returns the capsules of the recorded robot, with remarks; None without them.

    Raises:
        LogError: The messages do not have the fields of ``logs.robot_capsules``.
    """
    track = log.capsules()
    if track is None:
        return None, ()
    numbers = RecordedJoints(track.numbers.t_ns, track.numbers.q, track.numbers.dq, track.numbers.gaps_ns)
    return RecordedCapsules(numbers, track.names, T_world_base), track.notes


def _recorded_beside_task(log: LogLike, model: RobotModel) -> tuple[Recorded | None, tuple[str, ...]]:
    """Returns the robot as recorded in a log whose programme is a task, with remarks; None if it does not fit."""
    try:
        track = log.joints(model.joint_names, model.axis_frames)
        if track is None:
            return (None, ()) if log.header.joint_topics else recorded_capsules(log, model.T_world_base)
        return _recorded(track, model), log.joint_notes
    except (LogError, SettingsError) as error:
        return None, (f"the robot as recorded is not judged: {str(error).removeprefix(f'{log.header.path}: ')}",)


def static_hulls(objects: Sequence[CellObject], model: RobotModel) -> list[StaticHull]:
    """Returns the convex parts of a cell's objects in the world; of a half-space the part that the robot can reach."""
    found = []
    for one in objects:
        T = (model.T_world_base if one.frame == "base" else np.eye(4)) @ one.T_frame_object()
        more = (tuple(one.may_approach), one.programme_may_touch)
        if one.normal is not None:
            normal = T[:3, :3] @ np.array(one.normal)
            box = half_space(model, T[:3, 3], normal / np.linalg.norm(normal))
            found.append(StaticHull(one.name, box, 0.0, *more))
        for points_m, radius_m in one.parts():
            found.append(StaticHull(one.name, points_m @ T[:3, :3].T + T[:3, 3], radius_m, *more))
    return found


def bounded_hulls(run_config: RunConfig, model: RobotModel) -> list[StaticHull]:
    """Returns the parts of the objects of a run's cell for drawing: all but half-spaces, in the world."""
    objects = () if run_config.cell is None else run_config.cell.objects
    return static_hulls([one for one in objects if one.normal is None], model)


def static_scene(run_config: RunConfig, model: RobotModel, path: Reference, s_s: float) -> StaticObstacles | None:
    """Makes what a run's robot keeps clear of beside people; None if its cell has no objects and there is no SRDF.

    Args:
        run_config: The run.
        model: The robot.
        path: Programmed path, which is checked.
        s_s: Programmed time at which the robot begins [s].

    Raises:
        SettingsError: The robot begins inside an object, or its programme touches one that does not allow it.
    """
    objects = () if run_config.cell is None else run_config.cell.objects
    if not objects and run_config.settings.robot.srdf is None:
        return None
    disabled = [frozenset(pair) for pair in run_config.disabled_pairs]
    clearance_m = run_config.settings.plan.clearance_m
    return check_programme(model, path, static_hulls(objects, model), clearance_m, path.sample(s_s).q, disabled)


@lru_cache(maxsize=4)  # a live session makes its controller twice: to compile the kernels, and to run
def _programme(
    task: Task, where: str, settings: Robot, files: UrdfFiles | None, stop_s: float, T_world_base: bytes
) -> Reference:
    """Makes the path of a task for a robot; the other arguments are those of ``_robot``."""
    model = _robot(settings, files, stop_s, np.frombuffer(T_world_base).reshape(4, 4))
    return plan_programme(task, model, where)


def planners(run_config: RunConfig, given: RunProgramme, start_ns: int) -> dict[str, Planner]:
    """Makes stage 3: the chosen method and its baselines, each with its own robot."""
    plan, dt_s, s_s = run_config.settings.plan, 1.0 / run_config.settings.fusion.rate_hz, given.start_s(start_ns)
    static = static_scene(run_config, given.path.model, given.path, s_s)

    def planner(name: str) -> Planner:
        settings = plan_settings(run_config, dt_s, name)
        controller = make_controller(name, given.path.model, given.path, settings, s_s, static)
        return Planner(controller, chosen=name == plan.method)

    return {name: planner(name) for name in dict.fromkeys((plan.method, *plan.baselines))}


def recorded_motion(
    run_config: RunConfig, model: RobotModel, recorded: Recorded, static: StaticObstacles | None
) -> RecordedMotion | RecordedCapsuleMotion:
    """Makes the motion of the robot as recorded, beside the volumes of the run.

    Args:
        run_config: The run.
        model: The robot of the settings.
        recorded: The robot as recorded.
        static: What its joints are measured against beside people; None: nothing.
    """
    if isinstance(recorded, RecordedCapsules):
        return RecordedCapsuleMotion(model, recorded)
    settings = plan_settings(run_config, 1.0 / run_config.settings.fusion.rate_hz, RECORDED)
    return RecordedMotion(model, recorded, settings, static)


def followers(run_config: RunConfig, given: RunProgramme, start_ns: int) -> dict[str, Follower]:
    """Makes all motions of a run: the chosen method, its baselines and, with joints in the log, the recorded robot."""
    planned = planners(run_config, given, start_ns)
    found: dict[str, Follower] = {**planned}
    if given.recorded is not None:
        static = next(iter(planned.values())).static
        found[RECORDED] = recorded_motion(run_config, given.path.model, given.recorded, static)
    return found


def scene_notes(run_config: RunConfig, log: LogLike, moved: Mapping[str, Follower]) -> list[str]:
    """Returns notes on what the robots of a run keep clear of beside people, and on where objects hide people."""
    one = next(iter(moved.values()))
    static = one.static
    return [*(() if static is None else static.notes), *hidden_area_notes(run_config, log, one.robot)]


def hidden_area_notes(run_config: RunConfig, log: LogLike, model: RobotModel) -> list[str]:
    """Returns notes on where near the robot somebody may be whom no camera sees; none for a cell without objects.

    Raises:
        SettingsError: The cell names the view of a camera that the log does not have.
    """
    cell = run_config.cell or Cell()
    unknown = sorted(set(cell.views) - set(log.header.cameras))
    if unknown:
        raise SettingsError(
            f"cell: views.{unknown[0]}: not in the log; its cameras are {', '.join(log.header.cameras)}"
        )
    if not cell.objects:
        return []
    missing = [name for name in log.header.cameras if name not in cell.views]
    if missing:
        needed = f"the cell file does not say what {missing[0]} sees (views.{missing[0]}, fov_deg)"
        return [f"cameras: where objects hide people is not known, as {needed}"]
    poses = {**log.header.T_world_camera, **cell.T_world_camera}
    views = []
    for name in log.header.cameras:
        across, down = (0.5 * np.radians(whole) for whole in cell.views[name].fov_deg)
        views.append(CameraView(poses[name], (float(across), float(down)), cell.views[name].range_m))
    hulls = [(hull.vertices_m, hull.radius_m) for hull in static_hulls(cell.objects, model)]
    base_m = model.T_world_base[:3, 3]
    return hidden_notes(hidden_floor(views, hulls, base_m), base_m)


def robot_base(run_config: RunConfig, log: LogLike) -> Floats:
    """(4, 4) pose of the robot's base in the world, which must be known.

    Raises:
        SettingsError: Both the cell and the log lack it.
    """
    T_world_base = known_robot_base(run_config, log)
    if T_world_base is None:
        raise SettingsError(
            f"{log.header.path}: where the robot stands is not known; give a --cell file with T_world_base"
        )
    return T_world_base


def plan_settings(run_config: RunConfig, dt_s: float, method: str) -> PlanSettings:
    """Returns the settings of Section 5 for ticks of ``dt_s`` [s] and a method."""
    plan, stage = run_config.settings.plan, prediction_stage(run_config)
    prediction, area = stage.settings, watched_area(run_config)
    contact = None
    if method in ALLOWING_CONTACT:
        sides = 0 if area is None else len(area.polygon.normals)
        contact = contact_speeds(run_config.settings, stage.limbs, sides)
    return PlanSettings(
        plan,
        dt_s=dt_s,
        stop_s=prediction.stop_s,
        latency_s=prediction.latency_s,
        spare_ticks=int(run_config.command == "live"),
        certified=plan.certify and method not in UNGUARDED,
        retreat_m=plan.retreat_m if plan.certify and method == "qp" else 0.0,
        contact=contact,
    )


def make_controller(
    method: str,
    model: RobotModel,
    path: Reference,
    settings: PlanSettings,
    s_s: float,
    static: StaticObstacles | None,
) -> Controller:
    """Makes a controller that follows a path by a method, from ``s_s`` seconds of programmed time on.

    Args:
        method: One of ``plan.method``.
        model: The robot.
        path: Programmed path.
        settings: Section 5 for the length of a tick.
        s_s: Programmed time at the start [s].
        static: What the robot keeps clear of beside people; None: nothing.
    """
    return CONTROLLERS[method](model, path, settings, s_s, static)
