"""The records that the stages exchange. Read this module first.

Every record is a table of ticks or of frames: its arrays have time as their first axis. A live tick is a table of one
row, so live session and replay use the same stages. Arrays are read-only. Missing values are NaN, never 0.
Instants are int nanoseconds, durations are float seconds; all other quantities are in SI units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

#: Height of the floor in the world, whose z axis is up [m].
FLOOR_Z_M = 0.0

#: Joints of the human model in the order of Eq. (37), right arm before left; then the height of the pelvis above the
#: floor. The paper counts this height among the lengths, but it changes when people squat, sit down and get up.
JOINTS = ("x", "y", "theta", "rho", "ar1", "ar2", "ar3", "ar4", "al1", "al2", "al3", "al4", "z")
#: Number of joints.
DOF = len(JOINTS)

#: Limb lengths pi that the filter estimates with the joints [m].
LENGTHS = (
    "pi_torso",
    "pi_head",
    "pi_half_shoulder",
    "pi_upper_arm_l",
    "pi_upper_arm_r",
    "pi_forearm_l",
    "pi_forearm_r",
)

#: Limbs of Alg. 2 with predicted swept volumes.
LIMBS = ("HD", "THX", "URA", "LRA", "ULA", "LLA")

#: The limbs and the lower body; of the lower body the model only contains the position of the pelvis.
BODY = (*LIMBS, "LEGS")

#: Body points of a camera's skeleton. A camera that lacks one leaves it NaN with confidence 0.
POINTS = (
    "pelvis",
    "chest",
    "neck",
    "head",
    "shoulder_l",
    "elbow_l",
    "wrist_l",
    "hand_l",
    "shoulder_r",
    "elbow_r",
    "wrist_r",
    "hand_r",
    "hip_l",
    "knee_l",
    "ankle_l",
    "foot_l",
    "hip_r",
    "knee_r",
    "ankle_r",
    "foot_r",
)

#: Body id in a frame without a person: all its points are missing.
NOBODY = -1

#: Name of the border of a watched area among the volumes that a robot keeps clear of; all sides have this name.
BORDER = "BORDER"

#: Between a limb and its person in the name of a limb or volume of person 2, 3, ...
OF_PERSON = " of person "


def of_person(limb: str, number: int) -> str:
    """Name of a limb of a person; that of person 1 is the limb's own."""
    return limb if number == 1 else f"{limb}{OF_PERSON}{number}"


def volume_name(index: int, names: Sequence[str], limbs: Sequence[str]) -> str:
    """Name of one of the volumes that a robot keeps clear of.

    Args:
        index: Index of the volume: those of ``names``, then the limbs of persons 2, 3, ...
        names: Names of the limbs of person 1, then of the sides of a watched area.
        limbs: Limbs that have volumes.
    """
    if index < len(names):
        return names[index]
    person, limb = divmod(index - len(names), len(limbs))
    return of_person(limbs[limb], person + 2)


#: Name of the motion of the robot as recorded, among the methods; it is no controller.
RECORDED = "recorded"
#: Methods whose motion rests on no volume: the programme without reaction, and the robot as recorded.
UNGUARDED = ("none", RECORDED)
#: Methods that may touch people, so slowly that the force of the contact keeps its limit; see ``human.contact_limits``.
ALLOWING_CONTACT = ("pfl",)

#: POINTS with left and right exchanged.
MIRROR = tuple(
    POINTS.index(name[:-1] + {"l": "r", "r": "l"}[name[-1]]) if name[-2:] in ("_l", "_r") else i
    for i, name in enumerate(POINTS)
)


class Neighbours(NamedTuple):
    """The two samples around each of m instants; the same one twice if an instant is that of a sample."""

    before: Ints  #: (m,) row of the earlier one
    after: Ints  #: (m,) row of the later one
    share: Floats  #: (m,) of the way from the earlier to the later one, 0 to 1
    known: Bools  #: (m,) False: outside the samples' span or in a gap; the rows are then no neighbours


