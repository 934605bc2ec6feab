"""The 3-D replay on the page: its data, scripts and two bundled libraries, and a still at one instant.

The data are a JSON header and one compact block of deflated numbers: positions in millimetres, joints in 0.1 mrad,
speeds in mm/s, as int16, column by column, each as the difference from the previous one, low bytes before high bytes.
``static/data.js`` reads it again.
"""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import resources
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hrcreplay.geometry.distances import nearest_pair
from hrcreplay.records import Floats, Ints, SweptVolume
from hrcreplay.reporting.figures import drawing
from hrcreplay.reporting.figures.scene import (
    RenderedHull,
    RenderedSolid,
    View,
    bounds_of,
    render_hulls,
    view_from,
    volume_solids,
)
from hrcreplay.reporting.metrics.series import seconds_from
from hrcreplay.reporting.replay_scene import (
    LONG_VOLUME_HZ,
    VOLUME_HZ,
    MethodTrack,
    ReplayScene,
    RobotGeometry,
    VolumeTrack,
    at_rate,
    placements,
    pose_links,
)
from hrcreplay.reporting.scene_messages import whole_surface
from hrcreplay.reporting.tables import part_name_text, reason_text
from hrcreplay.reporting.tour import telling_moment, tour
from hrcreplay.robot.control.static_obstacles import StaticHull

#: Modules that the browser imports by name, and their files.
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
#: Key of the scene, colour, text.
LAYERS = (
    ("person", "person", "recorded person"),
    ("skeleton", "bones", "fused skeleton"),
    ("volumes", "volume", "what the person could reach"),
    ("stop", "stop", "end of the robot's stop"),
    ("paths", "driven", "paths"),
    ("distance", "toBody", "distances"),
    ("cameras", "soft", "cameras"),
)
MESHES = ("meshes", "robot", "meshes of the links")  #: the same, for a robot with meshes
ROBOT_LEGEND = {
    False: "Orange: the robot as the capsules that its distances are measured from; red, with what it touches, in "
    "contact",
    True: "Orange: the robot, in the shell of the capsules that its distances are measured from; red, with what it "
    "touches, in contact",
}
LEGEND = (
    "green: end of the stop that it could begin at that instant, and the path of its TCP until then. Blue: the "
    "recorded body; the dark lines in it are the person as fused from the cameras. Yellow: space that the person "
    "could reach until the robot would have stopped. Blue line: programmed path; orange line: driven path. Violet: "
    "from the "
    "robot to the nearest part of the body; dashed: to the nearest volume."
)


@dataclass(frozen=True)
class ReplayPart:
    """Parts that the page's template inserts."""

    html: Markup
    style: Markup
    licences: tuple[str, ...]


def replay_part(scene: ReplayScene) -> ReplayPart:
    """Makes the replay of a run, including its data and scripts."""
    header, numbers = replay_data(scene)
    modules = {name: _text(f"static/{path}") for name, path in MODULES.items()}
    modules["three"] = modules["three"].replace('"./three.core.min.js"', '"three/core"')  # blobs: no relative paths
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    html = environment.from_string(_text("replay.html.j2")).render(
        replay={
            "header": script(header),
            "numbers": numbers,
            "modules": [(name, script(text)) for name, text in modules.items()],
            "scripts": [script(_text(f"static/{path}")) for path in ("uplot/uPlot.iife.min.js", "boot.js")],
            "layers": (*LAYERS, MESHES) if scene.robot.meshes else LAYERS,
            "legend": f"{ROBOT_LEGEND[bool(scene.robot.meshes)]}; {LEGEND}",
        }
    )
    return ReplayPart(
        html=Markup(html),  # noqa: S704  our own template
        style=Markup(_text("static/uplot/uPlot.min.css") + _text("static/replay.css")),  # noqa: S704  files of ours
        licences=(_text("static/three/LICENSE"), _text("static/uplot/LICENSE")),
    )


def script(text: str) -> Markup:
    """Checks that a text can be placed in a script element."""
    if "</script" in text.lower() or "<!--" in text:
        raise ValueError("a script must not end its own element")
    return Markup(text)  # noqa: S704  our own file


def _text(path: str) -> str:
    return resources.files("hrcreplay.reporting.page").joinpath(*path.split("/")).read_text("utf-8")


