"""Sections of the settings that only a live session has."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from hrcreplay.sections import NotNegative, Positive, Section


class ZenohKey(Section):
    """The Zenoh keys of one camera."""

    key: str
    """Key expression: 0/kinect/skeleton/** of rmw_zenoh, kinect/skeleton of the DDS bridge."""
    payload: Literal["hrcreplay", "cdr"] = "hrcreplay"
    """Our own message, or the CDR of a ROS 2 system."""
    type: str | None = None
    """cdr: message type; none: as the keys of rmw_zenoh tell."""
    definition: str = ""
    """cdr: text of the type's .msg, where no release of ROS 2 has it."""
    points: str | None = None
    """cdr: path to the points in a type without a decoder of its own, as in logs.decoders."""
    index: dict[str, int] = Field(default_factory=dict)
    """cdr: which element is which body point."""
    unit: Literal["m", "mm"] = "m"
    """cdr: unit of the points."""
    stamp: str | None = "header.stamp"
    """cdr: path to the capture time."""
    confidence: str | None = None
    """cdr: path to an array of confidences."""


class Zenoh(Section):
    """Live skeletons over Zenoh."""

    mode: Literal["peer", "client"] = "peer"
    """How we take part."""
    connect: tuple[str, ...] = ()
    """Endpoints to connect to, as tcp/192.168.0.1:7447."""
    listen: tuple[str, ...] = ()
    """Endpoints to listen on."""
    scouting: bool = False
    """Whether to look for others by multicast."""
    keys: dict[str, ZenohKey] = Field(default_factory=dict)
    """Camera -> where its skeletons are."""


class Live(Section):
    """The live session: EGM link, watchdog, person."""

    port: Annotated[int, Field(ge=0, le=65535)] = 6510
    """UDP port at which the robot's packets arrive."""
    cycle_s: Positive = 0.004032
    """The robot's cycle: every answer moves the reference by this much time [s]."""
    reaction_s: NotNegative = 0.05
    """From a look at the person to the robot's obedience: up to two cycles until it is used, an answer's delay, a cycle
    and the robot's own lag. The swept volumes of method sound reach this much further than T_s [s]."""
    approach_speed: Annotated[float, Field(gt=0, le=1)] = 0.1
    """Share of the axes' top speeds on the way from where the robot stands to its programme."""
    resume: bool = False
    """Whether motion goes on by itself once the reason of a stop is gone."""
    resume_s: Positive = 1.0
    """How long it must be gone before that [s]."""
    fresh_s: Positive = 0.3
    """No frame of the person for longer stops the robot [s]."""
    uncertain_m: Positive = 0.2
    """A larger standard deviation of the person's position stops the robot [m]."""
    uncertain_rad: Positive = 0.8
    """The same for heading and bend of the trunk [rad]."""
    person_late_s: Positive = 0.2
    """The human side's process without a sign of life for longer stops the robot [s]."""
    overrun_s: Positive = 0.02
    """An answer later than this stops the robot [s]."""
    silent_s: Positive = 0.1
    """A robot that sends nothing for longer counts as gone [s]."""
    tracking_rad: Positive = 0.2
    """A robot further than this from its reference stops [rad]."""
    utilization_max: Positive = 100.0
    """A robot above this cannot follow, and stops [%]."""
    keep_recorder: bool = True
    """Whether the robot stops when nobody records any more."""
    real_time: bool = True
    """Whether to ask the system to run the control loop before all else and to keep it in memory."""
    zenoh: Zenoh = Zenoh()
    """Where live skeletons come from when no recording is played."""
