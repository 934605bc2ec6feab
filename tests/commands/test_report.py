"""What a report shows of the run's own method, and ``report RUN --snapshot SECONDS`` (whole runs: test_replay.py)."""

from __future__ import annotations

import dataclasses
import io
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from matplotlib.path import Path as Path2D
from PIL import Image

from hrcreplay.commands import replay, report
from hrcreplay.errors import SettingsError
from hrcreplay.limits import load_limits
from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.run_config import read_run_config
from hrcreplay.records import LIMBS
from hrcreplay.reporting.figures import drawing, figure_data
from hrcreplay.reporting.figures.catalogue import FIGURES, FigureData
from hrcreplay.reporting.page.replay_page import snapshot
from hrcreplay.reporting.replay_scene import pose_links, robot_geometry
from hrcreplay.store import run_folder
from hrcreplay.store.run_folder import Run
from tests.facts import facts
from tests.reporting.moving import moving_run, moving_scene


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Run:
    out = tmp_path_factory.mktemp("sound") / "run"
    overrides = ("prediction.method=sound", "prediction.store_hz=5")
    return run_folder.read(
        replay.run("report", replay.demo_log(), out=out, overrides=overrides, start_s=8.0, end_s=12.0)
    )


def test_the_figure_of_volumes_holds_the_runs_own_method(sound: Run) -> None:
    people = figure_data._states(read_run_config(sound.folder), sound, ["instants"])
    assert people is not None
    (_, methods), *others = figure_data.volumes_by_method(read_run_config(sound.folder), sound, people)
    assert len(others) == 3
    assert list(methods) == ["paper", "positions", "sound"]
    assert list(methods["paper"]) == list(LIMBS)
    assert list(methods["sound"]) == [*LIMBS, "LEGS"]
    assert methods["paper"]["HD"][1] == 0.12
    assert methods["sound"]["HD"][1] > 0.12  # the residual


def test_the_page_has_the_lower_body(sound: Run) -> None:
    page = re.sub(r"<script.*?</script>", "", (sound.folder / "report.html").read_text(), flags=re.DOTALL)
    assert re.search(r"<t[hd][^>]*>\s*LEGS\s*</t[hd]>", page)
    assert "legs, of sound" in page
    assert not re.search(r"\b(nan|inf|None)\b", page)


def picture(row: int) -> np.ndarray:
    with drawing.style():
        figure = snapshot(moving_scene(moving_run(3.0)), row)
        figure.set_facecolor("white")
        content = drawing.png_bytes(figure)
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)


def share_of(image: np.ndarray, colour: tuple[int, int, int]) -> float:
    """How much of a picture has about that hue: its channels in about these proportions."""
    total = image.sum(axis=2)
    apart = np.abs(image / np.maximum(total, 1)[..., None] - np.array(colour) / sum(colour)).max(axis=2)
    return float(((apart < 0.03) & (total < 690)).mean())


def test_a_still_shows_robot_and_person_and_changes_with_the_instant() -> None:
    first, later = picture(30), picture(60)
    for image in (first, later):
        assert share_of(image, (217, 130, 59)) > 0.005
        assert share_of(image, (127, 178, 217)) > 0.01
    assert first.shape != later.shape or (first != later).any()
    np.testing.assert_array_equal(picture(30), first)


def test_what_no_still_can_be_taken_of_is_told(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=facts("--snapshot", str(tmp_path), "hrcreplay report")):
        report.take_still(tmp_path, 1.0, None)


def test_movie_and_rerun_file_are_made_of_the_folder_alone(sound: Run, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="needs rerun-sdk (extra: rerun)")
    assert report.make_movie(sound.folder, tmp_path / "tour.gif") == tmp_path / "tour.gif"
    assert report.save_for_rerun(sound.folder, tmp_path / "scene.rrd") == tmp_path / "scene.rrd"
    with Image.open(tmp_path / "tour.gif") as tour:
        assert getattr(tour, "n_frames", 1) > 20
    assert (tmp_path / "scene.rrd").read_bytes()[:3] == b"RRF"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene.rrd", "tour.gif"]  # no temporary file stays
    for make, name in ((report.make_movie, "tour.gif"), (report.save_for_rerun, "scene.rrd")):
        with pytest.raises(SettingsError, match=f"{name}: exists already"):
            make(sound.folder, tmp_path / name)
    for make, option in ((report.make_movie, "--movie"), (report.save_for_rerun, "--rerun")):
        with pytest.raises(SettingsError, match=facts(option, str(tmp_path), "hrcreplay report")):
            make(tmp_path, None)


def test_the_cameras_of_a_run_are_in_its_scene(sound: Run) -> None:
    scene = report.scene_of(read_run_config(sound.folder), sound)
    assert scene is not None
    assert [one.name for one in scene.cameras] == ["kinect", "xtion"]
    for one in scene.cameras:
        np.testing.assert_array_equal(one.T_world_camera, sound.meta["cameras"][one.name])
    assert (sound.folder / "foxglove-layout.json").is_file()


