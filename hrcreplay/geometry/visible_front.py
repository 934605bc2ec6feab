"""What a viewer sees of a convex solid: at each pixel how near its front is, and how the face there is lit."""

from __future__ import annotations

import numpy as np
from numba import njit

from hrcreplay.records import Floats

#: A pixel so little outside a triangle, as a share of it, is on its edge: neighbours leave no gap between them.
_EDGE = 1e-9


@njit(cache=True)
def visible_front(triangles: Floats, light: Floats, u: Floats, v: Floats) -> tuple[Floats, Floats]:
    """Depth of the front of a convex solid at pixels, and the light on the face there.

    Only triangles that face the viewer are drawn, each on the pixels that it covers.

    Args:
        triangles: (f, 3, 3) corners of each, along the view's right, up and towards the viewer, counterclockwise seen
            from outside [m].
        light: (f,) on each of them.
        u: (columns,) of the pixels, to the right, evenly spaced [m].
        v: (rows,) of the pixels, up, evenly spaced [m].

    Returns:
        (rows, columns) depth [m], -inf beside the solid, and (rows, columns) light.
    """
    depth = np.full((len(v), len(u)), -np.inf)
    lit = np.zeros((len(v), len(u)))
    for f in range(len(triangles)):
        a, b, c = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        bu, bv, cu, cv = b[0] - a[0], b[1] - a[1], c[0] - a[0], c[1] - a[1]
        area = bu * cv - bv * cu
        if area <= 0.0:  # it faces away, or is seen from its edge
            continue
        first, last = np.searchsorted(v, min(a[1], b[1], c[1])), np.searchsorted(v, max(a[1], b[1], c[1]))
        left, right = np.searchsorted(u, min(a[0], b[0], c[0])), np.searchsorted(u, max(a[0], b[0], c[0]))
        for i in range(first, last):
            pv = v[i] - a[1]
            for j in range(left, right):
                pu = u[j] - a[0]
                of_b, of_c = (pu * cv - pv * cu) / area, (bu * pv - bv * pu) / area
                if of_b < -_EDGE or of_c < -_EDGE or of_b + of_c > 1.0 + _EDGE:
                    continue
                near = a[2] + of_b * (b[2] - a[2]) + of_c * (c[2] - a[2])
                if near > depth[i, j]:
                    depth[i, j], lit[i, j] = near, light[f]
    return depth, lit
