"""Strategies that spoil a clip as recordings are spoilt: each small, and any number of them one after the other."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from hrcreplay.records import POINTS
from tests.tools.fuzz.clip import CAMERAS, Clip, Frame, Joints, clip

Draw = Callable[[st.SearchStrategy[Any]], Any]
Spoiler = Callable[[Clip, Draw], None]

_BAD = (0.0, float("nan"), float("inf"), -float("inf"), 1e9, -1e9, 3e38, 1e-30, 1e4)
_GROUPS = (
    POINTS,
    ("shoulder_l", "shoulder_r"),
    ("neck", "pelvis"),
    ("shoulder_l", "elbow_l", "wrist_l", "hand_l"),
    ("wrist_r", "elbow_r"),
    ("hand_l", "hand_r"),
    ("wrist_l", "wrist_r"),
    ("hip_l", "knee_l", "ankle_l", "foot_l", "hip_r", "knee_r", "ankle_r", "foot_r"),
    ("head",),
    ("pelvis",),
    ("chest", "neck"),
)
_JOINTS = ("joint_1", "joint_2", "joint_3", "joint_4", "joint_5", "joint_6")


def _frames(made: Clip, draw: Draw) -> list[Frame]:
    """Some of the frames; their cameras are no longer clean."""
    cameras = draw(st.sampled_from((CAMERAS, CAMERAS[:1], CAMERAS[1:])))
    first, last = sorted((draw(st.floats(0, 1)), draw(st.floats(0, 1))))
    few = draw(st.sampled_from((0.0, 1.0, 0.5, 0.1)))
    rng = _rng(draw)
    mine = [frame for frame in made.frames if frame.camera in cameras]
    if few == 1.0:
        chosen = mine[round(first * len(mine)) : max(1, round(last * len(mine)))]
    elif few:
        chosen = [frame for frame in mine if rng.random() < few]
    else:
        chosen = mine
    made.touched |= {frame.camera for frame in chosen}
    return chosen


def _rng(draw: Draw) -> np.random.Generator:
    return np.random.default_rng(draw(st.integers(0, 2**31)))


def _rows(draw: Draw) -> list[int]:
    return [POINTS.index(name) for name in draw(st.sampled_from(_GROUPS))]


def _fits(frame: Frame) -> bool:
    return frame.points_m.shape == (len(POINTS), 3)


# --- points ---


def values(made: Clip, draw: Draw) -> None:
    """Coordinates that are none."""
    rows, bad = _rows(draw), draw(st.sampled_from(_BAD))
    axes = draw(st.sampled_from(([0, 1, 2], [0], [2])))
    for frame in filter(_fits, _frames(made, draw)):
        for row in rows:
            frame.points_m[row, axes] = bad


def coincident(made: Clip, draw: Draw) -> None:
    """Several points in one place."""
    rows = _rows(draw)
    for frame in filter(_fits, _frames(made, draw)):
        frame.points_m[rows] = frame.points_m[rows[0]]


def scaled(made: Clip, draw: Draw) -> None:
    """Another unit, or a mirror image."""
    factor = draw(st.sampled_from((1000.0, 0.001, -1.0, 1e-9, 1e6)))
    axes = draw(st.sampled_from(([0, 1, 2], [0], [1], [2])))
    for frame in filter(_fits, _frames(made, draw)):
        frame.points_m[:, axes] *= factor


def axes(made: Clip, draw: Draw) -> None:
    """Axes in another order."""
    order = draw(st.permutations([0, 1, 2]))
    for frame in filter(_fits, _frames(made, draw)):
        frame.points_m[:] = frame.points_m[:, order]


def noise(made: Clip, draw: Draw) -> None:
    """Points that jump about."""
    sigma, rng = draw(st.sampled_from((0.003, 0.05, 0.5, 20.0))), _rng(draw)
    for frame in filter(_fits, _frames(made, draw)):
        frame.points_m += rng.normal(0.0, sigma, frame.points_m.shape)


def moved(made: Clip, draw: Draw) -> None:
    """The person is somewhere else from one frame to the next."""
    by = np.array(draw(st.lists(st.sampled_from((0.0, 1.0, -3.0, 100.0)), min_size=3, max_size=3)))
    for frame in filter(_fits, _frames(made, draw)):
        frame.points_m += by


def frozen(made: Clip, draw: Draw) -> None:
    """A camera that repeats itself."""
    kept: dict[str, np.ndarray[Any, Any]] = {}
    for frame in _frames(made, draw):
        frame.points_m = kept.setdefault(frame.camera, frame.points_m).copy()


def confidences(made: Clip, draw: Draw) -> None:
    """Confidences that are none."""
    bad = draw(st.sampled_from((-1.0, 0.0, 2.0, float("nan"), float("inf"), 1e-30, 0.5)))
    rows = _rows(draw)
    for frame in _frames(made, draw):
        frame.confidence[[row for row in rows if row < len(frame.confidence)]] = bad


# --- stamps, bodies, cameras ---


def captures(made: Clip, draw: Draw) -> None:
    """Capture times that cannot be."""
    kind = draw(st.sampled_from(("zero", "negative", "same", "late", "early", "ms", "shuffled", "last")))
    chosen, rng = _frames(made, draw), _rng(draw)
    stamps = [frame.capture_ns for frame in chosen]
    mixed = rng.permutation(len(stamps)).tolist()
    for i, frame in enumerate(chosen):
        given = {
            "zero": 0,
            "negative": -frame.capture_ns,
            "same": stamps[0],
            "late": frame.capture_ns + 3_600_000_000_000,
            "early": frame.capture_ns - 5_000_000_000,
            "ms": frame.capture_ns // 1_000_000,
            "shuffled": stamps[mixed[i]],
            "last": 2**63 - 1,
        }
        frame.capture_ns = given[kind]


def arrivals(made: Clip, draw: Draw) -> None:
    """Arrivals that cannot be, or pauses."""
    kind = draw(st.sampled_from(("zero", "same", "pause", "shuffled", "last", "day")))
    chosen, rng = _frames(made, draw), _rng(draw)
    times = [frame.arrival_ns for frame in chosen]
    mixed = rng.permutation(len(times)).tolist()
    made.touched |= set(CAMERAS)  # the span of the log is another
    for i, frame in enumerate(chosen):
        given = {
            "zero": 0,
            "same": times[0],
            "pause": frame.arrival_ns + 2_000_000_000,
            "shuffled": times[mixed[i]],
            "last": 2**63 - 1,
            "day": frame.arrival_ns + 86_400_000_000_000,
        }
        frame.arrival_ns = given[kind]


def bodies(made: Clip, draw: Draw) -> None:
    """Body ids that change, and people who are there twice."""
    kind, rng = draw(st.sampled_from(("changing", "negative", "twice", "large"))), _rng(draw)
    doubles = []
    for frame in _frames(made, draw):
        if kind == "twice":
            there = frame.points_m + rng.choice([0.0, 0.01, 1.0, 4.0])
            doubles.append(
                Frame(frame.arrival_ns, frame.capture_ns, frame.camera, frame.body + 1, there, frame.confidence.copy())
            )
        else:
            frame.body = {"changing": int(rng.integers(0, 5)), "negative": -1, "large": 2**63 - 1}[kind]
    made.frames = sorted([*made.frames, *doubles], key=lambda frame: frame.arrival_ns)


def missing(made: Clip, draw: Draw) -> None:
    """Frames or cameras that never came."""
    gone = {id(frame) for frame in _frames(made, draw)}
    made.frames = [frame for frame in made.frames if id(frame) not in gone]


def twice(made: Clip, draw: Draw) -> None:
    """Frames that came twice."""
    again = [Frame(**vars(frame)) for frame in _frames(made, draw)]
    made.frames = sorted([*made.frames, *again], key=lambda frame: frame.arrival_ns)


# --- messages ---


def shapes(made: Clip, draw: Draw) -> None:
    """More or fewer numbers than there should be."""
    points, confidence = draw(st.integers(0, 80)), draw(st.sampled_from((0, 1, 19, 20, 21, 60)))
    for frame in _frames(made, draw):
        frame.points_m = np.resize(frame.points_m.ravel() if frame.points_m.size else np.zeros(1), points)
        frame.confidence = np.resize(frame.confidence if frame.confidence.size else np.zeros(1), confidence)


def payloads(made: Clip, draw: Draw) -> None:
    """Messages that break off, are empty or garbage."""
    kind, rng = draw(st.sampled_from(("empty", "garbage", "cut"))), _rng(draw)
    size = draw(st.integers(1, 300))
    for frame in _frames(made, draw):
        garbage = rng.bytes(size)
        frame.payload = {"empty": b"", "garbage": garbage, "cut": b"\x08\x80\x80\x12\xff" + garbage[:40]}[kind]


def schemas(made: Clip, draw: Draw) -> None:
    """Topics that say something else of their messages."""
    made.schema = draw(st.sampled_from(("hrcreplay.Skeleton", "hrcreplay.Truth", "std_msgs/String", "", "tf2_msgs/TF")))
    made.schema_bytes = draw(st.sampled_from((None, b"", b"garbage", b"\x0a\xff\xff")))
    made.encoding = draw(st.sampled_from(("protobuf", "json", "ros1", "cdr", "")))
    made.touched |= set(CAMERAS)


# --- what holds for the whole log ---


def poses(made: Clip, draw: Draw) -> None:
    """Poses of cameras that are none."""
    camera = draw(st.sampled_from(CAMERAS))
    made.poses[camera] = _pose(made.poses[camera], draw)
    made.touched |= set(CAMERAS)


def base(made: Clip, draw: Draw) -> None:
    """A robot that stands nowhere, far away or in the person."""
    made.base = draw(st.sampled_from(([], None))) if draw(st.booleans()) else _pose(made.base or [], draw)


def _pose(pose: list[float], draw: Draw) -> list[float]:
    T = np.array(pose if len(pose) == 16 else np.eye(4).ravel()).reshape(4, 4)
    kind = draw(st.sampled_from(("nan", "far", "scaled", "mirrored", "zero", "short", "none", "turned", "here")))
    if kind == "nan":
        T[draw(st.integers(0, 3)), draw(st.integers(0, 3))] = np.nan
    elif kind == "far":
        T[:3, 3] += draw(st.sampled_from((10.0, 1e6, 1e300)))
    elif kind == "scaled":
        T[:3, :3] *= draw(st.sampled_from((1000.0, 0.001, 1.01)))
    elif kind == "mirrored":
        T[:3, 0] *= -1.0
    elif kind == "zero":
        T[:] = 0.0
    elif kind == "turned":
        T[:3, :3] = T[:3, [1, 2, 0]]
    elif kind == "here":
        T[:3, 3] = 0.0
    values: list[float] = T.ravel().tolist()
    return {"short": values[:7], "none": []}.get(kind, values)


def task(made: Clip, draw: Draw) -> None:
    """A task that is none."""
    kind = draw(st.sampled_from(("none", "text", "list", "empty", "value")))
    if kind == "value" and made.task is not None:
        found = json.loads(made.task)
        places = _places(found)
        if places:
            owner, key = places[draw(st.integers(0, len(places) - 1))]
            owner[key] = draw(st.sampled_from((None, "x", -1.0, 0.0, 1e9, float("nan"), [], {}, [1.0, 2.0])))
        made.task = json.dumps(found)
    else:
        made.task = {"none": None, "text": "{", "list": "[1, 2]", "empty": "{}"}.get(kind, made.task)


def _places(table: Any) -> list[tuple[Any, Any]]:
    """Everything in a JSON value that can be another."""
    keys = list(table) if isinstance(table, dict) else list(range(len(table))) if isinstance(table, list) else []
    return [(table, key) for key in keys] + [place for key in keys for place in _places(table[key])]


def joints(made: Clip, draw: Draw) -> None:
    """A track of the robot's joints, with or without a task beside it."""
    kind = draw(st.sampled_from(("fine", "still", "nan", "few", "many", "jumps", "backwards", "one", "huge")))
    made.task = draw(st.sampled_from((None, made.task)))
    first_ns = max(0, made.frames[0].arrival_ns) if made.frames else 0
    count = 1 if kind == "one" else 60
    made.joints = []
    for i in range(count):
        q = [0.0, 0.2, 0.1, 0.0, 0.5, 0.0] if kind == "still" else [0.002 * i, 0.2, 0.1, 0.0, 0.5, 0.0]
        q[1] = {"nan": float("nan"), "jumps": float(i % 2), "huge": 1e9}.get(kind, q[1])
        names = list(_JOINTS) if kind != "many" else [*_JOINTS, *_JOINTS]
        t_ns = first_ns + 10_000_000 * (count - i if kind == "backwards" else i)
        made.joints.append(Joints(t_ns, names, q[:3] if kind == "few" and i else q))


