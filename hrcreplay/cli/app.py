"""The command line: parses the arguments, calls the command, prints the run folder.

Slow imports are inside the commands, so that ``--help`` answers at once.
"""

from __future__ import annotations

import signal
import sys
import warnings
from pathlib import Path
from typing import Annotated, Any, TextIO

import typer

from hrcreplay.audit import COVER, COVERAGE, HELD_BACK
from hrcreplay.cli import (
    CellFile,
    Chunk,
    Config,
    End,
    LimitSet,
    Out,
    Set,
    Smooth,
    Source,
    Start,
    Topic,
    as_overrides,
    live,
    scale,
    span,
)
from hrcreplay.cli.commands import App, completion, give_back_memory, interruptible, print_run, tell
from hrcreplay.errors import CoverageMissed, HrcReplayError, SettingRenamed, SettingsError
from hrcreplay.version import __version__

#: Kinds of files that ``import`` reads, and sections of the settings: what both are is slow to load.
KINDS = (
    *("azure", "kinect2", "keraal", "table", "mediapipe", "openpose", "k4abt", "zed"),
    *("trc", "c3d", "bvh", "optitrack", "mvnx", "ntu", "chico", "harper"),
)
SECTIONS = ("logs", "fusion", "limits", "prediction", "robot", "plan", "report", "live")

app = App(
    name="hrcreplay",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help="""Had this controller been running, would the person have been safe, and what would it have cost the task?

Replays a recorded human-robot session through three stages, fuse, predict and plan, and reports.
Each stage takes a log (MCAP, ROS 1 or ROS 2 bag) or the run folder of an earlier stage.

A research and engineering tool, not a certified safety function.""",
    epilog="Try it: hrcreplay demo",
)


def _version(asked: bool) -> None:
    if asked:
        sys.stdout.write(f"hrcreplay {__version__}\n")
        raise typer.Exit


@app.callback()
def _root(
    _: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")] = False,
) -> None:
    pass


@app.command()
def info(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A log (MCAP, ROS 1 or ROS 2 bag).")],
    config: Config = None,
    settings: Set = None,
    topic: Topic = None,
    cell: CellFile = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print all of it as JSON.")] = False,
) -> None:
    """Show the content of a log, and what is missing for the next step."""
    from hrcreplay.commands import inputs

    found = inputs.describe(log, config, as_overrides(settings, topic), cell, as_json=as_json)
    sys.stdout.write("\n".join(found) + "\n")


@app.command(name="import")
def import_(
    kind: Annotated[
        str,
        typer.Argument(
            metavar="KIND",
            help=f"{', '.join(KINDS[:-1])} or {KINDS[-1]}.",
            autocompletion=completion(KINDS),
        ),
    ],
    files: Annotated[
        list[str],
        typer.Argument(metavar="[CAMERA=]FILE...", help="One file per camera; keraal: Kinect text, then optical text."),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="LOG.mcap", help="Log to write.")],
    rate: Annotated[
        float | None,
        typer.Option(
            "--rate", metavar="HZ", help="Rate of files that do not tell theirs, in Hz; keraal: 30 by default."
        ),
    ] = None,
    mapping: Annotated[
        Path | None,
        typer.Option("--mapping", metavar="FILE.toml", help="Description of the files: columns, points, unit, axes."),
    ] = None,
) -> None:
    """Make a log from files of trackers, motion capture systems and research sets."""
    from hrcreplay.commands import inputs

    for note in inputs.import_files(kind, files, out, rate, mapping):
        tell(note)
    sys.stdout.write(f"{out}\n")


