"""The page's replay as a browser has it. Nothing here depends on how fast the browser is."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hrcreplay.geometry.distances import distances
from hrcreplay.reporting import replay_scene
from hrcreplay.reporting.page import report_page
from hrcreplay.reporting.page.replay_page import replay_part, touching_pairs
from hrcreplay.reporting.replay_scene import ReplayScene
from hrcreplay.reporting.tour import telling_moment, tour
from tests.reporting.browser import Tab, chromium, opened
from tests.reporting.moving import moving_run, moving_scene, robot
from tests.reporting.reading import read
from tests.reporting.synthetic import metrics_of

PROGRAM = chromium()
pytestmark = pytest.mark.skipif(PROGRAM is None, reason="needs Chromium (Debian: apt-get install chromium)")


@pytest.fixture(scope="module")
def scene() -> ReplayScene:
    return moving_scene(moving_run(8.0))


@pytest.fixture(scope="module")
def file(scene: ReplayScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run, folder = moving_run(8.0), tmp_path_factory.mktemp("page")
    metrics = metrics_of(run)
    (folder / "report.html").write_text(
        report_page.render(run, metrics, folder, replay=replay_part(scene)), encoding="utf-8"
    )
    return folder / "report.html"


@pytest.fixture(scope="module")
def loaded(file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    """Opened once: without a graphics card it takes seconds to compile the shaders."""
    assert PROGRAM is not None
    with opened(PROGRAM, tmp_path_factory.mktemp("profile")) as tab:
        tab.open(file, 1280, 900)
        yield tab


@pytest.fixture
def tab(loaded: Tab) -> Tab:
    loaded.evaluate(
        "replay.play(false), replay.putBeside(null), replay.choose('qp'), replay.plots.zoom(null), replay.seek(0)"
    )
    loaded.evaluate("document.getElementById('replay').scrollIntoView()")
    return loaded


def settled(tab: Tab) -> None:
    """Waits until the browser has laid out and drawn twice."""
    tab.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")


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
    assert {link[:1] for link in read(html).links} == {"#"}
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
    shown = scene.t0_ns + round(1e9 * tab.evaluate("replay.view.stored.at_s"))
    assert 0 <= scene.t_ns[row] - shown <= 80_000_000
    rows = scene.volumes.rows(np.flatnonzero(scene.volumes.t_ns == shown))
    assert len(rows.t_ns) == 6
    far, _, _ = distances(np.ascontiguousarray(links), rows.vertices_m, rows.offsets)
    assert near["volume"]["distance"] == pytest.approx(
        (far - scene.robot.radius_m[:, None] - rows.radius_m[None]).min(), abs=2e-3
    )


def test_a_volume_is_drawn_on_its_own_surface(tab: Tab, scene: ReplayScene) -> None:
    """Each corner of the drawn surface lies on hull + ball: no vertex reaches further along its direction."""
    tab.evaluate(f"replay.seek({scene.seconds[100]})")
    shown = scene.t0_ns + round(1e9 * tab.evaluate("replay.view.stored.at_s"))
    rows = scene.volumes.rows(np.flatnonzero(scene.volumes.t_ns == shown))
    for i in range(len(rows.t_ns)):
        mesh = f"replay.view.volumes[{rows.limb[i]}].mesh"
        assert tab.evaluate(f"{mesh}.visible")
        corners, normals = (
            np.array(tab.evaluate(f"Array.from({mesh}.geometry.getAttribute('{name}').array)")).reshape(-1, 3)
            for name in ("position", "normal")
        )
        hull = rows.vertices_m[rows.offsets[i] : rows.offsets[i + 1]]
        furthest = (hull @ normals.T).max(axis=0) + rows.radius_m[i]
        np.testing.assert_allclose((corners * normals).sum(axis=1), furthest, atol=1.5e-3)
    floor = tab.evaluate("replay.view.materials.volume.clippingPlanes.map(p => [...p.normal.toArray(), p.constant])")
    assert floor == [[0, 0, 1, 0]]  # and what is below the floor is not shown
    assert tab.evaluate("replay.view.renderer.localClippingEnabled")


def test_playing_moves_the_scene_and_pausing_holds_it(tab: Tab) -> None:
    tab.evaluate("replay.seek(1)")
    before = picture(tab)
    tab.press(" ")
    tab.evaluate(
        "new Promise(done => { const look = () => replay.state.t_s > 1.5 ? done(1) : setTimeout(look, 20); look(); })"
    )
    assert tab.evaluate("replay.state.playing")
    assert tab.evaluate("document.querySelector('.play').textContent") == "Pause"
    tab.press(" ")
    assert not tab.evaluate("replay.state.playing")
    at_s, after = instant(tab), picture(tab)
    assert after != before
    settled(tab)
    assert (instant(tab), picture(tab)) == (at_s, after)
    assert tab.trouble == []


def test_it_stops_by_itself_at_the_end(tab: Tab, scene: ReplayScene) -> None:
    tab.evaluate(
        "{ const list = document.querySelector('.speed'); list.value = '10'; list.dispatchEvent(new Event('change')); }"
    )
    tab.evaluate(f"replay.seek({scene.seconds[-1] - 0.2}), replay.play(true)")
    tab.evaluate(
        "new Promise(done => { const look = () => replay.state.playing ? setTimeout(look, 20) : done(1); look(); })"
    )
    assert instant(tab) == pytest.approx(scene.seconds[-1])
    tab.press(" ")  # and begins again from there
    assert tab.evaluate("replay.state.playing")
    assert instant(tab) < scene.seconds[-1]
    for _ in range(3):
        tab.press("ArrowDown")
    assert tab.evaluate("replay.state.speed") == 1


def test_scrubbing_changes_the_instant(tab: Tab) -> None:
    tab.evaluate("replay.seek(0)")
    before = picture(tab)
    tab.evaluate(
        "{ const bar = document.querySelector('.scrub'); bar.value = 3.2; bar.dispatchEvent(new Event('input')); }"
    )
    assert instant(tab) == pytest.approx(3.2)
    assert tab.evaluate("document.querySelector('.clock').textContent") == "3.20 s"
    assert picture(tab) != before
    tab.evaluate("scrollBy(0, 400)")
    box = tab.evaluate(
        "(b => [b.left, b.top, b.width, b.height])(document.querySelector('.plot .u-over').getBoundingClientRect())"
    )
    x, y = box[0] + 0.25 * box[2], box[1] + 0.5 * box[3]
    for kind in ("mousePressed", "mouseReleased"):
        tab.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
    assert instant(tab) == pytest.approx(0.25 * 7.96, abs=0.02)
    line = tab.evaluate("document.querySelector('.plot-now').getBoundingClientRect().left")
    assert line == pytest.approx(x, abs=2.0)


def test_keys(tab: Tab, scene: ReplayScene) -> None:
    tab.evaluate("replay.seek(2)")
    for key, want in (("ArrowRight", 2.04), ("ArrowRight", 2.08), ("ArrowLeft", 2.04), ("Home", 0.0), ("End", 7.96)):
        tab.press(key)
        assert instant(tab) == pytest.approx(want), key
    tab.press("m")
    assert tab.evaluate("replay.state.method") == "scaling"
    assert not tab.evaluate("document.querySelector('.volumes-note').hidden")
    events = [event.at_s for event in scene.methods["scaling"].events]
    assert len(events) > 2
    tab.press("Home")
    for at_s in (at_s for at_s in events if at_s > 1e-3):
        tab.press("n")
        assert instant(tab) == pytest.approx(at_s, abs=1e-3)
    tab.press("p")
    assert instant(tab) == pytest.approx(events[-2], abs=1e-3)
    tab.press("ArrowUp")
    assert tab.evaluate("replay.state.speed") == 2
    tab.press("ArrowDown")
    assert tab.evaluate("replay.state.speed") == 1
    assert tab.trouble == []


def test_a_press_on_a_stop_goes_there(tab: Tab, scene: ReplayScene) -> None:
    for k, event in enumerate(scene.methods["qp"].events):
        tab.evaluate(f"document.querySelectorAll('.stops button')[{k}].click()")
        assert instant(tab) == pytest.approx(event.at_s, abs=1e-3)
        assert tab.evaluate(f"document.querySelectorAll('.stops li')[{k}].classList.contains('now')")
    tab.evaluate("replay.choose('scaling')")
    assert "1 contact" in tab.evaluate("document.querySelector('.stops h3').textContent")


def test_the_theme_follows_the_system_and_the_switch(tab: Tab) -> None:
    colour = "getComputedStyle(document.body).backgroundColor"
    light, drawn = tab.evaluate(colour), picture(tab)
    tab.evaluate("document.getElementById('theme').click()")
    dark = tab.evaluate(colour)
    assert dark != light
    assert picture(tab) != drawn
    tab.evaluate("document.getElementById('theme').click(), localStorage.clear()")
    assert tab.evaluate(colour) == light
    tab.evaluate("delete document.documentElement.dataset.theme")
    tab.look(1280, 900, theme="dark")
    settled(tab)
    assert tab.evaluate(colour) == dark
    assert tab.evaluate("document.getElementById('theme').textContent") == "Light theme"
    assert picture(tab) != drawn
    tab.look(1280, 900)


@pytest.mark.parametrize("width", [390, 1280])
def test_nothing_is_wider_than_the_screen(tab: Tab, width: int) -> None:
    tab.look(width, 844)
    settled(tab)
    assert tab.evaluate("document.documentElement.scrollWidth") == width
    box = tab.evaluate("(b => [b.left, b.right])(document.querySelector('.stage').getBoundingClientRect())")
    assert box[0] >= 0
    assert box[1] <= width
    assert tab.evaluate("document.querySelector('.plot canvas').getBoundingClientRect().right") <= width


def test_it_opens_on_the_telling_instant_with_the_robot_in_sight(
    file: Path, scene: ReplayScene, tmp_path: Path
) -> None:
    """A page of its own: a contact of scaling is what it opens with, and no point of the robot is behind the person."""
    assert PROGRAM is not None
    moment = telling_moment(scene)
    with opened(PROGRAM, tmp_path) as tab:
        tab.open(file, 1280, 900)
        assert instant(tab) == pytest.approx(scene.seconds[moment.row], abs=1e-4)
        assert tab.evaluate("replay.state.beside") == "scaling"
        assert tab.evaluate("replay.view.clearest('qp', replay.view.drawn.at).hidden") == 0
        side = np.array(tab.evaluate("replay.view.clearest('qp', replay.view.drawn.at).side.toArray()"))
        eye, target = (
            np.array(tab.evaluate(f"replay.view.{at}.toArray()")) for at in ("camera.position", "controls.target")
        )
        level = (eye - target)[:2] / np.linalg.norm((eye - target)[:2])
        assert level @ side[:2] > 0.99
        told = "[...document.querySelectorAll('.picture-title')].map(one => one.textContent).join()"
        assert tab.evaluate(told) == "qp (this plan),scaling"
        assert tab.trouble == []


def test_two_methods_stand_side_by_side_at_the_same_instant(tab: Tab, scene: ReplayScene) -> None:
    row = 80  # scaling touches at 3.2 s, qp does not
    tab.evaluate(f"replay.putBeside('scaling'), replay.seek({scene.seconds[row]})")
    assert [box["hidden"] for box in boxes(tab, ".picture")] == [False, False]
    left, right = boxes(tab, ".picture")
    assert left["right"] == pytest.approx(right["left"], abs=1.0)
    assert tab.evaluate("replay.view.camera.aspect") == pytest.approx(
        left["width"] / tab.evaluate("document.querySelector('.stage canvas').clientHeight"), rel=0.01
    )
    ends = np.array(tab.evaluate("replay.view.ends.map(pair => pair.map(end => end.toArray()))"))
    model = robot(moving_run(2.0))
    np.testing.assert_allclose(ends, model.ends_m(scene.methods["qp"].q[row]), atol=1e-3)  # the plan is drawn last
    drawn = tab.evaluate(
        "(view => { const seen = [], show = view.show, cut = view.renderer.setScissor;"
        "view.show = (...how) => (seen.push(how[0]), show.apply(view, how));"
        "view.renderer.setScissor = (...box) => (seen.push(box), cut.apply(view.renderer, box));"
        "view.render(); view.show = show; view.renderer.setScissor = cut; return seen; })(replay.view)"
    )
    assert drawn[0::2] == ["scaling", "qp"]
    assert [box[0] for box in drawn[1::2]] == pytest.approx([left["width"], 0.0], abs=1.0)
    assert not tab.evaluate("document.querySelector('.readout.other').hidden")
    assert "scaling" in tab.evaluate("document.querySelector('.readout.other').textContent")
    alone = picture(tab)
    tab.evaluate("replay.putBeside(null)")
    assert [box["hidden"] for box in boxes(tab, ".picture")] == [False, True]
    assert picture(tab) != alone
    tab.press("b")
    assert tab.evaluate("replay.state.beside") == "qp"


def boxes(tab: Tab, what: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = tab.evaluate(
        f"[...document.querySelectorAll('{what}')].map(one => {{ const b = one.getBoundingClientRect(); "
        "return { left: b.left, right: b.right, width: b.width, hidden: one.hidden }; })"
    )
    return found


def test_what_touches_is_red_and_named(tab: Tab, scene: ReplayScene) -> None:
    """The tables' contact is made up; that of the picture is of its own capsules, so grow them until they meet."""
    tab.evaluate(f"replay.seek({scene.seconds[80]})")
    assert tab.evaluate("document.querySelector('.picture-touch').hidden")
    grown = 0.3
    tab.evaluate(f"(replay.data.header.body.radius_m = replay.data.header.body.radius_m.map(r => r + {grown}), 0)")
    try:
        tab.evaluate("replay.view.known.clear(), replay.seek(replay.state.t_s), 0")
        near = tab.evaluate("replay.view.render()[0].touching.map(({ link, part }) => [link, part])")
        links = robot(moving_run(2.0)).ends_m(scene.methods["qp"].q[80])
        want = touching_pairs(links, scene.robot.radius_m, scene.body_m[80], scene.body_radius_m + grown)
        assert sorted(map(tuple, near)) == sorted(want)
        assert want
        said = tab.evaluate("document.querySelector('.picture-touch').textContent")
        assert said.startswith("contact: ")
        assert said.split(" \u2013 ")[0].removeprefix("contact: ") in scene.robot.links
        assert tab.evaluate("replay.view.touch.group.visible")
        marked = "one => one.material === replay.view.materials.touchMesh"
        red = tab.evaluate(f"replay.view.surfaces.group.children.filter({marked}).length")
        meshed = {mesh.link for mesh in scene.robot.meshes}
        assert red == len({link for link, _ in want} & meshed)
        assert "in contact" in tab.evaluate("document.querySelector('.readout').textContent")
    finally:
        tab.evaluate(f"(replay.data.header.body.radius_m = replay.data.header.body.radius_m.map(r => r - {grown}), 0)")
        tab.evaluate("replay.view.known.clear()")
    tab.evaluate("replay.seek(replay.state.t_s)")
    assert not tab.evaluate("replay.view.touch.group.visible")


