"""Writers of motion files for the tests, written from the formats' descriptions and not from the readers."""

from __future__ import annotations

import csv
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from hrcreplay.records import POINTS, Floats

#: Unit -> how many of it are a metre.
PER_METRE = {"m": 1.0, "cm": 100.0, "mm": 1000.0}


def trc(path: Path, names: list[str], points_m: Floats, rate_hz: float = 30.0, unit: str = "mm") -> None:
    """Markers (n, k, 3); NaN is an empty field."""
    n, k = points_m.shape[:2]
    head = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate_hz:.2f}\t{rate_hz:.2f}\t{n}\t{k}\t{unit}\t{rate_hz:.2f}\t1\t{n}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{i + 1}" for i in range(k) for axis in "XYZ"),
        "",
    ]
    rows = []
    for i, frame in enumerate(points_m * PER_METRE[unit]):
        fields = ["" if np.isnan(value) else f"{value:.5f}" for value in frame.ravel()]
        rows.append("\t".join([str(i + 1), f"{i / rate_hz:.6f}", *fields]))
    path.write_text("\n".join([*head, *rows]) + "\n")


def _c3d_text(text: str, width: int) -> bytes:
    return text.encode().ljust(width)


def c3d(path: Path, names: list[str], points_m: Floats, rate_hz: float = 30.0, unit: str = "mm") -> None:
    """Markers (n, k, 3) as Intel floats; NaN has residual -1, as the format marks lost markers."""
    n, k = points_m.shape[:2]
    width = max(map(len, names))

    def parameter(group: int, name: str, kind: int, dims: list[int], data: bytes) -> bytes:
        body = struct.pack("<bB", kind, len(dims)) + bytes(dims) + data + b"\0"
        return struct.pack("<bb", len(name), group) + name.encode() + struct.pack("<h", len(body) + 2) + body

    def group(number: int, name: str) -> bytes:
        return struct.pack("<bb", len(name), -number) + name.encode() + struct.pack("<h", 3) + b"\0"

    labels = b"".join(_c3d_text(name, width) for name in names)
    made = [
        group(1, "POINT"),
        parameter(1, "USED", 2, [], struct.pack("<h", k)),
        parameter(1, "SCALE", 4, [], struct.pack("<f", -1.0)),
        parameter(1, "RATE", 4, [], struct.pack("<f", rate_hz)),
        parameter(1, "DATA_START", 2, [], struct.pack("<h", 0)),
        parameter(1, "FRAMES", 2, [], struct.pack("<h", n)),
        parameter(1, "LABELS", -1, [width, k], labels),
        parameter(1, "UNITS", -1, [len(unit)], unit.encode()),
        group(2, "ANALOG"),
        parameter(2, "USED", 2, [], struct.pack("<h", 0)),
        parameter(2, "RATE", 4, [], struct.pack("<f", rate_hz)),
    ]
    blocks = -(-(4 + sum(map(len, made)) + 2) // 512)
    data_block = 2 + blocks
    made[4] = parameter(1, "DATA_START", 2, [], struct.pack("<h", data_block))
    section = bytes([1, 0x50, blocks, 84]) + b"".join(made)
    header = struct.pack("<BBhhhhhfhhf", 2, 0x50, k, 0, 1, n, 10, -1.0, data_block, 0, rate_hz)
    values = np.zeros((n, k, 4), dtype="<f4")
    lost = np.asarray(np.isnan(points_m).any(axis=2))
    values[..., :3] = np.where(lost[..., None], 0.0, points_m * PER_METRE[unit])
    values[..., 3] = np.where(lost, -1.0, 0.0)
    path.write_bytes(header.ljust(512, b"\0") + section.ljust(512 * blocks, b"\0") + values.tobytes())


def optitrack(
    path: Path, bodies: dict[str, dict[str, Floats]], rate_hz: float = 120.0, unit: str = "Millimeters"
) -> None:
    """Skeleton -> bone -> places (n, 3) [m]; with rotations between, as Motive exports them."""
    scale = {"Meters": 1.0, "Centimeters": 100.0, "Millimeters": 1000.0}[unit]
    columns = [(skeleton, bone, places * scale) for skeleton, bones in bodies.items() for bone, places in bones.items()]
    n = len(columns[0][2])
    with path.open("w", newline="") as file:
        write = csv.writer(file).writerow
        write(["Format Version", "1.23", "Take Name", "Take", "Export Frame Rate", rate_hz, "Length Units", unit])
        write([])
        write(["", "", *(["Bone"] * 7 * len(columns))])
        write(["", "", *(f"{skeleton}:{bone}" for skeleton, bone, _ in columns for _ in range(7))])
        write(["", "", *(f"{i}" for i in range(len(columns)) for _ in range(7))])
        write(["", "", *([*["Rotation"] * 4, *["Position"] * 3] * len(columns))])
        write(["Frame", "Time (Seconds)", *(["X", "Y", "Z", "W", "X", "Y", "Z"] * len(columns))])
        for i in range(n):
            row: list[Any] = [i, f"{i / rate_hz:.6f}"]
            for _, _, places in columns:
                row += [0, 0, 0, 1, *("" if np.isnan(v) else f"{v:.6f}" for v in places[i])]
            write(row)


def mvnx(path: Path, segments: list[str], places_m: Floats, rate_hz: float = 60.0, *, listed: bool = True) -> None:
    """Origins of the segments (n, k, 3); a T-pose before, as MVN writes it."""
    named = "".join(f'<segment label="{name}" id="{i + 1}"/>' for i, name in enumerate(segments))
    frames = [f'<frame type="tpose" index=""><position>{" ".join(["9"] * 3 * len(segments))}</position></frame>']
    for i, frame in enumerate(places_m):
        numbers = " ".join(f"{v:.6f}" for v in frame.ravel())
        frames.append(
            f'<frame time="{round(1000 * i / rate_hz)}" index="{i}" type="normal"><orientation>1 0 0 0</orientation>'
            f"<position>{numbers}</position></frame>"
        )
    head = f'<subject label="S" frameRate="{rate_hz:g}" segmentCount="{len(segments)}">'
    listing = f"<segments>{named}</segments>" if listed else ""
    text = f"{head}{listing}<frames>{''.join(frames)}</frames></subject>"
    path.write_text(f'<?xml version="1.0"?><mvnx xmlns="http://www.xsens.com/mvn/mvnx" version="4">{text}</mvnx>')


def k4abt(path: Path, joints: list[str], times_us: list[int], frames: list[dict[int, Floats]]) -> None:
    """Body -> places (32, 3) [m] in each frame."""
    content = {
        "joint_names": joints,
        "frames": [
            {
                "timestamp_usec": t,
                "num_bodies": len(bodies),
                "bodies": [{"body_id": i, "joint_positions": (1000 * xyz).tolist()} for i, xyz in bodies.items()],
            }
            for t, bodies in zip(times_us, frames, strict=True)
        ],
    }
    path.write_text(json.dumps(content))


def ntu(path: Path, frames: list[dict[int, Floats]]) -> None:
    """Body -> places (25, 3) [m] in each frame; all joints tracked but the last, which is inferred."""
    rows = [str(len(frames))]
    for bodies in frames:
        rows.append(str(len(bodies)))
        for number, joints in bodies.items():
            rows += [f"{number} 0 1 1 1 1 0 0.01 0.02 2", "25"]
            for j, (x, y, z) in enumerate(joints):
                rows.append(f"{x:.6f} {y:.6f} {z:.6f} 200.5 180.2 900.1 500.3 0.1 0.2 0.3 0.9 {1 if j == 24 else 2}")
    path.write_text("\r\n".join(rows) + "\r\n")


def wide(points_m: Floats, times: list[Any] | None) -> list[dict[str, Any]]:
    """A record per frame, columns as head_x; without a time, no column t."""
    records = []
    for i, frame in enumerate(points_m):
        record = {} if times is None else {"t": times[i]}
        record |= {f"{name}_{axis}": frame[k, j] for k, name in enumerate(POINTS) for j, axis in enumerate("xyz")}
        records.append(record)
    return records
