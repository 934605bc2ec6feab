from __future__ import annotations

import dataclasses
import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pypdf import PdfReader

from hrcreplay.records import SweptVolume
from hrcreplay.reporting.figures import catalogue, planning, prediction
from hrcreplay.reporting.figures.catalogue import FIGURES, FigureData
from hrcreplay.reporting.figures.prediction import Growth, Sweep, Walk
from hrcreplay.reporting.figures.scene import ABOVE, RenderedHull, render_hulls, view_from
from hrcreplay.reporting.metrics import series
from hrcreplay.reporting.metrics.planning import deviation_m
from hrcreplay.reporting.metrics.series import instants
from hrcreplay.reporting.tables import LIMB_NAMES
from hrcreplay.store.run_folder import Run
from tests.facts import tells
from tests.reporting.moving import moving_run
from tests.reporting.synthetic import RADII_M, T0_NS, frame_of, make_run, metrics_of, volumes_at

#: Of the made-up run, whose robot has no joints: all but those that show its links.
ALL = {kind.name for kind in FIGURES} - {"horizon", "fig15_storyboard", "robot_links"}
#: Those of the robot that need no prediction.
OF_ROBOT = {"fig13a_path", "fig13b_deviation", "fig14_speed", "stationary_share", "status"}


def data_of(run: Run, *, predicted: bool = True) -> FigureData:
    """What figures are drawn from; the predictions are made up as well."""
    data = FigureData(run, metrics_of(run), near_m=0.5, stationary_m_per_s=0.001)
    ticks = instants(run)
    if not predicted or not len(ticks):
        return data
    volumes = [
        (
            int(k),
            {
                m: {
                    limb: SweptVolume(vertices, RADII_M[limb])
                    for limb, vertices in volumes_at((k - T0_NS) * 1e-9, s).items()
                }
                for m, s in (("paper", 0.05), ("positions", 0.15))
            },
        )
        for k in ticks
    ]
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    walk = Walk(int(ticks[0]), 0.377, square[0], 0.3, 0.5, (-0.4, 0.6), square[[0, 2]], square, square[:2] * 0.2)
    angle = np.linspace(0.2, 1.0, 21)
    arc = 0.3 * np.column_stack([np.cos(angle), np.zeros(21), np.sin(angle)])
    sweep = Sweep(int(ticks[0]), "LRA", np.zeros(3), arc[3], arc, arc[[10]] / np.cos(0.4), square[[0, 2]] * 0.2)
    growth = Growth(int(ticks[0]), np.array([0.0, 0.1]), {"paper": np.array([0.1, 0.2])})
    return dataclasses.replace(data, instants=volumes, walk=walk, sweep=sweep, growth=growth)


def draw(run: Run, folder: Path, *, predicted: bool = True) -> set[str]:
    return set(catalogue.draw_all(data_of(run, predicted=predicted), folder))


def test_the_same_run_draws_the_same_bytes(tmp_path: Path) -> None:
    run = make_run(5.0)
    for folder in ("a", "b"):
        assert draw(run, tmp_path / folder) == ALL
    files = sorted(p.name for p in (tmp_path / "a").iterdir())
    assert files == sorted(f"{name}.{kind}" for name in ALL for kind in ("png", "svg"))
    for name in files:
        first, second = ((tmp_path / folder / name).read_bytes() for folder in ("a", "b"))
        assert first == second, name
        assert len(first) < 400_000 or name.endswith(".svg"), name
        assert b"Matplotlib" not in first or name.endswith(".png"), name


def test_a_pdf_has_the_words_of_its_figure_and_the_same_bytes_each_time(tmp_path: Path) -> None:
    run, kinds = make_run(5.0), catalogue.find("18")
    for folder in ("a", "b"):
        catalogue.draw_all(data_of(run), tmp_path / folder, kinds, pdf=True)
    first, second = ((tmp_path / folder / "fig18_coordinate.pdf").read_bytes() for folder in ("a", "b"))
    assert first == second
    (page,) = PdfReader(io.BytesIO(first)).pages
    assert tells(" ".join(page.extract_text().split()), "fused", "truth", "kinect", "time [s]")
    assert float(page.mediabox.width) == pytest.approx(252.0)


