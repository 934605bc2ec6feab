"""Topics and message types of our own log; skeleton.proto has the messages."""

from __future__ import annotations

PROFILE = "hrcreplay"  #: profile in the MCAP header, by which our logs are known
TASK = "/task"
BASE = "/robot/base"
JOINTS = "/robot/joints"
TRUTH = "/truth"


def skeleton(camera: str) -> str:
    """Topic of a camera's skeletons."""
    return f"/camera/{camera}/skeleton"


def info(camera: str) -> str:
    """Topic of what is known of a camera."""
    return f"/camera/{camera}/info"


def camera(topic: str) -> str:
    """The camera that a topic of ours is about."""
    return topic.split("/")[2]
