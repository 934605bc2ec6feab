"""A camera on another computer: publishes skeletons under Zenoh keys until it is killed. Run by test_zenoh."""

from __future__ import annotations

import itertools
import json
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from hrcreplay.logs import skeleton_pb2 as pb
from hrcreplay.logs.messages import AZURE_JOINTS
from tests.logs.bags import define, header, make, marker_array, point, store_of

MARKERS = "0/cell/kinect/visualization_msgs::msg::dds_::MarkerArray_/RIHS01_0"
OWN = "hrc/xtion"
PERSON = "lab/people"  # as the DDS bridge names the topic /lab/people
PERSON_DEFINITION = (
    "std_msgs/Header header\ngeometry_msgs/Point[] joints\n"
    + "=" * 80
    + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    + "=" * 80
    + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    + "=" * 80
    + "\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
)


def markers_m(i: int) -> np.ndarray[Any, Any]:
    """(32, 3) positions of the i-th message."""
    return np.arange(3 * len(AZURE_JOINTS)).reshape(-1, 3) / 64.0 + i % 50


def own_points(i: int) -> list[float]:
    """The points of the i-th message."""
    return [k / 64.0 - i % 50 for k in range(60)]


def payloads() -> dict[str, Callable[[int, int], bytes]]:
    """Key -> the payload of the i-th message, captured at an instant."""
    store = store_of("ros2")
    define(store, "lab/msg/Person", "std_msgs/Header header\ngeometry_msgs/Point[] joints")

    def markers(i: int, t_ns: int) -> bytes:
        message = marker_array(store, t_ns, {1: markers_m(i)})
        return bytes(store.serialize_cdr(message, "visualization_msgs/msg/MarkerArray"))

    def own(i: int, t_ns: int) -> bytes:
        if i % 3 == 2:
            return b"\xff this is no protobuf"
        return pb.Skeleton(
            capture_ns=t_ns, camera="whatever", body=4, points=own_points(i), confidence=[0.5] * 20
        ).SerializeToString()

    def person(i: int, _t_ns: int) -> bytes:
        head = make(
            store,
            "lab/msg/Person",
            header=header(store, 0),  # no stamp
            joints=[point(store, (i, 0.0, 1500.0)), point(store, (i, 0.0, 1000.0))],
        )
        return bytes(store.serialize_cdr(head, "lab/msg/Person"))

    return {MARKERS: markers, OWN: own, PERSON: person}


def main(endpoint: str) -> None:
    """Publishes at 50 Hz."""
    import zenoh

    config = zenoh.Config()
    for key, value in {
        "connect/endpoints": [endpoint],
        "listen/endpoints": [],
        "scouting/multicast/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    made = payloads()
    with zenoh.open(config) as session:
        for i in itertools.count():
            for key, payload in made.items():
                session.put(key, payload(i, time.time_ns()))
            time.sleep(0.02)


if __name__ == "__main__":
    main(sys.argv[1])
