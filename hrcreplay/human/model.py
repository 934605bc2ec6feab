"""The human model of Eq. (37): limits and forward kinematics.

World: z up, floor at z = 0. Human base: on the floor under the pelvis, x forward, y left.
"""

from __future__ import annotations

from dataclasses import dataclass

from hrcreplay.records import Floats


@dataclass(frozen=True)
class LimitSet:
    """Bounds on the joints of Eq. (37), (12,) each, [m, m, rad...] and their derivatives.

    The velocity and acceleration bounds of x and y bound v (forward) and v_perp (to the left) in the body frame,
    Eq. (25), (26). Heading has no position bound (+-inf). Where ``coupled``, alpha_2 and alpha_3 obey (34b), (34c)
    and their own entries in ``p_min``/``p_max`` only enclose them.
    """

    name: str
    p_min: Floats
    p_max: Floats
    v_min: Floats
    v_max: Floats
    a_min: Floats
    a_max: Floats
    coupled: bool
