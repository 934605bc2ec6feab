"""The residual against a plain implementation over the demo: lists of samples, exact weighted quantiles."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from hrcreplay.human.fusion.fuse import fuse, start
from hrcreplay.human.fusion.inverse_kinematics import inverse, measure
from hrcreplay.human.fusion.model_residual import LEAST
from hrcreplay.human.model import skeleton
from hrcreplay.logs.cleaning import PersonMemory, select_person
from hrcreplay.logs.reader import open_log
from hrcreplay.records import LIMBS, POINTS, CameraFrames, Floats, HumanStates, Ints, Measurements
from hrcreplay.settings.sections import Fusion
from hrcreplay.store.columns import read_states, state_columns
from tests.human.bent import RATE_HZ, WIDE, bent, fused, measured, predicted, ticks, used_frames

DEMO = Path(__file__).parents[3] / "datasets" / "demo.mcap"
POINTS_OF = {
    "HD": ("head",),
    "THX": ("pelvis", "shoulder_l", "shoulder_r"),
    "URA": ("shoulder_r", "elbow_r"),
    "LRA": ("elbow_r", "wrist_r"),
    "ULA": ("shoulder_l", "elbow_l"),
    "LLA": ("elbow_l", "wrist_l"),
}
TORSO = ("pelvis", "shoulder_l", "shoulder_r")


def index(names: tuple[str, ...]) -> list[int]:
    return [POINTS.index(name) for name in names]


@pytest.fixture(scope="module")
def demo() -> tuple[Measurements, Ints]:
    log = open_log(DEMO)
    poses, memory, parts = np.array([log.header.T_world_camera[c] for c in log.header.cameras]), PersonMemory(), []
    for chunk in log.frames():
        memory, mine, _ = select_person(chunk, memory, poses, 0.8, 2.0)
        parts.append(measure(chunk.rows(mine), poses, Fusion()))
    m = Measurements.join(parts)
    first = int(m.arrival_ns[0]) - 100_000_000
    return m, first + ticks((m.arrival_ns[-1] - first) * 1e-9)


def found_s(states: HumanStates, limb: int) -> float:
    """When the filter had first found all joints that carry a limb: when their errors fell for the first time."""
    arm = {2: [4, 5], 3: [4, 5, 6, 7], 4: [8, 9], 5: [8, 9, 10, 11]}.get(limb, [])
    known = np.isfinite(states.p_std[:, 0])
    first = states.p_std[known][0]
    unknown = np.array([0.5, 0.5, 1.5, 0.5, *(0.7, 0.7, 1.5, 0.7) * 2, 0.3])
    fell = [
        np.flatnonzero(known)[0] if first[j] < unknown[j] else np.flatnonzero(states.p_std[:, j] < unknown[j])[0]
        for j in [*range(4), *arm]
    ]
    return float(states.t_ns[max(fell)] * 1e-9)


#: Points whose place beside the model is learnt -> the limb that must be shown for it.
BESIDE = {"head": "HD", "shoulder_l": "THX", "shoulder_r": "THX"} | {
    f"{point}_{side}": f"{limb}{side.upper()}A" for side in "lr" for point, limb in (("elbow", "U"), ("wrist", "L"))
}


@dataclass
class Offset:
    """A running mean with the weight exp(-age / memory)."""

    mean: Floats = field(default_factory=lambda: np.zeros(3))
    weight: float = 0.0
    last_ns: int = 0

    def enter(self, beside: Floats, now_ns: int, settings: Fusion) -> None:
        age = min((now_ns - self.last_ns) * 1e-9, settings.memory_s)
        kept = self.weight * np.exp(-age / settings.offset_memory_s)
        self.mean = (kept * self.mean + beside) / (kept + 1.0)
        self.weight, self.last_ns = kept + 1.0, now_ns


@dataclass
class Samples:
    """All residuals of a limb with their ages, and the last that is larger than what is held."""

    sizes: Floats = field(default_factory=lambda: np.zeros(0))
    ages: Floats = field(default_factory=lambda: np.zeros(0))
    last_s: float = 0.0

    def enter(self, sample: float, now_s: float, settings: Fusion) -> None:
        self.ages = np.append(self.ages + min(now_s - self.last_s, settings.memory_s), 0.0)
        self.sizes, self.last_s = np.append(self.sizes, sample), now_s

    def quantile(self, settings: Fusion) -> float:
        weights, order = np.exp(-self.ages / settings.residual_memory_s), np.argsort(self.sizes)
        share = np.cumsum(weights[order]) / weights.sum()
        return float(self.sizes[order][np.searchsorted(share, settings.residual_quantile)])


@dataclass
class Shown:
    """Where each camera showed a point beside the model, (camera, point) -> offset [m] and capture [ns]."""

    places: dict[tuple[int, str], tuple[Floats, int]] = field(default_factory=dict)

    def off_m(self, camera: int, point: str, there: Floats, model: Floats, placed: Floats, now_ns: int) -> float:
        """From the line between the point as the filter has it and, up to 5 cm, as the camera showed it before."""
        last, capture_ns = self.places.get((camera, point), (model * np.nan, 0))
        along = model + last - placed
        apart = float(np.linalg.norm(along))
        if now_ns - capture_ns > 200_000_000 or not apart > 0.05:
            return float(np.linalg.norm(there - placed))
        unit = along / apart
        at = np.clip((there - placed) @ unit, 0.0, apart - 0.05)
        return float(np.linalg.norm(there - placed - at * unit))

    def enter(self, m: Measurements, i: int, model: Floats, settings: Fusion) -> None:
        for point in (*BESIDE, "pelvis"):
            k, key = POINTS.index(point), (int(m.camera[i]), point)
            newer = m.capture_ns[i] >= self.places.get(key, (None, 0))[1]
            if newer and m.confidence[i, k] >= settings.confidence_min and np.isfinite(m.points_m[i, k]).all():
                self.places[key] = (m.points_m[i, k] - model[k], int(m.capture_ns[i]))


def plain_residual(m: Measurements, states: HumanStates, prior: HumanStates, settings: Fusion) -> tuple[Floats, Floats]:
    """(n, 6) without a gate for outliers, and (n, 20, 3) where the points are: every sample kept, the quantile exact.

    The residual is the quantile, or a larger one that is held.
    """
    found, lately = np.full((len(states), 6), np.nan), np.zeros((len(states), 6))
    points, beside = skeleton(states.p, states.lengths_m), np.zeros((len(states), len(POINTS), 3))
    samples, offsets, by_camera = {limb: Samples() for limb in LIMBS}, {point: Offset() for point in BESIDE}, Shown()
    settled_s = {name: found_s(states, limb) + settings.memory_s for limb, name in enumerate(LIMBS)}
    torso = Rotation.from_euler("ZY", states.p[:, 2:4]).as_matrix()
    for k, i in used_frames(m, states.t_ns):
        now_s = float(states.t_ns[k]) * 1e-9
        d = min(max((states.t_ns[k] - m.capture_ns[i]) * 1e-9, 0.0), settings.delay_max_s)
        p = prior.p[k] - d * prior.v[k] + d**2 / 2 * prior.a[k] - d**3 / 6 * prior.j[k]
        model = skeleton(p[None], prior.lengths_m[k : k + 1])[0]
        turned = Rotation.from_euler("ZY", p[2:4]).as_matrix()
        placed = model.copy()
        for point, offset in offsets.items():
            placed[POINTS.index(point)] += turned @ offset.mean
        shown = []
        for limb, name in enumerate(LIMBS):
            ends, carrying = index(POINTS_OF[name]), [*TORSO, *POINTS_OF[name]]
            confident = m.confidence[i, index(tuple(dict.fromkeys(carrying)))].prod() >= settings.confidence_min
            if (
                now_s <= settled_s[name] + 1e-9
                or not confident
                or np.isnan(m.points_m[i, index(tuple(carrying))]).any()
            ):
                continue
            shown.append(name)
            sample = max(
                by_camera.off_m(int(m.camera[i]), POINTS[a], m.points_m[i, a], model[a], placed[a], int(states.t_ns[k]))
                for a in ends
            )
            samples[name].enter(sample, now_s, settings)
            if sample >= lately[k, limb]:  # nothing larger is held
                held = states.t_ns[k:] < states.t_ns[k] + round(settings.residual_hold_s * 1e9)
                lately[k:, limb] = np.where(held, sample, 0.0)
            if len(samples[name].sizes) >= LEAST:
                found[k:, limb] = samples[name].quantile(settings)
        for point, offset in offsets.items():
            if BESIDE[point] in shown:
                a = POINTS.index(point)
                offset.enter(turned.T @ (m.points_m[i, a] - model[a]), int(states.t_ns[k]), settings)
                beside[k:, a] = offset.mean
        by_camera.enter(m, i, model, settings)
    points += np.einsum("nij,nkj->nki", torso, beside)
    shoulders = points[:, index(("shoulder_l", "shoulder_r"))]
    points[:, POINTS.index("neck")] = shoulders.mean(axis=1)
    return np.where(np.isnan(found), np.nan, np.maximum(found, lately)), points


@pytest.mark.parametrize(("quantile", "memory_s", "hold_s"), [(0.95, 20.0, 0.0), (0.6, 1.0, 0.0), (0.6, 1.0, 0.15)])
def test_it_is_the_weighted_quantile_of_all_samples(
    demo: tuple[Measurements, Ints], quantile: float, memory_s: float, hold_s: float
) -> None:
    m, t = demo[0], demo[1][: 25 * RATE_HZ]
    m = m.rows(m.arrival_ns <= t[-1])
    settings = Fusion(
        outlier_m=1e6, bone_m=1e6, residual_quantile=quantile, residual_memory_s=memory_s, residual_hold_s=hold_s
    )
    states, prior = predicted(m, t, settings)
    expected, points = plain_residual(m, states, prior, settings)
    residual = states.residual_m[:, : len(LIMBS)]
    of_model = [*index(tuple(BESIDE)), *index(("pelvis", "neck"))]
    np.testing.assert_allclose(states.points_m[:, of_model], points[:, of_model], atol=1e-9)
    np.testing.assert_array_equal(np.isnan(residual), np.isnan(expected))
    known = np.isfinite(expected)
    assert known.mean() > 0.8
    above_mm = (residual[known] - expected[known]) * 1e3  # by the millimetre, rounded up
    assert above_mm.min() > -1e-6
    assert above_mm.max() <= 1.0 + 1e-6


def test_chunks_of_any_size_give_the_same_bits(demo: tuple[Measurements, Ints]) -> None:
    m, t = demo[0], demo[1][: 10 * RATE_HZ]
    whole = fused(m, t)
    for size in (1, 97):
        state, parts, last = start(m.cameras), [], -1
        for chunk in (t[i : i + size] for i in range(0, len(t), size)):
            mine = m.rows((m.arrival_ns > last) & (m.arrival_ns <= chunk[-1]))
            state, part, _, _ = fuse(state, chunk, mine, Fusion(), WIDE)
            parts.append(part)
            last = int(chunk[-1])
        joined = HumanStates.join(parts)
        np.testing.assert_array_equal(joined.residual_m, whole.residual_m)
        np.testing.assert_array_equal(joined.unseen_s, whole.unseen_s)
        np.testing.assert_array_equal(joined.points_m, whole.points_m)


def test_nine_of_ten_true_postures_are_within_it(demo: tuple[Measurements, Ints]) -> None:
    """The demo's worker is up to 89-113 mm (p95) from the model; half of it is known from where it was lately."""
    m, t = demo
    states = fused(m, t)
    truth = list(open_log(DEMO).truth())
    points = np.concatenate([part.points_m for part in truth])
    k = np.searchsorted(t, np.concatenate([part.t_ns for part in truth]))
    within = (k > 0) & (k < len(t))
    k = k[within]
    off = np.linalg.norm(states.points_m[k] - points[within], axis=2)
    plain = np.linalg.norm(skeleton(states.p[k], states.lengths_m[k]) - points[within], axis=2)
    for limb, name in enumerate(LIMBS):
        residual = states.residual_m[k, limb]
        known = np.isfinite(residual)
        farthest, from_model = (part[:, index(POINTS_OF[name])].max(axis=1)[known] for part in (off, plain))
        assert 0.04 < np.median(residual[known]) < 0.09
        assert np.median(farthest) < 0.8 * np.median(from_model)
        assert 0.85 < np.mean(farthest <= residual[known]) < 0.998


