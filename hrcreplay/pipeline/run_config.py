"""The configuration of a run: log, settings, cell, task and span, resolved from the command line or an earlier run.

It includes the files of ``robot.urdf``: the URDF and the meshes of its links, which may be in several packages.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any, TypedDict

import numpy as np

from hrcreplay.calibration.cell import Cell, load_cell
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.human.model import LimitSet
from hrcreplay.limits import load_limits
from hrcreplay.logs.unpack import ZSTD_MAGIC
from hrcreplay.robot import irb140
from hrcreplay.robot.model import Segment, from_urdf
from hrcreplay.robot.urdf import Description, describe, disabled_pairs
from hrcreplay.settings.load import Settings, as_overrides, load_settings
from hrcreplay.settings.sections import LinkSettings, Robot
from hrcreplay.store import run_folder
from hrcreplay.store.machine import describe_machine
from hrcreplay.toml_file import read_toml
from hrcreplay.version import __version__


@dataclass(frozen=True)
class UrdfFiles:
    """A URDF's text, and the paths of its meshes."""

    text: str
    meshes: tuple[tuple[str, str], ...]  #: file name of a collision mesh, and its path
    inputs: tuple[tuple[str, str], ...]  #: path and SHA-256 of each file that was read, the URDF first
    capsules: tuple[LinkSettings, ...] = ()  #: capsules of the links that a run has recorded: then no mesh is read


def robot_description(robot: Robot) -> Description:
    """Returns the chain of the robot in the settings, with the limits of its axes.

    Raises:
        SettingsError: The URDF cannot be used.
    """
    files = read_urdf(robot)
    xml, tcp_frame = (irb140.urdf(), "flange") if files is None else (files.text, robot.tcp_frame)
    return describe(xml, tcp_frame, robot.base_frame)


def read_urdf(robot: Robot) -> UrdfFiles | None:
    """Reads the files of the robot in the settings; none for the IRB 140.

    Meshes are searched only if link capsules are derived from them.

    Raises:
        SettingsError: The URDF or one of its meshes is missing or cannot be read.
    """
    path = robot.urdf
    if path is None:
        return None
    if not path.is_file():
        raise SettingsError(f"robot.urdf: {path} is not a file; name a URDF, or leave it out for the IRB 140")
    _check_size(path, _URDF_BYTES)
    try:
        text = path.read_text()
    except UnicodeDecodeError as error:
        raise SettingsError(f"robot.urdf: {path} is not text ({error.reason}); name a URDF") from error
    meshes: dict[str, str] = {}
    if not robot.links:
        for shape in describe(text, robot.tcp_frame, robot.base_frame).shapes:
            if shape.mesh is not None and shape.mesh not in meshes:
                meshes[shape.mesh] = str(_find(shape.mesh, shape.link, path, robot.packages))
    files = [path, *(Path(mesh) for mesh in meshes.values())]
    for mesh in files[1:]:
        _check_size(mesh, _MESH_BYTES)
        _check_kind(mesh)
    return UrdfFiles(text, tuple(meshes.items()), tuple((str(file), run_folder.sha256(file)) for file in files))


def read_srdf(robot: Robot) -> tuple[tuple[str, str], ...]:
    """Returns the pairs of links that the SRDF in the settings disables; none without one.

    Raises:
        SettingsError: The file is missing or is not an SRDF.
    """
    path = robot.srdf
    if path is None:
        return ()
    if not path.is_file():
        raise SettingsError(f"robot.srdf: {path} is not a file; name an SRDF, or leave it out")
    _check_size(path, _URDF_BYTES)
    try:
        return disabled_pairs(path.read_text())
    except UnicodeDecodeError as error:
        raise SettingsError(f"robot.srdf: {path} is not text ({error.reason}); name an SRDF") from error


#: Maximum size of a URDF, and of a mesh: 400,000 triangles of a binary STL [bytes].
_URDF_BYTES, _MESH_BYTES = 8 << 20, 20 << 20


def _check_size(path: Path, most: int) -> None:
    size = path.stat().st_size
    if size > most:
        raise SettingsError(
            f"robot.urdf: {path} has {size / (1 << 20):.0f} MB; at most {most >> 20} MB are read, so simplify the mesh "
            "or give robot.links"
        )


#: File endings of accepted meshes; in these formats the data in memory are at most a few times as large as the file.
_MESHES = (".stl", ".dae", ".obj")
#: First bytes of packed files: zip, gzip, zstd.
_PACKED = (b"PK", b"\x1f\x8b", ZSTD_MAGIC)


