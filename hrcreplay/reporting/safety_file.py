"""The safety file of a run: four pages of PDF to print, sign and file. Its text can be searched.

Every page says that it is no certificate, and the second page says what was not checked. The same run gives the same
bytes: the date in the file is that of the run.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path, PurePath
from typing import Any

import matplotlib as mpl
import numpy as np
from fpdf import FPDF, FontFace

from hrcreplay.records import ALLOWING_CONTACT, UNGUARDED, Floats
from hrcreplay.reporting import summary_text
from hrcreplay.reporting.metrics.fusion import cameras
from hrcreplay.reporting.metrics.series import Metric
from hrcreplay.reporting.severity import severity_tables
from hrcreplay.reporting.tables import NOT_CLAIMED, PageTable, counted, text_of
from hrcreplay.reporting.verdict import verdict
from hrcreplay.settings.sections import Settings, with_new_names
from hrcreplay.store.run_folder import Run, sha256

PAGES = 4
QUESTION = "Had this controller been running, would the person have been safe, and what would it have cost the task?"
#: On every page.
CAUTION = (
    "A research tool's reading of one recording: no certificate, no risk assessment. What was not checked: page 2."
)

#: Attempts to fit all on four pages: size of the letters as a share, and number of remarks that are printed.
_FITS = ((1.0, 12), (0.92, 12), (0.86, 10), (0.8, 8), (0.74, 6), (0.68, 4), (0.62, 0))
_INK, _SOFT, _LINE, _WASH = (29, 39, 48), (91, 105, 118), (205, 212, 219), (243, 246, 248)
_MARGIN_MM = 17.0

Metrics = Mapping[str, Metric]
#: A still: its caption, and the picture as PNG.
Still = tuple[str, bytes]


def safety_file(run: Run, metrics: Metrics, stills: Sequence[Still]) -> bytes:
    """Makes the PDF of a run with a robot.

    Args:
        run: The run's tables.
        metrics: Its metrics.
        stills: Pictures for the third page, up to two.
    """
    for size, remarks in _FITS:
        made = _make(run, metrics, stills, size, remarks)
        if made.pages_count == PAGES:
            break
    return bytes(made.output())


def _make(run: Run, metrics: Metrics, stills: Sequence[Still], size: float, remarks: int) -> _Paper:
    """Makes the four sections, each on a page of its own if it fits."""
    paper = _Paper(run, size)
    _first(paper, run, metrics)
    _limits(paper, run, metrics, remarks)
    _methods(paper, run, metrics, stills)
    _proof(paper, run)
    return paper


class _Paper(FPDF):
    """A4 pages with a head, a foot, and the elements of the sections."""

    def __init__(self, run: Run, size: float) -> None:
        super().__init__(format="A4")
        self._size, self._name = size, log_name(run)
        self._version = run.meta.get("versions", {}).get("hrcreplay", "")
        fonts = Path(mpl.get_data_path()) / "fonts" / "ttf"
        for style, name in (("", "DejaVuSans"), ("B", "DejaVuSans-Bold"), ("I", "DejaVuSans-Oblique")):
            self.add_font("DejaVu", style, fonts / f"{name}.ttf")
        self.set_margins(_MARGIN_MM, 15.0)
        self.set_auto_page_break(True, 19.0)
        self.set_title(f"Safety file: {self._name}")
        self.set_creator(f"hrcreplay {self._version}")
        self.set_lang("en")
        self.set_creation_date(datetime.fromisoformat(str(run.meta.get("created", "2000-01-01T00:00:00Z"))))

    def footer(self) -> None:
        """Says on each page what it is not."""
        self.set_y(-15.0)
        self._letters(6.6, colour=_SOFT)
        self.set_draw_color(*_LINE)
        self.line(_MARGIN_MM, self.get_y() - 1.5, self.w - _MARGIN_MM, self.get_y() - 1.5)
        self.multi_cell(0, 3.4, f"{CAUTION}\nhrcreplay {self._version}, {self._name}, page {self.page_no()} of {{nb}}")

    def section(self, title: str) -> None:
        """Begins a page."""
        self.add_page()
        self._letters(15.0, "B")
        self.multi_cell(0, 7.2 * self._size, title, new_x="LMARGIN", new_y="NEXT")
        self.ln(1.5)

    def heading(self, title: str) -> None:
        """Begins a part of a page."""
        self.ln(2.2 * self._size)
        self._letters(10.0, "B")
        self.multi_cell(0, 5.0 * self._size, title, new_x="LMARGIN", new_y="NEXT")
        self.ln(0.6)

    def words(self, text: str, *, bold: bool = False, small: bool = False) -> None:
        """Writes a paragraph."""
        self._letters(7.2 if small else 8.6, "B" if bold else "", _SOFT if small else _INK)
        self.multi_cell(0, (3.5 if small else 4.3) * self._size, text, new_x="LMARGIN", new_y="NEXT", align="L")
        self.ln(0.9 * self._size)

    def points(self, texts: Sequence[str]) -> None:
        """Writes a list."""
        self._letters(8.2)
        for text in texts:
            self.cell(4.0, 4.1 * self._size, "\u2022")
            self.multi_cell(0, 4.1 * self._size, text, new_x="LMARGIN", new_y="NEXT", align="L")
            self.ln(0.7 * self._size)

    def pairs(self, rows: Sequence[tuple[str, str]]) -> None:
        """Writes a table of names and values, without the empty ones."""
        self._letters(8.0)
        self.set_draw_color(*_LINE)
        with self.table(
            col_widths=(34, 142),
            borders_layout="HORIZONTAL_LINES",
            line_height=4.0 * self._size,
            first_row_as_headings=False,
            text_align="LEFT",
            padding=0.5 * self._size,
        ) as table:
            for name, value in rows:
                if value:
                    row = table.row()
                    row.cell(name, style=FontFace(color=_SOFT))
                    row.cell(value)

    def grid(self, of: PageTable, widths: Sequence[int], left: Sequence[int] = (0,)) -> None:
        """Writes a table with its headings and its note; ``left``: columns of words."""
        self.heading(of.title)
        self._letters(6.5)
        self.set_draw_color(*_LINE)
        with self.table(
            col_widths=tuple(widths),
            borders_layout="HORIZONTAL_LINES",
            line_height=3.1 * self._size,
            headings_style=FontFace(emphasis="BOLD", fill_color=_WASH),
            text_align=tuple("LEFT" if i in left else "RIGHT" for i in range(len(of.columns))),
            padding=0.5 * self._size,
        ) as table:
            for cells in (of.columns, *of.rows):
                table.row([" ".join(cell.split("\n")) for cell in cells])
        self.ln(0.8)
        if of.note:
            self.words(of.note, small=True)

    def box(self, texts: Sequence[str]) -> None:
        """Writes the verdict beside a bar."""
        top = self.get_y() + 1.0
        self.set_left_margin(_MARGIN_MM + 4.0)
        self.set_xy(_MARGIN_MM + 4.0, top)
        for text in texts:
            self._letters(10.2, "B")
            self.multi_cell(0, 5.2 * self._size, text, new_x="LMARGIN", new_y="NEXT", align="L")
            self.ln(1.0 * self._size)
        self.set_left_margin(_MARGIN_MM)
        self.set_fill_color(0, 114, 178)
        self.rect(_MARGIN_MM, top, 1.3, self.get_y() - top, style="F")
        self.set_fill_color(255)
        self.set_xy(_MARGIN_MM, self.get_y() + 1.0)

    def pictures(self, stills: Sequence[Still]) -> None:
        """Shows pictures side by side, each above its caption."""
        gap, width = 4.0, (self.epw - 4.0) / 2.0
        top, low = self.get_y() + 1.0, 0.0
        for i, (caption, png) in enumerate(stills):
            left = _MARGIN_MM + i * (width + gap)
            placed = self.image(io.BytesIO(png), x=left, y=top, w=width, alt_text=caption)
            self.set_xy(left, top + placed.rendered_height + 0.5)
            self._letters(6.8, colour=_SOFT)
            self.multi_cell(width, 3.2 * self._size, caption, new_x="LMARGIN", new_y="NEXT", align="L")
            low = max(low, self.get_y())
        self.set_xy(_MARGIN_MM, low)

    def signatures(self) -> None:
        """Leaves room for names, dates and signatures."""
        self.ln(9.0 * self._size)
        width = (self.epw - 12.0) / 3.0
        self._letters(7.6, colour=_SOFT)
        for title in ("Prepared by, date, signature", "Reviewed by, date, signature"):
            y = self.get_y()
            self.set_draw_color(*_INK)
            self.line(_MARGIN_MM, y, _MARGIN_MM + 2.0 * width, y)
            self.set_xy(_MARGIN_MM, y + 0.8)
            self.cell(0, 4.0, title, new_x="LMARGIN", new_y="NEXT")
            self.ln(9.0 * self._size)

    def _letters(self, points: float, style: str = "", colour: tuple[int, int, int] = _INK) -> None:
        self.set_font("DejaVu", style, points * self._size)
        self.set_text_color(*colour)


def log_name(run: Run) -> str:
    """Name of the run's log, without its folder."""
    inputs = run.meta.get("inputs", [])
    return PurePath(str(inputs[0]["path"])).name if inputs else "a session"


