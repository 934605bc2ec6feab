"""What a viewer sees of a convex solid: at each pixel how near its front is, and how the face there is lit."""

from __future__ import annotations

import numpy as np
from numba import njit

from hrcreplay.records import Floats


@njit(cache=True)
def visible_front(normals: Floats, offsets: Floats, u: Floats, v: Floats) -> tuple[Floats, Floats]:
    """Depth of the front of a convex solid at pixels, and the light on the face there.

    A pixel's ray is inside between the last of the planes that face away and the first of those that face the viewer.

    Args:
        normals: (f, 4) of each face, its normal along the view's right, up and towards the viewer, and its light.
        offsets: (f,) of the faces' planes [m].
        u: (columns,) of the pixels, to the right [m].
        v: (rows,) of the pixels, up [m].

    Returns:
        (rows, columns) depth [m], -inf beside the solid, and (rows, columns) light.
    """
    front = np.full((len(v), len(u)), np.inf)
    back = np.full((len(v), len(u)), -np.inf)
    light = np.zeros((len(v), len(u)))
    for f in range(len(normals)):
        nu, nv, nt, lit = normals[f]
        if abs(nt) < 1e-9:
            continue
        along = -offsets[f] / nt - (nu / nt) * u
        up = nv / nt
        for i in range(len(v)):
            down = up * v[i]
            for j in range(len(u)):
                depth = along[j] - down
                if nt > 0:
                    if depth < front[i, j]:
                        front[i, j] = depth
                        light[i, j] = lit
                elif depth > back[i, j]:
                    back[i, j] = depth
    return np.where(front >= back, front, -np.inf), light