def _check_kind(mesh: Path) -> None:
    """Rejects a mesh that may be packed, as the library unpacks it without a size limit, or is not in metres."""
    from hrcreplay.calibration.meshes import unit_m  # slow to load; few robots have meshes

    with mesh.open("rb") as file:
        packed = file.read(4).startswith(_PACKED)
    if packed or mesh.suffix.lower() not in _MESHES:
        raise SettingsError(
            f"robot.urdf: {mesh} is {'packed' if packed else 'of another format'}; STL, Collada and OBJ (.stl, .dae, "
            ".obj) are read, not packed, so convert it or give robot.links"
        )
    try:
        length = unit_m(mesh)
    except ValueError as error:
        raise SettingsError(f"robot.urdf: {mesh}: {error}; a Collada mesh is in a unit > 0") from error
    if length != 1.0:
        raise SettingsError(
            f"robot.urdf: {mesh} has a unit of {length:g} m; would be right: metres, because pinocchio converts no "
            "unit, so convert it or give robot.links"
        )


def _find(name: str, link: str, urdf: Path, packages: tuple[Path, ...]) -> Path:
    """Finds a file that a URDF names by ``package://PACKAGE/...`` or by its path."""
    scheme, _, rest = name.partition("://") if "://" in name else ("", "", name)
    if scheme in ("", "file"):
        path = urdf.parent / rest  # an absolute path stays one
        if path.is_file():
            return path
        raise SettingsError(f"robot.urdf: {urdf}: the mesh {name} of link {link!r} is not at {path}")
    package, _, inside = rest.partition("/")
    roots = [*packages, *urdf.resolve().parents, *_ros_path()]
    for root in roots:
        for path in (root / rest, root / inside):
            if path.is_file() and (path == root / rest or root.name == package):
                return path
    raise SettingsError(
        f"robot.urdf: {urdf}: the mesh {name} of link {link!r} is not in {_listed(packages)} "
        f"(robot.packages), nor beside the URDF, nor in {_listed(_ros_path())} (ROS_PACKAGE_PATH); name the directory "
        f"that holds {package!r} in robot.packages, or give robot.links"
    )


def _ros_path() -> list[Path]:
    """Returns the directories in which ROS searches packages."""
    ros1 = os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)
    ros2 = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return [Path(root) for root in ros1 if root] + [Path(root) / "share" for root in ros2 if root]


def _listed(roots: tuple[Path, ...] | list[Path]) -> str:
    return ", ".join(str(root) for root in roots) or "nothing"


STAGES = ("fuse", "predict", "plan")

#: Tables that each stage writes.
TABLES = {
    "fuse": ("measurements.parquet", "state.parquet", "truth.parquet", "bodies.parquet", "agreement.parquet"),
    "predict": ("occupancy.parquet",),
    "plan": ("motion.parquet", "motion_*.parquet"),
}

#: Entries of run.json that are required to repeat a run.
_NEEDED = ("inputs", "settings", "cell", "task", "span_s")

#: Packages whose version can change a result.
PACKAGES = (
    *("coal", "filterpy", "llvmlite", "mcap", "numba", "numpy", "pin", "proxsuite", "pyarrow", "rosbags", "ruckig"),
    "scipy",
)


