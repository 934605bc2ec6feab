"""Skeletons as the Azure Kinect ROS driver publishes them: visualization_msgs/MarkerArray, a marker a joint."""

from __future__ import annotations

from typing import Any, ClassVar

from hrcreplay.logs.joints import AZURE_INDEX, AZURE_JOINTS
from hrcreplay.logs.messages import Message
from hrcreplay.logs.skeletons import Row, blank, camera_of, stamp_ns

TYPE = "visualization_msgs/MarkerArray"
_IDS_A_BODY = 100
_LEAST_JOINTS = 8
_GONE = (2, 3)  # actions DELETE and DELETEALL


class MarkerDecoder:
    """A MarkerArray topic; marker.id = body * 100 + joint, positions in metres in the camera's frame.

    The markers carry no confidence: it is 1 for every point. The camera is named after the topic.
    """

    notes: ClassVar[tuple[str, ...]] = ("markers carry no confidence: 1 for every point",)
    always_heard: ClassVar[bool] = True

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.cameras = (camera_of(topic),)

    def fresh(self) -> MarkerDecoder:
        """Itself: it remembers nothing."""
        return self

    def rows(self, message: Message) -> list[Row]:
        """A row a body; none for an empty or a clearing array."""
        rows = []
        for body, markers in sorted(_bodies(message.read()).items()):
            points, confidence = blank()
            for joint, marker in markers.items():
                if joint in AZURE_INDEX:
                    at = marker.pose.position
                    points[AZURE_INDEX[joint]] = at.x, at.y, at.z
                    confidence[AZURE_INDEX[joint]] = 1.0
            stamp = stamp_ns(next(iter(markers.values())).header.stamp, self.topic)
            rows.append(Row(stamp or None, self.cameras[0], body, points, confidence, stamp_zero=not stamp))
        return rows


def is_skeleton(array: Any) -> bool:
    """Whether the markers of an array look like a body's joints: any other node publishes markers too."""
    return any(len(markers) >= _LEAST_JOINTS for markers in _bodies(array).values())


def _bodies(array: Any) -> dict[int, dict[int, Any]]:
    bodies: dict[int, dict[int, Any]] = {}
    for marker in array.markers:
        body, joint = divmod(marker.id, _IDS_A_BODY)
        if marker.action not in _GONE and body >= 0 and joint < len(AZURE_JOINTS):
            bodies.setdefault(body, {})[joint] = marker
    return bodies
