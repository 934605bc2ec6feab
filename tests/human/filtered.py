"""People filtered, for the tests."""

from __future__ import annotations

import numpy as np

from hrcreplay.human.fusion.fuse import fuse, start
from hrcreplay.human.fusion.inverse_kinematics import measure
from hrcreplay.human.model import LimitSet, skeleton
from hrcreplay.limits import load_limits
from hrcreplay.records import DOF, Floats, HumanStates, Ints, Measurements
from hrcreplay.settings.sections import Fusion
from tests.human.sightings import CAMERAS, LENGTHS_M, NEUTRAL, frames_of

WIDE = load_limits("human")
#: No bound but heading's absence of one, no outlier, nothing forgotten: the plain filter of (42)-(57).
_LOW, _HIGH = np.full(DOF, -1e9), np.full(DOF, 1e9)
FREE = LimitSet("free", _LOW, _HIGH, _LOW, _HIGH, _LOW, _HIGH, coupled=False)
PLAIN = Fusion(outlier_m=1e6, bone_m=1e6, coast_s=1e3, memory_s=1e3, spread_least=1.0, spread_most=1.0)


def ticks(stop_s: float, start_s: float = 0.0, rate_hz: float = 250.0) -> Ints:
    return (np.arange(round(start_s * rate_hz), round(stop_s * rate_hz)) * (1e9 / rate_hz)).astype(np.int64)


def until(measurements: Measurements, end_ns: int) -> Measurements:
    return measurements.rows(measurements.arrival_ns <= end_ns)


def standing(
    stop_s: float, p: Floats = NEUTRAL, cameras: tuple[int, ...] = (0, 1), start_s: float = 0.0
) -> Measurements:
    """Noise-free frames of a person who stands still, 25 Hz a camera, 20 ms on the wire."""
    instants = np.arange(start_s, stop_s, 0.04)
    capture = np.concatenate([(instants * 1e9).astype(np.int64) + 5_000_000 * c for c in cameras])
    camera = np.repeat(np.array(cameras), len(instants))
    order = np.argsort(capture, kind="stable")
    points = np.repeat(skeleton(p[None], LENGTHS_M[None]), len(capture), axis=0)
    frames = frames_of(points, camera[order], capture[order], 20_000_000)
    return measure(frames, np.tile(np.eye(4), (2, 1, 1)), Fusion(point_std_m=0.01))


def fused(measurements: Measurements, t_ns: Ints, settings: Fusion, limits: LimitSet = WIDE) -> HumanStates:
    return fuse(start(CAMERAS), t_ns, until(measurements, int(t_ns[-1])), settings, limits)[1]
