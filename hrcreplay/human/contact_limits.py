"""Biomechanical limits of contact, by body region: ISO/TS 15066:2016, Tables A.2 and A.3.

ISO 10218-2:2025 has absorbed this technical specification. The forces are those that bruise at most; the pressures of
Table A.2 are not here, as they need the area of contact, which no log gives. Contact of the model's limbs is compared
with the strictest region that the limb may stand for: a log does not say which side of the trunk or of the head is hit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Region:
    """A body region as a mass behind a spring, and the forces that it bears."""

    name: str
    mass_kg: float  #: effective mass, Table A.3
    stiffness_n_per_m: float  #: effective spring constant, Table A.3
    clamped_n: float  #: largest quasi-static force, Table A.2: the part cannot give way
    transient: bool  #: True: in a short contact the part bears twice the force; False: the table allows none

    @property
    def transient_n(self) -> float:
        """Largest force of a short contact, from which the part recoils, Table A.2; as if clamped where it has none."""
        return (2.0 if self.transient else 1.0) * self.clamped_n

    @property
    def energy_j(self) -> float:
        """Largest energy that the spring takes up to that force, F^2 / (2 k)."""
        return self.transient_n**2 / (2.0 * self.stiffness_n_per_m)

    def reduced_mass_kg(self, robot_kg: float) -> float:
        """Reduced mass of the region and a robot of an effective mass; inf: a robot that does not give way."""
        return 1.0 / (1.0 / self.mass_kg + (0.0 if math.isinf(robot_kg) else 1.0 / robot_kg))

    def speed_m_per_s(self, robot_kg: float) -> float:
        """Largest relative speed of a short contact, F / sqrt(mu k), for a robot of an effective mass [kg]."""
        return self.transient_n / math.sqrt(self.reduced_mass_kg(robot_kg) * self.stiffness_n_per_m)


REGIONS = (
    Region("skull and forehead", 4.4, 150e3, 130.0, transient=False),
    Region("face", 4.4, 75e3, 65.0, transient=False),
    Region("neck", 1.2, 50e3, 150.0, transient=True),
    Region("back and shoulders", 40.0, 35e3, 210.0, transient=True),
    Region("chest", 40.0, 25e3, 140.0, transient=True),
    Region("abdomen", 40.0, 10e3, 110.0, transient=True),
    Region("pelvis", 40.0, 25e3, 180.0, transient=True),
    Region("upper arms and elbow joints", 3.0, 30e3, 150.0, transient=True),
    Region("lower arms and wrist joints", 2.0, 40e3, 160.0, transient=True),
    Region("hands and fingers", 0.6, 75e3, 140.0, transient=True),
    Region("thighs and knees", 75.0, 50e3, 220.0, transient=True),
    Region("lower legs", 75.0, 60e3, 130.0, transient=True),
)
_BY_NAME = {region.name: region for region in REGIONS}

#: Part of the body, or limb with a volume -> the regions that it may stand for. Feet are in no table; they count as the
#: legs that they hang from. The forearm's volume and capsule hold the hand, too.
MAY_BE = {
    "HD": ("skull and forehead", "face"),
    "THX": ("back and shoulders", "chest", "abdomen", "pelvis"),
    **dict.fromkeys(("URA", "ULA"), ("upper arms and elbow joints",)),
    **dict.fromkeys(("LRA", "LLA"), ("lower arms and wrist joints", "hands and fingers")),
    **dict.fromkeys(("HAND_R", "HAND_L"), ("hands and fingers",)),
    **dict.fromkeys(("THIGH_R", "THIGH_L"), ("thighs and knees",)),
    **dict.fromkeys(("SHANK_R", "SHANK_L", "FOOT_R", "FOOT_L"), ("lower legs",)),
    "LEGS": ("pelvis", "thighs and knees", "lower legs"),
}


def region_of(part: str, robot_kg: float = math.inf) -> Region:
    """Returns the strictest region that a part may stand for: that with the lowest speed of a short contact.

    Args:
        part: One of ``MAY_BE``.
        robot_kg: Effective mass of the robot; inf: it does not give way.
    """
    return min((_BY_NAME[name] for name in MAY_BE[part]), key=lambda region: region.speed_m_per_s(robot_kg))