def test_a_body_unlike_the_model_is_where_cameras_show_it() -> None:
    frames = bent(4.0)
    states = fused(measured(frames), ticks(4.0))
    off = np.linalg.norm(skeleton(*inverse(frames.points_m[:1]))[0] - frames.points_m[0], axis=1)
    assert max(off[index(POINTS_OF[limb])].max() for limb in LIMBS) > 0.05
    shown = [*index(tuple(BESIDE)), POINTS.index("pelvis")]
    np.testing.assert_allclose(states.points_m[-1, shown], frames.points_m[0, shown], atol=2e-3)
    assert (states.residual_m[-1, : len(LIMBS)] <= 2e-3).all()


def test_it_is_not_known_before_enough_samples() -> None:
    frames = bent(2.0)
    states = fused(measured(frames), ticks(2.0))
    begin_ns = states.t_ns[np.searchsorted(states.t_ns, frames.arrival_ns[0])] + 500_000_000  # found, not lost again
    settled = np.searchsorted(states.t_ns[np.searchsorted(states.t_ns, frames.arrival_ns)], begin_ns, side="right")
    first = np.searchsorted(states.t_ns, frames.arrival_ns[settled + LEAST - 1])
    assert np.isnan(states.residual_m[:first]).all()
    assert np.isfinite(states.residual_m[first:, : len(LIMBS)]).all()


