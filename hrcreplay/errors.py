"""User errors, each with its exit code.

A message says *where: what was found; what would be right*. A bug keeps its traceback.
"""

from __future__ import annotations

#: Exit codes of ``verify`` where a run does not come out bit by bit as it was recorded: something differs; nothing
#: differs but numbers, by no more than 1e-9, and the run was recorded on another machine.
EXIT_DIFFERS, EXIT_SAME_DECISIONS = 1, 6

_SHOWN = 200


def shown(value: object) -> str:
    """A value as messages show it: its repr, cut where it is long."""
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


class HrcReplayError(Exception):
    """Something the user can mend. The command prints the message and leaves with ``exit_code``."""

    exit_code = 1


class SettingsError(HrcReplayError):
    """A setting, an argument, a cell file, a task or an output folder that cannot be used."""

    exit_code = 2


class LogError(HrcReplayError):
    """A log that cannot be read, or that lacks what a stage needs."""

    exit_code = 3


class LiveStopped(HrcReplayError):
    """A live session that ended by a stop reason."""

    exit_code = 4


class CoverageMissed(HrcReplayError):
    """A fit that was written and holds fewer people that it was not fitted to than was asked for."""

    exit_code = 5


class SettingRenamed(FutureWarning):
    """A setting is given by a name of an earlier version."""
