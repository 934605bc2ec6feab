"""Conversion between records and the columns of a run folder's tables. Other programs rely on the column names."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from hrcreplay.records import (
    BODY,
    JOINTS,
    LENGTHS,
    POINTS,
    STATUSES,
    Bools,
    Floats,
    HumanStates,
    Ints,
    Measurements,
    Motion,
    MotionRow,
    number_names,
)

Columns = dict[str, Any]

#: Name of the joint ``z`` among the lengths of the paper; the tables contain both names.
_HEIGHT, _AS_LENGTH = JOINTS.index("z"), "pi_pelvis_height"
_LENGTHS = (_AS_LENGTH, *LENGTHS)
#: Rows of state.parquet that are read together: of fewer, each column takes longer to find than to read.
_ROWS = 4096


def with_person(columns: Columns, person: Ints | None) -> Columns:
    """Returns the columns with the number of each row's person after the first; unchanged for None: person 1."""
    if person is None:
        return columns
    (first, instants), *rest = columns.items()
    return {first: instants, "person": person, **dict(rest)}


def measurement_columns(measurements: Measurements) -> Columns:
    """Returns one row per frame and person: the result of the closed-form inverse kinematics."""
    columns = {
        "capture_ns": measurements.capture_ns,
        "arrival_ns": measurements.arrival_ns,
        "camera": _names(measurements.camera, measurements.cameras),
        **_spread(measurements.angles, JOINTS),
        **_spread(measurements.angles_std, JOINTS, "_std"),
        _AS_LENGTH: measurements.angles[:, _HEIGHT],
        **_spread(measurements.lengths_m, LENGTHS),
    }
    return with_person(columns, measurements.person)


def truth_columns(t_ns: Ints, angles: Floats, lengths_m: Floats) -> Columns:
    """Returns one row per instant of the ground truth: (n, 13) JOINTS, (n, 7) LENGTHS [m] of the exact skeleton."""
    heights = {_AS_LENGTH: angles[:, _HEIGHT]}
    return {"t_ns": t_ns, **_spread(angles, JOINTS), **heights, **_spread(lengths_m, LENGTHS)}


_STATE = (("p", ""), ("v", "_vel"), ("a", "_acc"), ("j", "_jerk"), ("p_std", "_std"), ("v_std", "_vel_std"))
_RESIDUAL = tuple(f"residual_{limb}" for limb in BODY)
_UNSEEN = tuple(f"unseen_{limb}" for limb in BODY)
_FRAME_AGE = "frame_age_s"
#: Columns that a table may lack: what is not known there.
_MAYBE = ("legs_sway_m", "nobody_s", "nobody_else_s")
_SHOWN = tuple(f"point_{point}_{axis}" for point in POINTS for axis in "xyz")


def _shown_by(camera: str) -> tuple[str, ...]:
    return tuple(f"{camera}_{name}" for name in _SHOWN)


def state_columns(states: HumanStates) -> Columns:
    """Returns one row per tick and person: joints with derivatives and deviations, lengths, limbs, cameras used."""
    columns = with_person({"t_ns": states.t_ns}, states.person)
    for field, suffix in _STATE:
        columns |= _spread(getattr(states, field), JOINTS, suffix)
    columns |= _spread(states.lengths_m, LENGTHS) | _spread(states.lengths_std_m, LENGTHS, "_std")
    columns |= _spread(states.residual_m, _RESIDUAL) | _spread(states.unseen_s, _UNSEEN)
    columns |= {_FRAME_AGE: states.frame_age_s} | _spread(states.points_m.reshape(len(states), -1), _SHOWN)
    if states.camera_points_m is not None:
        for i, camera in enumerate(states.cameras):
            columns |= _spread(states.camera_points_m[:, i].reshape(len(states), -1), _shown_by(camera))
    columns |= {_AS_LENGTH: states.p[:, _HEIGHT], f"{_AS_LENGTH}_std": states.p_std[:, _HEIGHT]}
    columns |= {name: column for name in _MAYBE if (column := getattr(states, name)) is not None}
    return columns | {f"valid_{camera}": states.valid[:, i] for i, camera in enumerate(states.cameras)}


