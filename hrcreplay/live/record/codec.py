"""Messages of a session's record, which control sends to the recorder, and their topics in the log.

The first byte is the kind, the next eight bytes are the session's clock [ns]; numbers are little-endian. Everything
that decides a tick is recorded, so the log is sufficient to compute the session again (see ``live.verify``).

======  ==========================================================================================================
``R``   a datagram of the robot, unchanged
``C``   the reply to the robot, unchanged (in shadow mode nothing is sent, and ``sent`` is 0)
``F``   a skeleton that a perception update used: the serialised Skeleton message, with the clock of the update
``L``   a perception update: state of each person, digests of the swept volumes
``V``   the swept volumes of some perception updates, complete
``A``   a decision: the loop's signals and the command to the robot
``S``   a time-out: no packet came from the robot
``E``   JSON: the settings at the start, notes, the end
======  ==========================================================================================================

The log has hrcreplay's own format, so every reader of logs reads it: skeletons, cameras, task and base are on their
usual topics. All other messages are on separate topics, with the session's clock as log_time.
"""

from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import dataclass
from enum import IntFlag
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hrcreplay.logs import messages
from hrcreplay.records import STATUSES, Bools, Floats, HumanStates, Ints, MotionRow, SweptVolumes, number_names

if TYPE_CHECKING:  # recorder and screen do not need the robot's imports, which take 3/4 of their start-up time
    from hrcreplay.robot.control.separation import Obstacles
    from hrcreplay.robot.control.stops import Stop

#: Phases of a session: the robot must not move yet, the first answers, the approach to the programme, the programme,
#: braking for a stop reason, standing still for a stop reason.
PHASES = ("waiting", "echo", "approach", "following", "stopping", "holding")
WAITING, ECHO, APPROACH, FOLLOWING, STOPPING, HOLDING = range(len(PHASES))


class Signal(IntFlag):
    """Conditions that the loop finds outside the stages and passes to the controller with an event. Recorded."""

    NONE = 0
    INTERRUPT = 1  #: Ctrl-C
    TERMINATE = 2  #: SIGTERM
    DURATION = 4  #: the session's time is over
    PERSON_DEAD = 8  #: the human side's process has ended
    PERSON_LATE = 16  #: the last heartbeat of the human side is too old
    PERSON_ENDED = 32  #: the recording of the person is over
    RECORDER_DEAD = 64  #: the recorder's process has ended
    OVERRUN = 128  #: the previous answer was too late
    SCREEN_DEAD = 256  #: the screen's process has crashed
    HANGUP = 512  #: SIGHUP: the terminal was closed, or its connection was lost
    QUIT = 1024  #: SIGQUIT
    SUSPEND = 2048  #: SIGTSTP: a suspended process cannot answer the robot
    OTHER = 4096  #: another signal that would end the process
    DISK = 8192  #: the disk has too little space for the record


@dataclass(frozen=True, slots=True)
class TickEvent:
    """One wake-up of the control loop by the robot."""

    t_ns: int  #: session clock when the first datagram was received
    datagrams: tuple[bytes, ...]  #: all datagrams in the queue, in order of arrival
    signals: Signal


@dataclass(frozen=True, slots=True)
class Decision:
    """Decision of the controller on an event."""

    t_ns: int  #: of the event
    look_ns: int  #: of the perception update with the volumes used
    datagram: bytes | None  #: reply to the robot; None without a reply
    phase: int  #: index into PHASES
    measured: Floats  #: (nv,) joints measured by the robot [rad]; empty without a reply
    row: MotionRow | None  #: the commanded motion; None without a reply
    refusal: str  #: reason why there is no reply
    stop: Stop | None  #: the stop that continues after the reply without further decisions; not recorded

    @property
    def status(self) -> int:
        """Index into records.STATUSES."""
        return STATUSES.index("braking") if self.row is None else self.row.status

    @property
    def reason(self) -> str:
        """Reason of the controller or the watchdog for braking; empty if the robot did not brake."""
        return self.refusal if self.row is None else self.row.reason

    @property
    def limb(self) -> int:
        """Index of the nearest pair's limb among the volumes; -1 without one."""
        return -1 if self.row is None else self.row.limb

    @property
    def link(self) -> int:
        """Index of the nearest pair's link; -1 without one."""
        return -1 if self.row is None else self.row.link


@dataclass(frozen=True, slots=True)
class Perception:
    """Knowledge of the people after a perception update."""

    t_ns: int
    states: HumanStates  #: one row per person
    volumes: SweptVolumes  #: one row per person
    people: tuple[Obstacles, ...]  #: the same volumes
    horizon_s: float  #: time after ``t_ns`` for which they are valid, without the latency [s]


