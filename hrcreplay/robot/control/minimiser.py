"""The minimiser of Eq. (66) under its rows, by proxqp. The only user of proxsuite.

Every vertex of every limb has rows and the minimiser lies on few of them, so rows join in while the candidate breaks
any. Where the rows are soft, one slack [m/s] loosens all of them, so that there is always a solution.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import proxsuite

from hrcreplay.records import Floats, Ints
from hrcreplay.robot.control.approach_rows import Approach, worst_rows


class Limits(NamedTuple):
    """Bounds that do not depend on people."""

    low: Floats  #: (nv,) Eq. (66d)-(66f) [rad/s]
    high: Floats  #: (nv,) [rad/s]
    J: Floats  #: (6, nv) of the TCP
    J_low: Floats  #: (6,) Eq. (66g), (66h): bounds on ``J @ w`` [m/s, rad/s]
    J_high: Floats  #: (6,) [m/s, rad/s]


@dataclass(frozen=True, slots=True)
class Problem:
    """Minimise ``w @ H @ w / 2 + g @ w`` over the next joint velocity w [rad/s], within limits and clear of people."""

    H: Floats  #: (nv, nv)
    g: Floats  #: (nv,)
    limits: Limits
    rows: Approach  #: Eq. (66i)
    soft: bool  #: whether the rows of Eq. (66i) may be broken at a cost


@dataclass(frozen=True, slots=True)
class Solution:
    """The minimiser of Eq. (66)."""

    dq_next: Floats  #: (nv,) [rad/s]
    held: bool  #: whether an approach row holds the robot back
    slack: float  #: speed by which a link approaches a limb faster than its row allows; 0 where the rows are hard [m/s]


@dataclass(frozen=True, slots=True)
class Unsolved:
    """There is no minimiser, or none was found."""

    status: str  #: what went wrong


#: Weight of the squared slack: a row is broken by 1 mm/s rather than that the TCP is slower by 1 m/s.
SLACK = 1000.0
#: Rows broken by less than this speed hold [m/s].
HELD = 1e-7
#: Rounds in which rows may join in.
ROUNDS = 30
#: Multiplier above which a row holds the robot back.
BINDING = 1e-9

_dense = proxsuite.proxqp.dense
_SOLVED = proxsuite.proxqp.QPSolverOutput.PROXQP_SOLVED


def minimise(task: Problem) -> Solution | Unsolved:
    """The minimiser over all rows."""
    low, high, J, J_low, J_high = task.limits
    if not np.isfinite(task.H.sum() + task.g.sum() + low.sum() + high.sum() + J_low.sum() + J_high.sum()):
        return Unsolved("not finite")
    nv = len(task.g)
    n = nv + task.soft
    scale = 1.0 / task.H.diagonal().max()
    H, g = np.zeros((n, n)), np.zeros(n)
    H[:nv, :nv], g[:nv] = scale * task.H, scale * task.g
    A, bounds = np.zeros((nv + 6, n)), (np.concatenate((low, J_low)), np.concatenate((high, J_high)))
    A[:nv, :nv], A[nv:, :nv] = np.eye(nv), J
    if task.soft:
        H[nv, nv] = scale * SLACK
    known: set[tuple[int, ...]] = set()
    x, z = np.zeros(n), np.zeros(len(A))
    for _ in range(ROUNDS):
        qp = _dense.QP(n, 0, len(A), False, _dense.HessianType.Dense, _dense.DenseBackend.PrimalLDLT)
        qp.settings.eps_abs, qp.settings.eps_rel = 1e-9, 0.0
        qp.settings.initial_guess = proxsuite.proxqp.InitialGuess.WARM_START
        qp.init(H, g, None, None, A, *bounds)
        qp.solve(x, None, z)
        if qp.results.info.status != _SOLVED:
            return Unsolved(str(qp.results.info.status))
        x, z = np.array(qp.results.x), np.array(qp.results.z)
        w, slack = np.clip(x[:nv], low, high), max(0.0, float(x[nv])) if task.soft else 0.0
        which, new, room = _broken(task.rows, w, slack)
        if not len(which):
            return Solution(w, bool(np.any(z[nv + 6 :] > scale * BINDING)), slack)
        fresh = [i for i, key in enumerate(map(tuple, which.tolist())) if key not in known]
        if not fresh:
            return Unsolved("residual")
        known |= {tuple(which[i].tolist()) for i in fresh}
        rows = np.hstack((new[fresh], np.full((len(fresh), int(task.soft)), -1.0)))
        A, z = np.vstack((A, rows)), np.concatenate((z, np.zeros(len(fresh))))
        bounds = np.concatenate((bounds[0], np.full(len(fresh), -1e20))), np.concatenate((bounds[1], room[fresh]))
    return Unsolved("too many rows")


def _broken(rows: Approach, w: Floats, slack: float) -> tuple[Ints, Floats, Floats]:
    """Rows that a velocity breaks by more than the slack: which, (m, nv) and (m,) as speeds of approach [m/s]."""
    loose = rows._replace(room_m2=rows.room_m2 + rows.per_speed * (slack + HELD))
    which, A, _ = worst_rows(loose, w, 0.0)
    speed = rows.per_speed[which[:, 0], which[:, 1]]
    return which, A / speed[:, None], rows.room_m2[which[:, 0], which[:, 1]] / speed