def test_the_tour_visits_its_stops_in_turn(tab: Tab, scene: ReplayScene) -> None:
    stops = tour(scene)
    assert len(stops) > 1
    tab.evaluate("replay.startTour()")
    assert instant(tab) >= stops[0].from_s - 1e-3
    assert stops[0].words in tab.evaluate("document.querySelector('.caption').textContent")
    for k in range(1, len(stops)):
        tab.evaluate(f"replay.seek({stops[k - 1].until_s})")
        tab.evaluate(
            "new Promise(done => { const look = () => "
            f"replay.state.tour === {k} ? done(1) : setTimeout(look, 20); look(); }})"
        )
        assert stops[k].words in tab.evaluate("document.querySelector('.caption').textContent")
        assert tab.evaluate("replay.state.beside") == stops[k].beside
    tab.evaluate(f"replay.seek({stops[-1].until_s})")
    tab.evaluate(
        "new Promise(done => { const look = () => replay.state.playing ? setTimeout(look, 20) : done(1); look(); })"
    )
    assert tab.evaluate("replay.state.tour") is None
    assert tab.evaluate("document.querySelector('.caption').hidden")
    assert instant(tab) == pytest.approx(stops[-1].until_s, abs=0.05)


def test_a_drag_zooms_the_plots_and_a_double_click_shows_all(tab: Tab, scene: ReplayScene) -> None:
    tab.evaluate("document.querySelector('.plots').scrollIntoView({ block: 'center', behavior: 'instant' })")
    settled(tab)
    x, y, width = tab.evaluate(
        "(b => [b.left, b.top + b.height / 2, b.width])"
        "(document.querySelector('.plot .u-over').getBoundingClientRect())"
    )
    before_s = instant(tab)
    tab.call("Input.dispatchMouseEvent", type="mouseMoved", x=x + 0.25 * width, y=y)
    for kind, share in (("mousePressed", 0.25), ("mouseMoved", 0.4), ("mouseMoved", 0.5), ("mouseReleased", 0.5)):
        buttons = {"buttons": 1} if kind == "mouseMoved" else {"clickCount": 1}
        tab.call("Input.dispatchMouseEvent", type=kind, x=x + share * width, y=y, button="left", **buttons)
    settled(tab)
    span = float(scene.seconds[-1])
    for k in (0, 1):  # both plots show the same stretch
        low, high = tab.evaluate(f"(s => [s.min, s.max])(replay.plots.plots[{k}].plot.scales.x)")
        assert (low, high) == pytest.approx((0.25 * span, 0.5 * span), abs=0.03 * span)
    assert instant(tab) == before_s  # a drag is no press
    assert not tab.evaluate("document.querySelector('.whole').hidden")
    for count in (1, 2):
        for kind in ("mousePressed", "mouseReleased"):
            tab.call("Input.dispatchMouseEvent", type=kind, x=x + 0.5 * width, y=y, button="left", clickCount=count)
    settled(tab)
    assert tab.evaluate("(s => [s.min, s.max])(replay.plots.plots[0].plot.scales.x)") == pytest.approx([0.0, span])
    assert tab.evaluate("document.querySelector('.whole').hidden")


