"""The command ``bench``: the time of every stage on a log, beside well-known programs for the same tasks in one run.

A stage has its median and mean in batches, as a replay runs it, and its times tick by tick, as a live session does;
both with the work around it: records of each batch, and the volumes prepared for it. In a batch a tick is not timed: it
counts with its share of the batch. The decision of the method, from the people to the certified step, is timed alone.

References: filterpy's dense Kalman filter over the same states and its smoother joint by joint, Qhull on the vertices
that the volumes have, and daqp on the controller's cost with one row per link and vertex. They are timed without the
work around them.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from filterpy.kalman import KalmanFilter
from rich import box
from rich.console import Console
from rich.table import Table
from scipy.linalg import block_diag
from scipy.spatial import ConvexHull

from hrcreplay.errors import SettingsError
from hrcreplay.human.fusion.smoother import smooth
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline import assembly, stages
from hrcreplay.pipeline.kernel_build import ensure_compiled
from hrcreplay.pipeline.person_fuser import PersonFuser
from hrcreplay.pipeline.progress import NO_PROGRESS, Progress
from hrcreplay.pipeline.run_config import RunConfig, RunOptions, resolve
from hrcreplay.pipeline.stages import Sink
from hrcreplay.pipeline.stored_volumes import store_every
from hrcreplay.pipeline.surroundings import Forecast
from hrcreplay.records import DOF, JOINTS, LENGTHS, Floats, HumanStates, Ints
from hrcreplay.robot.control.separation import Obstacles
from hrcreplay.robot.model import RobotModel
from hrcreplay.store.machine import describe_machine
from hrcreplay.store.run_folder import Stopwatch

#: Length of the stretch that is timed, and largest number of ticks for a reference.
SECONDS, FEW = 20.0, 500
#: Ticks of a batch.
BATCH = 250
#: Number of calls of a smoother.
_SMOOTHINGS = 3
#: Vertices of a volume this near to a plane lie in it [m].
_FLAT_M = 1e-6
_MB = 1024.0
#: From this value on a number of the table has no decimals.
_WHOLE = 100.0


@dataclass(frozen=True)
class BenchRow:
    """Times of one stage."""

    name: str
    ticks: int
    batch_median_us: float  #: of a stage, in batches: the tick in the middle, each with its share of its batch
    mean_us: float  #: of a stage, in batches
    real_time_factor: float  #: by the mean
    median_us: float  #: tick by tick, as the next two
    p99_us: float
    max_us: float
    reference: bool = False


@dataclass(frozen=True)
class BenchResult:
    """Result of a benchmark."""

    log: str
    seconds: float
    rate_hz: float
    peak_mb: float  #: largest memory of the process until the end of the stages [MiB]
    rows: tuple[BenchRow, ...]
    missing: tuple[str, ...] = ()  #: references that are not installed
    machine: Mapping[str, Any] = field(default_factory=describe_machine)

    def to_dict(self) -> dict[str, Any]:
        """Returns the result as JSON has it."""
        return asdict(self) | {"machine": dict(self.machine)}


class _Kept:
    """Tables of a run in memory: measurements and motion alone."""

    def __init__(self) -> None:
        self.parts: dict[str, list[Mapping[str, Any]]] = {"measurements": [], "motion": []}

    def table(self, name: str, columns: Mapping[str, Any], /) -> None:
        """Keeps rows of a table."""
        if name in self.parts:
            self.parts[name].append(columns)

    def column(self, name: str, columns: Sequence[str]) -> Floats:
        """(n, k) columns of a table."""
        return np.concatenate([np.column_stack([part[one] for one in columns]) for part in self.parts[name]])


def run(
    log: Path, *, seconds: float = SECONDS, progress: Progress = NO_PROGRESS, **options: Unpack[RunOptions]
) -> BenchResult:
    """Times the stages on the first seconds of a log, in batches and tick by tick, then the references.

    Args:
        log: Log or run folder.
        seconds: Length of the stretch [s].
        progress: Receives the progress.
        **options: Settings, cell and span, as ``run_config.resolve`` takes them.

    Raises:
        SettingsError: A setting or the cell cannot be used, or ``seconds`` is not positive.
        LogError: The log cannot be read, or lacks what a stage needs.
    """
    if not 0.0 < seconds < stages.LONGEST_S:
        raise SettingsError(f"--seconds {seconds:g}: would be right: a number of seconds above 0, e.g. {SECONDS:g}")
    ensure_compiled()
    begin_s = options.get("start_s") or 0.0
    options["end_s"] = min(options.get("end_s") or np.inf, begin_s + seconds)
    run_config = resolve("plan", log, **options)
    ticks_ns = stages.span_ticks(run_config, open_log(run_config.log, run_config.settings.logs))
    period_s = 1.0 / run_config.settings.fusion.rate_hz
    progress.begin("stages in batches", len(ticks_ns))
    batches, _, _ = _time_stages(run_config, ticks_ns, BATCH, progress)
    progress.begin("stages tick by tick", len(ticks_ns))
    single, kept, states = _time_stages(run_config, ticks_ns, 1, progress)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _MB
    rows = []
    for name, one in single.summary(period_s).items():
        together = batches.summary(period_s)[name]
        factor = together["real_time_factor"]
        in_batches = together["median_us"], 1e6 * period_s / factor, factor
        rows.append(BenchRow(name, one["ticks"], *in_batches, one["median_us"], one["p99_us"], one["max_us"]))
    progress.begin("decisions", len(ticks_ns))
    decisions = _time_decisions(run_config, states, progress)
    rows += [_summarise(name, took_us, period_s, reference=False) for name, took_us in decisions.items()]
    progress.begin("references")
    references, missing = _time_references(run_config, kept, states)
    rows += [_summarise(name, took_us, period_s, reference=True) for name, took_us in references.items()]
    length_s = float(ticks_ns[-1] - ticks_ns[0]) * 1e-9
    return BenchResult(run_config.log.name, length_s, 1.0 / period_s, peak_mb, tuple(rows), missing)


def _summarise(name: str, took_us: Floats, period_s: float, *, reference: bool) -> BenchRow:
    """Summarises the times of single calls."""
    median, p99 = np.quantile(took_us, [0.5, 0.99]).tolist()
    mean_us, max_us = float(took_us.mean()), float(took_us.max())
    return BenchRow(name, len(took_us), median, mean_us, 1e6 * period_s / mean_us, median, p99, max_us, reference)


def _time_stages(
    run_config: RunConfig, ticks_ns: Ints, size: int, progress: Progress
) -> tuple[Stopwatch, _Kept, HumanStates]:
    """Runs all stages in batches of ``size`` ticks; returns times, tables and the people."""
    log, kept = open_log(run_config.log, run_config.settings.logs), _Kept()

    def advance(stage: str, ticks: int) -> None:
        if stage == "plan":  # the last one
            progress.advance(_part(size), ticks)

    sink = Sink(kept, Stopwatch(time.perf_counter_ns), advance)
    states: list[HumanStates] = []

    def keep(parts: Iterable[HumanStates]) -> Iterator[HumanStates]:
        for part in parts:
            states.append(part)
            yield part

    robot = assembly.robot(run_config, assembly.robot_base(run_config, log))
    moved = assembly.followers(run_config, assembly.programme(run_config, log, robot), int(ticks_ns[0]))
    fused = stages.fuse_batches(log, ticks_ns, size, assembly.fusion_stage(run_config, log), sink)
    every = store_every(run_config)
    for _ in stages.plan_batches(keep(fused), assembly.surroundings(run_config, robot), moved, every, sink):
        pass
    return sink.watch, kept, HumanStates.join(states)


def _time_decisions(run_config: RunConfig, states: HumanStates, progress: Progress) -> dict[str, Floats]:
    """Times the decisions of the chosen method; returns those and the times of their volumes, (n,) each [us].

    As in a replay, the people of a batch are prepared for all horizons first; that counts to the batch's first tick.
    """
    log, method = open_log(run_config.log, run_config.settings.logs), run_config.settings.plan.method
    robot = assembly.robot(run_config, assembly.robot_base(run_config, log))
    around, clock = assembly.surroundings(run_config, robot), time.perf_counter_ns
    t_ns, first = states.ticks()
    programme = assembly.programme(run_config, log, robot)
    controller = assembly.planners(run_config, programme, int(t_ns[0]))[method].controller
    took, volumes = np.empty(len(t_ns)), np.zeros(len(t_ns))
    for begin in range(0, len(t_ns), BATCH):
        end = min(begin + BATCH, len(t_ns))
        forecast = Forecast(around, states.rows(slice(int(first[begin]), int(first[end]))), most_ahead=0)

        def look(tick: int, horizon_s: float, begin: int = begin, forecast: Forecast = forecast) -> Obstacles:
            start_ns = clock()
            found = forecast.obstacles(tick - begin, horizon_s)
            volumes[tick] += clock() - start_ns
            return found

        for tick in range(begin, end):
            start_ns = clock()
            controller.step(partial(look, tick))
            took[tick] = clock() - start_ns
        progress.advance("decisions", end - begin)
    return {f"decision of {method}": took / 1e3, "volumes of a decision": volumes / 1e3}


def _part(size: int) -> str:
    return "stages tick by tick" if size == 1 else "stages in batches"


def _time_references(
    run_config: RunConfig, kept: _Kept, states: HumanStates
) -> tuple[dict[str, Floats], tuple[str, ...]]:
    """Times the references; returns name -> (n,) times [us], and the names of those that are not installed."""
    log = open_log(run_config.log, run_config.settings.logs)
    robot = assembly.robot(run_config, assembly.robot_base(run_config, log))
    surroundings = assembly.surroundings(run_config, robot)
    forecast = Forecast(surroundings, states)
    known = np.flatnonzero(np.isfinite(states.p).all(axis=1) & (states.numbers == 1))
    if not len(known):
        return {}, ()
    rows = known[np.linspace(0, len(known) - 1, min(FEW, len(known))).astype(int)]
    ticks = np.searchsorted(forecast.t_ns, states.t_ns[rows])
    horizons = kept.column("motion", ["horizon_s"])[ticks, 0]
    found = {"filterpy: dense filter": _dense_filter_us(kept, states.t_ns), **_smoothers_us(run_config, forecast.t_ns)}
    volumes = [forecast.person.volumes(float(h), int(row), int(row) + 1) for row, h in zip(rows, horizons, strict=True)]
    hulls = [[cloud for i in range(len(one.limbs)) if _is_solid(cloud := one.vertices(0, i))] for one in volumes]
    found["volumes of one person alone"] = _each_us(
        rows,
        lambda row: Forecast(surroundings, states.rows(slice(row, row + 1))).person.volumes(
            surroundings.prediction.horizon_s
        ),
    )
    found["qhull: hulls of their vertices"] = _each_us(hulls, lambda clouds: [ConvexHull(cloud) for cloud in clouds])
    try:
        import daqp
    except ImportError:
        return found, ("daqp",)
    seen = [forecast.obstacles(int(tick), float(h)) for tick, h in zip(ticks, horizons, strict=True)]
    axes = range(1, robot.nv + 1)
    q, dq = (kept.column("motion", [f"{name}{i}" for i in axes])[ticks] for name in ("q", "dq"))
    problems = [dense_problem(robot, *state) for state in zip(q, dq, seen, strict=True)]
    found["daqp: QP with a row per link and vertex"] = _each_us(problems, lambda problem: daqp.solve(*problem))
    return found, ()


def _is_solid(cloud_m: Floats) -> bool:
    """Returns True for vertices (n, 3) that do not lie in a plane, of which Qhull would make no hull."""
    return int(np.linalg.matrix_rank(cloud_m - cloud_m.mean(axis=0), tol=_FLAT_M)) == 3


def _each_us(items: Iterable[Any], work: Callable[[Any], object]) -> Floats:
    """(n,) time of each call; the first item is worked on before [us]."""
    items = list(items)
    work(items[0])
    took = []
    for item in items:
        begin_ns = time.perf_counter_ns()
        work(item)
        took.append((time.perf_counter_ns() - begin_ns) / 1e3)
    return np.array(took)


def _dense_filter_us(kept: _Kept, t_ns: Ints) -> Floats:
    """(n,) times of filterpy's filter over the same states: predicts every tick, updates with the frames of the log."""
    names = [*JOINTS, *LENGTHS]
    z = kept.column("measurements", names)
    arrival_ns = np.concatenate([part["arrival_ns"] for part in kept.parts["measurements"]])
    dt_s, size = float(np.median(np.diff(t_ns))) * 1e-9, 4 * DOF + len(LENGTHS)
    dense = KalmanFilter(size, 1)
    chain = sum(np.eye(4, k=k) * dt_s**k / (1, 1, 2, 6)[k] for k in range(4))
    F = block_diag(np.kron(chain, np.eye(DOF)), np.eye(len(LENGTHS)))
    Q = np.diag(np.repeat([0.0, 1e-4, 0.0, 0.0, 0.0], [DOF] * 4 + [len(LENGTHS)]))
    H = np.zeros((DOF + len(LENGTHS), size))
    H[:DOF, :DOF], H[DOF:, 4 * DOF :] = np.eye(DOF), np.eye(len(LENGTHS))
    R, seen = np.eye(len(H)) * 1e-3, int(np.searchsorted(arrival_ns, t_ns[0]))
    took = []
    for now in np.unique(t_ns)[:FEW]:
        begin_ns = time.perf_counter_ns()
        dense.predict(F=F, Q=Q)
        while seen < len(z) and arrival_ns[seen] <= now:
            dense.update(np.nan_to_num(z[seen])[:, None], R=R, H=H)
            seen += 1
        took.append((time.perf_counter_ns() - begin_ns) / 1e3)
    return np.array(took)


