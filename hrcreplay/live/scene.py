"""What the screen needs to draw a live session in 3-D: the message ``P``, and ``J`` with the names in it, once."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from hrcreplay.live import wire
from hrcreplay.records import POINTS, Floats, SweptVolumes

_HEAD = struct.Struct("<qH")


class Cast(TypedDict):
    """What stays the same for a session."""

    limbs: list[str]  #: of the swept volumes
    links: list[str]  #: of the robot's segments
    radii_m: list[float]  #: of the robot's segments


@dataclass(frozen=True, slots=True)
class Scene:
    """An instant of a session, in the world."""

    t_ns: int
    points_m: Floats  #: (20, 3) the fused person; NaN where the model has no say
    ends_m: Floats  #: (s, 2, 3) both ends of the robot's segments, as RobotPose has them
    volumes: SweptVolumes  #: of a single tick


def pack(t_ns: int, points_m: Floats, ends_m: Floats, volumes: bytes) -> bytes:
    """The payload of ``P``, of the fields of a Scene; ``volumes`` as ``wire.whole`` packs them for the record."""
    return b"".join([_HEAD.pack(t_ns, len(ends_m)), points_m.tobytes(), ends_m.tobytes(), volumes])


def unpack(data: bytes, limbs: tuple[str, ...]) -> Scene:
    """The inverse of ``pack``; the volumes' method does not travel."""
    t_ns, segments = _HEAD.unpack_from(data)
    at = _HEAD.size
    points = np.frombuffer(data, "<f8", 3 * len(POINTS), at).reshape(-1, 3)
    at += points.nbytes
    ends = np.frombuffer(data, "<f8", 6 * segments, at).reshape(-1, 2, 3)
    at += ends.nbytes
    return Scene(t_ns, points, ends, wire.read_whole(data[at:], limbs, ""))
