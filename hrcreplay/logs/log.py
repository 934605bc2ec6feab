"""What a log says of itself and the tracks that travel in it beside the camera frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hrcreplay.records import Floats, Ints, Table


@dataclass(frozen=True)
class Header:
    """All that is known of a log before its first frame."""

    path: Path
    kind: str  #: "hrcreplay", "mcap", "ros1" or "ros2"
    cameras: tuple[str, ...]
    T_world_camera: dict[str, Floats]  #: (4, 4); only of the cameras whose extrinsics are in the log
    task: dict[str, Any] | None  #: programmed task in the log, of the same structure as a task file
    start_ns: int  #: first arrival of a skeleton, joint state or truth; of anything where there are none
    end_ns: int  #: last arrival of anything
    T_world_base: Floats | None  #: (4, 4) robot base, where the log knows it
    has_truth: bool
    joint_names: tuple[str, ...]  #: of the joint track; () where there is none


@dataclass(frozen=True)
class JointTrack(Table):
    """Robot joints as the log has them, a row a message."""

    t_ns: Ints  #: (n,)
    q: Floats  #: (n, nv) [rad]
    names: tuple[str, ...]


@dataclass(frozen=True)
class Truth(Table):
    """The person by a reference better than the cameras, a row an instant."""

    t_ns: Ints  #: (n,)
    points_m: Floats  #: (n, 20, 3) POINTS in the world [m]
