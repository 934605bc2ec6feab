"""What ``sound`` adds to the model's motions so that real people stay inside too."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Margins:
    """Margins of ``occupancy.method = "sound"``. ``paper`` and ``positions`` know none of them."""

    sigmas: float = 3.0  #: states within so many standard deviations of the estimate are enclosed, joint by joint
    latency_s: float = 0.0  #: from the newest capture to the robot's reaction; the horizon is longer by it [s]
    hand_m: float = 0.19  #: length of the hand, which goes on where the forearm ends [m]
    legs_radius_m: float = 0.20  #: least of the lower body, around the line from the floor to the pelvis [m]
    residual: bool = True  #: whether the body's distance from the model is added to the radii
    residual_m: float = 0.10  #: that distance as long as it is not known: of most people, ERRATA 'The human model' [m]
    memory_s: float = 0.5  #: a limb unseen for longer grows to what it could have reached since [s]
    legs: bool = True  #: whether there is a lower body


STANDARD = Margins()
