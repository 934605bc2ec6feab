"""Bodies collected in files, beside the same frames in memory."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from hrcreplay.human.fusion import inverse_kinematics
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline.fusion_stage import Sightings, as_frames
from hrcreplay.pipeline.seen_bodies import Bodies, SeenBodies
from hrcreplay.records import CameraFrames
from hrcreplay.settings.sections import Fusion

DEMO = Path(__file__).parents[2] / "datasets" / "demo.mcap"


def parts() -> list[Sightings]:
    """Frames of the demo, of which every third body is somebody else; and a part without a body."""
    log = open_log(DEMO)
    poses = np.array([log.header.T_world_camera[camera] for camera in log.header.cameras])
    found = []
    for n, frames in enumerate(log.frames(log.header.start_ns, log.header.start_ns + 8_000_000_000)):
        person = np.where(np.arange(len(frames)) % 3 == n % 3, 0, 1)
        measured = inverse_kinematics.measure(frames.rows(person > 0), poses, Fusion())
        found.append(Sightings(measured, frames, person, Counter()))
    nobody = found[0].everybody.rows(slice(0, 0))
    measured = inverse_kinematics.measure(nobody, poses, Fusion())
    return [found[0], Sightings(measured, nobody, np.zeros(0, np.int64), Counter()), *found[1:]]


def assert_same(bodies: Bodies | None, frames: CameraFrames) -> None:
    assert bodies is not None
    assert len(bodies) == len(frames) > 50
    some = np.array([7, 3, 3, len(frames) - 1])
    for got, want in (
        (bodies.rows(slice(None)), frames),
        (bodies.rows(slice(5, 9)), frames.rows(slice(5, 9))),
        (bodies.rows(some), frames.rows(some)),
        (bodies.some(some).rows(np.array([1, 0])), frames.rows(some[[1, 0]])),
        (bodies.some(some).rows(slice(0, 2)), frames.rows(some[:2])),
    ):
        assert got.cameras == want.cameras
        for name in ("capture_ns", "arrival_ns", "camera", "body", "points_m", "confidence"):
            np.testing.assert_array_equal(getattr(got, name), getattr(want, name))


def test_bodies_come_back_from_files_and_from_memory(tmp_path: Path) -> None:
    seen, kept = parts(), SeenBodies(tmp_path)
    people = CameraFrames.join([as_frames(one.measured) for one in seen])
    others = CameraFrames.join([one.others for one in seen])
    alone = SeenBodies()
    for one in seen:
        kept.add(one)
        alone.add(one)
    assert sum(path.stat().st_size for path in tmp_path.rglob("*.array")) == 8 * sum(
        frames.points_m.size + frames.confidence.size for frames in (people, others)
    )
    for bodies in (kept, alone):
        mine, rest = bodies.take()
        assert_same(mine, people)
        assert_same(rest, others)
        assert bodies.take() == (None, None)
        bodies.close()
    assert list(tmp_path.iterdir()) == []