#: Columns that every table of this name has, for any cameras and robot; readers rely on them.
COLUMNS = {
    "measurements": ("capture_ns", "arrival_ns", "camera", *JOINTS, *(f"{joint}_std" for joint in JOINTS), *_LENGTHS),
    "bodies": ("camera", "frames", "floor_m", "floor_p95_m", "by_ankles", "head_m", "bones_m"),
    "agreement": ("a", "b", "limb", "median_m", "p95_m", "pairs", "mirrored"),
    "truth": ("t_ns", *JOINTS, *_LENGTHS),
    "state": (
        "t_ns",
        *(f"{joint}{suffix}" for _, suffix in _STATE for joint in JOINTS),
        *(f"{length}{suffix}" for suffix in ("", "_std") for length in _LENGTHS),
        *_RESIDUAL,
        *_UNSEEN,
        _FRAME_AGE,
        *_SHOWN,
        "legs_sway_m",
    ),
    "occupancy": ("t_ns", "limb", "method", "radius_m", "volume_m3", "vertices", "horizon_s"),
    "motion": (
        "t_ns",
        *(name for field in MotionRow._fields for name in number_names(field, 0)),  # without the columns of the axes
    ),
    "contact": (
        *("t_ns", "method", "person", "moving", "distance_m", "limb", "link", "tcp_speed", "contact_speed"),
        *("source", "person_m", "other_m", "outside_m", "left_m", "left_limb", "left_full_m", "left_full_limb"),
    ),
    "severity": (
        *("t_ns", "method", "kind", "duration_s", "source", "link", "limb", "region", "distance_m"),
        *("robot_speed", "person_speed", "robot_kg", "robot_simple_kg", "person_kg", "stiffness_n_per_m"),
        *("energy_j", "energy_simple_j", "energy_limit_j"),
        *("transient_n", "transient_limit_n", "clamped_n", "clamped_limit_n"),
    ),
}


def missing_columns(path: Path) -> tuple[str, ...]:
    """Returns the COLUMNS that a table of an earlier version lacks; ``motion_<baseline>`` has those of motion."""
    names = set(pq.read_schema(path).names)
    return tuple(name for name in COLUMNS[path.stem.split("_")[0]] if name not in names)


def read_states(path: Path, chunk_ticks: int) -> Iterator[HumanStates]:
    """Reads state.parquet into records, bit for bit, about ``chunk_ticks`` rows at a time; no tick is divided."""
    pending: HumanStates | None = None
    with pq.ParquetFile(path, pre_buffer=False) as file:  # the buffer would hold the whole file until the end
        cameras = _cameras(file)
        for batch in file.iter_batches(batch_size=max(chunk_ticks, _ROWS), use_threads=False):
            states = _states(
                {name: batch.column(name).to_numpy(zero_copy_only=False) for name in batch.schema.names}, cameras
            )
            if states.person is None:
                yield from _pieces(states, chunk_ticks)
                continue
            if pending is not None:  # its last tick may go on in this batch
                whole = int(np.searchsorted(pending.t_ns, pending.t_ns[-1]))
                yield from _pieces(pending.rows(slice(0, whole)), chunk_ticks)
                states = HumanStates.join([pending.rows(slice(whole, None)), states])
            pending = states
    if pending is not None:
        yield from _pieces(pending, chunk_ticks)


def _pieces(states: HumanStates, size: int) -> Iterator[HumanStates]:
    """Divides a table into pieces of ``size`` rows, and the rest of a tick that began there."""
    first = 0
    while first < len(states.t_ns):
        last_ns = states.t_ns[min(first + size, len(states.t_ns)) - 1]
        end = int(np.searchsorted(states.t_ns, last_ns, side="right"))
        yield states.rows(slice(first, end))
        first = end


def read_states_at(path: Path, at_ns: Ints) -> HumanStates:
    """Reads the rows of some ticks of state.parquet; only the groups of rows that may have them are read."""
    found: list[HumanStates] = []
    with pq.ParquetFile(path) as file:
        cameras = _cameras(file)
        column = file.schema_arrow.names.index("t_ns")
        for group in range(file.num_row_groups):
            known = file.metadata.row_group(group).column(column).statistics
            if found and not ((known.min <= at_ns) & (at_ns <= known.max)).any():
                continue
            table = file.read_row_group(group)
            table = table.filter(pc.is_in(table["t_ns"], pa.array(at_ns)))
            found.append(_states({name: table[name].to_numpy() for name in table.column_names}, cameras))
    return HumanStates.join(found)


def _cameras(file: pq.ParquetFile) -> tuple[str, ...]:
    return tuple(n.removeprefix("valid_") for n in file.schema_arrow.names if n.startswith("valid_"))


