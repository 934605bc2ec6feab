"""Faults injected into the link and the robot, from a script or random with a seed, and the outcome of each.

``FaultyChannel`` applies those of one direction of the link: it decides which datagrams arrive, when, and in what
order.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hrcreplay.egm.robot_double.servo import PERIOD_NS
from hrcreplay.errors import SettingsError
from hrcreplay.records import Bools, Floats
from hrcreplay.toml_file import read_toml


class Datagram(NamedTuple):
    """A datagram and the time of its departure or arrival [ns]."""

    t_ns: int
    data: bytes


class FaultyChannel:
    """Faults of one direction, in the given order, with a separate random generator."""

    def __init__(self, faults: Iterable[Fault], seed: Sequence[int]) -> None:
        self._faults = tuple(faults)
        self._rng = np.random.default_rng(seed)
        self._dropping = 0
        self._held: Datagram | None = None

    def transmit(self, datagram: Datagram, since_s: float) -> list[Datagram]:
        """Applies the faults of this direction to a datagram; returns the datagrams that arrive in its place.

        Args:
            datagram: The datagram to transmit.
            since_s: Time since the first cycle, that of the script [s].

        Returns:
            The departing datagrams, each with a time not before that of ``datagram``.
        """
        if not self._faults:
            return [datagram]
        out = [datagram]
        beside: list[Datagram] = []
        if self._dropping:
            self._dropping -= 1
            out = []
        for fault in self._faults:
            if is_active(fault, since_s) and self._rng.random() < fault.probability:
                out = self._touch(fault, out, beside, datagram.t_ns, since_s)
        if self._held is not None and out and out[-1] is not self._held:
            out.append(Datagram(out[-1].t_ns, self._held.data))
            self._held = None
        return out + beside

    def _touch(
        self, fault: Fault, out: list[Datagram], beside: list[Datagram], t_ns: int, since_s: float
    ) -> list[Datagram]:
        """Applies one fault; garbage and empty datagrams go to ``beside``."""
        match fault.kind:
            case "loss":
                return []
            case "burst" if out:
                self._dropping = fault.count - 1
                return []
            case "duplicate":
                return [copy for datagram in out for copy in (datagram, datagram)]
            case "reorder" if out and self._held is None:
                self._held = out[-1]
                return out[:-1]
            case "delay":
                return _later(out, round(fault.delay_s * 1e9))
            case "jitter":
                return _later(out, round(fault.delay_s * 1e9 * self._rng.random()))
            case "stall":
                end_ns = t_ns + round((fault.at_s + fault.duration_s - since_s) * 1e9)
                return [Datagram(max(datagram.t_ns, end_ns), datagram.data) for datagram in out]
            case "garbage":
                beside.append(Datagram(t_ns, self._rng.bytes(int(self._rng.integers(1, 400)))))
            case "empty":
                beside.append(Datagram(t_ns, b""))
        return out


def is_active(fault: Fault, since_s: float) -> bool:
    """Returns True if a fault is active; without a duration it is active for less than a cycle."""
    return fault.at_s <= since_s < fault.at_s + max(fault.duration_s, 0.004032)


def _later(datagrams: list[Datagram], by_ns: int) -> list[Datagram]:
    return [Datagram(datagram.t_ns + by_ns, datagram.data) for datagram in datagrams]


Direction = Literal["out", "in", "both"]
_DIRECTIONS = ("out", "in", "both")

#: Faults of the link -> their keys in addition to kind, at_s, duration_s, probability, direction.
LINK_FAULTS: Mapping[str, tuple[str, ...]] = {
    "loss": (),
    "burst": ("count",),
    "duplicate": (),
    "reorder": (),
    "delay": ("delay_s",),
    "jitter": ("delay_s",),
    "stall": (),
    "garbage": (),
    "empty": (),
}
#: Faults of the robot -> their keys in addition to kind, at_s, duration_s.
ROBOT_FAULTS: Mapping[str, tuple[str, ...]] = {
    "nan": ("axis",),
    "teleport": ("axis", "angle_deg"),
    "motors_off": (),
    "program_stop": (),
    "egm_error": (),
    "rapid_undefined": (),
    "silence": (),
    "new_session": (),
}
KINDS = (*LINK_FAULTS, *ROBOT_FAULTS)


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault.

    ``loss`` drops datagrams, ``burst`` that many in a row; ``duplicate`` sends twice; ``reorder`` sends the next one
    first; ``delay`` adds a fixed time, ``jitter`` a random one up to it; ``stall`` delays all and then delivers them at
    once; ``garbage`` and ``empty`` add such a datagram to each one. ``nan`` and ``teleport`` falsify the measured joint
    of an axis. ``silence`` stops the robot's messages while it continues to move; ``egm_error`` and ``new_session``
    happen once, at their onset.
    """

    kind: str
    at_s: float
    """Onset, since the first cycle [s]."""
    duration_s: float = 0.0
    """Duration [s]; 0: one cycle."""
    probability: float = 1.0
    """Probability of changing a datagram, or for ``burst`` of beginning at one."""
    direction: Direction = "out"
    """Direction of the datagrams: out of the robot, in to it, or both."""
    delay_s: float = 0.02
    """Time of delay and jitter [s]."""
    count: int = 5
    """Number of datagrams in a burst."""
    axis: int = 1
    """Axis that is falsified, from 1."""
    angle_deg: float = 10.0
    """Apparent offset of a teleported axis [deg]."""

    @property
    def of_link(self) -> bool:
        """Returns True for a fault of the link, False for one of the robot."""
        return self.kind in LINK_FAULTS


