"""A person unlike the model, seen by two cameras, and the filter's view of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hrcreplay.human.fusion.fuse import fuse, start
from hrcreplay.human.fusion.inverse_kinematics import measure
from hrcreplay.limits import load_limits
from hrcreplay.records import POINTS, CameraFrames, HumanStates, Ints, Measurements
from hrcreplay.settings.sections import Fusion

WIDE = load_limits("human")
CAMERAS = ("left", "right")
RATE_HZ = 250
#: Bent sideways, one shoulder up, head forward. World, facing x.
BENT_M = {
    "pelvis": (0.0, 0.0, 0.95),
    "head": (0.06, 0.14, 1.62),
    "shoulder_r": (0.0, -0.12, 1.47),
    "elbow_r": (0.10, -0.30, 1.22),
    "wrist_r": (0.33, -0.28, 1.25),
    "shoulder_l": (0.0, 0.26, 1.41),
    "elbow_l": (0.05, 0.33, 1.10),
    "wrist_l": (0.27, 0.25, 1.18),
}


def ticks(seconds: float) -> Ints:
    return np.arange(1, round(seconds * RATE_HZ) + 1) * (1_000_000_000 // RATE_HZ)


def bent(seconds: float) -> CameraFrames:
    """Frames of the bent person, who stands still; each camera at 25 Hz, noise-free, at the world's origin."""
    capture = np.arange(0, round(seconds * 1e9), 20_000_000)
    points = np.full((len(capture), len(POINTS), 3), np.nan)
    for name, point in BENT_M.items():
        points[:, POINTS.index(name)] = point
    return CameraFrames(
        capture_ns=capture,
        arrival_ns=capture + 1_000_000,
        camera=np.arange(len(capture)) % 2,
        body=np.zeros(len(capture), np.int64),
        points_m=points,
        confidence=np.isfinite(points[:, :, 0]).astype(np.float64),
        cameras=CAMERAS,
    )


def measured(frames: CameraFrames) -> Measurements:
    return measure(frames, np.tile(np.eye(4), (2, 1, 1)), Fusion(point_std_m=0.01))


def fused(m: Measurements, t_ns: Ints, settings: Fusion | None = None) -> HumanStates:
    return fuse(start(m.cameras), t_ns, m.rows(m.arrival_ns <= t_ns[-1]), settings or Fusion(), WIDE)[1]


def predicted(m: Measurements, t_ns: Ints, settings: Fusion) -> tuple[HumanStates, HumanStates]:
    """The fused states, and what the state before each tick predicts for it, Eq. (48), before any of its frames."""
    _, states, _, trace = fuse(start(m.cameras), t_ns, m.rows(m.arrival_ns <= t_ns[-1]), settings, WIDE, traced=True)
    before = {name: np.roll(getattr(states, name), 1, axis=0) for name in ("p", "v", "a", "j", "lengths_m")}
    dt, damping = np.diff(t_ns, prepend=t_ns[0])[:, None] * 1e-9, trace.damping
    p, v, a, j = (before[name] for name in "pvaj")
    prior = replace(
        states,
        p=p + dt * v + dt**2 / 2 * a + dt**3 / 6 * j,
        v=damping * (v + dt * a + dt**2 / 2 * j),
        a=damping * (a + dt * j),
        j=damping * j,
        lengths_m=before["lengths_m"],
    )
    return states, prior


def used_frames(m: Measurements, t_ns: Ints) -> list[tuple[int, int]]:
    """(tick, frame) of the newest frame of a camera in each tick; one captured before an earlier arrival is not."""
    newest: dict[tuple[int, int], int] = {}
    captured = dict.fromkeys(range(len(m.cameras)), -1)
    for i, k in enumerate(np.searchsorted(t_ns, m.arrival_ns).tolist()):
        c = int(m.camera[i])
        if k < len(t_ns) and m.capture_ns[i] >= captured[c]:
            captured[c] = int(m.capture_ns[i])
            newest[k, c] = i
    return [(k, i) for (k, _), i in sorted(newest.items())]
