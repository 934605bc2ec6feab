"""Replays recorded human-robot sessions through a safety-aware trajectory generator.

``import hrcreplay as hr`` gives the library (``hrcreplay.api``): the steps of the commands as functions. It is loaded
at its first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hrcreplay.version import __version__ as __version__

if TYPE_CHECKING:
    from hrcreplay.api import Controller as Controller
    from hrcreplay.api import Fusion as Fusion
    from hrcreplay.api import People as People
    from hrcreplay.api import Plan as Plan
    from hrcreplay.api import Recording as Recording
    from hrcreplay.api import Robot as Robot
    from hrcreplay.api import Volumes as Volumes
    from hrcreplay.api import demo_log as demo_log
    from hrcreplay.api import frames as frames
    from hrcreplay.api import fuse as fuse
    from hrcreplay.api import load_task as load_task
    from hrcreplay.api import open_log as open_log
    from hrcreplay.api import plan as plan
    from hrcreplay.api import predict as predict
    from hrcreplay.api import report as report


_LIBRARY = (
    *("Controller", "Fusion", "People", "Plan", "Recording", "Robot", "Volumes"),
    *("demo_log", "frames", "fuse", "load_task", "open_log", "plan", "predict", "report"),
)


def __getattr__(name: str) -> Any:
    if name not in _LIBRARY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from hrcreplay import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_LIBRARY])
