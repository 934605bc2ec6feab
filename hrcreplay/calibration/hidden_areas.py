"""Where objects and the edges of the cameras' views may hide a person near the robot.

The floor around the robot is a grid. Over each of its points a person may stand; a height there is seen by a camera if
it lies in the camera's view and no object stands between. Nothing is guessed: only what the cell file states is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hrcreplay.geometry.distances import distances
from hrcreplay.records import FLOOR_Z_M, Bools, Floats, Ints

#: Distance from the robot's base within which the floor is looked at [m], and step of the grid [m].
AROUND_M, STEP_M = 2.0, 0.1
#: Heights of a standing person that are looked at [m].
HEIGHTS_M = np.arange(0.2, 1.81, 0.2)
#: Height of somebody who crouches [m].
CROUCHED_M = 1.0


class CameraView(NamedTuple):
    """What a camera sees: a pyramid along its z axis."""

    T_world_camera: Floats  #: (4, 4) z forward
    half_view_rad: tuple[float, float]  #: half of the field of view across and down
    range_m: float  #: greatest distance along z [m]


class HiddenFloor(NamedTuple):
    """Points of the floor around the robot and how much of a person over each is seen."""

    points_m: Floats  #: (n, 2) outside the objects, world [m]
    seen: Bools  #: (n, len(HEIGHTS_M)) whether any camera sees that height

    def area_m2(self, up_to_m: float) -> float:
        """Area of the floor over which no camera sees anything up to a height [m^2]."""
        return float(np.count_nonzero(self.hidden(up_to_m))) * STEP_M**2

    def hidden(self, up_to_m: float) -> Bools:
        """(n,) points over which no camera sees anything up to a height [m]."""
        return np.asarray(~self.seen[:, up_to_m + 1e-9 >= HEIGHTS_M].any(axis=1))


def hidden_floor(views: Sequence[CameraView], hulls: Sequence[tuple[Floats, float]], base_m: Floats) -> HiddenFloor:
    """Looks at the floor around a robot.

    Args:
        views: What the cameras see.
        hulls: Points (m, 3) of each convex part of the objects, world, and the radius around them [m].
        base_m: (3,) the robot's base, world [m].
    """
    steps = np.arange(-AROUND_M, AROUND_M + 0.5 * STEP_M, STEP_M)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    grid = grid[np.hypot(grid[:, 0], grid[:, 1]) <= AROUND_M] + base_m[:2]
    columns = np.empty((len(grid), len(HEIGHTS_M), 3))
    columns[:, :, :2], columns[:, :, 2] = grid[:, None], FLOOR_Z_M + HEIGHTS_M
    offsets = np.cumsum([0, *(len(points) for points, _ in hulls)])
    vertices = np.ascontiguousarray(np.concatenate([np.empty((0, 3)), *(points for points, _ in hulls)]))
    radius = np.array([radius for _, radius in hulls])
    places = columns.reshape(-1, 3)
    inside = _blocked(np.stack((places, places), axis=1), vertices, offsets, radius)
    seen = np.zeros(len(places), dtype=bool)
    for view in views:
        within = np.flatnonzero(~seen & ~inside & _in_view(view, places))
        eye = np.broadcast_to(view.T_world_camera[:3, 3], (len(within), 3))
        seen[within] = ~_blocked(np.stack((eye, places[within]), axis=1), vertices, offsets, radius)
    free = ~inside.reshape(len(grid), -1)[:, 0]  # somebody may stand or crouch where no object stands on the floor
    return HiddenFloor(grid[free], seen.reshape(len(grid), -1)[free])


def _in_view(view: CameraView, places_m: Floats) -> Bools:
    """(n,) places (n, 3) [m] in a camera's pyramid."""
    local = (places_m - view.T_world_camera[:3, 3]) @ view.T_world_camera[:3, :3]
    ahead = local[:, 2]
    across, down = (np.tan(half) * ahead for half in view.half_view_rad)
    return np.asarray(
        (ahead > 0.0) & (ahead <= view.range_m) & (np.abs(local[:, 0]) <= across) & (np.abs(local[:, 1]) <= down)
    )


def _blocked(ends_m: Floats, vertices_m: Floats, offsets: Ints, radius_m: Floats) -> Bools:
    """(n,) whether segments (n, 2, 3) [m] touch an object."""
    if not len(radius_m) or not len(ends_m):
        return np.zeros(len(ends_m), dtype=bool)
    low, _, _ = distances(np.ascontiguousarray(ends_m), vertices_m, offsets)
    return np.asarray((low <= radius_m).any(axis=1))


def hidden_notes(found: HiddenFloor, base_m: Floats) -> list[str]:
    """Notes on where somebody may be without being seen; none where the cameras see all of the floor."""
    notes = []
    for up_to_m, who in ((float(HEIGHTS_M[-1]), "somebody who stands"), (CROUCHED_M, "somebody who crouches")):
        hidden = found.hidden(up_to_m)
        if not hidden.any():
            continue
        apart = np.hypot(*(found.points_m[hidden] - base_m[:2]).T)
        x, y = found.points_m[hidden][int(np.argmin(apart))].tolist()
        notes.append(
            f"cameras: {who} is out of sight on {found.area_m2(up_to_m):.1f} m² of the floor within {AROUND_M:g} m of "
            f"the robot's base, behind objects or beyond the views; nearest at ({x:.1f}, {y:.1f}) m"
        )
    return notes
