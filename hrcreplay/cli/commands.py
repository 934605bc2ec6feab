"""The commands beside the stages: live, twin and verify, and what info, import and calibrate do.

Slow imports stand inside the functions, so that ``--help`` answers at once.
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hrcreplay.cli import CellFile, Config, LimitSet, Set, as_overrides
from hrcreplay.errors import SettingsError

if TYPE_CHECKING:
    from hrcreplay.egm.robot_double.servo import Axes

Human = Annotated[
    Path | None,
    typer.Option("--human", metavar="LOG", help="Play this recording of the person; default: live.zenoh."),
]
Port = Annotated[int | None, typer.Option("--port", min=0, max=65535, help="UDP port; default 6510.")]
Duration = Annotated[
    float | None, typer.Option("--duration", metavar="S", help="How long, in seconds; default: until stopped.")
]


def register(app: typer.Typer) -> None:
    """Adds the commands to the command line."""
    app.command()(live)
    app.command()(twin)
    app.command()(verify)


def live(
    human: Human = None,
    send: Annotated[
        bool, typer.Option("--send", help="Answer the robot. Without it all is computed and recorded, nothing is sent.")
    ] = False,
    port: Port = None,
    duration: Duration = None,
    repeat: Annotated[bool, typer.Option("--repeat", help="Start the recording again at its end.")] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Run folder to make; default reports/<log>/<UTC>-live."),
    ] = None,
    json_lines: Annotated[bool, typer.Option("--json", help="Status as JSON lines instead of the panel.")] = False,
    foxglove: Annotated[
        int | None, typer.Option("--foxglove", metavar="PORT", help="Also stream the scene to Foxglove at this port.")
    ] = None,
    config: Config = None,
    settings: Set = None,
    limits: LimitSet = None,
    cell: CellFile = None,
) -> None:
    """Drive an EGM robot beside a person, or watch in shadow mode; everything is recorded.

    Exit code 4 when a stop reason ended the motion. A research tool, not a certified safety function.
    """
    from hrcreplay.live import session

    request = session.Request(
        human=human,
        repeat=repeat,
        port=port,
        duration_s=_positive(duration),
        out=out or session.default_out(human),
        send=send,
        json_lines=json_lines,
        foxglove=foxglove,
        config=config,
        overrides=as_overrides(settings, None, limits),
        cell=cell,
    )
    sys.stdout.write(f"{session.run(request)}\n")


def twin(
    host: Annotated[str, typer.Option("--host", help="Where the guide listens.")] = "127.0.0.1",
    port: Port = None,
    duration: Duration = None,
    faults: Annotated[
        Path | None, typer.Option("--faults", metavar="FILE.toml", help="Script of what goes wrong.")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of all that is random in the faults.")] = 0,
    version: Annotated[str, typer.Option("--version", metavar="A|B|C", help="Edition of the messages.")] = "B",
    radians: Annotated[bool, typer.Option("--radians", help="As RobotWare below 6.07: radians and no clock.")] = False,
    gain: Annotated[float, typer.Option("--gain", help="Proportional gain of the position loop, 0 to 20 1/s.")] = 5.0,
    filter_hz: Annotated[float, typer.Option("--filter", metavar="HZ", help="Low-pass filter; 0 is off.")] = 20.0,
    deviation: Annotated[
        float, typer.Option("--max-speed-deviation", metavar="DEG_PER_S", help="MaxSpeedDeviation.")
    ] = 450.0,
    cond_time: Annotated[
        float, typer.Option("--cond-time", metavar="S", help="CondTime: end after this long converged; 0 disables.")
    ] = 0.0,
    comm_timeout: Annotated[float, typer.Option("--comm-timeout", metavar="S", help="CommTimeout.")] = 1.0,
    start: Annotated[
        str, typer.Option("--start", metavar="DEG,...", help="Joints at the beginning, one an axis, in degrees.")
    ] = "0,0,0,0,30,0",
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Folder for the record.")] = None,
    config: Config = None,
    settings: Set = None,
) -> None:
    """Play the robot of an EGM session: a UDP client with the controller's behaviour, and faults on demand.

    It is the robot of the settings, as of live: --set robot.urdf=FILE, and live.joint_order.
    """
    from hrcreplay.egm.robot_double.faults import load_faults
    from hrcreplay.egm.robot_double.servo import ServoSettings
    from hrcreplay.egm.robot_double.twin import TwinSettings
    from hrcreplay.egm.robot_double.udp_client import run_twin

    servo = ServoSettings(
        gain=gain,
        filter_hz=filter_hz,
        max_speed_deviation_deg_per_s=deviation,
        cond_time_s=cond_time,
        comm_timeout_s=comm_timeout,
        axes=_axes_of_double(config, as_overrides(settings, None, None)),
    )
    double = TwinSettings(servo=servo, start_deg=_degrees(start), version=version, radians=radians)  # type: ignore[arg-type]
    script = () if faults is None else load_faults(faults, seed=seed, duration_s=_positive(duration))
    duration_s = None if duration is None else _positive(duration)
    port = 6510 if port is None else port
    report = run_twin(host, port, settings=double, faults=script, seed=seed, duration_s=duration_s, out=out)
    sys.stdout.write("\n".join(report.lines()) + "\n")


def _axes_of_double(config: Path | None, overrides: tuple[str, ...]) -> Axes:
    """Range and speed of the robot of the settings, in the order of EGM."""
    from hrcreplay.egm.robot_double.servo import IRB140, axes_of
    from hrcreplay.settings.load import load_settings

    found = load_settings(config, overrides)
    if found.robot.urdf is None:  # and the double is there at once
        return IRB140
    import numpy as np

    from hrcreplay.live.control.setup import joint_order
    from hrcreplay.run.job import robot_description

    robot = robot_description(found.robot)
    order = joint_order(robot.name, robot.joints, found.live.joint_order)
    return axes_of(*(np.asarray(bound)[order] for bound in (robot.q_min, robot.q_max, robot.dq_max)))


def verify(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder of a live session or of a replay.")],
    finish: Annotated[
        bool, typer.Option("--finish", help="First make the run folder of a killed session, RUN.partial, from its log.")
    ] = False,
) -> None:
    """Compute a run again from its log and compare every bit.

    Says 'identical' (exit code 0); 'same decisions, numbers within 1e-9' (exit code 6) where the run was recorded on
    another processor and nothing else differs; or what differs first (exit code 1).
    """
    from hrcreplay.live import verify as again
    from hrcreplay.live.record import folder

    run = folder.finish(run) if finish else run
    verdict = again.verify(run)
    sys.stdout.write("\n".join(verdict.lines) + "\n")
    raise typer.Exit(int(verdict.agreement))


def _positive(duration: float | None) -> float:
    if duration is None:
        return math.inf
    if not 0 < duration < math.inf:
        raise SettingsError(f"--duration {duration:g}: a positive number of seconds would be right")
    return duration


def _degrees(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise SettingsError(f"--start {text}: numbers with commas between them would be right") from None


KINDS = ("azure", "kinect2", "keraal")


def describe(path: Path, config: Path | None, overrides: tuple[str, ...], cell_file: Path | None = None) -> list[str]:
    """Content of a log, line by line.

    Args:
        path: The log.
        config: Settings file, or none.
        overrides: ``section.key=value`` of the command line, which win over the file.
        cell_file: Poses and clock offsets of the cameras, which win over the log's.

    Raises:
        SettingsError: A setting cannot be used.
        LogError: The log cannot be read.
    """
    from hrcreplay.calibration.cell import Cell, load_cell
    from hrcreplay.logs import info
    from hrcreplay.logs.reader import open_log
    from hrcreplay.run.job import robot_axes
    from hrcreplay.settings.load import load_settings

    settings = load_settings(config, overrides)
    cell = load_cell(cell_file) if cell_file is not None else Cell()
    log = open_log(path, settings.logs, skeletons=False)
    summary = info.summarize(
        log,
        axes=robot_axes(settings.robot),
        options=settings.logs,
        T_world_camera=cell.T_world_camera,
        clock_offset_s=cell.clock_offset_s,
        T_world_base=cell.T_world_base,
    )
    return info.lines(summary)


def import_files(kind: str, files: list[str], out: Path, rate_hz: float) -> list[str]:
    """Makes our log from text files; returns what the user should know of it.

    Args:
        kind: azure, kinect2 or keraal.
        files: ``[camera=]path``, one a camera; for keraal the Kinect's file and, if there is one, the optical one.
        out: Log to write.
        rate_hz: Frames a second of the Kinect, keraal only [Hz].

    Raises:
        SettingsError: No such kind, too many files, a camera twice, or ``out`` exists.
        LogError: A file cannot be read.
    """
    from hrcreplay.logs import importers

    if kind not in KINDS:
        raise SettingsError(f"import: found {kind!r}; would be right: {', '.join(KINDS)}")
    if kind == "keraal":
        if len(files) > 2:
            raise SettingsError(f"import keraal: found {len(files)} files; give the Kinect's, then the optical one")
        paths = [Path(file) for file in files]
        return importers.import_keraal(paths[0], paths[1] if len(paths) > 1 else None, out, rate_hz)
    make = importers.import_azure if kind == "azure" else importers.import_kinect2
    return make(_by_camera(files), out)


def _by_camera(files: list[str]) -> dict[str, Path]:
    """Files by camera; a file without a camera's name gets its own, without endings."""
    found: dict[str, Path] = {}
    for file in files:
        name, equals, path = file.partition("=")
        camera, path = (name, path) if equals else (Path(file).name.split(".")[0], file)
        if camera in found:
            raise SettingsError(
                f"import: camera {camera} is given twice; name each file's camera: left=FILE right=FILE"
            )
        found[camera] = Path(path)
    return found


