"""Walking, Eq. (25), by Gauss's rule on smooth pieces."""

from __future__ import annotations

import math

import numpy as np

from hrcreplay.records import Floats
from tests.tools.soundness.compiled import kernel
from tests.tools.soundness.joint import accelerate, rates_of, saturates

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)
#: In no panel of the rule the heading turns by more, nor its rate changes by much: so it is good to 1e-12 m.
_PANEL_RAD = 0.1


@kernel
def walk(q: Floats, v: Floats, wish: Floats, h: float, bounds: Floats) -> None:
    """Moves place, heading and their velocities on by h [s].

    Between the instants at which a velocity comes to its bound, all is smooth.
    """
    when = (
        saturates(v[0], wish[0], h, rates_of(bounds, 0)),
        saturates(v[1], wish[1], h, rates_of(bounds, 1)),
        saturates(v[2], wish[2], h, rates_of(bounds, 2)),
    )
    first, last = min(when), max(when)
    cuts = (0.0, first, when[0] + when[1] + when[2] - first - last, last, h)
    turn_rate = max(abs(v[2]), abs(v[2] + wish[2] * when[2]), math.sqrt(abs(wish[2])))
    dx, dy = 0.0, 0.0
    for i in range(4):
        length = cuts[i + 1] - cuts[i]
        panels = max(1, math.ceil(length * turn_rate / _PANEL_RAD)) if length > 0.0 else 0
        half = 0.5 * length / max(1, panels)
        for panel in range(panels):
            for node, weight in zip(_NODES, _WEIGHTS):  # noqa: B905 (numba knows no strict)
                t = cuts[i] + half * (2.0 * panel + 1.0 + node)
                forward = v[0] + wish[0] * min(t, when[0])
                left = v[1] + wish[1] * min(t, when[1])
                turning = min(t, when[2])
                theta = q[2] + v[2] * t + wish[2] * turning * (t - 0.5 * turning)
                c, s = math.cos(theta), math.sin(theta)
                dx += half * weight * (forward * c - left * s)
                dy += half * weight * (forward * s + left * c)
    q[0] += dx
    q[1] += dy
    for k in range(3):
        q_end, v[k], _, _ = accelerate(q[k], v[k], wish[k], h, rates_of(bounds, k))
        if k == 2:
            q[k] = q_end
