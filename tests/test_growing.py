"""Rows of a long run are collected in arrays that grow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hrcreplay.records import CameraFrames, Growing, HumanStates
from tests.pipeline.test_several_people import crowd


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
    monkeypatch.setattr(Growing, "LEAST", 8)
    rng, growing = np.random.default_rng(1), Growing[CameraFrames]()
    parts = [frames(rng, size) for size in sizes]
    for part in parts:
        growing.add(part)
    assert len(growing) == sum(sizes)
    found, joined = growing.take(), CameraFrames.join(parts)
    assert found is not None
    assert found.cameras == joined.cameras
    for name, values in vars(joined).items():
        if isinstance(values, np.ndarray):
            np.testing.assert_array_equal(getattr(found, name), values)
            assert getattr(found, name).dtype == values.dtype
    assert len(growing) == 0
    assert growing.take() is None, "it is empty now"
    growing.add(parts[-1])
    again = growing.take()
    assert (0 if again is None else len(again)) == sizes[-1]


def test_a_part_with_other_columns_is_refused() -> None:
    growing = Growing[HumanStates]()
    with_person = crowd(1, 2)
    growing.add(with_person)
    with pytest.raises(ValueError, match="those of the first part"):
        growing.add(replace(with_person, person=None))
