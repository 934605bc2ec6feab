"""The names of robot joints: which joint of a log is which axis of the robot."""

from __future__ import annotations

import re
from collections.abc import Sequence

from hrcreplay.errors import LogError, SettingsError

#: Prefix of the name of an unnamed joint, before its index in the message.
NAMELESS = "#"
#: Names that drivers and recorders of a maker give to its axes, each with what numbers the axis; a prefix may precede.
_UR = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
_MAKES = (
    (re.compile(r"(?:.*[_/.])?(?:panda|fr3|fer)_joint_?([1-7])"), "1234567"),
    (re.compile(rf"(?:.*[_/.])?({'|'.join(_UR)})(?:_joint)?"), _UR),
    (re.compile(r"(?:.*[_/.])?actual_q_?([0-5])"), "012345"),
    (re.compile(r"(?:.*[_/.])?a([1-7])"), "1234567"),
)
#: Makes of ``_MAKES`` that name the axes of the robot -> makes that may name them in a log.
_SAME_MAKE = {0: (0,), 1: (1, 2), 3: (3,)}


def match_names(found: Sequence[str], axes: Sequence[str], given: Sequence[str], where: str) -> dict[str, str]:
    """Matches axes to joints in the log by name: axis -> joint.

    A joint is the axis of the same name, ignoring case and characters other than letters and digits: joint1 is joint_1.
    Where the robot's axes have the names of a maker, other names that the maker's drivers give to the same axes count.
    The order in a message is used only if it has no names and as many positions as the robot has axes. A log that
    numbers its joints from 0, or beyond the axes of the robot, counts as that of another robot until names are given.

    Args:
        found: Names of the joints in the log, each once; NAMELESS and a number where a message has none.
        axes: The robot's joints, from the base on.
        given: The log's names in that order; () if they equal the robot's.
        where: Start of error messages: the log and its topics.

    Raises:
        LogError: The names do not fit.
        SettingsError: The given names do not fit.
    """
    if given:
        return _check_names(found, axes, given)
    plain: dict[str, list[str]] = {}
    for name in found:
        plain.setdefault(_plain(name), []).append(name)
    names = {}
    for axis in axes:
        alike = plain.get(_plain(axis), [])
        if axis in found or len(alike) == 1:
            names[axis] = axis if axis in found else alike[0]
    more = _beyond(found, axes)
    if len(set(names.values())) == len(axes) and not more:
        return names
    nameless = [name for name in found if name.startswith(NAMELESS)]
    if not names and len(nameless) == len(axes):
        return dict(zip(axes, nameless, strict=True))
    if made := _match_by_make(found, axes):
        return made
    raise _unfit(found, axes, more, where)


def _match_by_make(found: Sequence[str], axes: Sequence[str]) -> dict[str, str]:
    """Matches the axes of a Franka, Universal Robots or KUKA arm to joints named by its maker; empty if not certain.

    Every axis must have a name of one maker, and every such name must be in the log exactly once: a log of two arms, or
    of one with other axes, is not matched.
    """
    for make, others in _SAME_MAKE.items():
        mine = _places(axes, make)
        if sorted(mine.values()) != list(range(len(axes))):
            continue
        for other in others:
            theirs = _places(found, other)
            if sorted(theirs.values()) == list(range(len(axes))):
                joints = {place: name for name, place in theirs.items()}
                return {axis: joints[place] for axis, place in mine.items()}
    return {}


def _places(names: Sequence[str], make: int) -> dict[str, int]:
    """Returns name -> number of the axis, from 0 at the base, of the names of a make."""
    pattern, order = _MAKES[make]
    matches = {name: pattern.fullmatch(name.casefold()) for name in names}
    return {name: order.index(match[1]) for name, match in matches.items() if match}


def _check_names(found: Sequence[str], axes: Sequence[str], given: Sequence[str]) -> dict[str, str]:
    setting = "logs.joint_names"
    if len(given) != len(axes):
        raise SettingsError(
            f"{setting}: found {len(given)} names; the robot has {len(axes)} axes, {', '.join(axes)}: name the log's "
            "joint of each, in this order"
        )
    missing = [name for name in given if name not in found]
    if missing:
        raise SettingsError(f"{setting}: {missing[0]!r} is not in the log; its joints are {list_names(found)}")
    return dict(zip(axes, given, strict=True))


def _plain(name: str) -> str:
    return "".join(letter for letter in name.casefold() if letter.isalnum())


def _beyond(found: Sequence[str], axes: Sequence[str]) -> list[str]:
    """Returns joints that are numbered like the axes but are none of them."""
    numbered = [re.fullmatch(r"(.*?)(\d+)", _plain(axis)) for axis in axes]
    stems = {match[1] for match in numbered if match}
    if not all(numbered) or len(stems) != 1:
        return []
    known = {(match[1], int(match[2])) for match in numbered if match}
    others = ((name, re.fullmatch(r"(.*?)(\d{1,3})", _plain(name))) for name in found)
    return [name for name, match in others if match and match[1] in stems and (match[1], int(match[2])) not in known]


def _unfit(found: Sequence[str], axes: Sequence[str], more: Sequence[str], where: str) -> LogError:
    nameless = sum(name.startswith(NAMELESS) for name in found)
    told = f"{nameless} positions without names" if nameless == len(found) else f"joints {list_names(found)}"
    ends = [[name for name in found if _plain(name).endswith(_plain(axis))] for axis in axes]
    likely = [names[0] for names in ends if len(names) == 1]
    example = likely if len(set(likely)) == len(axes) else [f"name of {axis}" for axis in axes]
    setting = ", ".join(f'"{name}"' for name in example)
    why = f" ({list_names(more)} would be one more of them)" if more else ""
    return LogError(
        f"{where}: found {told}; the robot's axes are "
        f"{', '.join(axes)}{why}. Name the log's joints in the order of the axes, "
        f"--set 'logs.joint_names=[{setting}]', or the robot that was recorded, --set robot.urdf=FILE, "
        "or give a task in their place, --set plan.task=FILE.toml"
    )


def list_names(names: Sequence[str]) -> str:
    """Returns the names for a message, the first twenty of them."""
    most = 20
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
