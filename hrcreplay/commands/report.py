"""The report of a run: computes all metrics from its tables, then the figures and the page that show them."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Any

from hrcreplay.commands.explain import Record, stop_table
from hrcreplay.errors import SettingsError
from hrcreplay.human.model import PARTS, part_radii
from hrcreplay.logs.reader import Log
from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.progress import NO_PROGRESS, Progress
from hrcreplay.pipeline.run_config import RunConfig, read_run_config
from hrcreplay.pipeline.second_process import share
from hrcreplay.records import Floats
from hrcreplay.reporting import tables
from hrcreplay.reporting.figures import catalogue, drawing
from hrcreplay.reporting.figures.catalogue import FigureData, FigureKind
from hrcreplay.reporting.figures.figure_data import compute_fields
from hrcreplay.reporting.metrics.contact import add_contact
from hrcreplay.reporting.metrics.fusion import add_fusion, add_limbs, add_occupancy, add_quality
from hrcreplay.reporting.metrics.people import add_people, most_tracked
from hrcreplay.reporting.metrics.planning import add_plan
from hrcreplay.reporting.metrics.series import Metric, MetricTable, start_ns
from hrcreplay.reporting.movie import default_name, write_movie
from hrcreplay.reporting.page import report_page
from hrcreplay.reporting.page.replay_page import ReplayPart, replay_part, snapshot
from hrcreplay.reporting.replay_scene import ReplayScene, replay_scene
from hrcreplay.reporting.safety_file import log_name, safety_file
from hrcreplay.reporting.scene_mcap import foxglove_layout, write_scene
from hrcreplay.reporting.severity import add_severity
from hrcreplay.reporting.summary_text import lines
from hrcreplay.reporting.tables import PageTable
from hrcreplay.reporting.tour import telling_moment, tour
from hrcreplay.settings.sections import Logs, setting
from hrcreplay.store import run_folder
from hrcreplay.store.memory import release_freed_memory
from hrcreplay.store.run_folder import Run, RunWriter

#: Key of ``--figure`` for all figures for which a run has the data.
ALL_FIGURES = "all"
#: Maximum number of people who have figures of their own; an hour has many visitors.
_DRAWN = 6


def write_report(
    run_config: RunConfig,
    writer: RunWriter,
    meta: dict[str, Any],
    log: Log | None = None,
    progress: Progress = NO_PROGRESS,
    second: Executor | None = None,
) -> None:
    """Writes metrics.json, the figures, report.html, scene.mcap and its layout beside the tables just written.

    Args:
        run_config: The run.
        writer: Run folder.
        meta: Content of run.json.
        log: Log of a replay, whose ticks can be computed again; None for a live session.
        progress: Receives the progress.
        second: A second process, which makes the replay and draws some figures, and then ends; None: no such process.
    """
    progress.begin("metrics")
    near = _bounds(run_config.settings.model_dump())
    meta["cameras"] = {name: T.tolist() for name, T in sorted(_camera_poses(run_config, log).items())}
    there = None if second is None else (second, second.submit(_replay_there, run_config, writer.partial, meta))
    everybody = run_folder.read(writer.partial, meta)
    found = compute(everybody, **near)
    release_freed_memory()
    run = everybody.of_person(everybody.people[0])
    stops = _stops(run_config, log, run, near["stationary_m_per_s"], found) if log else ()
    release_freed_memory()
    writer.text("metrics.json", run_folder.to_json(found))
    prediction_stage = assembly.prediction_stage(run_config)
    prediction = prediction_stage.settings
    parts = ("head", "thorax", "upper_arm", "lower_arm")
    radii = {part.replace("_", " "): getattr(prediction, f"radius_{part}_m") for part in parts}
    if prediction_stage.method == "sound" and prediction.legs:
        radii["legs, of sound"] = prediction.legs_radius_m
    folder = writer.partial / "figures"
    kinds = catalogue.select_figures(run, found)
    replay = None if there is not None else _make_replay(run_config, everybody)
    people = most_tracked(everybody, _DRAWN)
    _draw_figures(run_config, everybody, found, kinds, folder, people=people, progress=progress, second=there)
    if there is not None:
        replay = there[1].result()
        there[0].shutdown(wait=False)  # it ends while the page is made
    progress.begin("page")
    shown = [
        tables.limit_table(run_config.prediction_limits, use="prediction"),
        tables.limit_table(run_config.tracking_limits, use="tracking"),
        tables.radius_table(radii),
    ]
    writer.text(
        "report.html",
        report_page.render(run, found, folder, shown, stops=stops, replay=replay, people=people),
    )
    if replay is not None:
        writer.text("foxglove-layout.json", foxglove_layout())


def _make_replay(run_config: RunConfig, run: Run) -> ReplayPart | None:
    """Writes scene.mcap and makes the replay of the page; None for a run without a robot."""
    scene = scene_of(run_config, run)
    release_freed_memory()
    if scene is None:
        return None
    shown = replay_part(scene)
    release_freed_memory()
    write_scene(run.folder / "scene.mcap", scene, run.measurements)
    return shown


def _replay_there(run_config: RunConfig, folder: Path, meta: dict[str, Any]) -> ReplayPart | None:
    """Makes the replay in the second process."""
    made = _make_replay(run_config, _tables(folder, json.dumps(meta)))
    release_freed_memory()
    return made


@lru_cache(maxsize=1)
def _tables(folder: Path, meta: str) -> Run:
    """The tables of an open run, which the second process reads once; ``meta`` is JSON."""
    return run_folder.read(folder, json.loads(meta))


def _camera_poses(run_config: RunConfig, log: Log | None) -> dict[str, Floats]:
    """Returns the pose (4, 4) of each camera in the world, as the cell file or the log has it."""
    known = {} if run_config.cell is None else dict(run_config.cell.T_world_camera)
    if log is None:
        return known
    poses = {**log.header.poses_beside(known)[0], **known}
    return {name: poses[name] for name in log.header.cameras if name in poses}


def _draw_figures(
    run_config: RunConfig,
    everybody: Run,
    metrics: Mapping[str, Metric],
    kinds: Sequence[FigureKind],
    folder: Path,
    *,
    people: Sequence[int] | None = None,
    pdf: bool = False,
    progress: Progress = NO_PROGRESS,
    second: tuple[Executor, Future[Any]] | None = None,
) -> list[str]:
    """Draws figures of a run with all its people; those of one person for each, where they are made for that.

    Args:
        run_config: The run.
        everybody: The run's tables, with all people.
        metrics: The run's metrics.
        kinds: The figures.
        folder: Folder for the files.
        people: Those of whom figures are drawn; None: all.
        pdf: True: also as PDF.
        progress: Receives the progress.
        second: A second process and what it does before it draws the last ones; None: no such process.

    Returns:
        The names drawn.
    """
    drawings = []
    for number in people or everybody.people:
        shown = [kind for kind in kinds if number == everybody.people[0] or kind.each]
        drawings += [_Drawing(run_config, folder, kind.name, number, pdf) for kind in shown]
    progress.begin("figures", len(drawings))

    def here(task: _Drawing) -> tuple[str, ...]:
        drawn = task.draw(everybody, metrics)
        release_freed_memory()
        progress.advance("figures")
        return drawn

    if second is None:
        return [name for task in drawings for name in here(task)]
    (pool, busy), run, meta = second, everybody.folder, json.dumps(everybody.meta)
    drawn = share(drawings, here, lambda task: pool.submit(task.draw_there, run, meta, metrics), busy)
    return [name for names in drawn for name in names]


@dataclass(frozen=True)
class _Drawing:
    """A figure of one person to draw, in either process."""

    run_config: RunConfig
    folder: Path  #: for the files
    name: str  #: of the kind of figure
    number: int  #: the person
    pdf: bool  #: True: also as PDF

    def draw(self, everybody: Run, metrics: Mapping[str, Metric]) -> tuple[str, ...]:
        """Draws it; returns its name, or nothing if the run lacks what is computed for it."""
        kinds = [kind for kind in catalogue.FIGURES if kind.name == self.name]
        data = figure_data(self.run_config, everybody, metrics, kinds, self.number)
        return catalogue.draw_all(data, self.folder, kinds, self.number, pdf=self.pdf)

    def draw_there(self, run: Path, meta: str, metrics: Mapping[str, Metric]) -> tuple[str, ...]:
        """Draws it in the second process."""
        drawn = self.draw(_tables(run, meta), metrics)
        release_freed_memory()
        return drawn


def scene_of(run_config: RunConfig, run: Run) -> ReplayScene | None:
    """Returns the scene of a run's 3-D replay; None for a run without a robot."""
    if run.motion is None or run.T_world_base is None:
        return None
    radii_m = part_radii(run_config.settings.prediction, run_config.settings.report.leg_radius_m)
    parts = dict(zip(PARTS, radii_m.tolist(), strict=True))
    robot = assembly.robot(run_config, run.T_world_base)
    return replay_scene(run, robot, start_ns(run), parts, assembly.bounded_hulls(run_config, robot))


