"""Stages 1 and 2 of a live session: skeletons in, fused person and swept volumes out, one update at a time.

The bytes that are decoded here are those that are recorded, and they are cleaned as a reader of the log will clean
them. What the process of the person has cleaned before is not enough: the message rounds to 32 bits, by which a
skeleton may become that of the frame before it, and a capture is judged by the session's clock only here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from google.protobuf.message import DecodeError

from hrcreplay.human.fusion import fuse
from hrcreplay.live.record.codec import Perception
from hrcreplay.logs.clean import Cleaner, PersonMemory
from hrcreplay.logs.decoders import own_row
from hrcreplay.logs.messages import Undecodable
from hrcreplay.logs.skeleton_pb2 import Skeleton
from hrcreplay.records import CameraFrames, HumanStates
from hrcreplay.robot.control.separation import Obstacles, obstacles
from hrcreplay.run.prediction import PredictionStage
from hrcreplay.run.stages import NS, FusionStage, no_frames


class Observer:
    """Stages 1 and 2, updated with the skeletons that have come since the update before."""

    def __init__(
        self, fusion_stage: FusionStage, prediction_stage: PredictionStage, cameras: tuple[str, ...], gap_s: float
    ) -> None:
        self._fusion_stage = fusion_stage
        self._prediction_stage = prediction_stage
        self._cameras = cameras
        self._nothing = no_frames(cameras)
        self._fusion = fuse.start(cameras)
        self._memory = PersonMemory()
        self.counts: Counter[str] = Counter()
        self._cleaner = Cleaner(cameras, gap_s, self.counts)
        self.newest_ns: dict[str, int] = {}  #: per camera: when it last took the person, by the reference's clock

    def update_perception(self, t_ns: int, skeletons: Sequence[bytes], horizon_s: float) -> Perception:
        """Fused person and swept volumes at ``t_ns``, which must be later than that of the update before.

        Args:
            t_ns: By the session's clock; the arrival of all skeletons of this update [ns].
            skeletons: Serialised Skeleton messages. What cannot be read is counted and left out.
            horizon_s: Until when the volumes must hold, the latency aside [s].
        """
        frames = self._frames(t_ns, skeletons)
        measured = self._nothing
        if frames is not None:
            self._memory, measured, found = self._fusion_stage.measure(frames, self._memory)
            self.counts.update(found)
            for camera, capture_ns in zip(measured.camera.tolist(), measured.capture_ns.tolist(), strict=True):
                self.newest_ns[self._cameras[camera]] = capture_ns
        ticks = np.array([t_ns])
        self._fusion, states, events, _ = fuse.fuse(
            self._fusion, ticks, measured, self._fusion_stage.filter, self._fusion_stage.limits
        )
        self.counts.update(events)
        volumes = self._prediction_stage.volumes(states, horizon_s)
        return Perception(t_ns, states, volumes, obstacles(volumes, 0, horizon_s), horizon_s)

    def present(self, states: HumanStates) -> Obstacles:
        """Where the person may be now, for ``ssm``, which does not look ahead."""
        return obstacles(self._prediction_stage.volumes(states, 0.0), 0)

    def age_s(self, t_ns: int) -> float:
        """How old the newest frame of the person is; inf before the first [s]."""
        return (t_ns - max(self.newest_ns.values())) / NS if self.newest_ns else float("inf")

    def _frames(self, t_ns: int, skeletons: Sequence[bytes]) -> CameraFrames | None:
        for data in skeletons:
            try:
                skeleton = Skeleton.FromString(data)
                row = own_row(skeleton, skeleton.camera, skeleton.camera)
            except (DecodeError, Undecodable):
                self.counts["skeletons_unreadable"] += 1
                continue
            if row.camera not in self._cameras:
                self.counts["skeletons_of_unknown_cameras"] += 1
                continue
            # a camera whose clock is ahead has seen nothing of the future
            self._cleaner.add(row._replace(capture_ns=min(row.capture_ns or t_ns, t_ns)), t_ns)
        return self._cleaner.flush()
