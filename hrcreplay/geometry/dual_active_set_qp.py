"""A small, exact solver for quadratic programs of a few variables."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from hrcreplay.geometry.vectors import dot_n, norm_n
from hrcreplay.records import Floats, Ints

#: A row of unit length in the metric of the cost is broken above this.
BROKEN = 1e-13

#: A row that cannot be taken up, and is broken by no more than this, counts as kept.
ROUNDING = 1e-10

#: Squared part of such a row across the held ones below which it depends on them.
DEPENDENT = 1e-18

#: Rows that may be taken up before the problem counts as unsolved.
STEPS = 200


class Working(NamedTuple):
    """A problem being solved: in the metric of the cost, ``y = L.T @ w``, H is the identity and rows have length 1."""

    L: Floats  #: (n, n) of H
    y: Floats  #: (n,)
    A: Floats  #: (most, n) rows as they were given
    high: Floats  #: (most,) their bounds
    E: Floats  #: (most, n) the rows in the metric
    h: Floats  #: (most,) their bounds there
    norms: Floats  #: (most,) the rows' lengths there
    z: Floats  #: (most,) multipliers there
    held: Ints  #: (n,) rows that y lies on


@njit(cache=True, error_model="numpy")
def working(H: Floats, g: Floats, most: int) -> Working:
    """A problem with room for ``most`` rows, at its minimiser without any."""
    n, L = len(g), _cholesky(H)
    A, E, h, norms, z = np.empty((most, n)), np.zeros((most, n)), np.empty(most), np.ones(most), np.zeros(most)
    return Working(L, _forward(L, -g), A, np.empty(most), E, h, norms, z, np.empty(n, dtype=np.int64))


@njit(cache=True, error_model="numpy")
def add(work: Working, i: int, row: Floats, sign: float, high: float) -> None:
    """Row i: ``sign * row @ w <= high``; inf where it has no bound.

    Args:
        work: Receives the row.
        i: Index of the row, less than ``most`` of ``working``.
        row: (n,) its coefficients.
        sign: 1 for an upper bound; -1 for a lower bound, which is given as ``high = -low``.
        high: Right-hand side, in the unit of ``row @ w``.
    """
    for k in range(len(row)):
        work.A[i, k] = sign * row[k]
    work.high[i] = work.h[i] = high
    e = _forward(work.L, work.A[i])
    length = norm_n(e)
    if length > 0.0:
        work.norms[i], work.h[i] = length, high / length
        for k in range(len(row)):
            work.E[i, k] = e[k] / length


@njit(cache=True, error_model="numpy")
def settle(work: Working, rows: int, count: int) -> int:
    """Goes on to the minimiser over the first rows, of which ``count`` are held; how many then are, -1 without one.

    The dual method of Goldfarb and Idnani: one broken row after the other is moved onto, in the metric of H, and rows
    are let go whose multipliers would turn negative. Exact after finitely many steps, also where rows repeat each
    other or leave no room. Rows may be added between two calls.
    """
    E, h, y = work.E[:rows], work.h, work.y
    for _ in range(STEPS):
        p = _worst(E, h, y)
        if p < 0:
            return count
        count, taken = _take(E, h, p, y, work.z, work.held, count)
        if taken:
            continue
        if dot_n(E[p], y) - h[p] <= ROUNDING:
            h[p] = dot_n(E[p], y)  # where the held rows leave no room, others are broken by rounding errors
        else:
            break
    return -1


@njit(cache=True, error_model="numpy")
def solution(work: Working, rows: int) -> tuple[Floats, Floats]:
    """``w`` (n,) and the rows' multipliers ``z``: where it has settled ``H @ w + g + A.T @ z = 0``, ``z >= 0``."""
    return _backward(work.L, work.y), work.z[:rows] / work.norms[:rows]


@njit(cache=True)
def _worst(E: Floats, h: Floats, y: Floats) -> int:
    """The row that y breaks most; -1 where all hold."""
    worst, most = -1, BROKEN
    for i in range(len(E)):
        broken = dot_n(E[i], y) - h[i]
        if broken > most:
            worst, most = i, broken
    return worst


@njit(cache=True, error_model="numpy")
def _take(E: Floats, h: Floats, p: int, y: Floats, z: Floats, held: Ints, count: int) -> tuple[int, bool]:
    """Moves y onto row p and lets go the rows that stand in the way, if they can be let go.

    Changes ``y``, ``z`` and ``held``; returns how many rows are held, and whether p is the last of them.
    """
    while True:
        r, across = _split(E, held, count, E[p])
        squared = dot_n(across, across)
        depends = count == len(y) or squared <= DEPENDENT
        full = np.inf if depends else (dot_n(E[p], y) - h[p]) / squared
        partial, leaving = np.inf, -1
        for j in range(count):
            if r[j] > 0.0 and z[held[j]] / r[j] < partial:
                partial, leaving = z[held[j]] / r[j], j
        step = min(full, partial)
        if step == np.inf:
            return count, False
        for j in range(count):
            z[held[j]] -= step * r[j]
        z[p] += step
        for k in range(0 if depends else len(y)):
            y[k] -= step * across[k]
        if full <= partial:
            held[count] = p
            return count + 1, True
        z[held[leaving]] = 0.0
        count -= 1
        for j in range(leaving, count):
            held[j] = held[j + 1]


@njit(cache=True, error_model="numpy")
def _split(E: Floats, held: Ints, count: int, e: Floats) -> tuple[Floats, Floats]:
    """A row as a combination of the held ones and the rest across them, by Gram and Schmidt."""
    basis, L = np.zeros((count, len(e))), np.zeros((count, count))
    for i in range(count):
        for c in range(len(e)):
            basis[i, c] = E[held[i], c]
        _remove(basis, i, basis[i], L[i])
        L[i, i] = norm_n(basis[i])
        for c in range(len(e)):
            basis[i, c] /= L[i, i]
    across, along = e.copy(), np.zeros(count)
    _remove(basis, count, across, along)
    return _backward(L, along), across


@njit(cache=True)
def _remove(basis: Floats, count: int, v: Floats, along: Floats) -> None:
    """Takes off v what lies along the first vectors of a basis, and adds up how much."""
    for _ in range(2):  # twice is enough
        for j in range(count):
            part = dot_n(basis[j], v)
            along[j] += part
            for c in range(len(v)):
                v[c] -= part * basis[j, c]


@njit(cache=True, error_model="numpy")
def _cholesky(H: Floats) -> Floats:
    n = len(H)
    L = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            rest = H[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(rest) if i == j else rest / L[j, j]
    return L


@njit(cache=True, error_model="numpy")
def _forward(L: Floats, b: Floats) -> Floats:
    """(n,) with ``L @ y = b``."""
    y = np.empty(len(b))
    for i in range(len(b)):
        rest = b[i]
        for k in range(i):
            rest -= L[i, k] * y[k]
        y[i] = rest / L[i, i]
    return y


@njit(cache=True, error_model="numpy")
def _backward(L: Floats, y: Floats) -> Floats:
    """(n,) with ``L.T @ w = y``."""
    w = np.empty(len(y))
    for i in range(len(y) - 1, -1, -1):
        rest = y[i]
        for k in range(i + 1, len(y)):
            rest -= L[k, i] * w[k]
        w[i] = rest / L[i, i]
    return w
