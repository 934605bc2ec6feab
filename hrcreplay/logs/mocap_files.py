"""Readers of motion capture files: TRC, C3D (by ezc3d), BVH, CSV of Motive (OptiTrack), MVNX of Xsens."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from hrcreplay.errors import LogError
from hrcreplay.logs.motion_files import (
    Body,
    ImportMapping,
    Tracks,
    in_order,
    one_body,
    rate_of,
    seen,
    stacked,
    times_at,
)
from hrcreplay.logs.writer import lines, numbers
from hrcreplay.records import Floats, Ints

_UNITS = {
    **dict.fromkeys(("m", "meters", "metres", "meter"), "m"),
    **dict.fromkeys(("cm", "centimeters", "centimetres"), "cm"),
    **dict.fromkeys(("mm", "millimeters", "millimetres"), "mm"),
}


def _unit(given: str, where: str, mapping: ImportMapping) -> str | None:
    """Returns a file's unit of length; None if it names none. Raises LogError for an unknown one."""
    name = given.strip().lower()
    if not name or mapping.unit is not None:
        return None
    if name not in _UNITS:
        raise LogError(f"{where}: found the unit {given!r}; would be right: m, cm or mm, or unit in --mapping")
    return _UNITS[name]


def _without_subject(name: str) -> str:
    """Returns a point's name without the name of the subject before a colon."""
    return name.rpartition(":")[2].strip()


# --- TRC ---


def read_trc(path: Path, mapping: ImportMapping) -> Tracks:
    """Reads a TRC file: markers with times, unit and rate in the header. Empty fields are missing points."""
    rows = ((where, text.split("\t")) for where, text in lines(path, strip=False))
    head = [next(rows, ("", [])) for _ in range(5)]
    if len(head[4][1]) < 2 or not head[0][1][:1] == ["PathFileType"]:
        raise LogError(f"{path}:1: found {head[0][1][:3]}; would be right: PathFileType and four more lines")
    about = dict(zip(head[1][1], head[2][1], strict=False))
    where, names = f"{path}:4", tuple(_without_subject(name) for name in head[3][1][2:] if name.strip())
    axes = [name.strip() for name in head[4][1] if name.strip()]
    if len(axes) != 3 * len(names):
        raise LogError(f"{path}:5: found {len(axes)} columns for {len(names)} markers; would be right: X, Y, Z of each")
    times, table = [], []
    for where_row, fields in rows:
        times.append(_number(where_row, fields[1] if len(fields) > 1 else ""))
        table.append(_points(where_row, [*fields[2:], *[""] * (3 * len(names))][: 3 * len(names)], fields))
    t_ns = np.round(np.array(times) * 1e9).astype(np.int64)
    points = np.array(table).reshape(len(times), len(names), 3)
    return one_body(t_ns, names, points, str(path), _unit(about.get("Units", ""), where, mapping))


def _number(where: str, text: str) -> float:
    return float(numbers(where, [text.strip()], 1)[0])


def _points(where: str, fields: Sequence[str], row: Sequence[str]) -> Floats:
    if len([text for text in row if text.strip()]) < 2:
        raise LogError(f"{where}: found {len(row)} fields; would be right: frame, time and the markers")
    return numbers(where, [text.strip() or "nan" for text in fields], len(fields))


# --- C3D ---