def calibrate(
    log: Path,
    out: Path,
    config: Path | None,
    overrides: tuple[str, ...],
    *,
    reference: str | None,
    up: str | None,
    height_m: float | None,
    base: str | None,
) -> list[str]:
    """Writes the cell file of a log's cameras; returns the residuals and what is not sure, line by line.

    Args:
        log: Log whose cameras saw one person.
        out: Cell file to write.
        config: Settings file, or none.
        overrides: ``section.key=value`` of the command line, which win over the file.
        reference: Camera that defines the world; None: the first.
        up: ``X,Y,Z``, up in the reference camera's frame; None: from the person's feet.
        height_m: Height of the reference camera above the floor [m]; None: from the person's feet.
        base: ``X,Y,Z,YAW`` of the robot base in the world [m, m, m, deg]; None: not known.

    Raises:
        SettingsError: An option cannot be used, or ``out`` exists.
        LogError: The cameras did not see one person together, or floor and up cannot be told.
    """
    import numpy as np

    from hrcreplay.calibration import calibrate as calibration
    from hrcreplay.calibration.cell import pose_from_position, write_cell
    from hrcreplay.logs.reader import open_log
    from hrcreplay.settings.load import load_settings

    if out.exists():
        raise SettingsError(f"{out}: exists already; name another file, or remove it")
    settings = load_settings(config, overrides)
    axis = None if up is None else _numbers("--up", up, 3)
    place = None if base is None else _numbers("--base", base, 4)
    if height_m is not None and not 0.0 <= height_m < math.inf:
        raise SettingsError(f"--height {height_m:g}: would be right: metres above the floor, 0 or more, e.g. 1.6")
    opened = open_log(log, settings.logs)
    cell, stood = calibration.survey(
        opened,
        reference,
        axis,
        height_m,
        jump_m=settings.logs.person_jump_m,
        memory_s=settings.logs.person_memory_s,
    )
    if place is not None:
        cell = replace(cell, T_world_base=pose_from_position(np.array(place[:3]), float(np.radians(place[3]))))
    write_cell(cell, out)
    lines = [
        f"{r.a} - {r.b}: apart by {1e3 * r.median_m:.0f} mm (median), {1e3 * r.p95_m:.0f} mm (p95) at {r.points} points"
        for r in cell.residuals
    ]
    return [*lines, *stood, *opened.notes, *cell.notes]


def _numbers(option: str, text: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise SettingsError(f"{option} {text}: would be right: {count} numbers with commas between, e.g. 0,-1,0"[:200])
    return values
