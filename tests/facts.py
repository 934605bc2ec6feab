"""Looks for facts in what was told: where, what was found, what would be right; the wording is free to change."""

from __future__ import annotations

import re
from collections.abc import Iterable


def facts(*tokens: str) -> str:
    """A pattern of texts that hold all tokens, as whole words and numbers in any order; for ``match=`` too.

    '0.3' is not found in '10.3', '0.35' or '-0.3', 'rate' not in 'rate_hz' or 'logs.rate'.
    """
    return "(?s)^" + "".join(rf"(?=.*{_whole(token)})" for token in tokens)


def tells(text: str | Iterable[str], *tokens: str) -> bool:
    """Whether the text, or one of several lines, holds all tokens."""
    return any(re.search(facts(*tokens), line) for line in ([text] if isinstance(text, str) else text))


def _whole(token: str) -> str:
    begin = r"(?<![\w.\u2212-])" if re.match(r"\w", token) else ""
    end = r"(?![\w-]|[.,]\w)" if re.search(r"\w$", token) else ""
    return begin + re.escape(token) + end
