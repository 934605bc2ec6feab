"""Loads the settings: defaults < settings file (TOML) < command line (``--set section.key=value``).

Packages that need settings take a whole section (``sections``); none of them loads it.
"""

from __future__ import annotations

import json
import re
import tomllib
import warnings
from collections.abc import Mapping
from pathlib import Path, PurePath
from typing import Any

from pydantic import BaseModel

from hrcreplay.errors import SettingRenamed, SettingsError
from hrcreplay.settings.sections import Settings, with_new_names
from hrcreplay.toml_file import read_toml, validate

__all__ = ["SHIPPED", "Settings", "as_overrides", "load_settings"]

#: Shipped settings files: ``--config paper``.
SHIPPED = {"paper": Path(__file__).with_name("paper.toml")}

#: Words that TOML does not read as text.
_WORDS = frozenset({"true", "false", "inf", "nan"})


#: Settings that name files; a relative path in a settings file is searched beside that file first.
_PATHS = (
    ("robot", "urdf"),
    ("robot", "srdf"),
    ("robot", "packages"),
    ("plan", "task"),
    ("limits", "tracking"),
    ("limits", "prediction"),
    ("live", "zenoh", "config"),
    ("live", "zenoh", "secret"),
)


def load_settings(
    path: Path | None = None,
    overrides: tuple[str, ...] = (),
    base: dict[str, Any] | None = None,
    given: Mapping[str, Mapping[str, Any]] | None = None,
) -> Settings:
    """Loads settings from a TOML file and ``section.key=value`` overrides, over those of an earlier run (``base``).

    Args:
        path: A file, or one of the names in SHIPPED if no such file exists.
        overrides: ``section.key=value``.
        base: The settings of an earlier run.
        given: Section -> key -> value; they override the file and are overridden by ``overrides``.

    Raises:
        SettingsError: The file cannot be read, or a key or value is unknown.
    """
    table, _ = with_new_names(base or {})
    where = "settings"
    if path is not None:
        where = str(path)
        file = SHIPPED.get(where, path) if not path.exists() else path
        read = read_toml(file, f"name a TOML file, or {', '.join(SHIPPED)}")
        _merge(table, _beside(_renamed(read, where), file.parent))
    _merge(table, given or {})
    for override in overrides:
        _merge(table, _renamed(_override(override), f"--set {override}"))
    return validate(Settings, table, where)


def _renamed(table: dict[str, Any], where: str) -> dict[str, Any]:
    """Replaces old names by new ones; warns of old names."""
    found, replaced = with_new_names(table)
    for old, new in replaced.items():
        warnings.warn(
            f"{where}: {old} is now called {new}; this version still reads the old name", SettingRenamed, stacklevel=3
        )
    return found


def _merge(table: dict[str, Any], layer: Mapping[str, Any]) -> None:
    """Merges the sections of a layer into the table; an entry that is not a section is kept and rejected later."""
    for name, section in layer.items():
        below = table.get(name, {})
        table[name] = {**below, **section} if isinstance(section, Mapping) and isinstance(below, Mapping) else section


def _beside(table: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Replaces relative paths of files beside a settings file by paths from the working directory."""
    for path in _PATHS:
        table = _one_beside(table, path, folder)
    return table


def _one_beside(table: dict[str, Any], path: tuple[str, ...], folder: Path) -> dict[str, Any]:
    """Does the same for one setting, if present."""
    name, rest = path[0], path[1:]
    given = table.get(name)
    if rest:
        return table | {name: _one_beside(given, rest, folder)} if isinstance(given, dict) else table
    if isinstance(given, list):
        return table | {name: [_beside_or_same(one, folder) for one in given]}
    return table | {name: _beside_or_same(given, folder)} if name in table else table


def _beside_or_same(given: Any, folder: Path) -> Any:
    named = isinstance(given, str) and given not in ("paper", "human", "people", "none", "")
    return str(folder / given) if named and (folder / given).exists() else given


def as_overrides(settings: Settings) -> tuple[str, ...]:
    """Returns the settings that differ from the defaults, as ``section.key=value``; files by name, without folders."""
    found = []
    for name in sorted(Settings.model_fields):
        section, usual = getattr(settings, name), getattr(Settings(), name)
        for key in sorted(type(section).model_fields):
            value = getattr(section, key)
            if value != getattr(usual, key) and value is not None:
                found.append(f"{name}.{key}={_toml(value)}")
    return tuple(found)


def _toml(value: Any, *, inside: bool = False) -> str:
    """Returns a value in the form that ``--set`` takes: TOML or a plain word."""
    if isinstance(value, BaseModel):
        usual = {name: field.default for name, field in type(value).model_fields.items()}
        value = {name: part for name in usual if (part := getattr(value, name)) != usual[name]}
    if value is None:
        return '"none"'
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {_toml(part, inside=True)}" for key, part in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml(part, inside=True) for part in value) + "]"
    if isinstance(value, PurePath) or (isinstance(value, str) and value.endswith(".toml")):
        value = PurePath(value).name
    plain = isinstance(value, str) and re.fullmatch(r"[A-Za-z_][\w.-]*", value) and value not in _WORDS
    return str(value) if plain and not inside else json.dumps(value)


def _override(text: str) -> dict[str, Any]:
    """Parses ``section.key=value`` into section -> key -> value."""
    key, equals, value = text.partition("=")
    parts = key.strip().split(".")
    if not equals or len(parts) != 2:
        raise SettingsError(f"--set {text}: not of the form section.key=value; e.g. --set fusion.rate_hz=100")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        parsed = value.strip()
    except RecursionError as error:
        raise SettingsError(f"--set {key}=...: nested too deep; at most some hundred brackets are read") from error
    return {parts[0]: {parts[1]: parsed}}
