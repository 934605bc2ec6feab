"""What control tells the screen ten times a second: ``S`` + this as JSON. Not known is null, never NaN."""

from __future__ import annotations

from typing import TypedDict


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
    """The flight recorder."""

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