#: Version of the messages, kept in the start event; records of another one cannot be decoded.
FORMAT = 5

ROBOT, REPLY, SKELETON, PERCEPTION, VOLUMES, DECISION, TIMEOUT, EVENT = (b"R", b"C", b"F", b"L", b"V", b"A", b"S", b"E")

_HEAD = struct.Struct("<cq")
_REPLY = struct.Struct("<cqB")
_LOOK = struct.Struct("<cqHHHHH")
_VOLUMES = struct.Struct("<cqHHId")
_ANSWER = struct.Struct("<cqqIIBBhhHB")
_SILENCE = struct.Struct("<cqI")
_DIGEST, _NUMBER = 8, 8  # bytes
_DIGESTS = 3  #: per limb: one of its bits, and one of its numbers on each of the two grids
#: Cell width of both grids [m]. The second grid is shifted by half a cell, so a number near the border of a cell in one
#: grid is near the middle of a cell in the other.
GRID_M = 1e-7


def kind(message: bytes) -> bytes:
    """Kind of a message: its first byte."""
    return message[:1]


def clock_ns(message: bytes) -> int:
    """Instant of a message by the session's clock [ns]."""
    return int(_HEAD.unpack_from(message)[1])


def body(message: bytes) -> bytes:
    """Content of a message after kind and clock: the datagram, the skeleton."""
    return message[_HEAD.size :]


def encode_robot_packet(t_ns: int, datagram: bytes) -> bytes:
    """Encodes a datagram of the robot."""
    return _HEAD.pack(ROBOT, t_ns) + datagram


def encode_skeleton(t_ns: int, skeleton: bytes) -> bytes:
    """Encodes a skeleton with the clock of the perception update that used it."""
    return _HEAD.pack(SKELETON, t_ns) + skeleton


def encode_reply(t_ns: int, datagram: bytes, *, sent: bool) -> bytes:
    """Encodes a reply; ``sent`` is False in shadow mode."""
    return _REPLY.pack(REPLY, t_ns, sent) + datagram


def decode_reply(message: bytes) -> tuple[bool, bytes]:
    """Decode a recorded reply: whether it was sent, and its datagram."""
    return bool(_REPLY.unpack_from(message)[2]), message[_REPLY.size :]


def encode_event(t_ns: int, what: dict[str, Any]) -> bytes:
    """Encodes an event as JSON."""
    return _HEAD.pack(EVENT, t_ns) + json.dumps(what, sort_keys=True, allow_nan=False).encode()


def decode_event(message: bytes) -> dict[str, Any]:
    """Content of a recorded event."""
    found: dict[str, Any] = json.loads(body(message))
    return found


def encode_timeout(t_ns: int, signals: Signal) -> bytes:
    """Encodes a time-out: no packet came from the robot."""
    return _SILENCE.pack(TIMEOUT, t_ns, signals)


def decode_timeout(message: bytes) -> Signal:
    """Signals of a recorded time-out."""
    return Signal(_SILENCE.unpack_from(message)[2])


@dataclass(frozen=True, slots=True)
class RecordedPerception:
    """A perception update as it is recorded."""

    t_ns: int
    skeletons: int  #: number of skeletons used, which are the SKELETON messages right before it
    people: Ints  #: (k,) number of each person
    state: Floats  #: (k, n) all numbers of each person's row, in the order of the record's fields
    valid: Bools  #: (k, c) for each camera
    digests: tuple[bytes, ...]  #: one per person and limb, of vertices and radius, from ``volume_digests``


def encode_perception(look: Perception, skeletons: int) -> bytes:
    """Encodes a perception update; ``skeletons`` is the number of skeletons that it used."""
    states, state, digests = look.states, state_numbers(look.states), volume_digests(look.volumes)
    sizes = len(states), state.shape[1], states.valid.shape[1], len(look.volumes.limbs)
    head = _LOOK.pack(PERCEPTION, look.t_ns, skeletons, *sizes)
    return b"".join([head, states.numbers.tobytes(), state.tobytes(), states.valid.tobytes(), *digests])


