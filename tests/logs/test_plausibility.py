"""What cannot be a person: said in ``info`` and in the notes of every pass, refused where nobody can be like that."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hrcreplay.errors import LogError
from hrcreplay.logs.info import lines, summarize
from hrcreplay.logs.plausibility import BodyPosture
from hrcreplay.logs.reader import Log, open_log
from hrcreplay.records import LIMBS, POINTS, CameraFrames, Floats
from hrcreplay.settings.sections import Decoder, Logs
from tests.facts import facts, tells
from tests.logs import own
from tests.logs.bags import bag, define, header, make, point
from tests.reobserve import walker

PERIOD = own.PERIOD_NS
CAMERA = np.array(
    [[0.0, -1, 0, 0], [0, 0, -1, 1.5], [1, 0, 0, 4.0], [0, 0, 0, 1]]
)  # 4 m away, x right, y down, z ahead


def seen(n: int = 60, T_camera_world: Floats = CAMERA) -> CameraFrames:
    """The walker, 1.65 m to the middle of the head, before one camera."""
    person = walker(n / 30.0)
    points = person.points_m @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    capture_ns = own.BEGIN_NS + np.arange(n, dtype=np.int64) * PERIOD
    zeros = np.zeros(n, dtype=np.int64)
    return CameraFrames(capture_ns, capture_ns + 5_000_000, zeros, zeros, points, np.ones((n, 20)), ("left",))


def with_points(table: CameraFrames, points: Floats) -> CameraFrames:
    names = ("capture_ns", "arrival_ns", "camera", "body", "confidence", "cameras")
    return CameraFrames(points_m=points, **{name: getattr(table, name) for name in names})


def opened(tmp_path: Path, table: CameraFrames, T_world_camera: Floats | None = None) -> Log:
    return open_log(own.write(tmp_path / "a.mcap", table, cameras={"left": T_world_camera}))


def test_a_person_is_told_and_not_remarked(tmp_path: Path) -> None:
    log = opened(tmp_path, seen(), np.asarray(np.linalg.inv(CAMERA)))
    found = summarize(log)
    assert found.notes == ()
    log.check()
    # by Winter's shares of the walker's bones: trunk 0.45, upper arm 0.28, lower arm 0.25, thigh 0.45, shank 0.40 m
    assert found.cameras[0].stature_m == pytest.approx(
        np.median([0.45 / 0.288, 0.28 / 0.186, 0.25 / 0.146] * 2), abs=0.3
    )
    assert tells(lines(found), "person", f"{found.cameras[0].stature_m:.2f} m", "(left)")


@pytest.mark.parametrize(
    ("factor", "cause"),
    [
        (1000.0, "millimetres were taken for metres"),
        (100.0, "centimetres were taken for metres"),
        (0.001, "metres were taken for millimetres"),
        (0.05, "metres?"),
    ],
)
def test_a_body_of_another_size_is_refused(factor: float, cause: str, tmp_path: Path) -> None:
    table = seen()
    log = opened(tmp_path, with_points(table, factor * table.points_m))
    own_notes = [note for note in _notes(log) if "tall" in note]
    assert len(own_notes) == 1
    assert tells(own_notes[0], cause, "0.5 to 2.3 m")
    with pytest.raises(LogError, match=facts("camera left", cause, "0.5 to 2.3 m")) as refused:
        log.check()
    assert refused.value.exit_code == 3


@pytest.mark.parametrize("factor", [0.27, 1.7])
def test_an_odd_size_is_a_note(factor: float, tmp_path: Path) -> None:
    table = seen()
    log = opened(tmp_path, with_points(table, factor * table.points_m))
    assert tells(_notes(log), "tall", "0.5 to 2.3 m", "metres?")
    log.check()


def test_a_described_decoder_is_told_which_unit_would_be_right(tmp_path: Path) -> None:
    names = ("pelvis", "neck", "shoulder_l", "elbow_l", "wrist_l")
    body = 1e3 * seen(20).points_m[:, [POINTS.index(name) for name in names]]
    with bag(tmp_path / "a.bag", "ros1") as (write, store):
        define(store, "lab/msg/Person", "std_msgs/Header header\ngeometry_msgs/Point[] joints")
        for i, joints in enumerate(body):
            stamp = own.BEGIN_NS + i * PERIOD
            person = make(
                store, "lab/msg/Person", header=header(store, stamp), joints=[point(store, at) for at in joints]
            )
            write("/people", "lab/msg/Person", stamp + 1000, person)
    index = {name: i for i, name in enumerate(names)}
    log = open_log(
        tmp_path / "a.bag", Logs(decoders=(Decoder(topic="/people", camera="lidar", points="joints", index=index),))
    )
    _notes(log)
    with pytest.raises(LogError, match=r'in its \[\[logs.decoders\]\]: unit = "mm"'):
        log.check()
    right = Decoder(topic="/people", camera="lidar", points="joints", index=index, unit="mm")
    log = open_log(tmp_path / "a.bag", Logs(decoders=(right,)))
    assert not any("tall" in note for note in _notes(log))
    log.check()


def test_a_mirrored_axis_is_told(tmp_path: Path) -> None:
    table = seen()
    log = opened(tmp_path, with_points(table, table.points_m * [-1.0, 1.0, 1.0]))
    assert tells(_notes(log), "left and right", "exchanged", "feet")


@pytest.mark.parametrize(
    ("turn", "said"),
    [
        (np.diag([1.0, -1.0, -1.0]), "stands upside down"),
        (np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), "trunk is 90 degrees from upright"),
    ],
)
def test_a_wrong_up_axis_is_told(turn: Floats, said: str, tmp_path: Path) -> None:
    T = np.asarray(np.linalg.inv(CAMERA))
    T[:3] = turn @ T[:3]
    found = summarize(opened(tmp_path, seen(), T))
    assert [said in note for note in found.notes] == [True]


def test_a_floor_that_is_elsewhere_is_told(tmp_path: Path) -> None:
    T = np.asarray(np.linalg.inv(CAMERA))
    T[2, 3] += 1.2
    found = summarize(opened(tmp_path, seen(), T))
    assert tells(found.notes[0], "pelvis", "2.20 m")


def test_limbs_that_no_camera_measured_are_told(tmp_path: Path) -> None:
    table = seen()
    points = table.points_m.copy()
    points[:, POINTS.index("wrist_r")] = 0.0  # how trackers write 'not tracked'
    points[:, POINTS.index("head")] = np.nan
    notes = _notes(opened(tmp_path, with_points(table, points)))
    never = [note for note in notes if "never measured" in note]
    assert [limb for note in never for limb in LIMBS if tells(note, f"limb {limb}")] == ["HD", "LRA"]
    assert tells(never[1], "wrist_r")


def _notes(log: Log) -> list[str]:
    own.read(log)
    return log.notes


def test_a_posture_keeps_two_numbers_of_a_body_and_not_its_points() -> None:
    posture = BodyPosture()
    posture.add(np.random.default_rng(1).normal(size=(50, 20, 3)))
    kept = [array for parts in vars(posture).values() for array in parts]
    assert [array.shape for array in kept] == [(50,), (50,)]
    assert all(array.base is None for array in kept), "a view would keep the points of a whole log in memory"
