"""Content of the 3-D replay of a run, at a steady rate: robot, person, volumes, and each method's motion."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from hrcreplay.human.model import skeleton
from hrcreplay.records import JOINTS, LENGTHS, OF_PERSON, POINTS, RECORDED, Bools, Floats, Ints
from hrcreplay.reporting.figures.drawing import BONES
from hrcreplay.reporting.metrics.contact import StopEvent, method_prefixes, motion_of, stop_events
from hrcreplay.reporting.metrics.people import named_volumes
from hrcreplay.reporting.metrics.planning import numeric_column
from hrcreplay.reporting.metrics.series import columns, seconds_from, times
from hrcreplay.reporting.robot_description import LinkFrame, link_frames, with_capsules
from hrcreplay.robot import irb140, irb140_shape
from hrcreplay.robot.control.static_obstacles import StaticHull
from hrcreplay.robot.control.stops import stop_axis_by_axis
from hrcreplay.robot.irb140_shape import Solid
from hrcreplay.robot.model import RobotModel, Segment
from hrcreplay.settings.sections import setting
from hrcreplay.store.memory import release_freed_memory
from hrcreplay.store.run_folder import Run
from hrcreplay.store.stored_table import RunTable, number_columns, rows_where, text_column

#: Rate of the replay [Hz], and the length of a run up to which it is whole; of a longer run the rate is lower [s].
RATE_HZ, WHOLE_S = 25.0, 600.0
#: Maximum rate of volumes in the replay [Hz], and that of a longer run.
VOLUME_HZ, LONG_VOLUME_HZ = 12.5, 5.0
#: Number of people up to which each is drawn on its own; of more, those who are there in turn are drawn as one, as the
#: numbers of a long run with many visitors would fill the memory.
_APART = 8
#: Maximum age of a row of a table at an instant [s].
_STALE_S = 0.2
#: Frames whose skeletons are computed together.
_TOGETHER = 4096
#: Shown body points of a fused person.
SHOWN_POINTS = tuple(dict.fromkeys(name for bone in BONES for name in bone))
#: Lines between them.
_PAIRS = np.array([[SHOWN_POINTS.index(a), SHOWN_POINTS.index(b)] for a, b in BONES])


@dataclass(frozen=True)
class LinkMesh:
    """The surface of a body of the robot in the world, with all axes at zero."""

    link: int  #: index of the robot's link whose capsule surrounds it; -1: none
    vertices_m: Floats  #: (k, 3)
    triangles: Ints  #: (t, 3) indices of vertices
    axes: int = -1  #: number of axes, counted from the base, that move it; -1: those of its link


@dataclass(frozen=True)
class RobotGeometry:
    """A serial robot for drawing: its geometry with all axes at zero in the world, and the screws of its axes."""

    links: tuple[str, ...]  #: (s,) names
    radius_m: Floats  #: (s,) radii of the links' capsules
    ends_m: Floats  #: (s, 2, 3) ends of their axes
    moved_by: Ints  #: (s,) number of axes, counted from the base, that move the link
    screws: Floats  #: (nv, 6) screws of unit rates: velocity of the point at the world's origin, angular velocity
    tcp_m: Floats  #: (3,)
    base_m: Floats  #: (3,)
    meshes: tuple[LinkMesh, ...]  #: meshes of the links that have one, and of the base
    solids: tuple[Solid, ...] = ()  #: convex parts of these meshes in the world, if they are known
    urdf: str = ""  #: text to draw it from
    joints: tuple[str, ...] = ()  #: (nv,) names of its axes there
    frames: tuple[LinkFrame, ...] = ()  #: its links there
    T_world_root: Floats = field(default_factory=lambda: np.eye(4))  #: (4, 4) pose of the root of them

    def axes_of(self, mesh: LinkMesh) -> int:
        """Number of axes that move a mesh."""
        return int(self.moved_by[mesh.link]) if mesh.axes < 0 else mesh.axes


class CameraSight(NamedTuple):
    """A camera and the pyramid that it sees, as far as it is drawn."""

    name: str
    T_world_camera: Floats  #: (4, 4) z forward
    half_view: tuple[float, float]  #: tangents of half of the field of view, across and down
    known: bool  #: False: nothing states the field of view, and a usual one is drawn

    def corners_m(self, depth_m: float) -> Floats:
        """(5, 3) the camera and the corners of its view at a depth along its axis [m], world [m]."""
        across, down = self.half_view
        corners = [[0.0, 0.0, 0.0], *([s * across, t * down, 1.0] for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1)))]
        return depth_m * np.array(corners) @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3]


#: Drawn where nothing states the field of view, across and down [deg]; that of a usual depth camera.
_USUAL_VIEW_DEG = (58.0, 45.0)


def camera_sights(meta: Mapping[str, Any]) -> Iterator[CameraSight]:
    """Yields the cameras that run.json knows the poses of."""
    views = (meta.get("cell") or {}).get("views") or {}
    for name, T in sorted((meta.get("cameras") or {}).items()):
        fov_deg = (views.get(name) or {}).get("fov_deg")
        half = np.tan(0.5 * np.radians(fov_deg or _USUAL_VIEW_DEG)).tolist()
        yield CameraSight(name, np.array(T), (half[0], half[1]), fov_deg is not None)


@dataclass(frozen=True)
class MethodTrack:
    """Motion of one method, one row per instant; NaN and -1 if its table has no value."""

    q: Floats  #: (n, nv) [rad]
    stop_q: Floats  #: (n, nv) end of the stop that would follow [rad]
    ref_m: Floats  #: (n, 3) programmed TCP, world
    tcp_m: Floats  #: (n, 3) driven TCP, world
    ref_speed: Floats  #: (n,) [m/s]
    tcp_speed: Floats  #: (n,) [m/s]
    distance_m: Floats  #: (n,) distance from the space that the person can reach until the horizon
    body_m: Floats  #: (n,) distance from the recorded body
    horizon_s: Floats  #: (n,)
    certified: Ints  #: (n,) 1, 0, or -1 if the table has no value
    names: dict[str, tuple[tuple[str, ...], Ints]]  #: status, reason, limb, link: all names, and (n,) indices or -1
    events: tuple[StopEvent, ...]


@dataclass(frozen=True)
class VolumeTrack:
    """The swept volumes as stored: rows of (instant, limb)."""

    t_ns: Ints  #: (k,)
    limb: Ints  #: (k,) index into ``limbs``
    radius_m: Floats  #: (k,) radius of the ball around the hull
    offsets: Ints  #: (k + 1,) hull ``i`` is ``vertices_m[offsets[i] : offsets[i + 1]]``
    vertices_m: Floats  #: (m, 3) world
    horizon_s: Floats  #: (k,) horizon after the instant; NaN if the table has no value
    limbs: tuple[str, ...]
    rate_hz: float  #: maximum number of instants a second

    def rows(self, which: Ints) -> VolumeTrack:
        """Selects some rows."""
        counts = np.diff(self.offsets)[which]
        parts = [self.vertices_m[self.offsets[i] : self.offsets[i + 1]] for i in which.tolist()]
        return VolumeTrack(
            t_ns=self.t_ns[which],
            limb=self.limb[which],
            radius_m=self.radius_m[which],
            offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            vertices_m=np.concatenate(parts) if parts else np.zeros((0, 3)),
            horizon_s=self.horizon_s[which],
            limbs=self.limbs,
            rate_hz=self.rate_hz,
        )


@dataclass(frozen=True)
class ReplayScene:
    """All moving parts of the 3-D replay, at ``rate_hz``."""

    t0_ns: int  #: instant of time zero of the report
    t_ns: Ints  #: (n,)
    points_m: Floats  #: (n, k * len(SHOWN_POINTS), 3) the fused people, one after the other
    body_m: Floats  #: (n, p, 2, 3) ends of the capsules of all recorded bodies; p is 0 without a comparison
    body_parts: tuple[str, ...]  #: (p,) named with the person
    body_radius_m: Floats  #: (p,)
    volumes: VolumeTrack
    robot: RobotGeometry
    methods: dict[str, MethodTrack]  #: the run's own first
    watched_m: Floats  #: (k, 2) corners of the watched area, on the floor; k is 0 if the cell gives none
    objects: tuple[StaticHull, ...] = ()  #: convex parts of the objects of the cell, without half-spaces
    people: tuple[str, ...] = ("1",)  #: (k,) numbers of the people; "7 or another": of several, there in turn
    cameras: tuple[CameraSight, ...] = ()
    rate_hz: float = RATE_HZ

    @property
    def bones(self) -> Ints:
        """(b, 2) lines of the skeletons of all people, as indices of points."""
        return np.concatenate([_PAIRS + k * len(SHOWN_POINTS) for k in range(len(self.people))])

    @property
    def seconds(self) -> Floats:
        """(n,) instants on the report's clock [s]."""
        return seconds_from(self.t_ns, self.t0_ns)


