"""TOML that a user wrote, read within limits: of its size, of how deep it is nested, of how long its keys are."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any, Final

from hrcreplay.errors import SettingsError

#: The longest file that is read; settings, cells, tasks and limit sets have some kB [bytes].
FILE_BYTES: Final = 2 << 20
#: A key of so many parts joined by dots takes the parser very long.
_LONG_KEY = re.compile(r"""(?<![\w"'-])(?:[\w"'-]++[ \t]*+\.[ \t]*+){50}""")


def parse_toml(text: str, where: str | Path) -> dict[str, Any]:
    """The table that a text is.

    Args:
        text: TOML.
        where: Start of error messages, as the file.

    Raises:
        SettingsError: It is not TOML, or beyond the limits.
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
    """The table that a file is.

    Args:
        path: File.
        right: What would be right where it cannot be read: "name a cell file".

    Raises:
        SettingsError: It cannot be read, is not TOML, or is beyond the limits.
    """
    try:
        with path.open("rb") as file:
            data = file.read(FILE_BYTES + 1)
        if len(data) > FILE_BYTES:
            raise SettingsError(
                f"{path}: has over {FILE_BYTES >> 20} MB, the most that is read of a TOML file; {right}"
            )
        return parse_toml(data.decode("utf-8").replace("\r\n", "\n"), path)
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read ({error.strerror}); {right}") from error
    except UnicodeDecodeError as error:
        raise SettingsError(f"{path}: not TOML ({error})") from error
