"""``pytest --benchmark-only``: the swept volumes of a tick beside a convex hull of the same raw points."""

from __future__ import annotations

from typing import Any

import pytest
from scipy.spatial import ConvexHull

from hrcreplay.limits import load_limits
from hrcreplay.records import LIMBS
from tests.human.people import random_states, raw_cloud
from tests.human.predictions import predict, reachable

T, PAPER = 0.377, load_limits("paper")
PEOPLE = random_states(PAPER, 50, 0)


@pytest.mark.benchmark(group="swept volumes of 50 ticks")
def test_ours(benchmark: Any) -> None:
    predict(PEOPLE, PAPER, horizon_s=T, method="paper")
    volumes = benchmark(predict, PEOPLE, PAPER, horizon_s=T, method="paper")
    benchmark.extra_info["points a limb"] = len(volumes.vertices_m) / len(volumes) / len(LIMBS)
    assert len(volumes) == 50


@pytest.mark.benchmark(group="swept volumes of 50 ticks")
def test_qhull_on_the_raw_points(benchmark: Any) -> None:
    """Only the hulls: the raw points are there before the clock starts."""
    reach = reachable(PEOPLE, PAPER, T, "paper")
    clouds = [raw_cloud(limb, *ends) for ends in zip(reach.low, reach.high, strict=True) for limb in LIMBS]
    hulls = benchmark(lambda: [len(ConvexHull(cloud).vertices) for cloud in clouds])
    benchmark.extra_info["points a limb"] = sum(hulls) / len(clouds)
    assert len(hulls) == 300


@pytest.mark.benchmark(group="swept volumes of one live tick")
def test_live(benchmark: Any) -> None:
    tick = PEOPLE.rows(slice(0, 1))
    volumes = benchmark(predict, tick, PAPER, horizon_s=T, method="paper")
    assert len(volumes) == 1
