"""Messages from control to the screen process: the status, and the 3-D scene.

``S`` + a Status as JSON, ten times a second; what is not known is null, never NaN. For the scene ``J`` + its
SceneNames as JSON once, and ``P`` + a packed Scene.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from hrcreplay.live.record import codec
from hrcreplay.records import POINTS, Floats, SweptVolumes


class Latency(TypedDict):
    """From the robot's packet in to our reply out, over the whole session so far [us]."""

    p50: float
    p99: float
    p99_9: float


class CameraStatus(TypedDict):
    """A camera of the session."""

    name: str
    age_s: float | None  #: from the capture of its newest frame until now
    rate_hz: float  #: frames in the last second


class RecorderStatus(TypedDict):
    """State of the recorder process."""

    alive: bool
    dropped: int  #: messages that it could not take


class Status(TypedDict):
    """A session at one instant."""

    t_s: float  #: since the session's start
    phase: str  #: of records.PHASES
    sending: bool  #: False: shadow mode, nothing goes to the robot
    robot: str | None  #: address of the robot
    rate_hz: float  #: answers in the last second
    latency_us: Latency | None
    distance_m: float | None  #: smallest separation, surface to surface
    limb: str | None  #: of the nearest pair
    link: str | None
    tcp_speed: float | None  #: commanded [m/s]
    status: str | None  #: of hrcreplay.records.STATUSES
    reason: str  #: why it brakes; empty where it does not
    cameras: list[CameraStatus]
    stops: dict[str, int]  #: reasons of the session's stops so far, in order of their first time, with their number
    recorder: RecorderStatus
    note: str  #: the latest remark


_HEAD = struct.Struct("<qH")


class SceneNames(TypedDict):
    """Names and radii that stay the same for a session."""

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
    """The payload of ``P``, of the fields of a Scene.

    Args:
        t_ns: Instant of the perception [ns].
        points_m: (20, 3) fused person, world [m]; NaN where the model has no such point.
        ends_m: (s, 2, 3) both ends of the robot's s segments, world [m].
        volumes: Swept volumes of one tick, as ``codec.encode_volumes`` packs them for the record.
    """
    return b"".join([_HEAD.pack(t_ns, len(ends_m)), points_m.tobytes(), ends_m.tobytes(), volumes])


def unpack(data: bytes, limbs: tuple[str, ...]) -> Scene:
    """The inverse of ``pack``; the volumes' method does not travel."""
    t_ns, segments = _HEAD.unpack_from(data)
    at = _HEAD.size
    points = np.frombuffer(data, "<f8", 3 * len(POINTS), at).reshape(-1, 3)
    at += points.nbytes
    ends = np.frombuffer(data, "<f8", 6 * segments, at).reshape(-1, 2, 3)
    at += ends.nbytes
    return Scene(t_ns, points, ends, codec.decode_volumes(data[at:], limbs, "")[0])
