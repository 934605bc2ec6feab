"""Motions of the model, integrated here by small steps, against the volumes of ``sound``."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from hrcreplay.geometry.convex_hull import CORNERS, DIRECTIONS, around, reach_turning, sphere_swept_volume_m3
from hrcreplay.human.model import HEIGHT, LimitSet, alpha_2_bounds, alpha_3_bounds, skeleton
from hrcreplay.human.prediction.joint_reach import rise
from hrcreplay.human.prediction.swept_volumes import limb_radii
from hrcreplay.limits import load_limits
from hrcreplay.records import BODY, DOF, JOINTS, LIMBS, Floats, HumanStates, SweptVolumes
from hrcreplay.settings.sections import Prediction
from tests.human.people import limb_points, random_states, states
from tests.human.predictions import predict, reachable

T = 0.377
PAPER, HUMAN = load_limits("paper"), load_limits("human")
BARE = Prediction(sigmas=0.0, hand_m=0.0, legs=False)
STEPS = 40


def volumes(people: HumanStates, limits: LimitSet = PAPER, margins: Prediction = BARE) -> SweptVolumes:
    return predict(people, limits, horizon_s=T, method="sound", margins=margins)


def uncertain(people: HumanStates, p_std: float, v_std: float, lengths_std_m: float) -> HumanStates:
    return dataclasses.replace(
        people,
        p_std=np.full_like(people.p, p_std) * np.where(np.arange(DOF) < 2, 0.3, 1.0),
        v_std=np.full_like(people.v, v_std),
        lengths_std_m=np.full_like(people.lengths_m, lengths_std_m),
    )


def stopped(p: Floats, limits: LimitSet) -> tuple[Floats, Floats]:
    """The stops of postures (n, 13): least and most, each (n, 13)."""
    least, most = np.tile(limits.p_min, (len(p), 1)), np.tile(limits.p_max, (len(p), 1))
    for i in range(len(p) if limits.coupled else 0):
        for a in (4, 8):
            a1 = min(max(p[i, a], least[i, a]), most[i, a])
            least[i, a + 1], most[i, a + 1] = alpha_2_bounds(a1, a1)
            a2 = min(max(p[i, a + 1], least[i, a + 1]), most[i, a + 1])
            least[i, a + 2], most[i, a + 2] = alpha_3_bounds(a1, a1, a2, a2)
    return least, most


def motions(
    rng: np.random.Generator, p: Floats, v: Floats, limits: LimitSet, count: int, sharp: bool
) -> list[tuple[Floats, Floats]]:
    """Postures (count, DOF) of random motions from one true state at some instants; v of x and y in the body's frame.

    Bang-bang with a switch, or accelerations all over. The integral of a piece is never more than the model allows:
    velocities are integrated by the trapezoid of what the bounds let through. Stops end what goes into them.
    """
    q, w = np.tile(p, (count, 1)), np.tile(v, (count, 1))
    first, second = (rng.choice([0.0, 1.0], (count, DOF)) if sharp else rng.random((count, DOF)) for _ in range(2))
    switch = rng.uniform(0, 1.2, (count, DOF))
    dt, seen = T / STEPS, [(q.copy(), w.copy())]
    for k in range(STEPS):
        share = np.where(k / STEPS < switch, first, second)
        a = limits.a_min + share * (limits.a_max - limits.a_min)
        after = np.clip(
            w + a * dt, np.minimum(limits.v_min, w + limits.a_max * dt), np.maximum(limits.v_max, w + limits.a_min * dt)
        )
        mean, w = 0.5 * (w + after), after
        turn = q[:, 2] + 0.5 * dt * mean[:, 2]
        q[:, 0] += dt * (np.cos(turn) * mean[:, 0] - np.sin(turn) * mean[:, 1])
        q[:, 1] += dt * (np.sin(turn) * mean[:, 0] + np.cos(turn) * mean[:, 1])
        q[:, 2:] += dt * mean[:, 2:]
        least, most = stopped(q, limits)
        held = q.copy()  # who starts beyond a stop gets no further out
        held[:, 3:] = np.clip(q, np.minimum(least, p), np.maximum(most, p))[:, 3:]
        w, q = np.where(held == q, w, 0.0), held
        if k % 8 == 7:
            seen.append((q.copy(), w.copy()))
    return seen


def worst(people: HumanStates, limits: LimitSet, margins: Prediction, seed: int, count: int = 120) -> tuple[float, str]:
    """How far any sampled motion is out of its volume [m], and which."""
    rng = np.random.default_rng(seed)
    swept = volumes(people, limits, margins)
    k, largest, where = margins.sigmas, -np.inf, ""
    for i in range(len(people)):
        solids = [ConvexHull(swept.vertices(i, limb)).equations for limb in range(len(LIMBS))]
        room = swept.radius_m[i] - np.append(limb_radii(Prediction()), np.zeros(len(swept.limbs) - 6))
        for sharp in (True, False):
            side = rng.choice([-1.0, 1.0], (3, DOF)) if sharp else rng.uniform(-1, 1, (3, DOF))
            p, v = people.p[i] + k * people.p_std[i] * side[0], people.v[i] + k * people.v_std[i] * side[1]
            c, s = np.cos(p[2]), np.sin(p[2])
            v[0], v[1] = c * v[0] + s * v[1], c * v[1] - s * v[0]
            lengths = people.lengths_m[i] + k * people.lengths_std_m[i] * side[2, :7]
            lengths[5:] += margins.hand_m
            for q, _ in motions(rng, p, v, limits, count, sharp):
                points = skeleton(q, np.tile(lengths, (count, 1)))
                for limb, name in enumerate(LIMBS):
                    reached = np.concatenate([limb_points(body, name) for body in points])
                    out = (reached @ solids[limb][:, :3].T + solids[limb][:, 3]).max() - room[limb]
                    if out > largest:
                        largest, where = out, f"row {i}, {name}, sharp {sharp}"
    return float(largest), where


@pytest.mark.parametrize("limits", [PAPER, HUMAN], ids=lambda limits: limits.name)
@pytest.mark.parametrize("std", [0.0, 0.1], ids=["known", "uncertain"])
def test_no_motion_leaves(limits: LimitSet, std: float) -> None:
    people = uncertain(random_states(limits, 40, 3), 0.5 * std, std, 0.05 * std)
    margins = BARE if std == 0.0 else Prediction(sigmas=2.0, legs=False)
    out, where = worst(people, limits, margins, 1)
    assert out <= 0.0, where


def test_paper_lets_motions_out_that_sound_holds() -> None:
    """The motions drawn here have teeth: the same ones leave the volumes of ``paper``."""
    people, rng = random_states(PAPER, 40, 3), np.random.default_rng(1)
    printed = predict(people, PAPER, horizon_s=T, method="paper")
    out = np.full(len(LIMBS), -np.inf)
    for i in range(len(people)):
        c, s = np.cos(people.p[i, 2]), np.sin(people.p[i, 2])
        v = people.v[i].copy()
        v[0], v[1] = c * v[0] + s * v[1], c * v[1] - s * v[0]
        q, _ = motions(rng, people.p[i], v, PAPER, 60, True)[-1]
        points = skeleton(q, np.tile(people.lengths_m[i], (60, 1)))
        for limb, name in enumerate(LIMBS):
            solid = ConvexHull(printed.vertices(i, limb)).equations
            reached = np.concatenate([limb_points(body, name) for body in points])
            out[limb] = max(out[limb], (reached @ solid[:, :3].T + solid[:, 3]).max())
    assert (out > 0.003).all()


def test_it_is_hardly_larger_than_paper() -> None:
    people = random_states(PAPER, 60, 15)
    totals = []
    for method in ("paper", "sound"):
        swept = predict(people, PAPER, horizon_s=T, method=method, margins=BARE)
        totals.append(
            [
                sum(sphere_swept_volume_m3(swept.vertices(i, k), swept.radius_m[i, k]) for k in range(len(LIMBS)))
                for i in range(len(people))
            ]
        )
    assert np.mean(np.array(totals[1]) / totals[0]) < 1.3


def test_an_excursion_peaks_where_a_simulated_joint_does() -> None:
    rng = np.random.default_rng(4)
    for _ in range(300):
        v, top = rng.uniform(-3, 3), rng.uniform(-1, 2)
        gain, brake = rng.uniform(0, 8), -rng.uniform(0, 8)
        t = np.linspace(0, T, 20_001)
        profile = np.minimum(v + gain * t, top) if v <= top else np.maximum(v + brake * t, top)
        travelled = np.concatenate([[0.0], np.cumsum(0.5 * (profile[1:] + profile[:-1])) * (t[1] - t[0])])
        assert rise(v, top, gain, brake, T) == pytest.approx(travelled.max(), abs=1e-6)


def test_a_joint_faster_than_its_bound_comes_back_at_its_bound() -> None:
    j, p, v = JOINTS.index("rho"), np.zeros((1, DOF)), np.zeros((1, DOF))
    v[0, j] = PAPER.v_max[j] + 0.1
    reach = reachable(states(p, v), PAPER, T, "sound", BARE)
    assert reach.high[0, j] == pytest.approx((PAPER.v_max[j] + 0.1) * T + 0.5 * PAPER.a_min[j] * T**2)


def test_stops_hold_and_a_posture_beyond_one_stays_inside() -> None:
    j, p, v = JOINTS.index("ar1"), np.zeros((2, DOF)), np.zeros((2, DOF))
    p[:, j], v[:, j] = (PAPER.p_max[j] - 0.01, PAPER.p_max[j] + 0.2), (1.0, 0.0)
    reach = reachable(states(p, v), PAPER, T, "sound", BARE)
    assert reach.high[:, j].tolist() == [PAPER.p_max[j], p[1, j]]


def test_a_walker_who_turns_stays_in_the_polygon() -> None:
    """By fine integration: heading, speed and sidestep each at their own bounds, in world axes."""
    rng = np.random.default_rng(6)
    people = random_states(PAPER, 40, 6)
    reach = reachable(people, PAPER, T, "sound", BARE)
    dt = T / 4000
    for i in range(len(people)):
        c, s = np.cos(people.p[i, 2]), np.sin(people.p[i, 2])
        v = np.array([[c, s], [-s, c]]) @ people.v[i, :2]
        body = np.tile([v[0], v[1], people.v[i, 2]], (16, 1))
        a = np.where(rng.random((16, 3)) < 0.5, PAPER.a_min[:3], PAPER.a_max[:3])
        q = np.tile(people.p[i, :3], (16, 1))
        for _ in range(4000):
            after = np.clip(body + a * dt, PAPER.v_min[:3], PAPER.v_max[:3])
            mean, body = 0.5 * (body + after), after
            turn = q[:, 2] + 0.5 * dt * mean[:, 2]
            q[:, 0] += dt * (np.cos(turn) * mean[:, 0] - np.sin(turn) * mean[:, 1])
            q[:, 1] += dt * (np.sin(turn) * mean[:, 0] + np.cos(turn) * mean[:, 1])
            q[:, 2] += dt * mean[:, 2]
        assert (q >= reach.low[i, :3] - 1e-9).all()
        assert (q <= reach.high[i, :3] + 1e-9).all()


def test_a_polytope_holds_every_turned_point() -> None:
    rng = np.random.default_rng(7)
    for axis in range(3):
        for low, high in ((0.0, 0.0), (-0.3, 0.4), (-1.0, 2.6), (0.0, 7.0)):
            points, far = rng.normal(size=(12, 3)), np.full(len(DIRECTIONS), -np.inf)
            reach_turning(points, len(points), axis, low, high, far)
            corners = np.empty((CORNERS, 3))
            solid = ConvexHull(corners[: around(far, corners)]).equations
            turning = Rotation.from_euler("xyz"[axis], np.linspace(low, high, 500)[:, None])
            reached = np.concatenate([turning.apply(point) for point in points])
            assert (reached @ solid[:, :3].T + solid[:, 3]).max() <= 1e-12
            assert (reached @ DIRECTIONS.T).max(axis=0) == pytest.approx(far, abs=1e-4)


def test_unknown_lengths_are_in_the_volumes() -> None:
    people = uncertain(random_states(PAPER, 30, 9), 0.0, 0.0, 0.01)
    margins = Prediction(sigmas=3.0, legs=False)
    out, where = worst(people, PAPER, margins, 5)
    assert out <= 0.0, where
    assert volumes(people, PAPER, margins).radius_m[0, LIMBS.index("URA")] == pytest.approx(0.07 + np.hypot(0.03, 0.03))
    assert volumes(people, PAPER, margins).radius_m[0, LIMBS.index("HD")] == pytest.approx(0.12)


def test_a_limb_out_of_sight_grows_to_all_that_it_can_reach() -> None:
    people = random_states(PAPER, 5, 10)
    unseen = np.zeros((5, len(BODY)))
    unseen[:, LIMBS.index("LLA")] = (0.0, 0.5, 0.6, 3.0, np.inf)
    same = people.rows(np.zeros(5, dtype=np.int64))
    reach = reachable(dataclasses.replace(same, unseen_s=unseen), PAPER, T, "sound", BARE)
    elbow = JOINTS.index("al4")
    width = reach.high[:, elbow] - reach.low[:, elbow]
    assert width[0] == width[1] < width[2] < width[4] == pytest.approx(PAPER.p_max[elbow] - PAPER.p_min[elbow])
    assert width[3] == pytest.approx(width[4])
    others = [j for j in range(DOF) if JOINTS[j] not in ("al3", "al4")]
    assert (reach.low[:, others] == reach.low[0, others]).all()
    swept = volumes(dataclasses.replace(same, unseen_s=unseen))
    sizes = [sphere_swept_volume_m3(swept.vertices(i, LIMBS.index("LLA")), 0.07) for i in range(5)]
    assert sizes[0] == sizes[1] < sizes[2] < sizes[3]


def test_an_arm_never_seen_needs_no_state_but_its_lengths() -> None:
    people = random_states(PAPER, 1, 11)
    p, unseen = people.p.copy(), np.zeros((1, len(BODY)))
    p[0, 8:12] = np.nan
    blind = dataclasses.replace(people, p=p)
    assert np.isnan(volumes(blind).vertices(0, LIMBS.index("LLA"))).all()
    unseen[0, [LIMBS.index("ULA"), LIMBS.index("LLA")]] = np.inf
    assert np.isfinite(volumes(dataclasses.replace(blind, unseen_s=unseen)).vertices_m).all()


def test_a_person_out_of_sight_may_have_walked_anywhere() -> None:
    people = random_states(PAPER, 1, 12)
    away = dataclasses.replace(people, unseen_s=np.full((1, len(BODY)), 2.0))
    near, far = (reachable(someone, PAPER, T, "sound", BARE) for someone in (people, away))
    assert (far.high[0, :2] - far.low[0, :2] > near.high[0, :2] - near.low[0, :2] + 0.8 * 2.0).all()


def test_residual_hand_and_legs() -> None:
    people = random_states(PAPER, 2, 13)
    residual = np.array([[np.nan] * 7, [*[0.05] * 6, np.nan]])
    people = dataclasses.replace(people, residual_m=residual)
    swept = volumes(people, PAPER, Prediction(sigmas=0.0))
    assert swept.limbs == (*LIMBS, "LEGS")
    assert swept.radius_m[:, -1] == pytest.approx([0.20 + 0.10, 0.20 + 0.05])  # not known yet: that of most people
    assert swept.radius_m[0, :-1] - swept.radius_m[1, :-1] == pytest.approx(0.05)
    assert volumes(people, PAPER, BARE.model_copy(update={"residual": False})).radius_m[1] == pytest.approx(
        limb_radii(Prediction())
    )
    legs = swept.vertices(0, len(LIMBS))
    assert (legs[:, 2].min(), legs[:, 2].max()) == (0.0, people.p[0, HEIGHT])
    assert (legs[:, :2].min(axis=0) <= people.p[0, :2]).all()
    assert (legs[:, :2].max(axis=0) >= people.p[0, :2]).all()


def test_a_low_pelvis_puts_the_knees_further_out() -> None:
    """Knees of two bones of 0.47 m between the pelvis and a foot under it, all around, and a thigh of 8 cm."""
    p = np.tile(random_states(PAPER, 1, 15).p, (4, 1))
    p[:, HEIGHT] = (0.94, 0.7, 0.5, 0.3)
    swept = volumes(states(p, np.zeros_like(p)), margins=Prediction(sigmas=0.0, residual=False))
    for i, height in enumerate(p[:, HEIGHT]):
        solid = ConvexHull(swept.vertices(i, 6)).equations
        knee = np.sqrt(0.47**2 - 0.25 * height**2)
        around = np.linspace(0.0, 2.0 * np.pi, 50)
        for at in (0.1, 0.5 * height):
            knees = np.column_stack([p[i, 0] + knee * np.cos(around), p[i, 1] + knee * np.sin(around), np.full(50, at)])
            out = knees @ solid[:, :3].T + solid[:, 3]
            assert out.max() <= swept.radius_m[i, 6] - 0.08 + 1e-9
            assert out.max() > -0.05 or height == 0.94  # and not much more


def test_legs_are_as_wide_as_they_were_seen() -> None:
    """A thigh is 8 cm thick on each side of what was seen; legs near the line take nothing away."""
    seen_m = np.array([np.nan, 0.0, 0.11, 0.25, 0.45, 0.45])
    thorax_m = np.array([0.07, 0.07, 0.07, 0.07, np.nan, 0.30])
    people = random_states(PAPER, len(seen_m), 14)
    residual = np.full((len(seen_m), 7), 0.02)
    residual[:, 1], residual[:, 6] = thorax_m, seen_m
    people = dataclasses.replace(people, residual_m=residual)
    swept = volumes(people, PAPER, BARE.model_copy(update={"legs": True}))
    assert swept.radius_m[:, 6] == pytest.approx([0.27, 0.27, 0.27, 0.33, 0.53, 0.53])
    wide = BARE.model_copy(update={"legs": True, "legs_radius_m": 0.3})
    assert volumes(people, PAPER, wide).radius_m[:, 6] == pytest.approx([0.37, 0.37, 0.37, 0.37, 0.53, 0.60])
    deaf = BARE.model_copy(update={"legs": True, "residual": False})
    assert volumes(people, PAPER, deaf).radius_m[:, 6] == pytest.approx(0.20)
    assert volumes(people).radius_m == pytest.approx(swept.radius_m[:, :6])  # no lower body, and no other limb's radius


def test_one_tick_has_the_bits_of_many() -> None:
    people = uncertain(random_states(HUMAN, 20, 16), 0.05, 0.3, 0.004)
    whole = volumes(people, HUMAN, Prediction(sigmas=3.0))
    alone = [volumes(people.rows(slice(i, i + 1)), HUMAN, Prediction(sigmas=3.0)) for i in range(len(people))]
    assert np.concatenate([tick.vertices_m for tick in alone]).tobytes() == whole.vertices_m.tobytes()
    assert len(volumes(people.rows(slice(0, 0)))) == 0
