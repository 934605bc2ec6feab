"""Limits of contact by body region, against a second transcription of the tables."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hrcreplay.human import contact_limits
from hrcreplay.human.contact_limits import MAY_BE, REGIONS, region_of
from hrcreplay.human.model import PARTS
from hrcreplay.records import BODY

#: ISO/TS 15066:2016, copied from other places than the code's: effective mass [kg] and spring constant [N/mm] of Table
#: A.3, largest quasi-static force [N] of Table A.2, and by how much a short contact may exceed it.
TABLE = """
skull and forehead          | 4.4 | 150 | 130 | n/a
face                        | 4.4 |  75 |  65 | n/a
neck                        | 1.2 |  50 | 150 | 2
back and shoulders          |  40 |  35 | 210 | 2
chest                       |  40 |  25 | 140 | 2
abdomen                     |  40 |  10 | 110 | 2
pelvis                      |  40 |  25 | 180 | 2
upper arms and elbow joints |   3 |  30 | 150 | 2
lower arms and wrist joints |   2 |  40 | 160 | 2
hands and fingers           | 0.6 |  75 | 140 | 2
thighs and knees            |  75 |  50 | 220 | 2
lower legs                  |  75 |  60 | 130 | 2
"""
#: Energy limits of Table A.4 for seven of the regions [J].
ENERGIES_J = {
    "back and shoulders": 2.5,
    "chest": 1.6,
    "abdomen": 2.4,
    "pelvis": 2.6,
    "upper arms and elbow joints": 1.5,
    "lower arms and wrist joints": 1.3,
    "thighs and knees": 1.9,
}


def test_the_numbers_are_those_of_the_tables() -> None:
    rows = [[cell.strip() for cell in line.split("|")] for line in TABLE.strip().splitlines()]
    assert [
        (region.name, region.mass_kg, region.stiffness_n_per_m / 1e3, region.clamped_n, region.transient)
        for region in REGIONS
    ] == [(name, float(mass), float(k), float(force), times == "2") for name, mass, k, force, times in rows]


def test_the_energies_are_those_of_the_third_table() -> None:
    """That of the face, 0.11 J in a public transcription of the table, is what twice the clamped force gives.

    Table A.2 allows no short contact there, so ours is a quarter of that.
    """
    face = next(region for region in REGIONS if region.name == "face")
    assert round(4.0 * face.energy_j, 2) == 0.11
    found = {region.name: round(region.energy_j, 1) for region in REGIONS if region.name in ENERGIES_J}
    assert found == ENERGIES_J


def test_at_the_largest_speed_the_spring_has_the_largest_force() -> None:
    rng = np.random.default_rng(1)
    for region in REGIONS:
        for robot_kg in (*rng.uniform(1.0, 100.0, 5), math.inf):
            speed = region.speed_m_per_s(robot_kg)
            # bodies of these masses with a common centre at rest: all energy of the relative motion is in the spring
            mass = region.mass_kg
            own = 0.0 if math.isinf(robot_kg) else speed * mass / (mass + robot_kg)
            energy_j = 0.5 * mass * (speed - own) ** 2 + (0.0 if math.isinf(robot_kg) else 0.5 * robot_kg * own**2)
            assert energy_j == pytest.approx(region.energy_j)
            pressed_m = math.sqrt(2.0 * energy_j / region.stiffness_n_per_m)
            assert region.stiffness_n_per_m * pressed_m == pytest.approx(region.transient_n)


def test_a_part_counts_as_the_strictest_region_that_it_may_be() -> None:
    assert set(MAY_BE) == {*PARTS, *BODY}
    for robot_kg in (5.0, 55.0, math.inf):
        for part, names in MAY_BE.items():
            slowest = min(region.speed_m_per_s(robot_kg) for region in REGIONS if region.name in names)
            assert region_of(part, robot_kg).speed_m_per_s(robot_kg) == slowest
    assert {part: region_of(part).name for part in ("HD", "THX", "LRA", "HAND_R", "SHANK_L", "FOOT_L")} == {
        "HD": "face",
        "THX": "chest",
        "LRA": "lower arms and wrist joints",
        "HAND_R": "hands and fingers",
        "SHANK_L": "lower legs",
        "FOOT_L": "lower legs",
    }
    assert contact_limits.__doc__ is not None
    assert "ISO 10218-2:2025" in contact_limits.__doc__
