"""Imports motions from files of other programs: what all formats share, from a file's points to a log.

A format reads a file into ``Tracks``: times, bodies and named points. Here they become body points by an order of
points, in metres and along the log's axes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from hrcreplay.errors import LogError, SettingsError
from hrcreplay.logs import presets
from hrcreplay.logs.messages import METRES
from hrcreplay.logs.plausibility import PERSON_M, PROPORTION, bone_ratio, statures
from hrcreplay.logs.writer import ARRIVAL_NOTE, START_NS, Capsules, ImportedSkeleton, overlap_notes, write_log
from hrcreplay.records import NOBODY, POINTS, Floats, Ints
from hrcreplay.settings.sections import Axis, Finite, Positive, Section, is_rotation

#: Times in a table -> nanoseconds.
TIME_UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_SKIN = "plug_in_gait"
_SKIN_CONFIDENCE = 0.5  # markers on the skin, as for the optical targets of KERAAL
_NO_ARM = (
    "the robot's {count} points are not taken: they are places along its arm and do not tell the angles of its axes; "
    "would be right: the radius of its links as robot_radius_m in --mapping, or the robot by its own log, or a task"
)
_FAR = 1e9  # in any unit, no coordinate of a person
_LATEST_NS = 9e18  # near the end of int64
_FEW = 10  # with fewer frames, proportions are not judged
_HIPS_M = 0.01  # the middle of the hips this close to the origin in nearly all frames is the origin
_NEARLY_ALL = 0.95


class ImportMapping(Section):
    """Description of a file for ``import``: columns of a table, and settings that replace those of a format."""

    time: str | None = None
    """Column with the times; none: frames follow one another at rate_hz."""
    time_unit: Literal["s", "ms", "us", "ns"] = "s"
    """Unit of the times."""
    rate_hz: Positive | None = None
    """Rate of files without times [Hz]."""
    separator: Annotated[str, Field(min_length=1, max_length=1)] = ","
    """Separator of the columns of a CSV file."""
    records: str | None = None
    """JSON: path to the list of records, fields joined by dots; none: the file is the list."""
    body: str | None = None
    """Column with the body's number; none: one body."""
    name: str | None = None
    """Column with a point's name or number, where each row is one point; none: a row holds all points of a body."""
    columns: str = "{point}_{axis}"
    """Pattern of the columns of a point, with {point} its name and {axis} one of axis_names; with name, the pattern of
    three columns."""
    axis_names: tuple[str, str, str] = ("x", "y", "z")
    """Words for the axes in the columns."""
    confidence: str | float | None = None
    """Column with the confidence, with {point} where a row holds all points, or a constant; none: 1."""
    confidence_max: Positive = 1.0
    """The value of a confidence that means certain."""
    index: dict[str, int | str] | str | None = None
    """As in logs.decoders; none: the order of the format."""
    unit: Literal["m", "cm", "mm"] | None = None
    """Unit of the points; none: that of the format or file, or the one in which the body has the size of a person."""
    axes: tuple[Axis, Axis, Axis] = ("x", "y", "z")
    """As in logs.decoders."""
    offset_m: tuple[Finite, Finite, Finite] | None = None
    """Place of the points' origin in the log, added to all points: for points relative to the hips [m]."""
    robot_radius_m: Positive | None = None
    """Radius of the capsules between the points of the robot's arm, in sets that have them; none: the robot is left
    out [m]."""
    skip: Annotated[int, Field(ge=0)] = 0
    """Lines of a CSV file before the header."""

    def model_post_init(self, _context: object) -> None:
        """Rejects axes that mirror and patterns without a point or an axis."""
        if not is_rotation(self.axes):
            raise ValueError(f"axes: found {', '.join(self.axes)}; would be right: each axis once, and no mirror image")
        wanted = "{axis}" if self.name is not None else "{point} and {axis}"
        if "{axis}" not in self.columns or (self.name is None and "{point}" not in self.columns):
            raise ValueError(f"columns: found {self.columns!r}; would be right: a pattern with {wanted}")