def test_what_has_no_data_is_not_drawn(tmp_path: Path) -> None:
    run = make_run(4.0, human=False, robot=False)
    assert draw(run, tmp_path, predicted=False) == {"fig18_coordinate", "joint_angles", "data_quality"}


def test_a_person_never_seen_and_a_robot_that_never_moved(tmp_path: Path) -> None:
    run = make_run(4.0)
    assert run.state is not None
    assert run.motion is not None
    keep = {"t_ns", "valid_kinect", "valid_xtion"}
    state = run.state.assign(**{name: np.nan for name in run.state.columns if name not in keep})
    state = state.assign(valid_kinect=False, valid_xtion=False)
    motion = run.motion.assign(distance_m=np.nan, limb=None, tcp_speed=0.0, status="braking", reason="no person yet")
    run = dataclasses.replace(run, state=state, motion=motion, measurements=None, occupancy=None, baselines={})
    assert len(instants(run)) == 0
    assert draw(run, tmp_path) == OF_ROBOT | {"joint_angles"}


def test_volumes_show_every_method_and_limb_in_its_own_size() -> None:
    run = make_run(5.0)
    assert run.state is not None
    limbs = {limb: SweptVolume(vertices, 0.1) for limb, vertices in volumes_at(2.0, 0.05).items()}
    tall = limbs | {"LEGS": SweptVolume(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 9.0]]), 0.5)}
    k = T0_NS + 2_000_000_000
    plain = prediction.volumes([(k, {"paper": limbs})], run.state, T0_NS)
    assert "legs" not in {text.get_text() for text in plain.legends[0].get_texts()}
    found = prediction.volumes([(k, {"paper": limbs, "sound": tall})], run.state, T0_NS)
    assert {text.get_text() for text in found.legends[0].get_texts()} == {LIMB_NAMES[limb] for limb in (*limbs, "LEGS")}
    assert [ax.get_ylabel().split("\n")[0] for ax in found.axes] == ["paper", "sound"]
    low, high = found.axes[1].get_ylim()
    assert high - low > 9.0 * np.cos(0.28)
    scales = [np.diff(ax.get_xlim()) / ax.get_position().width for ax in found.axes]
    assert scales[0] == pytest.approx(scales[1])


def test_a_robot_that_kept_to_its_path_left_it_nowhere(tmp_path: Path) -> None:
    run = make_run(5.0)
    assert run.motion is not None
    kept = run.motion.assign(tcp_x=run.motion["ref_x"], tcp_y=run.motion["ref_y"], tcp_z=run.motion["ref_z"])
    (ax,) = planning.deviation(run.motion, None, T0_NS).axes
    assert [text.get_text() for text in ax.texts] == [f"{planning.largest_deviation(run.motion).length_m:.3f} m"]
    kept_run = dataclasses.replace(run, motion=kept)
    (kind,) = catalogue.find("13b")
    why = catalogue.missing(kind, kept_run, data_of(kept_run).metrics)
    assert tells(why, "TCP", "path")
    assert draw(kept_run, tmp_path, predicted=False) >= {"fig13a_path", "fig14_speed"}
    assert not (tmp_path / "fig13b_deviation.png").exists()


def test_every_figure_is_one_column_wide_and_has_a_name_of_its_own(tmp_path: Path) -> None:
    names, numbers = [kind.name for kind in FIGURES], [n for kind in FIGURES for n in kind.numbers]
    assert len(set(names)) == len(names)
    assert numbers == ["5", "7", "8", "9", "13a", "13b", "14", "15", "16", "17", "18"]
    assert all(kind.caption.endswith(".") and set(kind.needs) <= set(catalogue.NEEDS) for kind in FIGURES)
    for name in draw(make_run(5.0), tmp_path):
        assert 'width="252pt"' in (tmp_path / f"{name}.svg").read_text()[:600], name  # 3.5 in
        with Image.open(tmp_path / f"{name}.png") as image:
            assert image.width == 1050


def test_a_figure_is_found_by_number_and_by_name() -> None:
    found = {
        key: [kind.name for kind in catalogue.find(key)] for key in ("14", "Fig. 14", "16", "13", "13b", "horizon")
    }
    assert found == {
        "14": ["fig14_speed"],
        "Fig. 14": ["fig14_speed"],
        "16": ["fig15_storyboard"],
        "13": ["fig13a_path", "fig13b_deviation"],
        "13b": ["fig13b_deviation"],
        "horizon": ["horizon"],
    }
    assert [catalogue.find(key) for key in ("12", "", "a", "fig99")] == [()] * 4