def _stops(
    run_config: RunConfig, log: Log, run: Run, slow_m_per_s: float, found: dict[str, Metric]
) -> tuple[PageTable, ...]:
    """Returns the longest stops of the plan as a table and adds them to the metrics.

    Args:
        run_config: The run.
        log: The replayed log.
        run: The run's tables.
        slow_m_per_s: A TCP slower than this counts as stationary [m/s].
        found: The metrics so far; the metrics of the stops are added.
    """
    if run.motion is None or not len(run.motion):
        return ()
    record = Record(run.folder, run_config.settings.plan.method, run_config, log, run.motion)
    table, every = stop_table(record, slow_m_per_s)
    metrics = MetricTable()
    for i, stop in enumerate(every, start=1):
        which = f"of the plan's longest stops number {i}"
        metrics.add(f"plan_stop_{i:02}_at_s", stop["at_s"], "s", f"{which}: its first tick, from the first of the run")
        metrics.add(f"plan_stop_{i:02}_duration_s", stop["duration_s"], "s", f"{which}: how long it lasted")
        metrics.add(f"plan_stop_{i:02}_cause", stop["cause"], "name", f"{which}: what held the robot at its first tick")
    both = {**found, **metrics.sorted()}
    found.clear()
    found.update(sorted(both.items()))
    return (table,) if table.rows else ()


