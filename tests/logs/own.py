"""Our own logs made for the tests."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hrcreplay.logs.writer import LogWriter
from hrcreplay.records import CameraFrames

BEGIN_NS = 1_700_000_000_000_000_000
PERIOD_NS = 33_333_333


def frames(
    n: int = 90, cameras: tuple[str, ...] = ("left", "right"), seed: int = 0, which: Sequence[int] | None = None
) -> CameraFrames:
    """Frames of cameras in turn, 5 ms on the wire; points are random, exactly as float32 stores them."""
    rng = np.random.default_rng(seed)
    capture_ns = BEGIN_NS + np.arange(n, dtype=np.int64) * PERIOD_NS
    table = CameraFrames(
        capture_ns=capture_ns,
        arrival_ns=capture_ns + 5_000_000,
        camera=np.arange(n, dtype=np.int64) % len(cameras),
        body=np.full(n, 7, dtype=np.int64),
        points_m=rng.normal(size=(n, 20, 3)).astype(np.float32).astype(np.float64),
        confidence=rng.integers(0, 5, size=(n, 20)) / 4.0,
        cameras=cameras,
    )
    return table if which is None else table.rows(np.array(which, dtype=np.int64))


def write(path: Path, *tables: CameraFrames, **extra: Any) -> Path:
    """A log of these frames."""
    with LogWriter(path) as writer:
        for name, T in extra.get("cameras", {}).items():
            writer.camera(name, T)
        for table in tables:
            writer.frames(table)
    return path


def read(log: Any, **window: Any) -> CameraFrames:
    """All frames of a log in one table."""
    return CameraFrames.join(list(log.frames(**window)))
