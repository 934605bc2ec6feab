"""The sampler itself: kinematics, motions and containment against what is written differently."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import linprog

from hrcreplay.human.model import clamp, skeleton
from hrcreplay.limits import load_limits
from hrcreplay.records import DOF, Floats, Ints
from hrcreplay.records import POINTS as SKELETON
from tests.human.people import LENGTHS_M
from tests.tools.soundness.facets import Facets, distance_m, facets_of, outside
from tests.tools.soundness.joint import bounds_of
from tests.tools.soundness.kinematics import POINTS, body
from tests.tools.soundness.motion import GROUPS, step
from tests.tools.soundness.states import draw_estimate
from tests.tools.soundness.wishes import CODES, draw

LIMITS = {name: load_limits(name) for name in ("paper", "human")}
DT = 0.377 / 400


def test_points_are_those_of_the_model() -> None:
    rng = np.random.default_rng(1)
    p, lengths, points = rng.uniform(-4.0, 4.0, (50, DOF)), rng.uniform(0.1, 1.0, (50, 7)), np.empty((len(POINTS), 3))
    expected = skeleton(p, lengths)
    for i in range(len(p)):
        body(p[i], lengths[i], 0.0, points)
        for name, point in zip(POINTS[:-1], points, strict=False):
            there = expected[i, SKELETON.index(name.replace("tip", "wrist"))]
            assert point == pytest.approx(there, abs=1e-12), name
        assert points[-1].tolist() == [p[i, 0], p[i, 1], 0.0]


def test_the_hand_goes_on_where_the_forearm_ends() -> None:
    q, points, longer = np.linspace(-1.0, 1.0, DOF), np.empty((len(POINTS), 3)), np.empty((len(POINTS), 3))
    body(q, LENGTHS_M, 0.19, points)
    body(q, LENGTHS_M + np.array([0, 0, 0, 0, 0, 0.19, 0.19]), 0.0, longer)
    assert points == pytest.approx(longer, abs=1e-15)


def follow(limits: str, seed: int, careful: bool, beyond: bool) -> tuple[Floats, Floats, Ints]:
    """A random motion in fine steps: q, v (n, 13), and for every step which groups had ended before it (n, 4)."""
    bounds, rng = bounds_of(LIMITS[limits]), np.random.default_rng(seed)
    start = draw_estimate(rng, LIMITS[limits], beyond=beyond)
    wish = np.empty((8, DOF))
    draw(rng, CODES[("corner", "bang_bang", "switching", "pieces")[seed % 4]], bounds, wish)
    q, v, ended, work = start.true_q, start.true_v, np.zeros(len(GROUPS), np.int64), np.empty((8, DOF))
    rows = [(q.copy(), v.copy(), ended.copy())]
    for k in range(400):
        t = 0.0
        while t < DT:
            moved, _ = step(q, v, wish[k // 50], DT - t, (careful, beyond), ended, bounds, work)
            t = DT if moved == DT - t else t + moved
        rows.append((q.copy(), v.copy(), ended.copy()))
    places, speeds, ends = (np.array(column) for column in zip(*rows, strict=True))
    return places, speeds, ends


@pytest.mark.parametrize("limits", LIMITS)
@pytest.mark.parametrize("careful", [False, True])
def test_motions_obey_every_bound(limits: str, careful: bool) -> None:
    bound, moved = LIMITS[limits], 0
    for seed in range(60):
        q, v, ended = follow(limits, seed, careful, beyond=False)
        assert (v >= bound.v_min - 1e-12).all()
        assert (v <= bound.v_max + 1e-12).all()
        followed = np.ones((len(q) - 1, DOF), dtype=bool)
        for g, (first, end) in enumerate(GROUPS):
            followed[:, first:end] = ended[1:, g, None] == 0
        a, rate = np.diff(v, axis=0) / DT, np.diff(q, axis=0) / DT
        assert (a >= bound.a_min - 1e-9)[followed].all()
        assert (a <= bound.a_max + 1e-9)[followed].all()
        middle = 0.5 * (v[1:] + v[:-1])
        assert (np.abs(rate - middle) <= 0.26 * DT * (bound.a_max - bound.a_min) + 1e-9)[:, 2:][followed[:, 2:]].all()
        assert np.abs(clamp(q, bound) - q).max() < 1e-12  # the coupling (34) too
        moved += int(followed[-1].sum())
    assert moved > 60 * DOF * (0.6 if careful else 0.3)


@pytest.mark.parametrize("limits", LIMITS)
def test_what_a_stop_does(limits: str) -> None:
    """A joint that meets a limit rests there: it loses its velocity, and else no acceleration is above its bound."""
    bound, rested = LIMITS[limits], 0
    for seed in range(150):
        q, v, ended = follow(limits, seed, careful=False, beyond=True)
        assert np.abs(clamp(q, bound) - q).max() < 1e-9
        a = np.diff(v, axis=0) / DT
        jumps = ((a < bound.a_min - 1e-9) | (a > bound.a_max + 1e-9))[:, 3:]
        for k, j in np.argwhere(jumps):
            group = next(g for g, (first, end) in enumerate(GROUPS) if first <= j + 3 < end)
            assert ended[k + 1, group] or abs(v[k + 1, j + 3]) <= max(bound.a_max[j + 3], -bound.a_min[j + 3]) * DT
            rested += not ended[k + 1, group]
        assert not (jumps.sum(axis=0) > 3).any()
    assert rested > 3


def test_too_fast_comes_back() -> None:
    bound = LIMITS["paper"]
    bounds, ended, work = bounds_of(bound), np.zeros(len(GROUPS), np.int64), np.empty((8, DOF))
    q, v = np.zeros(DOF), np.zeros(DOF)
    q[[3, 4, 8]], q[[7, 11]], v[0], v[4] = 0.3, 2.0, 0.85, 1.7
    moved, t, wish = 0.0, 0.0, bound.a_max
    while t < 0.377:
        moved, _ = step(q, v, wish, 0.377 - t, (False, False), ended, bounds, work)
        t += moved
    back = (1.7 - bound.v_max[4]) / -bound.a_min[4]
    assert v[4] == bound.v_max[4]
    assert q[4] == pytest.approx(0.3 + 1.7 * back + 0.5 * bound.a_min[4] * back**2 + bound.v_max[4] * (0.377 - back))
    assert v[0] == pytest.approx(0.85 - 0.1 * 0.377)


@pytest.mark.parametrize("limits", LIMITS)
def test_walking_is_the_integral_of_the_unicycle(limits: str) -> None:
    """Eq. (25) by adaptive quadrature, from one kink of the velocities to the next."""
    bound, rng = LIMITS[limits], np.random.default_rng(5)
    for _ in range(20):
        start = draw_estimate(rng, bound)
        q, v = start.true_q.copy(), start.true_v.copy()
        a = np.where(rng.random(DOF) < 0.5, bound.a_min, bound.a_max)
        step(q, v, a, 0.1, (False, False), np.ones(len(GROUPS), np.int64), bounds_of(bound), np.empty((8, DOF)))
        kinks = (np.where(a > 0.0, bound.v_max, bound.v_min) - start.true_v)[:3] / a[:3]

        def rate(t: float, axis: int, p: Floats = start.true_q, v: Floats = start.true_v, a: Floats = a) -> float:
            forward, left = np.clip(v + a * t, bound.v_min, bound.v_max)[:2]
            bent = min(t, (np.where(a > 0.0, bound.v_max, bound.v_min) - v)[2] / a[2])
            theta = p[2] + v[2] * t + a[2] * (0.5 * bent**2 + bent * (t - bent))
            c, s = np.cos(theta), np.sin(theta)
            return float(s * forward + c * left if axis else c * forward - s * left)

        spans = list(pairwise(np.unique(np.clip([0.0, *kinks, 0.1], 0.0, 0.1))))
        for axis in range(2):
            way = sum(quad(rate, *span, args=(axis,), epsabs=1e-14, epsrel=1e-13)[0] for span in spans)
            assert q[axis] == pytest.approx(start.true_q[axis] + way, abs=1e-12)


def margin(facets: Facets, points: Floats) -> Floats:
    margins = np.full(len(points), -np.inf)
    outside(facets, 0, np.ascontiguousarray(points.T), -np.inf, margins)
    return margins


def is_inside(vertices: Floats, point: Floats) -> bool:
    rows = np.vstack([vertices.T, np.ones(len(vertices))])
    return bool(linprog(np.zeros(len(vertices)), A_eq=rows, b_eq=np.append(point, 1.0)).status == 0)


def test_containment_is_that_of_a_linear_program() -> None:
    rng = np.random.default_rng(6)
    for shape in ([1.0, 1.0, 1.0], [1.0, 0.2, 0.05]):
        vertices = rng.normal(size=(40, 3)) * shape
        facets = facets_of([vertices], np.zeros(1))
        points = rng.normal(size=(60, 3)) * shape
        margins = margin(facets, points)
        assert (margins > 0.0).any()
        assert (margins < 0.0).any()
        for point, far in zip(points, margins, strict=True):
            assert (far <= 0.0) == is_inside(vertices, point)
            assert distance_m(vertices, point) >= max(far, 0.0) - 1e-12
            assert (distance_m(vertices, point) < 1e-9) == (far <= 0.0)


def test_distance_and_balls_by_hand() -> None:
    cube = np.array([(x, y, z) for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    points = np.array([[2.0, 0.5, 0.5], [2.0, 3.0, 0.5], [2.0, 3.0, -1.0], [0.5, 0.6, 0.5]])
    assert [distance_m(cube, p) for p in points] == pytest.approx([1.0, 5**0.5, 6**0.5, 0.0])
    assert margin(facets_of([cube], np.zeros(1)), points) == pytest.approx([1.0, 2.0, 2.0, -0.4])
    rounded = margin(facets_of([cube], np.array([0.1])), points)
    assert rounded[[0, 3]] == pytest.approx([0.9, -0.5])
    assert (rounded[1:3] <= np.array([5**0.5, 6**0.5]) - 0.1 + 1e-12).all()  # never more than the distance
    assert rounded[1] > 2.0


def test_what_is_far_from_a_side_may_be_passed_over_but_no_worst() -> None:
    rng = np.random.default_rng(7)
    facets = facets_of([rng.normal(size=(50, 3))], np.zeros(1))
    points = rng.uniform([0.1, -0.4, -0.4], [0.9, 0.4, 0.4], (40, 3))
    full, some = margin(facets, points), np.full(40, -np.inf)
    enough = float(np.sort(full)[30])
    outside(facets, 0, np.ascontiguousarray(points.T), enough, some)
    assert some[full > enough].tolist() == full[full > enough].tolist()
    assert (some[full <= enough] <= enough).all()


def test_flat_volumes_have_sides_all_around() -> None:
    square = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 1.0, 1.0], [0.5, 0.5, 1.0]])
    points = np.array([[0.5, 0.5, 1.0], [0.5, 0.5, 1.5], [1.25, 0.5, 1.0], [0.5, 0.5, 0.9]])
    assert margin(facets_of([square], np.zeros(1)), points) == pytest.approx([0.0, 0.5, 0.25, 0.1])
    line = square[:2]
    points = np.array([[0.25, 0.0, 1.0], [-0.5, 0.0, 1.0], [0.5, 0.0, 1.5]])
    margins = margin(facets_of([line], np.zeros(1)), points)
    assert margins[:2] == pytest.approx([0.0, 0.5])
    assert 0.5 / 2**0.5 - 1e-12 <= margins[2] <= 0.5
