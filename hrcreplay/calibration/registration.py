"""Registration of two sensors, pose and clock offset, from the skeletons of one person that both saw.

Recorded skeletons have gross errors at full confidence (left and right exchanged, jumps), the two clocks differ, and
the frames have different capture times. So both tracks are smoothed by the same kernel and compared at the instants of
one camera, and pose and clock offset are estimated together by a robust Gauss-Newton method.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hrcreplay.kernels import njit
from hrcreplay.logs.camera_checks import find_mirrored, interpolate
from hrcreplay.records import MIRROR, POINTS, Floats, Ints, SkeletonTrack

_NS = 1e-9
_SPEED_MAX = 4.0  # m/s, maximum speed of a person; faster motion is a jump of the tracker
_STARTS = 40  # number of frames whose alignment is tried as the initial one
_ITERATIONS = 60
_INSTANTS = 5000  # maximum number of instants, evenly spaced, at which the tracks are compared
_LIKE = 0.1  # minimum significant correlation of speeds
_COARSE = 1200  # maximum number of instants during the search for offsets
_ROUGH = 400  # maximum number of instants for an offset accurate to a frame
_TOGETHER = 20  # minimum number of frames of both with a point
_OVERLAP = 0.4  # minimum share of the maximum number of point pairs over all offsets
_BATCH = 4096  # number of frames whose neighbours are compared together


@dataclass(frozen=True)
class Registration:
    """Pose and clock of sensor b relative to sensor a."""

    T_a_b: Floats  #: (4, 4) transforms points of b into the frame of a
    offset_s: float  #: clock of b minus clock of a [s]


@dataclass(frozen=True)
class Disagreement:
    """Residual between two registered tracks, over all points that both saw, including outliers."""

    median_m: float
    p95_m: float
    points: int  #: number of point pairs
    mirrored: float  #: share of the frames in which the two disagree on left and right


def kabsch(source_m: Floats, target_m: Floats, weight: Floats) -> Floats:
    """Computes the rigid transform from the source points to the target points by weighted least squares.

    scipy's ``Rotation.align_vectors`` agrees to 1e-14 but takes 2.6 times as long, and would change the last bits of
    the cell file.

    Args:
        source_m: (m, 3) [m].
        target_m: (m, 3) [m].
        weight: (m,) weights, not negative.

    Returns:
        T_target_source (4, 4).
    """
    share = weight / weight.sum()
    middle_s, middle_t = share @ source_m, share @ target_m
    u, _, vt = np.linalg.svd((share[:, None] * (source_m - middle_s)).T @ (target_m - middle_t))
    turn = vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    return rigid(turn, middle_t - turn @ middle_s)


def rigid(rotation: Floats, translation_m: Floats) -> Floats:
    """Returns the (4, 4) transform of a rotation (3, 3) and a translation (3,) [m]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation_m
    return T


def transform(T: Floats, points_m: Floats) -> Floats:
    """Transforms points (..., 3) [m] by T (4, 4)."""
    return points_m @ T[:3, :3].T + T[:3, 3]


