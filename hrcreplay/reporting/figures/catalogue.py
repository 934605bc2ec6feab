"""The figures of a run: a table of all figures with the data that each needs, and their drawing."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeVar

from matplotlib.figure import Figure

from hrcreplay.reporting.figures import drawing, fusion, planning, prediction, scene
from hrcreplay.reporting.figures.planning import SHORTEST_M, Deviation
from hrcreplay.reporting.figures.prediction import Growth, Instant, Sweep, Walk
from hrcreplay.reporting.figures.scene import LinkPose, Storyboard
from hrcreplay.reporting.metrics.fusion import cameras
from hrcreplay.reporting.metrics.people import named_volumes
from hrcreplay.reporting.metrics.series import Metric, find_known_ticks, instants, moment_ns, start_ns
from hrcreplay.settings.sections import Logs, setting
from hrcreplay.store.memory import release_freed_memory
from hrcreplay.store.run_folder import Run
from hrcreplay.store.stored_table import RunTable

_T = TypeVar("_T")


@dataclass(frozen=True)
class FigureData:
    """Input of figures: the run's tables and metrics, and the prediction at some instants."""

    run: Run  #: of one person
    metrics: Mapping[str, Metric]
    near_m: float  #: the stationary share counts ticks with a separation of at most this
    stationary_m_per_s: float  #: a TCP slower than this counts as stationary
    gap_s: float = Logs().gap_s  #: a longer time without frames counts as a gap of a camera
    instants: Sequence[Instant] = ()  #: the swept volumes by several methods at the ticks that ``instants`` names
    walk: Walk | None = None
    sweep: Sweep | None = None
    growth: Growth | None = None
    story: Storyboard | None = None
    pose: LinkPose | None = None  #: the robot at the tick that ``nearest_tick`` names
    everybody: Run | None = None  #: the run with all people; None: there is one

    @property
    def t0_ns(self) -> int:
        """Instant of time zero [ns]."""
        return start_ns(self.run)

    @property
    def motion(self) -> RunTable:
        """Rows of motion.parquet."""
        return _require_table(self.run.motion)

    @property
    def state(self) -> RunTable:
        """Rows of state.parquet."""
        return _require_table(self.run.state)

    @cached_property
    def volumes(self) -> RunTable | None:
        """Rows of occupancy.parquet of all people, each limb named with its person."""
        return named_volumes((self.everybody or self.run).occupancy)

    @cached_property
    def worst(self) -> Deviation:
        """The largest deviation of the TCP from its programmed path."""
        return planning.largest_deviation(self.motion)


def require(value: _T | None) -> _T:
    """Returns a value that must not be None; figures without their data are not drawn."""
    if value is None:
        raise ValueError("a figure is drawn without its data")
    return value


def _require_table(table: RunTable | None) -> RunTable:
    """The same of a table, whose type is a union."""
    found: RunTable = require(table)  # type: ignore[assignment]
    return found


@dataclass(frozen=True)
class FigureKind:
    """A figure that a run may have."""

    name: str  #: name of its files
    numbers: tuple[str, ...]  #: number in the paper; None for other figures
    title: str
    section: str  #: section of the page
    needs: tuple[str, ...]  #: keys of NEEDS
    draw: Callable[[FigureData], Figure]
    caption: str
    predicted: str = ""  #: field of FigureData that must be computed for it
    each: bool = False  #: True: one for each person
    one: bool = False  #: True: shows one person, the first


#: Data that a run may lack: a test for their presence, and a message if they are missing.
NEEDS: dict[str, tuple[Callable[[Run, Mapping[str, Metric]], bool], str]] = {
    "motion": (
        lambda run, _: run.motion is not None and len(run.motion) > 1,
        "it moved no robot; run plan or report on its log",
    ),
    "path": (
        lambda _, metrics: metrics["plan_deviation_max_m"]["value"] is not None,
        "the path of the TCP is unknown",
    ),
    "deviation": (
        lambda _, metrics: metrics["plan_deviation_max_m"]["value"] >= SHORTEST_M,
        "its TCP never left the programmed path",
    ),
    "horizon": (
        lambda run, _: run.motion is not None and "horizon_s" in run.motion,
        "its motion.parquet has no horizon_s; make it again from its log",
    ),
    "base": (lambda run, _: run.T_world_base is not None, "the pose of the robot's base is unknown"),
    "joints": (
        lambda run, _: run.motion is not None and "q1" in run.motion and bool(run.motion["q1"].notna().any()),
        "the joint positions of the robot are unknown",
    ),
    "alone": (
        lambda run, _: "none" in run.baselines,
        'no robot that ignores the person; run it with "none" among plan.baselines',
    ),
    "person": (lambda run, _: len(find_known_ticks(run)) > 0, "no person was seen in it"),
    "seconds": (lambda run, _: len(instants(run)) > 0, "the person is not known for three seconds"),
    "occupancy": (
        lambda run, _: run.occupancy is not None and len(run.occupancy) > 0,
        "it has no swept volumes; run predict, plan or report on its log",
    ),
    "measurements": (
        lambda run, _: run.measurements is not None and len(run.measurements) > 0,
        "no camera saw a person",
    ),
    "ticks": (lambda run, _: run.state is not None and len(run.state) > 1, "no person was fused"),
    "truth": (
        lambda _, metrics: metrics["fusion_angle_rmse"]["value"] is not None,
        "its log has no ground truth",
    ),
}

