"""Whole quadratic programs by the solver of the controller, which itself takes rows one by one."""

from __future__ import annotations

import numpy as np

from hrcreplay.geometry.dual_active_set_qp import add, settle, solution, working
from hrcreplay.records import Floats


def minimiser(H: Floats, g: Floats) -> Floats:
    """(n,) minimiser of ``w @ H @ w / 2 + g @ w``; NaN where H is not positive definite."""
    return solution(working(H, g, 0), 0)[0]


def active_set(H: Floats, g: Floats, A: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Minimiser where ``A @ w <= high``, and the rows' multipliers; NaN without one."""
    m = len(high)
    work = working(H, g, m)
    for i in range(m):
        add(work, i, A[i], 1.0, high[i])
    if settle(work, m, 0) < 0:
        return np.full(len(g), np.nan), np.full(m, np.nan)
    return solution(work, m)