def test_what_no_camera_shows_has_no_residual_and_was_never_seen() -> None:
    frames = bent(2.0)
    points = frames.points_m.copy()
    points[:, POINTS.index("wrist_l")] = np.nan
    states = fused(measured(replace(frames, points_m=points)), ticks(2.0))
    hidden = np.array(LIMBS) == "LLA"
    residual = states.residual_m[:, : len(LIMBS)]
    assert np.isnan(residual[:, hidden]).all()
    unseen_s = states.unseen_s[:, : len(LIMBS)]
    assert np.isinf(unseen_s[:, hidden]).all()
    assert np.isfinite(residual[-1, ~hidden]).all()
    assert (unseen_s[-1, ~hidden] < 0.03).all()


@pytest.mark.parametrize(
    ("point", "hidden"),
    [
        ("elbow_r", {"URA", "LRA"}),
        ("wrist_l", {"LLA"}),
        ("pelvis", {"HD", "THX", "URA", "ULA"}),
        ("shoulder_l", {"HD", "THX", "URA", "ULA", "LLA"}),
    ],
)
def test_time_runs_from_the_last_frame_that_measured_the_limbs_own_joints(point: str, hidden: set[str]) -> None:
    frames = bent(3.0)
    confidence = frames.confidence.copy()
    confidence[frames.capture_ns >= 2_000_000_000, POINTS.index(point)] = 0.0
    states = fused(measured(replace(frames, confidence=confidence)), ticks(3.0))
    before, after = states.t_ns < 2_000_000_000, states.t_ns > 2_020_000_000
    assert (states.unseen_s[states.t_ns < frames.arrival_ns[0]] == np.inf).all()
    assert (states.unseen_s[before & (states.t_ns > frames.arrival_ns[0]), : len(LIMBS)] < 0.021).all()
    for limb, name in enumerate(LIMBS):
        if name in hidden:
            last = states.t_ns[np.searchsorted(states.t_ns, 1_981_000_000)]
            np.testing.assert_allclose(states.unseen_s[after, limb], (states.t_ns[after] - last) * 1e-9)
            assert len(np.unique(states.residual_m[after, limb])) == 1
        else:
            assert (states.unseen_s[after, limb] < 0.021).all()