def _first(paper: _Paper, run: Run, metrics: Metrics) -> None:
    """Question, verdict, recording and cell."""
    found = verdict(run, metrics)
    paper.section("Safety file of a recorded human-robot session")
    paper.words(QUESTION, bold=True)
    paper.heading("Verdict")
    if found is None:
        paper.box(["Nobody was recorded to compare the robot with: there is no verdict."])
    else:
        paper.box(found.sentences)
        for text in (found.held, found.speeds, *found.details):
            if text:
                paper.words(text)
    paper.heading("Recording")
    inputs = run.meta.get("inputs", [])
    seen = cameras(run)
    paper.pairs(
        (
            ("Log", log_name(run)),
            ("SHA-256", str(inputs[0]["sha256"]) if inputs else ""),
            ("Length", f"{text_of(metrics['span_s'])}, {text_of(metrics['ticks'])} ticks{_span(run)}"),
            ("Cameras", ", ".join(_camera(run, name) for name in seen)),
            ("Person known", _person(metrics)),
        )
    )
    paper.heading("Cell")
    robot, cell = run.meta.get("robot", {}), run.meta.get("cell") or {}
    axes = len(robot.get("joints", ()))
    objects = [str(one.get("name", "")) for one in cell.get("objects", [])]
    paper.pairs(
        (
            ("Robot", f"{robot.get('name', '')}, {axes} axes" if robot else ""),
            ("Its base", "" if run.T_world_base is None else _pose(run.T_world_base)),
            ("Its mass", str(robot.get("mass", ""))),
            ("Objects", ", ".join(objects) or "none given: table, fixtures and walls are not looked at"),
            ("Programme", _programme(run)),
        )
    )


