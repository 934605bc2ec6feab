"""A session made up for tests: a small deterministic controller, and the messages that control would record of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hrcreplay.egm import motion_link_pb2 as egm
from hrcreplay.live.record import codec
from hrcreplay.live.record.codec import Decision, Perception, Signal, TickEvent
from hrcreplay.live.record.recorder import SessionLogWriter
from hrcreplay.logs import skeleton_pb2 as pb
from hrcreplay.records import DOF, LENGTHS, LIMBS, HumanStates, MotionRow, SweptVolumes
from hrcreplay.robot.control.separation import obstacles

START_NS = 1_700_000_000_000_000_000
TICK_NS = 4_032_000
START: dict[str, Any] = {
    "what": "start",
    "cameras": {"left": np.eye(4).tolist(), "right": None},
    "T_world_base": np.diag([1.0, 1.0, 1.0, 1.0]).tolist(),
    "task": {"name": "pick", "waypoints": []},
    "gain": 0.1,
}


class MadeController:
    """Sums up what it is told, so that whatever changes in it changes all that follows."""

    def __init__(self, start: dict[str, Any]) -> None:
        self.gain = start["gain"]
        self.p = np.zeros(DOF)
        self.q = np.zeros(6)
        self.looked_ns = 0
        self.silences = 0

    def update_perception(self, t_ns: int, skeletons: Sequence[bytes]) -> Perception:
        """Every point of every skeleton moves the person."""
        for data in skeletons:
            self.p += self.gain * np.array(pb.Skeleton.FromString(data).points)[:DOF]
        self.looked_ns = t_ns
        row = {name: np.full((1, DOF), 0.5) for name in ("v", "a", "j", "p_std", "v_std")}
        states = HumanStates(
            t_ns=np.array([t_ns]),
            p=self.p[None].copy(),
            **row,
            lengths_m=np.full((1, len(LENGTHS)), 0.4),
            lengths_std_m=np.full((1, len(LENGTHS)), np.nan),
            valid=np.array([[bool(skeletons), False]]),
            residual_m=np.full((1, 7), np.nan),
            unseen_s=np.full((1, 7), np.inf),
            frame_age_s=np.full(1, np.inf),
            points_m=np.full((1, 20, 3), np.nan),
            cameras=("left", "right"),
            camera_points_m=np.full((1, 2, 20, 3), np.nan),
        )
        vertices = np.arange(6 * 4 * 3).reshape(-1, 3) + np.tanh(self.p[0])
        offsets = np.arange(0, 4 * len(LIMBS) + 1, 4)
        volumes = SweptVolumes(np.array([t_ns]), offsets, vertices, np.full((1, 6), 0.1), LIMBS, "positions")
        return Perception(t_ns, states, volumes, (obstacles(volumes, 0),), 0.1)

    def answer(self, event: TickEvent) -> Decision:
        """Every byte of every datagram moves the robot."""
        self.q += 1e-6 * sum(sum(data) for data in event.datagrams) + 1e-9 * self.p[:6] + 1e-4 * self.silences
        numbers = (self.q * 10).tolist()
        reply = egm.SensorMessage(planned=egm.Planned(joints=egm.Joints(joints=numbers))).SerializeToString()
        row = MotionRow(
            q=self.q.copy(),
            dq=self.q / 2,
            u=self.q / 3,
            ref_m=self.q[:3],
            tcp_m=self.q[3:],
            **dict.fromkeys(("tcp_speed", "ref_speed", "programme_s", "distance_m", "overlap_m"), 0.25),
            limb=1,
            link=-1,
            status=2 if Signal.INTERRUPT in event.signals else 0,
            reason="Ctrl-C" if Signal.INTERRUPT in event.signals else "",
            horizon_s=0.25,
            tau_s=0.25,
            certified=True,
        )
        return Decision(event.t_ns, self.looked_ns, reply, codec.FOLLOWING, self.q - 0.01, row, "", None)

    def silence(self, t_ns: int, signals: Signal) -> None:  # noqa: ARG002 - part of what a controller is
        """A silence moves the robot too."""
        self.silences += 1


def skeleton(number: int, camera: str = "left") -> bytes:
    """A skeleton as the human side sends it."""
    points = np.random.default_rng(number).normal(size=60).round(3).tolist()
    message = pb.Skeleton(
        capture_ns=START_NS + number * TICK_NS - 20_000_000, camera=camera, points=points, confidence=[1.0] * 20
    )
    return message.SerializeToString()


def datagram(number: int) -> bytes:
    """A packet of the robot, as far as this controller cares."""
    return egm.RobotMessage(header=egm.Header(seqno=number, tm=4 * number)).SerializeToString()


def session(ticks: int, *, controller: MadeController | None = None) -> Iterator[bytes]:
    """What control records: garbage and a skeleton of nobody among it, a silence, a Ctrl-C near the end."""
    yield codec.encode_event(START_NS, START)
    controller = controller or MadeController(START)
    for k in range(ticks):
        t_ns = START_NS + (k + 1) * TICK_NS
        if k == ticks // 2:
            yield codec.encode_timeout(t_ns - 1000, Signal.PERSON_LATE)
            controller.silence(t_ns - 1000, Signal.PERSON_LATE)
        datagrams = (b"\xff garbage", b"", datagram(k)) if k % 7 == 3 else (datagram(k),)
        signals = Signal.INTERRUPT if k == ticks - 2 else Signal(0)
        yield from (codec.encode_robot_packet(t_ns, data) for data in datagrams)
        answer = controller.answer(TickEvent(t_ns, datagrams, signals))
        yield codec.encode_decision(answer, signals, len(datagrams), 300 + k % 50)
        if answer.datagram is not None:
            yield codec.encode_reply(t_ns, answer.datagram, sent=k > 2)
        skeletons = [skeleton(k, ("left", "right")[k % 2]), skeleton(k, "nobody's")] if k % 5 == 0 else []
        look_ns = t_ns + 500_000
        yield from (codec.encode_skeleton(look_ns, data) for data in skeletons)
        perception = controller.update_perception(look_ns, skeletons)
        yield codec.encode_perception(perception, len(skeletons))
        if k % 10 == 0:
            yield codec.encode_volumes(perception)
    yield codec.encode_event(START_NS + (ticks + 2) * TICK_NS, {"what": "end", "reason": "Ctrl-C"})


def record(path: Path, messages: list[bytes], *, chunk: int = 100, finish: bool = True) -> Path:
    """The log that the recorder makes of them, with so many messages a chunk."""
    with path.open("xb") as stream:
        writer = SessionLogWriter(stream)
        for first in range(0, len(messages), chunk):
            for message in messages[first : first + chunk]:
                writer.add(message)
            writer.flush()
        if finish:
            writer.finish()
    return path
