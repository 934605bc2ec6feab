"""Clocks of cameras that are wrong, and those that are right.

Every log here is a true one, of which what the stamps mean is spoilt: the true captures are known.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.errors import LogError
from hrcreplay.logs.info import lines, summarize
from hrcreplay.logs.reader import Log, open_log
from hrcreplay.records import CameraFrames, Ints
from tests.facts import facts
from tests.logs import own
from tests.logs.test_dirty import changed

PERIOD_NS, DELAY_NS, N = 33_333_333, 40_000_000, 240
HALF = N // 2


def _table(seed: int = 1) -> CameraFrames:
    """One camera at 30 Hz, its frames 30 to 50 ms on the wire."""
    table = own.frames(N, cameras=("one",), seed=seed)
    jitter_ns = np.random.default_rng(seed).integers(-10_000_000, 10_000_000, N)
    arrival_ns = np.maximum.accumulate(table.capture_ns + DELAY_NS + jitter_ns)
    return changed(table, arrival_ns=arrival_ns, points_m=0.17 * table.points_m)  # of a person's size


def _read(tmp_path: Path, table: CameraFrames) -> tuple[Log, CameraFrames]:
    log = open_log(own.write(tmp_path / "log.mcap", table))
    return log, own.read(log)


def _captures(frames: CameraFrames, table: CameraFrames) -> Ints:
    """The true captures of the rows that were delivered, found by their arrivals."""
    return table.capture_ns[np.searchsorted(table.arrival_ns, frames.arrival_ns)]


def _about_clock(log: Log) -> list[str]:
    return [note for note in log.notes if "stamp" in note or "clock" in note or "captured" in note]


def _set_back(stamp_ns: Ints) -> Ints:
    return np.where(np.arange(N) >= HALF, stamp_ns - 3 * 10**9, stamp_ns)


def _set_back_a_little(stamp_ns: Ints) -> Ints:
    return np.where(np.arange(N) >= HALF, stamp_ns - 400_000_000, stamp_ns)


def _set_ahead(stamp_ns: Ints) -> Ints:
    return np.where(np.arange(N) >= HALF, stamp_ns + 2 * 10**9, stamp_ns)


def _set_back_and_right_again(stamp_ns: Ints) -> Ints:
    wrong = (np.arange(N) >= HALF) & (np.arange(N) < HALF + 60)
    return np.where(wrong, stamp_ns - 3 * 10**9, stamp_ns)


def _stands_still(stamp_ns: Ints) -> Ints:
    return np.minimum(stamp_ns, stamp_ns[HALF])


@pytest.mark.parametrize(
    ("spoil", "dropped", "least"),
    [
        (_set_back, 2, HALF - 2),
        (_set_back_a_little, 2, HALF - 2),
        (_set_ahead, 0, HALF),
        (_set_back_and_right_again, 2, 58),
        (_stands_still, 20, HALF - 20),
    ],
)
def test_a_clock_that_jumps_in_mid_recording(
    tmp_path: Path, spoil: Callable[[Ints], Ints], dropped: int, least: int
) -> None:
    """No frames vanish but those it takes to see it, and the rest are where they were captured, to the jitter."""
    table = _table()
    log, frames = _read(tmp_path, changed(table, capture_ns=spoil(table.capture_ns)))
    assert N - dropped <= len(frames) <= N
    off_ns = frames.capture_ns - _captures(frames, table)
    assert np.abs(off_ns).max() <= 25_000_000
    assert (frames.capture_ns <= frames.arrival_ns).all()
    assert (np.diff(frames.capture_ns) > 0).all()
    replaced = sum(log.defects[f"frames_stamp_{why}"] for why in ("ahead", "set_back"))
    assert replaced >= least
    (told,) = _about_clock(log)
    assert f"{replaced} of 240" in told


def test_the_size_and_the_instant_of_a_jump_are_told(tmp_path: Path) -> None:
    table = _table()
    log, _ = _read(tmp_path, changed(table, capture_ns=_set_back(table.capture_ns)))
    (told,) = _about_clock(log)
    size, _, instant = told.partition("recorder's: ")[2].partition(" s at ")
    assert float(size) == pytest.approx(-3.0, abs=0.03)
    assert float(instant.split()[0]) == pytest.approx(HALF * PERIOD_NS / 1e9, abs=0.1)


def test_a_clock_that_is_ahead_of_the_arrivals_all_the_time(tmp_path: Path) -> None:
    """A frame is not from the future: it was captured at its arrival at the latest."""
    table = _table()
    log, frames = _read(tmp_path, changed(table, capture_ns=table.capture_ns + 5 * 10**9))
    assert len(frames) == N
    np.testing.assert_array_equal(frames.capture_ns, frames.arrival_ns)
    (told,) = _about_clock(log)
    assert "camera one" in told
    assert "240 of 240" in told
    assert float(told.partition("by up to ")[2].split()[0]) == pytest.approx(4.97, abs=0.005)


def test_a_clock_of_a_simulation(tmp_path: Path) -> None:
    table = _table()
    log, frames = _read(tmp_path, changed(table, capture_ns=table.capture_ns - own.BEGIN_NS + 12 * 10**9))
    assert len(frames) == N
    np.testing.assert_array_equal(frames.capture_ns, frames.arrival_ns)
    (told,) = _about_clock(log)
    assert "simulation" in told
    assert "12.00 to 19.97 s" in told


def test_a_clock_that_is_behind_is_told_with_its_delay(tmp_path: Path) -> None:
    """Or a camera that is late: the stamps are kept, as who took the frame is believed."""
    table = _table()
    log, frames = _read(tmp_path, changed(table, capture_ns=table.capture_ns - 3 * 10**9))
    np.testing.assert_array_equal(frames.capture_ns, table.capture_ns - 3 * 10**9)
    (told,) = (note for note in summarize(log).notes if "clock_offset_s" in note)
    assert "camera one" in told
    median_s = float(np.median(table.arrival_ns - frames.capture_ns)) / 1e9
    assert float(told.partition("come ")[2].split()[0]) == pytest.approx(median_s, abs=0.006)
    mended = summarize(log, clock_offset_s={"one": -3.0})
    assert not [note for note in mended.notes if "clock_offset_s" in note]


def test_info_tells_the_delays_of_a_camera(tmp_path: Path) -> None:
    table = _table()
    log, _ = _read(tmp_path, table)
    delays_s = (table.arrival_ns - table.capture_ns) / 1e9
    (camera,) = summarize(log).cameras
    assert camera.delay_s == pytest.approx(np.median(delays_s))
    assert camera.delay_p95_s == pytest.approx(np.percentile(delays_s, 95))
    assert camera.delay_range_s == pytest.approx((delays_s.min(), delays_s.max()))
    (line,) = (line for line in lines(summarize(log)) if "one: 240 frames" in line)
    assert f"delay {1e3 * np.median(delays_s):.1f} ms (95 % within {1e3 * np.percentile(delays_s, 95):.1f}" in line


def test_frames_that_overtake_one_another_are_no_jump(tmp_path: Path) -> None:
    """Every tenth frame comes after the two that follow it; a second is held up and comes at once, newest first."""
    table = _table()
    arrival_ns = table.capture_ns + DELAY_NS
    arrival_ns[::10] += int(2.5 * PERIOD_NS)
    arrival_ns[130:160] = arrival_ns[160] - np.arange(1, 31) * 200_000
    order = np.argsort(arrival_ns, kind="stable")
    log, frames = _read(tmp_path, changed(table, arrival_ns=arrival_ns).rows(order))
    assert log.defects["frames_stamp_set_back"] == 0
    assert np.isin(frames.capture_ns, table.capture_ns).all()
    assert log.defects["frames_out_of_order"] == N - len(frames) > 40


def test_nothing_is_told_of_clocks_that_are_right(tmp_path: Path) -> None:
    log, frames = _read(tmp_path, _table())
    np.testing.assert_array_equal(frames.capture_ns, _table().capture_ns)
    assert _about_clock(log) == []


def test_bodies_of_one_frame_keep_one_capture(tmp_path: Path) -> None:
    table = changed(_table(), capture_ns=_set_back(_table().capture_ns))
    other = changed(table, body=np.full(N, 8), points_m=_table(seed=2).points_m)
    both = CameraFrames.join([table, other])
    _, frames = _read(tmp_path, both.rows(np.argsort(both.arrival_ns, kind="stable")))
    mine, theirs = (frames.rows(frames.body == body) for body in (7, 8))
    np.testing.assert_array_equal(mine.capture_ns, theirs.capture_ns)


def _recorder_set_back(table: CameraFrames, by_s: float = 3.0) -> CameraFrames:
    """All that came in the second half, stamps and arrivals, as by a clock that was set back."""
    by_ns = int(by_s * 1e9) * (np.arange(N) >= HALF)
    return changed(table, capture_ns=table.capture_ns - by_ns, arrival_ns=table.arrival_ns - by_ns)


def test_a_recorder_whose_clock_was_set_back_is_refused_where_it_mixes_two_times(tmp_path: Path) -> None:
    """4 s in order, then 4 s that begin again at 1 s: what is between 1 and 4 s is of two times."""
    table = _table()
    log, _ = _read(tmp_path, _recorder_set_back(table))
    with pytest.raises(LogError, match=facts("recorder's clock", "--start", "--end")) as refusal:
        log.check()
    begin_s, end_s = (float(part) for part in re.findall(r"--(?:end|start) ([\d.]+)", str(refusal.value)))
    assert begin_s == pytest.approx(1.0, abs=0.1)
    assert end_s == pytest.approx(4.0, abs=0.1)
    first_ns = log.header.start_ns
    for window in ({"end_ns": first_ns + int(begin_s * 1e9)}, {"start_ns": first_ns + int((end_s + 0.1) * 1e9)}):
        captures = own.read(log, **window).capture_ns
        log.check()
        assert len(captures) >= 25
        assert (np.diff(captures) > 0).all()


@pytest.mark.parametrize("by_s", [0.2, 0.0])
def test_a_recorder_that_writes_a_little_out_of_order_is_no_fault(tmp_path: Path, by_s: float) -> None:
    log, _ = _read(tmp_path, _recorder_set_back(_table(), by_s))
    log.check()


def test_bodies_written_one_after_the_other_are_no_fault(tmp_path: Path) -> None:
    table = _table()
    other = changed(table, body=np.full(N, 8), points_m=_table(seed=2).points_m)
    log, frames = _read(tmp_path, CameraFrames.join([table, other]))
    log.check()
    assert len(frames) == 2 * N
