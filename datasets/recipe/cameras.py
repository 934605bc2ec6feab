"""The two cameras' recordings: when frames are taken and arrive, what goes wrong, and who else walks by."""

from __future__ import annotations

import numpy as np

from datasets.recipe import scene
from datasets.recipe.curves import rot_z
from datasets.recipe.sensors import LEFT_ARM, RIGHT_ARM, Sensor, View, jump, observe, swap_arms
from hrcreplay.records import Bools, CameraFrames, Floats, Ints

KINECT = Sensor(
    name="kinect",
    T_world_camera=scene.T_WORLD_KINECT,
    half_view_rad=(np.radians(35.3), np.radians(30.0)),
    range_m=4.5,
    white_m=0.0100,
    slow_m=0.002,
    slow_s=0.15,
    along=1.3,
    rate_hz=30.0,
    first_s=5.0,
    late_s=0.030,
)
XTION = Sensor(
    name="xtion",
    T_world_camera=scene.T_WORLD_XTION,
    half_view_rad=(np.radians(29.0), np.radians(22.5)),
    range_m=4.0,
    white_m=0.0085,
    slow_m=0.003,
    slow_s=0.20,
    along=1.5,
    rate_hz=25.0,
    first_s=0.3,
    late_s=0.036,
)
SENSORS = (KINECT, XTION)

#: When a camera sees no worker at all [s]: somebody stands right before the kinect, the xtion's cable is loose.
BLOCKED_S = {"kinect": ((19.0, 21.4), (45.2, 46.9)), "xtion": ((33.4, 34.1),)}
#: When a colleague crosses the kinect's view [s], some way behind the worker.
COLLEAGUE_S = (43.6, 47.6)


def record(t_s: Floats, points_m: Floats, start_ns: int, seed: int) -> CameraFrames:
    """Both cameras' frames in order of arrival.

    Args:
        t_s: (n,) instants of the truth [s].
        points_m: (n, 20, 3) true POINTS in the world [m].
        start_ns: Instant of ``t_s == 0``.
        seed: Of all noise.
    """
    tables = [_one(index, t_s, points_m, start_ns, np.random.default_rng([seed, index])) for index in (0, 1)]
    frames = CameraFrames.join(tables)
    return frames.rows(np.lexsort((frames.body, frames.camera, frames.arrival_ns)))


def _one(index: int, t_s: Floats, points_m: Floats, start_ns: int, rng: np.random.Generator) -> CameraFrames:
    sensor = SENSORS[index]
    taken_s = np.arange(sensor.first_s, t_s[-1] - 0.09, 1.0 / sensor.rate_hz)
    taken_s = taken_s + rng.normal(0.0, 0.0006, len(taken_s))
    view = observe(sensor, taken_s, between(taken_s, t_s, points_m), rng)
    _spoil(view, rng)
    here = ~_blocked(sensor, taken_s) & (rng.random(len(taken_s)) > 0.015) & _within(sensor, view)
    body = np.where(taken_s < BLOCKED_S[sensor.name][-1][0], 1, 4)  # after the last block it is somebody new
    arrival_ns = _arrivals(sensor, taken_s, rng)
    worker = _table(index, taken_s, arrival_ns, body, view, start_ns).rows(here)
    if sensor is not KINECT:
        return worker
    passing = (taken_s >= COLLEAGUE_S[0]) & (taken_s < COLLEAGUE_S[1])
    other_m = _colleague(taken_s[passing], t_s, points_m)
    other = observe(sensor, taken_s[passing], other_m, rng)
    two = np.full(len(other_m), 2)
    return CameraFrames.join([worker, _table(index, other.t_s, arrival_ns[passing], two, other, start_ns)])


def between(when_s: Floats, t_s: Floats, points_m: Floats) -> Floats:
    """(m, 20, 3) points at other instants, on the straight line between two samples."""
    row = np.clip(np.searchsorted(t_s, when_s, side="right") - 1, 0, len(t_s) - 2)
    share = ((when_s - t_s[row]) / (t_s[row + 1] - t_s[row]))[:, None, None]
    return np.asarray(points_m[row] * (1.0 - share) + points_m[row + 1] * share)


def _colleague(when_s: Floats, t_s: Floats, points_m: Floats) -> Floats:
    """(n, 20, 3) somebody who walks by behind the worker, with the worker's own gait of the first seconds."""
    walk = between(when_s - COLLEAGUE_S[0] + 0.3, t_s, points_m)
    first = walk[0, 0] * np.array([1.0, 1.0, 0.0])
    turned = (walk - first) @ rot_z(np.array([np.radians(-72.0)]))[0].T
    return np.asarray(turned + np.array([2.70, -1.20, 0.0]))


def _spoil(view: View, rng: np.random.Generator) -> None:
    """Gross errors: arms taken for each other and limbs that jump, some of them at full confidence."""
    soonest, last = 60, len(view.t_s) - 60  # nobody can tell when the person has only just appeared
    for k in range(4):
        first = int(rng.integers(soonest, last))
        swap_arms(view, np.arange(first, first + rng.integers(2, 5)), from_shoulder=k % 2 == 0)
    for k in range(20):
        first = int(rng.integers(soonest, last))
        arm = (RIGHT_ARM, LEFT_ARM)[k % 2]
        by_m = rng.normal(0.0, 1.0, 3)
        by_m *= rng.uniform(0.25, 0.6) / np.linalg.norm(by_m)
        points = arm[1:] if k % 4 < 2 else arm[2:]
        jump(view, np.arange(first, first + rng.integers(1, 5)), points, by_m, (1.0, 0.5)[k % 3 == 0])


def _blocked(sensor: Sensor, t_s: Floats) -> Bools:
    """(n,) whether something stands before the camera."""
    return np.asarray(np.any([(t_s >= first) & (t_s < last) for first, last in BLOCKED_S[sensor.name]], axis=0))


def _within(sensor: Sensor, view: View) -> Bools:
    """(n,) whether the trunk is in view and near enough; without it there is no skeleton."""
    depth = view.points_m[:, :4, 2]
    far = np.median(np.where(np.isnan(depth), np.inf, depth), axis=1)
    return np.asarray(far < sensor.range_m)


def _arrivals(sensor: Sensor, taken_s: Floats, rng: np.random.Generator) -> Floats:
    """(n,) when frames reach the logger [s]: never before they are taken, never before an earlier one."""
    late_s = np.minimum(sensor.late_s + rng.gamma(2.0, 0.005, len(taken_s)), 0.080)
    return np.asarray(np.maximum.accumulate(taken_s + late_s))


def _table(index: int, taken_s: Floats, arrival_s: Floats, body: Ints, view: View, start_ns: int) -> CameraFrames:
    return CameraFrames(
        capture_ns=_instants(taken_s, start_ns),
        arrival_ns=_instants(arrival_s, start_ns),
        camera=np.full(len(taken_s), index),
        body=body.astype(np.int64),
        points_m=np.round(view.points_m, 4),  # a tenth of a millimetre: the last bits of a sine do not reach the log
        confidence=view.confidence,
        cameras=tuple(sensor.name for sensor in SENSORS),
    )


def _instants(t_s: Floats, start_ns: int) -> Ints:
    return np.asarray(start_ns + np.round(t_s * 1e6).astype(np.int64) * 1000)