@app.command()
def calibrate(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A log whose cameras saw one person.")],
    out: Annotated[Path, typer.Option("--out", metavar="CELL.toml", help="Cell file to write.")],
    config: Config = None,
    settings: Set = None,
    topic: Topic = None,
    camera: Annotated[
        str | None,
        typer.Option("--reference", metavar="CAMERA", help="Camera that defines the world; default: the first."),
    ] = None,
    up: Annotated[
        str | None,
        typer.Option(
            "--up",
            metavar="X,Y,Z",
            help="Upward direction in the reference camera's frame; default: found from the feet.",
        ),
    ] = None,
    height: Annotated[
        float | None,
        typer.Option(
            "--height",
            metavar="M",
            help="Height of the reference camera above the floor, in metres; default: found from the feet.",
        ),
    ] = None,
    base: Annotated[
        str | None,
        typer.Option("--base", metavar="X,Y,Z,YAW", help="Pose of the robot base in the world, in metres and degrees."),
    ] = None,
) -> None:
    """Find the poses and clock offsets of the cameras from the skeletons themselves."""
    from hrcreplay.commands import inputs

    for line in inputs.calibrate(
        log, out, config, as_overrides(settings, topic), reference=camera, up=up, height_m=height, base=base
    ):
        tell(line)
    sys.stdout.write(f"{out}\n")


def _stage(command: str, text: str) -> None:
    """Registers a command that runs all stages up to the named one."""

    @app.command(name=command, help=text)
    def stage(
        source: Source,
        config: Config = None,
        settings: Set = None,
        topic: Topic = None,
        limits: LimitSet = None,
        cell: CellFile = None,
        out: Out = None,
        start: Start = None,
        end: End = None,
        smooth: Smooth = False,
        chunk_ticks: Chunk = 250,
    ) -> None:
        folder = _run(
            command,
            source,
            out=out,
            config=config,
            overrides=as_overrides(settings, topic, limits),
            cell_file=cell,
            **span(start, end),
            smooth=smooth,
            chunk_ticks=chunk_ticks,
        )
        print_run(folder)


def _run(command: str, source: Path, **options: Any) -> Path:
    """Runs the stages up to that of a command, prints the main figures on standard error, returns the run folder."""
    give_back_memory()
    from hrcreplay.commands import replay
    from hrcreplay.pipeline.progress import print_note

    folder = replay.run(command, source, **options)
    from hrcreplay.commands import report  # slow to load, as it can draw; imported only after the run succeeded

    for line in report.summary(folder):
        print_note(line)
    return folder


_stage("fuse", "Stage 1: merge the cameras' skeletons into one person (state.parquet).")
_stage("predict", "Stages 1, 2: the space the person can reach within the braking time (occupancy.parquet).")
_stage("plan", "Stages 1 to 3: what the robot would have done (motion.parquet).")


Snapshot = Annotated[
    float | None,
    typer.Option(
        "--snapshot",
        metavar="SECONDS",
        help="With a run folder: only write a still of its replay at that instant, PNG; --out names the file.",
    ),
]
Movie = Annotated[
    bool,
    typer.Option(
        "--movie",
        help="With a run folder: only write ten seconds of its worst moments, MP4 (needs ffmpeg) or GIF; "
        "--out names the file.",
    ),
]
ForRerun = Annotated[
    bool,
    typer.Option(
        "--rerun",
        help="With a run folder: only write its scene for the Rerun viewer (extra: rerun); --out names the file.",
    ),
]
Pdf = Annotated[
    bool,
    typer.Option(
        "--pdf",
        help="With a run folder: only write its safety file, four pages to print and sign; --out names the file.",
    ),
]
Figure = Annotated[
    str | None,
    typer.Option(
        "--figure",
        metavar="NUMBER",
        help="With a run folder: only write that figure, such as 14, horizon or all, also as PDF; --out names the "
        "folder.",
    ),
]
ListFigures = Annotated[
    bool,
    typer.Option("--list-figures", help="Only list the figures, and whether a run folder has the data for each."),
]


