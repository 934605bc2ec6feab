"""The commands of a live session: live, twin and verify.

Slow imports are inside the functions, so that ``--help`` answers at once.
"""

from __future__ import annotations

import math
import sys
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
        bool,
        typer.Option(
            "--send",
            help="Send answers to the robot. Without it, everything is computed and recorded but nothing is sent.",
        ),
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
    from hrcreplay.pipeline.kernel_build import ensure_compiled

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
    ensure_compiled()  # before the robot waits
    sys.stdout.write(f"{session.run(request)}\n")


def twin(
    host: Annotated[str, typer.Option("--host", help="Address at which the live session listens.")] = "127.0.0.1",
    port: Port = None,
    duration: Duration = None,
    faults: Annotated[Path | None, typer.Option("--faults", metavar="FILE.toml", help="Script of the faults.")] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the random faults.")] = 0,
    version: Annotated[str, typer.Option("--version", metavar="A|B|C", help="Edition of the messages.")] = "B",
    radians: Annotated[
        bool, typer.Option("--radians", help="Behave as RobotWare below 6.07: radians and no clock.")
    ] = False,
    gain: Annotated[float, typer.Option("--gain", help="Proportional gain of the position loop, 0 to 20 1/s.")] = 5.0,
    filter_hz: Annotated[float, typer.Option("--filter", metavar="HZ", help="Low-pass filter; 0 is off.")] = 20.0,
    deviation: Annotated[
        float, typer.Option("--max-speed-deviation", metavar="DEG_PER_S", help="MaxSpeedDeviation.")
    ] = 450.0,
    cond_time: Annotated[
        float,
        typer.Option("--cond-time", metavar="S", help="CondTime: end after convergence for this long; 0 disables."),
    ] = 0.0,
    comm_timeout: Annotated[float, typer.Option("--comm-timeout", metavar="S", help="CommTimeout.")] = 1.0,
    start: Annotated[
        str, typer.Option("--start", metavar="DEG,...", help="Initial joint positions, one per axis, in degrees.")
    ] = "0,0,0,0,30,0",
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Folder for the record.")] = None,
    config: Config = None,
    settings: Set = None,
) -> None:
    """Play the robot of an EGM session: a UDP client with the controller's behaviour, and faults on demand.

    Plays the robot of the settings, like live: --set robot.urdf=FILE, and live.joint_order.
    """
    from hrcreplay.egm.robot_double.faults import load_faults
    from hrcreplay.egm.robot_double.robot_simulator import SimulatorSettings
    from hrcreplay.egm.robot_double.servo import ServoSettings
    from hrcreplay.egm.robot_double.udp_client import run_simulator

    servo = ServoSettings(
        gain=gain,
        filter_hz=filter_hz,
        max_speed_deviation_deg_per_s=deviation,
        cond_time_s=cond_time,
        comm_timeout_s=comm_timeout,
        axes=_axes_of_double(config, as_overrides(settings, None, None)),
    )
    double = SimulatorSettings(servo=servo, start_deg=_degrees(start), version=version, radians=radians)  # type: ignore[arg-type]
    script = () if faults is None else load_faults(faults, seed=seed, duration_s=_positive(duration))
    duration_s = None if duration is None else _positive(duration)
    port = 6510 if port is None else port
    report = run_simulator(host, port, settings=double, faults=script, seed=seed, duration_s=duration_s, out=out)
    sys.stdout.write("\n".join(report.lines()) + "\n")


def _axes_of_double(config: Path | None, overrides: tuple[str, ...]) -> Axes:
    """Returns range and speed of the axes of the robot in the settings, in the order of EGM."""
    from hrcreplay.egm.robot_double.servo import IRB140, axes_of
    from hrcreplay.settings.load import load_settings

    found = load_settings(config, overrides)
    if found.robot.urdf is None:  # and the double starts at once
        return IRB140
    import numpy as np

    from hrcreplay.live.control.setup import joint_order
    from hrcreplay.pipeline.run_config import robot_description

    robot = robot_description(found.robot)
    order = joint_order(robot.name, robot.joints, found.live.joint_order)
    return axes_of(*(np.asarray(bound)[order] for bound in (robot.q_min, robot.q_max, robot.dq_max)))


def verify(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder of a live session or of a replay.")],
    finish: Annotated[
        bool, typer.Option("--finish", help="First make the run folder of a killed session, RUN.partial, from its log.")
    ] = False,
) -> None:
    """Compute a run again from its log and compare it bit by bit.

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
