from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from scipy.linalg import block_diag

from hrcreplay.human.fusion.fuse import FusionState, fuse, start
from hrcreplay.human.fusion.inverse_kinematics import measure
from hrcreplay.human.model import skeleton
from hrcreplay.limits import load_limits
from hrcreplay.records import DOF, JOINTS, LENGTHS, POINTS, HumanStates
from hrcreplay.settings.sections import Fusion
from tests.human.filtered import FREE, PLAIN, WIDE, fused, standing, ticks, until
from tests.human.sightings import CAMERAS, LENGTHS_M, NEUTRAL, frames_of, random_measurements

#: p, v, a, j of every joint, and the lengths.
STATES = 4 * DOF + len(LENGTHS)


class Dense:
    """The filter of (42)-(57) over all states by filterpy, rows switched off in H."""

    def __init__(self, state: FusionState, settings: Fusion) -> None:
        self.settings = settings
        self.filter = KalmanFilter(STATES, 1)
        self.filter.x = np.concatenate([state.estimate.mean.T.ravel(), state.estimate.lengths])[:, None]
        P = np.zeros((STATES, STATES))
        for j in range(DOF):
            P[np.ix_(range(j, 4 * DOF, DOF), range(j, 4 * DOF, DOF))] = state.estimate.cov[j]
        P[4 * DOF :, 4 * DOF :] = np.diag(state.estimate.lengths_var)
        self.filter.P = P
        self.held: dict[int, dict[str, Any]] = {}

    def predict(self, dt: float) -> None:
        powers = [1.0, dt, dt**2 / 2, dt**3 / 6]
        F = np.kron(sum(np.eye(4, k=k) * powers[k] for k in range(4)), np.eye(DOF))
        place, angle = self.settings.sigma_position, self.settings.sigma_angle
        sigma = np.array([place] * 2 + [angle] * 10 + [self.settings.sigma_height])
        G = sigma.T**2 * np.array([dt**4 / 24, dt**3 / 6, dt**2 / 2, dt])[:, None]
        self.filter.predict(F=block_diag(F, np.eye(len(LENGTHS))), Q=np.diag([*G.ravel(), *np.zeros(len(LENGTHS))]))

    def update(self, now_ns: int, frames: list[dict[str, Any]]) -> None:
        for frame in frames:
            self.held[frame["camera"]] = frame | {"uses": 0}
        blocks, z, R = [], [], []
        for _, frame in sorted(self.held.items()):
            frame["uses"] += 1
            if frame["uses"] > 1 and self.settings.stale == "skip":
                continue
            d = (now_ns - frame["capture_ns"]) * 1e-9 if self.settings.delay == "compensate" else 0.0
            H = block_diag(np.kron([1.0, -d, d**2 / 2, -(d**3) / 6], np.eye(DOF)), np.eye(len(LENGTHS)))
            blocks.append(H[frame["valid"]])
            z.append(frame["z"][frame["valid"]])
            alike = np.repeat([1.0, 10.0], [DOF, len(LENGTHS)])  # frames whose errors of a length are alike
            R.append((frame["uses"] * alike * frame["std"] ** 2)[frame["valid"]])
        if blocks and len(np.concatenate(z)):
            H = np.vstack(blocks)
            self.filter.update(np.concatenate(z)[:, None], R=np.diag(np.concatenate(R)), H=H)


DEPENDS_ON = {
    "x": ["pelvis"],
    "y": ["pelvis"],
    "theta": ["shoulder_l", "shoulder_r"],
    "rho": ["pelvis", "shoulder_l", "shoulder_r"],
    "pelvis_height": ["pelvis"],
    "torso": ["pelvis", "shoulder_l", "shoulder_r"],
    "head": ["head", "shoulder_l", "shoulder_r"],
    "half_shoulder": ["shoulder_l", "shoulder_r"],
}


