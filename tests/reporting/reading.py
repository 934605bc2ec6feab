"""The report page as a reader finds it: well-formed HTML, its visible text, and the golden text of one run."""

from __future__ import annotations

import re
import tempfile
from html.parser import HTMLParser
from pathlib import Path

import numpy as np

from hrcreplay.human.model import LimitSet
from hrcreplay.reporting import summary_text, tables
from hrcreplay.reporting.figures.catalogue import FIGURES
from hrcreplay.reporting.page import report_page
from hrcreplay.store.run_folder import Run
from tests.reporting.synthetic import contact_run, metrics_of

GOLDEN = Path(__file__).parent / "golden" / "report.txt"
PI = np.pi
PAPER = LimitSet(
    name="paper",
    p_min=np.array([-np.inf, -np.inf, -np.inf, -PI / 6, *([-PI / 20, -PI, -PI, PI / 9] * 2), 0.0]),
    p_max=np.array([np.inf, np.inf, np.inf, PI / 2, *([8 * PI / 9, PI, PI, PI] * 2), 1.3]),
    v_min=np.array([0.0, -0.8, -PI / 4, -PI / 10, *([-PI / 2, -PI / 2, -PI / 2, -3 * PI / 10] * 2), 0.0]),
    v_max=np.array([0.8, 0.8, PI / 4, PI / 10, *([PI / 2, PI / 2, PI / 2, 3 * PI / 10] * 2), 0.0]),
    a_min=-np.array([0.1, 0.1, PI / 8, PI / 20, *([PI / 4, PI / 4, PI / 4, 3 * PI / 20] * 2), 0.1]),
    a_max=np.array([0.1, 0.1, PI / 8, PI / 20, *([PI / 4, PI / 4, PI / 4, 3 * PI / 20] * 2), 0.1]),
    coupled=True,
)
RADII = {"head": 0.12, "thorax": 0.15, "upper arm": 0.07, "lower arm": 0.07}


class Reader(HTMLParser):
    """What a browser would take from the page."""

    VOID = frozenset({"meta", "link", "img", "br", "hr", "input"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.tags: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag not in self.VOID:
            self.open.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(str(value))
            if name in ("href", "src"):
                self.links.append(str(value))

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] not in ("style", "script"):
            self.text.append(data)


def rendered(run: Run, folder: Path) -> str:
    """The page with the figures that the folder holds."""
    metrics = metrics_of(run)
    used = [tables.limit_table(PAPER, use="prediction"), tables.radius_table(RADII)]
    return report_page.render(run, metrics, folder, used)


def read(html: str) -> Reader:
    reader = Reader()
    reader.feed(html)
    assert not reader.open
    return reader


class _Lines(Reader):
    INLINE = frozenset({"a", "code", "b", "span", "strong", "small", "th", "td", "dt", "dd"})

    def __init__(self) -> None:
        super().__init__()
        self.line = ""
        self.lines: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.INLINE or tag == "dt":
            self.end_line()
        super().handle_starttag(tag, attrs)
        heading = re.fullmatch(r"h(\d)", tag)
        self.line += f"{'#' * int(heading[1])} " if heading else ""

    def handle_endtag(self, tag: str) -> None:
        super().handle_endtag(tag)
        if tag not in self.INLINE:
            self.end_line()
        elif tag not in ("a", "code"):
            self.line += " | "

    def handle_data(self, data: str) -> None:
        if not set(self.open) & {"style", "script", "svg"}:
            self.line += re.sub(r"\s+", " ", data)

    def end_line(self) -> None:
        line = re.sub(r"( \| *)+$", "", self.line).strip()
        self.lines += [line] if line else []
        self.line = ""


def page_lines(html: str) -> list[str]:
    """The visible text: a line for each paragraph, caption and item, and for each row of a table."""
    reader = _Lines()
    reader.feed(html)
    reader.end_line()
    return reader.lines


def golden_text() -> str:
    """The terminal's lines and the page of the made-up run with contacts, its figures left blank."""
    run = contact_run()
    with tempfile.TemporaryDirectory() as folder:
        for kind in FIGURES:
            (Path(folder) / f"{kind.name}.svg").write_text('<svg viewBox="0 0 1 1"></svg>')
        html = rendered(run, Path(folder))
    return "\n".join(["= Terminal", *summary_text.lines(run, metrics_of(run)), "", "= Page", *page_lines(html), ""])
