"""When the reference waits for the robot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from hrcreplay.robot.task import Reference, advance, waits
from hrcreplay.settings.sections import Plan
from tests.robot.tasks import pick_and_place, robot

__all__ = ["pick_and_place", "robot"]  # fixtures


def test_time_runs_with_the_clock(pick_and_place: Reference) -> None:
    assert advance(pick_and_place.grid, 1.0, 0.004, 9.0, waits(Plan(reference="time"))) == (1.004, 1.0)


def test_path_waits_on_a_taut_leash_and_never_turns_back(pick_and_place: Reference) -> None:
    leash = waits(Plan(reference="path", max_reference_lead_m=0.05, waypoint_m=0.05))
    errors = np.linspace(0, 0.08, 400)
    steps = [advance(pick_and_place.grid, 1.0, 0.004, e, leash) for e in errors]
    rates = np.array([rate for _, rate in steps])
    assert_allclose(rates[errors <= 0.025], 1, atol=1e-12)
    assert (rates[errors >= 0.05] == 0).all()
    assert (np.diff(rates) <= 1e-12).all()
    assert np.abs(np.diff(rates)).max() < 0.02  # no jump
    assert_allclose([s for s, _ in steps], 1.0 + 0.004 * rates)
    assert advance(pick_and_place.grid, 1.0, 0.004, float("nan"), leash) == (1.0, 0.0)


def test_a_held_robot_is_waited_for_and_skips_no_waypoint(pick_and_place: Reference) -> None:
    """The robot stands for two seconds in the middle of a move, then evades by 12 cm, and goes on from there."""
    tick, leash = 0.004, Plan(reference="path", max_reference_lead_m=0.25, waypoint_m=0.01)
    s, tcp = 0.0, pick_and_place.sample(0.0).T_world_tcp[:3, 3]
    passed, evaded = [], 0.0
    for k in range(4500):
        target = pick_and_place.sample(s).T_world_tcp[:3, 3]
        goal = target + np.array([0, 0, 0.12]) if 900 <= k < 1500 else target
        way = float(np.linalg.norm(goal - tcp))
        if not 100 <= k < 600:
            tcp = tcp + min(1.0, 1.2 * tick / max(way, 1e-12)) * (goal - tcp)
        error = float(np.linalg.norm(target - tcp))
        assert error < leash.max_reference_lead_m + 2.2 * tick
        s_next, rate = advance(pick_and_place.grid, s, tick, error, waits(leash))
        assert s <= s_next <= s + tick
        passed += [error for arrival in pick_and_place.waypoints_s if s <= arrival < s_next]
        evaded = max(evaded, error if s_next > s else 0.0)
        assert rate == pytest.approx((s_next - s) / tick, abs=1e-9)
        s = s_next
    assert len(passed) == 5
    assert max(passed) <= leash.waypoint_m
    assert evaded > 0.1  # between waypoints the reference goes on beside a robot that evades
    assert s > pick_and_place.duration_s


def test_the_next_waypoint_is_found_in_every_cycle(pick_and_place: Reference) -> None:
    looping = replace(pick_and_place, cycles=3.0)
    arrivals = np.add.outer(np.arange(4) * looping.cycle_s, np.array(looping.waypoints_s)).ravel()
    for s in np.linspace(0, looping.duration_s, 333):
        assert looping.next_waypoint(s) == pytest.approx(arrivals[arrivals >= s].min(), abs=1e-12)
    assert looping.next_waypoint(looping.duration_s + 1.0) == np.inf