def test_speed_and_horizon_show_the_runs_columns() -> None:
    run = moving_run(4.0)
    motion = run.motion
    assert motion is not None
    motion = frame_of(motion)
    motion["tau_s"] = np.linspace(0.0, 0.3, len(motion))
    seconds = (motion["t_ns"].to_numpy() - motion["t_ns"].iloc[0]) / 1e9
    nominal, actual, separation = planning.speed(motion, T0_NS, 0.5).axes
    drawn = planning.horizon(motion, T0_NS, 0.377).axes[0]
    lines = [*(ax.lines[0] for ax in (nominal, actual, separation)), *drawn.lines[:2]]
    for line, name in zip(lines, ("ref_speed", "tcp_speed", "distance_m", "horizon_s", "tau_s"), strict=True):
        np.testing.assert_allclose(np.asarray(line.get_xdata(), dtype=float), seconds, atol=1e-9)
        np.testing.assert_array_equal(np.asarray(line.get_ydata(), dtype=float), motion[name].to_numpy(dtype=float))
    assert set(np.asarray(drawn.lines[2].get_ydata()).tolist()) == {0.377}


def test_volumes_against_the_horizon_are_those_stored() -> None:
    run = make_run(3.0)
    assert run.occupancy is not None
    occupancy = run.occupancy.assign(horizon_s=np.arange(len(run.occupancy)) // 6 * 0.001)
    found = Growth(T0_NS, np.array([0.0, 0.1, 0.2]), {"paper": np.array([0.1, 0.2, 0.4])})
    ax = prediction.growth(found, occupancy, T0_NS).axes[0]
    lines = {str(line.get_label()): np.asarray(line.get_xydata(), dtype=float) for line in ax.lines}
    stored = lines["_"]
    np.testing.assert_allclose(stored[:, 0], 0.001 * np.arange(len(occupancy) // 6))
    np.testing.assert_allclose(stored[:, 1], 0.01 * (1 + 2 + 3 + 4 + 5 + 6))
    assert lines["paper"][:, 1].tolist() == [0.1, 0.2, 0.4]
    without = occupancy[(occupancy["limb"] != "HD") | (occupancy["horizon_s"] > 0.0)]  # one limb of one tick not known
    assert len(prediction.stored_sums(without)[0]) == len(occupancy) // 6 - 1


def test_the_largest_deviation_is_where_the_tcp_was_furthest_from_every_point_of_the_path() -> None:
    run = make_run(6.0)
    assert run.motion is not None
    reference, tcp = (run.motion[[f"{point}_{axis}" for axis in "xyz"]].to_numpy() for point in ("ref", "tcp"))
    nearest = np.linalg.norm(tcp[:, None] - reference, axis=2).min(axis=1)  # to the vertices, which are dense
    found = planning.largest_deviation(run.motion)
    assert found.length_m == pytest.approx(nearest.max(), abs=2e-3)
    assert nearest[found.row] == pytest.approx(nearest.max(), abs=2e-3)
    np.testing.assert_array_equal(found.at_m, tcp[found.row])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(series, "_TOGETHER", 7)
        again = planning.largest_deviation(run.motion)
        assert deviation_m(run.motion).argmax() == again.row == found.row
        np.testing.assert_array_equal(again.foot_m, found.foot_m)
        assert deviation_m(run.motion).max() == found.length_m


def test_the_figure_of_the_path_shows_all_of_both_ways() -> None:
    run = make_run(6.0)
    assert run.motion is not None
    far = frame_of(run.motion)
    far["tcp_y"], far["ref_x"] = far["tcp_y"] + 0.7, far["ref_x"] - 0.9
    above = planning.path(far, None, T0_NS).axes[0]
    for (low, high), axis in ((above.get_xlim(), "x"), (above.get_ylim(), "y")):
        for what in ("ref", "tcp"):
            assert low < far[f"{what}_{axis}"].min()
            assert far[f"{what}_{axis}"].max() < high


def test_instants_are_a_second_apart_and_hold_the_nearest() -> None:
    run = make_run(12.0)
    assert run.motion is not None
    ticks = instants(run)
    assert np.diff(ticks) * 1e-9 == pytest.approx([1.0, 1.0, 1.0], abs=0.011)
    nearest = frame_of(run.motion).sort_values("distance_m")["t_ns"].iloc[0]
    assert ticks[0] <= nearest <= ticks[-1]


BLACK = (0.0, 0.0, 0.0)


def test_outline_of_a_ball_is_its_circle_from_anywhere() -> None:
    centre = np.array([[0.3, -0.2, 1.0]])
    for azimuth, elevation in ((0.0, 0.0), (1.0, 0.4), (-2.0, 1.2)):
        view = view_from(azimuth, elevation)
        edge = RenderedHull(centre, 0.25, BLACK).outline(view) - view.flat(centre)
        assert np.linalg.norm(edge, axis=1) == pytest.approx(0.25)


def test_outline_of_missing_vertices_is_empty() -> None:
    assert len(RenderedHull(np.full((1, 3), np.nan), 0.1, BLACK).outline(view_from(0.0, 0.0))) == 0


def test_the_floor_cuts_the_outline_of_a_ball() -> None:
    """A ball with its centre in the floor: a half circle from the side, half an ellipse from obliquely above."""
    ball = RenderedHull(np.array([[0.3, -0.2, 0.0]]), 0.25, BLACK, floor_m=0.0)
    for elevation in (0.0, 0.5, 1.2):
        view = view_from(0.7, elevation)
        edge = ball.outline(view) - view.flat(ball.vertices_m)
        low = np.sin(elevation) * 0.25
        assert edge[:, 1].max() == pytest.approx(0.25, abs=0.002)
        assert edge[:, 1].min() == pytest.approx(-low, abs=0.01)
        assert edge[:, 0].max() == pytest.approx(0.25, abs=0.002)
        below = edge[edge[:, 1] < -0.02]
        if len(below):
            assert np.hypot(below[:, 0] / 0.25, below[:, 1] / low) == pytest.approx(1.0, abs=0.05)
    assert len(RenderedHull(np.array([[0.0, 0.0, -1.0]]), 0.25, BLACK, floor_m=0.0).outline(ABOVE)) == 0
    buried = RenderedHull(np.array([[0.0, 0.0, -1.0]]), 0.25, BLACK, floor_m=0.0)
    assert not render_hulls([buried], ABOVE, -np.ones(2), np.ones(2), 0.05).any()


def test_picture_shows_the_nearer_solid_and_the_area_of_a_ball() -> None:
    view = view_from(0.0, 0.0)  # looks along -x: larger x is nearer
    near = RenderedHull(np.array([[1.0, 0.0, 0.0]]), 0.2, (1.0, 0.0, 0.0))
    far = RenderedHull(np.array([[-1.0, 0.0, 0.0]]), 0.4, (0.0, 0.0, 1.0))
    for order in ((near, far), (far, near)):
        image = render_hulls(order, view, np.array([-0.5, -0.5]), np.array([0.5, 0.5]), 0.01)
        assert image.shape == (100, 100, 4)
        middle, rim = image[50, 50], image[50, 20]
        assert middle[0] > 0.5
        assert middle[2] == 0.0
        assert rim[2] > 0.5
        assert image[2, 2, 3] == 0.0
        assert (image[..., 3] > 0).mean() == pytest.approx(np.pi * 0.4**2, rel=0.08)


def test_the_window_of_a_path_holds_the_programme_the_robot_and_its_base() -> None:
    run = make_run(12.0)
    assert run.motion is not None
    base = np.eye(4)
    base[:3, 3] = 0.1, -0.9, 0.3
    above, side = planning.path(run.motion, None, T0_NS, base).axes[:2]
    for ax, (x, y) in ((above, "xy"), (side, "xz")):
        for what in ("ref", "tcp"):
            seen = (run.motion[f"{what}_{axis}"].to_numpy(dtype=float) for axis in (x, y))
            for values, (low, high) in zip(seen, (ax.get_xlim(), ax.get_ylim()), strict=True):
                assert low < values.min()
                assert values.max() < high
        at = dict(zip("xyz", base[:3, 3].tolist(), strict=True))
        assert ax.get_xlim()[0] < at[x] < ax.get_xlim()[1]
        assert ax.get_ylim()[0] < at[y] < ax.get_ylim()[1]