def summary(folder: Path) -> list[str]:
    """Returns the main figures of a run, one line per stage."""
    run = run_folder.read(folder)
    known = run_folder.read_metrics(folder) or compute(run, **_bounds(run.meta["settings"]))
    return lines(run.of_person(run.people[0]), known)


def _bounds(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the settings that the metrics need."""
    return {
        "near_m": settings["report"]["near_m"],
        "stationary_m_per_s": settings["report"]["stationary_m_per_s"],
        "gap_s": settings["logs"]["gap_s"],
    }


def compute(run: Run, *, near_m: float, stationary_m_per_s: float, gap_s: float = Logs().gap_s) -> dict[str, Metric]:
    """Computes the metrics of a run: name -> value, unit, meaning; null with a reason if one does not apply, never 0.

    Args:
        run: The run's tables; None for stages that were not run.
        near_m: The stationary share counts ticks with a separation of at most this [m].
        stationary_m_per_s: A TCP slower than this counts as stationary [m/s].
        gap_s: A camera silent for longer has a gap [s].

    Returns:
        Sorted by name, plain Python values, finite numbers only.
    """
    recorded = run.meta.get("settings", {})
    metrics = MetricTable()
    add_people(metrics, run)
    run = run.of_person(run.people[0])
    add_quality(metrics, run, gap_s)
    add_limbs(metrics, run)
    add_occupancy(metrics, run.occupancy)
    add_fusion(metrics, run, gap_s)
    add_plan(
        metrics,
        run.motion,
        run.baselines,
        method=str(setting(recorded, "plan", "method")),
        near_m=near_m,
        stationary_m_per_s=stationary_m_per_s,
        max_reference_lead_m=float(setting(recorded, "plan", "max_reference_lead_m")),
        contact=run.contact,
        recorded=run.recorded,
    )
    add_contact(metrics, run, stationary_m_per_s)
    add_severity(metrics, run)
    return metrics.sorted()


def take_still(folder: Path, at_s: float, out: Path | None) -> Path:
    """Draws the scene of a run at the instant of its replay that is nearest to ``at_s``.

    Args:
        folder: Folder of a run with a robot.
        at_s: Time on the report's clock [s].
        out: PNG file to create; None: ``snapshot-<seconds>.png`` in the working directory.

    Raises:
        SettingsError: The folder is not a run folder, the instant is outside the run, or the file exists or cannot be
            written.
    """
    scene = _read_scene(folder, "--snapshot")[1]
    first, last = scene.seconds[[0, -1]].tolist()
    if not first <= at_s <= last:
        raise SettingsError(f"--snapshot {at_s:g}: found an instant outside the run; from {first:g} to {last:g} s")
    row = int(abs(scene.seconds - at_s).argmin())
    path = out or Path(f"snapshot-{scene.seconds[row]:.2f}.png")
    with drawing.style():
        figure = snapshot(scene, row)
        figure.set_facecolor("white")
        run_folder.write_whole(path, drawing.png_bytes(figure))
    return path


def make_movie(folder: Path, out: Path | None) -> Path:
    """Writes the tour of a run's worst moments as a moving picture.

    Args:
        folder: Folder of a run with a robot.
        out: MP4 or GIF to create; None: ``tour.mp4``, or ``tour.gif`` without ffmpeg, in the working directory.

    Raises:
        SettingsError: The folder is not a run folder, the file exists or cannot be written, or ffmpeg is needed and
            missing.
    """
    path = out or Path(default_name())
    with _new_file(path) as made:
        write_movie(made, _read_scene(folder, "--movie")[1])
    return path


def save_for_rerun(folder: Path, out: Path | None) -> Path:
    """Writes the scene of a run for the Rerun viewer.

    Args:
        folder: Folder of a run with a robot.
        out: File to create; None: ``scene.rrd`` in the working directory.

    Raises:
        SettingsError: The folder is not a run folder, the file exists or cannot be written, or rerun-sdk is missing.
    """
    from hrcreplay.reporting.scene_rerun import write_scene as write_for_rerun  # rerun-sdk is an extra

    path = out or Path("scene.rrd")
    run, scene = _read_scene(folder, "--rerun")
    with _new_file(path) as made:
        write_for_rerun(made, scene, run.measurements, run.folder.name)
    return path


def make_pdf(folder: Path, out: Path | None) -> Path:
    """Writes the safety file of a run: four pages to print, sign and file.

    Args:
        folder: Folder of a run with a robot.
        out: PDF to create; None: ``<log>-safety-file.pdf`` in the working directory.

    Raises:
        SettingsError: The folder is not a run folder, or the file exists or cannot be written.
    """
    run, scene = _read_scene(folder, "--pdf")
    metrics = _recorded(folder, "--pdf")[1]
    one = run.of_person(run.people[0])
    path = out or Path(f"{PurePath(log_name(run)).stem}-safety-file.pdf")
    stills = []
    rows = dict.fromkeys((telling_moment(scene).row, *(int(abs(scene.seconds - s.at_s).argmin()) for s in tour(scene))))
    with drawing.style():
        for row in list(rows)[:2]:
            figure = snapshot(scene, row)
            figure.set_facecolor("white")
            stills.append(
                (f"The robot by {next(iter(scene.methods))} at {scene.seconds[row]:.2f} s.", drawing.png_bytes(figure))
            )
    run_folder.write_whole(path, safety_file(one, metrics, stills))
    return path


@contextmanager
def _new_file(path: Path) -> Iterator[Path]:
    """Gives a temporary name for a new file, which is renamed when it is complete."""
    if path.exists():
        raise SettingsError(f"{path}: exists already; name another file with --out, or remove it")
    try:
        with tempfile.TemporaryDirectory(prefix=".hrcreplay-", dir=path.parent) as folder:
            made = Path(folder) / path.name
            yield made
            made.rename(path)
    except OSError as error:
        raise SettingsError(f"{path}: cannot be written ({error.strerror}); name a folder that can") from error


def _read_scene(folder: Path, option: str) -> tuple[Run, ReplayScene]:
    """Returns the tables and the scene of a run folder."""
    if not run_folder.is_run(folder):
        raise SettingsError(f"{option}: {folder} is no run folder; make one with: hrcreplay report {folder}")
    run = run_folder.read(folder)
    scene = scene_of(read_run_config(folder), run)
    if scene is None:
        raise SettingsError(f"{option}: {folder} moved no robot; make a report of it first")
    return run, scene


def figure_data(
    run_config: RunConfig, everybody: Run, metrics: Mapping[str, Metric], kinds: Sequence[FigureKind], number: int = 1
) -> FigureData:
    """Returns all data from which some figures of a run are drawn.

    Args:
        run_config: Configuration of the run.
        everybody: The run's tables, with all people.
        metrics: The run's metrics.
        kinds: The figures.
        number: The person of the figures that show one.
    """
    predicted = compute_fields(run_config, everybody, number, [kind.predicted for kind in kinds])
    bounds = _bounds(run_config.settings.model_dump())
    return FigureData(everybody.of_person(number), metrics, **bounds, **predicted, everybody=everybody)


def draw_figures(folder: Path, key: str, out: Path | None) -> list[Path]:
    """Draws the figures with a number or a name from a run folder, also as PDF.

    PNG and SVG equal those of the report byte by byte.

    Args:
        folder: A run folder.
        key: Number of the figure in the paper, or name of the file, or ALL_FIGURES.
        out: Folder for the files; None: the working directory.

    Returns:
        The files written: PNG, SVG and PDF of each figure.

    Raises:
        SettingsError: The folder is not a run folder, there is no such figure, the run lacks its data, or a file exists
            already.
    """
    kinds, every = catalogue.find(key), key == ALL_FIGURES
    if not kinds and not every:
        there = ", ".join(map(catalogue.label, catalogue.FIGURES))
        raise SettingsError(f"--figure {key}: no such figure; there are {there}")
    everybody, metrics = _recorded(folder, "--figure")
    run = everybody.of_person(everybody.people[0])
    kinds = catalogue.select_figures(run, metrics) if every else kinds
    for kind in kinds:
        if why := catalogue.missing(kind, run, metrics):
            raise SettingsError(f"--figure {key}: {folder} lacks what it needs: {why}")
    to = out or Path()
    names = [
        catalogue.file_name(kind, number)
        for kind in kinds
        for number in (everybody.people if kind.each else everybody.people[:1])
    ]
    suffixes = ("png", "svg", "pdf")
    if taken := [path for name in names for suffix in suffixes if (path := to / f"{name}.{suffix}").exists()]:
        raise SettingsError(f"{taken[0]}: exists already; name another folder with --out, or remove it")
    with tempfile.TemporaryDirectory() as made:
        drawn = _draw_figures(read_run_config(folder), everybody, metrics, kinds, Path(made), pdf=True)
        if len(drawn) < len(names) and not every:
            raise SettingsError(
                f"--figure {key}: {folder} lacks what it needs: the person was not known well enough then"
            )
        try:
            to.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SettingsError(f"{to}: cannot be made ({error.strerror}); name another folder with --out") from error
        paths = [to / f"{name}.{suffix}" for name in names if name in drawn for suffix in suffixes]
        for path in paths:
            run_folder.write_whole(path, (Path(made) / path.name).read_bytes())
    return paths


def list_figures(folder: Path | None) -> list[str]:
    """Lists the figures, one per line: number or name, title and, for a run folder, any missing data."""
    run = None if folder is None else _of_first(*_recorded(folder, "--list-figures"))
    lines = []
    for kind in catalogue.FIGURES:
        why = "" if run is None else catalogue.missing(kind, *run)
        state = "" if run is None else f"lacks: {why}" if why else "there"
        lines.append(f"{catalogue.label(kind):<17}{kind.title:<76}{state}".rstrip())
    return lines


def _recorded(folder: Path, option: str) -> tuple[Run, dict[str, Metric]]:
    """Returns the tables and metrics of a run folder; computes the metrics if metrics.json is missing."""
    if not run_folder.is_run(folder):
        raise SettingsError(f"{option}: {folder} is no run folder; make one with: hrcreplay report {folder}")
    run = run_folder.read(folder)
    if "settings" not in run.meta or "fusion" not in run.meta["settings"]:
        raise SettingsError(f"{option}: {folder} is no run of fuse, predict, plan, report or live")
    path = folder / "metrics.json"
    metrics = json.loads(path.read_text()) if path.exists() else compute(run, **_bounds(run.meta["settings"]))
    return run, metrics


def _of_first(run: Run, metrics: dict[str, Metric]) -> tuple[Run, dict[str, Metric]]:
    return run.of_person(run.people[0]), metrics
