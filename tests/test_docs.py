from __future__ import annotations

import re
import shlex
import tomllib
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import typer

from hrcreplay import errors
from hrcreplay.calibration.cell import Cell
from hrcreplay.cli.app import app
from hrcreplay.egm import motion_link_pb2
from hrcreplay.egm.link import ALARMS, REFUSALS, STOPS, PacketStatus
from hrcreplay.egm.robot_double.faults import KINDS, load_faults
from hrcreplay.live.control import session_controller
from hrcreplay.live.record import codec
from hrcreplay.logs.motion_files import ImportMapping
from hrcreplay.robot.control import control_step
from hrcreplay.robot.task import parse_task
from hrcreplay.settings.listing import as_toml
from hrcreplay.settings.load import Settings, load_settings
from hrcreplay.settings.sections import Live
from hrcreplay.toml_file import validate

ROOT = Path(__file__).parent.parent
LIVE = ROOT / "docs" / "live.md"
PAGES = sorted(
    path for pattern in ("*.md", "docs/*.md", "reports/README.md", "datasets/*.md") for path in ROOT.glob(pattern)
)

BLOCK = re.compile(r"^ *```(\w*)\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)\s]+)\)")
SPAN = re.compile(r"`([^`\n]+)`")

COMMANDS: Any = typer.main.get_command(app)


def blocks(page: Path, language: str) -> list[str]:
    return [body for kind, body in BLOCK.findall(page.read_text()) if kind == language]


def spans(text: str) -> list[str]:
    """What stands in backticks outside blocks."""
    return list(SPAN.findall(BLOCK.sub("", text)))


def section(number: int) -> str:
    found = re.search(rf"^## {number}\. .*?(?=^## |\Z)", LIVE.read_text(), re.MULTILINE | re.DOTALL)
    assert found is not None
    return found[0]


def rows(text: str, head: str) -> list[list[str]]:
    """The cells of the table whose first row begins so."""
    lines = text[text.index(head) :].splitlines()
    table = lines[2 : next((i for i, line in enumerate(lines) if not line.startswith("|")), len(lines))]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table]


def commands(page: Path) -> list[str]:
    """Every call of ours: lines of console blocks, and what is written out in the text."""
    lines = [line.strip().split("  #")[0] for body in blocks(page, "console") for line in body.splitlines()]
    shown = [line.removeprefix("$ ") for line in lines if line.startswith("$ hrcreplay")]
    return shown + [span for span in spans(page.read_text()) if span.startswith("hrcreplay ") and " -" in span]


def slug(heading: str) -> str:
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def test_the_pages_are_found() -> None:
    assert {LIVE, ROOT / "README.md", ROOT / "CHANGELOG.md"} <= set(PAGES)


def test_what_is_looked_for_is_on_the_pages() -> None:
    texts = [page.read_text() for page in PAGES]
    named = {span for text in texts for span in spans(text)}
    assert any(LINK.findall(BLOCK.sub("", text)) for text in texts)
    assert any(re.match(r"hrcreplay [a-z-]+$", span) for span in named)
    assert {f"logs.{name}" for name in Settings().logs.model_dump()} & named


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for link in LINK.findall(BLOCK.sub("", page.read_text())):
        if "://" in link:
            continue
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        assert target.exists(), link
        if anchor:
            headings = re.findall(r"^#+ (.*)$", target.read_text(), re.MULTILINE)
            assert anchor in map(slug, headings), link


@pytest.mark.parametrize(("page", "line"), [(page, line) for page in PAGES for line in commands(page)])
def test_commands_parse(page: Path, line: str) -> None:
    _, name, *arguments = shlex.split(line)
    assert name in COMMANDS.commands, line
    COMMANDS.commands[name].make_context(name, [*arguments])  # raises where an option or a value is none
    overrides = tuple(value for option, value in pairwise(arguments) if option == "--set")
    load_settings(None, overrides)