def _states(column: Columns, cameras: tuple[str, ...]) -> HumanStates:
    return HumanStates(
        t_ns=column["t_ns"],
        **{field: _gather(column, JOINTS, suffix) for field, suffix in _STATE},
        lengths_m=_gather(column, LENGTHS),
        lengths_std_m=_gather(column, LENGTHS, "_std"),
        valid=np.column_stack([column[f"valid_{camera}"] for camera in cameras]),
        residual_m=_gather(column, _RESIDUAL),
        unseen_s=_gather(column, _UNSEEN),
        frame_age_s=column[_FRAME_AGE],
        points_m=_gather(column, _SHOWN).reshape(-1, len(POINTS), 3),
        cameras=cameras,
        camera_points_m=_camera_points(column, cameras),
        legs_sway_m=column.get("legs_sway_m"),
        nobody_s=column.get("nobody_s"),
        nobody_else_s=column.get("nobody_else_s"),
        person=column.get("person"),
    )


def _camera_points(column: Columns, cameras: tuple[str, ...]) -> Floats | None:
    """(n, c, 20, 3) points of each camera [m]; None in a table without them."""
    if not all(_shown_by(camera)[0] in column for camera in cameras):
        return None
    return np.stack([_gather(column, _shown_by(camera)).reshape(-1, len(POINTS), 3) for camera in cameras], axis=1)


def occupancy_columns(
    t_ns: Ints,
    limbs: list[str],
    method: str,
    radius_m: list[float],
    volume_m3: list[float],
    hulls: list[Floats],
    horizon_s: list[float],
) -> Columns:
    """Returns one row per stored tick and limb; ``hulls`` are (m, 3) hull vertices in the world [m], before the radius.

    Args:
        t_ns: (n,) ticks [ns].
        limbs: Limb of each row.
        method: Method of the swept volumes.
        radius_m: Radius of the ball around each hull [m].
        volume_m3: Volume of each hull with its ball, above the floor [m^3].
        hulls: (m, 3) hull vertices of each row, before the radius, world [m].
        horizon_s: Horizon of each row, after its tick [s].
    """
    return {
        "t_ns": t_ns,
        "limb": _text(limbs),
        "method": _text([method] * len(limbs)),
        "radius_m": np.array(radius_m, dtype=float),
        "volume_m3": np.array(volume_m3, dtype=float),
        "horizon_s": np.array(horizon_s, dtype=float),
        "vertices": pa.array([np.ascontiguousarray(hull).ravel() for hull in hulls], type=pa.list_(pa.float64())),
    }


def motion_columns(motion: Motion) -> Columns:
    """Returns one row per tick: the commanded motion, and the distance from the person."""
    names = {"limb": motion.limbs, "link": motion.links, "status": STATUSES, "reason": motion.reasons}
    columns: Columns = {"t_ns": motion.t_ns}
    for field in MotionRow._fields:
        values = getattr(motion, field)
        if field in names:
            columns[field] = _names(values, names[field])
        elif values.ndim == 2:
            columns |= _spread(values, number_names(field, values.shape[1]))
        else:
            columns[field] = values
    return columns


def static_columns(
    *,
    object_m: Floats,
    nearest_object: tuple[Ints, tuple[str, ...]],
    object_link: tuple[Ints, tuple[str, ...]],
    self_m: Floats,
    self_links: tuple[Ints, Ints, tuple[str, ...]],
) -> Columns:
    """Returns further columns of motion for a cell with objects: the nearest object and the nearest pair of links.

    Args:
        object_m: (n,) surface to surface, of links that keep the full distance; negative in overlap, NaN without one
            [m].
        nearest_object: (n,) indices of that object, -1 without one, and the names of all hulls.
        object_link: (n,) indices of its link, and the names of all links.
        self_m: (n,) surface to surface of two links that are kept apart; NaN without a pair [m].
        self_links: (n,) indices of the two, -1 without a pair, and the names of all links.
    """
    return {
        "object_distance_m": object_m,
        "object": _names(*nearest_object),
        "object_link": _names(*object_link),
        "self_distance_m": self_m,
        "self_link": _names(self_links[0], self_links[2]),
        "self_other_link": _names(self_links[1], self_links[2]),
    }