def read_c3d(path: Path, mapping: ImportMapping) -> Tracks:
    """Reads the markers of a C3D file by ezc3d, which makes lost ones NaN; loaded here, as no other format needs it."""
    if not path.is_file():
        raise LogError(f"{path}: no such file; name a recording")
    import ezc3d

    try:
        found = ezc3d.c3d(str(path))
        about, points = found["parameters"]["POINT"], np.asarray(found["data"]["points"], dtype=np.float64)
        names = [name for key in sorted(about) if key.startswith("LABELS") for name in about[key]["value"]]
        rate_hz, units = float(about["RATE"]["value"][0]), "".join(about.get("UNITS", {"value": []})["value"][:1])
    except (RuntimeError, OSError, KeyError, IndexError, ValueError, MemoryError) as error:
        told = " ".join(str(error).split())
        raise LogError(f"{path}: is no C3D file that can be read ({told}); export it again") from error
    count = points.shape[1]
    if not count or len(names) < count:
        raise LogError(f"{path}: found {count} markers with {len(names)} names; would be right: a name for each")
    table = points[:3].transpose(2, 1, 0)
    t_ns = times_at(len(table), rate_of(mapping, rate_hz or None, str(path)))
    return one_body(
        t_ns, tuple(map(_without_subject, names[:count])), table, str(path), _unit(units, str(path), mapping)
    )


# --- BVH ---


@dataclass
class _Joint:
    """A joint of a BVH file, in the order of the file."""

    name: str
    parent: int  #: -1 for a root
    offset: Floats = field(default_factory=lambda: np.zeros(3))
    channels: tuple[str, ...] = ()


def read_bvh(path: Path, mapping: ImportMapping) -> Tracks:
    """Reads a BVH file: places of its joints by forward kinematics. A position channel replaces the joint's offset.

    The end of a joint is named after it: Head_end. BVH files name no unit.
    """
    rows = lines(path)
    joints = _hierarchy(path, rows)
    where, text = next(rows, (str(path), ""))
    count = _after(where, text, "Frames:")
    where, text = next(rows, (str(path), ""))
    period_s = _after(where, text, "Frame Time:")
    width = sum(len(joint.channels) for joint in joints)
    table = [numbers(where, text.split(), width) for where, text in rows]
    if len(table) != count:
        raise LogError(f"{path}: found {len(table)} frames; would be right: {count:g}, as Frames: says")
    values = np.array(table).reshape(len(table), width)
    if not period_s > 0:
        raise LogError(f"{where}: Frame Time: found {period_s:g}; would be right: seconds from frame to frame")
    t_ns = times_at(len(values), rate_of(mapping, 1.0 / period_s, str(path)))
    names = tuple(_without_subject(joint.name) for joint in joints)
    return one_body(t_ns, names, _placed(joints, values), str(path), None)


def _after(where: str, text: str, word: str) -> float:
    if not text.startswith(word):
        raise LogError(f"{where}: found {text[:40]!r}; would be right: {word} and a number")
    return _number(where, text[len(word) :])


def _hierarchy(path: Path, rows: Iterator[tuple[str, str]]) -> list[_Joint]:
    """Reads the joints up to the line MOTION."""
    joints: list[_Joint] = []
    open_: list[int] = []
    newest = -1
    where, text = next(rows)
    if text.split()[0] != "HIERARCHY":
        raise LogError(f"{where}: found {text[:40]!r}; would be right: HIERARCHY")
    for where, text in rows:
        words = text.split()
        if words[0] in ("ROOT", "JOINT", "End"):
            parent = open_[-1] if open_ else -1
            name = f"{joints[parent].name}_end" if words[0] == "End" else " ".join(words[1:])
            joints.append(_Joint(name, parent))
            newest = len(joints) - 1
        elif words[0] == "{":
            open_.append(newest)
        elif words[0] == "}" and open_:
            open_.pop()
        elif words[0] == "OFFSET" and open_:
            joints[open_[-1]].offset = numbers(where, words[1:], 3)
        elif words[0] == "CHANNELS" and open_:
            joints[open_[-1]].channels = _channels(where, words[1:])
        elif words[0] == "MOTION" and joints and not open_:
            return joints
        else:
            raise LogError(
                f"{where}: found {text[:40]!r}; would be right: joints, their OFFSET and CHANNELS, then MOTION"
            )
    raise LogError(f"{path}: ends before MOTION; would be right: the whole file")


