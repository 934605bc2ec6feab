"""The status and the 3-D scene of a session: messages from control to the screen process, and their publisher.

``S`` + a Status as JSON, ten times per second; unknown values are null, never NaN. For the scene ``J`` + its SceneNames
as JSON once, and ``P`` + a packed Scene.
"""

from __future__ import annotations

import json
import math
import struct
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from hrcreplay.live.record import codec
from hrcreplay.live.record.codec import PHASES, RecordedVolumes
from hrcreplay.records import POINTS, STATUSES, Floats, Ints, volume_name

if TYPE_CHECKING:  # the screen process does not need the loop's imports, which take most of its start-up time
    from hrcreplay.live.control.loop import Loop


class Latency(TypedDict):
    """Quantiles of the time from the robot's packet to the reply, over the session so far [us]."""

    p50: float
    p99: float
    p99_9: float


class CameraStatus(TypedDict):
    """A camera of the session."""

    name: str
    age_s: float | None  #: time since the capture of its newest frame
    rate_hz: float  #: frames in the last second


class RecorderStatus(TypedDict):
    """State of the recorder process."""

    alive: bool
    dropped: int  #: number of messages that were not delivered


class Status(TypedDict):
    """A session at one instant."""

    t_s: float  #: since the session's start
    phase: str  #: one of codec.PHASES
    sending: bool  #: False: shadow mode, nothing goes to the robot
    robot: str | None  #: address of the robot
    rate_hz: float  #: answers in the last second
    latency_us: Latency | None
    distance_m: float | None  #: smallest separation, surface to surface
    limb: str | None  #: of the nearest pair
    link: str | None
    tcp_speed: float | None  #: commanded [m/s]
    status: str | None  #: one of hrcreplay.records.STATUSES
    reason: str  #: why the robot brakes; empty if it does not
    cameras: list[CameraStatus]
    stops: dict[str, int]  #: reason -> number of stops in the session so far, in order of first occurrence
    recorder: RecorderStatus
    outlook: str  #: condition on which a robot at rest moves again; empty if it moves or the session ends
    note: str  #: the latest remark


_HEAD = struct.Struct("<qHH")


class SceneNames(TypedDict):
    """Names and radii that are constant in a session."""

    limbs: list[str]  #: of the swept volumes
    links: list[str]  #: of the robot's segments
    radii_m: list[float]  #: of the robot's segments


@dataclass(frozen=True, slots=True)
class Scene:
    """An instant of a session, in the world."""

    t_ns: int
    people: Ints  #: (k,) number of each person
    points_m: Floats  #: (k, 20, 3) the fused people; NaN for points that the model does not have
    ends_m: Floats  #: (s, 2, 3) both ends of the robot's segments, as in RobotPose
    occupied: RecordedVolumes  #: of a single tick, perhaps one with other people


def pack(t_ns: int, people: Ints, points_m: Floats, ends_m: Floats, volumes: bytes) -> bytes:
    """The payload of ``P`` from the fields of a Scene.

    Args:
        t_ns: Instant of the perception [ns].
        people: (k,) number of each person.
        points_m: (k, 20, 3) fused people, world [m]; NaN for points that the model does not have.
        ends_m: (s, 2, 3) both ends of the robot's s segments, world [m].
        volumes: Swept volumes of one tick, as ``codec.encode_volumes`` packs them for the record.
    """
    head = _HEAD.pack(t_ns, len(people), len(ends_m))
    return b"".join([head, people.tobytes(), points_m.tobytes(), ends_m.tobytes(), volumes])


def unpack(data: bytes, limbs: tuple[str, ...]) -> Scene:
    """The inverse of ``pack``; the method of the volumes is not transmitted."""
    t_ns, count, segments = _HEAD.unpack_from(data)
    at = _HEAD.size
    people = np.frombuffer(data, "<i8", count, at)
    at += people.nbytes
    points = np.frombuffer(data, "<f8", 3 * count * len(POINTS), at).reshape(count, -1, 3)
    at += points.nbytes
    ends = np.frombuffer(data, "<f8", 6 * segments, at).reshape(-1, 2, 3)
    at += ends.nbytes
    return Scene(t_ns, people, points, ends, codec.decode_volumes(data[at:], limbs, ""))


_EVERY_NS = 100_000_000
_SECOND_NS = 1_000_000_000