FIGURES = (
    FigureKind(
        "fig05_walking",
        ("5",),
        "floor area that a person can reach, at the fastest step",
        "prediction",
        ("person",),
        lambda data: prediction.walking(require(data.walk), data.t0_ns),
        "As the paper's Fig. 5, at the instant of the fastest walking. Dashed: the circular sectors that a unicycle "
        "reaches within the stopping time, as in the paper. Orange: their convex approximation, Eq. (22)-(30), "
        "corrected. Blue: every walk under the joints' bounds, of every likely state. Red: where the person walked.",
        "walk",
        one=True,
    ),
    FigureKind(
        "fig07_sweeps",
        ("7", "8"),
        "a forearm swept by walking (7) and by the elbow (8)",
        "prediction",
        ("person",),
        lambda data: prediction.sweeps(require(data.sweep), data.t0_ns),
        "As the paper's Fig. 7 and 8, on the forearm of this run's person. On the right the elbow turns it through "
        "all angles that it can reach by the paper's method: arcs in triangles, and their hull. On the left that set "
        "is displaced to all positions that walking can reach, seen from above.",
        "sweep",
        one=True,
    ),
    FigureKind(
        "fig09_volumes",
        ("9",),
        "swept volumes as the run used them",
        "prediction",
        ("occupancy", "person"),
        lambda data: prediction.volumes_at(
            _require_table(data.volumes),
            (data.everybody or data.run).states(),
            require(moment_ns(data.run)),
            data.t0_ns,
        ),
        "As the paper's Fig. 9. The swept volumes that this run used, limb radii included, with the fused skeleton.",
    ),
    FigureKind(
        "fig13a_path",
        ("13a",),
        "programmed and actual path of the TCP",
        "cost",
        ("motion", "path"),
        lambda data: planning.path(data.motion, data.volumes, data.t0_ns, data.run.T_world_base, data.worst),
        "As the paper's Fig. 13(a). Programmed and actual path of the TCP. The two dots are the ends of the largest "
        "deviation; shaded: the swept volumes of the person at that tick.",
    ),
    FigureKind(
        "fig13b_deviation",
        ("13b",),
        "largest deviation from the programmed path",
        "cost",
        ("motion", "path", "deviation"),
        lambda data: planning.deviation(data.motion, data.volumes, data.t0_ns, data.worst),
        "As the paper's Fig. 13(b). The largest deviation from the programmed path with its length, in the vertical "
        "plane that contains it. The paper's own deviation is 0.221 m.",
    ),
    FigureKind(
        "fig14_speed",
        ("14",),
        "programmed speed, actual speed, separation",
        "safety",
        ("motion",),
        lambda data: planning.speed(data.motion, data.t0_ns, data.near_m),
        "As the paper's Fig. 14. Programmed speed of the TCP; its actual speed, braking shaded; and the smallest "
        "distance, surface to surface, between the robot and what the person could reach within the tick's horizon.",
    ),
    FigureKind(
        "fig15_storyboard",
        ("15", "16"),
        "the same stretch of the programme without the person (15) and with (16)",
        "cost",
        ("motion", "joints", "base", "alone", "occupancy", "person"),
        lambda data: scene.storyboard(require(data.story), data.t0_ns),
        "As the paper's Fig. 15 and 16. Each row is the same instant of the programme: on the left as the robot "
        "passes it without reaction to people (the baseline none), on the right near the person.",
        "story",
    ),
    FigureKind(
        "fig17_volumes",
        ("17",),
        "swept volumes at four instants, by method",
        "prediction",
        ("seconds",),
        lambda data: prediction.volumes(data.instants, data.state, data.t0_ns),
        "As the paper's Fig. 17. The space that the person could reach within the stopping time at four instants, "
        "limb radii included: from positions and velocities (paper); by the older method, from positions only; and by "
        "this run's method, if different.",
        "instants",
        each=True,
    ),
    FigureKind(
        "fig18_coordinate",
        ("18",),
        "one coordinate of the person as measured and as fused",
        "fusion",
        ("measurements",),
        lambda data: fusion.coordinate(data.run, data.t0_ns, data.gap_s),
        "As the paper's Fig. 18. One coordinate of the person as each camera saw it and as fused and, if the log has "
        "ground truth, the errors.",
        one=True,
    ),
    FigureKind(
        "horizon",
        (),
        "horizon and stop time over time",
        "safety",
        ("motion", "horizon"),
        lambda data: planning.horizon(data.motion, data.t0_ns, _stop_s(data.run)),
        "Horizon of the swept volumes used at each tick, and duration of the stop that the robot would make from "
        "there; T\u209b is the stop from full speed. Braking is shaded.",
    ),
    FigureKind(
        "volume_horizon",
        (),
        "swept volume against the horizon, by method",
        "prediction",
        ("person",),
        lambda data: prediction.growth(require(data.growth), data.run.occupancy, data.t0_ns),
        "How the swept volumes of the six limbs, added up, grow with the horizon: by each method at one instant "
        "(lines), and as this run stored them at all others (dots).",
        "growth",
        one=True,
    ),
    FigureKind(
        "status",
        (),
        "what each method did over time",
        "safety",
        ("motion",),
        lambda data: planning.status(
            data.motion,
            data.run.baselines,
            method=str(data.metrics["plan_method"]["value"]),
            t0_ns=data.t0_ns,
            near_m=data.near_m,
            slow_m_per_s=data.stationary_m_per_s,
        ),
        "Status of the robot over time. Limited: slowed by a safety constraint or a limit. Above each bar, grey: the "
        "robot is near the person; solid: it stands there although its programme moves. Where periods are narrower "
        "than a line, the most severe status is drawn.",
    ),
    FigureKind(
        "stationary_share",
        (),
        "share of the near ticks at which each method stood",
        "cost",
        ("motion",),
        lambda data: planning.stationary_share(data.metrics),
        "Share of the ticks near the person at which the robot stood still although its programme moves. The hatched "
        "bars are the paper's own numbers, from its own data: they can be compared in kind only.",
    ),
    FigureKind(
        "robot_links",
        (),
        "the robot's capsules where it was nearest to the person",
        "robot",
        ("motion", "joints", "base"),
        lambda data: scene.links(require(data.pose), data.t0_ns, require(data.run.T_world_base)),
        "The robot as used for distances: a capsule around each collision shape of its links, at the tick of the "
        "smallest separation, with the swept volumes of the person. The square is the robot's base.",
        "pose",
    ),
    FigureKind(
        "fusion_error",
        (),
        "errors against ground truth, by joint",
        "fusion",
        ("truth",),
        lambda data: fusion.fusion_error(data.metrics, cameras(data.run)),
        "Root mean square error against ground truth, of each camera's raw angles and of the fused state.",
    ),
    FigureKind(
        "joint_angles",
        (),
        "all joints of the person over time",
        "fusion",
        ("ticks",),
        lambda data: fusion.joint_angles(data.run, data.t0_ns, data.gap_s),
        "All joints of the human model: the cameras' raw values (dots) and the fused state (line).",
        each=True,
    ),
    FigureKind(
        "data_quality",
        (),
        "times at which each camera saw the person",
        "data",
        ("measurements",),
        lambda data: fusion.data_quality(data.run, data.t0_ns, data.gap_s),
        "Times at which each camera's frames contain the person (pale), at which the filter used them (solid), and at "
        "which it had none.",
        each=True,
    ),
)


