"""Skeletons from Zenoh keys: messages of our own format, or the CDR messages of a ROS 2 system.

Control stamps the arrival. A capture time is used as it is, because it and the session's clock are both Unix time.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from threading import Thread
from typing import Any

from google.protobuf.message import DecodeError

from hrcreplay.errors import LogError, SettingsError
from hrcreplay.live.person.log_playback import Message as Outgoing
from hrcreplay.live.person.log_playback import frames_of, ready_note, same_frame
from hrcreplay.live.processes import ControlGoneError
from hrcreplay.logs import decoders, ros_bags
from hrcreplay.logs import skeleton_pb2 as pb
from hrcreplay.logs.clean import DEFECTS, STAMP_FAR_S, Cleaner
from hrcreplay.logs.decoders import GenericDecoder, MarkerDecoder, OwnDecoder, TfDecoder
from hrcreplay.logs.messages import Message, RawSkeleton, SkeletonDecoder, Topic, Undecodable
from hrcreplay.settings.sections import Decoder, ZenohKey

_OWN = "hrcreplay.Skeleton"
_RMW_TYPE = re.compile(r"(\w+)::msg::dds_::(\w+)_")  # in the keys of rmw_zenoh: <domain>/<topic>/<type>/<hash>
_KNOWN = (decoders.MARKER_TYPE, *decoders.TF_TYPES)
_AHEAD_NS = 10**9  # a capture further in the future would make all that follow look late
_FAR_NS = round(STAMP_FAR_S * 1e9)
_OLD_NS = 10**9  # an older capture hints at clocks that are not set
_GAP_S = 0.2


class CameraSubscription:
    """The keys of one camera: payloads in, cleaned skeletons out."""

    def __init__(self, camera: str, settings: ZenohKey) -> None:
        self._camera = camera
        self._settings = settings
        self._where = f"live.zenoh.keys.{camera}"
        self._readers: dict[str, tuple[Topic, SkeletonDecoder]] = {}  # of each type
        self._defects: Counter[str] = Counter()
        self._cleaner = Cleaner((camera,), _GAP_S, self._defects)
        self._told: set[str] = set()
        self._undecodable = 0

    def prepare(self) -> None:
        """Makes the readers of the types that may come, which takes too long for the first message to wait for."""
        given = self._settings
        types = (_OWN,) if given.payload == "hrcreplay" else (given.type,) if given.type else _KNOWN
        for msgtype in types:
            with suppress(LogError):
                self._reader(given.key, ros_bags.plain(msgtype))[0].parse(b"")

    def take(self, key: str, data: bytes, now_ns: int) -> Iterator[Outgoing]:
        """Messages to control for one payload: its bodies, and notes, each once."""
        try:
            rows = self._rows(key, data, now_ns)
        except Exception as error:  # whatever a stranger sends: it is not worth more than a remark
            self._undecodable += 1
            if str(self._undecodable).rstrip("0") == "1":  # 1, 10, 100...
                yield self._note(f"{self._undecodable} undecodable: {error or type(error).__name__}")
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
            return topic, GenericDecoder(Decoder(topic=key, camera=self._camera, **how))
        if msgtype in decoders.TF_TYPES:
            return topic, TfDecoder(key, (self._camera,))
        if msgtype == decoders.MARKER_TYPE:
            return topic, MarkerDecoder(key)
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
    """Subscribes to the cameras' keys. Zenoh's threads decode and send at once; ``due`` only tells of a failure."""

    def __init__(
        self, settings: Mapping[str, Any], send: Callable[[bytes, bytes], object], clock: Callable[[], int]
    ) -> None:
        self._settings = settings
        self._send = send
        self._clock = clock
        self._going = False
        self._failure: Exception | None = None
        self._open: list[Any] = []  # what must live as long as the source
        Thread(target=self._begin, name="opening zenoh", daemon=True).start()

    def go(self, start_ns: int) -> None:  # noqa: ARG002 - live frames have no start of their own
        """Lets frames through from now on."""
        self._going = True

    def due(self, now_ns: int) -> Iterator[Outgoing]:  # noqa: ARG002
        """Nothing: frames go by themselves.

        Raises:
            SettingsError: There is no session, or a key is none.
        """
        if self._failure is not None:
            raise self._failure
        return iter(())

    def next_ns(self, now_ns: int) -> int | None:  # noqa: ARG002
        """Not known."""
        return None

    def _begin(self) -> None:
        try:
            keys = {name: ZenohKey.model_validate(given) for name, given in self._settings["keys"].items()}
            session = open_session(self._settings)
            self._open.append(session)
            for name, given in keys.items():
                stream = CameraSubscription(name, given)
                stream.prepare()
                self._open.append(_subscribe(session, name, given, self._taker(stream)))
            self._send(*ready_note(tuple(keys)))
        except ControlGoneError:
            pass  # the main thread sees it too
        except Exception as error:  # raised again where the process can tell of it
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
    """A Zenoh session that talks to the endpoints that settings name, and to nobody else unless ``scouting`` is on.

    Raises:
        SettingsError: Zenoh is not installed, or the session cannot be opened.
    """
    try:
        import zenoh
    except ModuleNotFoundError as error:
        raise SettingsError(
            "live.zenoh: eclipse-zenoh is not installed; would be right: pip install 'hrcreplay[zenoh]'"
        ) from error
    config = zenoh.Config()
    given = {
        "mode": settings.get("mode", "peer"),
        "connect/endpoints": list(settings.get("connect", ())),
        "connect/retry": {"period_init_ms": 250, "period_max_ms": 1000},
        "listen/endpoints": list(settings.get("listen", ())),
        "scouting/multicast/enabled": bool(settings.get("scouting", False)),
    }
    try:
        for key, value in given.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise SettingsError(f"live.zenoh: no session ({error}); check mode, connect and listen") from error


def _subscribe(session: Any, camera: str, given: ZenohKey, take: Callable[[Any], None]) -> Any:
    import zenoh

    try:
        return session.declare_subscriber(given.key, take)
    except zenoh.ZError as error:
        raise SettingsError(f"live.zenoh.keys.{camera}: {given.key!r} is no key expression ({error})") from error
