"""Reads a user's TOML within limits on file size, nesting depth and key length, and checks its tables."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from hrcreplay.errors import SettingsError, shown

Model = TypeVar("Model", bound=BaseModel)

#: Maximum size of a file; settings, cells, tasks and limit sets have a few kB [bytes].
FILE_BYTES: Final = 2 << 20
#: Maximum number of dotted parts of a key; the parser is very slow for more.
_LONG_KEY = re.compile(r"""(?<![\w"'-])(?:[\w"'-]++[ \t]*+\.[ \t]*+){50}""")


def parse_toml(text: str, where: str | Path) -> dict[str, Any]:
    """Parses a text into a table.

    Args:
        text: TOML.
        where: Start of error messages, such as the file name.

    Raises:
        SettingsError: The text is not TOML or exceeds the limits.
    """
    if _LONG_KEY.search(text):
        raise SettingsError(f"{where}: found a key of over 50 parts; at most 50 are read")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(f"{where}: not TOML ({error})") from error
    except RecursionError as error:
        raise SettingsError(f"{where}: nested too deep; at most some hundred brackets are read") from error


def read_toml(path: Path, right: str) -> dict[str, Any]:
    """Reads a file into a table.

    Args:
        path: File.
        right: End of the error message, such as "name a cell file".

    Raises:
        SettingsError: The file cannot be read, is not TOML or exceeds the limits.
    """
    try:
        with path.open("rb") as file:
            data = file.read(FILE_BYTES + 1)
        if len(data) > FILE_BYTES:
            raise SettingsError(f"{path}: is larger than {FILE_BYTES >> 20} MB, the maximum for a TOML file; {right}")
        return parse_toml(data.decode("utf-8").replace("\r\n", "\n"), path)
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read ({error.strerror}); {right}") from error
    except UnicodeDecodeError as error:
        raise SettingsError(f"{path}: not TOML ({error})") from error


def validate(model: type[Model], table: Any, where: str | Path, right: Mapping[str, str] | None = None) -> Model:
    """Makes a model from a table.

    Args:
        model: The model, which forbids unknown keys.
        table: A parsed TOML table.
        where: Start of error messages, such as the file name.
        right: Key -> description of a valid value; the other keys are described in pydantic's words.

    Raises:
        SettingsError: A key is unknown or missing, or a value is invalid.
    """
    try:
        return model.model_validate(table)
    except ValidationError as error:
        raise SettingsError(f"{where}: {_first_problem(error, model, table, right or {})}") from error


def _first_problem(error: ValidationError, model: type[BaseModel], table: Any, right: Mapping[str, str]) -> str:
    """Describes one problem: an unknown key if there is one, as it may be a misspelled missing one."""
    problems = error.errors()
    problem = next((one for one in problems if one["type"] == "extra_forbidden"), problems[0])
    kind, loc = problem["type"], _without_tags(problem["loc"], table, missing=problem["type"] == "missing")
    if kind == "extra_forbidden":
        at, models = _place(model, loc[:-1], right)
        known = ", ".join(key for one in models for key in one.model_fields)
        return f"{at}{at and ': '}unknown key {shown(loc[-1])}; known here: {known}"
    at, _ = _place(model, loc, right)
    described = right.get(next((part for part in reversed(loc) if isinstance(part, str)), ""))
    wanted = f"would be right: {described}" if described else _reworded(problem["msg"])
    if kind == "missing":
        return f"{at} is missing; {wanted}"
    if kind == "value_error" and (text := str(problem["ctx"]["error"])):
        return f"{at}{at and ': '}{text}"
    return f"{at}: found {shown(problem['input'])}; {wanted}"


def _without_tags(loc: tuple[int | str, ...], table: Any, *, missing: bool) -> list[int | str]:
    """Removes the names of a union's variants, which are not in the table, from a location."""
    found, value = [], table
    for number, part in enumerate(loc):
        inside = isinstance(value, Mapping) and part in value
        inside |= isinstance(value, list | tuple) and isinstance(part, int) and part < len(value)
        if inside or (missing and number == len(loc) - 1):
            found.append(part)
            value = value[part] if inside else None
    return found


def _place(
    model: type[BaseModel], loc: list[int | str], right: Mapping[str, str]
) -> tuple[str, tuple[type[BaseModel], ...]]:
    """Returns a location in words, such as "waypoint 2: move", and the models of the table there.

    Tables in a list are counted from 1. The index of a value is left out if ``right`` describes the whole list.
    """
    models: tuple[type[BaseModel], ...] = (model,)
    text, key, is_list = "", "", False
    for part in loc:
        if isinstance(part, str):
            fields = [one.model_fields[part].annotation for one in models if part in one.model_fields]
            inner = tuple(found for annotation in fields for found in _models_in(annotation))
            models, key, is_list = inner or models, part, bool(inner)
            text += f".{part}" if text and not text.endswith(": ") else part
        elif is_list:
            text = f"{text.removesuffix('s')} {part + 1}: "
        elif key not in right:
            text += f".{part}"
    return text.removesuffix(": "), models


def _models_in(annotation: Any) -> tuple[type[BaseModel], ...]:
    """Lists the models in an annotation such as ``dict[str, Camera] | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return (annotation,)
    return tuple(model for part in get_args(annotation) for model in _models_in(part))


def _reworded(message: str) -> str:
    """Rewords pydantic's message in the words of TOML."""
    if message == "Field required":
        return "it has to be given"
    text = re.sub(r"^(Input|Value|Tuple|List|Dictionary|String) should", "it should", message)
    text = re.sub(r", unable to .*| after validation", "", text).replace("a valid boolean", "true or false")
    text = re.sub(r"valid dictionary( or instance of \w+)?", "table", text).replace("valid tuple", "list")
    return text[0].lower() + text[1:]