def contact_columns(
    *,
    t_ns: Ints,
    method: str,
    person: str,
    moving: Bools,
    distance_m: Floats,
    part: tuple[Ints, tuple[str, ...]],
    link: tuple[Ints, tuple[str, ...]],
    speeds: tuple[Floats, Floats],
    source: tuple[Ints, tuple[str, ...]],
    apart: tuple[Floats, Floats],
    outside_m: Floats,
    left: tuple[Floats, Ints, tuple[str, ...]],
    left_full: tuple[Floats, Ints, tuple[str, ...]],
) -> Columns:
    """Returns one row per tick of a method: the smallest distance of the robot over all bodies and sources.

    Args:
        t_ns: (n,) [ns].
        method: Method of the robot.
        person: Source of the recorded person.
        moving: (n,) True if any axis turns.
        distance_m: (n,) between the surfaces of robot and nearest body, negative in overlap; NaN: no known body [m].
        part: (n,) indices of the nearest part of the body, -1 without one, and the names of all parts.
        link: (n,) indices of the nearest link, -1 without one, and the names of all links.
        speeds: (n,) each: of the TCP, and of the link's surface where it is nearest to the body [m/s].
        source: (n,) indices of the source of the nearest body, -1 without one, and the names of all sources.
        apart: (n,) each: the distance of the person, and of the nearest other body; NaN: unknown [m].
        outside_m: (n,) distance of the touched part outside the volume used to certify the motion; NaN if no moving
            part touched the person, or without a prediction [m].
        left: (n,) maximum distance by which a limb left the volume of the tick until its horizon, 0 if none did, NaN if
            not checked [m]; (n,) indices of that limb, -1 without one, and the names of all limbs.
        left_full: The same until the braking time T_s, independent of the tick's horizon.
    """
    return {
        "t_ns": t_ns,
        "method": _text([method] * len(t_ns)),
        "person": _text([person] * len(t_ns)),
        "moving": moving,
        "distance_m": distance_m,
        "limb": _names(*part),
        "link": _names(*link),
        "tcp_speed": speeds[0],
        "contact_speed": speeds[1],
        "source": _names(*source),
        "person_m": apart[0],
        "other_m": apart[1],
        "outside_m": outside_m,
        "left_m": left[0],
        "left_limb": _names(left[1], left[2]),
        "left_full_m": left_full[0],
        "left_full_limb": _names(left_full[1], left_full[2]),
    }


def person_columns(number: int, distance_m: Floats, left_m: Floats, left_full_m: Floats) -> Columns:
    """Returns the further columns of contact for one of several people.

    Args:
        number: Number of the person.
        distance_m: (n,) distance of the robot's surface; NaN: unknown [m].
        left_m: (n,) as ``left`` of ``contact_columns`` [m].
        left_full_m: (n,) as ``left_full`` [m].
    """
    return {
        f"person_{number}_m": distance_m,
        f"left_person_{number}_m": left_m,
        f"left_full_person_{number}_m": left_full_m,
    }


def record_columns(rows: Sequence[Any]) -> Columns:
    """Returns one row per record, for flat dataclasses of one type; one column per field."""
    columns = {spec.name: [getattr(row, spec.name) for row in rows] for spec in fields(rows[0])}
    return {name: _text(values) if isinstance(values[0], str) else np.array(values) for name, values in columns.items()}


def body_columns(t_ns: Ints, axes_m: Floats, parts: tuple[str, ...], person: Ints | None = None) -> Columns:
    """Returns one row per instant and person.

    Args:
        t_ns: (n,) instants [ns].
        axes_m: (n, p, 2, 3) ends of the recorded body's capsules, world; NaN if unknown [m].
        parts: Names of the p capsules.
        person: (n,) number of the person; None: person 1.
    """
    names = [f"{part}_{end}_{axis}" for part in parts for end in (0, 1) for axis in "xyz"]
    return with_person({"t_ns": t_ns, **_spread(axes_m.reshape(len(t_ns), -1), names)}, person)


def _spread(array: Floats, names: tuple[str, ...] | list[str], suffix: str = "") -> Columns:
    return {f"{name}{suffix}": np.ascontiguousarray(array[:, i]) for i, name in enumerate(names)}


def _gather(column: Columns, names: tuple[str, ...], suffix: str = "") -> Floats:
    return np.column_stack([column[f"{name}{suffix}"] for name in names])


def _text(values: list[str]) -> pa.Array:
    return pa.array(values, type=pa.string())


def _names(index: Ints, names: tuple[str, ...]) -> pa.Array:
    """Index -> name; -1 -> null."""
    return pa.array([names[i] if i >= 0 else None for i in index.tolist()], type=pa.string())
