"""Tubes against a plain implementation: whoever keeps to the departures is inside, and the tube is no larger."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import nnls

from hrcreplay.human.model import Departure, LimitSet, skeleton
from hrcreplay.human.prediction.swept_volumes import predict
from hrcreplay.human.prediction.velocity_tube import NOISE_M
from hrcreplay.limits import load_limits
from hrcreplay.records import BODY, LENGTHS, LIMBS, POINTS, Floats, HumanStates, SweptVolumes
from hrcreplay.settings.sections import Fusion, Prediction
from tests.human.people import random_states

PEOPLE = load_limits("people")
MEMORY_S, HAND_M = Fusion().memory_s, Prediction().hand_m
FLESH_M = dict(zip(BODY, (0.12, 0.15, 0.07, 0.07, 0.07, 0.07, 0.08), strict=True))
ENDS = {
    "HD": ("neck", "head"),
    "THX": ("pelvis", "shoulder_r", "shoulder_l"),
    "URA": ("shoulder_r", "elbow_r"),
    "LRA": ("elbow_r", "wrist_r"),
    "ULA": ("shoulder_l", "elbow_l"),
    "LLA": ("elbow_l", "wrist_l"),
}
LEGS = tuple(f"{part}_{side}" for part in ("hip", "knee", "ankle", "foot") for side in "lr")


def people(count: int, seed: int) -> HumanStates:
    """Of any posture, beside the model, with bent hands, legs that are shown, residuals, and cameras that disagree."""
    rng, states = np.random.default_rng(seed), random_states(PEOPLE, count, seed)
    points = states.points_m + rng.normal(0.0, 0.05, states.points_m.shape)
    for side in "rl":
        bent = rng.normal(size=(count, 3))
        bent *= 0.08 / np.linalg.norm(bent, axis=1)[:, None]
        points[:, POINTS.index(f"hand_{side}")] = points[:, POINTS.index(f"wrist_{side}")] + bent
    for name in LEGS:
        points[:, POINTS.index(name)] = points[:, 0] + rng.uniform(-0.4, 0.4, (count, 3)) - [0.0, 0.0, 0.4]
    cameras = np.where(rng.random((count, 2, len(POINTS), 1)) < 0.6, np.nan, points[:, None])
    cameras = cameras + rng.normal(0.0, 0.2, cameras.shape)
    residual, sway = rng.uniform(0.0, 0.4, (count, len(BODY))), rng.uniform(0.0, 0.04, count)
    return replace(states, points_m=points, camera_points_m=cameras, residual_m=residual, legs_sway_m=sway)


def residual_of(states: HumanStates, tick: int, limb: str, late_s: float = 0.0) -> float:
    """What the departures of a limb are multiples of: of shown legs their sway, which rises when it is not seen [m]."""
    if limb != "LEGS":
        return float(states.residual_m[tick, BODY.index(limb)])
    assert states.legs_sway_m is not None
    return float(np.clip(states.legs_sway_m[tick] + 5.0 * 0.025 * late_s, 0.008, 0.03))


def velocities(states: HumanStates, tick: int) -> dict[str, Floats]:
    """Of the model's points [m/s]."""
    step, at = 1e-5, states.rows(slice(tick, tick + 1))
    later, earlier = (skeleton(at.p + sign * step * at.v, at.lengths_m)[0] for sign in (1.0, -1.0))
    return {name: (later[k] - earlier[k]) / (2.0 * step) for k, name in enumerate(POINTS)}


def looks(states: HumanStates, tick: int, names: tuple[str, ...]) -> list[dict[str, Floats]]:
    """The fused places of the points, then those of each camera that shows any of some elsewhere [m]."""
    fused = {name: states.points_m[tick, k] for k, name in enumerate(POINTS)}
    found = [fused]
    for camera in [] if states.camera_points_m is None else states.camera_points_m[tick]:
        there = {name: camera[POINTS.index(name)] for name in names if np.isfinite(camera[POINTS.index(name)]).all()}
        if there:
            found.append({**fused, **there})
    return found