def label(kind: FigureKind) -> str:
    """Key for users: its number, or its name if it is not in the paper."""
    return ", ".join(kind.numbers) or kind.name


def find(key: str) -> tuple[FigureKind, ...]:
    """Finds the figures with a number or a name; ``13`` means 13a and 13b. Empty if there is none."""
    wanted = re.sub(r"^fig\.?\s*", "", key.strip().lower())
    found = [kind for kind in FIGURES if wanted in (*kind.numbers, kind.name) or key == kind.name]
    return tuple(found or (kind for kind in FIGURES if wanted and wanted in [n.rstrip("ab") for n in kind.numbers]))


def missing(kind: FigureKind, run: Run, metrics: Mapping[str, Metric]) -> str:
    """Returns the data that a run lacks for a figure, in words; empty if it has all."""
    return next((why for there, why in map(NEEDS.__getitem__, kind.needs) if not there(run, metrics)), "")


def select_figures(run: Run, metrics: Mapping[str, Metric]) -> tuple[FigureKind, ...]:
    """Returns the figures for which a run has all data."""
    return tuple(kind for kind in FIGURES if not missing(kind, run, metrics))


def file_name(kind: FigureKind, number: int) -> str:
    """Returns the name of the files of a figure of a person, without suffix."""
    return kind.name if number == 1 else f"{kind.name}_person_{number}"


def draw_all(
    data: FigureData,
    folder: Path,
    kinds: Sequence[FigureKind] | None = None,
    number: int = 1,
    *,
    pdf: bool = False,
) -> tuple[str, ...]:
    """Draws figures into ``folder`` as ``<name>.png`` and ``<name>.svg``, and ``<name>.pdf`` if asked to.

    Args:
        data: Input of the figures.
        folder: Folder for the files; created if needed.
        kinds: Figures to draw; None: all for which the run has the data. A figure without its computed data is left
            out.
        number: The person of ``data``.
        pdf: True: also as PDF.

    Returns:
        The names drawn.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = []
    for kind in select_figures(data.run, data.metrics) if kinds is None else kinds:
        if kind.predicted and not getattr(data, kind.predicted):
            continue
        with drawing.style(column=True):
            drawing.save(kind.draw(data), folder, file_name(kind, number), drawing.COLUMN_DPI, pdf=pdf)
        release_freed_memory()
        names.append(file_name(kind, number))
    return tuple(names)


def _stop_s(run: Run) -> float:
    return float(setting(run.meta["settings"], "prediction", "stop_s"))
