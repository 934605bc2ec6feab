"""The process that sends skeletons to the control process, from a recording or from Zenoh.

Messages to control: ``H`` heartbeat every 20 ms, whatever else happens; ``F`` + a serialized Skeleton, captured in
session time, ``f`` where another body of the same frame follows; ``N`` + a note in UTF-8; ``Z`` end of the recording.
The first note is ``ready {"cameras": [...]}``; a note that begins with ``failed`` is the reason why the process ends.
From control: ``G`` + the session's start as 8 bytes, little-endian [ns], before which no frame is sent. The process
ends when control does.

A Zenoh key carries messages of our own format, or the CDR messages of a ROS 2 system. Control stamps the arrival. A
capture time is used as it is, because it and the session's clock are both Unix time.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import Any, NoReturn, Protocol

from google.protobuf.message import DecodeError

from hrcreplay.errors import HrcReplayError, LogError, SettingsError
from hrcreplay.live.person.envelope import SHORTEST_SECRET, Opener, UnverifiedError
from hrcreplay.live.person.log_playback import Outgoing, frames_of, play, ready_note, same_frame
from hrcreplay.live.processes import ControlChannel, ControlGoneError
from hrcreplay.logs import presets, ros_bags
from hrcreplay.logs import skeleton_pb2 as pb
from hrcreplay.logs.cleaning import DEFECTS, Cleaner
from hrcreplay.logs.clocks import STAMP_FAR_S
from hrcreplay.logs.decoders import GenericDecoder, OwnDecoder
from hrcreplay.logs.markers import MARKER_TYPE, MarkerDecoder
from hrcreplay.logs.messages import Message, RawSkeleton, SkeletonDecoder, Topic, Undecodable
from hrcreplay.logs.transforms import TF_TYPES, TfDecoder
from hrcreplay.settings.sections import Decoder, Zenoh, ZenohKey
from hrcreplay.toml_file import validate

_OWN = "hrcreplay.Skeleton"
_SECTION = "live.zenoh"  # start of error messages about its settings
_RMW_TYPE = re.compile(r"(\w+)::msg::dds_::(\w+)_")  # in the keys of rmw_zenoh: <domain>/<topic>/<type>/<hash>
_KNOWN = (MARKER_TYPE, *TF_TYPES)
_AHEAD_NS = 10**9  # after a capture further in the future, all following captures would look late
_FAR_NS = round(STAMP_FAR_S * 1e9)
_OLD_NS = 10**9  # an older capture indicates clocks that are not synchronised
_GAP_S = 0.2


class CameraSubscription:
    """The keys of one camera: payloads in, cleaned skeletons out."""

    def __init__(self, camera: str, settings: ZenohKey, opener: Opener | None = None) -> None:
        """Creates the subscription; with an opener only sealed payloads are used."""
        self._camera = camera
        self._opener = opener
        self._settings = settings
        self._where = f"live.zenoh.keys.{camera}"
        self._readers: dict[str, tuple[Topic, SkeletonDecoder]] = {}  # of each type
        self._defects: Counter[str] = Counter()
        self._cleaner = Cleaner((camera,), _GAP_S, self._defects, nobody=True)
        self._told: set[str] = set()
        self._unusable: Counter[str] = Counter()

    def prepare(self) -> None:
        """Makes the readers of all possible types in advance, because this would delay the first message too long."""
        given = self._settings
        types = (_OWN,) if given.payload == "hrcreplay" else (given.type,) if given.type else _KNOWN
        for msgtype in types:
            with suppress(LogError):
                self._reader(given.key, ros_bags.plain(msgtype))[0].parse(b"")

    def take(self, key: str, data: bytes, now_ns: int) -> Iterator[Outgoing]:
        """Messages to control for one payload: its bodies, and notes; each note is sent only once."""
        try:
            rows = self._rows(key, data if self._opener is None else self._opener.open(data, now_ns), now_ns)
        except UnverifiedError as error:
            yield from self._refuse("not verified, not used", error)
            return
        except Exception as error:  # an invalid payload must not end the process
            yield from self._refuse("undecodable", error)
            return
        for row in rows:
            yield from self._clocks(row, now_ns)
            if row.capture_ns is None or row.capture_ns - now_ns < _AHEAD_NS:
                self._cleaner.add(row, now_ns)
        table = self._cleaner.flush()
        if table is not None:
            frames = list(frames_of(table))
            for frame, after in zip(frames, [*frames[1:], None], strict=True):
                kind = b"f" if after is not None and same_frame(frame, after) else b"F"
                yield kind, frame.skeleton.SerializeToString()
        for name, count in self._defects.items():
            if count and name in DEFECTS and name not in self._told:
                self._told.add(name)
                yield self._note(f"{name}: {DEFECTS[name]}")

    def _refuse(self, what: str, error: Exception) -> Iterator[Outgoing]:
        self._unusable[what] += 1
        if str(self._unusable[what]).rstrip("0") == "1":  # 1, 10, 100...
            yield self._note(f"{self._unusable[what]} {what}: {error or type(error).__name__}")

    def _clocks(self, row: RawSkeleton, now_ns: int) -> Iterator[Outgoing]:
        age_ns = 0 if row.capture_ns is None else now_ns - row.capture_ns
        if not -_AHEAD_NS < age_ns < _OLD_NS and "clocks" not in self._told:
            self._told.add("clocks")
            kept = "its arrival is used" if age_ns > _FAR_NS else "used as it is"
            what = f"before; {kept}" if age_ns > 0 else "after; left out"
            yield self._note(f"captured {abs(age_ns) / 1e9:.3f} s {what}. Set the clocks of both computers")

    def _rows(self, key: str, data: bytes, now_ns: int) -> list[RawSkeleton]:
        topic, decoder = self._reader(key, self._type(key))
        rows = decoder.rows(Message(now_ns, topic, data))
        return [row._replace(camera=self._camera) if row.capture_ns else _unstamped(row, self._camera) for row in rows]

    def _type(self, key: str) -> str:
        if self._settings.payload == "hrcreplay":
            return _OWN
        if self._settings.type:
            return ros_bags.plain(self._settings.type)
        named = _RMW_TYPE.search(key)
        if not named:
            raise LogError(f"key {key} does not tell its type; name it: type = 'package/msg/Name'")
        return f"{named[1]}/{named[2]}"

    def _reader(self, key: str, msgtype: str) -> tuple[Topic, SkeletonDecoder]:
        if msgtype not in self._readers:
            self._readers[msgtype] = self._new_reader(key, msgtype)
        return self._readers[msgtype]

    def _new_reader(self, key: str, msgtype: str) -> tuple[Topic, SkeletonDecoder]:
        given = self._settings
        if msgtype == _OWN:
            return Topic(key, msgtype, 1, _own), OwnDecoder(key, self._camera)
        topic = Topic(key, msgtype, 1, ros_bags.parser(self._where, msgtype, given.definition, "msg", cdr=True))
        if given.points is not None:
            how = {name: getattr(given, name) for name in ("points", "index", "unit", "stamp", "confidence")}
            return topic, GenericDecoder((Decoder(topic=key, camera=self._camera, **how),))
        if msgtype in TF_TYPES:
            return topic, TfDecoder(key, (self._camera,), given.unit)
        if msgtype == MARKER_TYPE:
            return topic, MarkerDecoder(key, unit=given.unit)
        described = presets.of_type(msgtype, key, given.unit)
        if described:
            return topic, GenericDecoder(described[0])
        raise LogError(f"no decoder for {msgtype}; describe it with points and index, as in [[logs.decoders]]")

    def _note(self, text: str) -> Outgoing:
        return b"N", f"{self._where}: {text}".encode()


def _unstamped(row: RawSkeleton, camera: str) -> RawSkeleton:
    return row._replace(camera=camera, capture_ns=None, stamp_zero=row.stamp_zero or row.capture_ns == 0)


def _own(data: bytes) -> Any:
    try:
        return pb.Skeleton.FromString(data)
    except DecodeError as error:
        raise Undecodable(f"no {_OWN}: {error}") from error


class ZenohSource:
    """Subscribes to the cameras' keys. Zenoh's threads decode and send at once; ``due`` only reports a failure."""

    def __init__(
        self, settings: Mapping[str, Any], send: Callable[[bytes, bytes], object], clock: Callable[[], int]
    ) -> None:
        self._settings = settings
        self._send = send
        self._clock = clock
        self._going = False
        self._failure: Exception | None = None
        self._open: list[Any] = []  # keeps session and subscribers alive
        Thread(target=self._begin, name="opening zenoh", daemon=True).start()

    def go(self, start_ns: int) -> None:  # noqa: ARG002 - live frames have no start of their own
        """Sends frames from now on."""
        self._going = True

    def due(self, now_ns: int) -> Iterator[Outgoing]:  # noqa: ARG002
        """Returns no messages, because Zenoh's threads send the frames.

        Raises:
            SettingsError: The session cannot be opened, or a key is no key expression.
        """
        if self._failure is not None:
            raise self._failure
        return iter(())

    def next_ns(self, now_ns: int) -> int | None:  # noqa: ARG002
        """None: the time is not known."""
        return None

    def _begin(self) -> None:
        try:
            wanted = validate(Zenoh, self._settings, _SECTION)
            secret = None if wanted.secret is None else _secret(wanted.secret)
            session = open_session(self._settings)
            self._open.append(session)
            for name, given in wanted.keys.items():
                opener = None if secret is None else Opener(secret, wanted.sources, wanted.late_s)
                stream = CameraSubscription(name, given, opener)
                stream.prepare()
                self._open.append(_subscribe(session, name, given, self._taker(stream)))
            self._send(*ready_note(tuple(wanted.keys)))
        except ControlGoneError:
            pass  # the main thread detects this, too
        except Exception as error:  # ``due`` raises it in the main thread
            self._failure = error

    def _taker(self, stream: CameraSubscription) -> Callable[[Any], None]:
        def take(sample: Any) -> None:
            data = sample.payload.to_bytes()
            if not self._going or not data:  # a deletion has no payload
                return
            try:
                for kind, payload in stream.take(str(sample.key_expr), data, self._clock()):
                    self._send(kind, payload)
            except ControlGoneError:
                pass

        return take


def open_session(settings: Mapping[str, Any]) -> Any:
    """Opens a Zenoh session with the endpoints in the settings only, unless ``scouting`` is on.

    Raises:
        SettingsError: Zenoh is not installed, or the session cannot be opened.
    """
    try:
        import zenoh
    except ModuleNotFoundError as error:
        raise SettingsError(
            "live.zenoh: eclipse-zenoh is not installed; would be right: pip install 'hrcreplay[zenoh]'"
        ) from error
    wanted = validate(Zenoh, settings, _SECTION)
    try:
        if wanted.config is not None:
            return zenoh.open(zenoh.Config.from_file(str(wanted.config)))
    except (zenoh.ZError, OSError) as error:
        raise SettingsError(f"live.zenoh.config: {wanted.config} cannot be used ({error})") from error
    config = zenoh.Config()
    given = {
        "mode": wanted.mode,
        "connect/endpoints": list(wanted.connect),
        "connect/retry": {"period_init_ms": 250, "period_max_ms": 1000},
        "listen/endpoints": list(wanted.listen),
        "scouting/multicast/enabled": wanted.scouting,
    }
    try:
        for key, value in given.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise SettingsError(f"live.zenoh: no session ({error}); check mode, connect and listen") from error


def _secret(path: Path) -> bytes:
    """The secret in a file, without the line break at its end.

    Raises:
        SettingsError: The file cannot be read, or the secret is too short.
    """
    try:
        secret = path.read_bytes().rstrip(b"\r\n")
    except OSError as error:
        raise SettingsError(f"live.zenoh.secret: {path} cannot be read ({error.strerror})") from error
    if len(secret) < SHORTEST_SECRET:
        raise SettingsError(
            f"live.zenoh.secret: {path} holds {len(secret)} bytes; would be right: {SHORTEST_SECRET} or more"
        )
    return secret


def _subscribe(session: Any, camera: str, given: ZenohKey, take: Callable[[Any], None]) -> Any:
    import zenoh

    try:
        return session.declare_subscriber(given.key, take)
    except zenoh.ZError as error:
        raise SettingsError(f"live.zenoh.keys.{camera}: {given.key!r} is no key expression ({error})") from error


BEAT_NS = 20_000_000
_NICE = -10  # if permitted: priority after control, before recorder and screen
_SWITCH_S = 0.0005  # longest time that a decoding thread delays another thread


class SkeletonSource(Protocol):
    """A source of skeletons: a recording or Zenoh."""

    def go(self, start_ns: int) -> None:
        """Starts the flow at ``start_ns`` of session time."""

    def due(self, now_ns: int) -> Iterator[Outgoing]:
        """The messages to send now. Raises LogError, SettingsError."""

    def next_ns(self, now_ns: int) -> int | None:
        """Time at which the next message is due; None: not known."""


class SendSchedule:
    """Schedule of the messages to control: heartbeats at fixed instants and due messages. Uses no clock, no socket."""

    def __init__(self, source: SkeletonSource, now_ns: int) -> None:
        self._source = source
        self._beat_ns = now_ns

    def receive(self, message: bytes) -> None:
        """Handles a message from control."""
        if message[:1] == b"G" and len(message) == 9:
            self._source.go(int.from_bytes(message[1:], "little"))

    def send(self, now_ns: int) -> Iterator[Outgoing]:
        """The messages that are due, with heartbeats. Raises LogError, SettingsError."""
        if now_ns >= self._beat_ns:
            self._beat_ns += BEAT_NS * ((now_ns - self._beat_ns) // BEAT_NS + 1)  # skip missed beats
            yield b"H", b""
        yield from self._source.due(now_ns)

    def next_ns(self, now_ns: int) -> int:
        """Time at which the next message is due."""
        due_ns = self._source.next_ns(now_ns)
        return self._beat_ns if due_ns is None else min(self._beat_ns, due_ns)


def run(channel: ControlChannel, source: SkeletonSource, anchor_ns: int) -> NoReturn:
    """Serves until control has ended.

    Raises:
        ControlGoneError: Control has ended.
        HrcReplayError: The source has failed.
    """
    pace = SendSchedule(source, time.monotonic_ns() + anchor_ns)
    told = 0
    while True:
        now_ns = time.monotonic_ns() + anchor_ns
        for kind, payload in pace.send(now_ns):
            channel.send(kind, payload)
        lost = channel.dropped
        if lost != told and channel.send(b"N", f"{lost} messages lost so far: control did not read them".encode()):
            told = lost
        now_ns = time.monotonic_ns() + anchor_ns
        message = channel.receive((pace.next_ns(now_ns) - now_ns) / 1e9)
        if message is not None:
            pace.receive(message)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the process and returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m hrcreplay.live.person.source", description=__doc__)
    parser.add_argument("--fd", type=int, required=True, help="socket to control")
    parser.add_argument("--anchor", type=int, required=True, help="session time minus monotonic time [ns]")
    parser.add_argument("--options", type=json.loads, default={}, help="JSON of the settings' section logs")
    parser.add_argument("--repeat", action="store_true", help="start the recording again at its end")
    kind = parser.add_mutually_exclusive_group(required=True)
    kind.add_argument("--log", type=Path, help="recording to play")
    kind.add_argument("--zenoh", type=json.loads, help="JSON of the settings' section live.zenoh")
    given = parser.parse_args(arguments)
    sys.setswitchinterval(_SWITCH_S)
    with suppress(PermissionError):
        os.nice(_NICE)
    channel = ControlChannel(given.fd)
    try:
        source = _source(given, channel)
        gc.freeze()
        run(channel, source, given.anchor)
    except ControlGoneError:
        return 0
    except HrcReplayError as error:
        channel.send(b"N", f"failed {error}".encode())
        return error.exit_code


def _source(given: argparse.Namespace, channel: ControlChannel) -> SkeletonSource:
    if given.log is not None:
        return play(given.log, given.options, repeat=given.repeat)
    return ZenohSource(given.zenoh, channel.send, lambda: time.monotonic_ns() + int(given.anchor))


if __name__ == "__main__":
    code = main()
    sys.stderr.flush()
    os._exit(code)  # a callback of Zenoh's threads during the interpreter's shutdown would abort