def ends(states: HumanStates, tick: int, limb: str, departure: Departure, horizon_s: float) -> Floats:
    """(k, 3) the limb's ends now and where they are carried, as high and as low as the body may be."""
    speed = velocities(states, tick)
    carried = 0.15 if "A" in limb else 0.25
    carried = min(horizon_s, carried + max(0.0, horizon_s - 0.377))
    hand = f"hand_{limb[1].lower()}"
    names = {"LEGS": ("pelvis", *LEGS)}.get(limb, ENDS.get(limb, ()) + ((hand,) if limb in ("LRA", "LLA") else ()))
    still, rising = [], []
    for place in looks(states, tick, names):
        if limb == "LEGS":
            over = speed["pelvis"] * [1.0, 1.0, 0.0]
            rising += [place["pelvis"], place["pelvis"] + carried * speed["pelvis"]]
            for name in LEGS:  # one stood since the frame 70 ms ago, the other one swings
                still += [place[name] - 0.07 * over, place[name] + 2.0 * (carried + 0.07) * over]
            continue
        now, going = [place[name] for name in ENDS[limb]], [speed[name] for name in ENDS[limb]]
        if limb in ("LRA", "LLA"):
            elbow, wrist = now
            turning = going[1] + (going[1] - going[0]) * HAND_M / np.linalg.norm(wrist - elbow)
            for along in (wrist - elbow, place[hand] - wrist):
                now.append(wrist + HAND_M * along / np.linalg.norm(along))
                going.append(turning)
        rising += now + [p + v * carried for p, v in zip(now, going, strict=True)]
    rise, sink = (at_horizon(departure, row, horizon_s) for row in (departure.rise_m, departure.sink_m))
    rise, sink = (min(by, 0.06 if "A" in limb else by) for by in (rise, sink))
    high, low = ([p + np.array([0.0, 0.0, by]) for p in rising] for by in (rise, -sink))
    return np.array(still + rising + high + low)


def at_horizon(departure: Departure, row: Floats, horizon_s: float) -> float:
    long = departure.horizon_s
    if horizon_s > long[-1]:
        return float(row[-1] + max(0.0, row[-1] - row[-2]) / (long[-1] - long[-2]) * (horizon_s - long[-1]))
    return float(np.interp(horizon_s, long, row))


def allowed_m(departure: Departure, limb: str, horizon_s: float, residual_m: float, speed: float) -> float:
    k = BODY.index(limb)
    assert departure.swings_s is not None
    beyond, swings = (at_horizon(departure, row[k], horizon_s) for row in (departure.beyond_m, departure.swings_s))
    times = np.interp(horizon_s, departure.horizon_s, departure.residuals[k])
    now = times * min(residual_m, NOISE_M) + max(residual_m - NOISE_M, 0.0)
    return float(max(residual_m, now + beyond + min(speed, 1.0) * swings))


def speed_of(states: HumanStates, tick: int, limb: str) -> float:
    """Of the fastest end of a limb, of legs that of the pelvis [m/s]."""
    found = velocities(states, tick)
    return max(float(np.linalg.norm(found[name])) for name in ENDS.get(limb, ("pelvis",)))


def distance_m(point: Floats, vertices: Floats) -> float:
    """Of a point from a hull, by non-negative least squares over the weights of its corners."""
    heavy = 1e4
    system = np.vstack([(vertices - point).T, np.full(len(vertices), heavy)])
    weights, _ = nnls(system, np.array([0.0, 0.0, 0.0, heavy]), maxiter=10_000)
    return float(np.linalg.norm(weights @ vertices / weights.sum() - point))


@pytest.mark.parametrize("horizon_s", [0.02, 0.05, 0.14, 0.377, 0.6])
def test_who_keeps_to_the_departures_is_inside_and_nobody_much_further(horizon_s: float) -> None:
    """500 places a limb, in the hull and as far from it as is allowed; and 1 mm further they are outside."""
    states, rng = people(10, seed=3), np.random.default_rng(4)
    volumes = predict(states, PEOPLE, Prediction(), horizon_s=horizon_s, memory_s=MEMORY_S)
    assert PEOPLE.departure is not None
    assert volumes.limbs == BODY
    for tick in range(len(states)):
        for k, limb in enumerate(BODY):
            base = ends(states, tick, limb, PEOPLE.departure, horizon_s)
            residual = residual_of(states, tick, limb)
            reach = allowed_m(PEOPLE.departure, limb, horizon_s, residual, speed_of(states, tick, limb))
            radius = volumes.radius_m[tick, k] - FLESH_M[limb]
            assert radius == pytest.approx(reach, abs=2e-9)
            out = rng.normal(size=(50, 3))
            out /= np.linalg.norm(out, axis=1)[:, None]
            farthest = base[(base @ out.T).argmax(axis=0)]
            for direction, end in zip(out, farthest, strict=True):
                assert distance_m(end + reach * direction, volumes.vertices(tick, k)) <= radius + 1e-5
                assert distance_m(end + (reach + 1e-3) * direction, volumes.vertices(tick, k)) > radius
            mixed = rng.dirichlet(np.full(len(base), 0.5), 10) @ base
            assert max(distance_m(point, volumes.vertices(tick, k)) for point in mixed) < 1e-5


