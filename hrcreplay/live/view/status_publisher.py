"""Sends the status of the control loop to the screen process, ten times a second."""

from __future__ import annotations

import json
import math
from collections import Counter
from typing import Any

from hrcreplay.human.model import skeleton
from hrcreplay.live.control.loop import Loop
from hrcreplay.live.record.codec import PHASES
from hrcreplay.live.view import status_messages
from hrcreplay.live.view.status_messages import CameraStatus, Latency, Status
from hrcreplay.records import STATUSES

_EVERY_NS = 100_000_000
_SECOND_NS = 1_000_000_000


class StatusPublisher:
    """Sends status and scene to the screen process; does nothing between two messages."""

    def __init__(self, loop: Loop, names: dict[str, Any], *, in_3d: bool) -> None:
        self._loop = loop
        self._names = names
        self._scene = in_3d
        self._told_ns = 0
        self._counted_ns = 0
        self._counted: Counter[str] = Counter()
        self._rates: dict[str, float] = {}
        if in_3d:
            radii = [segment.radius_m for segment in loop.controller.setup.robot.segments]
            cast = status_messages.SceneNames(limbs=names["limbs"], links=names["links"], radii_m=radii)
            self._send(b"J" + json.dumps(cast).encode())

    def publish(self, *, last: bool = False) -> None:
        """Sends the status where it is due."""
        now_ns = self._loop.now_ns()
        if now_ns - self._told_ns < _EVERY_NS and not last:
            return
        self._told_ns = now_ns
        self._count(now_ns)
        self._send(b"S" + json.dumps(self._status(now_ns)).encode())
        if self._scene:
            self._show()

    def _send(self, message: bytes) -> None:
        if self._loop.screen is not None:
            self._loop.screen.send(message)

    def _show(self) -> None:
        """The person, the volumes and the robot, for whoever draws them."""
        perception, answer, volumes = self._loop.controller.perception, self._loop.last, self._loop.stored
        if perception is None or answer is None or answer.row is None or volumes is None:
            return
        points = skeleton(perception.states.p, perception.states.lengths_m)[0]
        pose = self._loop.controller.setup.robot.pose(answer.row.q, answer.row.dq)
        self._send(b"P" + status_messages.pack(perception.t_ns, points, pose.ends_m, volumes))

    def _count(self, now_ns: int) -> None:
        """Rates of the last second."""
        passed_ns = now_ns - self._counted_ns
        if passed_ns < _SECOND_NS:
            return
        counts = self._loop.controller.observer.counts
        now = Counter({name: counts[f"frames_{name}"] for name in self._names["cameras"]})
        now[""] = self._loop.answers
        if self._counted_ns:
            self._rates = {name: (now[name] - self._counted[name]) * _SECOND_NS / passed_ns for name in now}
        self._counted_ns, self._counted = now_ns, now

    def _status(self, now_ns: int) -> Status:
        loop, controller = self._loop, self._loop.controller
        found = loop.reply_times.quantiles_us(0.5, 0.99, 0.999)
        answer = loop.last
        row = None if answer is None else answer.row
        return Status(
            t_s=(now_ns - loop.start_ns) / 1e9,
            phase=PHASES[controller.phase],
            sending=loop.settings.sending,
            robot=loop.robot,
            rate_hz=self._rates.get("", 0.0),
            latency_us=None if found is None else Latency(p50=found[0], p99=found[1], p99_9=found[2]),
            distance_m=None if row is None else _known(row.distance_m),
            limb=None if answer is None or answer.limb < 0 else self._names["limbs"][answer.limb],
            link=None if answer is None or answer.link < 0 else self._names["links"][answer.link],
            tcp_speed=None if row is None else _known(row.tcp_speed),
            status=None if row is None or answer is None or not controller.connected else STATUSES[answer.status],
            reason=controller.stop or controller.waiting or ("" if answer is None else answer.reason),
            cameras=[self._camera(name, now_ns) for name in self._names["cameras"]],
            stops=dict(Counter(reason for _, reason in controller.stops)),
            recorder={"alive": loop.recorder.alive, "dropped": loop.recorder.dropped},
            note=loop.notes[-1] if loop.notes else "",
        )

    def _camera(self, name: str, now_ns: int) -> CameraStatus:
        newest_ns = self._loop.controller.observer.newest_ns.get(name)
        age_s = None if newest_ns is None else (now_ns - newest_ns) / 1e9
        return CameraStatus(name=name, age_s=age_s, rate_hz=self._rates.get(name, 0.0))


def _known(number: float) -> float | None:
    return number if math.isfinite(number) else None