@dataclass(frozen=True)
class RunConfig:
    """One command on one log, resolved."""

    command: str
    log: Path
    log_sha256: str
    settings: Settings
    cell: Cell | None
    task: dict[str, Any] | None
    start_s: float | None
    end_s: float | None
    tracking_limits: LimitSet
    prediction_limits: LimitSet
    earlier: Path | None  #: run folder given instead of a log
    recorded_urdf: UrdfFiles | None = None  #: file of an earlier run; None: as in the settings
    recorded_srdf: tuple[tuple[str, str], ...] | None = None  #: pairs of an earlier run; None: as in the settings

    @property
    def urdf(self) -> UrdfFiles | None:
        """The robot's files; none for the IRB 140.

        Raises:
            SettingsError: As for ``read_urdf``.
        """
        return self.recorded_urdf or read_urdf(self.settings.robot)

    @property
    def disabled_pairs(self) -> tuple[tuple[str, str], ...]:
        """Pairs of links that an SRDF does not keep apart.

        Raises:
            SettingsError: As for ``read_srdf``.
        """
        return read_srdf(self.settings.robot) if self.recorded_srdf is None else self.recorded_srdf

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages that the command runs."""
        return STAGES[: STAGES.index(self.command) + 1] if self.command in STAGES else STAGES

    def arguments(self, *, smooth: bool) -> list[str]:
        """Returns a command line that makes the same run again, from any source of settings; names without folders.

        ``CELL.toml`` is a placeholder for the cell file; its content is the run's ``cell``.
        """
        span = (("--start", self.start_s), ("--end", self.end_s))
        return [
            *(self.command, self.log.name),
            *(part for name, at_s in span if at_s is not None for part in (name, f"{at_s:.12g}")),
            *(("--cell", "CELL.toml") if self.cell is not None else ()),
            *(("--smooth",) if smooth else ()),
            *(part for setting in as_overrides(self.settings) for part in ("--set", setting)),
        ]

    def meta(self) -> dict[str, Any]:
        """The part of run.json that is known before the first frame is read."""
        return {
            "command": self.command,
            "versions": versions(),
            "machine": describe_machine(),
            "inputs": [{"path": str(self.log), "sha256": self.log_sha256}, *_urdf_inputs(self.settings)],
            "urdf": _urdf_record(self) if "plan" in self.stages else None,
            **({} if self.settings.robot.srdf is None else {"srdf": self.disabled_pairs}),
            "settings": self.settings.model_dump(mode="json"),
            "cell": None if self.cell is None else self.cell.to_dict(),
            "task": self.task,
            "span_s": [self.start_s, self.end_s],
            "limits": {"tracking": self.tracking_limits.plain(), "prediction": self.prediction_limits.plain()},
        }


def versions() -> dict[str, str]:
    """Returns the version of hrcreplay and those of PACKAGES."""
    return {"hrcreplay": __version__, **{name: metadata.version(name) for name in PACKAGES}}


class RunOptions(TypedDict, total=False):
    """Arguments of ``resolve`` that the commands pass on."""

    config: Path | None
    overrides: tuple[str, ...]
    cell_file: Path | None
    start_s: float | None
    end_s: float | None


def resolve(
    command: str,
    source: Path,
    *,
    config: Path | None = None,
    overrides: tuple[str, ...] = (),
    cell_file: Path | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
    given: Mapping[str, Mapping[str, Any]] | None = None,
) -> RunConfig:
    """Resolves the arguments of a command line.

    Settings of a run folder are those of the run unless a settings file or ``--set`` says otherwise.

    Args:
        command: Command of the run.
        source: A log, or the run folder of an earlier command.
        config: Settings file; may be None.
        overrides: ``section.key=value`` of the command line; they override the file.
        cell_file: Poses of cameras and robot; None: those of the earlier run, else of the log.
        start_s: Start of the span, from the log's first message [s]; None: as in the earlier run, else its beginning.
        end_s: End of the span, from the log's first message [s]; None: as in the earlier run, else its end.
        given: Settings, section -> key -> value; they override the file.

    Raises:
        SettingsError: A setting, the cell, a limit set or the run folder cannot be used.
        LogError: The path does not exist.
    """
    if not source.exists():
        raise LogError(f"{source}: nothing is there; give a log or a run folder")
    earlier = run_folder.read_meta(source) if run_folder.is_run(source) else None
    if earlier is not None and (missing := [key for key in _NEEDED if key not in earlier]):
        raise LogError(f"{source}: its run.json lacks {missing[0]}, so another version made it; give the log itself")
    base = earlier["settings"] if earlier is not None else {}
    settings = load_settings(config, overrides, base, given)
    cell = load_cell(cell_file) if cell_file is not None else None
    if earlier is not None:
        cell = cell or (Cell.from_dict(earlier["cell"]) if earlier["cell"] else None)
        start_s = earlier["span_s"][0] if start_s is None else start_s
        end_s = earlier["span_s"][1] if end_s is None else end_s
    log = source
    if earlier is not None:  # a live session's log lies in its folder, even if the folder was moved
        named = Path(earlier["inputs"][0]["path"])
        log = source / named if (source / named).exists() else named
    return RunConfig(
        command=command,
        log=log,
        log_sha256=_digest(log, earlier),
        settings=settings,
        cell=cell,
        task=_task(settings, earlier),
        start_s=start_s,
        end_s=end_s,
        tracking_limits=load_limits(settings.limits.tracking),
        prediction_limits=load_limits(settings.limits.prediction),
        earlier=source if earlier is not None else None,
    )


def read_run_config(folder: Path) -> RunConfig:
    """Reads the configuration of a run from its run.json only; neither log nor limits are opened.

    Raises:
        SettingsError: The folder is not a run folder, or another version made it.
    """
    meta = run_folder.read_meta(folder)
    if missing := [key for key in (*_NEEDED, "limits") if key not in meta]:
        raise SettingsError(f"{folder}: its run.json lacks {missing[0]}, so another version made it")
    return RunConfig(
        command=meta["command"],
        log=Path(meta["inputs"][0]["path"]),
        log_sha256=meta["inputs"][0]["sha256"],
        settings=load_settings(None, (), meta["settings"]),
        cell=Cell.from_dict(meta["cell"]) if meta["cell"] else None,
        task=meta["task"],
        start_s=meta["span_s"][0],
        end_s=meta["span_s"][1],
        tracking_limits=recorded_limits(meta["limits"]["tracking"], folder),
        prediction_limits=recorded_limits(meta["limits"]["prediction"], folder),
        earlier=folder,
        recorded_urdf=_recorded_urdf(meta),
        recorded_srdf=tuple((one, two) for one, two in meta["srdf"]) if "srdf" in meta else None,
    )


def recorded_limits(plain: dict[str, Any], where: str | Path) -> LimitSet:
    """Returns the limit set that a run recorded as JSON.

    Raises:
        SettingsError: Another version recorded it.
    """
    try:
        return LimitSet.of(plain)
    except TypeError as error:  # too many or too few bounds
        raise SettingsError(f"{where}: its limit set {plain.get('name')} is of another version of hrcreplay") from error


def resolve_without_log(command: str, where: Path, settings: Settings, cell_file: Path | None) -> RunConfig:
    """Resolves a command that has no log yet.

    Args:
        command: Command of the run.
        where: Name in messages in place of the log.
        settings: Settings of the run.
        cell_file: Poses of cameras and robot; may be None.

    Raises:
        SettingsError: The cell, the task or a limit set cannot be used.
    """
    return RunConfig(
        command=command,
        log=where,
        log_sha256="",
        settings=settings,
        cell=load_cell(cell_file) if cell_file is not None else None,
        task=_task(settings, None),
        start_s=None,
        end_s=None,
        tracking_limits=load_limits(settings.limits.tracking),
        prediction_limits=load_limits(settings.limits.prediction),
        earlier=None,
    )


def _digest(log: Path, earlier: dict[str, Any] | None) -> str:
    if log.exists():
        return run_folder.sha256(log)
    if earlier is None:
        raise LogError(f"{log}: nothing is there; give a log or a run folder")
    return str(earlier["inputs"][0]["sha256"])


def _task(settings: Settings, earlier: dict[str, Any] | None) -> dict[str, Any] | None:
    """Returns the task of the task file, else of the earlier run; the log's own task is read with the log."""
    path = settings.plan.task
    if path is None:
        return earlier["task"] if earlier is not None else None
    return read_toml(path, "plan.task names a TOML file")