def test_a_limb_may_be_where_the_residual_says_whatever_the_departures() -> None:
    states = people(8, seed=12)
    nothing = Departure(np.array([0.1]), *np.zeros((2, len(BODY), 1)), *np.zeros((2, 1)))
    volumes = predict(states, replace(PEOPLE, departure=nothing), Prediction(), horizon_s=0.1, memory_s=MEMORY_S)
    for k, limb in enumerate(LIMBS):
        np.testing.assert_allclose(volumes.radius_m[:, k], FLESH_M[limb] + states.residual_m[:, k], atol=2e-9)


def test_until_the_residual_is_known_the_errors_of_the_lengths_up_to_a_limb_count() -> None:
    """Each limb's near end with the lengths wrong by two standard deviations, in every combination of signs."""
    near = {"URA": "shoulder_r", "LRA": "elbow_r", "ULA": "shoulder_l", "LLA": "elbow_l"}
    states, unknown_m = people(6, seed=5), Prediction().residual_unknown_m
    std_m = np.random.default_rng(6).uniform(0.01, 0.06, states.lengths_m.shape)
    states = replace(states, residual_m=np.full_like(states.residual_m, np.nan), lengths_std_m=std_m)
    nothing = Departure(np.array([0.1]), *np.zeros((2, len(BODY), 1)), *np.zeros((2, 1)))
    volumes = predict(states, replace(PEOPLE, departure=nothing), Prediction(), horizon_s=0.1, memory_s=MEMORY_S)
    signs = np.array(np.meshgrid(*[(-2.0, 2.0)] * std_m.shape[1])).reshape(std_m.shape[1], -1).T
    for tick in range(len(states)):
        p = np.tile(states.p[tick], (len(signs), 1))
        plain = skeleton(p[:1], states.lengths_m[tick : tick + 1])[0]
        wrong = np.linalg.norm(skeleton(p, states.lengths_m[tick] + signs * std_m[tick]) - plain, axis=2).max(axis=0)
        for k, limb in enumerate(LIMBS):
            off_m = wrong[POINTS.index(near[limb])] if limb in near else 0.0
            off = volumes.radius_m[tick, k] - FLESH_M[limb]
            assert off >= max(unknown_m, off_m) - 1e-9
            assert off <= max(unknown_m, 1.5 * off_m) + 2e-9
        legs_m = volumes.radius_m[tick, BODY.index("LEGS")]
        assert legs_m == pytest.approx(FLESH_M["LEGS"] + unknown_m + residual_of(states, tick, "LEGS"), abs=2e-9)


def test_legs_whose_sway_nobody_knows_go_as_far_as_those_of_who_walks() -> None:
    states, k = people(4, seed=13), BODY.index("LEGS")
    swaying = (np.full(len(states), 0.5), np.full(len(states), np.nan), None)
    of = [replace(states, legs_sway_m=sway) for sway in swaying]
    most, *unknown = (predict(s, PEOPLE, Prediction(), horizon_s=0.1, memory_s=MEMORY_S).radius_m[:, k] for s in of)
    for radius_m in unknown:
        np.testing.assert_array_equal(radius_m, most)


def test_legs_go_as_far_without_distances_from_the_model() -> None:
    """Their sway is a motion, no distance from the model: ``prediction.residual = false`` does not leave it out."""
    states, k = people(4, seed=13), BODY.index("LEGS")
    with_them, without_them = (
        predict(states, PEOPLE, Prediction(residual=residual), horizon_s=0.1, memory_s=MEMORY_S)
        for residual in (True, False)
    )
    np.testing.assert_array_equal(with_them.radius_m[:, k], without_them.radius_m[:, k])
    assert (with_them.radius_m[:, :k] > without_them.radius_m[:, :k]).all()


