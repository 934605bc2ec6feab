"""Selects the figures that the data of a run allow, and draws them into its folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from hrcreplay.records import Ints
from hrcreplay.report import drawing, figures_human, figures_robot
from hrcreplay.report.figures_human import Instant
from hrcreplay.report.figures_robot import LinkPose
from hrcreplay.report.metrics import Metric, columns, times
from hrcreplay.report.metrics_data import cameras
from hrcreplay.store.run_folder import Run


def start_ns(run: Run) -> int:
    """The instant that the report's clock counts from: the first tick, else the first frame [ns]."""
    if run.state is not None and len(run.state):
        return int(times(run.state)[0])
    if run.motion is not None and len(run.motion):
        return int(times(run.motion)[0])
    if run.measurements is not None and len(run.measurements):
        return int(times(run.measurements, "capture_ns").min())
    return 0


def instants(run: Run, count: int = 4, step_s: float = 1.0) -> Ints:
    """(count,) ticks for Fig. 17, ``step_s`` apart, that end one step after the nearest or liveliest moment [ns].

    The moment is the smallest separation of the plan or, without a plan, the fastest arm. Empty where the person is
    not known at that many ticks.
    """
    none = np.zeros(0, dtype=np.int64)
    if run.state is None:
        return none
    p = columns(run.state)
    known_ns = times(run.state)[np.isfinite(p).all(axis=1)]
    if len(known_ns) < 2:
        return none
    if run.motion is not None and run.motion["distance_m"].notna().any():
        moment_ns = int(times(run.motion)[int(np.nanargmin(run.motion["distance_m"].to_numpy(dtype=float)))])
    else:
        speed = np.abs(columns(run.state, "_vel")[:, 4:]).sum(axis=1)
        moment_ns = int(times(run.state)[int(np.argmax(np.where(np.isfinite(speed), speed, -1.0)))])
    step_ns = round(step_s * 1e9)
    first_ns = max(moment_ns - (count - 2) * step_ns, int(known_ns[0]))
    wanted_ns = first_ns + step_ns * np.arange(count)
    nearest = np.clip(np.searchsorted(known_ns, wanted_ns), 0, len(known_ns) - 1)
    found = known_ns[nearest]
    return found if len(np.unique(found)) == count else none


def nearest_tick(motion: pd.DataFrame) -> int:
    """Row of the smallest separation of a plan; the first where none is known."""
    distance_m = motion["distance_m"].to_numpy(dtype=float)
    return int(np.argmin(np.where(np.isnan(distance_m), np.inf, distance_m)))


def draw_all(
    run: Run,
    folder: Path,
    metrics: Mapping[str, Metric],
    *,
    near_m: float,
    stationary_m_per_s: float,
    gap_s: float = 0.2,
    volumes: Sequence[Instant] = (),
    robot: LinkPose | None = None,
) -> tuple[str, ...]:
    """Draws what the run has data for into ``folder`` as ``<name>.png`` and ``<name>.svg``.

    Args:
        run: The run's tables.
        folder: Made if need be.
        metrics: What :func:`hrcreplay.run.report.compute` found.
        near_m: The stationary share counts ticks with a separation of at most this [m].
        stationary_m_per_s: A TCP slower than this stands [m/s].
        gap_s: A camera silent for longer has a gap [s].
        volumes: The swept volumes by several methods at the ticks that :func:`instants` names.
        robot: The capsules of the robot's links at the tick that :func:`nearest_tick` names.

    Returns:
        The names drawn.
    """
    folder.mkdir(parents=True, exist_ok=True)
    t0_ns = start_ns(run)
    makers = _of_robot(run, metrics, t0_ns, near_m, stationary_m_per_s, robot)
    makers |= _of_human(run, metrics, t0_ns, gap_s, volumes)
    for name, make in makers.items():
        with drawing.style():
            drawing.save(make(), folder, name)
    return tuple(makers)


def _of_robot(
    run: Run,
    metrics: Mapping[str, Metric],
    t0_ns: int,
    near_m: float,
    stationary_m_per_s: float,
    robot: LinkPose | None,
) -> dict[str, Callable[[], Figure]]:
    """The figures of the plan and of the robot by their names; the arguments are those of ``draw_all``."""
    makers: dict[str, Callable[[], Figure]] = {}
    if run.motion is not None and len(run.motion) > 1:
        plan = run.motion
        if metrics["plan_deviation_max_m"]["value"] is not None:
            makers["fig13_path"] = lambda: figures_robot.path(plan, run.occupancy, t0_ns, run.T_world_base)
        makers["fig14_speed"] = lambda: figures_robot.speed(plan, t0_ns, near_m)
        makers["status"] = lambda: figures_robot.status(
            plan,
            run.baselines,
            method=str(metrics["plan_method"]["value"]),
            t0_ns=t0_ns,
            near_m=near_m,
            slow_m_per_s=stationary_m_per_s,
        )
        makers["stationary_share"] = lambda: figures_robot.stationary_share(metrics)
    if robot is not None and run.T_world_base is not None:
        pose, base = robot, run.T_world_base
        makers["robot_links"] = lambda: figures_robot.links(pose, t0_ns, base)
    return makers


