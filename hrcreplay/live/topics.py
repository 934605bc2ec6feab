"""Where the messages of a session's record go in its log, and how they come back.

The log is one of ours, so whatever reads logs reads it: skeletons, cameras, task and base lie on their usual topics.
The rest of the record lies beside them, with the session's clock as log_time.
"""

from __future__ import annotations

from hrcreplay.live import wire
from hrcreplay.logs import topics

ROBOT = "/egm/robot"  #: datagrams of the robot, whatever is in them
SENT = "/egm/correction"  #: datagrams that went to the robot
UNSENT = "/egm/correction/unsent"  #: datagrams that would have gone: shadow mode
STRAY = "/live/frame"  #: skeletons of no camera of the session, or not to be read
EVENT = "/live/event"  #: JSON

ENCODING = "hrcreplay.live"  #: of the messages that only the record has; wire.py says what is in them

_BY_KIND = {
    wire.ROBOT: ROBOT,
    wire.LOOK: "/live/look",
    wire.VOLUMES: "/live/volumes",
    wire.ANSWER: "/live/answer",
    wire.SILENCE: "/live/silence",
    wire.EVENT: EVENT,
}
_KINDS = {topic: kind for kind, topic in _BY_KIND.items()} | {STRAY: wire.FRAME}


def split(message: bytes) -> tuple[str, bytes]:
    """The topic of a message and what lies there; of a frame, the topic of those that belong to no camera."""
    kind = wire.kind(message)
    if kind == wire.REPLY:
        sent, datagram = wire.read_reply(message)
        return SENT if sent else UNSENT, datagram
    return STRAY if kind == wire.FRAME else _BY_KIND[kind], wire.body(message)


def join(topic: str, t_ns: int, data: bytes) -> bytes | None:
    """The message of the record that lies on a topic; None for what the log has beside the record."""
    if topic in (SENT, UNSENT):
        return wire.reply(t_ns, data, sent=topic == SENT)
    if topic in _KINDS:
        return _KINDS[topic] + wire.robot(t_ns, data)[1:]
    parts = topic.split("/")
    if len(parts) == 4 and topic == topics.skeleton(parts[2]):
        return wire.frame(t_ns, data)
    return None