def robot_geometry(robot: RobotModel, urdf: str | None = None) -> RobotGeometry:
    """Makes a robot with all axes at zero. A link's twist at unit velocity of an axis is the axis' screw, or zero.

    Args:
        robot: The robot.
        urdf: Text that it was made of; None: this project's IRB 140.
    """
    zero = np.zeros((robot.nv, robot.nv))
    motion = robot.link_motion(zero, np.eye(robot.nv))
    moves = np.abs(motion.twist[:, :, 3:]).sum(axis=2) > 0.0  # (nv, s)
    urdf = irb140.urdf() if urdf is None else urdf
    frames = link_frames(urdf, robot.joint_names)
    T_root_base = next((one.T_root_link for one in frames if one.name == robot.base_frame), np.eye(4))
    screws, look = motion.twist[np.arange(robot.nv), np.argmax(moves, axis=1)], own_look(robot)
    return RobotGeometry(
        links=tuple(segment.name for segment in robot.segments),
        radius_m=np.array([segment.radius_m for segment in robot.segments]),
        ends_m=motion.ends_m[0],
        moved_by=np.where(moves.any(axis=0), robot.nv - np.argmax(moves[::-1], axis=0), 0),
        screws=screws,
        tcp_m=robot.pose(zero[0], zero[0]).T_world_tcp[:3, 3],
        base_m=robot.T_world_base[:3, 3],
        meshes=own_meshes(look) if look else tuple(_meshes(robot, motion.ends_m[0, :, 0], zero[0])),
        solids=look,
        urdf=with_capsules(urdf, robot.segments),
        joints=robot.joint_names,
        frames=frames,
        T_world_root=robot.T_world_base @ np.linalg.inv(T_root_base),
    )