def _smoothers_us(run_config: RunConfig, ticks_ns: Ints) -> dict[str, Floats]:
    """Times the smoother and filterpy's on the first ticks at which person 1 is known: name -> (n,) for a tick [us]."""
    log = open_log(run_config.log, run_config.settings.logs)
    stage, few_ns = assembly.fusion_stage(run_config, log), ticks_ns[: 2 * FEW]
    fuser = PersonFuser(replace(stage, watched=None), log.header.cameras, traced=True)
    frames = log.frames(int(few_ns[0]), int(few_ns[-1]) + 1)
    fused, _ = fuser.update(*next(stages.batches(frames, few_ns, len(few_ns))))
    known = np.isfinite(fused.states.p).all(axis=1) & (fused.states.numbers == 1)
    rows = np.flatnonzero(known)[:FEW]
    if len(rows) < 2:
        return {}
    states, trace = replace(fused.states.rows(rows), person=None), fused.trace.rows(rows)
    mean, (F, Q) = np.stack([states.p, states.v, states.a, states.j], axis=2), (np.eye(4), 1e-6 * np.eye(4))

    def by_filterpy(_: int) -> None:
        for j in range(DOF):
            KalmanFilter(4, 1).rts_smoother(mean[:, j], trace.cov[:, j], [F] * len(rows), [Q] * len(rows))

    calls = range(_SMOOTHINGS)
    ours = _each_us(calls, lambda _: smooth(states, trace, stage.filter))
    return {"smoother": ours / len(rows), "filterpy: smoother": _each_us(calls, by_filterpy) / len(rows)}


