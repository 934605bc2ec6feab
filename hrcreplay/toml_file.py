"""Reads a user's TOML within limits on file size, nesting depth and key length."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any, Final

from hrcreplay.errors import SettingsError

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
