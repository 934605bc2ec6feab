"""Progress along the programme, for motions made from a known programmed time at every tick."""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd
import pytest

from hrcreplay.records import Floats
from hrcreplay.reporting.metrics.planning import programme_progress
from tests.reporting.synthetic import T0_NS, make_run, metrics_of

HZ = 100.0
STOPS = np.array([[0.4, -0.3, 0.6], [0.4, -0.3, 0.3], [0.4, -0.3, 0.6], [0.4, 0.3, 0.6], [0.4, -0.3, 0.6]])
MOVE_S, DWELL_S = 1.5, 0.5
LEASH_M = 0.25


def at(s: Floats) -> Floats:
    """(n, 3) a pick-and-place programme: down and up the same line, over and back, with a stop at each place."""
    part = np.clip(s, 0.0, None) % (4 * (MOVE_S + DWELL_S))
    leg = np.minimum((part // (MOVE_S + DWELL_S)).astype(int), 3)
    share = np.clip((part - leg * (MOVE_S + DWELL_S)) / MOVE_S, 0.0, 1.0)[:, None]
    smooth = share**3 * (10 - 15 * share + 6 * share**2)
    return STOPS[leg] + smooth * (STOPS[leg + 1] - STOPS[leg])


def table(reference_s: Floats, tcp_m: Floats) -> pd.DataFrame:
    """A motion whose reference has these programmed times."""
    t_ns = T0_NS + np.round(np.arange(len(reference_s)) / HZ * 1e9).astype(np.int64)
    ref = at(reference_s)
    places = {f"{name}_{axis}": p[:, i] for name, p in (("ref", ref), ("tcp", tcp_m)) for i, axis in enumerate("xyz")}
    return pd.DataFrame({"t_ns": t_ns, "programme_s": reference_s} | places)


def share(motion: pd.DataFrame) -> float:
    found = programme_progress(motion, LEASH_M)
    assert found is not None
    return found[0] / found[1]


def leashed(robot_s: Floats) -> Floats:
    """Programmed times of a reference that runs ahead of the robot by up to the leash, and waits at each place."""
    ahead = robot_s.copy()
    for k in range(1, len(ahead)):
        ahead[k] = ahead[k - 1]
        further = ahead[k] + 1 / HZ
        arrival = np.ceil((ahead[k] + 1e-9) / (MOVE_S + DWELL_S)) * (MOVE_S + DWELL_S) - DWELL_S
        waits = further > arrival and ahead[k] <= arrival and robot_s[k] < arrival
        apart = np.linalg.norm(at(np.array([further])) - at(robot_s[k : k + 1]))
        if further <= k / HZ and apart <= LEASH_M and not waits:
            ahead[k] = further
    return np.maximum(ahead, robot_s)


CLOCK_S = np.arange(0, 20.0, 1 / HZ)


def test_a_robot_that_follows_exactly_keeps_the_whole_pace() -> None:
    assert share(table(CLOCK_S, at(CLOCK_S))) == 1.0


def test_a_robot_that_follows_exactly_keeps_it_while_the_programme_stands() -> None:
    whole_s = np.arange(0, 1.8, 1 / HZ)  # ends within the first dwell
    assert share(table(whole_s, at(whole_s))) == 1.0
    settling = at(whole_s) + np.array([0.0, 0.0, 0.0005])
    assert share(table(whole_s, settling)) == 1.0


@pytest.mark.parametrize("moved_m", [0.0, 2e-14])
@pytest.mark.parametrize("waits", [True, False])
def test_a_robot_that_did_not_move_made_no_way(moved_m: float, waits: bool) -> None:
    """Whether its reference is held by the leash or goes round and comes by again and again."""
    stands = np.broadcast_to(at(np.zeros(1)), (len(CLOCK_S), 3)) + moved_m * np.linspace(0, 1, len(CLOCK_S))[:, None]
    reference_s = leashed(np.zeros(len(CLOCK_S))) if waits else CLOCK_S
    assert reference_s[-1] > 0.1  # ahead on its leash
    assert share(table(reference_s, stands)) == 0.0


def test_a_baseline_on_its_path_that_did_not_move_made_no_way() -> None:
    stands = np.zeros(len(CLOCK_S))
    assert share(table(stands, at(stands))) == 0.0


@pytest.mark.parametrize("mode", ["path", "time"])
def test_a_robot_at_half_the_speed_keeps_half_the_pace(mode: str) -> None:
    robot_s = 0.5 * CLOCK_S
    reference_s = leashed(robot_s) if mode == "path" else CLOCK_S
    assert reference_s[-1] > robot_s[-1]
    assert share(table(reference_s, at(robot_s))) == pytest.approx(0.5, abs=2e-3)


@pytest.mark.parametrize("seed", range(6))
def test_the_way_made_is_that_of_the_robot_however_it_is_held_and_evades(seed: int) -> None:
    """Held at random, and off its path by up to 6 cm wherever the programme is not at a place."""
    rng = np.random.default_rng(seed)
    rate = np.clip(np.repeat(rng.uniform(-0.5, 1.5, 40), 50), 0.0, 1.0)
    robot_s = np.concatenate([[0.0], np.cumsum(rate)[:-1]]) / HZ
    part = robot_s % (MOVE_S + DWELL_S)
    off = 0.06 * np.sin(np.pi * np.clip(part / MOVE_S, 0.0, 1.0)) ** 2
    tcp = at(robot_s) + off[:, None] * np.array([1.0, 0.0, 0.0])  # across every move
    found = share(table(leashed(robot_s), tcp))
    given_s = (len(robot_s) - 1) / HZ
    ends = robot_s[-1]
    into = ends % (MOVE_S + DWELL_S)
    slack_s = DWELL_S if into >= MOVE_S - 0.2 else 0.02  # at a place, all of its dwell that the reference made
    assert ends / given_s - 0.02 / given_s <= found <= (ends + slack_s) / given_s


def test_a_round_that_was_left_out_does_not_count() -> None:
    """The reference does not wait; the robot stands for the first round and follows exactly from then on."""
    round_s = 4 * (MOVE_S + DWELL_S)
    clock_s = CLOCK_S[:1900]  # ends within a move
    robot_s = np.where(clock_s < round_s, 0.0, clock_s)
    assert share(table(clock_s, at(robot_s))) == pytest.approx((clock_s[-1] - round_s) / clock_s[-1], abs=1e-9)


def test_a_programme_that_only_stands_has_no_pace() -> None:
    run = make_run(4.0)
    assert run.motion is not None
    still = {f"{what}_{axis}": run.motion[f"{what}_{axis}"].iloc[0] for what in ("ref", "tcp") for axis in "xyz"}
    s = 0.01 * np.arange(len(run.motion))
    stands = dataclasses.replace(run, motion=run.motion.assign(**still, programme_s=s))
    found = metrics_of(stands)
    assert found["plan_progress_share"]["value"] is None
    assert "stationary" in found["plan_progress_share"]["reason"]
    held = dataclasses.replace(run, motion=run.motion.assign(**still, programme_s=0.0))
    found = metrics_of(held)
    assert found["plan_progress_share"]["value"] == 0.0
    assert found["plan_time_lost_s"]["value"] == pytest.approx(found["span_s"]["value"])


def test_ticks_at_which_the_robot_is_not_known_are_left_out() -> None:
    whole = table(CLOCK_S, at(0.8 * CLOCK_S))
    gaps = whole.copy()
    gaps.loc[gaps.index % 5 == 3, ["tcp_x", "tcp_y", "tcp_z"]] = np.nan
    assert share(gaps) == pytest.approx(share(whole), abs=0.005)
