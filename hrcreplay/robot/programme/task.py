"""The programmed task: what the robot would do if nobody were there.

The same structure is a task file (TOML) and the task that travels inside a log. In full::

    name = "pick and place"
    repeat = true                     # for the whole log; or: cycles = 3 (default 1)
    speed = 0.6                       # share of every axis' top speed, in (0, 1]
    acceleration = 0.5                # share of every axis' acceleration limit, in (0, 1]
    tcp_speed_m_per_s = 1.0           # no move carries the TCP faster [m/s]
    tcp_acceleration_m_per_s2 = 4.0   # of linear moves [m/s^2]

    [[waypoints]]                     # the first is where the robot starts
    name = "home"
    joints_deg = [0, 0, 0, 0, 90, 0]  # or joints_rad

    [[waypoints]]
    name = "above the rack"
    position_m = [0.45, 0.30, 0.25]   # TCP in the robot's base frame [m]
    rpy_deg = [180, 0, 0]             # R = Rz(yaw) Ry(pitch) Rx(roll); or quaternion_wxyz = [0, 1, 0, 0]
    move = "joint"                    # how to get here: "joint" (default) or "linear"

    [[waypoints]]
    name = "rack"
    position_m = [0.45, 0.30, 0.10]
    rpy_deg = [180, 0, 0]
    move = "linear"
    tcp_speed_m_per_s = 0.25          # this move only; at most the task's
    dwell_s = 0.5                     # the robot stands this long before it goes on [s]

The robot stops at every waypoint, and stands at the first for its dwell before it starts. ``cycles`` times from the
first to the last; between two cycles it goes back to the first by the first's own ``move``. On a straight line the TCP
turns by at most 2 pi rad for every 2.5 m of the TCP speed, so a pure turn takes its time too.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from hrcreplay.errors import SettingsError

_Share = Annotated[float, Field(gt=0, le=1)]
_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Three = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
_Quaternion = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class Waypoint(_Strict):
    """A place where the robot stops, as joint angles or as a pose of the TCP in the robot's base frame."""

    name: str = ""
    """Shown in messages."""
    joints_deg: tuple[FiniteFloat, ...] | None = None
    """An angle an axis [deg]."""
    joints_rad: tuple[FiniteFloat, ...] | None = None
    """An angle an axis [rad]."""
    position_m: _Three | None = None
    """TCP in the base frame [m]."""
    rpy_deg: _Three | None = None
    """Its orientation, Rz(yaw) Ry(pitch) Rx(roll) [deg]."""
    quaternion_wxyz: _Quaternion | None = None
    """Its orientation, scalar first."""
    move: Literal["joint", "linear"] = "joint"
    """How the robot gets here: every axis on its own way, or the TCP on a straight line."""
    tcp_speed_m_per_s: _Positive | None = None
    """Top speed of the TCP on the way here; none: the task's [m/s]."""
    dwell_s: Annotated[float, Field(ge=0, le=3600)] = 0.0
    """How long the robot stands here [s]."""

    @model_validator(mode="after")
    def _one_place(self) -> Waypoint:
        places = [n for n in ("joints_deg", "joints_rad", "position_m") if getattr(self, n) is not None]
        turns = [n for n in ("rpy_deg", "quaternion_wxyz") if getattr(self, n) is not None]
        if len(places) != 1:
            raise ValueError(f"found {_listed(places)}; give exactly one of joints_deg, joints_rad, position_m")
        if (places == ["position_m"]) != (len(turns) == 1) or len(turns) > 1:
            raise ValueError(
                f"found {places[0]} with {_listed(turns)}; "
                "position_m takes one of rpy_deg, quaternion_wxyz, and joints take none"
            )
        if self.quaternion_wxyz is not None and sum(v * v for v in self.quaternion_wxyz) < 1e-6:
            raise ValueError(f"found quaternion_wxyz {list(self.quaternion_wxyz)}; its length must not be 0")
        return self


class Task(_Strict):
    """The waypoints of a cycle and how fast to pass them."""

    name: str = "task"
    """Shown in the report."""
    waypoints: Annotated[tuple[Waypoint, ...], Field(min_length=2)]
    """In order; the first is the start."""
    repeat: bool = False
    """Start over until the log ends."""
    cycles: Annotated[int, Field(ge=1)] = 1
    """How often to run the waypoints, unless they repeat."""
    speed: _Share = 0.5
    """Share of every axis' top speed."""
    acceleration: _Share = 0.5
    """Share of every axis' acceleration limit."""
    tcp_speed_m_per_s: _Positive = 1.0
    """Top speed of the TCP [m/s]."""
    tcp_acceleration_m_per_s2: _Positive = 4.0
    """Top acceleration of the TCP on linear moves [m/s^2]."""

    @model_validator(mode="after")
    def _repeat_or_cycles(self) -> Task:
        if self.repeat and "cycles" in self.model_fields_set:
            raise ValueError(f"found repeat = true and cycles = {self.cycles}; give one of them")
        return self

    def label(self, index: int) -> str:
        """How messages call a waypoint, counted from 1."""
        name = self.waypoints[index].name
        return f"waypoint {index + 1}" + (f" ({name})" if name else "")


def parse_task(table: dict[str, Any], where: str = "task") -> Task:
    """A task from the structure of its file.

    Args:
        table: As ``tomllib`` reads the example above.
        where: What messages begin with, e.g. the file's path.

    Raises:
        SettingsError: An unknown key, or a value that cannot be used; names the waypoint.
    """
    try:
        return Task.model_validate(table)
    except ValidationError as error:
        raise SettingsError(f"{where}: {_first_problem(error)}") from error


def _first_problem(error: ValidationError) -> str:
    problem = error.errors()[0]
    at, key = _place(problem["loc"])
    if problem["type"] == "extra_forbidden":
        known = Waypoint.model_fields if at else Task.model_fields
        return f"{at}unknown key {key!r}; known here: {', '.join(known)}"
    if problem["type"] == "missing":
        return f"{at}{key} is missing; the task needs it"
    if problem["type"] == "value_error":
        return f"{at}{problem['ctx']['error']}"
    wanted = problem["msg"].removeprefix("Input ").replace("valid tuple", "list").replace("valid dictionary", "table")
    return f"{at}{key}: found {problem['input']!r}; it {wanted}"


def _place(loc: tuple[int | str, ...]) -> tuple[str, str]:
    """'waypoint 3: ' (or nothing) and the key behind it."""
    if len(loc) > 1 and loc[0] == "waypoints":
        return f"waypoint {int(loc[1]) + 1}: ", ".".join(str(part) for part in loc[2:]) or "waypoint"
    return "", ".".join(str(part) for part in loc)


def _listed(names: list[str]) -> str:
    return " and ".join(names) or "none"