def test_a_straight_arm_is_seen_although_its_rotation_is_not() -> None:
    frames = bent(2.0)
    points = frames.points_m.copy()
    shoulder, elbow, wrist = index(("shoulder_l", "elbow_l", "wrist_l"))
    points[:, wrist] = points[:, elbow] + 0.8 * (points[:, elbow] - points[:, shoulder])
    states = fused(measured(replace(frames, points_m=points)), ticks(2.0))
    assert (states.unseen_s[states.t_ns > frames.arrival_ns[0]][:, LIMBS.index("LLA")] < 0.021).all()
    assert np.isfinite(states.residual_m[-1, LIMBS.index("LLA")])


def test_an_outlier_is_no_sample() -> None:
    frames = bent(3.0)
    points, wrist = frames.points_m.copy(), POINTS.index("wrist_l")
    points[50::9, wrist] += [0.5, 0.0, 0.4]
    gross = measured(replace(frames, points_m=points))
    clean = fused(measured(frames), ticks(3.0)).residual_m[-1]
    np.testing.assert_allclose(fused(gross, ticks(3.0)).residual_m[-1], clean, atol=1.1e-3)
    no_gate = fused(gross, ticks(3.0), Fusion(outlier_m=1e6, bone_m=1e6)).residual_m[-1]
    assert no_gate[LIMBS.index("LLA")] > 0.3


