"""A short stretch of the demo log that can be spoilt in any way, and written as a log all the same."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message
from mcap.writer import CompressionType, Writer

from hrcreplay.logs import messages
from hrcreplay.logs import skeleton_pb2 as pb
from hrcreplay.logs.reader import open_log
from hrcreplay.records import CameraFrames, Floats

DEMO = Path(__file__).parents[3] / "datasets" / "demo.mcap"
CAMERAS = ("kinect", "xtion")


@dataclass
class Frame:
    """A body in a frame, as a message has it: the numbers may be too many or too few."""

    arrival_ns: int
    capture_ns: int
    camera: str
    body: int
    points_m: Floats  #: (20, 3) and anything else
    confidence: Floats  #: (20,) and anything else
    payload: bytes | None = None  #: instead of a message


@dataclass
class Joints:
    """A joint state of the robot."""

    t_ns: int
    names: list[str]
    q: list[float]


@dataclass
class Clip:
    """What a log is made of."""

    frames: list[Frame]
    poses: dict[str, list[float]]  #: of the cameras, row-major; empty where there is none
    base: list[float] | None
    task: str | None
    joints: list[Joints] = field(default_factory=list)
    truth: list[tuple[int, Floats]] = field(default_factory=list)
    encoding: str = "protobuf"
    schema: str = "hrcreplay.Skeleton"  #: what the skeletons' topics say of their type
    schema_bytes: bytes | None = None
    indexed: bool = True
    whole: bool = True  #: no for a file that breaks off without its end
    cut: list[tuple[str, float, int]] = field(default_factory=list)  #: what happens to the file's bytes, in this order
    touched: set[str] = field(default_factory=set)  #: cameras of which something was spoilt
    told: list[str] = field(default_factory=list)  #: what was done


@cache
def _demo() -> tuple[CameraFrames, dict[str, list[float]], list[float], str, int]:
    log = open_log(DEMO)
    header = log.header
    assert header.T_world_base is not None
    poses = {name: header.T_world_camera[name].ravel().tolist() for name in header.cameras}
    frames = CameraFrames.join(list(log.frames()))
    return frames, poses, header.T_world_base.ravel().tolist(), json.dumps(header.task), header.start_ns


def clip(start_s: float, length_s: float) -> Clip:
    """A stretch of the demo log as it is."""
    frames, poses, base, task, first_ns = _demo()
    begin_ns = first_ns + round(start_s * 1e9)
    which = (frames.arrival_ns >= begin_ns) & (frames.arrival_ns < begin_ns + round(length_s * 1e9))
    rows = frames.rows(which)
    made = [
        Frame(
            int(rows.arrival_ns[i]),
            int(rows.capture_ns[i]),
            rows.cameras[rows.camera[i]],
            int(rows.body[i]),
            rows.points_m[i].copy(),
            rows.confidence[i].copy(),
        )
        for i in range(len(rows))
    ]
    return Clip(made, {name: list(pose) for name, pose in poses.items()}, list(base), task)


def write(made: Clip, path: Path) -> Path:
    """The log of a clip."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=4096, compression=CompressionType.ZSTD, use_chunking=made.indexed)
        writer.start(profile=messages.PROFILE, library="hrcreplay")
        _fill(_Channels(writer), made)
        if made.whole:
            writer.finish()  # type: ignore[no-untyped-call]
    data = path.read_bytes()
    for what, where, number in made.cut:
        data = _cut(data, what, int(where * len(data)), number)
    path.write_bytes(data)
    return path


class _Channels:
    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._known: dict[str, int] = {}

    def add(self, topic: str, message: Message, t_ns: int, publish_ns: int, made: Clip, payload: bytes | None) -> None:
        if topic not in self._known:
            name = message.DESCRIPTOR.full_name
            files = FileDescriptorSet()
            message.DESCRIPTOR.file.CopyToProto(files.file.add())
            schema, encoding = files.SerializeToString(deterministic=True), "protobuf"
            if isinstance(message, pb.Skeleton):
                name, encoding = made.schema, made.encoding
                schema = schema if made.schema_bytes is None else made.schema_bytes
            number = self._writer.register_schema(name, "protobuf", schema)
            self._known[topic] = self._writer.register_channel(topic, encoding, number)
        data = message.SerializeToString(deterministic=True) if payload is None else payload
        self._writer.add_message(self._known[topic], log_time=t_ns, publish_time=publish_ns, data=data)


def _fill(channels: _Channels, made: Clip) -> None:
    first_ns = max(0, min((frame.arrival_ns for frame in made.frames), default=0))
    for name, pose in made.poses.items():
        camera = pb.Camera(camera=name, T_world_camera=pose)
        channels.add(messages.camera_info_topic(name), camera, first_ns, first_ns, made, None)
    if made.task is not None:
        channels.add(messages.TASK, pb.Task(json=made.task), first_ns, first_ns, made, None)
    if made.base is not None:
        channels.add(messages.BASE, pb.Base(T_world_base=made.base), first_ns, first_ns, made, None)
    for state in made.joints:
        message = pb.JointState(t_ns=state.t_ns, names=state.names, q=state.q)
        channels.add(messages.JOINTS, message, max(0, state.t_ns), max(0, state.t_ns), made, None)
    for t_ns, points in made.truth:
        channels.add(messages.TRUTH, pb.Truth(t_ns=t_ns, points=points.ravel().tolist()), t_ns, t_ns, made, None)
    for frame in made.frames:
        skeleton = pb.Skeleton(
            capture_ns=frame.capture_ns,
            camera=frame.camera,
            body=frame.body,
            points=np.asarray(frame.points_m).ravel().tolist(),
            confidence=np.asarray(frame.confidence).ravel().tolist(),
        )
        stamp_ns = min(max(0, frame.capture_ns), 2**63 - 1)
        channels.add(messages.skeleton_topic(frame.camera), skeleton, frame.arrival_ns, stamp_ns, made, frame.payload)


def _cut(data: bytes, what: str, at: int, number: int) -> bytes:
    if what == "truncated":
        return data[:at]
    if what == "flipped":
        return data[:at] + bytes([data[at] ^ (1 << number % 8)]) + data[at + 1 :] if at < len(data) else data
    if what == "zeroed":
        return data[:at] + bytes(min(number, len(data) - at)) + data[at + number :]
    if what == "inserted":
        return data[:at] + np.random.default_rng(number).bytes(number % 100) + data[at:]
    return data[:at] + data[at + number :]  # left out
