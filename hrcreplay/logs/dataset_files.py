"""Readers of research sets of people beside robots: CHICO and HARPER. Their pickles are read without running code."""

from __future__ import annotations

import pickle
import re
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from hrcreplay.errors import LogError
from hrcreplay.logs.motion_files import ImportMapping, Tracks, one_body, rate_of, times_at
from hrcreplay.records import Floats

_CHICO_HZ = 25.0
_ROBOT = (
    "the robot's {count} points are not taken: they are places on body and legs, which tell neither the angles of its "
    "axes nor its shape; give the robot by its own log, or a task"
)


class _ArraysOnly(pickle.Unpickler):
    """Unpickler of lists, dictionaries, numbers, texts and numpy's arrays; anything else is refused unread."""

    _ALLOWED: ClassVar[set[tuple[str, str]]] = {
        *((f"numpy.{core}.multiarray", name) for core in ("core", "_core") for name in ("_reconstruct", "scalar")),
        *((f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")),
        ("numpy", "ndarray"),
        ("numpy", "dtype"),
    }

    def find_class(self, module: str, name: str) -> Any:
        """Returns one of numpy's parts of an array; raises UnpicklingError for anything else."""
        if (module, name) not in self._ALLOWED:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, and only numbers and arrays are read")
        return super().find_class(module, name)


def unpickle_arrays(path: Path) -> Any:
    """Reads a pickle that holds only lists, dictionaries, numbers, texts and arrays.

    Raises:
        LogError: The file cannot be read, or asks for anything else.
    """
    try:
        with path.open("rb") as file:
            return _ArraysOnly(file).load()
    except FileNotFoundError as error:
        raise LogError(f"{path}: no such file; name a recording") from error
    except Exception as error:  # a spoilt pickle may raise anything
        told = " ".join(str(error).split())
        raise LogError(f"{path}: is no pickle that can be read safely ({told}); take the set's own file") from error


def read_chico(path: Path, mapping: ImportMapping) -> Tracks:
    """Reads a recording of CHICO: a list of frames, each 15 points of the person and 9 of the KUKA; 25 Hz."""
    frames = unpickle_arrays(path)
    if not isinstance(frames, list) or not frames or not all(_is_pair(frame) for frame in frames):
        raise LogError(f"{path}: found {type(frames).__name__}; would be right: a list of person and robot per frame")
    points = np.stack([_points(frame[0], 15, f"{path}: frame {i + 1}") for i, frame in enumerate(frames)])
    arm = np.stack([_points(frame[1], 9, f"{path}: frame {i + 1}: robot") for i, frame in enumerate(frames)])
    t_ns = times_at(len(points), rate_of(mapping, _CHICO_HZ, str(path)))
    return replace(one_body(t_ns, tuple(map(str, range(15))), points, str(path), None), arm=arm)


def _is_pair(frame: Any) -> bool:
    return isinstance(frame, (list, tuple)) and len(frame) == 2


def read_harper(path: Path, mapping: ImportMapping) -> Tracks:
    """Reads a recording of HARPER's 3-D data: frame -> 21 points of the person and those of Spot; rate by the name."""
    frames = unpickle_arrays(path)
    keys = ("human_joints_3d", "spot_joints_3d")
    if not isinstance(frames, dict) or not frames or not all(_is_frame(*item, keys) for item in frames.items()):
        raise LogError(f"{path}: found {type(frames).__name__}; would be right: frames with {' and '.join(keys)}")
    found = re.search(r"_(\d+)hz", path.name)
    rate_hz = rate_of(mapping, float(found[1]) if found else None, str(path))
    numbers = sorted(frames)
    points = np.stack([_points(frames[k][keys[0]], 21, f"{path}: frame {k}") for k in numbers])
    robot = np.asarray(frames[numbers[0]][keys[1]], dtype=np.float64)
    at = np.array(numbers, dtype=np.int64)
    steps = np.append(0, at[1:] - at[:-1])
    step = max(1, int(np.median(steps[1:]))) if len(steps) > 1 else 1  # a gap in the numbers is a gap in time
    t_ns = np.round(np.cumsum(steps) / step / rate_hz * 1e9).astype(np.int64)
    note = _ROBOT.format(count=len(robot))
    return replace(one_body(t_ns, tuple(map(str, range(21))), points, str(path), None), notes=(note,))


def _is_frame(number: Any, frame: Any, keys: tuple[str, ...]) -> bool:
    return isinstance(number, int) and isinstance(frame, dict) and frame.keys() >= set(keys)


def _points(values: Any, count: int, where: str) -> Floats:
    try:
        points = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise LogError(f"{where}: found {str(values)[:40]}; would be right: {count} points of three numbers") from error
    if points.shape != (count, 3):
        raise LogError(f"{where}: found {points.shape} numbers; would be right: {count} points of three numbers")
    return points