def load_faults(path: Path, *, seed: int, duration_s: float) -> tuple[Fault, ...]:
    """Reads a script: ``[[fault]]`` with fields of `Fault`, and ``[random]`` with arguments of `random_faults`.

    Args:
        path: A TOML file.
        seed: Seed of the random ones.
        duration_s: Length of the session, for the random ones [s].

    Returns:
        The faults in order of their onset.

    Raises:
        SettingsError: The file cannot be read or has an invalid entry.
    """
    script = read_toml(path, "name a script of faults, with [[fault]] tables")
    unknown = sorted(set(script) - {"fault", "random"})
    if unknown:
        raise SettingsError(f"{path}: unknown key {unknown[0]!r}; [[fault]] or [random] would be right")
    rows, chance = script.get("fault", []), script.get("random")
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise SettingsError(f"{path}: fault is no list of tables; write [[fault]]")
    faults = [fault_of(row, f"{path}: fault {number}") for number, row in enumerate(rows, start=1)]
    if chance is not None and math.isinf(duration_s):
        raise SettingsError(f"{path}: random faults lie within the session; give its length with --duration")
    if chance is not None:
        faults += random_faults(seed, duration_s=duration_s, **_chance_of(chance, f"{path}: random"))
    return tuple(sorted(faults, key=lambda fault: fault.at_s))


def random_faults(
    seed: int, *, duration_s: float, count: int = 3, after_s: float = 1.0, kinds: Sequence[str] = KINDS
) -> tuple[Fault, ...]:
    """Draws faults of random kind, time, duration and strength; repeatable for a seed.

    Args:
        seed: Seed of the generator.
        duration_s: Latest onset [s].
        count: Number of faults.
        after_s: Earliest onset [s].
        kinds: Kinds to draw from.

    Returns:
        The faults in order of their onset.
    """
    rng = np.random.default_rng(seed)
    faults = []
    for at_s in sorted(rng.uniform(min(after_s, duration_s), duration_s, count)):
        kind = str(rng.choice(kinds))
        link = kind in LINK_FAULTS
        faults.append(
            Fault(
                kind=kind,
                at_s=round(float(at_s), 4),
                duration_s=round(float(10 ** rng.uniform(-2.0, 0.3)), 4),  # 10 ms to 2 s
                probability=round(float(rng.uniform(0.05, 1.0)), 3) if link else 1.0,
                direction=_DIRECTIONS[rng.integers(3)] if link else "out",  # type: ignore[arg-type]
                delay_s=round(float(10 ** rng.uniform(-3.0, -0.5)), 4),  # 1 ms to 0.3 s
                count=int(rng.integers(2, 60)),
                axis=int(rng.integers(1, 7)),
                angle_deg=round(float(rng.choice((-1, 1)) * 10 ** rng.uniform(-0.5, 2.0)), 3),  # 0.3 to 100 deg
            )
        )
    return tuple(faults)


def fault_of(row: Mapping[str, Any], where: str) -> Fault:
    """Makes one fault from a table of a script.

    Raises:
        SettingsError: A key, a type or a value is invalid.
    """
    kind = row.get("kind")
    if kind not in KINDS:
        raise SettingsError(f"{where}: kind is {kind!r}; one of {', '.join(KINDS)} would be right")
    of_link = kind in LINK_FAULTS
    known = {"kind", "at_s", "duration_s"} | (
        {"probability", "direction", *LINK_FAULTS[kind]} if of_link else {*ROBOT_FAULTS[kind]}
    )
    unknown = sorted(set(row) - known)
    if unknown:
        raise SettingsError(f"{where}: {kind} has no key {unknown[0]!r}; it has {', '.join(sorted(known))}")
    if "at_s" not in row:
        raise SettingsError(f"{where}: at_s is missing; name the second at which it begins")
    if row.get("direction", "out") not in _DIRECTIONS:
        raise SettingsError(f"{where}: direction is {row['direction']!r}; {', '.join(_DIRECTIONS)} would be right")
    for key, (low, high) in _RANGES.items():
        if key in row:
            _check_number(row[key], low, high, f"{where}: {key}", whole=key in _WHOLE)
    return Fault(**row)