#: Number of axes that move a body of the IRB 140 -> its link whose capsule surrounds it.
_LINK_AROUND = {1: 0, 2: 1, 3: 2, 5: 3}


def own_look(robot: RobotModel) -> tuple[Solid, ...]:
    """Returns the solids of this project's IRB 140 in the world, with all axes at zero; none of another robot."""
    own = tuple(Segment(*capsule) for capsule in irb140.capsules(0.0)[:-1])
    if robot.name != "irb140" or robot.segments[: len(own)] != own:
        return ()
    R, p = robot.T_world_base[:3, :3], robot.T_world_base[:3, 3]
    return tuple(one._replace(vertices_m=one.vertices_m @ R.T + p) for one in irb140_shape.solids())


def own_meshes(look: Sequence[Solid]) -> tuple[LinkMesh, ...]:
    """Returns solids as one mesh for each body of the IRB 140."""
    meshes = []
    for axes in sorted({one.axes for one in look}):
        parts = [one for one in look if one.axes == axes]
        first = np.cumsum([0, *(len(one.vertices_m) for one in parts)])
        triangles = np.concatenate([one.triangles + k for one, k in zip(parts, first, strict=False)])
        vertices_m = np.concatenate([one.vertices_m for one in parts])
        meshes.append(LinkMesh(_LINK_AROUND.get(axes, -1), vertices_m, triangles, axes))
    return tuple(meshes)


#: Maximum number of triangles of a drawn mesh; larger meshes are simplified.
_TRIANGLES = 8000


def _meshes(robot: RobotModel, start_m: Floats, q: Floats) -> Iterator[LinkMesh]:
    """Returns the links' meshes in the world at joint positions (nv,) [rad]; links begin at (s, 3) [m]."""
    for link, (segment, turn) in enumerate(zip(robot.segments, robot.R_bodies(q), strict=True)):
        if segment.surface is not None and len(segment.surface.triangles):
            vertices_m, triangles = coarser(segment.surface.vertices_m, segment.surface.triangles, _TRIANGLES)
            yield LinkMesh(link, (vertices_m - segment.start_m) @ turn.T + start_m[link], triangles)