#: Stored for NaN.
MISSING = -32768
_LARGEST = 32767
#: Maximum size of the block in base64 [bytes]; the volumes are stored at the highest of these rates that fits.
BUDGET_BYTES = 9_000_000
VOLUME_RATES_HZ = (VOLUME_HZ, LONG_VOLUME_HZ, 2.5, 1.0, 0.5, 0.2)
#: Number of hulls that are sorted together: those of a long run would be in memory five times.
_TOGETHER = 4096
#: Minimum share to which hulls are usually deflated.
_AT_BEST = 0.3


class NumberBlock:
    """Concatenated arrays of int16, and a list of their positions."""

    def __init__(self) -> None:
        self.entries: dict[str, dict[str, Any]] = {}
        self._stream = zlib.compressobj(6)
        self._packed = bytearray()
        self._at = 0

    def add(self, name: str, values: Floats | Ints, unit: float = 1.0) -> None:
        """Adds an array whose rows are instants; ``unit`` is the step of one count. NaN is kept.

        If a value is too large for 16 bits, the step is increased.
        """
        table = np.asarray(values).reshape(len(values), math.prod(values.shape[1:]))
        unit = max(unit, _largest(table) / _LARGEST)
        counts = np.empty(table.shape, np.int16)
        for k, column in enumerate(table.T):
            counts[:, k] = _counts(column, unit)
        self.add_counts(name, counts, unit)

    def add_counts(self, name: str, counts: NDArray[np.int16], unit: float) -> None:
        """Adds counts (n, k) of steps, or ``MISSING``; ``unit`` is the step of one count."""
        low, high = bytearray(), bytearray()
        for column in counts.T:
            steps = np.array(column).view(np.uint16)
            steps[1:] -= np.ascontiguousarray(column[:-1]).view(np.uint16)  # modulo 2^16
            low += (steps & 0xFF).astype(np.uint8).tobytes()
            high += (steps >> 8).astype(np.uint8).tobytes()
        self._packed += self._stream.compress(low) + self._stream.compress(high)
        self.entries[name] = {"at": self._at, "rows": len(counts), "columns": counts.shape[1], "unit": unit}
        self._at += 2 * counts.size

    def deflated(self) -> bytes:
        """Returns the whole block as a zlib stream."""
        return bytes(self._packed) + self._stream.copy().flush()


def _largest(table: NDArray[Any]) -> float:
    """Returns the largest finite size of the numbers in a table (n, k); 0 without one."""
    return max((float(np.abs(column[np.isfinite(column)]).max(initial=0.0)) for column in table.T), default=0.0)


def _counts(table: NDArray[Any], unit: float) -> NDArray[np.int16]:
    """Returns how many steps of ``unit`` each number has; ``MISSING`` for NaN."""
    finite = np.isfinite(table)
    return np.where(finite, np.round(np.where(finite, table, 0.0) / unit), MISSING).astype(np.int16)


