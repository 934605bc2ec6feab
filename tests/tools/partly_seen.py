"""How large the volumes are of people who are partly out of sight, and how often they hold them.

    python -m tests.tools.partly_seen [--json] [NAME...]

All points of a recording but elbows and wrists, or a wrist with its hand, go out of sight for the second half of every
three seconds. Against what was recorded without that, shortly after it and once the filter has forgotten the torso, or
the forearm: the share of ticks in which every recorded limb stayed whole in its volume until the braking time, and the
mean volume of the union beside that of the same ticks with everything in sight. And, of arms alone, the last volume
that there would be, were the points that are seen known to go no further than limbs of people seen whole depart: at
``SLOWLY`` of people's speeds.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np

from hrcreplay.commands import replay
from hrcreplay.evaluation.containment import body_radii_m, check_containment, recorded_future
from hrcreplay.evaluation.recording import Recording, read_recording
from hrcreplay.human.prediction import shown_points
from hrcreplay.human.prediction.velocity_tube import PEOPLES_SPEEDS
from hrcreplay.logs.reader import Log, open_log
from hrcreplay.logs.writer import LogWriter
from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.run_config import RunConfig, RunOptions, resolve
from hrcreplay.pipeline.stages import span_ns, tick_times
from hrcreplay.pipeline.surroundings import PredictionStage
from hrcreplay.records import BODY, POINTS, HumanStates, Ints
from tests.tools import bases
from tests.tools.readme.measurements import PARTLY_SEEN_OF, SLOWLY

_ARMS = [f"{point}_{side}" for point in ("elbow", "wrist") for side in "rl"]
_FOREARM = ["wrist_r", "hand_r"]
#: What is left of a person -> the points that go out of sight, and the limb that the filter forgets with them.
CASES = {
    "arms": (tuple(name for name in POINTS if name not in _ARMS), "THX"),
    "all but a forearm": (tuple(_FOREARM), "LRA"),
}
_EVERY_S, _HIDDEN_S, _SECONDS = 3.0, 1.5, 20.0
#: How long that limb has been out of sight: at least this long [s]; then until the filter forgets it, and longer.
FRESH_S = 0.1
WHEN, WHAT = ("just", "long"), ("partly", "whole")
#: Every so many ticks one is looked at.
_STEP = 6


def hide(log: Log, path: Path, points_hidden: Sequence[str]) -> Path:
    """Writes the log with some of POINTS out of sight in the last part of every period."""
    hidden = [POINTS.index(name) for name in points_hidden]
    with LogWriter(path) as writer:
        for name in log.header.cameras:
            writer.camera(name, log.header.T_world_camera.get(name, np.eye(4)))
        for frames in log.frames():
            points, confidence = frames.points_m.copy(), frames.confidence.copy()
            at_s = (frames.capture_ns - log.header.start_ns) * 1e-9 % _EVERY_S
            rows = np.flatnonzero(at_s >= _EVERY_S - _HIDDEN_S)[:, None]
            points[rows, hidden], confidence[rows, hidden] = np.nan, 0.0
            writer.frames(replace(frames, points_m=points, confidence=confidence))
    return path


def read(log: Log, run_config: RunConfig, ticks_ns: Ints) -> Recording:
    """Reads a recording at some ticks."""
    return read_recording(log, ticks_ns, assembly.fusion_stage(run_config, log), lambda _: None)


def measure(name: str, tmp: Path) -> dict[str, float]:
    """Share held and volumes [m^3] of one recording."""
    path, options = replay.demo_log(), RunOptions(end_s=_SECONDS)
    if name != "demo":
        path, cell, config = bases.recorded(name, tmp)
        options = RunOptions(cell_file=cell, config=config, end_s=_SECONDS)
    run_config = resolve("audit", path, **options)
    stage, settings = assembly.prediction_stage(run_config), run_config.settings
    log = open_log(run_config.log, settings.logs)
    ticks_ns = tick_times(*span_ns(run_config, log), settings.fusion.rate_hz)
    found: dict[str, float] = {}
    whole = read(log, run_config, ticks_ns)
    for case, (hidden, limb) in CASES.items():
        partly_log = open_log(hide(log, tmp / f"{case}.mcap", hidden), settings.logs)
        partly = read(partly_log, run_config, ticks_ns).states
        compared = compare(stage, whole, partly, BODY.index(limb))
        found |= {f"{case} {key}": value for key, value in compared.items()}
    return found


def compare(stage: PredictionStage, whole: Recording, partly: HumanStates, limb: int) -> dict[str, float]:
    """Volumes of somebody partly out of sight beside those of everything in sight, and how often they hold.

    Args:
        stage: Of the volumes.
        whole: The recording.
        partly: The same person with points hidden.
        limb: Index into BODY: the ticks are those in which this one is out of sight.
    """
    unseen_s, in_sight = partly.unseen_s[:, limb], whole.states.unseen_s[:, limb] < FRESH_S
    compared = in_sight & np.isfinite(whole.states.p[:, 0])
    compared &= whole.states.t_ns + round(stage.horizon_s * 1e9) <= whole.t_ns[-1]
    found: dict[str, float] = {}
    for when, least_s, most_s in ((WHEN[0], FRESH_S, stage.memory_s), (WHEN[1], stage.memory_s, np.inf)):
        ticks = np.flatnonzero(compared & (unseen_s > least_s) & (unseen_s <= most_s))[::_STEP]
        found[f"{when}_ticks"] = len(ticks)
        for what, states in zip(WHAT, (partly, whole.states), strict=True):
            held, union_m3, median_m3 = judge(stage, whole, states.rows(ticks))
            each = {"held": held, "m3": union_m3, "median_m3": median_m3}
            found |= {f"{when}_{what}_{key}": value for key, value in each.items()}
    with mock.patch.object(shown_points, "PEOPLES_SPEEDS", SLOWLY * PEOPLES_SPEEDS):
        found[f"{WHEN[1]}_slow_m3"] = judge(stage, whole, partly.rows(ticks))[1]
    return found


def judge(stage: PredictionStage, whole: Recording, states: HumanStates) -> tuple[float, float, float]:
    """Share of ticks with every recorded limb in its volume until the braking time; mean and median union [m^3]."""
    future = recorded_future(whole.t_ns, whole.points_m, states, stage.horizon_s)
    every = np.ones(len(states), dtype=np.bool_)
    outcome = check_containment(stage.volumes(states), future, body_radii_m(stage), every, sizes=False)
    worst_m = outcome.worst_m()
    union_m3 = outcome.union_m3[np.isfinite(outcome.union_m3)]
    return float((worst_m[np.isfinite(worst_m)] <= 0.0).mean()), float(union_m3.mean()), float(np.median(union_m3))


def told(name: str, found: dict[str, float]) -> str:
    """The lines of one recording."""
    lines = []
    for case in CASES:
        each = [
            f"{when}: "
            + ", ".join(
                f"{w} {found[f'{case} {when}_{w}_held']:.1%}, {found[f'{case} {when}_{w}_m3']:.1f} m3" for w in WHAT
            )
            for when in WHEN
        ]
        lines.append(f"{name}, {case} | {' | '.join(each)} | slow: {found[f'{case} {WHEN[1]}_slow_m3']:.1f} m3")
    return "\n".join(lines)


def parser() -> argparse.ArgumentParser:
    """The arguments."""
    return bases.parser("partly_seen", __doc__)


def main() -> None:
    """Runs the recordings."""
    given, found = parser().parse_args(), {}
    for name in given.names or PARTLY_SEEN_OF:
        with tempfile.TemporaryDirectory() as tmp:
            found[name] = measure(name, Path(tmp))
        if not given.json:
            print(told(name, found[name]), flush=True)  # noqa: T201
    if given.json:
        print(json.dumps(found))  # noqa: T201


if __name__ == "__main__":
    main()
