"""Poses of cameras and base in our own logs: what is none is refused in a line that says which and why."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hrcreplay.errors import LogError
from hrcreplay.logs.reader import open_log
from hrcreplay.records import Floats
from tests.tools.fuzz.clip import clip, write


def pose(rotation: Floats, place: float = 1.0, last: float = 1.0) -> list[float]:
    T = np.diag([1.0, 1.0, 1.0, last])
    T[:3, :3], T[:3, 3] = rotation, place
    values: list[float] = T.ravel().tolist()
    return values


NONE = {
    "a pose with nan; finite": pose(np.eye(3), float("nan")),
    "a pose with inf; finite": pose(np.eye(3), float("inf")),
    "a pose with axes off by 1e": pose(np.eye(3) * 1000.0),
    "a pose with axes off by 1;": pose(np.zeros((3, 3))),
    "a pose with a mirror image": pose(np.diag([1.0, 1.0, -1.0])),
    "a pose with a mirror image, or a last row": pose(np.eye(3), last=2.0),
}


@pytest.mark.parametrize("text", NONE)
@pytest.mark.parametrize("whose", ["/robot/base", "/camera/kinect/info"])
def test_a_pose_that_is_none_is_refused(text: str, whose: str, tmp_path: Path) -> None:
    made = clip(6.0, 0.3)
    if whose == "/robot/base":
        made.base = NONE[text]
    else:
        made.poses["kinect"] = NONE[text]
    with pytest.raises(LogError, match=f"^{whose}: {text}"):
        open_log(write(made, tmp_path / "log.mcap"))


def test_a_pose_that_was_rounded_is_taken(tmp_path: Path) -> None:
    made = clip(6.0, 0.3)
    rotation = np.array([[np.cos(1.0), -np.sin(1.0), 0.0], [np.sin(1.0), np.cos(1.0), 0.0], [0.0, 0.0, 1.0]])
    made.base = pose(rotation.round(3))
    found = open_log(write(made, tmp_path / "log.mcap")).header.T_world_base
    assert found is not None
    np.testing.assert_array_equal(found[:3, :3], rotation.round(3))