def _channels(where: str, words: list[str]) -> tuple[str, ...]:
    known = {f"{axis}{kind}" for axis in "XYZ" for kind in ("position", "rotation")}
    if not words or words[0] != str(len(words) - 1) or not set(words[1:]) <= known:
        raise LogError(f"{where}: channels: found {' '.join(words)[:60]!r}; would be right: their number and names")
    return tuple(words[1:])


def _placed(joints: list[_Joint], values: Floats) -> Floats:
    """Returns the places (n, joints, 3) of the joints, in the file's unit."""
    places = np.empty((len(values), len(joints), 3))
    turns: list[Rotation] = []
    column = 0
    for k, joint in enumerate(joints):
        mine = values[:, column : column + len(joint.channels)]
        column += len(joint.channels)
        at = np.tile(joint.offset, (len(values), 1))
        for i, channel in enumerate(joint.channels):
            if channel.endswith("position"):
                at[:, "XYZ".index(channel[0])] = mine[:, i]
        about = [i for i, channel in enumerate(joint.channels) if channel.endswith("rotation")]
        order = "".join(joint.channels[i][0] for i in about)
        turn = Rotation.from_euler(order, mine[:, about], degrees=True) if order else Rotation.identity(len(values))
        if joint.parent >= 0:
            at = places[:, joint.parent] + turns[joint.parent].apply(at)
            turn = turns[joint.parent] * turn
        places[:, k] = at
        turns.append(turn)
    return places


# --- Motive ---


def read_optitrack(path: Path, mapping: ImportMapping) -> Tracks:
    """Reads a CSV of Motive: bones of its skeletons; without bones, rigid bodies, and without these, markers."""
    rows = ((where, next(csv.reader([text]), [])) for where, text in lines(path, strip=False))
    where, first = next(rows, (str(path), []))
    about = dict(zip(first[::2], first[1::2], strict=False))
    if "Format Version" not in about:
        raise LogError(f"{where}: found {','.join(first)[:40]!r}; would be right: Format Version,... as Motive exports")
    head: list[list[str]] = []
    for _, row in rows:
        head.append(row)
        if row[:1] == ["Frame"]:
            break
    columns = _columns(head, where)
    skeletons = list(dict.fromkeys(skeleton for skeleton, _ in columns))
    names = tuple(dict.fromkeys(name for _, name in columns))
    times, table, width = [], [], len(head[-1])
    for where, row in rows:
        times.append(_number(where, row[1] if len(row) > 1 else ""))
        fields = [text.strip() or "nan" for text in [*row, *[""] * width][:width]]
        table.append(numbers(where, fields, width))
    values = np.array(table).reshape(len(times), width)
    t_ns = np.round(np.array(times) * 1e9).astype(np.int64)
    bodies = np.full((len(times), len(skeletons), len(names), 3), np.nan)
    for (skeleton, name), places in columns.items():
        bodies[:, skeletons.index(skeleton), names.index(name)] = values[:, places]
    return _interleaved(t_ns, names, bodies, str(path), _unit(about.get("Length Units", ""), str(path), mapping))


def _columns(head: list[list[str]], where: str) -> dict[tuple[str, str], list[int]]:
    """Returns skeleton and name of each point -> its columns of x, y, z, of the most suitable type of points."""
    axes = head[-1] if head else []
    kinds, labels = (head[0], head[1]) if len(head) > 3 else ([], [])
    what = next((row for row in head[:-1] if "Position" in row), [])
    for kind in ("Bone", "Rigid Body", "Marker"):
        found: dict[tuple[str, str], dict[str, int]] = {}
        for i, axis in enumerate(axes):
            if i < min(len(kinds), len(labels), len(what)) and kinds[i] == kind and what[i] == "Position":
                skeleton, _, name = labels[i].rpartition(":")
                found.setdefault((skeleton, name), {})[axis] = i
        for (skeleton, name), of_axis in found.items():
            if set(of_axis) != {"X", "Y", "Z"}:
                raise LogError(
                    f"{where}: {skeleton}:{name} has {', '.join(of_axis)}; would be right: the columns X, Y and Z"
                )
        if found:
            return {key: [of_axis[axis] for axis in "XYZ"] for key, of_axis in found.items()}
    raise LogError(
        f"{where}: found no positions of bones, rigid bodies or markers; would be right: an export with bones"
    )


