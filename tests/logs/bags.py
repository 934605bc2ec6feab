"""Bags made for the tests, by rosbags' own writers: ROS 1, ROS 2 sqlite3 and ROS 2 MCAP."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

KINDS = ("ros1", "db3", "mcap")
_LIMBS = ("shoulder", "elbow", "hand", "hip", "knee", "foot")
OPENNI = ("head", "neck", "torso", *(f"{side}_{joint}" for side in ("left", "right") for joint in _LIMBS))

Write = Callable[[str, str, int, Any], None]  #: topic, type, arrival [ns], message


def store_of(kind: str) -> Typestore:
    """Types of ROS 1 (with tf, which rosbags lacks) or of ROS 2."""
    if kind != "ros1":
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    for name in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
    return store


def define(store: Typestore, name: str, definition: str) -> None:
    """Adds a type of one's own."""
    store.register(get_types_from_msg(definition, name))


@contextmanager
def bag(path: Path, kind: str, **options: Any) -> Iterator[tuple[Write, Typestore]]:
    """A bag being written: a function that writes a message, and the types."""
    store = store_of(kind)
    connections: dict[str, Any] = {}
    writer: Any
    if kind == "ros1":
        writer = rosbag1.Writer(path)
    else:
        plugin = StoragePlugin.SQLITE3 if kind == "db3" else StoragePlugin.MCAP
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    if "compression" in options:
        writer.set_compression(*options["compression"])
    with writer:

        def write(topic: str, msgtype: str, arrival_ns: int, message: Any) -> None:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=store)
            serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
            writer.write(connections[topic], arrival_ns, serialize(message, msgtype))

        yield write, store


def make(store: Typestore, msgtype: str, /, **given: Any) -> Any:
    """A message with the given fields; the others are empty."""
    values = {
        field: given[field] if field in given else _empty(store, kind, args)
        for field, (kind, args) in store.fielddefs[msgtype][1]
    }
    return store.types[msgtype](**values)


def _empty(store: Typestore, kind: Nodetype, args: Any) -> Any:
    if kind == Nodetype.NAME:
        return make(store, args)
    if kind == Nodetype.BASE:
        return {"string": "", "bool": False}.get(args[0], 0)
    (inner, inner_args), size = args
    if inner == Nodetype.BASE and inner_args[0] != "string":
        return np.zeros(size if kind == Nodetype.ARRAY else 0, dtype=inner_args[0])
    return []


def header(store: Typestore, stamp_ns: int, frame: str = "") -> Any:
    """A std_msgs/Header."""
    stamp = make(store, "builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return make(store, "std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def point(store: Typestore, xyz: Any, kind: str = "Point") -> Any:
    """A geometry_msgs/Point or Vector3."""
    x, y, z = (float(v) for v in xyz)
    return make(store, f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


def transform(store: Typestore, stamp_ns: int, parent: str, child: str, xyz: Any) -> Any:
    """A geometry_msgs/TransformStamped without rotation."""
    rotation = make(store, "geometry_msgs/msg/Quaternion", w=1.0, x=0.0, y=0.0, z=0.0)
    moved = make(store, "geometry_msgs/msg/Transform", translation=point(store, xyz, "Vector3"), rotation=rotation)
    return make(
        store,
        "geometry_msgs/msg/TransformStamped",
        header=header(store, stamp_ns, parent),
        child_frame_id=child,
        transform=moved,
    )


def openni_at(joint: str, frame: int, body: int = 1) -> np.ndarray[Any, Any]:
    """Where a joint is in a frame: all different, so that a mix-up shows."""
    return np.array([OPENNI.index(joint) / 10.0, frame / 100.0, 2.0 + body])


def write_openni(write: Write, store: Typestore, *, frames: int, start_ns: int, **how: Any) -> None:
    """A person by openni_tracker at 30 Hz: a message a joint, each with a stamp of its own."""
    msgtype = how.get("msgtype", "tf2_msgs/msg/TFMessage")
    parent, body, joints = how.get("parent", "openni_depth_frame"), how.get("body", 1), how.get("joints", OPENNI)
    for frame in range(frames):
        for i, joint in enumerate(joints):
            stamp_ns = start_ns + frame * 33_000_000 + i * 200_000
            at = openni_at(joint, frame, body)
            sent = transform(store, stamp_ns, parent, f"{joint}_{body}", at)
            write("/tf", msgtype, stamp_ns + 5_000_000, make(store, msgtype, transforms=[sent]))


def marker_array(store: Typestore, stamp_ns: int, bodies: dict[int, Any], action: int = 0) -> Any:
    """What the Azure Kinect ROS driver publishes: (32, 3) positions [m] a body."""
    markers = [
        make(
            store,
            "visualization_msgs/msg/Marker",
            header=header(store, stamp_ns, "depth_camera_link"),
            id=100 * body + joint,
            action=action,
            pose=make(store, "geometry_msgs/msg/Pose", position=point(store, xyz)),
        )
        for body, positions in bodies.items()
        for joint, xyz in enumerate(positions)
    ]
    return make(store, "visualization_msgs/msg/MarkerArray", markers=markers)
