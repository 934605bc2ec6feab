"""All settings, by section, and where they come from.

Precedence: defaults < settings file (TOML) < command line (``--set section.key=value``).
Rooms below never see these models: the drivers hand them plain values.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from hrcreplay.errors import SettingsError
from hrcreplay.sections import Fusion, Limits, Logs, Occupancy, Plan, Report, Robot, Section
from hrcreplay.sections_live import Live


class Settings(Section):
    """Everything a run depends on beside the log and the cell."""

    logs: Logs = Logs()
    fusion: Fusion = Fusion()
    limits: Limits = Limits()
    occupancy: Occupancy = Occupancy()
    robot: Robot = Robot()
    plan: Plan = Plan()
    report: Report = Report()
    live: Live = Live()


def load_settings(
    path: Path | None = None, overrides: tuple[str, ...] = (), base: dict[str, Any] | None = None
) -> Settings:
    """Settings from a TOML file and ``section.key=value`` overrides, over those of an earlier run (``base``).

    Raises:
        SettingsError: The file cannot be read, or a key or value is not known.
    """
    table: dict[str, Any] = {name: dict(section) for name, section in (base or {}).items()}
    where = "settings"
    if path is not None:
        where = str(path)
        try:
            for name, section in tomllib.loads(path.read_text()).items():
                table[name] = table.get(name, {}) | section if isinstance(section, dict) else section
        except OSError as error:
            raise SettingsError(f"{path}: cannot be read ({error.strerror}); name a TOML file") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise SettingsError(f"{path}: not TOML ({error})") from error
    for override in overrides:
        _override(table, override)
    try:
        return Settings.model_validate(table)
    except ValidationError as error:
        raise SettingsError(f"{where}: {_first_problem(error)}") from error


def _override(table: dict[str, Any], text: str) -> None:
    key, equals, value = text.partition("=")
    parts = key.strip().split(".")
    if not equals or len(parts) != 2:
        raise SettingsError(f"--set {text}: not of the form section.key=value; e.g. --set fusion.rate_hz=100")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        parsed = value.strip()
    section = table.setdefault(parts[0], {})
    if not isinstance(section, dict):
        raise SettingsError(f"--set {text}: {parts[0]} is not a section of the settings file")
    section[parts[1]] = parsed


def _first_problem(error: ValidationError) -> str:
    problem = error.errors()[0]
    loc = [str(part) for part in problem["loc"]]
    if problem["type"] == "extra_forbidden":
        known = Settings.model_fields if len(loc) == 1 else _section_keys(loc[0])
        return f"unknown setting {'.'.join(loc)!r}; known here: {', '.join(known)}"
    return f"{'.'.join(loc)}: found {problem['input']!r}; {problem['msg'][0].lower()}{problem['msg'][1:]}"


def _section_keys(name: str) -> list[str]:
    field = Settings.model_fields.get(name)
    section = field.annotation if field else None
    return list(section.model_fields) if isinstance(section, type) and issubclass(section, BaseModel) else []
