"""The topics of a session's log: where each recorded message is stored, and how it is read back.

The log has our own format, so every reader of logs reads it: skeletons, cameras, task and base are on their usual
topics. All other messages are on topics of their own, with the session's clock as log_time.
"""

from __future__ import annotations

from hrcreplay.live.record import codec
from hrcreplay.logs import messages

ROBOT = "/egm/robot"  #: datagrams of the robot, whatever is in them
SENT = "/egm/correction"  #: datagrams that went to the robot
UNSENT = "/egm/correction/unsent"  #: datagrams that would have gone: shadow mode
STRAY = "/live/frame"  #: skeletons of no camera of the session, or not to be read
EVENT = "/live/event"  #: JSON

ENCODING = "hrcreplay.live"  #: of the messages that only the record has; ``codec`` says what is in them

_BY_KIND = {
    codec.ROBOT: ROBOT,
    codec.PERCEPTION: "/live/look",
    codec.VOLUMES: "/live/volumes",
    codec.DECISION: "/live/answer",
    codec.TIMEOUT: "/live/silence",
    codec.EVENT: EVENT,
}
_KINDS = {topic: kind for kind, topic in _BY_KIND.items()} | {STRAY: codec.SKELETON}


def split(message: bytes) -> tuple[str, bytes]:
    """The topic of a message and what lies there; of a frame, the topic of those that belong to no camera."""
    kind = codec.kind(message)
    if kind == codec.REPLY:
        sent, datagram = codec.decode_reply(message)
        return SENT if sent else UNSENT, datagram
    return STRAY if kind == codec.SKELETON else _BY_KIND[kind], codec.body(message)


def join(topic: str, t_ns: int, data: bytes) -> bytes | None:
    """The message of the record that lies on a topic; None for what the log has beside the record."""
    if topic in (SENT, UNSENT):
        return codec.encode_reply(t_ns, data, sent=topic == SENT)
    if topic in _KINDS:
        return _KINDS[topic] + codec.encode_robot_packet(t_ns, data)[1:]
    parts = topic.split("/")
    if len(parts) == 4 and topic == messages.skeleton_topic(parts[2]):
        return codec.encode_skeleton(t_ns, data)
    return None
