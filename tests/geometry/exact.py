"""The distance between a segment and a convex hull in rational arithmetic: slow, and without any rounding."""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import combinations

from hrcreplay.records import Floats

_Vector = list[Fraction]


def exact_distance(a: Floats, b: Floats, vertices: Floats) -> float:
    """Length of the shortest vector of the hull of all differences between a vertex and an end.

    Exchanges one difference after another, and ends when a plane across the vector leaves all of them behind it.

    Args:
        a: (3,) end of the segment [m].
        b: (3,) other end [m].
        vertices: (m, 3) [m].
    """
    points = [
        [Fraction(float(v)) - Fraction(float(e)) for v, e in zip(vertex, end, strict=True)]
        for vertex in vertices
        for end in (a, b)
    ]
    chosen = [min(points, key=lambda p: _dot(p, p))]
    while True:
        x, chosen = _shortest(chosen)
        length2 = _dot(x, x)
        deepest = min(points, key=lambda p: _dot(p, x))
        if length2 == 0 or _dot(deepest, x) >= length2:
            return math.sqrt(length2)
        chosen.append(deepest)


def _shortest(points: list[_Vector]) -> tuple[_Vector, list[_Vector]]:
    """Shortest vector of the hull of up to five points, and those of them that carry it: every face is tried."""
    best: tuple[Fraction, _Vector, list[_Vector]] | None = None
    for count in range(1, min(len(points), 4) + 1):
        for face in combinations(points, count):
            x = _foot(list(face))
            if x is not None and (best is None or _dot(x, x) < best[0]):
                best = _dot(x, x), x, list(face)
    assert best is not None
    return best[1], best[2]


def _foot(face: list[_Vector]) -> _Vector | None:
    """Foot of the perpendicular from the origin on a face; none where it is not inside or the face is flat."""
    edges = [[p - q for p, q in zip(point, face[0], strict=True)] for point in face[1:]]
    rows = [[_dot(e, f) for f in edges] + [-_dot(e, face[0])] for e in edges]
    for i in range(len(rows)):  # Gauss and Jordan
        pivot = next((k for k in range(i, len(rows)) if rows[k][i] != 0), None)
        if pivot is None:
            return None
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [value / rows[i][i] for value in rows[i]]
        for k in range(len(rows)):
            if k != i:
                rows[k] = [v - rows[k][i] * w for v, w in zip(rows[k], rows[i], strict=True)]
    weights = [row[-1] for row in rows]
    if any(w < 0 for w in weights) or sum(weights) > 1:
        return None
    return [face[0][c] + sum((w * e[c] for w, e in zip(weights, edges, strict=True)), Fraction(0)) for c in range(3)]


def _dot(p: _Vector, q: _Vector) -> Fraction:
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]