def urdf_digest(settings: Settings) -> str | None:
    """Computes the digest of the robot's URDF and of the meshes of its link capsules; None for the IRB 140."""
    digests = [file["sha256"] for file in _urdf_inputs(settings)]
    return hashlib.sha256("".join(digests).encode()).hexdigest() if digests else None


def _urdf_inputs(settings: Settings) -> list[dict[str, str]]:
    files = read_urdf(settings.robot)
    return [] if files is None else [{"path": path, "sha256": digest} for path, digest in files.inputs]


@lru_cache(maxsize=4)  # a run makes its robot several times; a file that changes has another digest
def _derived_capsules(files: UrdfFiles, tcp_frame: str | None, base_frame: str | None) -> tuple[Segment, ...]:
    """Derives the link capsules from a URDF's collision shapes."""
    meshes = dict(files.meshes)
    model = from_urdf(files.text, np.eye(4), stop_s=1.0, tcp_frame=tcp_frame, base_frame=base_frame, meshes=meshes)
    return model.segments


def link_capsules(robot: Robot, files: UrdfFiles) -> tuple[Segment, ...]:
    """Returns the links' capsules: from the settings, else as a run recorded them, else derived from the shapes."""
    given = tuple(Segment(**dict(link)) for link in robot.links or files.capsules)
    return given or _derived_capsules(files, robot.tcp_frame, robot.base_frame)


def _urdf_record(run_config: RunConfig) -> dict[str, Any] | None:
    """Returns a record from which the robot can be made again without its files."""
    files = run_config.urdf
    if files is None:
        return None
    links, names = link_capsules(run_config.settings.robot, files), tuple(LinkSettings.model_fields)
    return {"text": files.text, "links": [{name: getattr(link, name) for name in names} for link in links]}


def _recorded_urdf(meta: dict[str, Any]) -> UrdfFiles | None:
    record = meta.get("urdf")
    if record is None:
        return None
    inputs = tuple((str(file["path"]), str(file["sha256"])) for file in meta["inputs"][1:])
    return UrdfFiles(record["text"], (), inputs, tuple(LinkSettings(**link) for link in record["links"]))