@dataclass(frozen=True)
class Tracks:
    """Points of the bodies in a file, one row per body and frame."""

    t_ns: Ints  #: (n,), not decreasing
    body: Ints  #: (n,); NOBODY for a frame without a body
    names: tuple[str, ...]  #: k names or places of the points
    points: Floats  #: (n, k, 3); NaN if missing
    confidence: Floats  #: (n, k)
    unit: str | None = None  #: of the points; None: not known from the file
    notes: tuple[str, ...] = ()
    order: str | None = None  #: order of its points; None: that of the format
    arm: Floats | None = None  #: (n, r, 3) points along the robot's arm in the same frame and unit; None: not known


@dataclass(frozen=True)
class Format:
    """A file format that ``import`` reads."""

    orders: tuple[str, ...]  #: orders of its points; the one that finds most body points counts
    read: Callable[[Path, ImportMapping], Tracks]


def import_motion(form: Format, paths: Mapping[str, Path], out: Path, mapping: ImportMapping) -> list[str]:
    """Makes a log from motion files, one per sensor or system, each in a frame of its own.

    Args:
        form: Format of the files.
        paths: Camera -> file.
        out: Log to write.
        mapping: Description of the files.

    Returns:
        Remarks for the user.

    Raises:
        LogError: A file cannot be read in this format, or its points are no body points.
        SettingsError: ``out`` exists or cannot be written, or the mapping does not fit.
    """
    notes = [ARRIVAL_NOTE]
    tracks = {camera: form.read(path, mapping) for camera, path in paths.items()}
    first_ns = min(int(track.t_ns[0]) for track in tracks.values())
    shift_ns = START_NS - first_ns if first_ns < START_NS else 0
    if shift_ns:
        notes.append(
            f"the times begin at {first_ns * 1e-9:g} s; {shift_ns * 1e-9:g} s are added, because 0 means no time"
        )
    bodies, robot = {}, None
    for camera, track in tracks.items():
        points, confidence, unit, told = body_points(track, form, mapping, f"{paths[camera]}")
        notes.extend(f"camera {camera}: {note}" for note in (*track.notes, *told))
        bodies[camera] = _rows(track, points, confidence, shift_ns)
        if robot is None and track.arm is not None and mapping.robot_radius_m is not None:
            robot = _capsules(_in_metres(track.arm, unit, mapping), track.t_ns + shift_ns, mapping.robot_radius_m)
            notes.append(
                f"the robot's arm is taken as {robot.ends_m.shape[1]} capsules of robot_radius_m, in the frame of "
                f"camera {camera}: give that camera's pose as T_world_base, too, in the cell file"
            )
        elif track.arm is not None:
            notes.append(_NO_ARM.format(count=track.arm.shape[1]))
    return [*notes, *overlap_notes(write_log(bodies, out, robot))]


def _capsules(arm_m: Floats, t_ns: Ints, radius_m: float) -> Capsules:
    """Returns the capsules between neighbouring points of an arm (n, r, 3) [m]."""
    return Capsules(t_ns, np.stack([arm_m[:, :-1], arm_m[:, 1:]], axis=2), radius_m)


def _rows(track: Tracks, points: Floats, confidence: Floats, shift_ns: int) -> Iterator[ImportedSkeleton]:
    for i, (t_ns, body) in enumerate(zip(track.t_ns.tolist(), track.body.tolist(), strict=True)):
        yield ImportedSkeleton(t_ns + shift_ns, body, points[i], confidence[i])


def body_points(
    track: Tracks, form: Format, mapping: ImportMapping, where: str
) -> tuple[Floats, Floats, str, list[str]]:
    """Returns points (n, 20, 3) [m] and confidence (n, 20) of a file's bodies, the file's unit, and remarks.

    Args:
        track: Points of the file.
        form: Its format.
        mapping: Description of the file, which replaces what the format says.
        where: File, for messages.

    Raises:
        LogError: None of its points is a body point, the body is no person, the unit is not known, or the points have
            no place.
    """
    name, wanted = _order(track, form, mapping, where)
    found, confidence = _by_order(track, wanted)
    notes = []
    absurd = np.asarray((np.abs(found) > _FAR).any(axis=2))
    if absurd.any():
        found[absurd], confidence[absurd] = np.nan, 0.0
        notes.append(f"{absurd.sum()} points with a coordinate beyond {_FAR:g} made missing")
    if name == _SKIN:
        confidence = np.where(confidence > 0, _SKIN_CONFIDENCE, 0.0)
        notes.append("markers on the skin are used as joints, with errors of a few centimetres: confidence 0.5")
    unit = mapping.unit or track.unit
    if unit is None:
        unit = _unit_by_size(found, where)
        notes.append(f"the unit is taken as {unit}, in which the body has the size of a person")
    found = _in_metres(found, unit, mapping)
    ratio = bone_ratio(found) if len(found) >= _FEW else 1.0
    if ratio > PROPORTION:
        raise LogError(
            f"{where}: the body is {ratio:.1f} times as tall by one bone as by another, so its points are in another "
            "order than this format's; would be right: which point is which body part, with index in --mapping"
        )
    if mapping.offset_m is None and _about_hips(found):
        raise LogError(
            f"{where}: the middle of the hips is always at the origin, so the file does not tell where the person "
            "is; would be right: points in a camera or room, or their place with offset_m in --mapping"
        )
    missing = presets.lacking({point for i, point in enumerate(POINTS) if np.isfinite(found[:, i]).any()})
    if missing:
        notes.append(f"the points lack {missing}")
    return found, confidence, unit, notes