@pytest.mark.parametrize("pelvis_m", [0.94, 0.6])
def test_legs_of_somebody_new_may_be_anywhere_from_below_to_stretched_ahead(pelvis_m: float) -> None:
    """A tracker puts legs that it does not see below the pelvis; then it finds them ahead of somebody who sits."""
    states = people(6, seed=5)
    points = states.points_m + [0.0, 0.0, 1.0] * (pelvis_m - states.points_m[:, :1])
    points[:, [POINTS.index(name) for name in LEGS]] = points[:, :1]  # they say nothing of where the legs are
    states = replace(states, v=np.zeros_like(states.v), points_m=points, camera_points_m=None)
    new = replace(states, residual_m=np.full_like(states.residual_m, np.nan))
    known, unknown = (predict(of, PEOPLE, Prediction(), horizon_s=0.1, memory_s=MEMORY_S) for of in (states, new))
    k = BODY.index("LEGS")
    for tick in range(len(states)):
        pelvis, right, left = (points[tick, POINTS.index(name)] for name in ("pelvis", "shoulder_r", "shoulder_l"))
        across = (left - right)[:2] / np.linalg.norm((left - right)[:2])
        stretched = np.sqrt(max(0.0, 0.94**2 - pelvis_m**2)) * np.array([across[1], -across[0], 0.0])
        below = pelvis * [1.0, 1.0, 0.0]
        for share in (0.0, 0.5, 1.0):
            for height in (0.0, 0.5, 1.0):
                place = below + share * stretched + height * (pelvis - below)
                assert distance_m(place, unknown.vertices(tick, k)) < 1e-5
        if pelvis_m < 0.9:
            assert distance_m(pelvis + stretched, known.vertices(tick, k)) > 0.1
        assert unknown.radius_m[tick, k] == pytest.approx(known.radius_m[tick, k] + 0.1, abs=2e-9)


def without(limits: LimitSet) -> LimitSet:
    return replace(limits, departure=None)


def blind(states: HumanStates, *limbs: str) -> HumanStates:
    """The same, with limbs that no camera has shown for so long that the filter has forgotten them."""
    unseen = states.unseen_s.copy()
    for limb in limbs:
        unseen[:, BODY.index(limb)] = MEMORY_S + 0.1
    return replace(states, unseen_s=unseen, camera_points_m=None)  # otherwise what they show bounds the limb


def box_m3(volumes: SweptVolumes, tick: int, limb: str) -> float:
    points, radius = volumes.vertices(tick, BODY.index(limb)), volumes.radius_m[tick, BODY.index(limb)]
    return float(np.prod(np.ptp(points, axis=0) + 2.0 * radius))


@pytest.mark.parametrize("horizon_s", [0.02, 0.1, 0.377])
def test_no_arm_out_of_sight_is_further_than_its_length_from_what_carries_it(horizon_s: float) -> None:
    """500 of them, at any angle, with the hand, from any place that the bounds allow for what carries them."""
    states, rng = people(5, seed=6), np.random.default_rng(7)
    states = replace(states, lengths_std_m=np.full((5, len(LENGTHS)), 0.01), camera_points_m=None)
    seen = predict(states, PEOPLE, Prediction(), horizon_s=horizon_s, memory_s=MEMORY_S)
    for hidden, carrier, bones in (
        (("LRA",), "URA", ("pi_forearm_r",)),
        (("ULA", "LLA"), "THX", ("pi_upper_arm_l", "pi_forearm_l")),
        (("ULA",), "THX", ("pi_upper_arm_l", "pi_forearm_l")),
    ):
        volumes = predict(blind(states, *hidden), PEOPLE, Prediction(), horizon_s=horizon_s, memory_s=MEMORY_S)
        limb = "LRA" if "LRA" in hidden else "LLA"
        which = [LENGTHS.index(bone) for bone in bones]
        for tick in range(5):
            points = volumes.vertices(tick, BODY.index(limb))
            radius = volumes.radius_m[tick, BODY.index(limb)] - FLESH_M[limb]
            near = seen.vertices(tick, BODY.index(carrier))
            if not np.array_equal(points, near):  # the joints' volume is smaller, and holds by a test of its own
                assert len(points) > len(near)
                continue
            allowed = seen.radius_m[tick, BODY.index(carrier)] - FLESH_M[carrier]
            longest = (states.lengths_m[tick, which] + Prediction().sigmas * 0.01).sum() + HAND_M
            for _ in range(100):
                out, along = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
                start = rng.dirichlet(np.ones(len(near))) @ near + allowed * out
                assert distance_m(start + longest * along, points) <= radius + 1e-6
            most = allowed + longest + residual_of(states, tick, limb)
            assert radius == pytest.approx(most, abs=1e-6)