def _span(run: Run) -> str:
    span = run.meta.get("span_s")
    return "" if not span or None in span else f", from {span[0]:g} to {span[1]:g} s of the log"


def _camera(run: Run, name: str) -> str:
    pose = (run.meta.get("cameras") or {}).get(name)
    return name if pose is None else f"{name} at {_point(np.asarray(pose, dtype=float)[:3, 3])}"


def _point(at_m: Floats) -> str:
    return f"({', '.join(f'{value:.2f}' for value in at_m.tolist())}) m".replace("-", "\u2212")


def _pose(T: Floats) -> str:
    turned = f"{np.degrees(np.arctan2(T[1, 0], T[0, 0])) + 0.0:.0f}".replace("-", "\u2212")
    return f"{_point(T[:3, 3])}, turned by {turned} degrees about z"


def _person(metrics: Metrics) -> str:
    judge, known = metrics["contact_person"]["value"], metrics.get("plan_body_known_ticks")
    if judge is None or known is None:
        return ""
    return f"at {text_of(known)} of {text_of(metrics['plan_ticks'])} ticks, by the {judge}"


def _programme(run: Run) -> str:
    task = run.meta.get("task")
    if task:
        return "a task file"
    return "the recorded joints" if run.meta.get("programme") == "recorded joints" else "the task in the log"