def rows_of_points() -> list[list[int]]:
    """The points that each row is computed from, written down once more."""
    torso = DEPENDS_ON["torso"]
    names = [DEPENDS_ON[j] for j in JOINTS[:4]]
    for side in "rl":
        arm = [f"shoulder_{side}", f"elbow_{side}", f"wrist_{side}"]
        names += [[*torso, arm[1]]] * 2 + [[*torso, *arm[1:]], arm]
    names += [DEPENDS_ON[k] for k in ("pelvis_height", "torso", "head", "half_shoulder")]
    names += [[f"{a}_{s}", f"{b}_{s}"] for a, b in (("shoulder", "elbow"), ("elbow", "wrist")) for s in "lr"]
    return [[POINTS.index(point) for point in row] for row in names]


@pytest.mark.parametrize("stale", ["skip", "reuse"])
@pytest.mark.parametrize("delay", ["compensate", "ignore"])
def test_it_is_the_dense_filter_over_the_whole_state(stale: Any, delay: Any) -> None:
    settings = PLAIN.model_copy(update={"stale": stale, "delay": delay, "delay_max_s": 10.0})
    m = random_measurements(150, seed=1)
    t = np.sort(np.random.default_rng(2).choice(ticks(2.0), 300, replace=False))
    first = int(np.searchsorted(t, m.arrival_ns[20]))
    state, _, _, _ = fuse(start(CAMERAS), t[:first], until(m, int(t[first - 1])), settings, FREE)
    dense = Dense(state, settings)
    z, std = m.z, m.z_std
    confident = np.stack([m.confidence[:, row].prod(axis=1) >= settings.confidence_min for row in rows_of_points()], 1)
    frames = [
        {"camera": int(m.camera[i]), "capture_ns": m.capture_ns[i], "arrival_ns": m.arrival_ns[i], "z": z[i]}
        | {"std": std[i], "valid": np.isfinite(z[i]) & confident[i]}
        for i in range(len(m))
    ]
    newest: dict[int, dict[str, Any]] = {}
    for frame in (f for f in frames if f["arrival_ns"] <= t[first - 1]):
        if frame["capture_ns"] >= newest.get(frame["camera"], frame)["capture_ns"]:
            newest[frame["camera"]] = frame
    dense.held = {c: f | {"uses": int(state.gate.uses[c])} for c, f in newest.items()}
    rest = m.rows(m.arrival_ns > t[first - 1])
    _, states, _, _ = fuse(state, t[first:], until(rest, int(t[-1])), settings, FREE)
    for k in range(first, len(t)):
        dense.predict((t[k] - t[k - 1]) * 1e-9)
        arrived: dict[int, dict[str, Any]] = {}
        for frame in (f for f in frames if t[k - 1] < f["arrival_ns"] <= t[k]):
            before = arrived.get(frame["camera"], dense.held.get(frame["camera"], frame))
            if frame["capture_ns"] >= before["capture_ns"]:
                arrived[frame["camera"]] = frame
        dense.update(int(t[k]), list(arrived.values()))
        x, P, i = dense.filter.x[:, 0], dense.filter.P, k - first
        for found, expected in zip((states.p, states.v, states.a, states.j), x[: 4 * DOF].reshape(4, DOF), strict=True):
            np.testing.assert_allclose(found[i], expected, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(states.p_std[i] ** 2, np.diag(P)[:DOF], rtol=1e-9)
        np.testing.assert_allclose(states.v_std[i] ** 2, np.diag(P)[DOF : 2 * DOF], rtol=1e-9)
        np.testing.assert_allclose(states.lengths_m[i], x[4 * DOF :], atol=1e-9)
        np.testing.assert_allclose(states.lengths_std_m[i] ** 2, np.diag(P)[4 * DOF :], rtol=1e-9)


@pytest.mark.parametrize("stale", ["skip", "reuse"])
def test_one_tick_at_a_time_gives_the_same_bits_as_all_at_once(stale: Any) -> None:
    settings, m, t = Fusion(stale=stale), random_measurements(120, seed=3, missing=0.5), ticks(1.5)
    _, whole, counts, _ = fuse(start(CAMERAS), t, until(m, int(t[-1])), settings, WIDE)
    for size in (1, 7):
        state, parts, total, last = start(CAMERAS), [], type(counts)(), -1
        for chunk in (t[i : i + size] for i in range(0, len(t), size)):
            mine = m.rows((m.arrival_ns > last) & (m.arrival_ns <= chunk[-1]))
            state, part, events, _ = fuse(state, chunk, mine, settings, WIDE)
            parts.append(part)
            total.update(events)
            last = int(chunk[-1])
        joined = HumanStates.join(parts)
        for name in ("p", "v", "a", "j", "p_std", "v_std", "lengths_m", "lengths_std_m", "valid"):
            np.testing.assert_array_equal(getattr(joined, name), getattr(whole, name))
        assert total == counts


def test_no_tick_uses_a_frame_that_was_still_on_the_wire() -> None:
    m = standing(0.5)
    states = fused(m, ticks(0.5), Fusion())
    assert not states.valid[states.t_ns < m.arrival_ns[0]].any()
    assert np.isnan(states.p[states.t_ns < m.arrival_ns[0]]).all()
    assert np.isfinite(states.p[states.t_ns >= m.arrival_ns[0]]).all()
    for c in (0, 1):
        expected = np.searchsorted(states.t_ns, m.arrival_ns[m.camera == c])
        np.testing.assert_array_equal(np.flatnonzero(states.valid[:, c]), expected[expected < len(states)])


def test_it_settles_on_a_person_who_stands_still_with_either_kind_of_delay() -> None:
    delay: Literal["compensate", "ignore"]
    for delay in ("compensate", "ignore"):
        states = fused(standing(2.0), ticks(2.0), Fusion(delay=delay))
        np.testing.assert_allclose(states.p[-1], NEUTRAL, atol=2e-3)
        np.testing.assert_allclose(states.v[-1], 0.0, atol=2e-2)
        np.testing.assert_allclose(states.lengths_m[-1], LENGTHS_M, atol=2e-3)


def test_a_compensated_delay_does_not_lag() -> None:
    """Heading at constant speed, frames 40 ms old: the lag is the delay when it is ignored, and none otherwise."""
    capture = (np.arange(0.0, 3.0, 0.02) * 1e9).astype(np.int64)
    p = np.tile(NEUTRAL, (len(capture), 1))
    p[:, 2] += 1.0 * capture * 1e-9
    frames = frames_of(skeleton(p, np.tile(LENGTHS_M, (len(p), 1))), capture * 0, capture, 40_000_000)
    m = measure(frames, np.tile(np.eye(4), (2, 1, 1)), Fusion(point_std_m=0.01))
    t = ticks(2.9)
    lags: tuple[tuple[Literal["compensate", "ignore"], float], ...] = (("compensate", 0.0), ("ignore", 0.04))
    for delay, lag in lags:
        states = fused(m, t, Fusion(delay=delay))
        late = NEUTRAL[2] + t[-100:] * 1e-9 - states.p[-100:, 2]
        np.testing.assert_allclose(late.mean(), lag, atol=0.012)


def test_heading_is_unwrapped_through_a_whole_turn() -> None:
    capture = (np.arange(0.0, 6.0, 0.03) * 1e9).astype(np.int64)
    p = np.tile(NEUTRAL, (len(capture), 1))
    p[:, 2] += 2.0 * capture * 1e-9
    frames = frames_of(skeleton(p, np.tile(LENGTHS_M, (len(p), 1))), capture * 0, capture)
    states = fused(measure(frames, np.tile(np.eye(4), (2, 1, 1)), Fusion(point_std_m=0.01)), ticks(5.9), Fusion())
    heading = states.p[250:, 2]
    assert np.abs(np.diff(heading)).max() < 0.1
    np.testing.assert_allclose(heading, NEUTRAL[2] + 2.0 * states.t_ns[250:] * 1e-9, atol=0.1)


def test_an_arm_crossing_the_chest_is_followed_although_its_angles_change_name() -> None:
    """alpha_1 from 20 to -60 degrees: the closed-form angles jump by pi on the way, the arm and its speed do not."""
    seconds = np.arange(0.0, 4.0, 0.03)
    p = np.tile(NEUTRAL, (len(seconds), 1))
    p[:, 8] = np.radians(20.0 - 80.0 * np.clip((seconds - 1.0) / 2.0, 0.0, 1.0))
    p[:, 9] = np.radians(55.0)
    capture = (seconds * 1e9).astype(np.int64)
    points = skeleton(p, np.tile(LENGTHS_M, (len(p), 1)))
    m = measure(frames_of(points, capture * 0, capture), np.tile(np.eye(4), (2, 1, 1)), Fusion(point_std_m=0.01))
    assert np.abs(np.diff(m.angles[:, 8])).max() > 3.0
    t = capture[40:]
    states = fused(m, t, Fusion())
    again = skeleton(states.p, states.lengths_m)
    hands = [POINTS.index("elbow_l"), POINTS.index("wrist_l")]
    assert np.linalg.norm(again - points[40:], axis=-1)[10:, hands].max() < 0.03
    assert np.abs(states.v[:, 8]).max() < 2.0


def test_frames_that_a_newer_one_overtook_are_counted() -> None:
    m = standing(1.0, cameras=(0,))
    t = ticks(1.0, rate_hz=10.0)
    _, _, counts, _ = fuse(start(CAMERAS), t, until(m, int(t[-1])), Fusion(), WIDE)
    used = len(np.unique(np.searchsorted(t, until(m, int(t[-1])).arrival_ns)))
    assert counts["superseded_frames_left"] == len(until(m, int(t[-1]))) - used


def test_the_state_obeys_the_limits_in_the_body_frame() -> None:
    """A fast walk diagonal to the world's axes, the filter saturated at Table 1."""
    capture = (np.arange(0.0, 3.0, 0.03) * 1e9).astype(np.int64)
    seconds = capture * 1e-9
    p = np.tile(NEUTRAL, (len(capture), 1))
    p[:, 2] = 0.7
    p[:, 0] += 2.0 * seconds * np.cos(0.7)
    p[:, 1] += 2.0 * seconds * np.sin(0.7)
    p[:, 9] += 1.5 * np.sin(4.0 * seconds)
    frames = frames_of(skeleton(p, np.tile(LENGTHS_M, (len(p), 1))), capture * 0, capture)
    m = measure(frames, np.tile(np.eye(4), (2, 1, 1)), Fusion(point_std_m=0.01))
    t = ticks(2.9)
    limits = load_limits("paper")
    _, states, counts, _ = fuse(start(CAMERAS), t, until(m, int(t[-1])), Fusion(), limits)
    assert counts["ticks_saturated"] > 100
    for rate, low, high in ((states.v, limits.v_min, limits.v_max), (states.a, limits.a_min, limits.a_max)):
        body = rate.copy()
        c, s = np.cos(states.p[:, 2]), np.sin(states.p[:, 2])
        body[:, 0], body[:, 1] = c * rate[:, 0] + s * rate[:, 1], c * rate[:, 1] - s * rate[:, 0]
        assert (body >= low - 1e-9).all()
        assert (body <= high + 1e-9).all()
    a1, a2 = np.degrees(states.p[:, 8]), np.degrees(states.p[:, 9])
    assert (a2 >= -43 + a1 / 3 - 1e-9).all()
    assert (a2 <= 153 - a1 / 6 + 1e-9).all()
    for j in (3, 5, 7, 9, 11):  # (63), (64): nor does a step lead out
        high = states.p[:-1, j] + np.diff(t) * 1e-9 * states.v[:-1, j]
        bound = 153 - np.degrees(states.p[:-1, j - 1]) / 6 if j in (5, 9) else np.degrees(limits.p_max[j])
        assert (np.degrees(high) <= bound + 1e-6).all()


def test_a_saturated_state_keeps_its_covariance() -> None:
    m, t = random_measurements(60, seed=6, missing=0.0), ticks(0.9)
    free = fused(m, t, PLAIN, FREE)
    held = fused(m, t, PLAIN, load_limits("paper"))
    assert np.nanmax(np.abs(free.v - held.v)) > 0.1
    np.testing.assert_array_equal(free.p_std, held.p_std)


def test_the_given_state_is_not_changed() -> None:
    state, m, t = start(CAMERAS), standing(0.3), ticks(0.3)
    before = [array.copy() for part in state for array in part]
    fuse(state, t, until(m, int(t[-1])), Fusion(), WIDE)
    for array, kept in zip((array for part in state for array in part), before, strict=True):
        np.testing.assert_array_equal(array, kept)
