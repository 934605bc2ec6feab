"""Arms of others with a task in each one's own reach, from the wheel ``example-robot-data``."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import pytest

_HOME_UR = (0, -90, 90, -90, -90, 0)


@dataclass(frozen=True)
class Arm:
    """A URDF, and where its task goes."""

    urdf: str
    home_deg: tuple[float, ...]
    place_m: tuple[float, float, float]  #: one side; the other is its mirror image
    tool_m: float
    tcp: str

    @property
    def path(self) -> Path:
        """The URDF, or a skip."""
        try:
            found = metadata.distribution("example-robot-data")
        except metadata.PackageNotFoundError:
            pytest.skip("example-robot-data is not installed; it comes with the extra 'dev'")
        return Path(str(found.locate_file("cmeel.prefix/share/example-robot-data/robots"))) / self.urdf

    def task(self, folder: Path) -> Path:
        """A task file: from home to one side and, past the person, to the other."""
        x, y, z = self.place_m
        places = "".join(
            f"[[waypoints]]\nposition_m = [{x}, {side * y}, {z}]\nrpy_deg = [180, 0, 0]\n" for side in (1, -1)
        )
        file = folder / "task.toml"
        file.write_text(f"repeat = true\n[[waypoints]]\njoints_deg = {list(self.home_deg)}\n{places}")
        return file

    def overrides(self, folder: Path) -> tuple[str, ...]:
        """What a user sets for it."""
        return (f"robot.urdf={self.path}", f"robot.tool_m={self.tool_m}", f"plan.task={self.task(folder)}")


ARMS = {
    "ur3": Arm("ur_description/urdf/ur3_robot.urdf", _HOME_UR, (0.25, 0.15, 0.2), 0.1, "tool0"),
    "ur5": Arm("ur_description/urdf/ur5_robot.urdf", _HOME_UR, (0.45, 0.25, 0.3), 0.1, "tool0"),
    "ur10": Arm("ur_description/urdf/ur10_robot.urdf", _HOME_UR, (0.6, 0.35, 0.4), 0.1, "tool0"),
    "panda": Arm(
        "panda_description/urdf/panda.urdf", (0, -45, 0, -135, 0, 90, 45), (0.45, 0.25, 0.35), 0.0, "panda_hand_tcp"
    ),
    "kinova": Arm(
        "kinova_description/robots/kinova.urdf",
        (275, 167, 57, 241, 82, 75),
        (0.35, 0.2, 0.3),
        0.0,
        "j2s6s200_end_effector",
    ),
    "xarm7": Arm("xarm_description/urdf/xarm7.urdf", (0, -30, 0, 30, 0, 60, 0), (0.3, 0.2, 0.25), 0.0, "link_eef"),
}
