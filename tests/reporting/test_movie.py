"""The tour as a moving picture."""

from __future__ import annotations

import dataclasses
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hrcreplay.errors import SettingsError
from hrcreplay.reporting import movie
from hrcreplay.reporting.movie import frames, write_movie
from hrcreplay.reporting.page.replay_page import clearest_azimuth, solids, touching_pairs
from hrcreplay.reporting.replay_scene import pose_links
from hrcreplay.reporting.tour import tour
from tests.reporting.moving import moving_run, moving_scene

SCENE = moving_scene(moving_run(6.0))


def test_a_gif_shows_the_tour_at_the_pace_of_the_recording(tmp_path: Path) -> None:
    write_movie(tmp_path / "tour.gif", SCENE)
    write_movie(tmp_path / "again.gif", SCENE)
    assert (tmp_path / "tour.gif").read_bytes() == (tmp_path / "again.gif").read_bytes()
    wanted_s = sum(stop.until_s - stop.from_s for stop in tour(SCENE))
    with Image.open(tmp_path / "tour.gif") as picture:
        shown_s = 0.0
        for k in range(getattr(picture, "n_frames", 1)):
            picture.seek(k)
            shown_s += picture.info["duration"] / 1000.0
    assert shown_s == pytest.approx(wanted_s, abs=0.1 * len(tour(SCENE)))


def test_the_pictures_show_both_methods_and_the_contact_in_red() -> None:
    stop = next(stop for stop in tour(SCENE) if "contact" in stop.words)
    pictures = list(frames(SCENE, [stop], 5))
    assert len({picture.size for picture in pictures}) == 1
    assert pictures[0].width == 2 * movie._WIDE
    rows = np.flatnonzero((SCENE.seconds >= stop.from_s) & (SCENE.seconds < stop.until_s))[::5]
    touching = int(np.argmin(np.abs(SCENE.seconds[rows] - stop.at_s)))
    right = np.asarray(pictures[touching].crop((movie._WIDE, 0, 2 * movie._WIDE, movie._BAR))).astype(int)
    assert ((right[..., 0] - right[..., 1]) > 90).any()  # the title of the method that touches is red
    left = np.asarray(pictures[touching].crop((0, 0, movie._WIDE, movie._BAR))).astype(int)
    assert not ((left[..., 0] - left[..., 1]) > 90).any()


def test_what_touches_is_what_brute_force_finds() -> None:
    row, share = 80, np.linspace(0.0, 1.0, 101)[:, None]
    ends = pose_links(SCENE.robot, SCENE.methods["qp"].q[row : row + 1])[0]
    radius_m = SCENE.body_radius_m + 0.25  # so that there is something to find
    found = touching_pairs(ends, SCENE.robot.radius_m, SCENE.body_m[row], radius_m)
    want = [
        (link, part)
        for part, ((c, d), s) in enumerate(zip(SCENE.body_m[row], radius_m, strict=True))
        for link, ((a, b), r) in enumerate(zip(ends, SCENE.robot.radius_m, strict=True))
        if np.linalg.norm((a + share * (b - a))[:, None] - (c + share * (d - c))[None], axis=2).min() <= r + s
    ]
    assert sorted(found) == sorted(want)
    assert 0 < len(want) < len(ends) * len(radius_m)


def test_the_view_is_one_from_which_the_person_hides_little() -> None:
    """A wall of a person between viewer and robot: seen from its side the robot stands free."""
    body = SCENE.body_m.copy()
    base = SCENE.robot.base_m
    body[:] = (base + np.array([0.9, 0.0, 0.3]))[None, None, None] + np.array([[0.0, -0.3, 0.0], [0.0, 0.3, 0.0]])
    scene = dataclasses.replace(SCENE, body_m=body, body_radius_m=np.full(len(SCENE.body_parts), 0.3))
    azimuth = clearest_azimuth(scene, [50], ["qp"])
    assert abs(np.sin(azimuth)) > 0.8  # from the side, not along x
    assert len(solids(scene, 50)) > len(scene.body_parts)


def test_a_suffix_that_is_no_movie_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"tour\.avi is neither \.mp4 nor \.gif"):
        write_movie(tmp_path / "tour.avi", SCENE)


def test_an_mp4_without_ffmpeg_says_what_helps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    with pytest.raises(SettingsError, match="needs ffmpeg"):
        write_movie(tmp_path / "tour.mp4", SCENE)
    assert movie.default_name() == "tour.gif"


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg (Debian: apt-get install ffmpeg)")
def test_an_mp4_has_the_frames_of_the_tour(tmp_path: Path) -> None:
    write_movie(tmp_path / "tour.mp4", SCENE)
    said = subprocess.run(["ffmpeg", "-i", tmp_path / "tour.mp4", "-f", "null", "-"], capture_output=True, text=True)
    wanted = sum(int(((SCENE.seconds >= stop.from_s) & (SCENE.seconds < stop.until_s)).sum()) for stop in tour(SCENE))
    assert f"frame= {wanted:4d}".replace("  ", " ").split("=")[1].strip() in said.stderr
