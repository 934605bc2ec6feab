"""Prints all settings with their defaults, units and meanings, as a settings file."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator
from pathlib import PurePath
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel

from hrcreplay.errors import SettingsError, shown
from hrcreplay.settings.sections import Section, Settings

_WIDTH = 100


def as_toml(only: str | None = None, *, commented: bool = False) -> str:
    """Returns the default settings as a settings file, each preceded by its meaning.

    Args:
        only: Name of a section; None: all.
        commented: True: the values are commented out, as in a file to be edited.

    Raises:
        SettingsError: There is no such section.
    """
    settings = Settings()
    names = list(Settings.model_fields)
    if only is not None and only not in names:
        raise SettingsError(f"settings: found {shown(only)}; would be right: {', '.join(names)}")
    chosen = names if only is None else [only]
    sections = ((name, getattr(settings, name)) for name in chosen)
    return "\n".join(
        line for name, section in sections for line in _section(name, section, _summary(section), commented=commented)
    )


def _section(name: str, section: Section, meaning: str, *, commented: bool) -> Iterator[str]:
    yield from _comment(meaning)
    yield f"[{name}]"
    inner = []
    for key, field in type(section).model_fields.items():
        value = getattr(section, key)
        if isinstance(value, Section) and _is_table(value):
            inner.append((key, value, field.description or _summary(value)))
            continue
        yield from _comment(field.description or "")
        if choices := _choices(field.annotation):
            yield f"# One of {', '.join(choices)}."
        yield f"{'# ' if commented else ''}{key} = {_value(value)}"
    yield ""
    for key, value, about in inner:
        yield from _section(f"{name}.{key}", value, about, commented=commented)


def _summary(section: Section) -> str:
    return (type(section).__doc__ or "").split("\n\n")[0]


def _is_table(section: Section) -> bool:
    """Returns True if a nested section is large enough for a separate table."""
    return len(type(section).model_fields) > 3


def _comment(text: str) -> Iterator[str]:
    for line in textwrap.wrap(" ".join(text.split()), _WIDTH):
        yield f"# {line}"


def _choices(annotation: Any) -> list[str]:
    if get_origin(annotation) is Literal:
        return [json.dumps(choice) for choice in get_args(annotation)]
    return [choice for part in get_args(annotation) for choice in _choices(part)]


def _value(value: Any) -> str:
    """Returns a value as TOML; "none" for a missing one."""
    if value is None:
        return '"none"'
    if isinstance(value, BaseModel):
        return "{" + ", ".join(f"{name} = {_value(getattr(value, name))}" for name in type(value).model_fields) + "}"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {_value(part)}" for key, part in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_value(part) for part in value) + "]"
    return json.dumps(str(value) if isinstance(value, PurePath) else value)