@app.command()
def report(
    source: Annotated[
        Path | None, typer.Argument(metavar="LOG_OR_RUN", help="A log, or the run folder of an earlier stage.")
    ] = None,
    config: Config = None,
    settings: Set = None,
    topic: Topic = None,
    limits: LimitSet = None,
    cell: CellFile = None,
    out: Out = None,
    start: Start = None,
    end: End = None,
    smooth: Smooth = False,
    chunk_ticks: Chunk = 250,
    snapshot: Snapshot = None,
    movie: Movie = False,
    rerun: ForRerun = False,
    pdf: Pdf = False,
    figure: Figure = None,
    list_figures: ListFigures = False,
) -> None:
    """All stages, then metrics.json, figures, report.html with the 3-D replay, and scene.mcap."""
    if list_figures or source is None or figure is not None or snapshot is not None or movie or rerun or pdf:
        _part_of_report(source, figure, snapshot, out, listed=list_figures, movie=movie, rerun=rerun, pdf=pdf)
        return
    folder = _run(
        "report",
        source,
        out=out,
        config=config,
        overrides=as_overrides(settings, topic, limits),
        cell_file=cell,
        **span(start, end),
        smooth=smooth,
        chunk_ticks=chunk_ticks,
    )
    print_run(folder)


def _part_of_report(
    source: Path | None,
    figure: str | None,
    snapshot: float | None,
    out: Path | None,
    *,
    listed: bool,
    movie: bool,
    rerun: bool,
    pdf: bool,
) -> None:
    """Writes single parts of a report from a run folder, without a new run folder."""
    from hrcreplay.commands.report import draw_figures, list_figures, make_movie, make_pdf, save_for_rerun, take_still

    parts = {"--figure": figure is not None, "--snapshot": snapshot is not None}
    parts |= {"--movie": movie, "--rerun": rerun, "--pdf": pdf, "--list-figures": listed}
    if len(given := [option for option, there in parts.items() if there]) > 1:
        raise SettingsError(f"report: found {' and '.join(given)}; would be right: one of them at a time")
    if listed:
        found: list[object] = [*list_figures(source)]
    elif source is None:
        raise SettingsError("report: found neither log nor run folder; give one: hrcreplay report LOG_OR_RUN")
    elif figure is not None:
        found = [*draw_figures(source, figure, out)]
    elif movie:
        found = [make_movie(source, out)]
    elif rerun:
        found = [save_for_rerun(source, out)]
    elif pdf:
        found = [make_pdf(source, out)]
    else:
        found = [take_still(source, snapshot or 0.0, out)]
    sys.stdout.write("".join(f"{line}\n" for line in found))


@app.command()
def compare(
    sources: Annotated[
        list[Path], typer.Argument(metavar="LOG_OR_RUN...", help="Logs, or run folders of earlier commands.")
    ],
    methods: Annotated[
        str | None,
        typer.Option(
            "--methods",
            metavar="LIST",
            help="METHOD[:OCCUPANCY[:HORIZON]],... as in none,qp,qp:paper:fixed; default: eight common ones.",
        ),
    ] = None,
    config: Config = None,
    settings: Set = None,
    topic: Topic = None,
    limits: LimitSet = None,
    cell: CellFile = None,
    out: Out = None,
    start: Start = None,
    end: End = None,
    chunk_ticks: Chunk = 250,
    processes: Annotated[
        int, typer.Option("--processes", min=1, max=2, help="Number of parallel processes; changes no result.")
    ] = 2,
) -> None:
    """Compare methods side by side on the same recording: what if another controller had been running?"""
    give_back_memory()
    from hrcreplay.commands import compare as comparing

    folder = comparing.run(
        sources,
        methods=comparing.PRESET if methods is None else methods,
        out=out,
        chunk_ticks=chunk_ticks,
        processes=processes,
        config=config,
        overrides=as_overrides(settings, topic, limits),
        cell_file=cell,
        **span(start, end),
    )
    print_run(folder)


@app.command()
def why(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder of plan or report.")],
    at: Annotated[float, typer.Option("--at", metavar="S", help="Instant, in seconds after the first tick.")],
    method: Annotated[
        str | None,
        typer.Option(
            "--method",
            metavar="NAME",
            help="One of the run's baselines, or recorded: the robot as it ran; default: the run's own method.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print all facts as JSON.")] = False,
) -> None:
    """Explain the robot's step at an instant: limb, link, vertex and row that limited it, or its rejected stop."""
    import json

    from hrcreplay.commands import explain as explaining

    found = explaining.explain(folder, at, method)
    lines = [json.dumps(found, indent=2)] if as_json else explaining.sentences(found)
    sys.stdout.write("\n".join(lines) + "\n")


