"""The robot's mass as far as it is known, for contact: never a guess, and its source in words.

Also the speeds at which a robot of that mass may touch the limbs of a person.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hrcreplay.human.contact_limits import region_of
from hrcreplay.robot import irb140
from hrcreplay.robot.control.contact_speed import ContactSpeeds
from hrcreplay.robot.model import RobotModel
from hrcreplay.settings.sections import Robot, Settings


class RobotMass(NamedTuple):
    """Mass of a robot by ISO/TS 15066, A.3.4."""

    moving_kg: float  #: M, of all moving parts; NaN: not known [kg]
    payload_kg: float  #: m_L, of tool and workpiece [kg]
    source: str  #: where M is from, in words

    @property
    def simple_kg(self) -> float:
        """The effective mass M / 2 + m_L, whatever the posture; NaN: not known [kg]."""
        return 0.5 * self.moving_kg + self.payload_kg

    @property
    def words(self) -> str:
        """The numbers and their source, for readers."""
        if math.isnan(self.moving_kg):
            return self.source
        payload = f", with {self.payload_kg:g} kg of tool and workpiece" if self.payload_kg else ""
        return f"{self.moving_kg:.3g} kg, {self.source}{payload}"


def robot_mass(settings: Robot, model: RobotModel) -> RobotMass:
    """Returns the mass of the robot of the settings.

    Args:
        settings: Section ``robot``.
        model: The robot.
    """
    if (known := _published(settings)) is not None:
        return known
    payload_kg = settings.payload_kg or 0.0
    if model.inertial:
        return RobotMass(model.moving_mass_kg, payload_kg, "its moving parts by the inertias of its URDF")
    return RobotMass(math.nan, payload_kg, "not known, as its URDF has no inertias; robot.mass_kg gives it")


def recorded_capsules_mass(settings: Robot) -> RobotMass:
    """Returns the mass of a robot that is recorded by its capsules and is not the one of the settings.

    Args:
        settings: Section ``robot``.
    """
    if settings.mass_kg is None:
        why = "not known, as the log holds its capsules alone; robot.mass_kg gives it"
        return RobotMass(math.nan, settings.payload_kg or 0.0, why)
    return RobotMass(settings.mass_kg, settings.payload_kg or 0.0, _SET)


_SET = "its moving parts as set by robot.mass_kg"


def _published(settings: Robot) -> RobotMass | None:
    """Returns the mass as the settings or the data sheet of the IRB 140 give it; None: only a URDF may give it."""
    ours = settings.urdf is None
    payload_kg = settings.payload_kg if settings.payload_kg is not None else irb140.PAYLOAD_KG if ours else 0.0
    if settings.mass_kg is not None:
        return RobotMass(settings.mass_kg, payload_kg, _SET)
    if ours:
        why = "the whole robot by its data sheet, which says nothing of the moving parts alone"
        return RobotMass(irb140.MASS_KG, payload_kg, why)
    return None


def contact_speeds(settings: Settings, limbs: Sequence[str], others: int) -> ContactSpeeds:
    """Returns the speeds at which links may touch limbs, ``pfl``.

    Where the settings give no mass, the robot counts as one that does not give way: its effective mass by a URDF
    depends on the posture and has no upper bound.

    Args:
        settings: All settings.
        limbs: Limbs with volumes.
        others: Number of volumes that are no limbs.
    """
    known = _published(settings.robot)
    robot_kg = math.inf if known is None else known.simple_kg
    allowed = settings.plan.contact_limbs
    speeds = [region_of(limb, robot_kg).speed_m_per_s(robot_kg) if limb in allowed else math.nan for limb in limbs]
    return ContactSpeeds(np.array(speeds), others)