@pytest.mark.parametrize(
    ("hidden", "gone"),
    [
        ("THX", set(BODY)),  # a pelvis behind a table: whatever the torso carries is where nobody knows
        ("URA", {"URA", "LRA"}),
        ("ULA", {"ULA", "LLA"}),
        ("LLA", {"LLA"}),
        ("HD", {"HD"}),
    ],
)
def test_a_limb_out_of_sight_has_the_smaller_volume_of_its_joints_and_of_its_length(
    hidden: str, gone: set[str]
) -> None:
    """And so have those that hang on it; none is larger than the joints alone allow, and some are much smaller."""
    states = replace(people(4, seed=11), camera_points_m=None, residual_m=np.full((4, len(BODY)), 0.05))
    every = {}
    for horizon_s in (0.02, 0.377):
        seen, tubes, joints = (
            predict(of, limits, Prediction(), horizon_s=horizon_s, memory_s=MEMORY_S)
            for of, limits in (
                (states, PEOPLE),
                (blind(states, hidden), PEOPLE),
                (blind(states, hidden), without(PEOPLE)),
            )
        )
        for tick in range(4):
            for k, limb in enumerate(BODY):
                assert np.array_equal(tubes.vertices(tick, k), seen.vertices(tick, k)) or limb in gone, limb
                if limb in gone:
                    every[limb, tick, horizon_s] = box_m3(tubes, tick, limb) / box_m3(joints, tick, limb)
    assert max(every.values()) <= 1.0
    if hidden == "THX":
        assert set(every.values()) == {1.0}
    elif hidden == "LLA":
        assert max(share for (_, _, horizon_s), share in every.items() if horizon_s > 0.3) < 0.6


def test_a_limb_seen_a_while_ago_may_have_departed_for_longer() -> None:
    states = people(3, seed=7)
    unseen = states.unseen_s.copy()
    unseen[:, LIMBS.index("ULA")] = 0.3
    early = predict(states, PEOPLE, Prediction(), horizon_s=0.1, memory_s=MEMORY_S)
    late = predict(replace(states, unseen_s=unseen), PEOPLE, Prediction(), horizon_s=0.1, memory_s=MEMORY_S)
    assert PEOPLE.departure is not None
    k = BODY.index("ULA")
    for tick in range(3):
        reach = allowed_m(PEOPLE.departure, "ULA", 0.3, states.residual_m[tick, k], speed_of(states, tick, "ULA"))
        assert late.radius_m[tick, k] == pytest.approx(FLESH_M["ULA"] + reach, abs=2e-9)
    assert (late.radius_m[:, k] > early.radius_m[:, k]).all()


@pytest.mark.parametrize("unseen_s", [0.15, 0.2])
def test_somebody_whose_torso_went_out_of_sight_may_have_walked_on(unseen_s: float) -> None:
    """At 1.6 m/s, and arms at 2 m/s, since a limb of the fit was seen at the latest."""
    states, departure = people(3, seed=11), PEOPLE.departure
    assert departure is not None
    unseen = states.unseen_s.copy()
    unseen[:, BODY.index("THX")] = unseen_s
    late = predict(replace(states, unseen_s=unseen), PEOPLE, Prediction(), horizon_s=0.05, memory_s=MEMORY_S)
    for tick in range(3):
        for k, limb in enumerate(BODY):
            speed = speed_of(states, tick, limb)
            late_s = max(0.0, unseen_s - 0.1)
            residual = residual_of(states, tick, limb, late_s)
            here, later = (allowed_m(departure, limb, h, residual, speed) for h in (0.05, 0.05 + late_s))
            walked = (2.0 if limb in LIMBS[2:] else 1.6) * (unseen_s - 0.1)
            assert late.radius_m[tick, k] == pytest.approx(FLESH_M[limb] + max(later, here + walked), abs=2e-9)


