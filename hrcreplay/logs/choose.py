"""Which topics of a log carry skeletons, and which decoder reads each."""

from __future__ import annotations

from itertools import islice

from hrcreplay.errors import LogError
from hrcreplay.logs import decode_markers, decode_tf, topics
from hrcreplay.logs.decode_generic import GenericDecoder
from hrcreplay.logs.decode_markers import MarkerDecoder
from hrcreplay.logs.decode_own import OwnDecoder
from hrcreplay.logs.decode_tf import TfDecoder
from hrcreplay.logs.messages import Topic, listed
from hrcreplay.logs.skeletons import Decoder
from hrcreplay.logs.source import Source

_OWN = "hrcreplay.Skeleton"
_PEEK = 300  # markers: ten seconds of a sensor to show a body in
_HOW = "Name one with --topic NAME, or a decoder for it in [logs.decoders] of the settings file."


def choose(source: Source, names: tuple[str, ...], described: tuple[GenericDecoder, ...]) -> list[Decoder]:
    """The decoders of a log's skeleton topics.

    Args:
        source: The log's files.
        names: Topics that the user named; () for all that a decoder knows.
        described: Decoders that settings describe; a topic with one is read by it.

    Returns:
        A decoder a topic, none where no topic carries skeletons.

    Raises:
        LogError: A named topic is not in the log, or carries no skeletons.
    """
    found = {topic.name: topic for topic in source.topics()}
    for name in (*names, *(decoder.topic for decoder in described)):
        if name not in found:
            raise LogError(f"{source.path}: no topic {name}; found {listed(found.values())}")
    by_topic = {decoder.topic: decoder for decoder in described}
    decoders: list[Decoder] = []
    for topic in found.values():
        if names and topic.name not in names:
            continue
        decoder = by_topic.get(topic.name) or _known(source, topic, asked=bool(names))
        if decoder is not None:
            decoders.append(decoder)
        elif names:
            raise LogError(f"{source.path}: no skeletons on {topic.name} ({topic.type}). {_HOW}")
    _check_cameras(source, decoders)
    return decoders


def none_found(source: Source) -> LogError:
    """What to tell the user where no topic carries skeletons."""
    return LogError(f"{source.path}: no skeleton topic; found {listed(source.topics())}.\n{_HOW}")


def _known(source: Source, topic: Topic, *, asked: bool) -> Decoder | None:
    if not topic.count:
        return None
    if topic.type == _OWN:
        return OwnDecoder(topic.name, topics.camera(topic.name))
    if topic.type in decode_tf.TYPES:
        cameras = decode_tf.find_cameras(source.messages([topic.name]))
        return TfDecoder(topic.name, cameras) if cameras else None
    if topic.type == decode_markers.TYPE:
        looks = any(decode_markers.is_skeleton(m.read()) for m in islice(source.messages([topic.name]), _PEEK))
        return MarkerDecoder(topic.name) if looks or asked or "body_tracking" in topic.name else None
    return None


def _check_cameras(source: Source, decoders: list[Decoder]) -> None:
    met: dict[str, str] = {}
    for decoder in decoders:
        for camera in decoder.cameras:
            if camera in met:
                raise LogError(
                    f"{source.path}: {met[camera]} and {decoder.topic} are both camera {camera!r}; "
                    "choose topics with --topic, or give another name in [logs.decoders]"
                )
            met[camera] = decoder.topic
