"""Set-up of a live session: from its settings to a table that is recorded, and from the table to the controller.

The table contains everything that the decisions depend on, so the record is sufficient to build the controller again.
``compile_kernels`` compiles every kernel and loads every library before the robot waits for an answer.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hrcreplay.calibration.cell import Cell
from hrcreplay.egm.codec import ARM_JOINTS, MOST_JOINTS, Mci, Motors, Rapid, RobotPacket, encode_robot
from hrcreplay.egm.link import EgmSession
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.human.fusion.fuse import MEDIAN_LENGTHS_M
from hrcreplay.human.model import skeleton
from hrcreplay.live.control.session_controller import SessionController
from hrcreplay.live.control.stages import ControlSetup, Observer
from hrcreplay.live.record import codec
from hrcreplay.live.record.codec import Signal, TickEvent
from hrcreplay.logs import skeleton_pb2
from hrcreplay.logs.capsule_track import CapsuleTrack
from hrcreplay.logs.joints import JointTrack
from hrcreplay.logs.log_files import Header
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.run_config import RunConfig, recorded_limits, resolve, resolve_without_log
from hrcreplay.records import AxisFrame, Floats, Ints
from hrcreplay.robot.control import certificate, qp_controller
from hrcreplay.robot.control.control_step import RobotState
from hrcreplay.robot.control.controllers import Controller, QpController
from hrcreplay.robot.control.minimiser import compile_second_tries
from hrcreplay.robot.control.static_obstacles import StaticObstacles
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.task import Reference
from hrcreplay.settings.load import Settings, load_settings
from hrcreplay.settings.sections import with_new_names
from hrcreplay.toml_file import validate
from hrcreplay.version import __version__


@dataclass(frozen=True)
class HeaderOnlyLog:
    """The header in place of a log that does not exist yet; see ``build.LogLike``."""

    header: Header

    joint_notes: tuple[str, ...] = ()

    def joints(self, _axes: Sequence[str], _frames: Sequence[AxisFrame] = ()) -> JointTrack | None:
        """None: a live robot follows a task."""
        return None

    def capsules(self) -> CapsuleTrack | None:
        """None: a live robot is the one of the settings."""
        return None


def live_run_config(
    human: Path | None, config: Path | None, overrides: tuple[str, ...], cell_file: Path | None
) -> tuple[RunConfig, Header]:
    """Settings and cameras of a session.

    Args:
        human: Recording of the person; None: the cameras are in live.zenoh.keys, their poses in the cell.
        config: Settings file.
        overrides: ``section.key=value``.
        cell_file: Poses of cameras and robot.

    Raises:
        SettingsError: A setting or the cell cannot be used, or there is no camera.
        LogError: The recording cannot be read.
    """
    if human is not None:
        run_config = resolve("live", human, config=config, overrides=overrides, cell_file=cell_file)
        return run_config, open_log(run_config.log, run_config.settings.logs).header
    settings = load_settings(config, overrides)
    cameras = tuple(sorted(settings.live.zenoh.keys))
    if not cameras:
        raise SettingsError("live.zenoh.keys: no camera; name one there, or play a recording with --human LOG")
    where = Path("live.zenoh")
    run_config = resolve_without_log("live", where, settings, cell_file)
    return run_config, _header(where, cameras, {}, None, None)


def _header(
    path: Path,
    cameras: tuple[str, ...],
    T_world_camera: dict[str, Floats],
    T_world_base: Floats | None,
    task: dict[str, Any] | None,
) -> Header:
    return Header(
        path=path,
        kind="hrcreplay",
        cameras=cameras,
        T_world_camera=T_world_camera,
        task=task,
        start_ns=0,
        end_ns=0,
        T_world_base=T_world_base,
        has_truth=False,
        joint_topics=(),
    )


def start_table(run_config: RunConfig, header: Header, *, sending: bool) -> dict[str, Any]:
    """Everything that the session's decisions depend on, apart from its inputs, as JSON.

    Raises:
        SettingsError: There is no task, or the pose of the robot's base is not known.
        LogError: The pose of a camera is not known.
    """
    task = run_config.task or header.task
    if task is None:
        raise SettingsError(
            f"{header.path}: no task; a live robot needs one: name a task file with --set plan.task=FILE"
        )
    if (method := run_config.settings.plan.method) in ("none", "pfl"):
        why = "looks at nobody" if method == "none" else "may touch people"
        raise SettingsError(f"plan.method: {method} {why}; a live robot needs qp, scaling, shield or ssm")
    known, scene = run_config.meta(), HeaderOnlyLog(header)
    T_world_base, fusion_stage = assembly.robot_base(run_config, scene), assembly.fusion_stage(run_config, scene)
    robot = assembly.robot(run_config, T_world_base)
    if not ARM_JOINTS <= robot.nv <= MOST_JOINTS:
        raise SettingsError(
            f"robot.urdf: {robot.name} has {robot.nv} axes; live drives robots of {ARM_JOINTS} to {MOST_JOINTS} over "
            "EGM"
        )
    joint_order(robot.name, robot.joint_names, run_config.settings.live.joint_order)
    predicted = assembly.prediction_stage(run_config)
    return {
        "hrcreplay": __version__,
        "record": codec.FORMAT,
        "settings": known["settings"],
        "versions": known["versions"],
        "machine": known["machine"],
        "limits": known["limits"],
        "cell": known["cell"],
        "cameras": {name: T.tolist() for name, T in zip(header.cameras, fusion_stage.T_world_camera, strict=True)},
        "T_world_base": T_world_base.tolist(),
        "task": task,
        "sending": sending,
        "limbs": list(predicted.limbs),
        "neighbours": list(assembly.surroundings(run_config, robot).names),
        "method": predicted.method,
        "links": [segment.name for segment in robot.segments],
    }


def joint_order(robot: str, names: Sequence[str], given: tuple[int, ...]) -> Ints:
    """(n,) index of the robot's axis for each joint of EGM; axis 0 is next to the base.

    Args:
        robot: Name of the robot.
        names: Names of its axes, from the base on.
        given: ``live.joint_order``; empty: the joints of EGM are in the order of the axes.

    Raises:
        SettingsError: The order does not contain every axis once; or it is empty, and the numbers in the joints' names
            give another order.
    """
    axes = list(range(1, len(names) + 1))
    if given and sorted(given) != axes:
        raise SettingsError(
            f"live.joint_order: found {list(given)}; would be right: each of {axes} once, the axes of {robot} "
            f"from its base on ({', '.join(names)})"
        )
    numbers = [int(found[-1]) for name in names if (found := re.findall(r"\d+", name))]
    if not given and len(numbers) == len(names) and sorted(numbers) == axes and numbers != axes:
        order = [numbers.index(number) + 1 for number in axes]
        raise SettingsError(
            f"live.joint_order: from its base on the joints of {robot} are {', '.join(names)}, and "
            f"EGM sends them by number; would be right: live.joint_order={order}, or {axes} where EGM sends them so"
        )
    return np.array(given or axes) - 1


def build_controller(start: dict[str, Any]) -> SessionController:
    """The controller of a session at its start.

    Raises:
        SettingsError: A setting of the table cannot be used.
    """
    run_config, scene = _recorded_run(start)
    setup = _setup(run_config, scene, sending=start["sending"])
    robot, live = setup.robot, run_config.settings.live
    observer = Observer(
        assembly.fusion_stage(run_config, scene),
        assembly.surroundings(run_config, robot),
        scene.header.cameras,
        run_config.settings.logs.gap_s,
    )
    session = EgmSession(
        robot.q_min,
        robot.q_max,
        robot.dq_max,
        utilization_max=live.utilization_max,
        silence_s=live.silent_s,
        cycle_s=live.cycle_s,
    )
    return SessionController(setup, observer, session)


def build_scene(start: dict[str, Any]) -> tuple[RobotModel, Reference, StaticObstacles | None]:
    """Makes the robot of a session, its programme, and what the robot keeps clear of beside people.

    Raises:
        SettingsError: A setting of the table cannot be used.
    """
    return _scene(*_recorded_run(start))


def _recorded_run(start: dict[str, Any]) -> tuple[RunConfig, HeaderOnlyLog]:
    run_config = run_config_of(start, Path("live session"), "")
    poses = {name: np.array(T) for name, T in start["cameras"].items()}
    base = np.array(start["T_world_base"])
    return run_config, HeaderOnlyLog(_header(run_config.log, tuple(start["cameras"]), poses, base, run_config.task))


def _scene(run_config: RunConfig, scene: HeaderOnlyLog) -> tuple[RobotModel, Reference, StaticObstacles | None]:
    robot = assembly.robot(run_config, assembly.robot_base(run_config, scene))
    programme = assembly.programme(run_config, scene, robot).path
    return robot, programme, assembly.static_scene(run_config, robot, programme, 0.0)


def run_config_of(start: dict[str, Any], log: Path, log_sha256: str) -> RunConfig:
    """The run of a session, from its start table.

    Raises:
        LogError: Its record has another format.
        SettingsError: This version cannot read the settings or the limit sets of the table.
    """
    if (found := start.get("record", 1)) != codec.FORMAT:
        raise LogError(
            f"{log}: its record has format {found}, and this version of hrcreplay reads format {codec.FORMAT}; "
            "would be right: the version that recorded the session"
        )
    recorded, _ = with_new_names(start["settings"])
    settings = validate(Settings, recorded, f"{log}: its settings, by hrcreplay {start.get('hrcreplay')}")
    return RunConfig(
        command="live",
        log=log,
        log_sha256=log_sha256,
        settings=settings,
        cell=None if start["cell"] is None else Cell.from_dict(start["cell"]),
        task=start["task"],
        start_s=None,
        end_s=None,
        tracking_limits=recorded_limits(start["limits"]["tracking"], log),
        prediction_limits=recorded_limits(start["limits"]["prediction"], log),
        earlier=None,
    )


def _setup(run_config: RunConfig, scene: HeaderOnlyLog, *, sending: bool) -> ControlSetup:
    live, plan = run_config.settings.live, run_config.settings.plan
    robot, programme, static = _scene(run_config, scene)
    settings = assembly.plan_settings(run_config, live.cycle_s, plan.method)

    def follow(path: Reference, s_s: float) -> Controller:
        return assembly.make_controller(plan.method, robot, path, settings, s_s, static)

    return ControlSetup(
        robot=robot,
        programme=programme,
        plan=settings,
        static=static,
        follow=follow,
        waypoint_m=plan.waypoint_m,
        approach_speed=live.approach_speed,
        bounds=live,
        fresh_s=run_config.settings.fusion.fresh_s,
        sending=sending,
        joint_order=joint_order(robot.name, robot.joint_names, live.joint_order),
    )


_TICKS = 400
_TICK_NS = 4_032_000
_FRAME_EVERY = 8
_SECOND_FROM = 200  # tick after which the second person is seen


def compile_kernels(start: dict[str, Any]) -> None:
    """Compiles every kernel with a simulated session of 1.6 s in which a person walks up to the robot, then a second.

    The session has no watched area. With one, the robot would also need to know about other people and would not move.
    """
    compile_second_tries()
    cell = {name: part for name, part in (start["cell"] or {}).items() if name != "watched"}
    controller = build_controller({**start, "sending": False, "cell": cell or None})
    camera, T = next(iter(start["cameras"].items()))
    to_camera = np.linalg.inv(np.array(T))
    base = np.array(start["T_world_base"])[:3, 3]
    q = controller.setup.programme.q0[controller.setup.joint_order]
    for tick in range(_TICKS):
        t_ns = 10**18 + tick * _TICK_NS
        packet = RobotPacket(tick, tick * 4, t_ns, q, q, Motors.ON, Mci.RUNNING, Rapid.RUNNING, False, 0.0)
        event = TickEvent(t_ns, (encode_robot(packet),), Signal.NONE)
        answer = controller.answer(event)
        codec.encode_decision(answer, Signal.NONE, 1, 0)
        away_m = 2.0 - 1.6 * tick / _TICKS
        places_m = [np.array([away_m, 0.0, 0.0]), np.array([0.0, 2.0 + away_m, 0.0])][: 1 + (tick > _SECOND_FROM)]
        seen = [_seen(camera, to_camera, base + m, t_ns, body) for body, m in enumerate(places_m)]
        seen = [] if tick % _FRAME_EVERY else seen
        perception = controller.update_perception(t_ns + 1_000_000, seen)
        if controller.fault is not None:
            raise controller.fault
        if perception is not None:
            codec.encode_perception(perception, len(seen))
            codec.encode_volumes(perception)
    _compile_second_tries(controller)


def _compile_second_tries(controller: SessionController) -> None:
    """Compiles what a session needs after a crash, an echo or an unproven solution, with the person of the session."""
    setup, perception = controller.setup, controller.perception
    certificate.compile_second_tries(setup.robot)
    setup.stop_from(RobotState(setup.programme.q0, np.zeros(setup.robot.nv)))
    follower = setup.follow(setup.programme, 0.0)
    if isinstance(follower, QpController) and perception is not None:
        seen = follower.observe(lambda horizon_s: controller.observer.around(perception, horizon_s, believed=True))
        if seen.sight.pairs is not None:
            qp_controller.compile_second_tries(follower.qp_context(seen), follower.settings)


def _seen(camera: str, to_camera: Floats, place_m: Floats, t_ns: int, body: int) -> bytes:
    """Skeleton message of a person at a position, with half bent arms."""
    joints = np.array([[place_m[0], place_m[1], np.pi, 0.1, *(0.1, 0.5, 0.0, 1.8) * 2, 0.94]])
    points = skeleton(joints, np.array([MEDIAN_LENGTHS_M]))[0] @ to_camera[:3, :3].T + to_camera[:3, 3]
    message = skeleton_pb2.Skeleton(capture_ns=t_ns, camera=camera, body=body)
    message.points.extend(points.ravel().tolist())
    message.confidence.extend(np.isfinite(points[:, 0]).astype(float).tolist())
    data: bytes = message.SerializeToString()
    return data
