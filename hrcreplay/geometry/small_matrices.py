"""Products, solutions and singular values of small matrices, in a fixed order of operations on every processor.

BLAS and LAPACK choose their code by the processor, and with it the order of sums: the last bits differ between
machines, and so may the whole path of a robot. So all results that influence the motion are computed here. Kernels
without fastmath neither reorder sums nor fuse a product with a sum.
"""

from __future__ import annotations

import math

import numpy as np

from hrcreplay.geometry.vectors import dot_n, norm_n
from hrcreplay.kernels import njit
from hrcreplay.records import Floats, Ints

_EPS = float(np.finfo(np.float64).eps)
_SWEEPS = 60  #: maximum number of sweeps of Jacobi's rotations; about ten suffice


@njit(cache=True)
def multiply(A: Floats, B: Floats) -> Floats:
    """(n, m) product of (n, k) and (k, m)."""
    C = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            for k in range(A.shape[1]):
                C[i, j] += A[i, k] * B[k, j]
    return C


@njit(cache=True)
def apply(A: Floats, x: Floats) -> Floats:
    """(n,) product of (n, k) and (k,)."""
    y = np.empty(len(A))
    for i in range(len(A)):
        y[i] = dot_n(A[i], x)
    return y


@njit(cache=True, error_model="numpy")
def solve(A: Floats, b: Floats) -> Floats:
    """(n,) with ``A @ x = b`` by elimination with row pivots; not finite where A (n, n) is singular."""
    n, U, x = len(b), A.copy(), b.copy()
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(U[i, k]) > abs(U[pivot, k]):
                pivot = i
        for j in range(n):
            U[k, j], U[pivot, j] = U[pivot, j], U[k, j]
        x[k], x[pivot] = x[pivot], x[k]
        for i in range(k + 1, n):
            share = U[i, k] / U[k, k]
            for j in range(k, n):
                U[i, j] -= share * U[k, j]
            x[i] -= share * x[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            x[k] -= U[k, j] * x[j]
        x[k] /= U[k, k]
    return x


@njit(cache=True, error_model="numpy")
def cholesky(H: Floats) -> Floats:
    """(n, n) lower triangle L with ``L @ L.T = H``; NaN where H is not positive definite."""
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
def solve_lower(L: Floats, b: Floats) -> Floats:
    """(n,) with ``L @ y = b`` for a lower triangle."""
    y = np.empty(len(b))
    for i in range(len(b)):
        rest = b[i]
        for k in range(i):
            rest -= L[i, k] * y[k]
        y[i] = rest / L[i, i]
    return y


@njit(cache=True, error_model="numpy")
def solve_transposed(L: Floats, y: Floats) -> Floats:
    """(n,) with ``L.T @ x = y`` for a lower triangle."""
    x = np.empty(len(y))
    for i in range(len(y) - 1, -1, -1):
        rest = y[i]
        for k in range(i + 1, len(y)):
            rest -= L[k, i] * x[k]
        x[i] = rest / L[i, i]
    return x


@njit(cache=True)
def singular_values(A: Floats) -> tuple[Floats, Floats, Floats]:
    """``A = U @ diag(s) @ V.T`` by Jacobi's one-sided rotations (Hestenes).

    Args:
        A: (n, m), of any shape.

    Returns:
        ``U`` (n, m), its columns zero where s is; ``s`` (m,), the largest first; ``V`` (m, m).
    """
    m = A.shape[1]
    rows, turns = np.empty((m, A.shape[0])), np.eye(m)
    rows[:] = A.T  # a copy, whatever A's order in memory
    for _ in range(_SWEEPS):
        turned = False
        for p in range(m):
            for q in range(p + 1, m):
                turned = _make_orthogonal(rows, turns, p, q) or turned
        if not turned:
            break
    s = np.empty(m)
    for j in range(m):
        s[j] = norm_n(rows[j])
    order = np.argsort(-s, kind="mergesort")
    U, V = np.zeros((A.shape[0], m)), np.empty((m, m))
    for k in range(m):
        j = order[k]
        V[:, k] = turns[j]
        if s[j] > 0.0:
            U[:, k] = rows[j] / s[j]
    return U, s[order], V


@njit(cache=True, inner=True)
def _make_orthogonal(rows: Floats, turns: Floats, p: int, q: int) -> bool:
    """Rotates two rows in their plane until they are orthogonal, in place; returns True if they were not."""
    a, b, c = dot_n(rows[p], rows[p]), dot_n(rows[q], rows[q]), dot_n(rows[p], rows[q])
    if not abs(c) > _EPS * math.sqrt(a * b):
        return False
    zeta = (b - a) / (2.0 * c)
    t = math.copysign(1.0, zeta) / (abs(zeta) + math.sqrt(1.0 + zeta * zeta))
    cosine = 1.0 / math.sqrt(1.0 + t * t)
    sine = cosine * t
    for matrix in (rows, turns):
        for k in range(matrix.shape[1]):
            u, v = matrix[p, k], matrix[q, k]
            matrix[p, k], matrix[q, k] = cosine * u - sine * v, sine * u + cosine * v
    return True


@njit(cache=True)
def least_norm(A: Floats, b: Floats, smallest: float) -> Floats:
    """(m,) shortest x that minimises ``|A @ x - b|``, as the pseudoinverse of A (n, m) gives it.

    Args:
        A: (n, m).
        b: (n,).
        smallest: Singular values below this share of the largest count as zero.
    """
    U, s, V = singular_values(A)
    x = np.zeros(A.shape[1])
    for k in range(len(s)):
        if s[k] > smallest * s[0]:
            share = 0.0
            for i in range(len(b)):
                share += U[i, k] * b[i]
            for j in range(len(x)):
                x[j] += share / s[k] * V[j, k]
    return x


@njit(cache=True, error_model="numpy")
def least_squares(A: Floats, b: Floats) -> Floats:
    """(m,) x that minimises ``|A @ x - b|``, by Householder's reflections; not finite if columns of A are dependent."""
    R, y, m = A.copy(), b.copy(), A.shape[1]
    v = np.zeros(len(b))
    for k in range(m):
        v[:] = 0.0
        v[k:] = R[k:, k]
        v[k] += math.copysign(norm_n(v), v[k])
        length = dot_n(v, v)
        if length == 0.0:
            return np.full(m, np.nan)
        for j in range(k, m):
            share = 2.0 * dot_n(v, R[:, j]) / length
            for i in range(k, len(b)):
                R[i, j] -= share * v[i]
        share = 2.0 * dot_n(v, y) / length
        for i in range(k, len(b)):
            y[i] -= share * v[i]
    x = y[:m].copy()
    for k in range(m - 1, -1, -1):
        for j in range(k + 1, m):
            x[k] -= R[k, j] * x[j]
        x[k] /= R[k, k]
    return x


@njit(cache=True)
def nonnegative_least_squares(A: Floats, b: Floats, most: int) -> tuple[Floats, bool]:
    """Finds the x >= 0 (m,) that minimises ``|A @ x - b|``, by the algorithm of Lawson and Hanson.

    Args:
        A: (n, m).
        b: (n,).
        most: Maximum number of columns that are added.

    Returns:
        x, and True if it is the minimiser.
    """
    m = A.shape[1]
    x, chosen = np.zeros(m), np.zeros(0, np.int64)
    enough = 10.0 * _EPS * max(A.shape[0], m) * norm_n(b) * max(1.0, np.abs(A).max())
    for _ in range(most):
        wider, z = _join_steepest(A, b, x, chosen, enough)
        if len(wider) == len(chosen):
            return x, True
        chosen = wider
        while len(chosen) and not z.min() > 0.0:
            chosen = _leave_first(x, chosen, z)
            z = least_squares(A[:, chosen], b)
        for i, k in enumerate(chosen):
            x[k] = z[i]
    return x, False


@njit(cache=True, inner=True)
def _join_steepest(A: Floats, b: Floats, x: Floats, chosen: Ints, enough: float) -> tuple[Ints, Floats]:
    """Adds the steepest independent column, if any; returns the chosen columns and their solution."""
    rest = b.copy()
    for k in chosen:
        rest -= A[:, k] * x[k]
    slopes = np.array([dot_n(A[:, k], rest) for k in range(len(x))])
    slopes[chosen] = -np.inf
    while True:
        best = int(np.argmax(slopes))
        if not slopes[best] > enough:
            return chosen, x[chosen]
        wider = np.append(chosen, best)
        z = least_squares(A[:, wider], b)
        if z[-1] > 0.0 and np.isfinite(z).all():
            return wider, z
        slopes[best] = -np.inf


@njit(cache=True, inner=True)
def _leave_first(x: Floats, chosen: Ints, z: Floats) -> Ints:
    """Moves x towards z until the first weight becomes 0, in place; returns the remaining columns."""
    share, leaves = 1.0, 0
    for i, k in enumerate(chosen):
        if z[i] <= 0.0 and x[k] <= share * (x[k] - z[i]):
            share, leaves = x[k] / (x[k] - z[i]), i
    for i, k in enumerate(chosen):
        x[k] += share * (z[i] - x[k])
    x[chosen[leaves]] = 0.0
    return np.concatenate((chosen[:leaves], chosen[leaves + 1 :]))