_RANGES = {
    "at_s": (0.0, math.inf),
    "duration_s": (0.0, math.inf),
    "probability": (0.0, 1.0),
    "delay_s": (0.0, 10.0),
    "count": (1, 100_000),
    "axis": (1, 6),
    "angle_deg": (-360.0, 360.0),
}
_WHOLE = {"count", "axis"}


def _check_number(value: object, low: float, high: float, where: str, *, whole: bool = False) -> None:
    right = isinstance(value, int) if whole else isinstance(value, int | float)
    if isinstance(value, bool) or not right or not (low <= value <= high and math.isfinite(value)):  # type: ignore[operator,arg-type]
        noun = "a whole number" if whole else "a number"
        raise SettingsError(f"{where} is {value!r}; {noun} from {low:g} to {high:g} would be right")


def _chance_of(table: object, where: str) -> dict[str, Any]:
    """Reads the arguments of `random_faults` from a script."""
    if not isinstance(table, dict):
        raise SettingsError(f"{where} is {table!r}; a table [random] would be right")
    unknown = sorted(set(table) - {"count", "after_s", "kinds"})
    if unknown:
        raise SettingsError(f"{where}: has no key {unknown[0]!r}; it has after_s, count, kinds")
    if "count" in table:
        _check_number(table["count"], 1, 100_000, f"{where}: count", whole=True)
    if "after_s" in table:
        _check_number(table["after_s"], 0.0, math.inf, f"{where}: after_s")
    kinds = table.get("kinds", KINDS)
    if not isinstance(kinds, list | tuple) or not kinds or not set(kinds) <= set(KINDS):
        raise SettingsError(f"{where}: kinds is {kinds!r}; a list of {', '.join(KINDS)} would be right")
    return dict(table)


#: Maximum speed of every axis at standstill [rad/s] ...
_REST_RAD_PER_S = 0.01
#: ... for at least this number of cycles.
_REST_CYCLES = 25


@dataclass(frozen=True)
class FaultOutcome:
    """A fault and its outcome. None: not within the run."""

    fault: Fault
    told_rest_s: float | None
    """Time until the references stood still or became invalid [s]."""
    robot_rest_s: float | None
    """Time until the robot stood still [s]."""
    coast_s: float | None
    """Part of that time after the last moving reference [s]."""

    def line(self) -> str:
        """The fault as text."""
        rests = (("told", self.told_rest_s), ("robot", self.robot_rest_s), ("coasting", self.coast_s))
        times = ", ".join(f"{name} {'-' if rest_s is None else f'{rest_s:.3f} s'}" for name, rest_s in rests)
        return f"{self.fault.kind} at {self.fault.at_s:.3f} s: standstill after {times}"


def fault_outcome(fault: Fault, cycles: NDArray[Any]) -> FaultOutcome:
    """Computes the time from the onset of a fault until everything stood still."""
    since_s = (cycles["t_ns"] - cycles["t_ns"][:1]) * 1e-9
    told = _told_still(cycles)
    robot_s = _rest_s(fault, since_s, np.all(np.abs(cycles["planned_rad_per_s"]) < _REST_RAD_PER_S, axis=1))
    coast_s = None
    if robot_s is not None:
        moved = np.flatnonzero(~told & (since_s < fault.at_s + robot_s))
        last_s = float(since_s[moved[-1]]) if len(moved) else fault.at_s
        coast_s = min(robot_s, fault.at_s + robot_s - last_s)
    return FaultOutcome(fault, _rest_s(fault, since_s, told), robot_s, coast_s)


def _told_still(cycles: NDArray[Any]) -> Bools:
    """(n,) True for cycles whose reference neither moves nor has a speed, or without a reference."""
    reference = cycles["ref_rad"]
    step = np.diff(reference, axis=0, prepend=reference[:1]) / (PERIOD_NS * 1e-9)
    moves = (np.abs(step) >= _REST_RAD_PER_S) | (np.abs(cycles["ref_rad_per_s"]) >= _REST_RAD_PER_S)
    return ~np.any(moves, axis=1)


def _rest_s(fault: Fault, since_s: Floats, still: Bools) -> float | None:
    """Returns the time from the onset of a fault to the first cycle of a lasting standstill; None without one."""
    if len(still) < _REST_CYCLES:
        return None
    lasting = np.convolve(still, np.ones(_REST_CYCLES), mode="valid") > _REST_CYCLES - 0.5
    resting = np.flatnonzero(lasting & (since_s[: len(lasting)] >= fault.at_s))
    return float(since_s[resting[0]]) - fault.at_s if len(resting) else None