def test_legs_that_were_hidden_just_now_may_have_departed_for_longer_and_begun_to_move() -> None:
    states = people(3, seed=7)
    unseen, k = states.unseen_s.copy(), BODY.index("LEGS")
    unseen[:, k] = 0.18
    late = predict(replace(states, unseen_s=unseen), PEOPLE, Prediction(), horizon_s=0.1, memory_s=MEMORY_S)
    assert PEOPLE.departure is not None
    for tick in range(3):
        sway, speed = residual_of(states, tick, "LEGS", 0.08), speed_of(states, tick, "LEGS")
        reach = allowed_m(PEOPLE.departure, "LEGS", 0.18, sway, speed)
        assert late.radius_m[tick, k] == pytest.approx(FLESH_M["LEGS"] + reach, abs=2e-9)


@pytest.mark.parametrize("gone", [LEGS, LEGS[2:], ("knee_l",), ("ankle_r", "foot_r")])
def test_hidden_legs_are_the_line_below_the_pelvis_as_thick_as_they_were(gone: tuple[str, ...]) -> None:
    """Of one leg, or of both below the hips or the knees: it says nothing of where the rest of them is."""
    states = people(3, seed=8)
    points = states.points_m.copy()
    points[:, [POINTS.index(name) for name in gone]] = np.nan
    hidden = replace(states, points_m=points)
    k = BODY.index("LEGS")
    volumes = predict(hidden, PEOPLE, Prediction(), horizon_s=0.1, memory_s=MEMORY_S)
    assert PEOPLE.departure is not None
    for tick in range(3):
        pelvis = points[tick, 0]
        line = np.linspace([pelvis[0], pelvis[1], 0.0], pelvis, 5)
        shown = [points[tick, POINTS.index(name)] for name in LEGS if name not in gone]
        assert max(distance_m(point, volumes.vertices(tick, k)) for point in [*line, *shown]) < 1e-5
        reach = allowed_m(PEOPLE.departure, "LEGS", 0.1, 0.018, 0.0)  # like somebody who works on one spot
        reach = max(reach, states.residual_m[tick, BODY.index("THX")])
        bent = np.sqrt(max(0.0, 0.47**2 - (0.5 * states.p[tick, 12]) ** 2))
        thick = max(0.20 + 0.09, bent + 0.08 + 0.09, states.residual_m[tick, k] + 0.08)
        assert volumes.radius_m[tick, k] == pytest.approx(thick + reach, abs=2e-9)


def test_a_hidden_foot_or_hip_makes_legs_no_thicker() -> None:
    states = people(3, seed=8)
    points = states.points_m.copy()
    points[:, [POINTS.index(name) for name in ("hip_l", "foot_l", "foot_r")]] = np.nan
    shown, fewer = (
        predict(of, PEOPLE, Prediction(), horizon_s=0.1, memory_s=MEMORY_S)
        for of in (states, replace(states, points_m=points))
    )
    np.testing.assert_array_equal(fewer.radius_m, shown.radius_m)


def test_nobody_known_has_no_tube() -> None:
    states = people(2, seed=9)
    unknown = {name: np.full_like(getattr(states, name), np.nan) for name in ("p", "points_m", "camera_points_m")}
    nobody = replace(states, **unknown)
    volumes = predict(nobody, PEOPLE, Prediction(), horizon_s=0.1, memory_s=MEMORY_S)
    assert all(np.isnan(volumes.vertices(tick, k)).all() for tick in range(2) for k in range(len(BODY)))


def test_a_tick_has_the_same_bits_alone() -> None:
    states = people(5, seed=10)
    together = predict(states, PEOPLE, Prediction(), horizon_s=0.2, memory_s=MEMORY_S)
    alone = predict(states.rows(slice(3, 4)), PEOPLE, Prediction(), horizon_s=0.2, memory_s=MEMORY_S)
    for k in range(len(BODY)):
        np.testing.assert_array_equal(together.vertices(3, k), alone.vertices(0, k))
    np.testing.assert_array_equal(together.radius_m[3], alone.radius_m[0])