def find_neighbours(t_ns: Ints, at_ns: Ints, gap_s: float | None = None) -> Neighbours:
    """Finds the samples to interpolate between.

    Args:
        t_ns: (n,) instants of the samples, increasing, at least one [ns].
        at_ns: (m,) requested instants [ns].
        gap_s: Maximum time between two samples for interpolation; None: no maximum [s].
    """
    after = np.clip(np.searchsorted(t_ns, at_ns), 0, len(t_ns) - 1)
    before = np.where(t_ns[after] > at_ns, np.maximum(after - 1, 0), after)
    step_ns = t_ns[after] - t_ns[before]
    known: Bools = np.asarray((t_ns[before] <= at_ns) & (at_ns <= t_ns[after]))
    if gap_s is not None:
        known &= step_ns <= round(gap_s * 1e9)
    share = np.where(known, (at_ns - t_ns[before]) / np.maximum(step_ns, 1), 0.0)
    return Neighbours(before, after, share, known)


def _protect(record: Any) -> None:
    """Replaces the arrays of a new record by read-only views."""
    own = vars(record)
    for name, value in own.items():
        if isinstance(value, np.ndarray):
            own[name] = view = value.view()
            view.setflags(write=False)


@dataclass(frozen=True)
class Table:
    """Rows over time: every array field has time as its first axis; every other field applies to the whole table."""

    def __post_init__(self) -> None:
        _protect(self)

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}

    def __len__(self) -> int:
        return next(len(value) for value in vars(self).values() if isinstance(value, np.ndarray))

    def rows(self, which: slice | Ints | Bools) -> Self:
        """The table with only the rows that ``which`` selects."""
        return replace(self, **{name: array[which] for name, array in self._arrays().items()})

    @classmethod
    def join(cls, tables: Sequence[Self]) -> Self:
        """One table with the rows of all tables, in the given order; fields without rows are those of the first.

        Where one table names its people, all do.
        """
        if any(getattr(table, "person", None) is not None for table in tables):
            tables = [replace(table, person=table.numbers) for table in tables]  # type: ignore[attr-defined,call-arg]
        first = tables[0]
        names = [name for name, value in vars(first).items() if isinstance(value, np.ndarray)]
        return replace(first, **{name: np.concatenate([getattr(t, name) for t in tables]) for name in names})


_Rows = TypeVar("_Rows")


class Growing(Generic[_Rows]):
    """Rows of a long run in arrays that grow: parts in a list would be in memory twice while they are joined.

    A part is a dataclass whose arrays have time as their first axis; other fields are those of the first part.
    """

    #: Rows of the first arrays.
    LEAST = 4096

    def __init__(self) -> None:
        self._first: Any = None
        self._columns: dict[str, NDArray[Any]] = {}
        self._rows = 0

    def __len__(self) -> int:
        return self._rows

    def add(self, part: _Rows) -> None:
        """Adds some rows.

        Raises:
            ValueError: The part lacks an array that the first one has, or the other way round.
        """
        arrays = {name: value for name, value in vars(part).items() if isinstance(value, np.ndarray)}
        count = len(next(iter(arrays.values())))
        if not count:
            return
        self._first = part if self._first is None else self._first
        if self._columns and arrays.keys() != self._columns.keys():
            raise ValueError(f"rows with {', '.join(arrays)}; those of the first part, {', '.join(self._columns)}")
        for name, values in arrays.items():
            self._room(name, values, self._rows + count)[self._rows : self._rows + count] = values
        self._rows += count

    def _room(self, name: str, like: NDArray[Any], rows: int) -> NDArray[Any]:
        """The array of a column with room for so many rows; memory that no row has reached yet is not taken."""
        before = self._columns.get(name)
        if before is not None and rows <= len(before):
            return before
        room = max(rows, self.LEAST if before is None else 2 * len(before))
        found = self._columns[name] = np.empty((room, *like.shape[1:]), like.dtype)
        if before is not None:
            found[: self._rows] = before[: self._rows]
        return found

    def take(self) -> _Rows | None:
        """Returns all rows, None without any; it is empty then."""
        first, columns, rows = self._first, self._columns, self._rows
        self._first, self._columns, self._rows = None, {}, 0
        return replace(first, **{name: values[:rows] for name, values in columns.items()}) if rows else None


@dataclass(frozen=True)
class CameraFrames(Table):
    """Skeletons measured by the cameras, one row per body and frame, in order of arrival."""

    capture_ns: Ints  #: (n,) capture time of the frame
    arrival_ns: Ints  #: (n,) arrival time at the logger; no earlier tick may use the frame
    camera: Ints  #: (n,) index into ``cameras``
    body: Ints  #: (n,) the tracker's body id, which may change during a recording; or NOBODY
    points_m: Floats  #: (n, 20, 3) POINTS in that camera's own frame [m]
    confidence: Floats  #: (n, 20) in [0, 1]
    cameras: tuple[str, ...]