def _of_human(
    run: Run, metrics: Mapping[str, Metric], t0_ns: int, gap_s: float, volumes: Sequence[Instant]
) -> dict[str, Callable[[], Figure]]:
    """The figures of the person by their names; the arguments are those of ``draw_all``."""
    makers: dict[str, Callable[[], Figure]] = {}
    state = run.state
    if state is not None and volumes:
        fused = state
        makers["fig17_volumes"] = lambda: figures_human.volumes(volumes, fused, t0_ns)
    if run.measurements is not None and len(run.measurements):
        makers["fig18_coordinate"] = lambda: figures_human.coordinate(run, t0_ns, gap_s)
        makers["data_quality"] = lambda: figures_human.data_quality(run, t0_ns, gap_s)
    if state is not None and len(state) > 1:
        makers["joint_angles"] = lambda: figures_human.joint_angles(run, t0_ns, gap_s)
    if metrics["fusion_angle_rmse"]["value"] is not None:
        makers["fusion_error"] = lambda: figures_human.fusion_error(metrics, cameras(run))
    return makers


#: Method -> colour, and (occupancy, horizon) -> marker.
_COLOURS = {
    "qp": drawing.BLUE,
    "scaling": drawing.ORANGE,
    "shield": drawing.GREEN,
    "ssm": drawing.PURPLE,
    "none": drawing.VERMILLION,
}
_MARKERS = {"sound": "o", "paper": "s", "positions": "D"}


def methods(found: Mapping[str, Any]) -> Figure:
    """Safety against productivity: the smallest distance while moving over the pace kept, a point a method.

    Args:
        found: The content of compare.json.
    """
    figure = drawing.new_figure(3.7)
    ((ax,),) = drawing.panels(figure, 1, bottom_in=0.5, top_in=0.3, right_in=2.7)
    several = len(found["logs"]) > 1
    for label, row in found["total"].items():
        of, alone = found["methods"][label], log_rows(found, label) if several else []
        colour, marker = _COLOURS[of["method"]], _MARKERS.get(of.get("occupancy", ""), "X")
        for other in alone:
            ax.plot(*_place(other), ".", ms=5, color=colour, alpha=0.45)
        if row["pace"] is None or row["nearest_moving_m"] is None:
            continue
        words = label.replace(":", ", ")
        if row["touch_ticks"]:
            words += f": {row['touch_ticks']:,} ticks in contact,\nup to {row['touch_speed_m_per_s']:.2f} m/s"
        face = "white" if of.get("horizon") == "fixed" else colour
        ax.plot(
            *_place(row), marker, ms=8, mfc=face, mec=colour, mew=1.6, alpha=0.9, zorder=3, label=words, clip_on=False
        )
    ax.set_yscale("symlog", linthresh=20.0, linscale=1.5)
    ticks = [-100, -50, -20, -10, 0, 10, 20, 50, 100, 200, 500]
    low, high = min(ax.get_ylim()[0], -12.0), max(ax.get_ylim()[1], 25.0)
    ax.set_yticks([tick for tick in ticks if low <= tick <= high])
    ax.yaxis.set_major_formatter("{x:.0f}")
    ax.minorticks_off()
    ax.set_ylim(low, high)
    ax.set_xlim(0.0, 103.0)
    ax.axhspan(low, 0.0, color=drawing.VERMILLION, alpha=0.08, lw=0)
    ax.text(1.5, 0.97 * low, "in contact while moving", va="bottom", ha="left", color=drawing.VERMILLION, fontsize=8.0)
    ax.legend(loc="upper left", bbox_to_anchor=(1.03, 1.0), labelspacing=0.9)
    ax.set_xlabel("pace kept, of the programmed [%]")
    ax.set_ylabel("nearest to the person while moving [cm]")
    what = f"; {len(found['logs'])} logs, small dots: each" if several else ""
    ax.set_title(f"Safety and pace by method (hollow: fixed horizon{what})")
    return figure


def log_rows(found: Mapping[str, Any], label: str) -> list[Mapping[str, Any]]:
    """The figures of a method on each log that can be placed."""
    rows = [log["methods"][label] for log in found["logs"]]
    return [row for row in rows if row["pace"] is not None and row["nearest_moving_m"] is not None]


def _place(row: Mapping[str, Any]) -> tuple[float, float]:
    """Pace [%] and smallest distance [cm]."""
    return 100.0 * row["pace"], 100.0 * row["nearest_moving_m"]
