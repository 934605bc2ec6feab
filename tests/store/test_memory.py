"""Freed memory goes back to the system while a run goes on, not only at the end of a stage."""

from __future__ import annotations

import pytest

from hrcreplay.store import memory


def test_freed_memory_goes_back_after_every_hundredth_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    given_back: list[int] = []
    for batch in range(250):
        monkeypatch.setattr(memory, "release_freed_memory", lambda batch=batch: given_back.append(batch))
        memory.release_after(batch)
    assert given_back == [99, 199]
