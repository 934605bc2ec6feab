"""Data of a run's figures on its prediction and its robot, from the run folder alone.

Corrected equations: docs/paper.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from hrcreplay.geometry.inflated_hull import InflatedHull
from hrcreplay.human.model import skeleton
from hrcreplay.human.prediction.sweep import TRIANGLE_RAD
from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.run_config import RunConfig
from hrcreplay.records import FLOOR_Z_M, JOINTS, LIMBS, POINTS, Floats, HumanStates, Ints, SweptVolumes, of_person
from hrcreplay.reporting.figures import planning, prediction
from hrcreplay.reporting.figures.prediction import Growth, Instant, Sweep, Walk
from hrcreplay.reporting.figures.scene import LinkPose, Storyboard, StoryScene
from hrcreplay.reporting.metrics.people import named_volumes
from hrcreplay.reporting.metrics.planning import numeric_column, position_columns
from hrcreplay.reporting.metrics.series import find_known_ticks, instants, moment_ns, nearest_tick, times
from hrcreplay.store.columns import read_states_at
from hrcreplay.store.run_folder import Run
from hrcreplay.store.stored_table import RunTable

#: Programmed time between the pictures of the storyboard [s], and their number.
_STORY_STEP_S, _STORY_COUNT = 0.8, 4
#: Minimum deviation for a storyboard [m].
_STORY_M = 0.01
#: Horizons at which volumes are compared.
_HORIZONS = 7
X, Y, THETA = (JOINTS.index(name) for name in ("x", "y", "theta"))


def compute_fields(run_config: RunConfig, run: Run, number: int, fields: Iterable[str]) -> dict[str, Any]:
    """Computes the fields of ``FigureData`` that are not in the tables; None or empty if the run lacks the data.

    Args:
        run_config: Configuration of the run.
        run: Its tables, with all people.
        number: The person of the figures that show one.
        fields: Names of the fields.
    """
    wanted, one = [name for name in dict.fromkeys(fields) if name], run.of_person(number)
    people = _states(run_config, one, wanted) if wanted else None
    if people is None:
        return {}
    own = people.of_person(number)
    return {
        name: _OF_ALL[name](run_config, run, people) if name in _OF_ALL else _OF_ONE[name](run_config, one, own)
        for name in wanted
    }


def volumes_by_method(run_config: RunConfig, run: Run, people: HumanStates) -> list[Instant]:
    """Computes the swept volumes by the paper's two methods and the run's own at the instants of Fig. 17."""
    wanted_ns = instants(run)
    if not len(wanted_ns):
        return []
    stage, states = assembly.prediction_stage(run_config), _at(people, wanted_ns)
    methods = dict.fromkeys(("paper", "positions", stage.method))
    by_method = {method: stage.volumes(states, method=method) for method in methods}
    return [
        (int(t), {method: volumes.at(row) for method, volumes in by_method.items()})
        for row, t in enumerate(states.t_ns)
    ]


def fastest_walk(run_config: RunConfig, run: Run, people: HumanStates) -> Walk | None:
    """Computes the reachable area from the tick of the fastest walking, Eq. (18)-(30), corrected, and by ``sound``."""
    t_ns = _fastest_ns(run, run_config.settings.prediction.stop_s)
    if run.state is None or t_ns is None:
        return None
    stage, states = assembly.prediction_stage(run_config), _at(people, t_ns)
    reach, p, v = stage.by("paper").reachable(states), states.p[0], states.v[0]
    ahead = float(np.cos(p[THETA]) * v[X] + np.sin(p[THETA]) * v[Y])  # Eq. (33)
    fastest = min(ahead + float(stage.limits.a_max[X]) * stage.horizon_s, float(stage.limits.v_max[X]))  # Eq. (18)
    legs = stage.settings.model_copy(update={"method": "sound", "legs": True})
    sound = type(stage)(stage.limits, legs, stage.memory_s).volumes(states)
    floor = sound.vertices(0, sound.limbs.index("LEGS"))[:, :2]
    later = (times(run.state) >= t_ns) & (times(run.state) <= t_ns + round(stage.horizon_s * 1e9))
    return Walk(
        t_ns=t_ns,
        horizon_s=stage.horizon_s,
        place_m=p[[X, Y]],
        heading_rad=float(p[THETA]),
        radius_m=max(0.0, fastest) * stage.horizon_s,
        turn_rad=(float(reach.low[0, THETA] - p[THETA]), float(reach.high[0, THETA] - p[THETA])),
        box_m=np.array([reach.low[0, [X, Y]], reach.high[0, [X, Y]]]),
        polygon_m=prediction.hull_of(floor),
        walked_m=run.state[later][["x", "y"]].to_numpy(dtype=float),
    )


def forearm_sweep(run_config: RunConfig, run: Run, people: HumanStates) -> Sweep | None:
    """Sweeps the forearm nearest to the robot, or the right one, by elbow and walking, Alg. 2 and Fig. 7, 8."""
    moment = moment_ns(run)
    if moment is None:
        return None
    limb = "LRA"
    if run.motion is not None and run.motion["limb"].iloc[nearest_tick(run.motion)] in ("LLA", "ULA"):
        limb = "LLA"
    side = limb[1].lower()
    stage, states = assembly.prediction_stage(run_config), _at(people, moment)
    reach, p = stage.by("paper").reachable(states), states.p[0]
    joint = JOINTS.index(f"a{side}4")
    low, high = float(reach.low[0, joint]), float(reach.high[0, joint])
    pieces = max(1, int(np.ceil((high - low) / TRIANGLE_RAD)))
    middles = low + (np.arange(pieces) + 0.5) * (high - low) / pieces
    angles = np.concatenate([np.linspace(low, high, 20 * pieces + 1), middles, p[[joint]]])
    postures = np.tile(p, (len(angles), 1))
    postures[:, joint] = angles
    points = skeleton(postures, np.tile(states.lengths_m, (len(angles), 1)))
    elbow, wrist = (points[:, POINTS.index(f"{name}_{side}")] for name in ("elbow", "wrist"))
    if not np.isfinite(wrist).all():  # an unmeasured length
        return None
    apexes = elbow[0] + (wrist[-1 - pieces : -1] - elbow[0]) / np.cos(0.5 * (high - low) / pieces)
    return Sweep(
        t_ns=moment,
        limb=limb,
        elbow_m=elbow[0],
        wrist_m=wrist[-1],
        arc_m=wrist[: -1 - pieces],
        apexes_m=apexes,
        box_m=np.array([reach.low[0, [X, Y]], reach.high[0, [X, Y]]]) - p[[X, Y]],
    )


def volume_growth(run_config: RunConfig, run: Run, people: HumanStates) -> Growth | None:
    """Computes the six limbs' volumes at one instant, for horizons up to the braking time, by each method."""
    moment = moment_ns(run)
    if moment is None:
        return None
    stage, states = assembly.prediction_stage(run_config), _at(people, moment)
    horizons_s = stage.horizon_s * np.arange(_HORIZONS) / (_HORIZONS - 1)
    methods = dict.fromkeys((stage.method, "paper", "positions"))
    found = {
        method: np.array(
            [_sum_m3(stage.volumes(states, horizon_s, method=method)) for horizon_s in horizons_s.tolist()]
        )
        for method in methods
    }
    return Growth(moment, horizons_s, found)


