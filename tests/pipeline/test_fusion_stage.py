"""The bodies that cameras show are collected over a whole run."""

from __future__ import annotations

import numpy as np
import pytest

from hrcreplay.pipeline.fusion_stage import GrowingFrames
from hrcreplay.records import CameraFrames


def frames(rng: np.random.Generator, count: int) -> CameraFrames:
    return CameraFrames(
        capture_ns=rng.integers(0, 10**12, count),
        arrival_ns=rng.integers(0, 10**12, count),
        camera=rng.integers(0, 2, count),
        body=rng.integers(-1, 5, count),
        points_m=rng.normal(size=(count, 20, 3)),
        confidence=rng.random((count, 20)),
        cameras=("left", "right"),
    )


@pytest.mark.parametrize("sizes", [(3,), (0, 5, 0), (7, 1, 8, 16, 0, 33), (100, 1, 1)])
def test_frames_that_grow_are_the_parts_joined(sizes: tuple[int, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(GrowingFrames, "LEAST", 8)
    rng, growing = np.random.default_rng(1), GrowingFrames()
    parts = [frames(rng, size) for size in sizes]
    for part in parts:
        growing.add(part)
    found, joined = growing.take(), CameraFrames.join(parts)
    assert found is not None
    assert found.cameras == joined.cameras
    for name, values in vars(joined).items():
        if isinstance(values, np.ndarray):
            np.testing.assert_array_equal(getattr(found, name), values)
            assert getattr(found, name).dtype == values.dtype
    assert growing.take() is None, "it is empty now"
    growing.add(parts[-1])
    again = growing.take()
    assert (0 if again is None else len(again)) == sizes[-1]