def dense_problem(robot: RobotModel, q: Floats, dq: Floats, seen: Obstacles) -> tuple[Floats, ...]:
    """The tracking cost and one speed row per end of a link and vertex, Eq. (12), written down for a dense solver.

    Args:
        robot: The robot.
        q: (nv,) [rad].
        dq: (nv,) [rad/s].
        seen: Obstacles of the tick.

    Returns:
        ``H``, ``f``, ``A``, upper and lower bounds as daqp takes them; first the bounds of the velocities.
    """
    pose = robot.pose(q, dq)
    H = pose.J_tcp.T @ pose.J_tcp + 1e-3 * np.eye(robot.nv)
    g = -H @ dq
    rows = []
    for link in range(len(pose.ends_m)):
        for end in range(2):
            away = seen.vertices_m - pose.ends_m[link, end]
            rows.append(away @ pose.J_ends[link, end])
    A = np.ascontiguousarray(np.concatenate(rows))
    top = np.concatenate([robot.dq_max, np.full(len(A), 1.0)])
    low = np.concatenate([-robot.dq_max, np.full(len(A), -1e30)])
    return H, g, A, top, low


def print_table(found: BenchResult, console: Console) -> None:
    """Prints the times of a benchmark."""
    table = Table(
        title=f"{found.log}, {found.seconds:.1f} s, ticks at {found.rate_hz:g} Hz, peak memory {found.peak_mb:.0f} MB\n"
        "us per tick, first in batches as in a replay, then tick by tick",
        box=box.SIMPLE_HEAD,
        title_justify="left",
    )
    table.add_column("stage")
    for heading in ("ticks", "median", "mean", "x real time", "median", "p99", "max"):
        table.add_column(heading, justify="right")
    for row in sorted(found.rows, key=lambda row: row.reference):
        shares = row.batch_median_us, row.mean_us, row.real_time_factor
        values = (*shares, row.median_us, row.p99_us, row.max_us)
        numbers = (f"{value:,.0f}" if value >= _WHOLE else f"{value:.1f}" for value in values)
        table.add_row(row.name, f"{row.ticks:,}", *numbers)
    console.print(table)
    for name in found.missing:
        console.print(f'{name} is not installed; for its row: pip install "hrcreplay[bench]"')
