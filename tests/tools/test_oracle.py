"""Volumes of the recorded future: they hold what was recorded until the horizon, and no more."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.geometry.inflated_hull import InflatedHull
from hrcreplay.human.model import skeleton
from hrcreplay.human.prediction.swept_volumes import Predictor
from hrcreplay.limits import load_limits
from hrcreplay.pipeline.run_config import RunOptions
from hrcreplay.records import BODY, POINTS, Floats, HumanStates
from hrcreplay.settings.sections import Prediction
from tests.human.people import LENGTHS_M, states
from tests.tools import oracle
from tests.tools.oracle import MARGIN_S, Oracle, Recorded

RATE_HZ, HORIZON_S = 100.0, 0.2
RADII_M = dict(zip(BODY, (0.12, 0.15, 0.07, 0.07, 0.07, 0.07, 0.08), strict=True))
SETTINGS = Prediction()


def walking() -> tuple[HumanStates, Floats]:
    """Somebody who walks at 1 m/s and swings the arms, as 100 frames, without legs."""
    t_s = np.arange(100) / RATE_HZ
    p = np.tile([0.0, 0, 0, 0, 0.2, 0.5, 0, 2, 0.2, 0.5, 0, 2, 0.9], (len(t_s), 1))
    p[:, 0] = t_s
    p[:, 4] += np.sin(6.0 * t_s)
    of = states(p, np.zeros_like(p))
    of = HumanStates(**{**vars(of), "t_ns": np.round(t_s * 1e9).astype(np.int64)})
    return of, skeleton(p, np.tile(LENGTHS_M, (len(p), 1)))


def foreseen(of: HumanStates, points: Floats) -> Oracle:
    recorded = Recorded.of(of.t_ns, points, SETTINGS.hand_m)
    return Oracle(Predictor(load_limits("people"), SETTINGS, 0.5), {1: recorded}, RADII_M)


def test_a_robot_that_knows_the_future_is_ahead_of_one_that_predicts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tool itself, on 2.5 s of the demo with its worker beside the robot."""
    monkeypatch.setattr(oracle, "RunOptions", partial(RunOptions, start_s=16.0, end_s=18.5))
    found = oracle.measure("demo", 2.0, tmp_path)
    assert found["near_ticks"] > 100
    assert found["oracle_pace"] > found["qp_pace"] + 0.05


@pytest.mark.parametrize("tick", [10, 40])
def test_whoever_does_what_was_recorded_stays_inside_and_what_comes_later_does_not(tick: int) -> None:
    of, points = walking()
    volumes = foreseen(of, points).prepare(of).volumes(HORIZON_S, tick, tick + 1).at(0)
    last = tick + round((HORIZON_S + SETTINGS.latency_s) * RATE_HZ)
    beyond = last + round(MARGIN_S * RATE_HZ) + 5
    for limb, ends in (("HD", ("neck", "head")), ("LRA", ("elbow_r", "wrist_r")), ("THX", ("pelvis", "shoulder_l"))):
        solid = InflatedHull.around(*volumes[limb])
        assert solid.radius_m == RADII_M[limb]
        for name in ends:
            k = POINTS.index(name)
            for frame in range(tick, last):
                between = points[frame, k] + np.linspace(0.0, 1.0, 5)[:, None] * (
                    points[frame + 1, k] - points[frame, k]
                )
                assert solid.distances_m(between).max() < 1e-9
            assert solid.distances_m(points[beyond : beyond + 1, k]).max() > 0.01
        if limb == "LRA":
            elbow, wrist = (points[last, POINTS.index(name)] for name in ends)
            hand = wrist + SETTINGS.hand_m * (wrist - elbow) / np.linalg.norm(wrist - elbow)
            assert solid.distances_m(hand[None]).max() < 1e-9


def test_a_limb_that_was_not_recorded_keeps_its_predicted_volume() -> None:
    of, points = walking()
    points[:, POINTS.index("wrist_l")] = np.nan
    future = foreseen(of, points)
    found = future.prepare(of).volumes(HORIZON_S, 20, 22)
    plain = future.plain.prepare(of).volumes(HORIZON_S, 20, 22)
    for row in range(2):
        for k, limb in enumerate(BODY):
            same = np.array_equal(found.vertices(row, k), plain.vertices(row, k))
            assert same == (limb in ("LLA", "LEGS"))
            assert (found.radius_m[row, k] == plain.radius_m[row, k]) == same
