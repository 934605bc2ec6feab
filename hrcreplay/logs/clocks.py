"""Capture times of one camera, judged by the arrivals of its frames.

A stamp is accepted unless it is impossible: after the arrival, further from it than any delay, or from a clock that was
set back or stands still. Such a stamp is replaced by the arrival less the camera's usual delay.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Hashable, Iterator
from datetime import UTC, datetime
from statistics import median

import numpy as np

#: Maximum time between capture and arrival of a valid stamp [s].
STAMP_FAR_S = 10.0
#: A larger change of the delay is reported as a jump of the clock, and a larger median delay as a late camera [s].
JUMP_S = 0.1
LATE_S = 0.3

_FAR_NS, _JUMP_NS = round(STAMP_FAR_S * 1e9), round(JUMP_S * 1e9)
_SAME_NS = 10_000_000  # rows with the same stamp that arrive within this time are the bodies of one frame
_USUAL, _LEAST = 31, 5  # number of the latest accepted frames for the usual (median) delay, and its minimum
_RUN = 3  # number of consecutive frames without newer stamps that indicates a clock error, not a late frame
_STILL_NS = 500_000_000  # or duration of such frames
_SETTLED = 5  # number of frames of similar delay that confirm a jump
_FEW = 5  # number of frames out of order without a remark, and share with one
_MUCH = 0.02
_MIXED_NS = 1_000_000_000  # messages further apart than this are in order in every file
_YOUNG_NS = 10**17  # a stamp before 1973 counts from the start of a simulation or of a computer


class CameraClock:
    """The clock of one camera: takes its rows in order of arrival and returns their capture times."""

    def __init__(self) -> None:
        self.frames = 0
        self.replaced: Counter[str] = Counter()  #: reason to reject a stamp ("ahead", "far", "set back") -> frames
        self.jumps: list[tuple[int, float]] = []  #: the first few jumps: arrival [ns] and change of the delay [s]
        self.jump_count = 0
        self.far_ns: tuple[int, int] | None = None  #: smallest and largest stamp far from its arrival
        self._delays_ms: Counter[int] = Counter()
        self._believed: deque[int] = deque(maxlen=_USUAL)
        self._recent: deque[tuple[int, int]] = deque(maxlen=_SETTLED)
        self._level_ns: int | None = None
        self._newest_ns: int | None = None  # stamp of the newest frame on the present clock
        self._run: list[tuple[int, int]] = []  # arrivals and stamps of frames that are not newer
        self._set_back = False
        self._last = (0, -_FAR_NS, 0)  # stamp, first arrival and capture of the frame before

    @property
    def usual_ns(self) -> int:
        """The usual delay of the latest frames with an accepted stamp; 0 while they are few [ns]."""
        return int(median(self._believed)) if len(self._believed) >= _LEAST else 0

    def capture_ns(self, stamp_ns: int, arrival_ns: int) -> int:
        """Returns the capture time of a row."""
        last_ns, first_ns, capture_ns = self._last
        if stamp_ns == last_ns and arrival_ns - first_ns <= _SAME_NS:
            return capture_ns  # another body of the same frame
        self.frames += 1
        why = self._doubt(stamp_ns, arrival_ns)
        if why:
            self.replaced[why] += 1
            capture_ns = max(arrival_ns - self.usual_ns, min(capture_ns + 1, arrival_ns))
        else:
            capture_ns = stamp_ns
        self._last = (stamp_ns, arrival_ns, capture_ns)
        return capture_ns

    def _doubt(self, stamp_ns: int, arrival_ns: int) -> str:
        """Returns the reason to reject a stamp; empty if it is accepted."""
        delay_ns = arrival_ns - stamp_ns
        if abs(delay_ns) > _FAR_NS:
            low, high = self.far_ns or (stamp_ns, stamp_ns)
            self.far_ns = (min(low, stamp_ns), max(high, stamp_ns))
            return "far"
        self._note_delay(delay_ns, arrival_ns)
        if delay_ns < 0:
            return "ahead"
        if self._newest_ns is not None and stamp_ns <= self._newest_ns:
            self._run.append((arrival_ns, stamp_ns))
            if not self._clock_changed():
                return "set back" if self._set_back else ""
            self._set_back = True
        self._run.clear()
        self._newest_ns = stamp_ns
        if self._set_back:
            self._set_back = abs(delay_ns - self.usual_ns) > _JUMP_NS
        if self._set_back:
            return "set back"
        self._believed.append(delay_ns)
        return ""

    def _clock_changed(self) -> bool:
        """Returns True if the frames without newer stamps indicate a clock that was set back or stands still.

        Delayed frames arrive all at once, or between others.
        """
        if any(later < before for (_, before), (_, later) in zip(self._run, self._run[1:], strict=False)):
            del self._run[:-1]
        (first_ns, begin_ns), (last_ns, end_ns) = self._run[0], self._run[-1]
        arrived_ns, passed_ns = last_ns - first_ns, end_ns - begin_ns
        steady = len(self._run) >= _RUN and arrived_ns <= 2 * passed_ns <= 4 * arrived_ns and passed_ns > 0
        return steady or arrived_ns > _STILL_NS

    def _note_delay(self, delay_ns: int, arrival_ns: int) -> None:
        self._delays_ms[round(delay_ns / 1e6)] += 1
        self._recent.append((arrival_ns, delay_ns))
        delays = [delay for _, delay in self._recent]
        if len(delays) < _SETTLED or max(delays) - min(delays) > _JUMP_NS:
            return
        now_ns = int(median(delays))
        if self._level_ns is not None and abs(now_ns - self._level_ns) > _JUMP_NS:
            self.jump_count += 1
            if len(self.jumps) < 3:
                self.jumps.append((self._recent[0][0], (now_ns - self._level_ns) / 1e9))
        self._level_ns = now_ns

    def delay_s(self, *percent: float) -> tuple[float, ...]:
        """Returns percentiles of arrival minus stamp, to a millisecond; NaN without a stamp near its arrival [s].

        Args:
            *percent: Percentiles, in [0, 100].
        """
        if not self._delays_ms:
            return tuple(float("nan") for _ in percent)
        delays, counts = zip(*sorted(self._delays_ms.items()), strict=True)
        reached = np.cumsum(counts)
        index = [int(np.searchsorted(reached, p / 100.0 * reached[-1])) for p in percent]
        return tuple(delays[min(i, len(delays) - 1)] / 1e3 for i in index)


class ArrivalOrder:
    """Checks the order of a body's messages in the file: if a recorder's clock is set back, times are mixed.

    Bodies, topics and files may have been written one after the other; each is checked separately.
    """

    def __init__(self) -> None:
        self._waiting: dict[Hashable, deque[tuple[int, int]]] = {}  # arrival and position of the last second
        self._furthest: dict[Hashable, int] = {}  # the largest earlier position
        self._mixed: list[int] = []  # first and last arrival of messages that precede earlier ones in their file
        self._count = 0

    def add(self, body: Hashable, arrival_ns: int, position: int) -> None:
        """Adds a message of a body, in order of arrival."""
        waiting = self._waiting.setdefault(body, deque())
        while waiting and arrival_ns - waiting[0][0] > _MIXED_NS:
            self._furthest[body] = max(self._furthest.get(body, 0), waiting.popleft()[1])
        if position < self._furthest.get(body, 0):
            self._count += 1
            self._mixed = [*self._mixed[:1], arrival_ns]
        waiting.append((arrival_ns, position))

    def remarks(self, start_ns: int) -> Iterator[str]:
        """Returns remarks on wrong orders, with their times; ``start_ns`` is the start of the log [ns]."""
        if self._count < _FEW:
            return
        begin_s = (self._mixed[0] - _MIXED_NS - start_ns) / 1e9
        end_s = (self._mixed[-1] - start_ns) / 1e9
        yield (
            f"the recorder's clock was set back by about {end_s - begin_s:.1f} s: in the order of the file arrivals "
            f"step back, and between {begin_s:.1f} and {end_s:.1f} s frames of two times are mixed; would be right: a "
            f"span without them (--end {max(begin_s, 0.0):.1f} or --start {end_s:.1f}), or a recording whose clock was "
            "set before"
        )


def clock_remarks(camera: str, clock: CameraClock, begin_ns: int, late: int) -> Iterator[str]:
    """Returns notes on wrong stamps of a camera; none for a plausible clock.

    Args:
        camera: Name of the camera.
        clock: Its clock after the last of its rows.
        begin_ns: Start of the log [ns].
        late: Number of rows dropped because they were captured before an earlier delivered one.
    """
    usual = f"arrival less the usual delay ({clock.usual_ns / 1e6:.0f} ms) used" if clock.usual_ns else "arrival used"
    far, ahead, back = (clock.replaced[why] for why in ("far", "ahead", "set back"))
    if far and clock.far_ns is not None:
        yield (
            f"camera {camera}: {far} frames have a stamp over {STAMP_FAR_S:g} s from their arrival "
            f"({_epoch(*clock.far_ns)}); {usual}"
        )
    found = []
    if ahead:
        (least_s,) = clock.delay_s(0.0)
        found.append(f"{ahead} of {clock.frames} frames are stamped after their arrival, by up to {-least_s:.3f} s")
    if back:
        found.append(f"{back} of {clock.frames} frames have stamps of a clock that was set back or stands still")
    if clock.jumps:
        steps = ", ".join(f"{-s:+.2f} s at {(t_ns - begin_ns) / 1e9:.2f} s" for t_ns, s in clock.jumps)
        more = f" and {clock.jump_count - len(clock.jumps)} times more" if clock.jump_count > len(clock.jumps) else ""
        found.append(f"its clock jumps against the recorder's: {steps}{more}")
    if found:
        yield (
            f"camera {camera}: {'; '.join(found)}; {usual + '; ' if ahead or back else ''}would be right: the clocks "
            "of camera and recorder set (NTP, PTP) before recording"
        )
    if late > _FEW and late > _MUCH * clock.frames:
        yield f"camera {camera}: {late} rows were captured before an earlier delivered one; dropped"


def late_remark(camera: str, clock: CameraClock, offset_s: float) -> str | None:
    """Returns a note on a camera whose frames arrive long after their capture; None if most do not.

    Args:
        camera: Name of the camera.
        clock: Its clock after the last of its rows.
        offset_s: Its clock minus the reference camera's, from the cell [s].
    """
    (median_s,) = clock.delay_s(50.0)
    return f"camera {camera}: {delay_text(clock, offset_s)}" if median_s + offset_s > LATE_S else None


def delay_text(clock: CameraClock, offset_s: float) -> str:
    """Describes the delay from capture to arrival of a camera's frames, its likely cause, and the remedy."""
    median_s, p95_s, least_s, most_s = (s + offset_s for s in clock.delay_s(50.0, 95.0, 0.0, 100.0))
    return (
        f"its frames come {median_s:.2f} s after their capture by their stamps (median; 95 % within {p95_s:.2f} s, "
        f"range {least_s:.2f} to {most_s:.2f} s): the camera is late, or its clock behind; would be right: at most "
        "fusion.fresh_s; hrcreplay calibrate finds clock_offset_s for a clock that is behind"
    )


def _epoch(low_ns: int, high_ns: int) -> str:
    """Describes the likely clock of stamps."""
    if 0 <= high_ns < _YOUNG_NS:
        return f"{low_ns / 1e9:.2f} to {high_ns / 1e9:.2f} s: the time of a simulation, or since a computer started"
    try:
        return f"from {datetime.fromtimestamp(low_ns / 1e9, tz=UTC):%Y-%m-%d %H:%M:%S} UTC on"
    except (ValueError, OverflowError, OSError):
        return "no date at all"
