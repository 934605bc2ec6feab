"""The documentation as a site: it builds without a warning, needs no network, and its links lead somewhere."""

from __future__ import annotations

import json
import os
import posixpath
import re
import subprocess
import sys
from functools import cache
from html import unescape
from pathlib import Path
from urllib.parse import unquote

import pytest

import hrcreplay as hr
from hrcreplay import api
from hrcreplay.settings.load import Settings
from tests.test_docs import ROOT

PAGES = (
    "index",
    "guide",
    "validation",
    "paper",
    "live",
    "deviations",
    "changelog",
    "api",
    "reference",
    "examples/library",
)
#: What a browser loads of a page by itself.
LOADED = re.compile(
    r"<(?:script|img|iframe|source)\b[^>]*\bsrc=[\"']?([^\"'\s>]+)|<link\b[^>]*\bhref=[\"']?([^\"'\s>]+)"
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(folder)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


@cache
def ids(page: Path) -> set[str]:
    return {unescape(found) for found in re.findall(r"\b(?:id|name)=[\"']?([^\"'\s>]+)", page.read_text())}


def found_by_search(site: Path) -> dict[str, str]:
    """Address -> the text that the search looks through."""
    entries = json.loads((site / "search" / "search_index.json").read_text())["docs"]
    return {
        entry["location"]: unescape(re.sub(r"<[^>]+>", "", f"{entry['title']} {entry['text']}")) for entry in entries
    }


def keys(section: dict[str, object]) -> set[str]:
    """The names of all settings of a section, and of sections within."""
    return set(section) | {key for value in section.values() if isinstance(value, dict) for key in keys(value)}


def test_pages_are_there(site: Path) -> None:
    assert [page for page in PAGES if not (site / f"{page}.html").is_file()] == []


def test_nothing_is_loaded_from_elsewhere(site: Path) -> None:
    for page in site.rglob("*.html"):
        for script, link in LOADED.findall(page.read_text()):
            assert not re.match(r"(?:https?:)?//", script or link), f"{page.name}: {script or link}"
    for sheet in site.rglob("*.css"):
        assert not re.search(r"(?:url\([\"']?|@import [\"'])(?:https?:)?//", sheet.read_text()), sheet.name


def test_links_and_anchors_lead_somewhere(site: Path) -> None:
    """Links to places in the code are HTML, which mkdocs does not look at."""
    for page in site.rglob("*.html"):
        if page.name == "404.html":
            continue
        for href in re.findall(r"<a\b[^>]*\bhref=[\"']?([^\"'\s>]+)", page.read_text()):
            if re.match(r"\w+:", href):
                continue
            name, _, anchor = unquote(unescape(href)).partition("#")
            target = Path(posixpath.normpath(page.parent / name)) if name else page
            assert target.exists(), f"{page.name}: {href}"
            assert not anchor or anchor == "__skip" or anchor in ids(target), f"{page.name}: {href}"


def test_an_equation_leads_to_its_line(site: Path) -> None:
    link = re.search(
        r'href="(hrcreplay/[^"]*)#(__codelineno-0-\d+)"><code>worst_<wbr>rows', (site / "paper.html").read_text()
    )
    assert link is not None
    line = re.search(rf'name="{link[2]}".*', (site / link[1]).read_text())
    assert line is not None
    assert "def worst_rows(" in re.sub(r"<[^>]+>", "", line[0])


def test_the_api_page_has_every_public_name(site: Path) -> None:
    page = (site / "api.html").read_text()
    assert set(api.__all__) <= set(dir(hr))
    assert [name for name in api.__all__ if f'id="hrcreplay.api.{name}"' not in page] == []
    assert "counts and notes of stage 1" in page  # a comment beside a field


def test_the_search_finds_equations_settings_and_error_lines(site: Path) -> None:
    texts = found_by_search(site)
    settings = " ".join(text for address, text in texts.items() if address.startswith("guide.html#"))
    names = keys(Settings().model_dump())
    assert len(names) > 100
    assert [name for name in sorted(names) if not re.search(rf"\b{name}\b", settings)] == []
    assert "(66)" in texts["paper.html#section-5-trajectory-generation"]
    assert any("choose one of" in text for address, text in texts.items() if address.startswith("reference.html"))
    assert "max_reference_lead_m" in texts["guide.html#plan"]
