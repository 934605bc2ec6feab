"""Every kernel compiled and every library loaded before the robot waits for an answer."""

from __future__ import annotations

from typing import Any

import numpy as np

from hrcreplay.egm.codec import Mci, Motors, Rapid, RobotPacket, encode_robot
from hrcreplay.human.model import skeleton
from hrcreplay.live import wire
from hrcreplay.live.records import Signal, TickEvent
from hrcreplay.live.setup import build
from hrcreplay.logs import skeleton_pb2
from hrcreplay.records import Floats

_TICKS = 400
_TICK_NS = 4_032_000
_FRAME_EVERY = 8

#: Lengths of somebody, in the order of LENGTHS [m].
_LENGTHS_M = np.array([[0.94, 0.50, 0.20, 0.18, 0.36, 0.36, 0.29, 0.29]])


def warm(start: dict[str, Any]) -> None:
    """Runs a session of a second and a half with somebody who walks up to the robot."""
    pilot = build({**start, "sending": False})
    camera, T = next(iter(start["cameras"].items()))
    to_camera = np.linalg.inv(np.array(T))
    base = np.array(start["T_world_base"])[:3, 3]
    q = pilot.setup.programme.q0
    for tick in range(_TICKS):
        t_ns = 10**18 + tick * _TICK_NS
        packet = RobotPacket(tick, tick * 4, t_ns, q, q, Motors.ON, Mci.RUNNING, Rapid.RUNNING, False, 0.0)
        event = TickEvent(t_ns, (encode_robot(packet),), Signal.NONE)
        answer = pilot.answer(event)
        wire.answer(answer, Signal.NONE, 1, 0)
        away_m = 2.0 - 1.6 * tick / _TICKS
        seen = [] if tick % _FRAME_EVERY else [_seen(camera, to_camera, base + np.array([away_m, 0.0, 0.0]), t_ns)]
        sight = pilot.look(t_ns + 1_000_000, seen)
        if pilot.fault is not None:
            raise pilot.fault
        if sight is not None:
            wire.look(sight.states, sight.volumes, len(seen))
            wire.whole(sight.volumes)


def _seen(camera: str, to_camera: Floats, place_m: Floats, t_ns: int) -> bytes:
    """Somebody at a place, arms half bent."""
    joints = np.array([[place_m[0], place_m[1], np.pi, 0.1, 0.1, 0.5, 0.0, 1.8, 0.1, 0.5, 0.0, 1.8]])
    points = skeleton(joints, _LENGTHS_M)[0] @ to_camera[:3, :3].T + to_camera[:3, 3]
    message = skeleton_pb2.Skeleton(capture_ns=t_ns, camera=camera, body=1)
    message.points.extend(points.ravel().tolist())
    message.confidence.extend(np.isfinite(points[:, 0]).astype(float).tolist())
    data: bytes = message.SerializeToString()
    return data