def _sum_m3(volumes: SweptVolumes) -> float:
    hulls = volumes.at(0)
    if not all(np.isfinite(hulls[limb][0]).all() for limb in LIMBS):
        return float("nan")
    return sum(InflatedHull.around(*hulls[limb]).volume_above_m3(FLOOR_Z_M) for limb in LIMBS)


def story(run_config: RunConfig, run: Run, _people: HumanStates) -> Storyboard | None:
    """Returns the part of the programme around the largest deviation, or else the nearest tick."""
    motion, alone, occupancy = run.motion, run.baselines.get("none"), named_volumes(run.occupancy)
    if motion is None or alone is None or occupancy is None or run.state is None or run.T_world_base is None:
        return None
    robot = assembly.robot(run_config, run.T_world_base)
    worst = planning.largest_deviation(motion)
    row = worst.row if worst.length_m >= _STORY_M else nearest_tick(motion)
    passed = [numeric_column(table, "programme_s") for table in (alone, motion)]
    first, last = max(s[0] for s in passed), min(s[-1] for s in passed)
    step = min(_STORY_STEP_S, (last - first) / _STORY_COUNT)
    start = float(np.clip(passed[1][row] - 2 * step, first, last - (_STORY_COUNT - 1) * step))
    scenes = []
    for programme_s in (start + step * np.arange(_STORY_COUNT)).tolist():
        rows = [int(np.argmax(s >= programme_s)) for s in passed]
        begin = [int(np.argmax(s >= max(first, start - step))) for s in passed]
        at = [int(times(table)[i]) for table, i in zip((alone, motion), rows, strict=True)]
        stored, limbs = prediction.stored_at(occupancy, at[1])
        fresh = abs(at[1] - int(times(stored)[0])) * 1e-9 <= prediction.STALE_S
        ends = [robot.ends_m(_joints(table, i, robot.nv)) for table, i in zip((alone, motion), rows, strict=True)]
        ways = [
            position_columns(table.iloc[b : i + 1], "tcp")
            for table, b, i in zip((alone, motion), begin, rows, strict=True)
        ]
        people_m = prediction.skeletons_at(run.states(), at[1])
        scenes.append(
            StoryScene(
                programme_s, (at[0], at[1]), (ends[0], ends[1]), (ways[0], ways[1]), people_m, limbs if fresh else {}
            )
        )
    if not any(scene.volumes for scene in scenes):
        return None
    shown = (passed[0] >= start - step) & (passed[0] <= start + _STORY_COUNT * step)
    return Storyboard(
        scenes=scenes,
        radius_m=np.array([segment.radius_m for segment in robot.segments]),
        base_m=run.T_world_base[:3, 3],
        reference_m=position_columns(alone[shown], "ref"),
        method=run_config.settings.plan.method,
        objects=assembly.bounded_hulls(run_config, robot),
    )