@dataclass(frozen=True)
class SkeletonTrack(Table):
    """One person measured by one camera, one row per frame, in order of capture."""

    t_ns: Ints  #: (n,) capture time
    points_m: Floats  #: (n, 20, 3) POINTS in one frame, the camera's or the world's [m]
    confidence: Floats  #: (n, 20) in [0, 1]
    delay_s: float = 0.0  #: median from capture to arrival [s]


@dataclass(frozen=True)
class Measurements(Table):
    """Joint angles and limb lengths from camera frames, one row per frame, in order of arrival."""

    capture_ns: Ints  #: (n,)
    arrival_ns: Ints  #: (n,)
    camera: Ints  #: (n,) index into ``cameras``
    z: Floats  #: (n, 20) JOINTS, then LENGTHS [m, m, rad..., m, m...]; NaN where not observable
    z_std: Floats  #: (n, 20) sigma_z of Eq. (47), in the same units; NaN where ``z`` is
    points_m: Floats  #: (n, 20, 3) POINTS in the world [m]
    confidence: Floats  #: (n, 20) in [0, 1]
    cameras: tuple[str, ...]
    person: Ints | None = None  #: (n,) number of the person, from 1; None: person 1 in all rows

    @property
    def numbers(self) -> Ints:
        """(n,) number of the person of each row, from 1."""
        return np.ones(len(self), np.int64) if self.person is None else self.person

    @property
    def angles(self) -> Floats:
        """(n, 13) JOINTS [m, m, rad..., m]."""
        return self.z[:, : len(JOINTS)]

    @property
    def angles_std(self) -> Floats:
        """(n, 13) standard deviation of ``angles``."""
        return self.z_std[:, : len(JOINTS)]

    @property
    def lengths_m(self) -> Floats:
        """(n, 7) LENGTHS [m]."""
        return self.z[:, len(JOINTS) :]

    @property
    def lengths_std_m(self) -> Floats:
        """(n, 7) standard deviation of ``lengths_m`` [m]."""
        return self.z_std[:, len(JOINTS) :]


@dataclass(frozen=True)
class HumanStates(Table):
    """The fused people, one row per tick and person, ordered by both; mostly one person, and one row per tick.

    Rows before the first measurement are NaN. In a row of a body that counts by its points alone, since it was only
    just seen, all joints are NaN and ``points_m`` are the points shown.
    """

    t_ns: Ints  #: (n,)
    p: Floats  #: (n, 13) JOINTS [m, m, rad..., m]; heading is unwrapped
    v: Floats  #: (n, 13) [m/s, m/s, rad/s...]; x and y in the world frame
    a: Floats  #: (n, 13) [.../s^2]
    j: Floats  #: (n, 13) [.../s^3]
    p_std: Floats  #: (n, 13) standard deviation of ``p``
    v_std: Floats  #: (n, 13) standard deviation of ``v``
    lengths_m: Floats  #: (n, 7) LENGTHS [m]
    lengths_std_m: Floats  #: (n, 7) [m]
    valid: Bools  #: (n, c) whether a row of this camera is used in the update of this tick
    residual_m: Floats  #: (n, 7) high quantile of the recent distances of BODY from the model [m]; NaN until known
    unseen_s: Floats  #: (n, 7) time since a camera last saw the joints of each of BODY [s]; inf before the first time
    frame_age_s: Floats  #: (n,) time since the capture of the newest frame in the filter [s]; inf before the first
    points_m: Floats  #: (n, 20, 3) recent POINTS that cameras show away from the model, world [m]; otherwise NaN
    cameras: tuple[str, ...]
    #: (n, c, 20, 3) recent POINTS as each camera shows them, world [m]; while the torso is seen only those away from
    #: ``points_m``, otherwise NaN. None: not known
    camera_points_m: Floats | None = None
    #: (n,) sway: root mean square of the recent ways of the legs' points beside the pelvis, from one frame of a
    #: camera to the next that is at least 25 ms later [m]; NaN while no camera shows them. None: not known
    legs_sway_m: Floats | None = None
    nobody_s: Floats | None = None  #: (n,) time since the watched area was last empty [s]; None: no watched area
    nobody_else_s: Floats | None = None  #: (n,) the same, apart from the people tracked [s]; inf before the first time
    person: Ints | None = None  #: (n,) number of the person, from 1; None: person 1 in all rows, one row per tick

    @property
    def numbers(self) -> Ints:
        """(n,) number of the person of each row, from 1."""
        return np.ones(len(self), np.int64) if self.person is None else self.person

    @property
    def by_points(self) -> Bools:
        """(n,) whether the body was only just seen and counts by the points shown alone."""
        return np.asarray(np.isinf(self.unseen_s).all(axis=1) & np.isfinite(self.frame_age_s))

    def ticks(self) -> tuple[Ints, Ints]:
        """The ticks (k,), and the first row of each with the number of rows at the end (k + 1,)."""
        return (self.t_ns, np.arange(len(self) + 1)) if self.person is None else ticks_of(self.t_ns)

    def of_person(self, number: int) -> HumanStates:
        """The rows of one person, as if there were no other."""
        return self if self.person is None else replace(self.rows(self.person == number), person=None)


