"""People of whom only the arms are seen: the demo's, against the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hrcreplay.commands import replay
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline.run_config import resolve
from hrcreplay.records import POINTS, CameraFrames
from tests.tools.partly_seen import SHOWN, hide, measure


def test_the_volumes_hold_a_walker_whose_torso_goes_out_of_sight(tmp_path: Path) -> None:
    """Shortly after it, too, when the filter still brings the torso to rest; and they stay below ten times the size."""
    found = measure("demo", tmp_path)
    for when in ("just", "long"):
        assert found[f"{when}_ticks"] > 50
        assert found[f"{when}_partly_held"] >= 0.995
        assert found[f"{when}_whole_m3"] < found[f"{when}_partly_m3"] < 10.0 * found[f"{when}_whole_m3"]


def test_only_elbows_and_wrists_are_left_in_the_second_half_of_three_seconds(tmp_path: Path) -> None:
    logs = resolve("audit", replay.demo_log()).settings.logs
    log = open_log(replay.demo_log(), logs)
    before = CameraFrames.join(list(log.frames()))
    after = CameraFrames.join(list(open_log(hide(log, tmp_path / "hidden.mcap"), logs).frames()))
    assert np.array_equal(after.capture_ns, before.capture_ns)
    late = (before.capture_ns - log.header.start_ns) * 1e-9 % 3.0 >= 1.5
    arms = np.isin(POINTS, SHOWN)
    assert 0.4 < late.mean() < 0.6
    np.testing.assert_allclose(after.points_m[~late], before.points_m[~late], atol=1e-6)
    np.testing.assert_allclose(after.points_m[late][:, arms], before.points_m[late][:, arms], atol=1e-6)
    assert np.isnan(after.points_m[late][:, ~arms]).all()
