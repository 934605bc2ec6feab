"""The files behind ``robot.urdf``: the URDF itself and the meshes of its links, wherever its packages are."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from hrcreplay import runs
from hrcreplay.errors import SettingsError
from hrcreplay.robot.urdf import describe
from hrcreplay.sections import Robot


@dataclass(frozen=True)
class UrdfFiles:
    """A URDF's text, and where its meshes are."""

    text: str
    meshes: tuple[tuple[str, str], ...]  #: file that a collision mesh names, and its path
    inputs: tuple[tuple[str, str], ...]  #: path and SHA-256 of each file that was read, the URDF first


def read_urdf(robot: Robot) -> UrdfFiles | None:
    """The files of the robot that the settings name; none for the IRB 140.

    Meshes are looked for only where link capsules are derived from them.

    Raises:
        SettingsError: The URDF or one of its meshes is not there or cannot be read.
    """
    path = robot.urdf
    if path is None:
        return None
    if not path.is_file():
        raise SettingsError(f"robot.urdf: {path} is not a file; name a URDF, or leave it out for the IRB 140")
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
    return UrdfFiles(text, tuple(meshes.items()), tuple((str(file), runs.sha256(file)) for file in files))


def _find(name: str, link: str, urdf: Path, packages: tuple[Path, ...]) -> Path:
    """The file that a URDF calls ``package://PACKAGE/...``, or by its path."""
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
    """Where ROS looks for packages."""
    ros1 = os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)
    ros2 = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return [Path(root) for root in ros1 if root] + [Path(root) / "share" for root in ros2 if root]


def _listed(roots: tuple[Path, ...] | list[Path]) -> str:
    return ", ".join(str(root) for root in roots) or "nothing"
