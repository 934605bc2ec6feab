"""The pace of a controller that knows the recorded future, beside that of qp: what better prediction could gain.

    python -m tests.tools.oracle [--seconds 20] [--json] [NAME...]

The controller is qp with another prediction: the volume of a limb is the hull of its recorded points until the end of
the horizon, with the limb's own thickness and the length of a hand, and nothing for what might have happened instead.
No real controller can have these volumes. A limb that was not recorded around a tick keeps its predicted volume. In the
demo the robot stands where it stood; with other recordings 1.15 m before the hands (``tests.tools.bases``). Prints a
line for each recording: pace, and standing of the ticks within half a metre of the volumes of qp, by both.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from unittest import mock

import numpy as np
import pandas as pd

from hrcreplay.commands import replay
from hrcreplay.evaluation.containment import body_radii_m
from hrcreplay.evaluation.recorded_person import LIMB_POINTS
from hrcreplay.evaluation.recording import read_recordings
from hrcreplay.human.prediction.swept_volumes import Predictor, PreparedPerson
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.run_config import RunConfig, RunOptions, resolve
from hrcreplay.pipeline.stages import span_ns, tick_times
from hrcreplay.pipeline.surroundings import PredictionStage
from hrcreplay.records import POINTS, Floats, HumanStates, Ints, SweptVolumes
from hrcreplay.store import run_folder
from hrcreplay.store.columns import read_states
from tests.reporting.synthetic import frame_of
from tests.test_recordings import TASK
from tests.tools import bases
from tests.tools.readme.measurements import ORACLED

#: From the hands to the robot's base [m].
AWAY_M = 1.15
#: Time before and after a span whose recorded points also count: more than a frame of any camera [s].
MARGIN_S = 0.04
#: Ticks within this distance of the volumes are near people [m]; a slower tool stands [m/s].
NEAR_M, STANDS_M_PER_S = 0.5, 1e-3
TICK_S = 0.004
WHO = ("qp", "oracle")


@dataclass(frozen=True)
class Recorded:
    """What was recorded of a person."""

    t_ns: Ints  #: (m,) increasing
    limbs: dict[str, Floats]  #: limb -> (m, k, 3) points whose hull is the limb before its ball [m]

    @classmethod
    def of(cls, t_ns: Ints, points_m: Floats, hand_m: float) -> Recorded:
        """From POINTS (m, 20, 3), with the hands along the forearms; the neck is between the shoulders [m]."""
        points = points_m.copy()
        right, left = (POINTS.index(f"shoulder_{side}") for side in "rl")
        points[:, POINTS.index("neck")] = 0.5 * (points[:, right] + points[:, left])
        limbs = {limb: points[:, [POINTS.index(name) for name in names]] for limb, names in LIMB_POINTS.items()}
        for limb in ("LRA", "LLA"):
            elbow, wrist = limbs[limb][:, :1], limbs[limb][:, 1:2]
            along = (wrist - elbow) / np.linalg.norm(wrist - elbow, axis=2, keepdims=True)
            limbs[limb] = np.concatenate([limbs[limb], wrist + hand_m * along], axis=1)
        pelvis = points[:, [POINTS.index("pelvis")]]
        limbs["LEGS"] = np.concatenate([pelvis, limbs["LEGS"]], axis=1)
        return cls(t_ns, limbs)

    def within(self, limb: str, first_ns: int, last_ns: int) -> Floats:
        """(n, 3) points of a limb from an instant to another; none if one of its ends is missing [m]."""
        rows = slice(*np.searchsorted(self.t_ns, [first_ns, last_ns + 1]).tolist())
        points = self.limbs[limb][rows]
        known = np.asarray(np.isfinite(points).all(axis=2))
        ends = known if limb == "LEGS" else known[:, :2]
        return points[known] if ends.any(axis=0).all() else np.empty((0, 3))


@dataclass(frozen=True)
class Oracle:
    """A predictor that knows what was recorded."""

    plain: Predictor
    people: dict[int, Recorded]
    radii_m: dict[str, float]

    def prepare(self, states: HumanStates) -> Foreseen:
        """People with their volumes for any horizon."""
        return Foreseen(self, self.plain.prepare(states), states)


@dataclass(frozen=True)
class Foreseen:
    """The person of some ticks; takes the place of ``PreparedPerson``."""

    oracle: Oracle
    predicted: PreparedPerson
    states: HumanStates
    held: None = None  #: no kernel can predict these volumes, so none decides whole ticks

    def volumes(self, horizon_s: float, first: int = 0, last: int | None = None) -> SweptVolumes:
        """The recorded limbs of the ticks ``first`` to ``last`` - 1 until ``horizon_s`` after them [s]."""
        last = len(self.states) if last is None else last
        found = self.predicted.volumes(horizon_s, first, last)
        parts, radius_m = np.split(found.vertices_m, found.offsets[1:-1]), found.radius_m.copy()
        latency_s = self.oracle.plain.prediction.latency_s
        for row, number in enumerate(self.states.numbers[first:last].tolist()):
            one, t_ns = self.oracle.people.get(number), int(found.t_ns[row])
            for k, limb in enumerate(found.limbs):
                span_ns = t_ns - round(MARGIN_S * 1e9), t_ns + round((horizon_s + latency_s + MARGIN_S) * 1e9)
                points = np.empty((0, 3)) if one is None else one.within(limb, *span_ns)
                if len(points):
                    parts[row * len(found.limbs) + k] = points
                    radius_m[row, k] = self.oracle.radii_m[limb]
        offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum([len(part) for part in parts])])
        return replace(found, offsets=offsets, vertices_m=np.concatenate(parts), radius_m=radius_m)


def knowing(run_config: RunConfig) -> PredictionStage:
    """The prediction stage of a run, with the recorded future in place of predictions."""
    log = open_log(run_config.log, run_config.settings.logs)
    ticks_ns = tick_times(*span_ns(run_config, log), run_config.settings.fusion.rate_hz)
    recorded = read_recordings(log, ticks_ns, assembly.fusion_stage(run_config, log), lambda _: None)
    stage = assembly.prediction_stage(run_config)
    hand_m = stage.settings.hand_m
    people = {number: Recorded.of(one.t_ns, one.points_m, hand_m) for number, one in recorded.items()}
    found = replace(stage)
    found.__dict__["predictor"] = Oracle(stage.predictor, people, body_radii_m(stage))
    return found


def before_hands(states: HumanStates) -> str:
    """``--base`` so far before the hands that they are within the robot's reach."""
    hands, front = bases.hands_and_front(states)
    x, y = hands[:2] + AWAY_M * front
    return f"{x:.3f},{y:.3f},{hands[2] - bases.BELOW_M:.3f},{np.degrees(np.arctan2(-front[1], -front[0])):.1f}"


