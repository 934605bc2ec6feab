from __future__ import annotations

import pytest

from hrcreplay.geometry.hull_reduction import END, START, is_loop, surface


@pytest.mark.parametrize(
    ("slots", "simple"),
    [
        ("01 12 20", True),
        ("20 12 01", True),
        ("01 30 12 23", True),
        ("01 12 20 34 45 53", False),  # two loops
        ("01 12 20 03 34 40", False),  # two that meet
        ("03 34 40 01 12 20", False),
    ],
)
def test_only_one_simple_loop_is_one(slots: str, simple: bool) -> None:
    faces, edges = surface().faces, slots.split()
    faces[:] = 0
    faces[START, : len(edges)] = [int(edge[0]) for edge in edges]
    faces[END, : len(edges)] = [int(edge[1]) for edge in edges]
    assert is_loop(len(edges), faces) is simple
