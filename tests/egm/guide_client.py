"""A guide made of another EGM client: ``guide_client.py LIBRARY PORT SECONDS`` sways axis 1, prints its answers.

It goes on until its standard input is closed and nothing more comes.

In a process of its own: two schemas of the same name cannot live in one.
"""

from __future__ import annotations

import importlib
import math
import select
import sys
import time

import numpy as np

SWAY_DEG = 5.0


def main(library: str, port: int, seconds: float) -> None:
    client = importlib.import_module(library).EGM(port=port)
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    begun_s, start, answers = 0.0, np.zeros(6), 0
    while True:
        over = select.select([sys.stdin], [], [], 0.0)[0]
        heard, state = client.receive_from_robot(timeout=0.5)
        if not heard:
            if over:
                break
            continue
        if not answers:
            begun_s, start = time.monotonic(), np.array(state.joint_angles)
        phase = math.pi * (time.monotonic() - begun_s) / seconds
        sway, speed = np.eye(6)[0] * SWAY_DEG * np.array([[1 - math.cos(phase)], [math.sin(phase) * math.pi / seconds]])
        assert client.send_to_robot(start + sway, speed_ref=speed)
        answers += 1
    sys.stdout.write(f"{answers}\n")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))
