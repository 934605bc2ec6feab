"""docs/reference.md names every column, word, figure and error line that there is, and no other."""

from __future__ import annotations

import re
from itertools import product

import pytest

from hrcreplay.errors import LogError
from hrcreplay.human.model import PARTS
from hrcreplay.logs import mcap_stream
from hrcreplay.records import BODY, BORDER, JOINTS, LENGTHS, LIMBS, POINTS, STATUSES
from hrcreplay.reporting.figures.catalogue import FIGURES
from hrcreplay.robot.control.control_step import REASONS
from hrcreplay.store.columns import COLUMNS
from tests.tools.readme import __main__ as readme
from tests.tools.readme import reference

TEXT = readme.REFERENCE.read_text()
#: What stands in a name for several.
SEVERAL = {
    "joint": JOINTS,
    "length": ("pi_pelvis_height", *LENGTHS),
    "limb": BODY,
    "point": POINTS,
    "part": PARTS,
    "axis": ("x", "y", "z"),
}

#: Words of lines that a function puts together before they are raised.
_PUT_TOGETHER = ("unknown key", "no skeleton topic")


def _rows(heading: str) -> list[list[str]]:
    """The cells of all tables below a heading, without their heads."""
    below = re.split(rf"^#+ {re.escape(heading)}$", TEXT, flags=re.MULTILINE)[1]
    lines = re.split(r"^#", below, flags=re.MULTILINE)[0].splitlines()
    tables = [line for line in lines if line.startswith("|")]
    heads = {i + k for i, line in enumerate(tables) if line.startswith("|---") for k in (-1, 0)}
    return [[cell.strip() for cell in line.strip("|").split("|")] for i, line in enumerate(tables) if i not in heads]


def _words(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def _names(word: str) -> set[str]:
    """Every name that a word with <...> in it stands for."""
    parts = re.split(r"<(\w+)>", word)
    chosen = product(*(SEVERAL[part] for part in parts[1::2]))
    return {"".join(a + b for a, b in zip(parts[::2], (*names, ""), strict=True)) for names in chosen}


@pytest.mark.parametrize("block", ["figures", *reference.ERRORS])
def test_the_blocks_are_there(block: str) -> None:
    assert [name for _, name, _, _ in reference.BLOCK.findall(TEXT)].count(block) == 1


def test_the_blocks_are_what_the_code_holds() -> None:
    assert reference.fill(TEXT) == TEXT, "make readme"


def test_error_lines_are_those_that_are_raised() -> None:
    lines = reference.error_lines()
    assert "\u2026: breaks off within the MCAP header; record or copy it again" in lines["log"]
    assert "\u2026: found \u2026 joints; \u2026 has \u2026 axes" in lines["task"]
    with pytest.raises(LogError, match=": breaks off within the MCAP header; record or copy it again"):
        mcap_stream.McapStream(readme.FACTS)


#: Begins of columns that only some runs have: with a watched area, or with objects in the cell.
SOMETIMES = ("nobody", "object", "self_")


@pytest.mark.parametrize("table", COLUMNS)
def test_every_column_is_explained(table: str) -> None:
    words = [word for row in _rows(f"{table}.parquet") for word in _words(row[0])]
    several = table != "contact" and "person"  # of several people; contact.parquet always says whose person it is
    counted = ("<n>", "<camera>", "<k>")
    own = [word for word in words if not any(part in word for part in counted) and not word.startswith(SOMETIMES)]
    own = [word for word in own if word != several]
    named = [name for word in own for name in _names(word)]
    assert sorted(named) == sorted(set(COLUMNS[table]))


def test_every_name_of_the_body_is_explained() -> None:
    rows = _rows("Names of the body")
    assert [word for row in rows for word in _words(row[0])] == [
        *("x", "y", "theta", "rho", "ar1", "ar2", "ar3", "ar4", "al1", "al2", "al3", "al4", "z"),
        *("HD", "THX", "URA", "ULA", "LRA", "LLA", "LEGS", BORDER),
    ]
    assert set(LIMBS) < {word for row in rows for word in _words(row[0])}
    assert {*LENGTHS, "THIGH_R", "SHANK_R", "HAND_R", "FOOT_R"} <= set(_words(TEXT))


def test_every_status_and_reason_is_explained() -> None:
    words = [_words(row[0])[0] for row in _rows("Status and reason")]
    assert sorted(words) == sorted([*STATUSES, *(reason for reason in REASONS if reason)])


def test_every_figure_is_explained() -> None:
    assert [_words(row[0])[0] for row in _rows("Figures")] == [kind.name for kind in FIGURES]


def test_the_lines_that_people_meet_first_are_lines() -> None:
    lines = "\n".join(line for lines in reference.error_lines().values() for line in lines)
    for row in _rows("Error lines"):
        for word in _words(row[0]):
            assert word in lines or word in _PUT_TOGETHER, word