def test_every_figure_is_drawn_again_from_the_folder_alone(sound: Run, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(sound.folder, copy, ignore=shutil.ignore_patterns("figures"))
    text = (copy / "run.json").read_text()
    log = json.loads(text)["inputs"][0]["path"]
    (copy / "run.json").write_text(text.replace(log, "/nowhere/demo.mcap"))
    for kind in FIGURES:
        for path in report.draw_figures(copy, (kind.numbers or (kind.name,))[0], tmp_path / "out"):
            if path.suffix != ".pdf":  # which the report does not make
                assert path.read_bytes() == (sound.folder / "figures" / path.name).read_bytes(), path.name
    assert len(list((tmp_path / "out").iterdir())) == 3 * len(FIGURES)
    assert not (copy / "figures").exists()


def test_the_limits_of_a_run_are_read_back_from_it(sound: Run) -> None:
    run_config, want = read_run_config(sound.folder), load_limits("people")
    departure, wanted = run_config.prediction_limits.departure, want.departure
    assert departure is not None
    assert wanted is not None
    for found, right in ((vars(run_config.prediction_limits), vars(want)), (vars(departure), vars(wanted))):
        for name in right.keys() - {"departure"}:
            np.testing.assert_array_equal(found[name], right[name], err_msg=name)


def test_a_run_of_other_bounds_is_told_to_be_of_another_version(sound: Run, tmp_path: Path) -> None:
    meta = json.loads((sound.folder / "run.json").read_text())
    del meta["limits"]["prediction"]["departure"]["rise_m"]
    (tmp_path / "run.json").write_text(json.dumps(meta))
    with pytest.raises(SettingsError, match=facts(str(tmp_path), "people", "version")):
        read_run_config(tmp_path)


@pytest.fixture(scope="module")
def data(sound: Run) -> FigureData:
    metrics = json.loads((sound.folder / "metrics.json").read_text())
    return report.figure_data(read_run_config(sound.folder), sound, metrics, FIGURES)


def test_the_storyboard_has_both_robots_at_the_same_programmed_instant(sound: Run, data: FigureData) -> None:
    run_config, story = read_run_config(sound.folder), data.story
    assert story is not None
    assert sound.motion is not None
    assert sound.T_world_base is not None
    geometry = robot_geometry(assembly.robot(run_config, sound.T_world_base))
    step_s = np.diff([scene.programme_s for scene in story.scenes])
    assert step_s == pytest.approx(step_s[0])
    for scene in story.scenes:
        for table, t_ns, ends_m in zip((sound.baselines["none"], sound.motion), scene.t_ns, scene.ends_m, strict=True):
            row = int(np.flatnonzero(table["t_ns"].to_numpy() == t_ns)[0])
            assert 0.0 <= table["programme_s"].iloc[row] - scene.programme_s < 0.0041
            q = table[[f"q{i}" for i in range(1, 7)]].to_numpy(dtype=float)[[row]]
            np.testing.assert_allclose(pose_links(geometry, q)[0], ends_m, atol=1e-9)
        assert scene.volumes


def test_the_person_walks_within_what_sound_encloses(sound: Run, data: FigureData) -> None:
    walk = data.walk
    assert walk is not None
    assert sound.state is not None
    assert len(walk.walked_m) > 80  # 0.377 s at 250 Hz
    polygon = Path2D(walk.polygon_m)
    assert polygon.contains_points(walk.walked_m).all()
    at = sound.state[sound.state["t_ns"] == walk.t_ns].iloc[0]
    assert walk.place_m.tolist() == [at["x"], at["y"]]
    assert walk.heading_rad == at["theta"]
    (left, back), (right, front) = walk.box_m
    assert left <= at["x"] <= right
    assert back <= at["y"] <= front


def test_a_forearms_sweep_encloses_its_arc(data: FigureData) -> None:
    sweep = data.sweep
    assert sweep is not None
    length_m = np.linalg.norm(sweep.wrist_m - sweep.elbow_m)
    np.testing.assert_allclose(np.linalg.norm(sweep.arc_m - sweep.elbow_m, axis=1), length_m, rtol=1e-12)
    assert (np.linalg.norm(sweep.apexes_m - sweep.elbow_m, axis=1) > length_m).all()
    for end in sweep.arc_m[[0, -1]]:  # an apex is on the tangents at the arc's ends
        for apex in sweep.apexes_m[:1] if len(sweep.apexes_m) == 1 else ():
            assert (apex - end) @ (end - sweep.elbow_m) == pytest.approx(0.0, abs=1e-9)


def test_a_forearm_whose_length_nobody_measured_is_not_swept(sound: Run) -> None:
    run_config = read_run_config(sound.folder)
    people = figure_data._states(run_config, sound, ["sweep", "growth"])
    assert people is not None
    unknown = dataclasses.replace(people, lengths_m=people.lengths_m * np.nan)
    assert figure_data.forearm_sweep(run_config, sound, people) is not None
    assert figure_data.forearm_sweep(run_config, sound, unknown) is None
    growth = figure_data.volume_growth(run_config, sound, unknown)
    assert growth is not None
    assert np.isnan(growth.volume_m3["sound"]).all()


def test_volumes_grow_with_the_horizon(data: FigureData) -> None:
    growth = data.growth
    assert growth is not None
    assert growth.horizon_s[[0, -1]].tolist() == [0.0, 0.377]
    for volume_m3 in growth.volume_m3.values():
        assert (np.diff(volume_m3) > 0).all()
    assert growth.volume_m3["sound"][0] > growth.volume_m3["paper"][0]  # the estimate may be wrong, and has hands
