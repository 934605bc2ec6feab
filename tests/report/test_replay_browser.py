"""The page's replay as a browser has it. Nothing here depends on how fast the browser is."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hrcreplay.geometry.segment_hull_distance import protrusion_m
from hrcreplay.report import page
from hrcreplay.report.replay_scene import ReplayScene
from hrcreplay.run.report import compute
from tests.report.browser import Tab, chromium, opened
from tests.report.moving import moving_run, moving_scene, robot
from tests.report.test_page import read

PROGRAM = chromium()
pytestmark = pytest.mark.skipif(PROGRAM is None, reason="needs Chromium (Debian: apt-get install chromium)")


@pytest.fixture(scope="module")
def scene() -> ReplayScene:
    return moving_scene(moving_run(8.0))


@pytest.fixture(scope="module")
def file(scene: ReplayScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run, folder = moving_run(8.0), tmp_path_factory.mktemp("page")
    metrics = compute(run, near_m=0.5, stationary_m_per_s=0.001)
    (folder / "report.html").write_text(page.render(run, metrics, folder, scene=scene), encoding="utf-8")
    return folder / "report.html"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    assert PROGRAM is not None
    with opened(PROGRAM, tmp_path_factory.mktemp("profile")) as tab:
        yield tab


@pytest.fixture
def tab(browser: Tab, file: Path) -> Tab:
    browser.trouble.clear()
    browser.requests.clear()
    browser.open(file, 1280, 900)
    browser.evaluate("document.getElementById('replay').scrollIntoView()")
    return browser


def picture(tab: Tab) -> str:
    """The canvas as it is drawn now."""
    return str(tab.evaluate("replay.view.render(), document.querySelector('#replay canvas').toDataURL()"))


def instant(tab: Tab) -> float:
    return float(tab.evaluate("replay.state.t_s"))


def test_the_page_runs_without_network_and_without_trouble(tab: Tab, file: Path) -> None:
    assert tab.evaluate("document.querySelector('.replay-trouble').textContent") == ""
    assert all(url.startswith(("file:", "blob:", "data:")) for url in tab.requests)
    assert sum(url.startswith("file:") for url in tab.requests) == 1
    html = file.read_text("utf-8")
    assert all(link.startswith("#") for link in read(html).links)
    assert "MIT License" in html
    assert tab.trouble == []


def test_links_and_distances_are_where_python_has_them(tab: Tab, scene: ReplayScene) -> None:
    model, row = robot(moving_run(2.0)), 93
    tab.evaluate(f"replay.seek({scene.seconds[row]})")
    ends = tab.evaluate("replay.view.ends.map(pair => pair.map(end => end.toArray()))")
    np.testing.assert_allclose(np.array(ends), model.ends_m(scene.methods["qp"].q[row]), atol=1e-3)
    near: dict[str, Any] = tab.evaluate(f"replay.view.show('qp', {row}, {scene.seconds[row]})")
    links, body = np.array(ends), scene.body_m[row]
    share = np.linspace(0.0, 1.0, 201)[:, None]
    apart = min(
        float(np.linalg.norm((a + share * (b - a))[:, None] - (c + share * (d - c))[None], axis=2).min()) - r - s
        for (a, b), r in zip(links, scene.robot.radius_m, strict=True)
        for (c, d), s in zip(body, scene.body_radius_m, strict=True)
    )
    assert near["body"]["distance"] == pytest.approx(apart, abs=2e-3)
    at = scene.volumes.t_ns[np.searchsorted(scene.volumes.t_ns, scene.t_ns[row] - 40_000_000, side="right") - 1]
    found = []
    for k in np.flatnonzero(scene.volumes.t_ns == tab_instant(tab, scene)):
        hull = scene.volumes.vertices_m[scene.volumes.offsets[k] : scene.volumes.offsets[k + 1]]
        for (a, b), r in zip(links, scene.robot.radius_m, strict=True):
            points = a + np.linspace(0.0, 1.0, 101)[:, None] * (b - a)
            found += [outside(point, hull) - r - scene.volumes.radius_m[k] for point in points]
    assert at <= scene.t_ns[row]
    assert near["volume"]["distance"] == pytest.approx(min(found), abs=3e-3)
