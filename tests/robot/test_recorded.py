"""The robot as recorded: known instants, no bridged gap, velocities, and its own waiting."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from hrcreplay.records import Floats, Ints
from hrcreplay.robot.recorded import RecordedJoints, time_cut_ns, waiting_remarks

SECOND = 1_000_000_000
BEGIN = 1_700_000_000 * SECOND


def track(
    t_s: Floats, q: Floats, dq: Floats | None = None, gaps_s: tuple[tuple[float, float], ...] = ()
) -> RecordedJoints:
    dq = np.full_like(q, np.nan) if dq is None else dq
    return RecordedJoints(ns(t_s), q, dq, tuple((int(ns(a)), int(ns(b))) for a, b in gaps_s))


def ns(t_s: Floats | float) -> Ints:
    return BEGIN + np.round(np.asarray(t_s) * 1e9).astype(np.int64)


def sines(t_s: Floats) -> Floats:
    return np.column_stack([np.sin(1.1 * t_s), 0.4 + 0.3 * np.cos(0.7 * t_s)])


def test_a_stamp_gives_its_own_row_and_an_instant_between_two_their_mean_by_time() -> None:
    rng = np.random.default_rng(3)
    t_s = np.cumsum(rng.uniform(0.005, 0.05, 200))
    q = rng.normal(size=(200, 2))
    recorded = track(t_s, q)
    assert_array_equal(recorded.sample(ns(t_s)).q, q)
    at_s = rng.uniform(t_s[0], t_s[-1], 500)
    between = np.column_stack([np.interp(at_s, t_s, column) for column in q.T])
    assert_allclose(recorded.sample(ns(at_s)).q, between, atol=1e-5)


def test_nothing_is_known_before_the_first_row_in_a_gap_and_after_the_last() -> None:
    t_s = np.concatenate([np.arange(1.0, 2.0, 0.01), np.arange(3.0, 4.0, 0.01)])
    recorded = track(t_s, sines(t_s), gaps_s=((1.99, 3.0),))
    sample = recorded.sample(ns(np.array([0.999, 1.0, 1.99, 1.991, 2.5, 2.999, 3.0, 3.99, 3.991])))
    assert sample.reason.tolist() == [1, 0, 0, 2, 2, 2, 0, 0, 3]
    known = sample.reason == 0
    assert np.isfinite(sample.q[known]).all()
    assert np.isfinite(sample.dq[known]).all()
    assert np.isnan(sample.q[~known]).all()
    assert np.isnan(sample.dq[~known]).all()


def test_overlapping_silences_of_two_axes_are_one_gap() -> None:
    t_s = np.arange(0.0, 5.0, 0.01)
    recorded = track(t_s, sines(t_s), gaps_s=((1.0, 2.0), (1.2, 1.4), (1.5, 2.5)))
    at_s = np.array([0.99, 1.0, 1.1, 1.45, 1.6, 2.0, 2.2, 2.5, 2.6])
    assert recorded.sample(ns(at_s)).reason.tolist() == [0, 0, 2, 2, 2, 2, 2, 0, 0]


def test_velocities_are_the_recorded_ones_else_those_of_the_positions() -> None:
    t_s = np.arange(0.0, 3.0, 0.008)
    true = np.column_stack([1.1 * np.cos(1.1 * t_s), -0.21 * np.sin(0.7 * t_s)])
    at_s = np.arange(0.3, 1.2, 0.004)
    expected = np.column_stack([1.1 * np.cos(1.1 * at_s), -0.21 * np.sin(0.7 * at_s)])
    assert_allclose(track(t_s, sines(t_s)).sample(ns(at_s)).dq, expected, atol=6e-3)
    given = true + np.array([0.5, 0.0])  # told apart from the slope
    given[:, 1] = np.nan
    dq = track(t_s, sines(t_s), given).sample(ns(at_s)).dq
    assert_allclose(dq[:, 0], expected[:, 0] + 0.5, atol=1e-4)
    assert_allclose(dq[:, 1], expected[:, 1], atol=6e-3)


def test_noise_of_a_robot_at_rest_is_no_motion_and_a_slow_motion_is() -> None:
    rng = np.random.default_rng(1)
    t_s = np.arange(0.0, 4.0, 0.002)
    q = np.column_stack([np.where(t_s < 2.0, 0.3, 0.3 + 0.02 * (t_s - 2.0)), np.full_like(t_s, 1.0)])
    dq = track(t_s, q + rng.normal(0, 1e-4, q.shape)).sample(ns(np.arange(0.1, 3.9, 0.004))).dq
    moves = np.asarray(dq.any(axis=1))
    assert not moves[: round(1.8 / 0.004)].any()
    assert moves[round(2.2 / 0.004) :].all()


def there(share: Floats) -> Floats:
    return 10 * share**3 - 15 * share**4 + 6 * share**5


def stopped(wait_s: float, *, turns: bool = False) -> tuple[Floats, Floats]:
    """Two moves of 2 s in one direction (or there and back); the first is broken off at its half for a time."""
    t_s = np.arange(0.0, 6.0 + wait_s, 0.01)
    clock = np.where(t_s < 1.0, t_s, np.maximum(1.0, t_s - wait_s))
    slow = np.abs(t_s - 1.0) < 0.3  # it slows down before, as a robot has to
    clock = np.where(slow & (t_s < 1.0), 1.0 - (1.0 - t_s) ** 2 / 0.6 - 0.15 + 0.15 * (t_s - 0.7) / 0.3, clock)
    first, second = there(np.clip(clock / 2.0, 0, 1)), there(np.clip((clock - 4.0) / 2.0, 0, 1))
    way = first - second if turns else first + second
    return t_s, np.outer(way, [0.8, -0.4])


@pytest.mark.parametrize("turns", [False, True])
def test_a_stop_within_a_move_is_waiting_and_a_dwell_where_the_way_turns_is_not(*, turns: bool) -> None:
    t_s, q = stopped(2.5, turns=turns)
    recorded = track(t_s, q)
    cuts = recorded.waits(0.5)
    (begin, end), *more = cuts
    assert_allclose([(begin - BEGIN) * 1e-9, (end - BEGIN) * 1e-9], [1.0, 3.5], atol=0.25)
    assert bool(more) is not turns  # the dwell between two moves in one direction cannot be told from waiting
    assert recorded.waits(3.0) == ()


def test_a_record_without_its_waiting_is_the_motion_that_never_waited() -> None:
    t_s, q = stopped(2.5, turns=True)
    recorded = track(t_s, q)
    cuts = recorded.waits(0.5)
    left_ns, left_q = recorded.without(cuts)
    cut_s = time_cut_ns(cuts, int(ns(10.0))) * 1e-9
    assert left_ns[-1] == pytest.approx(ns(t_s[-1] - cut_s), abs=1)
    assert (np.diff(left_ns) >= 0).all()
    after = left_ns >= ns(1.4)
    later = np.column_stack([np.interp(left_ns[after] + round(cut_s * 1e9), ns(t_s), column) for column in q.T])
    assert_allclose(left_q[after], later, atol=1e-3)
    assert np.abs(np.diff(left_q, axis=0)).max() < 0.02  # no leap where it was cut
    assert time_cut_ns(cuts, cuts[0][0]) == 0
    assert time_cut_ns(cuts, cuts[0][0] + SECOND) == SECOND
    (remark,) = waiting_remarks(cuts, BEGIN, 0.5)
    assert f"{cut_s:.2f} s" in remark
    assert "plan.waiting_s = 0.5" in remark
    assert waiting_remarks((), BEGIN, 0.5) == []


def test_a_standstill_beside_a_gap_is_no_waiting() -> None:
    t_s, q = stopped(2.5, turns=True)
    kept = (t_s < 1.5) | (t_s > 3.7)
    recorded = track(t_s[kept], q[kept], gaps_s=((1.49, 3.71),))
    assert recorded.waits(0.2) == ()