def replay_data(scene: ReplayScene, *, budget_bytes: int = BUDGET_BYTES) -> tuple[str, str]:
    """Returns the header as JSON and the block in base64.

    Args:
        scene: Scene to show.
        budget_bytes: Maximum size of the block; the volumes' rate is reduced to fit.
    """
    block = NumberBlock()
    header = _header(scene)
    block.add("points", scene.points_m, 1e-3)
    block.add("body", scene.body_m, 1e-3)
    for number, mesh in enumerate(scene.robot.meshes):
        block.add(f"mesh/{number}/vertices", mesh.vertices_m, 1e-4)
        block.add(f"mesh/{number}/triangles", mesh.triangles)
    for name, track in scene.methods.items():
        _add_track(block, name, track)
    motion = block.deflated()
    left = budget_bytes * 3 // 4 - len(motion)
    volumes, rows, rate_hz = _volumes_within(scene.volumes, left)
    header["volumes"] = {
        "limbs": list(scene.volumes.limbs),
        "limb_names": [part_name_text(limb) for limb in scene.volumes.limbs],
        "rate_hz": rate_hz,
        "at_s": [round(at_s, 4) for at_s in seconds_from(scene.volumes.t_ns[rows], scene.t0_ns).tolist()],
        "entries": volumes.entries,
    }
    header["entries"] = block.entries
    packed = volumes.deflated()
    header["bytes"] = [len(motion), len(packed)]
    text = json.dumps(header, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c"), base64.b64encode(motion + packed).decode()


def _header(scene: ReplayScene) -> dict[str, Any]:
    robot = scene.robot
    return {
        "rate_hz": scene.rate_hz,
        "count": len(scene.t_ns),
        "start_s": round((int(scene.t_ns[0]) - scene.t0_ns) * 1e-9, 6),
        "bones": scene.bones.tolist(),
        "body": {
            "parts": [part_name_text(part) for part in scene.body_parts],
            "radius_m": scene.body_radius_m.tolist(),
        },
        "robot": {
            "links": [link.replace("_", " ") for link in robot.links],
            "radius_m": robot.radius_m.tolist(),
            "ends_m": robot.ends_m.tolist(),
            "moved_by": robot.moved_by.tolist(),
            "screws": robot.screws.tolist(),
            "tcp_m": robot.tcp_m.tolist(),
            "base_m": robot.base_m.tolist(),
            "meshes": [{"link": mesh.link, "axes": robot.axes_of(mesh)} for mesh in robot.meshes],
        },
        "methods": {
            name: {
                "events": [_event(asdict(event)) for event in track.events],
                "names": {kind: list(texts) for kind, (texts, _) in track.names.items()},
            }
            for name, track in scene.methods.items()
        },
        "order": list(scene.methods),
        "watched": scene.watched_m.tolist(),
        "cameras": [
            {"name": one.name, "corners": np.round(one.corners_m(_VIEW_DEPTH_M), 4).tolist()} for one in scene.cameras
        ],
        **_moments(scene),
        **({"objects": [_object(one) for one in scene.objects]} if scene.objects else {}),
    }


def _moments(scene: ReplayScene) -> dict[str, Any]:
    """Returns the instant that the page opens with, the method beside the run's own, and the tour."""
    moment = telling_moment(scene)
    return {
        "open_s": round(float(scene.seconds[moment.row]), 4),
        "beside": moment.beside,
        "tour": [{**asdict(stop), "words": stop.words} for stop in tour(scene)],
    }


def _object(one: StaticHull) -> dict[str, Any]:
    """Returns the surface of a part of an object."""
    corners, triangles = whole_surface(one.vertices_m, one.radius_m)
    return {
        "name": one.name,
        "corners": np.round(corners, 4).ravel().tolist(),
        "triangles": triangles.ravel().tolist(),
    }


def _event(event: Mapping[str, Any]) -> dict[str, Any]:
    """Returns an event with rounded numbers; null for unknown values."""
    found: dict[str, Any] = {}
    for name, value in event.items():
        found[name] = (round(value, 3) if math.isfinite(value) else None) if isinstance(value, float) else value
    found["limb"] = part_name_text(event["limb"]) if event["limb"] else ""
    found["link"] = event["link"].replace("_", " ")
    return found


def _add_track(block: NumberBlock, name: str, track: MethodTrack) -> None:
    for joints in ("q", "stop_q"):
        block.add(f"{name}/{joints}", getattr(track, joints), 1e-4)
    for metres in ("ref_m", "tcp_m", "ref_speed", "tcp_speed", "distance_m", "body_m", "horizon_s"):
        block.add(f"{name}/{metres}", getattr(track, metres), 1e-3)
    block.add(f"{name}/certified", track.certified)
    for kind, (_, index) in track.names.items():
        block.add(f"{name}/{kind}", index)


def _volumes_within(volumes: VolumeTrack, left: int) -> tuple[NumberBlock, Ints, float | None]:
    """Returns the volumes at the highest rate that fits into a number of deflated bytes, and their rows; None: none."""
    counts = np.diff(volumes.offsets)
    for rate_hz in [rate_hz for rate_hz in VOLUME_RATES_HZ if len(volumes.t_ns) and rate_hz <= volumes.rate_hz]:
        rows = at_rate(volumes.t_ns, rate_hz)
        if _AT_BEST * 6 * counts[rows].sum() > left:
            continue
        block = _hulls(volumes, rows)
        if len(block.deflated()) <= left:
            return block, rows, rate_hz
    nothing = np.zeros(0, np.int64)
    return _hulls(volumes, nothing), nothing, None


def _hulls(volumes: VolumeTrack, rows: Ints) -> NumberBlock:
    """Stores some hulls, the vertices of each by height, so that their differences are small."""
    block, some = NumberBlock(), [rows[first : first + _TOGETHER] for first in range(0, len(rows), _TOGETHER)]
    unit = max(1e-3, max((_largest(volumes.rows(few).vertices_m) for few in some), default=0.0) / _LARGEST)
    corners, first = np.diff(volumes.offsets)[rows], 0
    vertices = np.empty((int(corners.sum()), 3), np.int16)
    for few in some:
        found = _counts(_by_height(volumes.rows(few)), unit)
        vertices[first : first + len(found)] = found
        first += len(found)
    block.add_counts("vertices", vertices, unit)
    block.add("limb", volumes.limb[rows])
    block.add("count", corners)
    block.add("radius", volumes.radius_m[rows], 1e-3)
    block.add("horizon", volumes.horizon_s[rows], 1e-3)
    return block


def _by_height(hulls: VolumeTrack) -> Floats:
    """Returns the vertices (m, 3), those of each hull by height [m]."""
    owner = np.repeat(np.arange(len(hulls.t_ns)), np.diff(hulls.offsets))
    return hulls.vertices_m[np.lexsort((*hulls.vertices_m.T, owner))]


_ROBOT, _PERSON, _TOUCH = "#d9823b", "#7fb2d9", "#c62828"
#: Depth of the drawn view of a camera [m].
_VIEW_DEPTH_M = 0.35
#: Time around the instant in which paths are drawn [s].
_PATH_S = 8.0
_MARGIN_M = 0.12


def snapshot(scene: ReplayScene, row: int) -> Figure:
    """Draws the scene of the run's own method at an instant, from where people hide the least of the robot.

    Args:
        scene: The scene.
        row: Index of the instant.
    """
    name, track = next(iter(scene.methods.items()))
    view = view_from(clearest_azimuth(scene, [row], [name]), ELEVATION_RAD)
    figure = drawing.new_figure(6.2)
    axes = drawing.panels(figure, 1, 1, left_in=0.62, top_in=0.62, bottom_in=0.75)[0][0]
    low, high = bounds_of([solid.outline(view) for solid in (*solids(scene, row), *reach(scene, row))], _MARGIN_M)
    drawing.set_window(axes, low.tolist(), high.tolist())
    draw_instant(axes, scene, row, view)
    axes.set(xlabel="across [m]", ylabel="up [m]")
    axes.set_title(f"{scene.seconds[row]:.2f} s, {name}: {_words(track, row)}", wrap=True)
    figure.legend(handles=legend(), loc="lower center", ncols=5, bbox_to_anchor=(0.5, 0.01))
    return figure


def solids(scene: ReplayScene, row: int, method: str | None = None) -> list[RenderedHull | RenderedSolid]:
    """Returns a robot and the recorded people at an instant, as far as they are known; in red what touches.

    Args:
        scene: The scene.
        row: Index of the instant.
        method: Method of the robot; None: the run's own.
    """
    q = scene.methods[method or next(iter(scene.methods))].q[row]
    ends, radius_m = pose_links(scene.robot, q[None])[0], scene.robot.radius_m
    touching = touching_pairs(ends, radius_m, scene.body_m[row], scene.body_radius_m)
    links, parts = ({pair[side] for pair in touching} for side in (0, 1))
    person = [
        RenderedHull(pair, float(r), to_rgb(_TOUCH if part in parts else _PERSON))
        for part, (pair, r) in enumerate(zip(scene.body_m[row], scene.body_radius_m, strict=True))
    ]
    found: list[RenderedHull | RenderedSolid] = [*_robot_solids(scene.robot, q, ends, links), *person]
    return [solid for solid in found if np.isfinite(solid.vertices_m).all()]


def _robot_solids(
    robot: RobotGeometry, q: Floats, ends_m: Floats, touching: set[int]
) -> list[RenderedHull | RenderedSolid]:
    """Returns the robot by its own solids, and by the capsules of the links that those do not show."""
    colours = [to_rgb(_TOUCH if link in touching else _ROBOT) for link in range(len(robot.links))]
    if not robot.solids or not np.isfinite(q).all():
        return [RenderedHull(e, float(r), c) for e, r, c in zip(ends_m, robot.radius_m, colours, strict=True)]
    link_of = {robot.axes_of(mesh): mesh.link for mesh in robot.meshes}
    poses = [(Rotation.identity(), np.zeros(3)), *((turn[0], at_m[0]) for turn, at_m in placements(robot, q[None]))]
    own: list[RenderedHull | RenderedSolid] = []
    for one in robot.solids:
        turn, at_m = poses[one.axes]
        link = link_of[one.axes]
        own.append(
            RenderedSolid(
                (turn.apply(one.vertices_m) + at_m, one.triangles), colours[link] if link >= 0 else to_rgb(_ROBOT)
            )
        )
    bare = [link for link in range(len(robot.links)) if link not in link_of.values()]
    return own + [RenderedHull(ends_m[k], float(robot.radius_m[k]), colours[k]) for k in bare]


def touching_pairs(ends_m: Floats, radius_m: Floats, body_m: Floats, body_radius_m: Floats) -> list[tuple[int, int]]:
    """Returns the pairs of a link and a part of a body whose capsules overlap.

    Args:
        ends_m: (s, 2, 3) ends of the links' axes [m].
        radius_m: (s,) their radii [m].
        body_m: (p, 2, 3) ends of the axes of the parts; NaN if unknown [m].
        body_radius_m: (p,) their radii [m].
    """
    found = []
    for part in np.flatnonzero(np.isfinite(body_m).all(axis=(1, 2))).tolist():
        for link in range(len(ends_m)):
            one, other = (slice(k, k + 1) for k in (link, part))
            pair = nearest_pair(ends_m[None, one], radius_m[one], body_m[None, other], body_radius_m[other])
            if pair.distance_m[0] <= 0.0:
                found.append((link, part))
    return found


def reach(scene: ReplayScene, row: int) -> list[RenderedHull]:
    """The swept volumes stored last before an instant."""
    return volume_solids(_stored(scene, row))


def draw_instant(
    axes: Axes, scene: ReplayScene, row: int, view: View, *, since: int | None = None, method: str | None = None
) -> None:
    """Draws swept volumes, robot, person and paths at an instant, on axes whose window is set.

    Args:
        axes: To draw on.
        scene: What moves.
        row: Which of its instants.
        view: From where.
        since: Instant that the driven path begins with; None: some seconds before.
        method: Method of the robot; None: the run's own.
    """
    track = scene.methods[method or next(iter(scene.methods))]
    for one in scene.objects:
        edge = RenderedHull(one.vertices_m, one.radius_m, to_rgb(drawing.FAINT)).outline(view)
        axes.add_patch(Polygon(edge, facecolor=drawing.FAINT, edgecolor=drawing.INK, alpha=0.25, lw=0.5, zorder=0))
    for edge in (solid.outline(view) for solid in reach(scene, row)):
        axes.add_patch(Polygon(edge, facecolor=drawing.ORANGE, edgecolor=drawing.ORANGE, alpha=0.16, lw=0.7, zorder=1))
    shown = solids(scene, row, method)
    low, high = bounds_of([solid.outline(view) for solid in shown], _MARGIN_M)
    image = render_hulls(shown, view, low, high, float(np.diff(axes.get_ylim())[0]) / 700.0)
    limits = axes.get_xlim(), axes.get_ylim()
    extent = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    axes.imshow(image, origin="lower", extent=extent, aspect="auto", interpolation="bilinear", zorder=2)
    around = slice(max(0, row - round(_PATH_S * scene.rate_hz)), row + round(_PATH_S * scene.rate_hz) + 1)
    axes.plot(*view.flat(track.ref_m[around]).T, color=drawing.NOMINAL, lw=1.2, zorder=3)
    driven = slice(around.start if since is None else since, row + 1)
    axes.plot(*view.flat(track.tcp_m[driven]).T, color=drawing.ACTUAL, lw=1.4, zorder=4)
    axes.set(xlim=limits[0], ylim=limits[1])


def legend() -> list[Patch | Line2D]:
    """Returns the legend of the colours of ``draw_instant``."""
    return [
        Patch(color=_ROBOT, lw=0, label="robot"),
        Patch(color=_PERSON, lw=0, label="recorded person"),
        Patch(color=drawing.ORANGE, alpha=0.3, lw=0, label="what the person could reach"),
        Line2D([], [], color=drawing.NOMINAL, lw=1.4, label="programmed"),
        Line2D([], [], color=drawing.ACTUAL, lw=1.4, label="driven"),
    ]


def _words(track: MethodTrack, row: int) -> str:
    """Describes the record at an instant."""
    found = {kind: known[index[row]] if index[row] >= 0 else "" for kind, (known, index) in track.names.items()}
    words = [found["status"] or "no record", f"{track.tcp_speed[row]:.2f} m/s"]
    if np.isfinite(track.body_m[row]):
        words.append(f"{track.body_m[row]:.2f} m from the body")
    if np.isfinite(track.distance_m[row]):
        words.append(f"{track.distance_m[row]:.2f} m from the volumes")
    reason = f"\n{reason_text(found['reason'])}" if found["reason"] else ""
    return ", ".join(words) + reason


def _stored(scene: ReplayScene, row: int) -> dict[str, SweptVolume]:
    """The volumes stored last before an instant, not more than a fifth of a second, by limb."""
    stored, now_ns = scene.volumes, int(scene.t_ns[row])
    before = stored.t_ns[(stored.t_ns <= now_ns) & (stored.t_ns >= now_ns - 200_000_000)]
    if not len(before):
        return {}
    return {
        stored.limbs[stored.limb[k]]: SweptVolume(
            stored.vertices_m[stored.offsets[k] : stored.offsets[k + 1]],
            float(stored.radius_m[k]),
        )
        for k in np.flatnonzero(stored.t_ns == before.max()).tolist()
    }


#: How far the viewer looks down [rad], and directions that are tried.
ELEVATION_RAD, _DIRECTIONS = 0.3, 36
#: Weight of a view along the line from robot to person beside the share of the robot that is hidden.
_AHEAD = 0.3


def clearest_azimuth(scene: ReplayScene, rows: Sequence[int], methods: Sequence[str]) -> float:
    """Returns the azimuth from which people hide the least of the robots, with both side by side [rad].

    Args:
        scene: The scene.
        rows: Instants that count.
        methods: Methods whose robots count.
    """
    points, people, towards = [], [], np.zeros(3)
    for row in rows:
        body = scene.body_m[row]
        known = np.isfinite(body).all(axis=(1, 2))
        if not known.any():
            body = scene.points_m[row][:, None].repeat(2, axis=1)
            known = np.isfinite(body).all(axis=(1, 2))
        if known.any():
            towards = towards + body[known].mean(axis=(0, 1)) - scene.robot.base_m
        for method in methods:
            ends = pose_links(scene.robot, scene.methods[method].q[row : row + 1])[0]
            points.append(np.concatenate([ends[:, 0], ends.mean(axis=1), ends[:, 1]]))
            people.append((scene.body_m[row], scene.body_radius_m))
    level = float(np.hypot(*towards[:2]))
    if level == 0.0:
        return -0.5 * np.pi
    azimuths = 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    ahead = np.abs(np.cos(azimuths - np.arctan2(towards[1], towards[0])))
    hidden = [
        np.mean(
            [
                _hidden(p, body, r, view_from(azimuth, ELEVATION_RAD))
                for p, (body, r) in zip(points, people, strict=True)
            ]
        )
        for azimuth in azimuths.tolist()
    ]
    return float(azimuths[int(np.argmin(np.round(np.array(hidden) + _AHEAD * ahead, 9)))])


def _hidden(points_m: Floats, body_m: Floats, radius_m: Floats, view: View) -> float:
    """Returns the share of points (n, 3) that capsules of a body hide in a view; unknown points are not counted."""
    points_m = points_m[np.isfinite(points_m).all(axis=1)]
    known = np.isfinite(body_m).all(axis=(1, 2))
    if not len(points_m) or not known.any():
        return 0.0
    sight = np.stack([points_m, points_m + 4.0 * view.toward], axis=1)
    near = [
        nearest_pair(sight[:, None], np.zeros(1), np.repeat(part[None, None], len(sight), axis=0), np.array([radius]))
        for part, radius in zip(body_m[known], radius_m[known], strict=True)
    ]
    return float((np.min([pair.distance_m for pair in near], axis=0) < 0.0).mean())
