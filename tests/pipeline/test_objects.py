"""Runs in a cell with objects: nothing is touched, the record says what is near, and a bad cell is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from hrcreplay.commands import replay
from hrcreplay.commands.explain import explain, sentences
from hrcreplay.errors import SettingsError
from hrcreplay.pipeline.run_config import resolve
from hrcreplay.store import run_folder
from tests.tools.object_overlaps import check

CELL = Path(__file__).parents[2] / "datasets" / "demo_cell.toml"
START_S, END_S = 12.0, 17.0
ALONE = ("plan.baselines=[]",)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("objects") / "run"
    return replay.run("plan", replay.demo_log(), cell_file=CELL, overrides=ALONE, out=out, start_s=START_S, end_s=END_S)


def test_no_tick_and_no_certified_stop_touches_an_object_or_another_link() -> None:
    found = check(resolve("plan", replay.demo_log(), cell_file=CELL, start_s=START_S, end_s=END_S), every=5)
    assert found.ticks == 1251
    held_off = {pair: apart for pair, apart in found.objects.items() if pair not in {("tool", "rack"), ("tool", "box")}}
    assert min(held_off.values()) > 0.0, held_off
    assert min(found.links.values()) > 0.0, found.links
    assert min(found.objects["tool", "rack"], found.objects["tool", "box"]) > -0.025, "as deep as the programme needs"


def test_the_record_has_the_nearest_object_and_pair_of_links(folder: Path) -> None:
    motion = pq.read_table(folder / "motion.parquet").to_pandas()
    assert np.isfinite(motion["object_distance_m"]).all()
    assert (motion["object_distance_m"] > 0.0).all()
    assert set(motion["object"]) <= {"floor", "pedestal", "table", "rack", "box"}
    assert set(motion["object_link"]) <= {"shoulder", "upper_arm", "forearm", "wrist", "tool"}
    assert (motion["self_distance_m"] > 0.0).all()
    assert (motion["self_link"] != motion["self_other_link"]).all()
    notes = run_folder.read_meta(folder)["notes"]
    assert any("rack" in note and "tool may approach it" in note for note in notes)
    assert any("out of sight" in note and "crouches" in note for note in notes)


def test_why_reproduces_a_tick_beside_objects_and_names_the_nearest(folder: Path) -> None:
    found = explain(folder, 1.5)
    motion = pq.read_table(folder / "motion.parquet").to_pandas()
    row = motion.iloc[found["tick"]]
    assert found["nearest_object"] == {
        "link": row["object_link"],
        "object": row["object"],
        "distance_m": row["object_distance_m"],
    }
    assert any(
        row["object"] in line and f"{1e3 * row['object_distance_m']:.1f} mm" in line for line in sentences(found)
    )


def test_an_object_in_the_programmes_way_is_refused_before_any_frame_is_read(tmp_path: Path) -> None:
    text = CELL.read_text() + '[[objects]]\nname = "crate"\nshape = "sphere"\nradius_m = 0.1\n'
    (tmp_path / "cell.toml").write_text(text + "position_m = [0.38, 0.7, 1.0]\n")
    with pytest.raises(SettingsError) as refused:
        replay.run(
            "plan",
            replay.demo_log(),
            cell_file=tmp_path / "cell.toml",
            out=tmp_path / "run",
            start_s=START_S,
            end_s=END_S,
        )
    assert all(word in str(refused.value) for word in ("crate", "tool", "mm inside it", "waypoint"))


def test_a_cell_without_objects_has_no_column_of_them(tmp_path: Path) -> None:
    folder = replay.run(
        "plan", replay.demo_log(), overrides=ALONE, out=tmp_path / "run", start_s=START_S, end_s=START_S + 0.1
    )
    names = pq.read_schema(folder / "motion.parquet").names
    assert not [name for name in names if name.startswith(("object", "self_"))]


def test_an_srdf_alone_keeps_the_links_apart_that_it_does_not_disable(tmp_path: Path) -> None:
    (tmp_path / "arm.srdf").write_text("<robot name='r'><disable_collisions link1='link_1' link2='link_3'/></robot>")
    overrides = (*ALONE, f"robot.srdf={tmp_path / 'arm.srdf'}")
    how = {"start_s": START_S, "end_s": START_S + 0.1}
    folder = replay.run("plan", replay.demo_log(), overrides=overrides, out=tmp_path / "run", **how)  # type: ignore[arg-type]
    motion = pq.read_table(folder / "motion.parquet").to_pandas()
    assert motion["object_distance_m"].isna().all()
    assert (motion["self_distance_m"] > 0.0).all()
    assert set(zip(motion["self_link"], motion["self_other_link"], strict=True)) <= {
        *{("shoulder", "wrist"), ("shoulder", "tool"), ("upper_arm", "wrist"), ("upper_arm", "tool")}
    }
    assert run_folder.read_meta(folder)["srdf"] == [["link_1", "link_3"]]


def test_without_the_cameras_views_a_note_says_that_hidden_places_are_not_known(tmp_path: Path) -> None:
    text = CELL.read_text()
    (tmp_path / "cell.toml").write_text(text[text.index("[[objects]]") :])
    how = {"start_s": START_S, "end_s": START_S + 0.1, "cell_file": tmp_path / "cell.toml"}
    folder = replay.run("plan", replay.demo_log(), overrides=ALONE, out=tmp_path / "run", **how)  # type: ignore[arg-type]
    assert any("kinect" in note and "fov_deg" in note for note in run_folder.read_meta(folder)["notes"])
