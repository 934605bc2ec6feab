"""The same movement as a second camera, elsewhere and with its own clock and errors, would have seen it."""

from __future__ import annotations

import gzip
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hrcreplay.calibration.registration import rigid
from hrcreplay.records import MIRROR, POINTS, Floats, SkeletonTrack

_ARM = ("CLAVICLE", "SHOULDER", "ELBOW", "WRIST", "HAND", "HANDTIP", "THUMB")
_LEG = ("HIP", "KNEE", "ANKLE", "FOOT")
AZURE = (
    *("PELVIS", "SPINE_NAVEL", "SPINE_CHEST", "NECK"),
    *(f"{joint}_{side}" for limb in (_ARM, _LEG) for side in ("LEFT", "RIGHT") for joint in limb),
    *("HEAD", "NOSE", "EYE_LEFT", "EAR_LEFT", "EYE_RIGHT", "EAR_RIGHT"),
)
COLUMNS = [0, 2, 3, 26, 5, 6, 7, 8, 12, 13, 14, 15, 18, 19, 20, 21, 22, 23, 24, 25]  # of POINTS among AZURE


@dataclass(frozen=True)
class Truth:
    """How the second camera really stands to the first."""

    T_a_b: Floats
    offset_s: float


#: 43 degrees and 1.6 m apart, as real pairs are.
POSE = rigid(Rotation.from_rotvec([0.1, np.radians(43.0), 0.08]).as_matrix(), np.array([-1.5, 0.1, 0.6]))


def reobserve(track: SkeletonTrack, truth: Truth, seed: int) -> SkeletonTrack:
    """The track as the second camera gives it, 40 % of a frame later.

    White noise of 8 mm and errors of 12 mm that last a second on each axis (together the 25 mm by which real pairs
    disagree), six mix-ups of left and right for up to 20 frames, a hundredth of all points thrown by half a metre,
    all at full confidence; a frame in twenty-five lost, and one second of silence.
    """
    rng = np.random.default_rng(seed)
    share = 0.4
    t_ns = track.t_ns[:-1] + np.round(share * np.diff(track.t_ns)).astype(np.int64)
    there = (1 - share) * track.points_m[:-1] + share * track.points_m[1:]
    points = (there - truth.T_a_b[:3, 3]) @ truth.T_a_b[:3, :3]
    slow = np.zeros_like(points)
    slow[0] = rng.normal(0, 0.012, points.shape[1:])
    keep = 0.97
    for i in range(1, len(points)):
        slow[i] = keep * slow[i - 1] + np.sqrt(1 - keep**2) * rng.normal(0, 0.012, points.shape[1:])
    points = points + slow + rng.normal(0, 0.008, points.shape)
    for first in rng.integers(0, len(points), 6):
        length = int(rng.integers(3, 20))
        points[first : first + length] = points[first : first + length][:, list(MIRROR)]
    thrown = rng.random(points.shape[:2]) < 0.01
    points[thrown] += rng.normal(0, 0.5, (int(thrown.sum()), 3))
    seen = rng.random(len(points)) > 0.04
    silent = int(rng.integers(0, len(points)))
    seen[silent : silent + 30] = False
    confidence = np.minimum(track.confidence[:-1], track.confidence[1:])
    return SkeletonTrack((t_ns + round(truth.offset_s * 1e9))[seen], points[seen], confidence[seen])


def read_azure(path: Path) -> SkeletonTrack:
    """An Azure CSV of one body, read without the importer."""
    with gzip.open(path, "rt") as stream:
        table = np.genfromtxt(stream, delimiter=";", skip_header=1)
    joints = table[:, 2:].reshape(len(table), 32, 4)[:, COLUMNS]
    return SkeletonTrack(
        (table[:, 0] * 1000).astype(np.int64), joints[..., 1:] / 1000, np.minimum(joints[..., 0] / 2, 1)
    )


def write_azure(track: SkeletonTrack, path: Path, body: int = 1) -> None:
    """Writes a track as Azure CSV; joints that POINTS lacks are zero."""
    header = ["timestamp", "body_idx", *(f"{joint} ({axis})" for joint in AZURE for axis in "cxyz")]
    rows = [";".join(header)]
    for t_ns, points, confidence in zip(track.t_ns, track.points_m, track.confidence, strict=True):
        joints = np.zeros((32, 4))
        joints[COLUMNS, 0], joints[COLUMNS, 1:] = np.round(confidence * 2), points * 1000
        fields = [f"{c:.0f};{x:.6f};{y:.6f};{z:.6f}" for c, x, y, z in joints.tolist()]
        rows.append(";".join([str(int(t_ns) // 1000), str(body), *fields]))
    path.write_text("\n".join(rows) + "\n")


def walker(seconds: float = 20.0, rate_hz: float = 30.0) -> SkeletonTrack:
    """Somebody who walks a figure of eight of 2 m x 1 m and swings the arms, in a world of z up and floor z = 0."""
    t = np.arange(0, seconds, 1 / rate_hz)
    x, y = np.sin(0.6 * t), 0.5 * np.sin(1.2 * t)
    heading = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    ahead = np.stack([np.cos(heading), np.sin(heading), 0 * t], axis=1)
    left = np.stack([-np.sin(heading), np.cos(heading), 0 * t], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    middle = np.stack([x, y, 0 * t], axis=1)
    pace = 5.0 * t

    def at(forward: Floats | float, side: float, height: Floats | float) -> Floats:
        forward, height = np.broadcast_to(forward, t.shape), np.broadcast_to(height, t.shape)
        return middle + forward[:, None] * ahead + side * left + height[:, None] * up

    points = {"pelvis": at(0, 0, 1.0), "chest": at(0, 0, 1.25), "neck": at(0, 0, 1.45), "head": at(0.02, 0, 1.65)}
    for side, s in (("l", 1.0), ("r", -1.0)):
        swing = s * np.sin(pace)
        lift = np.maximum(0.0, np.cos(pace) * s) * 0.1  # half of the time the foot rests
        points |= {
            f"shoulder_{side}": at(0, s * 0.19, 1.45),
            f"elbow_{side}": at(-0.08 * swing, s * 0.22, 1.17),
            f"wrist_{side}": at(0.05 - 0.2 * swing, s * 0.22, 0.93),
            f"hand_{side}": at(0.05 - 0.25 * swing, s * 0.22, 0.86),
            f"hip_{side}": at(0, s * 0.1, 0.95),
            f"knee_{side}": at(0.02 + 0.1 * swing, s * 0.1, 0.5 + 0.3 * lift),
            f"ankle_{side}": at(-0.03 + 0.2 * swing, s * 0.1, 0.1 + lift),
            f"foot_{side}": at(0.1 + 0.2 * swing, s * 0.1, 0.03 + lift),
        }
    table = np.stack([points[name] for name in POINTS], axis=1)
    return SkeletonTrack(1_000_000_000 + np.round(t * 1e9).astype(np.int64), table, np.ones(table.shape[:2]))


def angle_deg(R: Floats) -> float:
    """Angle of a rotation matrix [deg]."""
    return float(np.degrees(Rotation.from_matrix(R).magnitude()))
