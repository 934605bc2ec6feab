from __future__ import annotations

import pytest

from tests.facts import tells


@pytest.mark.parametrize("token", ["0.3", "rate", "3 ticks", "a.mcap", "--out", "[2, 1]"])
def test_a_fact_is_found_anywhere(token: str) -> None:
    for text in (token, f"/there/{token}: found", f"'{token}', then", f"first\n({token})."):
        assert tells(text, token)
        assert tells(["other", text], token)
        assert not tells(text, token, "other")


@pytest.mark.parametrize(
    ("token", "text"),
    [
        ("0.3", "10.3 s"),
        ("0.3", "0.35 s"),
        ("0.3", "-0.3 s"),
        ("3 ticks", "1.3 ticks"),
        ("2", "2.5"),
        ("2", "2,500"),
        ("rate", "rate_hz"),
        ("rate", "logs.rate"),
        ("a", "a_b"),
    ],
)
def test_a_part_of_a_word_or_number_is_no_fact(token: str, text: str) -> None:
    assert not tells(text, token)


def test_facts_of_two_lines_are_not_those_of_one() -> None:
    assert not tells(["left 3", "right 4"], "left", "4")
