"""The part of the page with the 3-D replay: its data, our scripts, and the two libraries that are bundled with it."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from hrcreplay.report.page_data import replay_data
from hrcreplay.report.replay_scene import ReplayScene

#: What the browser imports by name, and the file that it is.
MODULES = {
    "three/core": "three/three.core.min.js",
    "three": "three/three.module.min.js",
    "three/orbit": "three/OrbitControls.js",
    "replay/data": "data.js",
    "replay/geometry": "geometry.js",
    "replay/scene": "scene.js",
    "replay/plots": "plots.js",
    "replay/app": "app.js",
}
#: Key of the scene, colour, words.
LAYERS = (
    ("person", "person", "recorded person"),
    ("skeleton", "bones", "fused skeleton"),
    ("volumes", "volume", "what the person could reach"),
    ("stop", "stop", "where the robot would stop"),
    ("paths", "driven", "paths"),
    ("distance", "toBody", "distances"),
)
LEGEND = (
    "Orange: the robot as the capsules that its distances are measured from; red: where the stop ends that it could "
    "begin at that instant, and the way of its TCP until then. Blue: the recorded body; the dark lines in it are the "
    "person as fused from the cameras. Yellow: all that the person could reach until the robot would have stood. Blue "
    "line: programmed path; orange line: driven path. Violet: from the robot to the nearest part of the body; dashed: "
    "to the nearest volume."
)


@dataclass(frozen=True)
class ReplayPart:
    """What the page's template puts in."""

    html: Markup
    style: Markup
    licences: tuple[str, ...]


def replay_part(scene: ReplayScene) -> ReplayPart:
    """The replay of a run, its data and scripts with it."""
    header, numbers = replay_data(scene)
    modules = {name: _text(f"static/{path}") for name, path in MODULES.items()}
    modules["three"] = modules["three"].replace('"./three.core.min.js"', '"three/core"')  # a blob has no neighbours
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    html = environment.from_string(_text("replay.html.j2")).render(
        replay={
            "header": script(header),
            "numbers": numbers,
            "modules": [(name, script(text)) for name, text in modules.items()],
            "scripts": [script(_text(f"static/{path}")) for path in ("uplot/uPlot.iife.min.js", "boot.js")],
            "layers": LAYERS,
            "legend": LEGEND,
        }
    )
    return ReplayPart(
        html=Markup(html),  # noqa: S704  our own template
        style=Markup(_text("static/uplot/uPlot.min.css") + _text("static/replay.css")),  # noqa: S704  files of ours
        licences=(_text("static/three/LICENSE"), _text("static/uplot/LICENSE")),
    )


def script(text: str) -> Markup:
    """Text that may stand in a script element."""
    if "</script" in text.lower() or "<!--" in text:
        raise ValueError("a script must not end its own element")
    return Markup(text)  # noqa: S704  our own file


def _text(path: str) -> str:
    return resources.files("hrcreplay.report").joinpath(*path.split("/")).read_text("utf-8")
