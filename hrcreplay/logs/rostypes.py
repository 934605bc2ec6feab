"""ROS messages from their bytes, without ROS: by the definitions in the log, else by those of the known releases."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore

from hrcreplay.logs.messages import Undecodable

_IDL_RULE = "=" * 80 + "\n"
_ROS1 = (Stores.ROS1_NOETIC,)
_ROS2 = (Stores.LATEST, Stores.ROS2_HUMBLE, Stores.ROS2_GALACTIC, Stores.ROS2_FOXY)  # by what differs in their messages
_FAILURES = (SerdeError, TypesysError, KeyError, ValueError, AssertionError)


def plain(msgtype: str) -> str:
    """The name of a type without the "msg" that ROS 2 puts in the middle."""
    return msgtype.replace("/msg/", "/")


def parser(where: str, msgtype: str, definition: str, form: str, *, cdr: bool) -> Callable[[bytes], Any]:
    """A function from the bytes of a message to its fields.

    Args:
        where: Start of error messages: file and topic.
        msgtype: Name of the type, of ROS 1 or ROS 2.
        definition: Text of the type's definition in the log; "" where there is none.
        form: "msg" or "idl".
        cdr: Whether the bytes are CDR (ROS 2); else they are ROS 1's.

    Returns:
        The function. It settles on the first definition that fits its first message and raises Undecodable for a
        message that fits none.
    """
    name = _full(msgtype)
    chosen: list[Typestore] = []

    def read(store: Typestore, data: bytes) -> Any:
        return store.deserialize_cdr(data, name) if cdr else store.deserialize_ros1(data, name)

    def parse(data: bytes) -> Any:
        problem = "its type is not defined in the log"
        for store in chosen or _stores(name, definition, form, _ROS2 if cdr else _ROS1):
            try:
                message = read(store, data)
            except _FAILURES as error:
                problem = str(error)
                continue
            if not chosen:
                chosen.append(store)
            return message
        raise Undecodable(f"{where}: a message of type {plain(msgtype)} cannot be decoded: {problem}")

    return parse


def _stores(name: str, definition: str, form: str, releases: tuple[Stores, ...]) -> Iterator[Typestore]:
    if definition:
        store = get_typestore(Stores.EMPTY)
        try:
            store.register(_types(name, definition, form))
            yield store
        except _FAILURES:
            pass  # some recorders stored definitions without their parts; a release may know the type
    for release in releases:
        store = _release(release)
        if name in store.fielddefs:
            yield store


@cache
def _release(release: Stores) -> Typestore:
    """The types of a release, which take a while to build."""
    return get_typestore(release)


def _types(name: str, definition: str, form: str) -> Any:
    if form == "msg":
        return get_types_from_msg(definition, name)
    types: dict[str, Any] = {}
    for part in definition.split(_IDL_RULE) if definition.startswith(_IDL_RULE) else [definition]:
        text = part.partition("\n")[2] if part.startswith("IDL: ") else part
        if text.strip():
            types.update(get_types_from_idl(text))
    return types


def _full(msgtype: str) -> str:
    package, _, rest = msgtype.partition("/")
    return msgtype if "/" in rest else f"{package}/msg/{rest}"
