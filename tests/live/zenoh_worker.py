"""A worker before two cameras on another computer: skeletons under Zenoh keys until killed. Run by test_zenoh_session.

One camera puts there what a ROS 2 driver does, the other our own message: ``-m tests.live.zenoh_worker tcp/...``.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np

from hrcreplay.human.model import skeleton
from hrcreplay.logs import skeleton_pb2 as pb
from hrcreplay.logs.messages import AZURE_INDEX, AZURE_JOINTS
from hrcreplay.records import Floats
from tests.live.flights import LENGTHS_M
from tests.logs.bags import marker_array, store_of

MARKERS = "0/cell/kinect/visualization_msgs::msg::dds_::MarkerArray_/RIHS01_0"
OWN = "hrc/xtion"
AWAY_M = 3.0  #: from the robot's base

#: Camera -> its pose in the world: both look at the worker from in front of them, y down.
POSES: dict[str, Floats] = {
    "kinect": np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0.5], [0, -1, 0, 1.4], [0, 0, 0, 1]]),
    "xtion": np.array([[0.0, 0, 1, 0], [-1, 0, 0, -0.5], [0, -1, 0, 1.4], [0, 0, 0, 1]]),
}


def points_m(camera: str, t_s: float) -> Floats:
    """(20, 3) in the camera's frame; NaN where the model has no say. The worker shifts from one foot to the other."""
    arm = (0.1, 0.5, 0.0, 1.8)
    joints = np.array([[AWAY_M, 0.1 * np.sin(2.0 * t_s), np.pi, 0.1, *arm, *arm, 0.94]])
    to_camera = np.linalg.inv(POSES[camera])
    found: Floats = skeleton(joints, LENGTHS_M)[0] @ to_camera[:3, :3].T + to_camera[:3, 3]
    return found


def markers(t_ns: int) -> bytes:
    """What the driver of an Azure Kinect puts there."""
    positions = np.full((len(AZURE_JOINTS), 3), np.nan)
    positions[list(AZURE_INDEX)] = points_m("kinect", t_ns * 1e-9)[list(AZURE_INDEX.values())]
    store = store_of("ros2")
    return bytes(store.serialize_cdr(marker_array(store, t_ns, {1: positions}), "visualization_msgs/msg/MarkerArray"))


def own(t_ns: int) -> bytes:
    """Our own message."""
    found = points_m("xtion", t_ns * 1e-9)
    message = pb.Skeleton(capture_ns=t_ns, camera="xtion", body=1, points=found.ravel().tolist())
    message.confidence.extend(np.isfinite(found[:, 0]).astype(float).tolist())
    data: bytes = message.SerializeToString()
    return data


def main(endpoint: str) -> None:
    """Publishes at 30 Hz."""
    import zenoh

    config = zenoh.Config()
    given = {"connect/endpoints": [endpoint], "listen/endpoints": [], "scouting/multicast/enabled": False}
    for key, value in given.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        while True:
            session.put(MARKERS, markers(time.time_ns()))
            session.put(OWN, own(time.time_ns()))
            time.sleep(0.033)


if __name__ == "__main__":
    main(sys.argv[1])
