"""Skeletons that no body can have: what cannot be observed is NaN, and nothing in the kernels breaks on it."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hrcreplay.geometry.convex_hull import hull
from hrcreplay.human.fusion import fuse
from hrcreplay.human.fusion.inverse_kinematics import inverse, measure
from hrcreplay.human.model import LimitSet, skeleton
from hrcreplay.limits import load_limits
from hrcreplay.records import JOINTS, LENGTHS, POINTS, CameraFrames, Floats, HumanStates
from hrcreplay.settings.sections import Fusion, Prediction
from tests.human import sightings
from tests.human.predictions import predict

LIMITS: LimitSet = load_limits("people")
PERIOD_NS = 40_000_000
TICK_NS = 20_000_000
HEAD, NECK, PELVIS = (POINTS.index(name) for name in ("head", "neck", "pelvis"))
ARM_R = [POINTS.index(f"{name}_r") for name in ("shoulder", "elbow", "wrist")]
SHOULDERS = [POINTS.index(f"shoulder_{side}") for side in "lr"]
#: Numbers that loggers and trackers write for 'nothing', and what a broken byte makes of a coordinate.
VALUES = (0.0, 1e-9, 1e-4, 5e-4, 1e-3, -1.0, 1e3, 1e9, 3e38)


def body() -> Floats:
    return skeleton(sightings.NEUTRAL[None], sightings.LENGTHS_M[None])[0]


def rows(points: Floats) -> dict[str, float]:
    angles, lengths = inverse(points[None])
    return dict(zip((*JOINTS, *LENGTHS), np.concatenate([angles[0], lengths[0]]).tolist(), strict=True))


@pytest.mark.parametrize(
    ("one_place", "lost"),
    [
        (SHOULDERS, {"theta", "rho", "pi_half_shoulder", *(f"a{s}{k}" for s in "rl" for k in (1, 2, 3))}),
        ([HEAD, NECK, *SHOULDERS], {"theta", "rho", "pi_half_shoulder", "pi_head"}),
        (ARM_R[:2], {"ar1", "ar2", "ar3", "ar4", "pi_upper_arm_r"}),
        (ARM_R[1:], {"ar3", "ar4", "pi_forearm_r"}),
        (ARM_R, {"ar1", "ar2", "ar3", "ar4", "pi_upper_arm_r", "pi_forearm_r"}),
    ],
)
def test_what_hangs_on_a_bone_without_length_is_not_observed(one_place: list[int], lost: set[str]) -> None:
    points = body()
    whole = rows(points)
    points[one_place] = points[one_place[0]]
    found = rows(points)
    assert lost <= {name for name, value in found.items() if np.isnan(value)}
    for name in ("x", "y", "z"):
        assert found[name] == whole[name]
    if one_place == ARM_R[1:]:  # and what does not hang on it is what it was
        assert {name for name, value in found.items() if np.isnan(value)} == lost
        assert all(found[name] == whole[name] for name in found if name not in lost)


def test_neck_and_pelvis_in_one_place() -> None:
    points = body()
    points[PELVIS] = 0.5 * (points[SHOULDERS[0]] + points[SHOULDERS[1]])
    found = rows(points)
    assert np.isnan([found["rho"], found["pi_torso"]]).all()
    assert found["theta"] == pytest.approx(rows(body())["theta"], abs=1e-12)


def frames(points: Floats, confidence: Floats) -> CameraFrames:
    n = len(points)
    capture_ns = np.arange(1, n + 1, dtype=np.int64) * PERIOD_NS
    camera = np.arange(n, dtype=np.int64) % 2
    whole = sightings.frames_of(points, camera, capture_ns, 10_000_000)
    return CameraFrames(
        capture_ns=whole.capture_ns,
        arrival_ns=whole.arrival_ns,
        camera=camera,
        body=whole.body,
        points_m=points,
        confidence=confidence,
        cameras=whole.cameras,
    )


def followed(seen: CameraFrames, rules: Fusion) -> HumanStates:
    ticks = np.arange(0, int(seen.arrival_ns[-1]) + TICK_NS, TICK_NS)
    measured = measure(seen, np.stack([np.eye(4)] * 2), Fusion())
    return fuse.fuse(fuse.start(sightings.CAMERAS), ticks, measured, rules, LIMITS)[1]


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.sampled_from(VALUES), st.booleans())
def test_no_skeleton_breaks_the_kernels(seed: int, value: float, reuse: bool) -> None:
    """Points spoilt at random for 0.6 s, then one whole person for a second: all states are numbers."""
    rng = np.random.default_rng(seed)
    points = np.tile(body(), (40, 1, 1))
    points += rng.normal(0.0, 0.005, points.shape)
    spoilt = rng.random((15, len(POINTS))) < rng.choice([0.1, 0.5, 1.0])
    points[:15][spoilt] = value if rng.random() < 0.5 else points[0, rng.integers(len(POINTS))]
    some = rng.integers(0, len(POINTS), 3)
    points[:15, some] = points[:15, some[:1]] + rng.choice([0.0, 1e-12, 9e-4])
    confidence = np.where(np.isfinite(points[..., 0]), 1.0, 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # overflow: the numbers ask for it
        states = followed(frames(points, confidence), Fusion(stale="reuse" if reuse else "skip"))
        for method in ("sound", "paper", "positions"):
            volumes = predict(states, LIMITS, horizon_s=0.4, method=method, margins=Prediction(sigmas=3.0))
            for tick in (20, len(states) - 1):
                for limb in range(len(volumes.limbs)):
                    if np.isfinite(vertices := volumes.vertices(tick, limb)).all() and abs(vertices).max() < 1e6:
                        hull(vertices)
    assert np.isfinite(states.p[-1]).all()
    assert np.isfinite(states.p_std[-1]).all()