def decode_perception(message: bytes) -> RecordedPerception:
    """Decodes a perception update."""
    _, t_ns, skeletons, count, numbers, cameras, limbs = _LOOK.unpack_from(message)
    at = _LOOK.size
    people = np.frombuffer(message, "<i8", count, at)
    at += people.nbytes
    state = np.frombuffer(message, "<f8", count * numbers, at).reshape(count, numbers)
    at += state.nbytes
    valid = np.frombuffer(message, np.bool_, count * cameras, at).reshape(count, cameras)
    at += valid.nbytes
    width = _DIGEST * _DIGESTS
    digests = tuple(message[at + width * i : at + width * (i + 1)] for i in range(count * limbs))
    return RecordedPerception(t_ns, skeletons, people, state, valid, digests)


def state_numbers(states: HumanStates) -> Floats:
    """(k, n) all numbers of each row of states, field after field."""
    rows = len(states)
    found = [value for value in vars(states).values() if isinstance(value, np.ndarray)]
    return np.concatenate([value.reshape(rows, -1) for value in found if value.dtype == np.float64], axis=1)


def volume_digests(volumes: SweptVolumes) -> tuple[bytes, ...]:
    """Hashes of each row's and limb's volume: of its bits, and of its numbers on two grids.

    If two volumes have the same hash on a grid, their coordinates differ by no more than the cell width of the grid.
    """
    points, radius = _hashed(volumes.vertices_m), _hashed(volumes.radius_m.ravel())
    ends = [3 * _NUMBER * end for end in volumes.offsets.tolist()]
    return tuple(
        b"".join(
            hashlib.blake2b(numbers[first:last] + radii[at : at + _NUMBER], digest_size=_DIGEST).digest()
            for numbers, radii in zip(points, radius, strict=True)
        )
        for at, (first, last) in zip(range(0, len(radius[0]), _NUMBER), pairwise(ends), strict=True)
    )


def _hashed(numbers: Floats) -> list[bytes]:
    """What is hashed of numbers: they themselves, and their cells on the two grids."""
    cells = numbers / GRID_M
    on_grids = np.floor([cells, cells + 0.5]) + 0.0  # + 0.0 removes -0.0
    return [numbers.tobytes(), *(one.tobytes() for one in on_grids)]


def same_on_a_grid(recorded: bytes, again: bytes) -> bool:
    """Return whether two results of ``volume_digests`` describe the same volume, up to GRID_M."""
    grids = [slice(_DIGEST * i, _DIGEST * (i + 1)) for i in range(1, _DIGESTS)]
    return len(recorded) == len(again) and any(recorded[grid] == again[grid] for grid in grids)


class RecordedVolumes(NamedTuple):
    """The swept volumes of a perception update as they are recorded."""

    volumes: SweptVolumes  #: one row per person
    people: Ints  #: (k,) number of each person
    horizon_s: float  #: time for which they are valid [s]


def encode_volumes(look: Perception) -> bytes:
    """Encodes the swept volumes of a perception update."""
    volumes, people = look.volumes, look.states.numbers
    sizes = len(people), len(volumes.limbs), len(volumes.vertices_m)
    head = _VOLUMES.pack(VOLUMES, look.t_ns, *sizes, look.horizon_s)
    arrays = people, volumes.offsets, volumes.radius_m, volumes.vertices_m
    return b"".join([head, *(array.tobytes() for array in arrays)])


def decode_volumes(message: bytes, limbs: tuple[str, ...], method: str) -> RecordedVolumes:
    """Decodes swept volumes; the names of limbs and method are in the session's start event."""
    _, t_ns, count, width, vertices, horizon_s = _VOLUMES.unpack_from(message)
    at = _VOLUMES.size
    people = np.frombuffer(message, "<i8", count, at)
    at += people.nbytes
    offsets = np.frombuffer(message, "<i8", count * width + 1, at)
    at += offsets.nbytes
    radius = np.frombuffer(message, "<f8", count * width, at).reshape(count, width)
    at += radius.nbytes
    points = np.frombuffer(message, "<f8", 3 * vertices, at).reshape(-1, 3)
    volumes = SweptVolumes(np.full(count, t_ns), offsets, points, radius, limbs, method)
    return RecordedVolumes(volumes, people, horizon_s)


@dataclass(frozen=True, slots=True)
class RecordedDecision(Decision):
    """A decision as it is recorded; its reply, if there is one, is the REPLY message right after it."""

    took_us: int  #: from the datagram's arrival to the reply's departure; ``verify`` does not compare it
    signals: Signal
    datagrams: int  #: number of datagrams, which are the ROBOT messages right before it
    numbers: Floats  #: as recorded: ``number_names_of`` says which


#: Fields of a MotionRow that the head of a message holds, and those recorded as numbers; the reason is its text.
_IN_HEAD = ("status", "limb", "link")
_NUMBERS = tuple(name for name in MotionRow._fields if name not in (*_IN_HEAD, "reason"))


