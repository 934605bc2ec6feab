"""Raw messages of any kind of file, and how several files or chunks become one stream in order of arrival."""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

from hrcreplay.errors import LogError


class Undecodable(LogError):
    """A message that does not follow its own type."""


@dataclass(frozen=True)
class Topic:
    """A topic of one file."""

    name: str
    type: str  #: without the "msg" of ROS 2: tf2_msgs/TFMessage
    count: int  #: messages in this file
    parse: Callable[[bytes], Any]  #: bytes of a message -> its fields; raises Undecodable


def listed(found: Iterable[Topic]) -> str:
    """Topics and their types in one line."""
    return ", ".join(f"{topic.name} ({topic.type})" for topic in found) or "no topics at all"


class Message(NamedTuple):
    """A message as it lies in the file."""

    arrival_ns: int
    topic: Topic
    data: bytes

    def read(self) -> Any:
        """Its fields. Raises Undecodable."""
        return self.topic.parse(self.data)


class Stream(Protocol):
    """One file of a log."""

    topics: tuple[Topic, ...]
    start_ns: int  #: first arrival
    end_ns: int  #: last arrival
    profile: str  #: who wrote it, where the format says
    defects: Counter[str]
    notes: list[str]

    def messages(self, names: Collection[str], start_ns: int | None, end_ns: int | None) -> Iterator[Message]:
        """Messages on these topics with start <= arrival < end, in order of arrival."""


@dataclass
class Damage:
    """What was found wrong with a file."""

    defects: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)

    def ends_at(self, last_ns: int, start_ns: int) -> None:
        """Records that the file breaks off."""
        self.defects["truncated_at_ns"] = last_ns
        self.notes.append(f"the file breaks off {(last_ns - start_ns) / 1e9:.3f} s after its first message")


class Part(NamedTuple):
    """A stretch of messages that is opened only when its time has come."""

    start_ns: int  #: no message in it is earlier
    open: Callable[[], Iterator[Message]]  #: the messages in order of arrival


def in_order(parts: Iterable[Part]) -> Iterator[Message]:
    """Messages of all parts in order of arrival; parts that do not overlap are never open together.

    Messages of one arrival keep the order of their parts.
    """
    waiting = deque(sorted(parts, key=lambda part: part.start_ns))
    heads: list[tuple[int, int, Message, Iterator[Message]]] = []
    opened = 0
    while waiting or heads:
        while waiting and (not heads or waiting[0].start_ns <= heads[0][0]):
            messages = waiting.popleft().open()
            first = next(messages, None)
            if first is not None:
                heapq.heappush(heads, (first.arrival_ns, opened, first, messages))
            opened += 1
        if not heads:
            continue
        _, order, message, messages = heads[0]
        yield message
        following = next(messages, None)
        if following is None:
            heapq.heappop(heads)
        else:
            heapq.heapreplace(heads, (following.arrival_ns, order, following, messages))