def measure(name: str, seconds: float, tmp: Path) -> dict[str, float]:
    """Pace and standing by both, of one recording."""
    log, options = replay.demo_log(), RunOptions()
    overrides: tuple[str, ...] = ("plan.baselines=[]", "prediction.store_hz=1")
    if name != "demo":
        log, cell, config = bases.recorded(name, tmp)
        options = RunOptions(cell_file=cell, config=config, end_s=seconds)
        fused = replay.run("fuse", log, out=tmp / "fused", **options)
        states = HumanStates.join(list(read_states(fused / "state.parquet", 4096)))
        (tmp / "task.toml").write_text(TASK)
        options["cell_file"] = bases.with_base(cell, before_hands(states), tmp / "near.toml")
        overrides = (*overrides, f"plan.task={tmp / 'task.toml'}")
    options["overrides"] = overrides
    stage = knowing(resolve("plan", log, **options))
    qp = _motion(replay.run("plan", log, out=tmp / "qp", **options))
    with mock.patch.object(assembly, "prediction_stage", return_value=stage):
        oracle = _motion(replay.run("plan", log, out=tmp / "oracle", **options))
    near = qp["distance_m"].to_numpy(dtype=float) <= NEAR_M
    found: dict[str, float] = {"near_ticks": int(near.sum())}
    for who, motion in zip(WHO, (qp, oracle), strict=True):
        stands = motion["tcp_speed"].to_numpy(dtype=float)[near] < STANDS_M_PER_S
        found[f"{who}_pace"] = float(motion["programme_s"].iloc[-1]) / (TICK_S * len(motion))
        found[f"{who}_standing"] = float(stands.sum()) / max(1, len(stands))
    return found


def _motion(folder: Path) -> pd.DataFrame:
    motion = run_folder.read(folder).motion
    assert motion is not None
    return frame_of(motion)


def told(name: str, found: dict[str, float]) -> str:
    """The line of one recording."""
    parts = [f"{who}: pace {found[f'{who}_pace']:.1%}, standing {found[f'{who}_standing']:.1%}" for who in WHO]
    return f"{name} ({found['near_ticks']} near ticks) | {' | '.join(parts)}"


def parser() -> argparse.ArgumentParser:
    """The arguments."""
    given = bases.parser("oracle", __doc__)
    given.add_argument("--seconds", type=float, default=20.0)
    return given


def main() -> None:
    """Runs the recordings."""
    given, found = parser().parse_args(), {}
    for name in given.names or ORACLED:
        with tempfile.TemporaryDirectory() as tmp:
            found[name] = measure(name, given.seconds, Path(tmp))
        if not given.json:
            print(told(name, found[name]), flush=True)  # noqa: T201
    if given.json:
        print(json.dumps(found))  # noqa: T201


if __name__ == "__main__":
    main()
