"""Figures, page and scenes of a run with two people show both; of a run with one they are as without the other."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from hrcreplay.human.model import PARTS
from hrcreplay.records import RECORDED
from hrcreplay.reporting.figures import catalogue
from hrcreplay.reporting.figures.catalogue import FigureData
from hrcreplay.reporting.figures.prediction import skeleton_at, skeletons_at
from hrcreplay.reporting.metrics.people import add_people, most_tracked, named_volumes
from hrcreplay.reporting.metrics.series import MetricTable
from hrcreplay.reporting.page import report_page
from hrcreplay.reporting.page.replay_page import replay_data, snapshot, solids
from hrcreplay.reporting.replay_scene import SHOWN_POINTS
from hrcreplay.reporting.scene_mcap import write_scene
from hrcreplay.reporting.verdict import _held_each
from hrcreplay.store.run_folder import Run
from tests.reporting.moving import SECOND_M, moving_run, moving_scene, two_people
from tests.reporting.reading import read
from tests.reporting.synthetic import frame_of, metrics_of
from tests.reporting.test_scene_mcap import _topics

ONE, BOTH = moving_scene(moving_run(4.0)), moving_scene(two_people(moving_run(4.0)))
PARTS_SHOWN = len(ONE.body_parts)


def test_figures_draw_nobody_who_has_gone() -> None:
    first, second = two_people(moving_run(4.0)).states()
    t_ns = second["t_ns"].to_numpy()
    gone = second[t_ns <= t_ns[len(t_ns) // 2]]
    for at_ns, count in ((t_ns[len(t_ns) // 4], 2), (int(gone["t_ns"].iloc[-1]) + 150_000_000, 2), (t_ns[-1], 1)):
        shown = skeletons_at([first, gone], int(at_ns))
        assert len(shown) == count
        np.testing.assert_array_equal(shown[0], skeleton_at(first, int(at_ns))[0])
    assert skeletons_at([first, gone.iloc[:0]], int(t_ns[0]))[0].shape == (20, 3)


def test_the_second_person_is_shown_where_it_is() -> None:
    assert BOTH.people == ("1", "2")
    count = len(SHOWN_POINTS)
    np.testing.assert_array_equal(BOTH.points_m[:, :count], ONE.points_m)
    np.testing.assert_allclose(BOTH.points_m[:, count:], ONE.points_m + SECOND_M, atol=1e-12)
    np.testing.assert_array_equal(BOTH.body_m[:, :PARTS_SHOWN], ONE.body_m)
    np.testing.assert_allclose(BOTH.body_m[:, PARTS_SHOWN:], ONE.body_m + SECOND_M, atol=1e-12)
    assert BOTH.body_parts[PARTS_SHOWN:] == tuple(f"{part} of person 2" for part in PARTS[:PARTS_SHOWN])
    np.testing.assert_array_equal(BOTH.body_radius_m, np.tile(ONE.body_radius_m, 2))
    assert {name for name in BOTH.volumes.limbs if name.endswith("2")} == {
        f"{n} of person 2" for n in ONE.volumes.limbs
    }


def test_the_bones_of_each_person_join_its_own_points() -> None:
    first, second = np.split(BOTH.bones, 2)
    np.testing.assert_array_equal(first, ONE.bones)
    np.testing.assert_array_equal(second - first, len(SHOWN_POINTS))


def test_the_pages_header_names_the_parts_of_both() -> None:
    header = json.loads(replay_data(BOTH)[0])
    assert len(header["body"]["parts"]) == 2 * PARTS_SHOWN == len(header["body"]["radius_m"])
    assert "right lower arm of person 2" in header["body"]["parts"]
    assert len(header["bones"]) == len(BOTH.bones)
    assert header["entries"]["body"]["columns"] == 2 * json.loads(replay_data(ONE)[0])["entries"]["body"]["columns"]


def test_a_still_holds_the_bodies_of_both() -> None:
    row = 80
    assert len(solids(BOTH, row)) == len(solids(ONE, row)) + PARTS_SHOWN
    assert snapshot(BOTH, row).axes


def test_scene_mcap_has_an_entity_for_each(tmp_path: Path) -> None:
    write_scene(tmp_path / "scene.mcap", BOTH, None)
    found, row = _topics(tmp_path / "scene.mcap"), 80
    assert [one.id for one in found["/person/fused"][row][1].entities] == ["fused", "fused 2"]
    first, second = found["/person/recorded"][row][1].entities
    assert (first.id, second.id) == ("recorded", "recorded 2")
    for mine, theirs in zip(first.spheres, second.spheres, strict=True):
        at, other = (np.array([p.x, p.y, p.z]) for p in (mine.pose.position, theirs.pose.position))
        np.testing.assert_allclose(other - at, SECOND_M, atol=2e-3)
        assert mine.size.x == theirs.size.x


def test_scene_mcap_updates_who_has_gone_once(tmp_path: Path) -> None:
    points_m, body_m = BOTH.points_m.copy(), BOTH.body_m.copy()
    points_m[60:, len(SHOWN_POINTS) :], body_m[60:, PARTS_SHOWN:] = np.nan, np.nan
    write_scene(tmp_path / "scene.mcap", replace(BOTH, points_m=points_m, body_m=body_m), None)
    found = _topics(tmp_path / "scene.mcap")
    for topic, first in (("/person/fused", "fused"), ("/person/recorded", "recorded")):
        entities = [message.entities for _, message in found[topic]]
        assert len(entities) == len(BOTH.t_ns)
        assert {one.id for one in entities[59]} == {first, f"{first} 2"}
        (gone,) = (one for one in entities[60] if one.id == f"{first} 2")
        assert not gone.spheres
        assert not any(line.points for line in gone.lines)
        assert all([one.id for one in later] == [first] for later in entities[61:])


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, run = tmp_path_factory.mktemp("figures"), two_people(moving_run(4.0))
    metrics = metrics_of(run)
    for number in run.people:
        data = FigureData(run.of_person(number), metrics, near_m=0.5, stationary_m_per_s=0.001, everybody=run)
        kinds = catalogue.select_figures(data.run, metrics)
        catalogue.draw_all(data, folder, [kind for kind in kinds if number == 1 or kind.each], number)
    return folder


def test_figures_of_one_person_are_drawn_for_each_and_named(drawn: Path) -> None:
    run = two_people(moving_run(4.0))
    html = report_page.render(run.of_person(1), metrics_of(run), drawn, people=run.people)
    text = " ".join(read(html).text)
    assert {"joint_angles.svg", "joint_angles_person_2.svg"} <= {path.name for path in drawn.iterdir()}
    assert "Person 1. All joints of the human model" in text
    assert "Person 2. All joints of the human model" in text
    assert (drawn / "joint_angles.svg").read_bytes() != (drawn / "joint_angles_person_2.svg").read_bytes()
    alone = report_page.render(run.of_person(1), metrics_of(run), drawn)
    assert "Person 1." not in " ".join(read(alone).text)


def test_figures_of_the_volumes_hold_those_of_both(drawn: Path, tmp_path: Path) -> None:
    one = moving_run(4.0)
    kinds = catalogue.find("9")
    data = FigureData(one, metrics_of(one), near_m=0.5, stationary_m_per_s=0.001)
    catalogue.draw_all(data, tmp_path, kinds)
    assert (tmp_path / "fig09_volumes.svg").read_bytes() != (drawn / "fig09_volumes.svg").read_bytes()
    limbs = named_volumes(two_people(one).occupancy)
    assert limbs is not None
    assert "LRA of person 2" in set(limbs["limb"])
    assert named_volumes(one.occupancy) is one.occupancy


def visited(visitors: int) -> Run:
    """The run with visitors, one after the other, but the last two at the same time."""
    run = two_people(moving_run(4.0))
    assert run.state is not None
    assert run.body is not None
    tables = {}
    for name, table in (("state", frame_of(run.state)), ("body", frame_of(run.body))):
        at_s = (table["t_ns"] - table["t_ns"].iloc[0]) * 1e-9
        parts = [table[table["person"] == 1]]
        for k in range(visitors):
            from_s = 1.0 + 0.3 * min(k, visitors - 2)
            mine = (table["person"] == 2) & (at_s >= from_s) & (at_s < from_s + 0.04)
            parts.append(table[mine].assign(person=2 + k))
        tables[name] = pd.concat(parts).sort_values(["t_ns", "person"], kind="stable").reset_index(drop=True)
    return replace(run, state=tables["state"], body=tables["body"])


def test_many_visitors_are_drawn_in_turn() -> None:
    """Those of a long run would fill the memory; who is there at the same time is drawn apart."""
    scene, count = moving_scene(visited(9)), len(SHOWN_POINTS)
    assert scene.people == ("1", "2 or another", "10")
    np.testing.assert_array_equal(scene.points_m[:, :count], ONE.points_m)
    each = [np.isfinite(scene.points_m[:, k * count]).all(axis=1) for k in range(3)]
    there = np.isfinite(scene.points_m[:, count : 2 * count]).any(axis=(1, 2))
    begun = np.flatnonzero(np.diff(there.astype(int), prepend=0) == 1)
    assert len(begun) == 8
    np.testing.assert_allclose(scene.points_m[begun, count : 2 * count], BOTH.points_m[begun, count:], atol=1e-12)
    assert each[2].sum() > 0
    assert not (each[2] & ~each[1]).any()
    assert scene.body_parts[PARTS_SHOWN] == f"{PARTS[0]} of person 2 or another"
    assert "head of person 2 or another" in json.loads(replay_data(scene)[0])["body"]["parts"]
    apart = moving_scene(visited(7))
    assert apart.people == tuple("12345678")


def test_figures_of_one_person_are_those_of_who_was_there_longest() -> None:
    run = visited(9)
    assert run.state is not None
    longer = frame_of(run.state)
    longer["person"] = longer["person"].replace({4: 7})
    run = replace(run, state=longer)
    assert most_tracked(run, 2) == (1, 7)
    assert most_tracked(run, 20) == run.people


def test_each_person_is_held_by_the_volumes_of_the_chosen_method_also_beside_a_recorded_robot() -> None:
    """The recorded robot comes first in the list of methods, and used no volumes."""
    run = two_people(moving_run(4.0))
    parts = []
    for k, method in enumerate((RECORDED, "scaling", "qp")):
        left_m = [0.0, 0.0, 0.01, np.nan] if method == "qp" else [np.nan] * 4
        columns: dict[str, Any] = {"t_ns": np.arange(4), "method": method, "moving": [True, True, False, True]}
        for number in (1, 2):
            columns |= {
                f"person_{number}_m": np.array([0.3, -0.01, -0.5, 0.2]) * number + 0.001 * k,
                f"left_person_{number}_m": np.array(left_m) * (number - 1),
                f"left_full_person_{number}_m": left_m,
            }
        parts.append(pd.DataFrame(columns))
    table = MetricTable()
    add_people(table, replace(run, contact=pd.concat(parts, ignore_index=True), recorded=run.baselines["scaling"]))
    found = {name: metric["value"] for name, metric in table.sorted().items()}
    assert found["person_1_volumes_held_share"] == 1.0
    assert found["person_2_volumes_held_share"] == found["person_1_volumes_full_held_share"] == pytest.approx(2 / 3)
    assert found["person_2_volumes_checked_ticks"] == 3
    for prefix, more in ((RECORDED, 0.0), ("baseline_scaling", 0.001), ("plan", 0.002)):
        assert found[f"{prefix}_person_2_distance_min_moving_m"] == pytest.approx(-0.02 + more)
        assert found[f"{prefix}_person_1_touch_ticks"] == 1


def test_the_verdict_names_each_of_few_people_and_the_least_held_of_many() -> None:
    shares = {1: 0.99, 2: 0.9, 3: 0.6, 10: 0.95, 11: 0.6}
    metrics: dict[str, Any] = {f"person_{k}_volumes_held_share": {"value": share} for k, share in shares.items()}
    few = dict(sorted(metrics.items()))
    names = "person 1 at 99.0 %, person 2 at 90.0 %, person 3 at 60.0 %, person 10 at 95.0 %, person 11 at 60.0 %"
    assert _held_each(few) == f" Until their horizon they held {names} of the ticks checked of each."
    many = few | {f"person_{k}_volumes_held_share": {"value": 0.8} for k in range(20, 25)}
    assert _held_each(many) == (
        " Until their horizon they held person 1 at 99.0 % and the 9 others at 60.0 % (person 3) or more of the ticks "
        "checked of each."
    )