def nearest_pose(run_config: RunConfig, run: Run, people: HumanStates) -> LinkPose | None:
    """Returns the robot's capsules and the swept volumes at the tick of the smallest separation."""
    if run.motion is None or not len(run.motion) or run.T_world_base is None:
        return None
    robot = assembly.robot(run_config, run.T_world_base)
    at = nearest_tick(run.motion)
    row, q = run.motion.iloc[at], _joints(run.motion, at, robot.nv)
    if not np.isfinite(q).all():
        return None
    states = _at(people, int(row["t_ns"]))
    horizon_s = float(row["horizon_s"]) if "horizon_s" in row else None
    stage = assembly.prediction_stage(run_config)
    hulls = {
        of_person(limb, number): volume
        for number in np.unique(states.numbers).tolist()
        for limb, volume in stage.volumes(states.of_person(number), horizon_s).at(0).items()
    }
    return LinkPose(
        t_ns=int(row["t_ns"]),
        distance_m=float(row["distance_m"]),
        bodies=tuple(segment.body for segment in robot.segments),
        ends_m=robot.ends_m(q),
        radius_m=np.array([segment.radius_m for segment in robot.segments]),
        volumes={limb: volume for limb, volume in hulls.items() if volume.known},
        objects=assembly.bounded_hulls(run_config, robot),
    )


_Field = Callable[[RunConfig, Run, HumanStates], Any]
_OF_ONE: dict[str, _Field] = {
    "instants": volumes_by_method,
    "walk": fastest_walk,
    "sweep": forearm_sweep,
    "growth": volume_growth,
}
_OF_ALL: dict[str, _Field] = {"story": story, "pose": nearest_pose}


def _joints(motion: RunTable, row: int, axes: int) -> Floats:
    return motion.iloc[row][[f"q{axis}" for axis in range(1, axes + 1)]].to_numpy(dtype=float)


def _fastest_ns(run: Run, span_s: float) -> int | None:
    """Finds the tick [ns] from which the fused person walks furthest within ``span_s`` [s]; else the last known."""
    known_ns = find_known_ticks(run)
    if run.state is None or not len(known_ns):
        return None
    span_ns = round(span_s * 1e9)
    later = np.searchsorted(known_ns, known_ns + span_ns, side="right") - 1
    squares = np.zeros(len(known_ns))
    for axis in "xy":
        place = numeric_column(run.state, axis)[run.known]
        squares += (place[later] - place) ** 2
    whole = known_ns[later] - known_ns >= 0.9 * span_ns
    return int(known_ns[int(np.argmax(np.where(whole, np.sqrt(squares), -1.0)))])


def _states(run_config: RunConfig, run: Run, fields: Sequence[str]) -> HumanStates | None:
    """Reads the fused people at all ticks that some fields of one of them need, once; None without a person."""
    if run.state is None:
        return None
    wanted_ns: list[int | None] = instants(run).tolist() if "instants" in fields else []
    if "sweep" in fields or "growth" in fields:
        wanted_ns.append(moment_ns(run))
    if "walk" in fields:
        wanted_ns.append(_fastest_ns(run, run_config.settings.prediction.stop_s))
    if "pose" in fields and run.motion is not None and len(run.motion):
        wanted_ns.append(int(times(run.motion)[nearest_tick(run.motion)]))
    known_ns = np.array([t for t in wanted_ns if t is not None], dtype=np.int64)
    return read_states_at(run.folder / "state.parquet", known_ns)


def _at(people: HumanStates, wanted_ns: Ints | int) -> HumanStates:
    return people.rows(np.isin(people.t_ns, wanted_ns))