def _interleaved(t_ns: Ints, names: tuple[str, ...], bodies: Floats, where: str, unit: str | None) -> Tracks:
    """Returns tracks of several bodies (n, bodies, k, 3), frame by frame."""
    in_order(t_ns, where)
    count = bodies.shape[1]
    points = bodies.reshape(-1, len(names), 3)
    known = seen(points)
    there = known.any(axis=1)
    numbers_ = np.tile(np.arange(count, dtype=np.int64), len(t_ns))
    if not there.any():
        raise LogError(f"{where}: found no body; would be right: a recording of a person")
    return Tracks(np.repeat(t_ns, count)[there], numbers_[there], names, points[there], known[there], unit)


# --- MVNX ---

#: Segments of MVN in the order of its files, for files without a list.
_SEGMENTS = (
    *("Pelvis", "L5", "L3", "T12", "T8", "Neck", "Head"),
    *(f"{side}{name}" for side in ("Right", "Left") for name in ("Shoulder", "UpperArm", "ForeArm", "Hand")),
    *(f"{side}{name}" for side in ("Right", "Left") for name in ("UpperLeg", "LowerLeg", "Foot", "Toe")),
)


def read_mvnx(path: Path, mapping: ImportMapping) -> Tracks:
    """Reads an MVNX file: origins of the segments [m], in frames of type normal; several subjects are bodies."""
    segments: list[str] = []
    rate_hz: float | None = None
    subject, bodies = -1, []
    try:
        for event, element in ET.iterparse(path, events=("start", "end")):  # noqa: S314  expat bounds entity expansion
            tag = element.tag.rpartition("}")[2]
            if event == "start" and tag == "subject":
                subject, segments = subject + 1, []
                rate_hz = float(element.get("frameRate") or 0) or None
            elif event == "end" and tag == "segment":
                segments.append(element.get("label") or "")
            elif event == "end" and tag == "frame":
                if element.get("type", "normal") == "normal":
                    bodies.append(_segments_at(path, element, segments or list(_SEGMENTS), max(0, subject)))
                element.clear()
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror}); name a recording") from error
    except (ET.ParseError, ValueError) as error:
        raise LogError(f"{path}: is no MVNX file that can be read ({error}); export it again") from error
    if not bodies:
        raise LogError(f"{path}: found no frame of type normal; would be right: an export with position")
    if any(body.t_ns < 0 for body in bodies):
        bodies = _timed(bodies, rate_of(mapping, rate_hz, str(path)))
    bodies.sort(key=lambda body: body.t_ns)
    return stacked(bodies, tuple(segments or _SEGMENTS), str(path), "m")


def _timed(bodies: list[Body], rate_hz: float) -> list[Body]:
    """Returns the bodies with times by the rate, each subject from 0 on."""
    t_ns = times_at(len(bodies), rate_hz)
    counts: Counter[int] = Counter()
    timed = []
    for body in bodies:
        timed.append(replace(body, t_ns=int(t_ns[counts[body.number]])))
        counts[body.number] += 1
    return timed


def _segments_at(path: Path, frame: ET.Element, segments: list[str], subject: int) -> Body:
    """Returns the segments' origins in a frame; a time of -1 if it has none."""
    where = f"{path}: frame {frame.get('index', '?')}"
    found = next((part for part in frame if part.tag.rpartition("}")[2] == "position"), None)
    if found is None:
        raise LogError(f"{where}: has no position; would be right: an export with position of the segments")
    points = numbers(where, (found.text or "").split(), 3 * len(segments)).reshape(-1, 3)
    time = frame.get("time", "")
    t_ns = round(float(time) * 1e6) if time.strip() else -1
    return Body(t_ns, subject, points, seen(points))