def number_names_of(numbers: int) -> tuple[str, ...]:
    """Names of so many numbers of a recorded decision, as in motion.parquet: measured joints first."""
    axes = (numbers - sum(len(number_names(name, 0)) for name in _NUMBERS)) // 4  # measured, q, dq, u
    measured = (f"q_measured{axis}" for axis in range(1, axes + 1))
    return (*measured, *(one for name in _NUMBERS for one in number_names(name, axes))) if numbers else ()


def encode_decision(found: Decision, signals: Signal, datagrams: int, took_us: int) -> bytes:
    """Encodes a decision.

    Args:
        found: Decision of the controller.
        signals: Conditions that the loop found outside the stages.
        datagrams: Number of the robot's datagrams that the decision answers.
        took_us: From the first datagram's arrival to the reply's departure [us].
    """
    instants, decided = (found.t_ns, found.look_ns, took_us), (found.status, found.limb, found.link)
    head = _ANSWER.pack(DECISION, *instants, signals, found.phase, *decided, datagrams, len(found.measured))
    if found.row is None:
        return head + found.reason.encode()
    numbers = found.measured.tolist()
    for name in _NUMBERS:
        value = getattr(found.row, name)
        numbers += value.tolist() if isinstance(value, np.ndarray) else [value]
    return b"".join([head, np.array(numbers, np.float64).tobytes(), found.reason.encode()])


def decode_decision(message: bytes) -> RecordedDecision:
    """Decodes a decision."""
    _, t_ns, look_ns, took_us, signals, phase, *decided, datagrams, axes = _ANSWER.unpack_from(message)
    widths = [len(number_names(name, axes)) for name in _NUMBERS] if axes else []
    count = axes + sum(widths)
    numbers, text = np.frombuffer(message, "<f8", count, _ANSWER.size), message[_ANSWER.size + 8 * count :].decode()
    row = None
    if axes:
        values: dict[str, Any] = dict(zip(_IN_HEAD, decided, strict=True)) | {"reason": text}
        for name, width, part in zip(_NUMBERS, widths, np.split(numbers[axes:], np.cumsum(widths)[:-1]), strict=True):
            values[name] = part if name in ("q", "dq", "u") or width > 1 else float(part[0])
        row = MotionRow(**values | {"certified": values["certified"] != 0.0})
    recorded = (took_us, Signal(signals), datagrams, numbers)
    return RecordedDecision(t_ns, look_ns, None, phase, numbers[:axes], row, "" if axes else text, None, *recorded)


ROBOT_TOPIC = "/egm/robot"  #: datagrams of the robot, readable or not
SENT_TOPIC = "/egm/correction"  #: datagrams that were sent to the robot
UNSENT_TOPIC = "/egm/correction/unsent"  #: replies in shadow mode, which are not sent
STRAY_TOPIC = "/live/frame"  #: skeletons of unknown cameras, and unreadable skeletons
EVENT_TOPIC = "/live/event"  #: JSON

ENCODING = "hrcreplay.live"  #: encoding of the messages that occur only in the record of a session

_BY_KIND = {
    ROBOT: ROBOT_TOPIC,
    PERCEPTION: "/live/look",
    VOLUMES: "/live/volumes",
    DECISION: "/live/answer",
    TIMEOUT: "/live/silence",
    EVENT: EVENT_TOPIC,
}
_KINDS = {topic: kind for kind, topic in _BY_KIND.items()} | {STRAY_TOPIC: SKELETON}


def topic_and_data(message: bytes) -> tuple[str, bytes]:
    """The topic of a message and its data; for every skeleton the topic is STRAY_TOPIC."""
    found = kind(message)
    if found == REPLY:
        sent, datagram = decode_reply(message)
        return SENT_TOPIC if sent else UNSENT_TOPIC, datagram
    return STRAY_TOPIC if found == SKELETON else _BY_KIND[found], body(message)


def message_on(topic: str, t_ns: int, data: bytes) -> bytes | None:
    """The message of the record from its topic and data; None for topics that are not part of the record."""
    if topic in (SENT_TOPIC, UNSENT_TOPIC):
        return encode_reply(t_ns, data, sent=topic == SENT_TOPIC)
    if topic in _KINDS:
        return _KINDS[topic] + encode_robot_packet(t_ns, data)[1:]
    parts = topic.split("/")
    if len(parts) == 4 and topic == messages.skeleton_topic(parts[2]):
        return encode_skeleton(t_ns, data)
    return None
