"""People who are partly out of sight: the demo's, against the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hrcreplay.commands import replay
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline.run_config import resolve
from hrcreplay.records import POINTS, CameraFrames
from tests.tools.partly_seen import CASES, hide, measure


def test_the_volumes_hold_a_worker_whose_torso_or_forearm_goes_out_of_sight(tmp_path: Path) -> None:
    """Shortly after it, too, when the filter still brings the torso to rest; and they stay below a multiple.

    An arm that was seen a while ago departs as those that were seen lately do, which is not quite enough for reaches.
    """
    found = measure("demo", tmp_path)
    for case, when, share, times in (
        ("arms", "just", 0.995, 10.0),
        ("arms", "long", 0.995, 10.0),
        ("all but a forearm", "just", 0.95, 1.5),
        ("all but a forearm", "long", 0.995, 2.5),
    ):
        of = f"{case} {when}"
        assert found[f"{of}_ticks"] > 50
        assert found[f"{of}_partly_held"] >= share
        assert found[f"{of}_whole_m3"] < found[f"{of}_partly_m3"] < times * found[f"{of}_whole_m3"]


@pytest.mark.parametrize(("case", "left"), [("arms", ("elbow", "wrist")), ("all but a forearm", ())])
def test_points_go_out_of_sight_in_the_second_half_of_three_seconds(
    tmp_path: Path, case: str, left: tuple[str, ...]
) -> None:
    logs = resolve("audit", replay.demo_log()).settings.logs
    log = open_log(replay.demo_log(), logs)
    before = CameraFrames.join(list(log.frames()))
    after = CameraFrames.join(list(open_log(hide(log, tmp_path / "hidden.mcap", CASES[case][0]), logs).frames()))
    assert np.array_equal(after.capture_ns, before.capture_ns)
    late = (before.capture_ns - log.header.start_ns) * 1e-9 % 3.0 >= 1.5
    shown = np.array([name[:-2] in left if left else name not in ("wrist_r", "hand_r") for name in POINTS])
    assert 0.4 < late.mean() < 0.6
    np.testing.assert_allclose(after.points_m[~late], before.points_m[~late], atol=1e-6)
    np.testing.assert_allclose(after.points_m[late][:, shown], before.points_m[late][:, shown], atol=1e-6)
    assert np.isnan(after.points_m[late][:, ~shown]).all()