def register(a: SkeletonTrack, b: SkeletonTrack, *, search_s: float = 2.0) -> Registration | None:
    """Estimates the pose of sensor b in the frame of sensor a, and b's clock offset.

    Args:
        a: The person as sensor a saw it, (n, 20, 3) [m].
        b: The same person as sensor b saw it, (m, 20, 3) [m].
        search_s: Clock offsets are searched within plus and minus this [s].

    Returns:
        The registration, or None if the tracks share too few points.
    """
    if min(len(a), len(b)) < 3:
        return None
    a, b = _without_jumps(a), _without_jumps(b)
    width_s = max(float(np.median(np.diff(a.t_ns))), float(np.median(np.diff(b.t_ns)))) * _NS
    t_ns = a.t_ns[:: -(-len(a) // _INSTANTS)]
    points_a, velocity_a, weight_a = _smoothed(a, t_ns, width_s)
    few = slice(None, None, -(-len(t_ns) // _COARSE))
    offset_s, likeness = _coarse_offset(t_ns[few], velocity_a[few], b, width_s, search_s)
    if likeness < _LIKE:  # no motion: the clocks cannot be compared, and a velocity of zero leaves the offset unchanged
        offset_s, velocity_a = 0.0, np.zeros_like(velocity_a)
    at_a = _AtA(t_ns, points_a, velocity_a, weight_a, width_s)
    found = _refine(at_a, b, offset_s)
    if found is None or likeness < _LIKE:
        return found
    # Speeds may agree by chance if the person moved little; positions do not, once the pose is roughly known.
    there = SkeletonTrack(b.t_ns, transform(found.T_a_b, b.points_m), b.confidence)
    better = find_clock_offset(a, there, search_s=search_s)
    if better is None or abs(better.offset_s - found.offset_s) <= width_s:
        return found
    return _refine(at_a, b, better.offset_s) or found


class _AtA(NamedTuple):
    """Smoothed track of sensor a at its own instants."""

    t_ns: Ints
    points: Floats
    velocity: Floats
    weight: Floats
    width_s: float


def _refine(a: _AtA, b: SkeletonTrack, offset_s: float) -> Registration | None:
    """Refines pose and offset from an initial offset; None if the tracks share too few points."""
    points_b, _, weight_b = _smoothed(b, a.t_ns + round(offset_s / _NS), a.width_s)
    T = _start(a.points, points_b, np.sqrt(a.weight * weight_b))
    if T is None:
        return None
    for _ in range(_ITERATIONS):
        points_b, _, weight_b = _smoothed(b, a.t_ns + round(offset_s / _NS), a.width_s)
        weight = np.sqrt(a.weight * weight_b)
        if not weight.any():
            return None
        T, step = _gauss_newton(T, a.points, points_b, a.velocity, weight)
        offset_s += float(np.clip(step[6], -a.width_s, a.width_s))
        if np.abs(step).max() < 1e-6:
            break
    return Registration(T, offset_s)


class ClockOffset(NamedTuple):
    """Clock offset of a sensor b relative to a sensor a, from the person that both saw."""

    offset_s: float  #: clock of b minus clock of a, accurate to a frame [s]
    apart_m: float  #: median distance between the two movements with this offset [m]
    without_m: float  #: the same without an offset; NaN if the two then do not overlap [m]
    frame_s: float  #: time between two frames of the slower sensor [s]


def find_clock_offset(a: SkeletonTrack, b: SkeletonTrack, *, search_s: float) -> ClockOffset | None:
    """Finds the clock offset at which two sensors see the most similar movement; fast, accurate to a frame.

    A constant difference of positions, from an error of a pose or of a tracker, has no influence.

    Args:
        a: The person as sensor a saw it, in a frame with the same axes as that of b.
        b: The same person as sensor b saw it.
        search_s: Offsets are searched within plus and minus this [s].

    Returns:
        The offset; None if the two never saw the person together for long enough.
    """
    if min(len(a), len(b)) < _TOGETHER:
        return None
    a, b = _without_jumps(a), _without_jumps(b)
    width_s = max(float(np.median(np.diff(a.t_ns))), float(np.median(np.diff(b.t_ns)))) * _NS
    t_ns = a.t_ns[:: -(-len(a) // _ROUGH)]
    points_a, _, weight_a = _smoothed(a, t_ns, width_s)
    steps = int(np.ceil(search_s / width_s))
    offsets_s = np.array(sorted(range(-steps, steps + 1), key=abs)) * width_s
    apart_m, pairs = np.full(len(offsets_s), np.nan), np.zeros(len(offsets_s))
    for i, offset_s in enumerate(offsets_s):
        points_b, _, weight_b = _smoothed(b, t_ns + round(offset_s / _NS), width_s)
        both = (weight_a > 0) & (weight_b > 0)
        both &= both.sum(axis=0) >= _TOGETHER
        pairs[i] = both.sum()
        if pairs[i]:
            seen = both.any(axis=0)
            beside = np.where(both[..., None], points_a - points_b, np.nan)[:, seen]
            apart_m[i] = np.nanmedian(np.linalg.norm(beside - np.nanmedian(beside, axis=0), axis=2))
    usable = np.where(pairs >= _OVERLAP * pairs.max(), apart_m, np.nan)
    if not np.isfinite(usable).any():
        return None
    best = int(np.nanargmin(usable))
    return ClockOffset(float(offsets_s[best]), float(apart_m[best]), float(usable[0]), width_s)


def disagreement(a: SkeletonTrack, b: SkeletonTrack, found: Registration) -> Disagreement | None:
    """Computes the residual between the raw points of two registered tracks, b interpolated linearly to a's instants.

    Returns:
        Median and 95th percentile over all point pairs of positive confidence [m]; None without a pair.
    """
    there = transform(found.T_a_b, interpolate(b, a.t_ns + round(found.offset_s / _NS)))
    apart_m = np.linalg.norm(a.points_m - there, axis=2)
    seen = (a.confidence > 0) & np.isfinite(apart_m)
    if not seen.any():
        return None
    scale_m = float(np.median(apart_m[seen]))
    mirrored = find_mirrored(a.points_m, there, seen.astype(np.float64), max(scale_m, 1e-3))
    median_m, p95_m = np.percentile(apart_m[seen], [50, 95])
    return Disagreement(float(median_m), float(p95_m), int(seen.sum()), float(mirrored[seen.any(axis=1)].mean()))


def _without_jumps(track: SkeletonTrack) -> SkeletonTrack:
    """Sets confidence 0 for points further from the median of their five nearest frames than a fast arm can move.

    They are removed before smoothing, which would spread them over their neighbours.
    """
    n = len(track)
    seen = np.isfinite(track.points_m).all(axis=2) & (track.confidence > 0)
    filled = np.where(seen[..., None], track.points_m, 0.0)
    jumps = np.zeros_like(seen)
    for first in range(0, n, _BATCH):  # five times the frames of a long track would fill the memory
        rows = np.arange(first, min(first + _BATCH, n))
        around = np.clip(rows[:, None] + np.arange(-2, 3), 0, n - 1)
        middle = np.median(np.where(seen[around][..., None], filled[around], filled[rows][:, None]), axis=1)
        jumps[rows] = np.linalg.norm(filled[rows] - middle, axis=2) > 0.15
    return SkeletonTrack(track.t_ns, filled, np.where(seen & ~jumps, track.confidence, 0.0))


def _smoothed(track: SkeletonTrack, t_ns: Ints, width_s: float) -> tuple[Floats, Floats, Floats]:
    """Returns points (n, 20, 3) [m], velocities [m/s] and weights (n, 20) of a track at other instants."""
    return _smooth(track.t_ns, track.points_m, track.confidence, t_ns, width_s / _NS)


@njit(cache=True)
def _smooth(
    t_track: Ints, points: Floats, confidence: Floats, t_ns: Ints, width_ns: float
) -> tuple[Floats, Floats, Floats]:
    """Fits local lines with a Gaussian kernel.

    Linear interpolation between two noisy frames halves the noise midway, which biases the offset towards half a frame.
    With a kernel as wide as a frame the noise is the same everywhere.
    """
    n, m = len(t_ns), points.shape[1]
    value, slope, weight = np.zeros((n, m, 3)), np.zeros((n, m, 3)), np.zeros((n, m))
    reach = 3.0 * width_ns
    y0, y1 = np.zeros(3), np.zeros(3)
    first = 0
    for i in range(n):
        while first < len(t_track) and t_track[first] < t_ns[i] - reach:
            first += 1
        for k in range(m):
            s0 = s1 = s2 = mass = 0.0
            y0[:], y1[:] = 0.0, 0.0
            j = first
            while j < len(t_track) and t_track[j] <= t_ns[i] + reach:
                x = (t_track[j] - t_ns[i]) / width_ns
                g = np.exp(-0.5 * x * x)
                w = g * confidence[j, k]
                s0, s1, s2, mass = s0 + w, s1 + w * x, s2 + w * x * x, mass + g
                for d in range(3):
                    y0[d] += w * points[j, k, d]
                    y1[d] += w * x * points[j, k, d]
                j += 1
            det = s0 * s2 - s1 * s1
            # A line needs frames on both sides of the instant: elsewhere it would extrapolate.
            if s0 < 1.0 or det < 0.25 * s0 * s0 or abs(s1) > 0.5 * s0:
                continue
            weight[i, k] = s0 / mass
            for d in range(3):
                value[i, k, d] = (s2 * y0[d] - s1 * y1[d]) / det
                slope[i, k, d] = (s0 * y1[d] - s1 * y0[d]) / det / (width_ns * 1e-9)
    return value, slope, weight


def _coarse_offset(
    t_ns: Ints, velocity_a: Floats, b: SkeletonTrack, width_s: float, search_s: float
) -> tuple[float, float]:
    """Returns the offset [s] with the highest correlation of the points' speeds, and that correlation."""
    speed_a = np.minimum(np.linalg.norm(velocity_a, axis=2), _SPEED_MAX)
    seen_a = speed_a > 0
    steps = int(np.ceil(search_s / width_s))
    best, best_s = 0.0, 0.0
    for step in sorted(range(-steps, steps + 1), key=abs):
        offset_s = step * width_s
        _, velocity_b, _ = _smoothed(b, t_ns + round(offset_s / _NS), width_s)
        speed_b = np.minimum(np.linalg.norm(velocity_b, axis=2), _SPEED_MAX)
        both = seen_a & (speed_b > 0)
        if both.sum() < 20 * len(POINTS):
            continue
        x, y = speed_a[both] - speed_a[both].mean(), speed_b[both] - speed_b[both].mean()
        likeness = float(x @ y / np.sqrt((x @ x) * (y @ y)))
        if likeness > best:
            best, best_s = likeness, offset_s
    return best_s, best


def _start(points_a: Floats, points_b: Floats, weight: Floats) -> Floats | None:
    """Returns the best alignment of single frames, judged by all frames: a trimmed, deterministic initial value."""
    rows = np.flatnonzero((weight > 0).sum(axis=1) >= 4)
    if not len(rows):
        return None
    judges = rows[:: max(1, len(rows) // 400)]
    seen = weight[judges] > 0
    best, T_best = np.inf, None
    for row in rows[np.linspace(0, len(rows) - 1, min(_STARTS, len(rows))).astype(int)]:
        use = weight[row] > 0
        T = kabsch(points_b[row, use], points_a[row, use], weight[row, use])
        apart = np.linalg.norm(points_a[judges] - transform(T, points_b[judges]), axis=2)[seen]
        cost = float(np.median(apart))
        if cost < best:
            best, T_best = cost, T
    return T_best


def _gauss_newton(
    T: Floats, points_a: Floats, points_b: Floats, velocity_a: Floats, weight: Floats
) -> tuple[Floats, Floats]:
    """Takes a step on T and the offset with Cauchy weights; returns the new T and the step (7,) [rad, m, s]."""
    there = transform(T, points_b)
    scale_m = max(float(np.median(np.linalg.norm(points_a - there, axis=2)[weight > 0])), 1e-6)
    flip = find_mirrored(points_a, there, weight, scale_m)
    mirror = list(MIRROR)
    there = np.where(flip[:, None, None], there[:, mirror], there)
    use = weight > 0
    p, w = there[use], weight[use]
    left = points_a[use] - p
    w = w / (1.0 + np.sum(left**2, axis=1) / (1.5 * scale_m) ** 2)
    middle = w @ p / w.sum()  # a rotation about the middle decouples rotation from translation
    x, y, z = (p - middle).T
    o = np.zeros_like(x)
    turn = np.stack([o, z, -y, -z, o, x, y, -x, o], axis=1).reshape(-1, 3, 3)  # columns e_k x p
    shift = np.broadcast_to(np.eye(3), turn.shape)
    # A larger offset takes a later instant of b: the point moves by its velocity.
    A = np.concatenate([turn, shift, velocity_a[use][:, :, None]], axis=2)
    AtW = (A * w[:, None, None]).reshape(-1, 7).T
    flat = A.reshape(-1, 7)
    step = np.linalg.lstsq(AtW @ flat, AtW @ left.reshape(-1), rcond=1e-12)[0]
    R = Rotation.from_rotvec(step[:3]).as_matrix()
    moved = rigid(R, middle + step[3:6] - R @ middle)
    return moved @ T, step