def coarser(vertices_m: Floats, triangles: Ints, most: int) -> tuple[Floats, Ints]:
    """Simplifies a mesh to a maximum number of triangles: merges the vertices in each cell of a grid to their mean.

    Args:
        vertices_m: (k, 3) [m].
        triangles: (t, 3) indices of vertices.
        most: Maximum number of triangles.

    Returns:
        (k, 3) vertices [m] and (t, 3) triangles.
    """
    cell_m = 1e-4
    while True:
        cells, owner = np.unique(np.round(vertices_m / cell_m), axis=0, return_inverse=True)
        owner = owner.ravel()
        corners = owner[triangles]
        corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
        if len(corners) <= most:
            count = np.bincount(owner, minlength=len(cells))
            mean = [np.bincount(owner, axis, minlength=len(cells)) / count for axis in vertices_m.T]
            return np.column_stack(mean), corners
        cell_m *= 1.5


def placements(robot: RobotGeometry, q: Floats) -> Iterator[tuple[Rotation, Floats]]:
    """Computes the pose of each link relative to that with all axes at zero: products of exponentials.

    Args:
        robot: Its screws.
        q: (n, nv) [rad].

    Yields:
        For each axis, from the base on: n rotations and (n, 3) positions [m].
    """
    turned, at_m = Rotation.identity(len(q)), np.zeros((len(q), 3))
    for angle, screw in zip(q.T, robot.screws, strict=True):
        foot = np.cross(screw[3:], screw[:3])  # the point of the axis nearest to the world's origin
        turn = Rotation.from_rotvec(angle[:, None] * screw[3:])
        at_m = at_m + turned.apply(foot - turn.apply(foot))
        turned = turned * turn
        yield turned, at_m


def pose_links(robot: RobotGeometry, q: Floats) -> Floats:
    """Returns (n, s, 2, 3) ends of the links' axes in the world [m] at joint positions (n, nv) [rad]; keeps NaN."""
    known = np.asarray(np.isfinite(q).all(axis=1))
    ends = np.repeat(robot.ends_m[None], len(q), axis=0)
    for axis, (turned, at_m) in enumerate(placements(robot, np.where(known[:, None], q, 0.0)), start=1):
        for i in np.flatnonzero(robot.moved_by == axis).tolist():
            for end in (0, 1):
                ends[:, i, end] = turned.apply(robot.ends_m[i, end]) + at_m
    ends[~known] = np.nan
    return ends


