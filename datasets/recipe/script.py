"""What the worker does and when: the way over the floor, posture, and where the wrists go.

World: z up, floor at z = 0, the robot's base above the origin, the worker on its +x side and mostly facing it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, radians
from typing import Literal

import numpy as np

from datasets.recipe.curves import Move, follow
from hrcreplay.records import Floats

DURATION_S = 60.0

#: Where a wrist's target is fixed: the room, or the chest (x forward, y to this arm's outside, from its shoulder).
Frame = Literal["world", "chest"]


@dataclass(frozen=True)
class Reach:
    """A minimum-jerk transition of one wrist to a place."""

    start_s: float
    duration_s: float
    place_m: tuple[float, float, float]
    frame: Frame = "world"


REST = (0.09, 0.05, -0.515)  #: arm hanging, elbow a little bent
READY = (0.27, -0.02, -0.36)  #: forearms in front of the belly
LOOK = (0.17, -0.10, -0.42)  #: hands folded low

#: The way of the body: start [s], duration [s], x, y [m].
_WAY = (
    (0.3, 3.5, 1.24, 0.04),
    (23.6, 1.3, 1.26, 0.26),
    (29.6, 1.2, 1.24, 0.05),
    (36.6, 1.8, 1.40, 0.22),
    (40.6, 1.9, 1.23, 0.10),
    (52.4, 1.2, 1.42, 0.06),
    (54.8, 4.6, 2.60, -0.50),
)
_START = (2.65, -0.25)

#: Start [s], duration [s], heading [deg].
_HEADING = ((2.8, 1.5, 177), (22.4, 1.2, 192), (29.2, 1.4, 174), (36.2, 1.9, 58), (40.3, 2.1, 180), (53.6, 2.4, 335))


def floor_way(t_s: Floats) -> tuple[Floats, Floats]:
    """(n, 2) place of the body on the floor [m] and (n,) heading [rad], unwrapped."""
    axes = [follow(t_s, _START[i], [Move(m[0], m[1], m[2 + i]) for m in _WAY]) for i in (0, 1)]
    heading = follow(t_s, radians(169), [Move(s, d, radians(h)) for s, d, h in _HEADING])
    return np.column_stack(axes), heading


#: Forward lean of the whole trunk [deg]: it is shared by hips and spine.
LEAN_DEG = (
    (8.2, 0.9, 14), (10.9, 0.8, 4), (13.2, 0.9, 11), (15.4, 0.8, 3), (17.0, 1.0, 22), (21.6, 1.2, 5),
    (25.6, 0.8, 12), (28.0, 0.8, 4), (31.0, 0.7, 13), (35.2, 0.8, 3), (38.3, 0.9, 20), (39.9, 0.9, 5),
    (42.8, 1.0, 21), (47.4, 1.1, 4), (48.6, 0.8, 12), (50.4, 0.9, 3),
)  # fmt: skip
#: Sideways bend of the spine, to the right positive [deg].
BEND_DEG = (
    (4.0, 1.5, 7), (8.2, 1.0, 13), (11.0, 1.2, -6), (13.2, 1.0, -12), (15.6, 1.4, 6), (17.2, 1.4, -7),
    (19.2, 1.2, 8), (21.8, 1.2, -7), (25.4, 1.0, 13), (28.2, 1.2, 6), (30.8, 1.0, -10), (33.2, 0.9, 12),
    (35.3, 1.0, -6), (38.2, 1.0, 9), (40.4, 1.4, -7), (42.8, 1.0, 7), (45.0, 1.0, -9), (47.6, 1.2, 6),
    (48.6, 0.9, 12), (50.6, 1.2, -7), (54.0, 1.0, 2),
)  # fmt: skip
#: Twist of the chest against the pelvis, to the left positive [deg].
TWIST_DEG = (
    (8.1, 1.0, 16), (11.0, 1.0, 2), (13.1, 0.9, -15), (15.4, 1.0, 0), (18.6, 1.0, 8), (20.2, 1.0, -6),
    (21.6, 1.0, 0), (25.5, 0.9, 15), (28.0, 0.9, 0), (30.9, 0.8, -12), (33.1, 0.8, 14), (35.2, 0.9, 0),
    (43.0, 1.0, 10), (45.0, 0.9, -8), (47.4, 1.0, 0), (48.5, 0.8, 14), (50.4, 0.9, 0),
)  # fmt: skip
#: Weight on one leg: pelvis to the left positive [m].
SHIFT_M = (
    (4.4, 1.2, 0.045), (8.2, 1.2, -0.03), (11.6, 1.4, 0.05), (15.6, 1.3, -0.045), (22.0, 1.4, 0.04), (27.8, 1.3, -0.05),
    (31.0, 1.4, 0.04), (35.4, 1.0, 0.0), (42.6, 1.2, -0.03), (45.6, 1.3, 0.045), (50.5, 1.0, 0.0),
)  # fmt: skip
#: Knees bent: pelvis lower than standing tall [m].
CROUCH_M = (
    (7.9, 1.2, 0.03), (11.0, 1.0, 0.005), (16.9, 1.4, 0.06), (21.8, 1.2, 0.0), (38.2, 1.0, 0.05), (40.0, 1.0, 0.0),
    (42.8, 1.2, 0.05), (47.4, 1.2, 0.0),
)  # fmt: skip
#: Where the head looks against the chest: down and to the left positive [deg].
NOD_DEG = (
    (4.2, 1.0, 11), (8.2, 0.8, 16), (11.2, 0.8, 8), (17.0, 0.8, 18), (21.8, 0.9, 8), (25.5, 0.8, 14),
    (36.0, 0.9, 5), (38.4, 0.8, 18), (40.2, 0.8, 7), (42.8, 0.9, 17), (47.6, 0.9, 10), (53.0, 1.0, 2),
)  # fmt: skip
GAZE_DEG = (
    (4.6, 0.8, 18), (7.6, 0.6, -16), (11.4, 0.7, 22), (15.8, 0.7, -20), (22.0, 0.8, 15), (28.4, 0.7, 24),
    (31.4, 0.6, -12), (36.0, 0.7, -28), (38.2, 0.8, 0), (40.0, 0.7, 26), (42.6, 0.8, -8), (47.8, 0.8, 20),
    (52.4, 0.7, 30), (54.6, 1.0, 0),
)  # fmt: skip

RIGHT = (
    Reach(4.6, 1.3, LOOK, "chest"),
    Reach(8.2, 0.85, (0.86, 0.26, 1.00)), Reach(9.4, 0.5, (0.87, 0.20, 1.05)), Reach(10.8, 0.9, READY, "chest"),
    Reach(13.4, 0.9, LOOK, "chest"),
    Reach(17.0, 1.1, (0.84, 0.20, 0.98)), Reach(18.7, 0.55, (0.86, 0.30, 1.00)), Reach(20.0, 0.55, (0.86, 0.18, 1.06)),
    Reach(21.5, 1.0, READY, "chest"), Reach(23.2, 1.0, REST, "chest"),
    Reach(25.5, 0.8, (0.85, 0.34, 1.02)), Reach(27.0, 0.45, (0.88, 0.28, 1.10)), Reach(28.0, 0.8, LOOK, "chest"),
    Reach(33.1, 0.75, (0.85, 0.24, 1.04)), Reach(34.2, 0.4, (0.84, 0.28, 0.98)), Reach(35.2, 0.8, REST, "chest"),
    Reach(38.2, 0.9, (1.74, 0.62, 0.98)), Reach(39.9, 1.0, READY, "chest"),
    Reach(42.8, 1.0, (0.84, 0.22, 1.00)), Reach(44.3, 0.5, (0.86, 0.30, 1.06)), Reach(45.9, 0.5, (0.85, 0.22, 0.98)),
    Reach(47.3, 0.9, LOOK, "chest"),
    Reach(48.6, 0.7, (0.85, 0.28, 1.05)), Reach(50.3, 0.8, READY, "chest"), Reach(53.4, 1.2, REST, "chest"),
)  # fmt: skip
LEFT = (
    Reach(5.0, 1.3, LOOK, "chest"),
    Reach(8.6, 1.0, READY, "chest"), Reach(11.0, 1.0, LOOK, "chest"),
    Reach(13.1, 0.85, (0.89, -0.20, 1.12)), Reach(14.3, 0.5, (0.86, -0.14, 1.06)), Reach(15.4, 0.85, READY, "chest"),
    Reach(17.2, 1.1, (0.86, -0.02, 1.00)), Reach(19.3, 0.6, (0.86, 0.04, 1.05)), Reach(20.6, 0.5, (0.87, -0.04, 0.99)),
    Reach(21.8, 1.0, LOOK, "chest"), Reach(23.4, 1.0, REST, "chest"), Reach(25.4, 1.2, READY, "chest"),
    Reach(28.2, 1.0, LOOK, "chest"),
    Reach(30.8, 0.75, (0.89, -0.16, 1.12)), Reach(32.2, 0.45, (0.86, -0.10, 1.05)), Reach(33.2, 0.8, READY, "chest"),
    Reach(35.4, 0.9, REST, "chest"), Reach(38.0, 0.9, (1.62, 0.78, 0.98)), Reach(39.8, 1.0, READY, "chest"),
    Reach(42.9, 1.0, (0.86, 0.00, 1.00)), Reach(44.9, 0.55, (0.86, -0.08, 1.06)), Reach(47.4, 0.9, READY, "chest"),
    Reach(50.4, 0.9, LOOK, "chest"), Reach(53.6, 1.2, REST, "chest"),
)  # fmt: skip


def channel(t_s: Floats, first: float, steps: Sequence[tuple[float, float, float]], unit: float = 1.0) -> Floats:
    """(n,) one of the tables above, times ``unit``."""
    return follow(t_s, first * unit, [Move(start, duration, value * unit) for start, duration, value in steps])


def degrees(t_s: Floats, first: float, steps: Sequence[tuple[float, float, float]]) -> Floats:
    """(n,) [rad] of a table in degrees."""
    return channel(t_s, first, steps, pi / 180.0)