def test_there_are_commands_of_each_kind() -> None:
    found = " ".join(commands(LIVE))
    assert all(f"hrcreplay {name} " in found for name in ("live", "twin", "verify"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_named_commands_exist(page: Path) -> None:
    for span in spans(page.read_text()):
        if (named := re.match(r"hrcreplay ([a-z][a-z-]*)$", span)) is not None:
            assert named[1] in COMMANDS.commands, span


@pytest.mark.parametrize(("page", "body"), [(page, body) for page in PAGES for body in blocks(page, "toml")])
def test_toml_is_accepted(page: Path, body: str, tmp_path: Path) -> None:
    path = tmp_path / "block.toml"
    path.write_text(body)
    table = tomllib.loads(body)
    if "fault" in table or "random" in table:
        assert load_faults(path, seed=0, duration_s=60.0)
    elif "cameras" in table:
        assert Cell.from_dict(table).T_world_base is not None
    elif "watched" in table:
        assert Cell.from_dict(table).watched is not None
    elif "waypoints" in table:
        assert parse_task(table, "block").waypoints
    elif "columns" in table:
        assert validate(ImportMapping, table, path).columns
    else:
        assert load_settings(path) != Settings() or body == as_toml()  # the list of all of them


def test_there_is_toml_of_each_kind() -> None:
    keys = {key for body in blocks(LIVE, "toml") for key in tomllib.loads(body)}
    assert keys >= {"fault", "random", "cameras", "waypoints", "live", "prediction"}


def test_python_compiles() -> None:
    scripts = blocks(LIVE, "python")
    assert scripts
    for body in scripts:
        lines = body.splitlines()
        indent = len(lines[0]) - len(lines[0].lstrip())
        compile("\n".join(line[indent:] for line in lines), "block", "exec")


def test_the_program_shown_is_the_one_in_the_file() -> None:
    shown = [body for body in blocks(LIVE, "") if body.startswith("MODULE")]
    assert shown == [(LIVE.parent / "robot.mod").read_text()]


def test_every_stop_reason_is_in_the_table() -> None:
    heard = PacketStatus(answer=True, fresh=False, allowed=False, reason="", ended=False, lost=0)
    constants = {value for name, value in vars(session_controller).items() if name.isupper() and isinstance(value, str)}
    reasons = {
        *constants,
        *session_controller.SIGNALS.values(),
        *session_controller.REFUSED,
        *STOPS,
        *ALARMS,
        session_controller.reason_of_robot(heard),
    }
    table = rows(section(7), "| reason |")
    assert sorted(row[0].strip("`") for row in table) == sorted(reasons)
    assert all(len(row) == 3 and all(row) for row in table)


def test_refusals_and_reasons_of_the_plan_are_explained() -> None:
    for refusal in REFUSALS:
        assert f"`{refusal}`" in section(7)
    assert {row[1].strip("`") for row in rows(section(7), "| status |")} == set(control_step.REASONS)


def test_exit_codes() -> None:
    kinds = (errors.HrcReplayError, errors.SettingsError, errors.LogError, errors.LiveStopped)
    codes = [int(row[0]) for row in rows(section(7), "| exit code |")]
    assert codes == [0, *(kind.exit_code for kind in kinds), errors.EXIT_SAME_DECISIONS]


def test_every_setting_of_live_with_its_default() -> None:
    table = {row[0]: row[1] for row in rows(section(9), "| setting |")}
    assert set(table) == set(Live.model_fields) - {"zenoh"}
    for name, text in table.items():
        told, default = tomllib.loads(f"value = {text}")["value"], Live.model_fields[name].default
        assert told == (list(default) if isinstance(default, tuple) else default), name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_settings_that_are_named_exist(page: Path) -> None:
    known = Settings().model_dump()
    for span in spans(page.read_text()):
        named = re.match(r"\[*(\w+)\.(\w+)", span)
        if named is not None and named[1] in known and named[2] not in ("toml", "py", "md"):
            assert named[2] in known[named[1]], span


def test_every_kind_of_fault_is_named() -> None:
    assert set(KINDS) <= set(spans(section(4)))


def test_what_to_plot_is_in_the_messages() -> None:
    types = {codec.ROBOT_TOPIC: motion_link_pb2.RobotMessage, codec.SENT_TOPIC: motion_link_pb2.SensorMessage}
    found = [span for span in spans(section(8)) if span.startswith("/egm/") and "." in span]
    assert len(found) == 2
    for span in found:
        topic, *path = span.removesuffix("[0]").split(".")
        kind = types[topic].DESCRIPTOR
        for name in path:
            field = kind.fields_by_name[name]
            kind = field.message_type
        assert field.is_repeated