def test_contents_come_first_and_parts_open_for_a_link(tab: Tab) -> None:
    tab.evaluate("document.documentElement.scrollTo({ top: 0, behavior: 'instant' })")
    settled(tab)
    top = {
        name: tab.evaluate(f"document.querySelector('{name}').getBoundingClientRect().top + scrollY")
        for name in ("nav", "#replay", "main")
    }
    assert top["nav"] < top["#replay"] < top["main"]
    assert top["nav"] < 300
    closed = tab.evaluate("document.documentElement.scrollHeight")
    assert tab.evaluate("document.querySelectorAll('main .part[open]').length") == 0
    tab.evaluate("document.querySelector('nav a[href=\"#fusion\"]').click()")
    tab.evaluate("new Promise(done => setTimeout(done, 50))")
    assert tab.evaluate("document.querySelector('#fusion .part').open")
    tab.evaluate("document.querySelector('.unfold').click()")
    assert tab.evaluate("[...document.querySelectorAll('main details')].every(one => one.open)")
    assert tab.evaluate("document.documentElement.scrollHeight") > closed
    tab.evaluate("document.querySelector('.unfold').click()")
    assert tab.evaluate("document.documentElement.scrollHeight") == closed


def test_a_table_wider_than_a_phone_says_that_it_scrolls(tab: Tab) -> None:
    tab.look(390, 844)
    settled(tab)
    told = tab.evaluate(
        "[...document.querySelectorAll('.scroll')].map(one => [one.scrollWidth > one.clientWidth + 1, "
        "getComputedStyle(one, '::before').content.includes('scroll sideways')])"
    )
    assert any(wide for wide, _ in told)
    assert all(wide == says for wide, says in told)
    tab.look(1280, 900)


def test_a_long_run_tells_its_rates_in_short_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert PROGRAM is not None
    monkeypatch.setattr(replay_scene, "WHOLE_S", 1.2)  # so that 8 s are as more than an hour: 25 Hz by 7
    run = moving_run(8.0)
    page = report_page.render(run, metrics_of(run), tmp_path, replay=replay_part(moving_scene(run)))
    (tmp_path / "report.html").write_text(page, encoding="utf-8")
    with opened(PROGRAM, tmp_path / "profile") as tab:
        tab.open(tmp_path / "report.html", 1280, 900)
        said = tab.evaluate("document.querySelector('.volumes-rate').textContent")
    assert said == "The volumes are shown 5 times a second, robot and person 3.6 times."