def replay_scene(
    run: Run, robot: RobotModel, t0_ns: int, radii_m: Mapping[str, float], objects: Sequence[StaticHull] = ()
) -> ReplayScene | None:
    """Makes the replay of a run with a robot; None for other runs.

    Args:
        run: The run's tables, with all people.
        robot: The robot of the run at its base pose.
        t0_ns: Instant of time zero of the report [ns].
        radii_m: Part of a recorded body -> radius of its capsule [m].
        objects: Convex parts of the objects of the cell, without half-spaces.
    """
    if run.motion is None or len(run.motion) < 2 or "q1" not in run.motion:
        return None
    first, last = (int(t) for t in times(run.motion)[[0, -1]])
    every = max(1, math.ceil((last - first) * 1e-9 / WHOLE_S))
    step_ns = every * round(1e9 / RATE_HZ)
    t_ns = first + step_ns * np.arange((last - first) // step_ns + 1)
    parts = tuple(part for part in radii_m if run.body is not None and f"{part}_0_x" in run.body)
    prefixes = sorted(method_prefixes(run).items(), key=lambda pair: pair[1] != "plan")
    tables = {method: motion_of(run, prefix) for method, prefix in prefixes}
    if RECORDED in tables and not tables[RECORDED]["q1"].notna().any():  # its joints are not recorded
        del tables[RECORDED]
    slow = float(setting(run.meta.get("settings", {}), "report", "stationary_m_per_s"))
    people, points_m, body_m = _people(run, parts, t_ns)
    return ReplayScene(
        t0_ns=t0_ns,
        t_ns=t_ns,
        points_m=points_m,
        body_m=body_m,
        body_parts=tuple(part if one == "1" else f"{part}{OF_PERSON}{one}" for one in people for part in parts),
        body_radius_m=np.tile([radii_m[part] for part in parts], len(people)),
        volumes=volume_track(named_volumes(run.occupancy), VOLUME_HZ if every == 1 else LONG_VOLUME_HZ),
        robot=robot_geometry(robot, (run.meta.get("urdf") or {}).get("text")),
        methods={name: _track(run, name, table, robot, t_ns, t0_ns, slow) for name, table in tables.items()},
        watched_m=np.array(((run.meta.get("cell") or {}).get("watched") or {}).get("corners_m", [])).reshape(-1, 2),
        objects=tuple(objects),
        people=people,
        cameras=tuple(camera_sights(run.meta)),
        rate_hz=RATE_HZ / every,
    )


def _people(run: Run, parts: tuple[str, ...], t_ns: Ints) -> tuple[tuple[str, ...], Floats, Floats]:
    """Returns ``people``, ``points_m`` and ``body_m`` of a scene, for the parts of bodies at instants (n,) [ns]."""
    spans = [_span(run.of_person(number), t_ns) for number in run.people]
    drawn = [[k] for k in range(len(spans))] if len(spans) <= _APART else _in_turn(spans)
    shown = len(SHOWN_POINTS)
    points_m = np.full((len(t_ns), len(drawn) * shown, 3), np.nan)
    body_m = np.full((len(t_ns), len(drawn) * len(parts), 2, 3), np.nan)
    for i, members in enumerate(drawn):
        for k in members:
            rows, one = slice(*spans[k]), run.of_person(run.people[k])
            points_m[rows, i * shown : (i + 1) * shown] = _fused(one.state, t_ns[rows])
            body_m[rows, i * len(parts) : (i + 1) * len(parts)] = _body(one.body, parts, t_ns[rows])
    names = tuple(f"{run.people[k]}" + " or another" * bool(more) for k, *more in drawn)
    return names, points_m, body_m


def _span(one: Run, t_ns: Ints) -> tuple[int, int]:
    """Returns from which to before which of instants (n,) [ns] a person may be shown."""
    tables = [table for table in (one.state, one.body) if table is not None and len(table)]
    if not tables:
        return 0, 0
    ends_ns = np.array([times(table)[[0, -1]] for table in tables])
    last_ns = int(ends_ns[:, 1].max()) + round(_STALE_S * 1e9)
    return int(np.searchsorted(t_ns, ends_ns[:, 0].min())), int(np.searchsorted(t_ns, last_ns, side="right"))


def _in_turn(spans: Sequence[tuple[int, int]]) -> list[list[int]]:
    """Distributes people with these spans: the first one alone, the others with those who are gone before they come."""
    found = [[0]]
    for k in sorted(range(1, len(spans)), key=lambda k: spans[k]):
        free = [members for members in found[1:] if spans[members[-1]][1] <= spans[k][0]]
        if free:
            free[0].append(k)
        else:
            found.append([k])
    return found


def _rows(table: RunTable, at_ns: Ints) -> tuple[Ints, Bools]:
    """Returns the last row of a table at each instant, and True if it is recent enough."""
    t_ns = times(table)
    row = np.searchsorted(t_ns, at_ns, side="right") - 1
    known = (row >= 0) & (at_ns - t_ns[np.maximum(row, 0)] <= _STALE_S * 1e9)
    return np.maximum(row, 0), known


def _pick(table: RunTable, names: list[str], at_ns: Ints) -> Floats:
    """Returns (n, len(names)) numbers of a table at some instants; NaN without a recent row."""
    if not len(table) or not set(names) <= set(table.columns):
        return np.full((len(at_ns), len(names)), np.nan)
    row, known = _rows(table, at_ns)
    found = np.empty((len(at_ns), len(names)))
    for k, name in enumerate(names):  # column by column: all of a long run would be in memory three times
        found[:, k] = table[name].to_numpy(dtype=float)[row]
    found[~known] = np.nan
    return found


def _fused(state: RunTable | None, at_ns: Ints) -> Floats:
    if state is None:
        return np.full((len(at_ns), len(SHOWN_POINTS), 3), np.nan)
    points = skeleton(_pick(state, list(JOINTS), at_ns), _pick(state, list(LENGTHS), at_ns))
    return np.asarray(points[:, [POINTS.index(name) for name in SHOWN_POINTS]])


def _body(body: RunTable | None, parts: tuple[str, ...], at_ns: Ints) -> Floats:
    if body is None:
        return np.zeros((len(at_ns), 0, 2, 3))
    names = [f"{part}_{end}_{axis}" for part in parts for end in (0, 1) for axis in "xyz"]
    return _pick(body, names, at_ns).reshape(len(at_ns), len(parts), 2, 3)


def shown_skeletons(measurements: RunTable, camera: str) -> Iterator[tuple[int, Floats, int]]:
    """Yields the skeletons in a camera's frames, by arrival: instant [ns], points (20, 3) [m], number of the person.

    Raises:
        KeyError: The table has no lengths.
    """
    mine = rows_where(measurements, "camera", camera)
    order = np.argsort(times(mine, "arrival_ns"), kind="stable")
    t_ns = times(mine, "arrival_ns")[order]
    people = times(mine, "person")[order] if "person" in mine else np.ones(len(mine), np.int64)
    for first in range(0, len(order), _TOGETHER):
        rows = order[first : first + _TOGETHER]
        few, back = mine.iloc[np.sort(rows)], np.argsort(np.argsort(rows))
        points_m = skeleton(columns(few)[back], number_columns(few, LENGTHS)[back])
        part = slice(first, first + len(rows))
        yield from zip(t_ns[part].tolist(), points_m, people[part].tolist(), strict=True)


def at_rate(t_ns: Ints, rate_hz: float) -> Ints:
    """Returns the rows of the first stored instant in each period."""
    if not len(t_ns):
        return np.zeros(0, np.int64)
    instants = np.unique(t_ns)
    period = np.floor((instants - instants[0]) * 1e-9 * rate_hz + 1e-6)
    _, first = np.unique(period, return_index=True)
    return np.flatnonzero(np.isin(t_ns, instants[first]))


def volume_track(occupancy: RunTable | None, rate_hz: float) -> VolumeTrack:
    """Returns the stored volumes in order of time, at a rate of at most ``rate_hz`` [Hz]."""
    if occupancy is None or not len(occupancy):
        nothing, none = np.zeros(0), np.zeros(0, np.int64)
        return VolumeTrack(none, none, nothing, np.zeros(1, np.int64), np.zeros((0, 3)), nothing, (), rate_hz)
    t_ns, (limb, limbs) = times(occupancy), pd.factorize(text_column(occupancy, "limb"))
    shown, counts, flat = at_rate(t_ns, rate_hz), [], array("d")
    for first in range(0, len(shown), _TOGETHER):  # lists of numbers: all of a long run would be in memory three times
        hulls = occupancy.iloc[shown[first : first + _TOGETHER]]["vertices"].tolist()
        counts += [len(hull) // 3 for hull in hulls]
        flat.frombytes(np.concatenate(hulls).tobytes())
    known = "horizon_s" in occupancy
    return VolumeTrack(
        t_ns=t_ns[shown],
        limb=limb[shown],
        radius_m=numeric_column(occupancy, "radius_m")[shown],
        offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        vertices_m=np.frombuffer(flat).reshape(-1, 3),
        horizon_s=numeric_column(occupancy, "horizon_s")[shown] if known else np.full(len(shown), np.nan),
        limbs=tuple(limbs.tolist()),
        rate_hz=rate_hz,
    )


def _track(
    run: Run, method: str, motion: RunTable, robot: RobotModel, t_ns: Ints, t0_ns: int, slow: float
) -> MethodTrack:
    """Returns the motion of one method.

    Args:
        run: The run's tables.
        method: Name of the method.
        motion: Its table.
        robot: The robot of the run.
        t_ns: (n,) instants of the replay [ns].
        t0_ns: Instant of time zero [ns].
        slow: A TCP slower than this counts as stationary [m/s].
    """
    release_freed_memory()  # what reading the volumes, or the motion before, took
    contact = None if run.contact is None else rows_where(run.contact, "method", method)
    axes = range(1, robot.nv + 1)
    q, dq = (_pick(motion, [f"{kind}{i}" for i in axes], t_ns) for kind in ("q", "dq"))
    numbers = _pick(motion, ["tcp_speed", "ref_speed", "distance_m", "horizon_s", "tau_s", "certified"], t_ns)
    body = np.full(len(t_ns), np.nan) if contact is None else _pick(contact, ["distance_m"], t_ns)[:, 0]
    certified = np.where(np.isfinite(numbers[:, 5]) & (method != RECORDED), numbers[:, 5], -1).astype(np.int64)
    return MethodTrack(
        q=q,
        stop_q=_stops(run, method, motion, robot, t_ns, q, dq, numbers[:, 4]),
        ref_m=_pick(motion, ["ref_x", "ref_y", "ref_z"], t_ns),
        tcp_m=_pick(motion, ["tcp_x", "tcp_y", "tcp_z"], t_ns),
        ref_speed=numbers[:, 1],
        tcp_speed=numbers[:, 0],
        distance_m=numbers[:, 2],
        body_m=body,
        horizon_s=numbers[:, 3],
        certified=certified,
        names={name: _names(motion, name, t_ns) for name in ("status", "reason", "limb", "link")}
        | ({"status": (("as recorded",), np.zeros(len(t_ns), np.int64))} if method == RECORDED else {}),
        events=stop_events(motion, contact, t0_ns, slow),
    )


#: The method whose stops leave the path; those of all others end on the path.
_LEAVES_PATH = "qp"


def _stops(
    run: Run, method: str, motion: RunTable, robot: RobotModel, t_ns: Ints, q: Floats, dq: Floats, tau_s: Floats
) -> Floats:
    """Returns (n, nv) end of the stop that would follow; NaN if the table has no value [rad].

    A straight stop has a constant deceleration, so its length is half its time times the present velocity. A stop along
    the path does the same in programmed time, with the joint positions driven there.

    Args:
        run: The run's tables.
        method: Name of the method.
        motion: Its table.
        robot: The robot of the run.
        t_ns: (n,) instants [ns].
        q: (n, nv) there [rad].
        dq: (n, nv) there [rad/s].
        tau_s: (n,) duration of the stop [s].
    """
    straight = q + dq * (0.5 * tau_s)[:, None]
    if method == _LEAVES_PATH:
        if setting(run.meta.get("settings", {}), "plan", "certify"):
            return straight
        dt_s = float(np.median(np.diff(times(motion)))) * 1e-9
        ends = [stop_axis_by_axis(*row, robot.ddq_max, dt_s).q[-1] for row in zip(q, dq, strict=True)]  # Eq. (67)
        return np.where(np.isfinite(tau_s)[:, None], np.array(ends), np.nan)
    if method == RECORDED or "programme_s" not in motion:
        return straight
    row, _ = _rows(motion, t_ns)
    rate = np.gradient(numeric_column(motion, "programme_s"), times(motion) * 1e-9)[row]
    at_s = numeric_column(motion, "programme_s")[row] + 0.5 * rate * tau_s
    tables = [motion, *(table for name, table in run.baselines.items() if name == "none")]
    found = [_driven_beside(table, at_s, robot.nv) for table in tables]
    s_s, first = np.unique(np.concatenate([known for known, _ in found]), return_index=True)
    driven = np.concatenate([joints for _, joints in found])[first]
    return np.column_stack([np.interp(at_s, s_s, joint) for joint in driven.T])


def _driven_beside(motion: RunTable, at_s: Floats, axes: int) -> tuple[Floats, Floats]:
    """Returns programmed times (k,) before and after some others [s], and (k, axes) joints first driven there [rad].

    Few rows of a long run. The programmed time of a motion never decreases.
    """
    programme_s = numeric_column(motion, "programme_s")
    after = np.searchsorted(programme_s, at_s)
    beside = np.unique(np.clip(np.concatenate([after - 1, after]), 0, len(programme_s) - 1))
    rows = np.unique(np.searchsorted(programme_s, programme_s[beside]))
    joints = [numeric_column(motion, f"q{i}")[rows] for i in range(1, axes + 1)]
    return programme_s[rows], np.column_stack(joints)


def _names(motion: RunTable, column: str, at_ns: Ints) -> tuple[tuple[str, ...], Ints]:
    """Returns the texts of a column, in order of appearance, and the index of the text at each instant; -1: none."""
    if column not in motion:
        return (), np.full(len(at_ns), -1)
    index, texts = pd.factorize(motion[column].replace("", None))  # in order of appearance; -1: none
    known = tuple(str(text) for text in texts)
    row, valid = _rows(motion, at_ns)
    return known, np.where(valid, index[row], -1)