def truth(made: Clip, draw: Draw) -> None:
    """A true person who is none."""
    bad = draw(st.sampled_from(_BAD))
    size = draw(st.sampled_from((20, 20, 20, 3, 0)))
    made.truth = [(max(0, frame.arrival_ns), np.full((size, 3), bad)) for frame in made.frames[::2]]


def file(made: Clip, draw: Draw) -> None:
    """A file that was damaged."""
    made.indexed, made.whole = draw(st.booleans()), draw(st.booleans())
    kinds = st.sampled_from(("truncated", "flipped", "flipped", "zeroed", "inserted", "left out"))
    made.cut += draw(st.lists(st.tuples(kinds, st.floats(0, 1), st.integers(1, 2000)), max_size=4))
    made.touched |= set(CAMERAS)


SPOILERS: tuple[Spoiler, ...] = (
    values,
    coincident,
    scaled,
    axes,
    noise,
    moved,
    frozen,
    confidences,
    captures,
    arrivals,
    bodies,
    missing,
    twice,
    shapes,
    payloads,
    schemas,
    poses,
    base,
    task,
    joints,
    truth,
    file,
)
_COMMON = SPOILERS[: SPOILERS.index(shapes)]


@st.composite
def clips(draw: Draw) -> Clip:
    """A clip of the demo log with one to four things wrong: mostly with what trackers say, else with the file."""
    made = clip(draw(st.sampled_from((0.4, 6.0, 14.0, 21.0, 33.0, 47.0))), draw(st.sampled_from((0.3, 0.5, 0.6))))
    wrong = st.lists(st.sampled_from(_COMMON) | st.sampled_from(SPOILERS), min_size=1, max_size=4)
    for spoiler in draw(wrong):
        spoiler(made, draw)
        made.told.append(spoiler.__name__)
    return made


def spoilt(number: int) -> Clip:
    """The clip of a seed: the same again whenever it is asked for."""
    found: list[Clip] = []

    @seed(number)
    @settings(
        max_examples=2,  # the first one is the simplest, whatever the seed
        phases=[Phase.generate],
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(clips())
    def keep(made: Clip) -> None:
        found.append(made)

    keep()
    return found[-1]