@app.command()
def audit(
    sources: Annotated[
        list[Path], typer.Argument(metavar="LOG_OR_RUN...", help="Logs, or run folders of earlier stages.")
    ],
    config: Config = None,
    settings: Set = None,
    topic: Topic = None,
    limits: LimitSet = None,
    cell: CellFile = None,
    out: Out = None,
    start: Start = None,
    end: End = None,
) -> None:
    """Count how often people left the volumes that were predicted for them, by method and limb."""
    from hrcreplay.commands import audit as auditing

    overrides = as_overrides(settings, topic, limits)
    folder = auditing.run(sources, out=out, config=config, overrides=overrides, cell_file=cell, **span(start, end))
    print_run(folder)


@app.command(name="fit-limits")
def fit_limits(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG_OR_RUN...", help="Logs of people, or runs on them.")],
    out: Annotated[Path, typer.Option("--out", metavar="LIMITS.toml", help="Limit set to write.")],
    coverage: Annotated[
        float, typer.Option("--coverage", metavar="SHARE", help="Share of the ticks to cover, between 0 and 1.")
    ] = COVERAGE,
    held_back: Annotated[
        float,
        typer.Option(
            "--held-back", metavar="SHARE", help="Share of each log, at its end, that is kept out of the fit."
        ),
    ] = HELD_BACK,
    cover: Annotated[
        str, typer.Option("--cover", metavar="WHAT", help="joints in their intervals, or limbs in their volumes.")
    ] = COVER,
    config: Config = None,
    settings: Set = None,
    topic: Topic = None,
    cell: CellFile = None,
    start: Start = None,
    end: End = None,
) -> None:
    """Fit the tightest velocity and acceleration bounds that cover the recorded motion; for --limits."""
    from hrcreplay.audit import fit

    overrides = as_overrides(settings, topic)
    options = {"config": config, "overrides": overrides, "cell_file": cell, **span(start, end)}
    found = fit.run(logs, out=out, coverage=coverage, held_back=held_back, cover=cover, **options)
    for line in found.lines:
        tell(line)
    sys.stdout.write(f"{out}\n")
    if found.missed:
        raise CoverageMissed(f"{out}: {found.missed}")


@app.command()
def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder for the three files.")] = Path(),
) -> None:
    """Write commented files to begin with: cell.toml, task.toml and settings.toml."""
    from hrcreplay.commands.templates import write_templates

    for path in write_templates(folder):
        sys.stdout.write(f"{path}\n")


@app.command(name="settings")
def settings_(
    section: Annotated[
        str | None,
        typer.Argument(
            metavar="SECTION", help="Only this section, such as fusion.", autocompletion=completion(SECTIONS)
        ),
    ] = None,
) -> None:
    """Print all settings with their defaults, units and meanings, as a settings file."""
    from hrcreplay.settings.listing import as_toml

    sys.stdout.write(as_toml(section))


@app.command()
def demo(
    out: Out = None,
    config: Config = None,
    settings: Set = None,
    chunk_ticks: Chunk = 250,
) -> None:
    """Report on the log that ships with hrcreplay: a worker beside a pick-and-place robot, two cameras, 60 s."""
    from hrcreplay.commands import replay

    cell, how = replay.demo_cell(), {"config": config, "overrides": as_overrides(settings)}
    folder = _run("report", replay.demo_log(), cell_file=cell, out=out, chunk_ticks=chunk_ticks, **how)
    print_run(folder, folder / "report.html")


live.register(app)
scale.register(app)


_show_other_warning = warnings.showwarning


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Writes a warning for the user as one line, any other warning with its place in the code."""
    if issubclass(category, SettingRenamed):
        sys.stderr.write(f"hrcreplay: {message}\n")
    else:
        _show_other_warning(message, category, filename, lineno, file, line)


def main() -> None:
    """Runs the command line. A user error prints one line and sets the exit code; a bug keeps its traceback."""
    warnings.showwarning = _show_warning
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        with interruptible():
            app()
    except HrcReplayError as error:
        tell(str(error))
        sys.exit(error.exit_code)