def _limits(paper: _Paper, run: Run, metrics: Metrics, most: int) -> None:
    """What was considered, and what was not. This page is never left out."""
    found = verdict(run, metrics)
    paper.section("What was considered, and what was not")
    settings, _ = with_new_names(run.meta.get("settings", {}))
    prediction, plan = settings.get("prediction", {}), settings.get("plan", {})
    paper.heading("Considered")
    limits = settings.get("limits", {}).get("prediction", "")
    rule = "steps only with a certificate" if plan.get("certify") else "steps without a certificate"
    if plan.get("method") in (*ALLOWING_CONTACT, *UNGUARDED):
        rule = "no step has a certificate"
    considered = [
        (
            f"Where the person can get to: volumes by the method {prediction.get('method')}, limit set "
            f"{PurePath(str(limits)).name}, up to the end of the stop that would follow each step."
        ),
        (
            f"The robot by capsules around its links, at each of {text_of(metrics['ticks'])} ticks; method "
            f"{plan.get('method')}, {rule}."
        ),
        *(found.scope[:-1] if found else ()),
    ]
    paper.points(considered)
    paper.heading("Not considered")
    paper.points([*(found.scope[-1:] if found else ()), *NOT_CLAIMED])
    answers = summary_text.answers(run, metrics)
    paper.heading("Answers in full")
    for answer in answers:
        paper.words(f"{answer.question} {answer.short}", bold=True)
        paper.words(answer.words.replace("\n", " "), small=True)
    notes = summary_text.defect_notes(run.counts, run.notes)
    if notes:
        paper.heading("Remarks on the recording and the robot")
        left = len(notes) - most
        more = [f"{counted(left, 'more remark')}: see notes and counts in run.json, or the page."] if left > 0 else []
        paper.points([*notes[:most], *more])


def _methods(paper: _Paper, run: Run, metrics: Metrics, stills: Sequence[Still]) -> None:
    """The methods side by side, severity of contact, and stills."""
    found = verdict(run, metrics)
    paper.section("Methods side by side")
    if found is not None:
        paper.grid(found.table, (26, 20, 17, 20, 24, 18, 16, 19, 16))
    for table in severity_tables(run):
        paper.grid(table, (22, 16, 20, 42, 18, 18, 16, 20, 18), (0, 3))
    if stills:
        paper.pictures(stills)


def _proof(paper: _Paper, run: Run) -> None:
    """Settings, digests, versions, and the line to sign."""
    paper.section("Settings, digests and signature")
    changed = list(_changed(run.meta.get("settings", {})))
    paper.heading("Settings that are not the defaults")
    if changed:
        paper.pairs(changed)
    else:
        paper.words("None: all settings are the defaults.")
    paper.words(f"All others are the defaults of hrcreplay {_version(run)}; run.json holds them.", small=True)
    paper.heading("Command")
    paper.words(f"hrcreplay {' '.join(map(str, run.meta.get('arguments') or [run.meta.get('command', '')]))}")
    paper.heading("Digests (SHA-256)")
    outputs = run.meta.get("outputs", {})
    shown = ("state.parquet", "occupancy.parquet", "motion.parquet", "contact.parquet", "severity.parquet")
    record = run.folder / "run.json"
    paper.pairs(
        (
            *((PurePath(str(one["path"])).name, str(one["sha256"])) for one in run.meta.get("inputs", [])),
            *((name, str(outputs.get(name, ""))) for name in (*shown, "metrics.json", "report.html")),
            ("run.json", sha256(record) if record.is_file() else ""),
        )
    )
    paper.words("run.json holds the digests of all other files of the run.", small=True)
    paper.heading("Made by")
    versions = run.meta.get("versions", {})
    machine = run.meta.get("machine", {})
    paper.words(
        f"{', '.join(f'{name} {version}' for name, version in sorted(versions.items()))}; "
        f"{machine.get('architecture', '')} {machine.get('c_library', '')}; run made at {run.meta.get('created', '')}.",
        small=True,
    )
    paper.heading("Signature")
    paper.words(
        "The undersigned have read pages 1 to 4. They know that this file reports a replay of one recording, and does "
        "not show that a cell is safe."
    )
    paper.signatures()


def _version(run: Run) -> str:
    return str(run.meta.get("versions", {}).get("hrcreplay", ""))


def _changed(recorded: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Returns the settings of a run that differ from the defaults, without folders in paths."""
    found, defaults = [], Settings().model_dump(mode="json")
    known, _ = with_new_names(recorded)
    for section, values in sorted(known.items()):
        for key, value in sorted(values.items()) if isinstance(values, Mapping) else ():
            if section in defaults and value != defaults[section].get(key, value):
                text = PurePath(value).name if isinstance(value, str) and "/" in value else _plain(value)
                found.append((f"{section}.{key}", text))
    return found


def _plain(value: Any) -> str:
    """Formats a setting; a long one is shortened."""
    text = ", ".join(map(_plain, value)) if isinstance(value, list) else str(value)
    return text if len(text) <= 160 else f"{text[:160]}\u2026"