def ticks_of(t_ns: Ints) -> tuple[Ints, Ints]:
    """The ticks (k,) of rows (n,) in order of time, and the first row of each with their number at the end (k + 1,)."""
    first = np.flatnonzero(np.diff(t_ns, prepend=t_ns[:1] - 1))
    return t_ns[first], np.append(first, len(t_ns))


class AxisFrame(NamedTuple):
    """Links at both sides of an axis of a robot, by which a log may contain its position."""

    parent: str
    child: str
    R_parent_joint: Floats  #: (3, 3) of the child in the parent, with the axis at zero
    axis: Floats  #: (3,) unit vector in the child


class SweptVolume(NamedTuple):
    """Reachable space of one limb at one tick: the convex hull of its vertices + a ball."""

    vertices_m: Floats  #: (m, 3) world [m]
    radius_m: float  #: of the ball, Eq. (41) [m]

    @property
    def known(self) -> bool:
        """Return whether all numbers are finite; otherwise the limb could not be predicted."""
        return bool(np.isfinite(self.vertices_m).all() and np.isfinite(self.radius_m))


@dataclass(frozen=True)
class SweptVolumes:
    """Reachable space within the horizon: per tick and limb the convex hull of ``vertices`` + a ball.

    ``vertices_m[offsets[i * len(limbs) + l] : offsets[i * len(limbs) + l + 1]]`` belong to tick i, limb l.
    A limb that cannot be predicted (no state yet) has one NaN vertex; the robot must then brake.
    """

    t_ns: Ints  #: (n,)
    offsets: Ints  #: (n * len(limbs) + 1,)
    vertices_m: Floats  #: (m, 3) world [m]
    radius_m: Floats  #: (n, len(limbs)) radius of the ball, Eq. (41) [m]
    limbs: tuple[str, ...]
    method: str

    def __post_init__(self) -> None:
        _protect(self)

    def __len__(self) -> int:
        return len(self.t_ns)

    def vertices(self, tick: int, limb: int) -> Floats:
        """(m, 3) vertices of one limb at one tick, world [m]."""
        first = tick * len(self.limbs) + limb
        return self.vertices_m[self.offsets[first] : self.offsets[first + 1]]

    def at(self, tick: int) -> dict[str, SweptVolume]:
        """Limb -> its volume at one tick, known or not."""
        return {
            limb: SweptVolume(self.vertices(tick, i), float(self.radius_m[tick, i]))
            for i, limb in enumerate(self.limbs)
        }


#: Status of a tick: free tracking, limited by a safety constraint or a limit, a stop, or a motion out of a volume.
STATUSES = ("tracking", "limited", "braking", "retreating")


