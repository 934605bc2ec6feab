from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hrcreplay.logs.info import lines, summarize
from hrcreplay.logs.reader import open_log
from hrcreplay.logs.writer import LogWriter
from hrcreplay.records import CameraFrames
from hrcreplay.settings.sections import Decoder, Logs
from tests.facts import tells
from tests.logs import own
from tests.realdata import data_path

BEGIN = own.BEGIN_NS


def session(path: Path) -> Path:
    """Two cameras at 15 Hz: the right one posed, late, and with two bodies at the end; the left one has a gap."""
    table = own.frames(600, which=[k for k in range(600) if (k >= 90 if k % 2 else not 200 <= k < 260)])
    double = own.frames(600, which=[597, 599], seed=1)
    double = CameraFrames(
        double.capture_ns, double.arrival_ns, double.camera, double.body + 4,
        double.points_m, double.confidence, double.cameras,
    )  # fmt: skip
    with LogWriter(path) as writer:
        writer.camera("left")
        writer.camera("right", np.eye(4))
        writer.camera("top")
        writer.frames(CameraFrames.join([table, double]))
        writer.joints(("a", "b"), table.capture_ns, np.zeros((len(table), 2)))
    return path


def test_summary_of_our_own_log(tmp_path: Path) -> None:
    found = summarize(open_log(session(tmp_path / "a.mcap")))
    left, right, top = found.cameras
    assert (left.name, left.frames, left.bodies, left.posed) == ("left", 270, {7: 270}, False)
    assert (right.name, right.frames, right.bodies, right.posed) == ("right", 255, {7: 255, 11: 2}, True)
    assert left.rate_hz == pytest.approx(15.0, rel=1e-6)
    assert left.longest_gap_s == pytest.approx(62 * own.PERIOD_NS / 1e9, abs=1e-9)
    assert right.longest_gap_s == pytest.approx(2 * own.PERIOD_NS / 1e9, abs=1e-9)
    assert right.first_ns == BEGIN + 91 * own.PERIOD_NS + 5_000_000
    assert right.delay_s == pytest.approx(0.005)
    assert (top.frames, top.first_ns, top.bodies) == (0, None, {})
    assert np.isnan(top.rate_hz)
    assert [(topic.topic, topic.names) for topic in found.joints] == [("/robot/joints", ("a", "b"))]
    assert {topic.name: topic.messages for topic in found.topics}["/camera/right/skeleton"] == 257
    assert found.defects["gaps_left"] == 1
    extrinsics, silent, base = found.missing
    assert tells(extrinsics, "left", "hrcreplay calibrate", "--cell")
    assert tells(silent, "frames", "top")
    assert tells(base, "base", "--cell")
    assert found.span_s == pytest.approx((599 * own.PERIOD_NS + 5_000_000) / 1e9)  # from the first joint state


def test_lines_tell_it_all(tmp_path: Path) -> None:
    text = lines(summarize(open_log(session(tmp_path / "a.mcap"))))
    assert "kind     hrcreplay" in text
    assert "  /camera/left/skeleton        270  hrcreplay.Skeleton" in text
    assert tells(text, "left: 270 frames", "15.00 Hz", "0.005 to 19.938 s", "gap 2.067 s", "delay 5.0 ms", "bodies 7")
    assert tells(text, "right: 255 frames", "bodies 7, 11", "in the log")
    assert "  top: no frames" in text
    assert any(line.startswith("  /robot/joints: a, b; ") for line in text)
    assert "  gaps_left  1" in text
    assert not any("frames_left" in line for line in text)  # a count, but no defect
    assert tells(text, "camera top", "never")
    assert all("\n" not in line for line in text)


def test_what_can_be_asked_of_the_robot_as_recorded_is_told(tmp_path: Path) -> None:
    log = session(tmp_path / "a.mcap")
    (line,) = (line for line in lines(summarize(open_log(log), axes=("a", "b"))) if line.startswith("recorded"))
    assert tells([line], "by 2 joints", "report and compare", "as it ran", "of its motion")
    assert not any(line.startswith("recorded") for line in lines(summarize(open_log(log), axes=("a", "c"))))


def test_log_without_skeletons_is_described() -> None:
    found = summarize(open_log(data_path("ros_bags/example.bag"), skeletons=False))
    assert found.kind == "ros1"
    assert {t.name: (t.type, t.messages) for t in found.topics}["/tf"] == ("tf/tfMessage", 2688)
    assert found.span_s == pytest.approx(21.7, abs=0.05)
    assert tells(found.missing[0], "skeletons", "no setting")
    text = lines(found)
    assert "  none" in text
    assert "defects  none" in text


def test_sara_bag() -> None:
    index = {"shoulder_l": 0, "elbow_l": 1, "head": 6, "pelvis": 9}
    decoder = Decoder(topic="/SaRA_demo_human_capsules", camera="mocap", points="positions", index=index)
    path = data_path("sara_human_robot_bags/exp_box.bag")
    found = summarize(open_log(path, Logs(decoders=(decoder,))))
    [camera] = found.cameras
    assert (camera.frames, camera.bodies) == (1055, {0: 1055})
    assert found.defects["frames_repeated"] == 1
    assert camera.rate_hz == pytest.approx(60.0, abs=0.5)
    assert camera.longest_gap_s < 0.034  # where a frame repeats
    assert found.defects["frames_header_stamp_zero"] == 1056
    assert tells(found.notes, "stamps", "zero", "arrival")
