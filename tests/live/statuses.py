"""Statuses of sessions for the tests."""

from __future__ import annotations

from typing import Any

from hrcreplay.live.view.status import CameraStatus, Latency, RecorderStatus, Status


def status(**change: Any) -> Status:
    """A status with some fields changed."""
    values: dict[str, Any] = {
        "t_s": 83.49,
        "phase": "following",
        "sending": True,
        "robot": "192.168.125.1:6511",
        "rate_hz": 248.04,
        "latency_us": Latency(p50=412.0, p99=803.0, p99_9=1190.0),
        "distance_m": 0.4234,
        "limb": "LRA",
        "link": "forearm",
        "tcp_speed": 0.512,
        "status": "limited",
        "reason": "",
        "cameras": [
            CameraStatus(name="kinect", age_s=0.042, rate_hz=30.0),
            CameraStatus(name="[x]tion", age_s=None, rate_hz=0.0),
        ],
        "stops": {},
        "recorder": RecorderStatus(alive=True, dropped=0),
        "outlook": "",
        "note": "",
    }
    return Status(**(values | change))  # type: ignore[typeddict-item]