class StatusPublisher:
    """Sends status and scene to the screen process at fixed intervals."""

    def __init__(self, loop: Loop, names: dict[str, Any], *, in_3d: bool) -> None:
        self._loop = loop
        self._names = names
        self._scene = in_3d
        self._told_ns = 0
        self._counted_ns = 0
        self._counted: Counter[str] = Counter()
        self._rates: dict[str, float] = {}
        if in_3d:
            radii = [segment.radius_m for segment in loop.controller.setup.robot.segments]
            cast = SceneNames(limbs=names["limbs"], links=names["links"], radii_m=radii)
            self._send(b"J" + json.dumps(cast).encode())

    def publish(self, *, last: bool = False) -> None:
        """Sends status and scene if they are due, or if ``last`` is set."""
        now_ns = self._loop.now_ns()
        if now_ns - self._told_ns < _EVERY_NS and not last:
            return
        self._told_ns = now_ns
        self._count(now_ns)
        self._send(b"S" + json.dumps(self._status(now_ns)).encode())
        if self._scene:
            self._show()

    def _send(self, message: bytes) -> None:
        if self._loop.screen is not None:
            self._loop.screen.send(message)

    def _show(self) -> None:
        """Sends the people, the volumes and the robot for the 3-D view."""
        perception, answer, volumes = self._loop.controller.perception, self._loop.last, self._loop.stored
        if perception is None or answer is None or answer.row is None or volumes is None:
            return
        from hrcreplay.human.model import skeleton  # only needed here; control has it loaded

        states = perception.states
        points = np.where(states.by_points[:, None, None], states.points_m, skeleton(states.p, states.lengths_m))
        pose = self._loop.controller.setup.robot.pose(answer.row.q, answer.row.dq)
        self._send(b"P" + pack(perception.t_ns, states.numbers, points, pose.ends_m, volumes))

    def _count(self, now_ns: int) -> None:
        """Updates the rates once per second."""
        passed_ns = now_ns - self._counted_ns
        if passed_ns < _SECOND_NS:
            return
        counts = self._loop.controller.observer.counts
        now = Counter({name: counts[f"frames_{name}"] for name in self._names["cameras"]})
        now[""] = self._loop.answers
        if self._counted_ns:
            self._rates = {name: (now[name] - self._counted[name]) * _SECOND_NS / passed_ns for name in now}
        self._counted_ns, self._counted = now_ns, now

    def _status(self, now_ns: int) -> Status:
        loop, controller = self._loop, self._loop.controller
        found = loop.reply_times.quantiles_us(0.5, 0.99, 0.999)
        answer = loop.last
        row = None if answer is None else answer.row
        return Status(
            t_s=(now_ns - loop.start_ns) / 1e9,
            phase=PHASES[controller.phase],
            sending=loop.settings.sending,
            robot=loop.robot,
            rate_hz=self._rates.get("", 0.0),
            latency_us=None if found is None else Latency(p50=found[0], p99=found[1], p99_9=found[2]),
            distance_m=None if row is None else _known(row.distance_m),
            limb=None if answer is None or answer.limb < 0 else self._volume_name(answer.limb),
            link=None if answer is None or answer.link < 0 else self._names["links"][answer.link],
            tcp_speed=None if row is None else _known(row.tcp_speed),
            status=None if row is None or answer is None or not controller.connected else STATUSES[answer.status],
            reason=controller.stop or controller.waiting or ("" if answer is None else answer.reason),
            cameras=[self._camera(name, now_ns) for name in self._names["cameras"]],
            stops=dict(Counter(reason for _, reason in controller.stops)),
            recorder={"alive": loop.recorder.alive, "dropped": loop.recorder.dropped},
            outlook=controller.outlook,
            note=loop.notes[-1] if loop.notes else "",
        )

    def _volume_name(self, index: int) -> str:
        return volume_name(index, self._names["neighbours"], self._names["limbs"])

    def _camera(self, name: str, now_ns: int) -> CameraStatus:
        newest_ns = self._loop.controller.observer.newest_ns.get(name)
        age_s = None if newest_ns is None else (now_ns - newest_ns) / 1e9
        return CameraStatus(name=name, age_s=age_s, rate_hz=self._rates.get(name, 0.0))


def _known(number: float) -> float | None:
    return number if math.isfinite(number) else None
