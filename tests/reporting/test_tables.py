"""Numbers as the page and the terminal write them."""

from __future__ import annotations

import pytest

from hrcreplay.reporting import tables


@pytest.mark.parametrize(
    ("share", "decimals", "text"),
    [
        (1.0, 1, "100.0 %"),
        (0.99997, 1, "99.9 %"),
        (0.99997, 2, "99.99 %"),
        (0.9996, 1, "99.9 %"),
        (0.9989, 1, "99.9 %"),
        (0.005, 0, "1 %"),
        (1e-6, 1, "0.1 %"),
        (0.0, 1, "0.0 %"),
        (1.204, 1, "120.4 %"),
    ],
)
def test_only_all_is_written_as_100_and_only_none_as_0(share: float, decimals: int, text: str) -> None:
    assert tables.share_text(share, decimals) == text
    assert tables.percent({"value": share}, decimals) == text


@pytest.mark.parametrize(
    ("metres", "text"),
    [(0.1099, "10 cm"), (0.11, "11 cm"), (0.29, "29 cm"), (0.0, "0 cm"), (-0.151, "\u221216 cm"), (1.289, "128 cm")],
)
def test_a_distance_is_never_told_too_large(metres: float, text: str) -> None:
    assert tables.centimetres(metres) == text