class MotionRow(NamedTuple):
    """Commanded motion of one tick. A controller decides it, ``Motion`` collects it, and a session records it.

    This class is the only schema of a tick. Tables, the session's record and ``verify`` use its fields in this order.
    """

    q: Floats  #: (nv,) at the tick [rad]
    dq: Floats  #: (nv,) at the tick [rad/s]
    u: Floats  #: (nv,) applied from the tick on [rad/s^2]
    ref_m: Floats  #: (3,) programmed TCP position, world [m]
    tcp_m: Floats  #: (3,) TCP position at ``q``, world [m]
    tcp_speed: float  #: [m/s]
    ref_speed: float  #: of the reference [m/s]
    programme_s: float  #: programmed time of the reference [s]
    distance_m: float  #: surface to surface, smallest over all pairs; 0 in contact, NaN where not known [m]
    overlap_m: float  #: depth of the link inside the volume, radii included; NaN where not known [m]
    limb: int  #: of the nearest pair; -1 without one
    link: int  #: of the nearest pair; -1 without one
    status: int  #: index into STATUSES
    reason: str  #: why the robot braked or stood still; otherwise empty
    horizon_s: float  #: horizon of the volumes used, from the tick on [s]
    tau_s: float  #: duration of the stop from the tick's velocity [s]
    certified: bool  #: whether the step, or the stop it continues, has a valid certificate


#: Fields of a MotionRow with one number per axis of the robot, and those with one number per axis of the world.
_OF_AXES, _OF_POINTS = ("q", "dq", "u"), ("ref_m", "tcp_m")


def number_names(field: str, axes: int) -> tuple[str, ...]:
    """Names of the numbers of a field of a MotionRow, as in motion.parquet: q1 ..., ref_x ..., tcp_speed."""
    if field in _OF_AXES:
        return tuple(f"{field}{axis}" for axis in range(1, axes + 1))
    if field in _OF_POINTS:
        return tuple(f"{field.removesuffix('_m')}_{axis}" for axis in "xyz")
    return (field,)


@dataclass(frozen=True)
class Motion(Table):
    """Commanded motion of the robot, one row per tick: the fields of ``MotionRow`` as arrays."""

    t_ns: Ints  #: (n,)
    q: Floats  #: (n, nv) at the tick [rad]
    dq: Floats  #: (n, nv) at the tick [rad/s]
    u: Floats  #: (n, nv) applied from the tick on [rad/s^2]
    ref_m: Floats  #: (n, 3) programmed TCP position, world [m]
    tcp_m: Floats  #: (n, 3) TCP position, world [m]
    tcp_speed: Floats  #: (n,) [m/s]
    ref_speed: Floats  #: (n,) [m/s]
    programme_s: Floats  #: (n,) programmed time of the reference; behind the clock by its waiting time [s]
    distance_m: Floats  #: (n,) surface to surface, smallest over all pairs; 0 in contact [m]
    overlap_m: Floats  #: (n,) depth of the link inside the volume, radii included; NaN where not known [m]
    limb: Ints  #: (n,) index into ``limbs`` of the nearest pair; -1 without one
    link: Ints  #: (n,) index into ``links`` of the nearest pair; -1 without one
    status: Ints  #: (n,) index into STATUSES
    reason: Ints  #: (n,) index into ``reasons``: why the robot braked or stood still; otherwise 0
    horizon_s: Floats  #: (n,) horizon of the volumes used at the tick, from the tick on [s]
    tau_s: Floats  #: (n,) duration of the stop from the tick's velocity [s]
    certified: Bools  #: (n,) whether this tick's step, or the stop it continues, has a valid certificate
    limbs: tuple[str, ...]
    links: tuple[str, ...]
    reasons: tuple[str, ...]

    @classmethod
    def of_rows(
        cls,
        t_ns: Ints,
        rows: Sequence[MotionRow],
        *,
        limbs: tuple[str, ...],
        links: tuple[str, ...],
        reasons: tuple[str, ...],
    ) -> Self:
        """Collects rows into a table.

        Args:
            t_ns: (n,) ticks of the rows [ns].
            rows: n rows.
            limbs: Names of all volumes, in the order of ``MotionRow.limb``.
            links: Names of all links, in the order of ``MotionRow.link``.
            reasons: All reasons that a row may have, the empty one first.
        """
        columns = {
            name: np.array([getattr(row, name) for row in rows]) for name in MotionRow._fields if name != "reason"
        }
        reason = np.array([reasons.index(row.reason) for row in rows])
        return cls(t_ns=t_ns, **columns, reason=reason, limbs=limbs, links=links, reasons=reasons)

    @classmethod
    def join(cls, tables: Sequence[Self]) -> Self:
        """One table with the rows of all tables; volumes that only later tables name come after the others."""
        return replace(super().join(tables), limbs=max((table.limbs for table in tables), key=len))