def test_what_was_learnt_outlives_an_occlusion_and_fades_while_the_limb_is_seen() -> None:
    """Bent for 2 s, out of sight for 20 s, then like the model: what was learnt loses weight only from then on."""
    settings = Fusion(residual_memory_s=2.0)
    first, later = bent(2.0), bent(10.0)
    straight = skeleton(*inverse(first.points_m[:1]))
    later = replace(
        later,
        capture_ns=later.capture_ns + 22_000_000_000,
        arrival_ns=later.arrival_ns + 22_000_000_000,
        points_m=np.where(np.isfinite(later.points_m), straight, np.nan),
    )
    states = fused(measured(CameraFrames.join([first, later])), ticks(32.0), settings)
    elbow, limb = POINTS.index("elbow_r"), LIMBS.index("URA")
    off = np.linalg.norm(states.points_m - skeleton(states.p, states.lengths_m), axis=2)[:, elbow]
    learnt = off[2 * RATE_HZ]
    assert learnt > 0.05
    np.testing.assert_allclose(off[2 * RATE_HZ : 22 * RATE_HZ], learnt, atol=1e-6)
    assert states.residual_m[:, limb][23 * RATE_HZ] > 0.03  # another body than the one that was learnt
    assert off[-1] < 0.005
    assert states.residual_m[-1, limb] < 0.01
    kept = states.residual_m[2 * RATE_HZ : 22 * RATE_HZ, limb]
    assert (kept == kept[0]).all()


def test_the_table_gives_both_back_bit_for_bit(tmp_path: Path) -> None:
    frames = bent(1.0)
    points = frames.points_m.copy()
    points[:, POINTS.index("wrist_l")] = np.nan
    states = fused(measured(replace(frames, points_m=points)), ticks(1.0))
    pq.write_table(pa.table(state_columns(states)), tmp_path / "state.parquet")
    again = HumanStates.join(list(read_states(tmp_path / "state.parquet", 100)))
    for name in ("residual_m", "unseen_s", "points_m"):
        assert getattr(again, name).tobytes() == np.ascontiguousarray(getattr(states, name)).tobytes()
    assert np.isnan(states.residual_m).any()
    assert np.isinf(states.unseen_s).any()
