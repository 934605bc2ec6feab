"""A still of the replay at one instant: robot, recorded person, volumes, paths, and what the record says of it."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon

from hrcreplay.records import Floats
from hrcreplay.report import drawing
from hrcreplay.report.projection import RenderedHull, View, outline, render_hulls, view_from
from hrcreplay.report.replay_scene import RATE_HZ, MethodTrack, ReplayScene, posed
from hrcreplay.report.tables import reason_text

_ROBOT, _PERSON = "#d9823b", "#7fb2d9"
#: Seconds of the paths around the instant that are drawn.
_PATH_S = 8.0
_MARGIN_M = 0.12


def snapshot(scene: ReplayScene, row: int) -> Figure:
    """The scene of the run's own method at one of its instants, seen with robot and person side by side.

    Args:
        scene: What moves.
        row: Which of its instants.
    """
    name, track = next(iter(scene.methods.items()))
    ends = posed(scene.robot, track.q[row : row + 1])[0]
    body = scene.body_m[row]
    view = view_from(_beside(scene, row), 0.18)
    robot = [RenderedHull(pair, float(r), to_rgb(_ROBOT)) for pair, r in zip(ends, scene.robot.radius_m, strict=True)]
    person = [
        RenderedHull(pair, float(r), to_rgb(_PERSON))
        for pair, r in zip(body, scene.body_radius_m, strict=True)
        if np.isfinite(pair).all()
    ]
    volumes = _stored(scene, row)
    figure = drawing.new_figure(6.2)
    axes = drawing.panels(figure, 1, 1, left_in=0.62, top_in=0.62, bottom_in=0.75)[0][0]
    edges = [outline(solid.vertices_m, solid.radius_m, view) for solid in (*robot, *person)]
    corners = np.vstack([*edges, *(edge for edge in volumes_outlines(volumes, view) if len(edge))])
    low, high = corners.min(axis=0) - _MARGIN_M, corners.max(axis=0) + _MARGIN_M
    drawing.set_window(axes, low.tolist(), high.tolist())
    for edge in volumes_outlines(volumes, view):
        axes.add_patch(Polygon(edge, facecolor=drawing.ORANGE, edgecolor=drawing.ORANGE, alpha=0.16, lw=0.7, zorder=1))
    image = render_hulls([*robot, *person], view, low, high, float(high[1] - low[1]) / 700.0)
    limits = axes.get_xlim(), axes.get_ylim()
    extent = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    axes.imshow(image, origin="lower", extent=extent, aspect="auto", interpolation="bilinear", zorder=2)
    around = slice(max(0, row - round(_PATH_S * RATE_HZ)), row + round(_PATH_S * RATE_HZ) + 1)
    axes.plot(*view.flat(track.ref_m[around]).T, color=drawing.NOMINAL, lw=1.2, zorder=3)
    axes.plot(*view.flat(track.tcp_m[around.start : row + 1]).T, color=drawing.ACTUAL, lw=1.4, zorder=4)
    axes.set(xlim=limits[0], ylim=limits[1], xlabel="across [m]", ylabel="up [m]")
    axes.set_title(f"{scene.seconds[row]:.2f} s, {name}: {_words(track, row)}", wrap=True)
    figure.legend(handles=_legend(), loc="lower center", ncols=5, bbox_to_anchor=(0.5, 0.01))
    return figure


def _legend() -> list[Patch | Line2D]:
    return [
        Patch(color=_ROBOT, lw=0, label="robot"),
        Patch(color=_PERSON, lw=0, label="recorded person"),
        Patch(color=drawing.ORANGE, alpha=0.3, lw=0, label="what the person could reach"),
        Line2D([], [], color=drawing.NOMINAL, lw=1.4, label="programmed"),
        Line2D([], [], color=drawing.ACTUAL, lw=1.4, label="driven"),
    ]


def _words(track: MethodTrack, row: int) -> str:
    """What the record says of an instant."""
    found = {kind: known[index[row]] if index[row] >= 0 else "" for kind, (known, index) in track.names.items()}
    words = [found["status"] or "no record", f"{track.tcp_speed[row]:.2f} m/s"]
    if np.isfinite(track.body_m[row]):
        words.append(f"{track.body_m[row]:.2f} m from the body")
    if np.isfinite(track.distance_m[row]):
        words.append(f"{track.distance_m[row]:.2f} m from the volumes")
    reason = f"\n{reason_text(found['reason'])}" if found["reason"] else ""
    return ", ".join(words) + reason


def _stored(scene: ReplayScene, row: int) -> list[tuple[Floats, float]]:
    """The volumes stored last before an instant, not more than a fifth of a second."""
    stored, now_ns = scene.volumes, int(scene.t_ns[row])
    before = stored.t_ns[(stored.t_ns <= now_ns) & (stored.t_ns >= now_ns - 200_000_000)]
    if not len(before):
        return []
    return [
        (stored.vertices_m[stored.offsets[k] : stored.offsets[k + 1]], float(stored.radius_m[k]))
        for k in np.flatnonzero(stored.t_ns == before.max()).tolist()
    ]


def volumes_outlines(volumes: list[tuple[Floats, float]], view: View) -> list[Floats]:
    """(k, 2) the outline of each volume in a view [m]."""
    return [outline(vertices, radius, view) for vertices, radius in volumes]


def _beside(scene: ReplayScene, row: int) -> float:
    """The azimuth of who sees robot and person side by side [rad]."""
    known = scene.body_m[row] if len(scene.body_parts) else scene.points_m[row]
    person = known.reshape(-1, 3)
    person = person[np.isfinite(person).all(axis=1)]
    if not len(person):
        return -0.5 * np.pi
    towards = person.mean(axis=0) - scene.robot.base_m
    return float(np.arctan2(towards[1], towards[0]) - 0.5 * np.pi)
