"""Commands on a log before it is replayed: info, import and calibrate."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from hrcreplay.calibration import calibrate as calibration
from hrcreplay.calibration.cell import Cell, load_cell, pose_from_position, write_cell
from hrcreplay.errors import SettingsError
from hrcreplay.logs import importers, info
from hrcreplay.logs.motion_files import ImportMapping, import_motion
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline.run_config import robot_description
from hrcreplay.settings.load import load_settings
from hrcreplay.toml_file import read_toml, validate

#: Kinds of files that ``import`` reads with functions of their own; the others are ``formats.FORMATS``.
_OWN_KINDS = ("azure", "kinect2", "keraal")
_KERAAL_HZ = 30.0


def describe(
    path: Path,
    config: Path | None,
    overrides: tuple[str, ...],
    cell_file: Path | None = None,
    *,
    as_json: bool = False,
) -> list[str]:
    """Describes the content of a log, line by line.

    Args:
        path: The log.
        config: Settings file; may be None.
        overrides: ``section.key=value`` of the command line; they override the file.
        cell_file: Poses and clock offsets of the cameras; they override the log's.
        as_json: True: all of it as JSON.

    Raises:
        SettingsError: A setting cannot be used.
        LogError: The log cannot be read.
    """
    settings = load_settings(config, overrides)
    robot = robot_description(settings.robot)
    cell = load_cell(cell_file) if cell_file is not None else Cell()
    log = open_log(path, settings.logs, skeletons=False)
    summary = info.summarize(
        log,
        axes=robot.joints,
        frames=robot.frames,
        options=settings.logs,
        T_world_camera=cell.T_world_camera,
        clock_offset_s=cell.clock_offset_s,
        T_world_base=cell.T_world_base,
    )
    return [info.as_json(summary)] if as_json else info.lines(summary)


def import_files(
    kind: str, files: list[str], out: Path, rate_hz: float | None = None, mapping: Path | None = None
) -> list[str]:
    """Makes a log from files of other programs; returns notes for the user.

    Args:
        kind: azure, kinect2, keraal or one of ``formats.FORMATS``.
        files: ``[camera=]path``, one per camera; for keraal the Kinect's file and, optionally, the optical one.
        out: Log to write.
        rate_hz: Frames a second of files that do not tell; None: as in the file, 30 for keraal [Hz].
        mapping: TOML file with a description of the files, as in ``motion_files.ImportMapping``; None: none.

    Raises:
        SettingsError: The kind is unknown, there are too many files, a camera is given twice, ``out`` exists, or the
            mapping cannot be used.
        LogError: A file cannot be read.
    """
    from hrcreplay.logs.formats import FORMATS  # slow to load

    if kind not in (*_OWN_KINDS, *FORMATS):
        raise SettingsError(f"import: found {kind!r}; would be right: {', '.join((*_OWN_KINDS, *FORMATS))}")
    if kind in FORMATS:
        return import_motion(FORMATS[kind], _by_camera(files), out, _mapping(kind, mapping, rate_hz))
    if mapping is not None:
        raise SettingsError(f"import {kind}: found --mapping; would be right: without, or one of {', '.join(FORMATS)}")
    if kind == "keraal":
        if len(files) > 2:
            raise SettingsError(f"import keraal: found {len(files)} files; give the Kinect's, then the optical one")
        paths = [Path(file) for file in files]
        rate_hz = _KERAAL_HZ if rate_hz is None else rate_hz
        return importers.import_keraal(paths[0], paths[1] if len(paths) > 1 else None, out, rate_hz)
    make = importers.import_azure if kind == "azure" else importers.import_kinect2
    return make(_by_camera(files), out)


def _mapping(kind: str, path: Path | None, rate_hz: float | None) -> ImportMapping:
    """Returns the description of the files: that of the mapping file, with the rate of the command line."""
    if path is None and kind == "table":
        raise SettingsError("import table: found no description of the table; give one with --mapping FILE.toml")
    table = {} if path is None else read_toml(path, "name a TOML file")
    if rate_hz is not None:
        table["rate_hz"] = rate_hz
    return validate(ImportMapping, table, "--rate" if path is None else path)


def _by_camera(files: list[str]) -> dict[str, Path]:
    """Returns the files by camera; a file without a camera's name gets its file name without endings."""
    found: dict[str, Path] = {}
    for file in files:
        name, equals, path = file.partition("=")
        camera, path = (name, path) if equals else (Path(file).name.split(".")[0], file)
        if camera in found:
            raise SettingsError(
                f"import: camera {camera} is given twice; name each file's camera: left=FILE right=FILE"
            )
        found[camera] = Path(path)
    return found


def calibrate(
    log: Path,
    out: Path,
    config: Path | None,
    overrides: tuple[str, ...],
    *,
    reference: str | None,
    up: str | None,
    height_m: float | None,
    base: str | None,
) -> list[str]:
    """Writes the cell file of a log's cameras; returns the residuals and the uncertain results, line by line.

    Args:
        log: Log whose cameras saw one person.
        out: Cell file to write.
        config: Settings file; may be None.
        overrides: ``section.key=value`` of the command line; they override the file.
        reference: Camera that defines the world; None: the first.
        up: ``X,Y,Z``, up in the reference camera's frame; None: from the person's feet.
        height_m: Height of the reference camera above the floor [m]; None: from the person's feet.
        base: ``X,Y,Z,YAW`` of the robot base in the world [m, m, m, deg]; None: unknown.

    Raises:
        SettingsError: An option cannot be used, or ``out`` exists.
        LogError: The cameras did not see one person together, or floor and upward direction cannot be determined.
    """
    if out.exists():
        raise SettingsError(f"{out}: exists already; name another file, or remove it")
    settings = load_settings(config, overrides)
    axis = None if up is None else parse_numbers("--up", up, 3)
    place = None if base is None else parse_numbers("--base", base, 4)
    if height_m is not None and not 0.0 <= height_m < math.inf:
        raise SettingsError(f"--height {height_m:g}: would be right: metres above the floor, 0 or more, e.g. 1.6")
    opened = open_log(log, settings.logs)
    cell, stood = calibration.survey(
        opened,
        reference,
        axis,
        height_m,
        jump_m=settings.logs.person_jump_m,
        memory_s=settings.logs.person_memory_s,
    )
    if place is not None:
        cell = replace(cell, T_world_base=pose_from_position(np.array(place[:3]), float(np.radians(place[3]))))
    write_cell(cell, out)
    lines = [
        f"{r.a} - {r.b}: apart by {1e3 * r.median_m:.0f} mm (median), {1e3 * r.p95_m:.0f} mm (p95) at {r.points} points"
        for r in cell.residuals
    ]
    return [*lines, *stood, *opened.notes, *cell.notes]


def parse_numbers(option: str, text: str, count: int) -> list[float]:
    """Parses an option that takes finite numbers with commas between.

    Raises:
        SettingsError: It has another form.
    """
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise SettingsError(f"{option} {text}: would be right: {count} numbers with commas between, e.g. 0,-1,0"[:200])
    return values
