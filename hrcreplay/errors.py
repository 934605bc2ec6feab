"""User errors, each with its exit code.

A message says *where: what was found; what would be right*. A bug keeps its traceback.
"""

from __future__ import annotations

#: Exit codes of ``verify`` for a run that does not reproduce bit by bit. First: something differs. Second: only numbers
#: differ, by at most 1e-9, and the run was recorded on another machine.
EXIT_DIFFERS, EXIT_SAME_DECISIONS = 1, 6

#: Exit code of a command that Ctrl-C ended: 128 + SIGINT, as shells count.
EXIT_INTERRUPTED = 130

_SHOWN = 200


def shown(value: object) -> str:
    """Returns a value as messages show it: its repr, shortened if long."""
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


class HrcReplayError(Exception):
    """An error that the user can correct. The command prints the message and exits with ``exit_code``."""

    exit_code = 1


class SettingsError(HrcReplayError):
    """A setting, an argument, a cell file, a task or an output folder cannot be used."""

    exit_code = 2


class LogError(HrcReplayError):
    """A log cannot be read, or lacks data that a stage needs."""

    exit_code = 3


class LiveStopped(HrcReplayError):
    """A stop reason ended a live session."""

    exit_code = 4


class CoverageMissed(HrcReplayError):
    """A fit was written, but its coverage of the held-out people is below the requested share."""

    exit_code = 5


class RunsFailed(HrcReplayError):
    """Some runs of a sweep failed; the others are complete."""

    exit_code = 7


class SettingRenamed(FutureWarning):
    """A setting has a name from an earlier version."""