def _in_metres(points: Floats, unit: str, mapping: ImportMapping) -> Floats:
    """Points (..., 3) of a file in metres, by the axes and the place that the mapping gives."""
    found = METRES[unit] * _turned(points, mapping.axes)
    return found if mapping.offset_m is None else found + np.array(mapping.offset_m)


def _order(track: Tracks, form: Format, mapping: ImportMapping, where: str) -> tuple[str, presets.Places]:
    """Returns name and places of the order that finds most body points. Raises LogError if none finds one."""
    plain = {presets.plain(name) for name in track.names}
    if isinstance(mapping.index, dict):
        orders = {"": presets.places(mapping.index)}
    else:
        of_file = form.orders if track.order is None else (track.order,)
        names = of_file if mapping.index is None else (mapping.index,)
        orders = {name: presets.places(presets.order(name, "--mapping: index")) for name in names}
    counts = {
        name: sum(any(set(keys) <= plain for keys in ways) for ways in order.values()) for name, order in orders.items()
    }
    best = max(counts, key=lambda name: counts[name])
    if not counts[best]:
        shown = ", ".join(track.names[:8]) + (f" and {len(track.names) - 8} more" if len(track.names) > 8 else "")
        raise LogError(
            f"{where}: found points named {shown}, none of which is a body point; would be right: their names with "
            'index in --mapping, e.g. index = { head = "..." }'
        )
    return best, orders[best]


def _by_order(track: Tracks, wanted: presets.Places) -> tuple[Floats, Floats]:
    at = {presets.plain(name): i for i, name in reversed(list(enumerate(track.names)))}
    found = np.full((len(track.t_ns), len(POINTS), 3), np.nan)
    confidence = np.zeros((len(track.t_ns), len(POINTS)))
    for point, ways in wanted.items():
        keys = next((keys for keys in ways if all(key in at for key in keys)), None)
        if keys is not None:
            columns = [at[key] for key in keys]
            found[:, POINTS.index(point)] = track.points[:, columns].mean(axis=1)
            confidence[:, POINTS.index(point)] = track.confidence[:, columns].min(axis=1)
    missing = ~np.isfinite(found).all(axis=2)
    found[missing], confidence[missing] = np.nan, 0.0
    return found, np.clip(confidence, 0.0, 1.0)


def _turned(points: Floats, axes: tuple[str, str, str]) -> Floats:
    signs = np.array([-1.0 if axis[0] == "-" else 1.0 for axis in axes])
    return np.asarray(points[..., ["xyz".index(axis[-1]) for axis in axes]] * signs)


def _unit_by_size(points: Floats, where: str) -> str:
    """Returns the unit in which a body has the size of a person; the units differ too much for two to fit."""
    sizes = statures(points[:: max(1, len(points) // 1000)])
    size = float(np.median(sizes[np.isfinite(sizes)])) if np.isfinite(sizes).any() else float("nan")
    for unit, metres in METRES.items():
        if PERSON_M[0] <= size * metres <= PERSON_M[1]:
            return unit
    shown = "without two ends of a bone" if np.isnan(size) else f"{size:.4g} tall by its bones"
    raise LogError(f"{where}: found a body {shown}; would be right: one of 0.5 to 2.3 m, or unit in --mapping")


def _about_hips(points_m: Floats) -> bool:
    hips = points_m[:, [POINTS.index("hip_l"), POINTS.index("hip_r")]].mean(axis=1)
    known = np.isfinite(hips).all(axis=1)
    near = np.linalg.norm(hips[known], axis=1) < _HIPS_M
    return len(near) > 1 and bool(near.mean() >= _NEARLY_ALL)


def times_at(count: int, rate_hz: float) -> Ints:
    """Returns the times (count,) of frames at a rate, from 0 on [ns]."""
    return np.round(np.arange(count) / rate_hz * 1e9).astype(np.int64)


def nanoseconds(times: Floats | Ints, unit_ns: int, where: str) -> Ints:
    """Converts times in a unit to nanoseconds; whole numbers keep all their digits. Raises LogError for huge times."""
    largest = float(np.abs(times).max()) if len(times) else 0.0
    if not largest * unit_ns < _LATEST_NS:
        raise LogError(f"{where}: time: found {largest:g}; would be right: another unit of time, or numbers below it")
    if times.dtype.kind in "iu":
        return times.astype(np.int64) * unit_ns
    return np.asarray(np.round(times * unit_ns), dtype=np.int64)


def rate_of(mapping: ImportMapping, rate_hz: float | None, where: str) -> float:
    """Returns the rate of a file's frames: the user's, else the file's. Raises SettingsError if both lack it."""
    rate = mapping.rate_hz or rate_hz
    if rate is None or not 0 < rate < np.inf:
        raise SettingsError(f"{where}: the file does not tell how many frames a second it has; give --rate HZ")
    return rate


def in_order(t_ns: Ints, where: str) -> Ints:
    """Returns the times. Raises LogError if there is none, or they go back."""
    if not len(t_ns):
        raise LogError(f"{where}: found no frame; would be right: one row a frame")
    back = np.flatnonzero(np.diff(t_ns) < 0)
    if len(back):
        gone_s = (t_ns[back[0]] - t_ns[back[0] + 1]) * 1e-9
        raise LogError(f"{where}: frame {back[0] + 2}: time goes back by {gone_s:g} s; would be right: frames in order")
    return t_ns


def one_body(t_ns: Ints, names: tuple[str, ...], points: Floats, where: str, unit: str | None) -> Tracks:
    """Returns the tracks of one body whose points have no confidence.

    Args:
        t_ns: (n,) times [ns].
        names: k names of the points.
        points: (n, k, 3), in ``unit``; NaN if missing.
        where: File, for messages.
        unit: Unit of the points; None: not known from the file.

    Raises:
        LogError: There is no frame, or the times go back.
    """
    return Tracks(in_order(t_ns, where), np.zeros(len(t_ns), dtype=np.int64), names, points, seen(points), unit)


def seen(points: Floats) -> Floats:
    """Returns 1 for every point (..., 3) with numbers for coordinates, else 0: the confidence of files without one."""
    return np.asarray(np.isfinite(points).all(axis=-1), dtype=np.float64)


@dataclass(frozen=True)
class Body:
    """A body in a frame, for formats that are read frame by frame."""

    t_ns: int
    number: int
    points: Floats  #: (k, 3)
    confidence: Floats  #: (k,)


def empty_frame(t_ns: int, count: int) -> Body:
    """Returns a frame that shows nobody."""
    return Body(t_ns, NOBODY, np.full((count, 3), np.nan), np.zeros(count))


def stacked(
    bodies: list[Body], names: tuple[str, ...], where: str, unit: str | None, *notes: str, order: str | None = None
) -> Tracks:
    """Returns the tracks of bodies in the order of a file.

    Args:
        bodies: Bodies of all frames, in order of time.
        names: k names of their points.
        where: File, for messages.
        unit: Unit of the points; None: not known from the file.
        notes: Remarks for the user.
        order: Order of the points; None: that of the format.

    Raises:
        LogError: There is no body, or the times go back.
    """
    if not any(body.number != NOBODY for body in bodies):
        raise LogError(f"{where}: found no body; would be right: a recording of a person")
    return Tracks(
        in_order(np.array([body.t_ns for body in bodies], dtype=np.int64), where),
        np.array([body.number for body in bodies], dtype=np.int64),
        names,
        np.stack([body.points for body in bodies]),
        np.stack([body.confidence for body in bodies]),
        unit,
        notes,
        order,
    )
