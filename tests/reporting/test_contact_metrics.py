"""What metrics, page and terminal say of robot and recorded body, of contacts made up by hand."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hrcreplay.human.model import PARTS
from hrcreplay.reporting import summary_text, verdict
from hrcreplay.reporting.metrics.contact import _names_at
from hrcreplay.reporting.summary_text import lines
from hrcreplay.store import stored_table
from hrcreplay.store.run_folder import Run
from hrcreplay.store.stored_table import StoredTable
from tests.facts import tells
from tests.reporting.reading import page_lines, rendered
from tests.reporting.synthetic import contact_run, contact_table, frame_of, make_run, metrics_of


@pytest.fixture(scope="module")
def run() -> Run:
    return contact_run()


def test_metrics_of_contacts(run: Run) -> None:
    found = {name: metric["value"] for name, metric in metrics_of(run).items()}
    assert found["contact_person"] == "ground truth"
    assert found["plan_touch_moving_ticks"] == found["plan_touch_rest_ticks"] == 0
    assert found["plan_body_distance_min_moving_m"] == pytest.approx(0.301)
    assert found["plan_body_distance_min_rest_m"] == pytest.approx(0.3)
    assert found["plan_body_distance_min_moving_contact_speed_m_per_s"] == pytest.approx(0.2)
    assert found["plan_body_distance_min_moving_tcp_speed_m_per_s"] == pytest.approx(0.1)
    assert (found["plan_body_distance_min_moving_link"], found["plan_body_distance_min_moving_limb"]) == (
        "forearm",
        "THX",
    )
    assert found["plan_touch_contact_speed_max_m_per_s"] is None
    assert found["baseline_scaling_touch_moving_ticks"] == 25
    assert found["baseline_scaling_touch_rest_ticks"] == 5
    assert found["baseline_scaling_touch_moving_s"] == pytest.approx(0.25)
    assert found["baseline_scaling_touch_contact_speed_max_m_per_s"] == pytest.approx(0.248)
    assert found["baseline_scaling_body_distance_min_moving_m"] == pytest.approx(-0.029)
    assert found["baseline_scaling_body_distance_min_moving_at_s"] == pytest.approx(1.24)
    assert found["baseline_scaling_touch_inside_ticks"] == sum(tick % 3 == 0 for tick in range(100, 125))
    assert found["baseline_scaling_touch_outside_ticks"] == sum(tick % 3 != 0 for tick in range(100, 125))
    assert found["baseline_scaling_touch_unpredicted_ticks"] == 0
    assert found["baseline_none_touch_inside_ticks"] is None
    assert found["baseline_none_touch_moving_ticks"] == 50
    assert found["volumes_left_ticks"] == 3  # of all methods here; a run has them of its own method only
    assert found["volumes_left_max_m"] == pytest.approx(0.04)


def test_full_stops_certificates_and_horizons(run: Run) -> None:
    assert run.motion is not None
    found = metrics_of(run)
    stops = (run.motion["status"] == "braking") & (run.motion["tcp_speed"] >= 0.001)
    assert found["plan_full_stop_share"]["value"] == pytest.approx(stops.mean())
    assert found["plan_uncertified_moving_ticks"]["value"] == 0
    assert found["plan_horizon_median_s"]["value"] == pytest.approx(0.02)
    assert found["baseline_scaling_horizon_median_s"]["value"] is None
    doubtful = run.motion.assign(certified=np.arange(len(run.motion)) != 400)
    assert metrics_of(dataclasses.replace(run, motion=doubtful))["plan_uncertified_moving_ticks"]["value"] == 1


def test_a_reason_to_stand_is_told(run: Run, tmp_path: Path) -> None:
    assert run.motion is not None
    held = np.arange(len(run.motion)) < 60
    motion = run.motion.assign(
        status=np.where(held, "limited", "tracking"), reason=np.where(held, "inside a volume", "")
    )
    standing = dataclasses.replace(run, motion=motion)
    assert metrics_of(standing)["plan_standing_share_inside_a_volume"]["value"] == pytest.approx(0.05)
    safe, _ = summary_text.answers(standing, metrics_of(standing))
    assert tells(safe.words.splitlines(), "5.0 %", "link")
    lines = page_lines(rendered(standing, tmp_path))
    assert tells(lines, "standing", "inside a volume", "5.00 %")


def test_the_first_sentences_of_a_robot_that_touched_nobody(run: Run, tmp_path: Path) -> None:
    found = verdict.verdict(run, metrics_of(run))
    assert found is not None
    assert tells(found.sentences[0], "not", "any tick", "ground truth", "30 cm")
    assert "never" not in found.sentences[0]
    assert tells(found.sentences[1], "person", "50 ticks", "0.298 m/s")
    pace = metrics_of(run)["plan_progress_share"]["value"]
    assert tells(found.sentences[1], f"{1 / pace:.1f} times", f"{100 * pace:.0f} %")
    touched, cost = found.details
    assert tells(touched, "0.301 m", "forearm", "trunk", "1.0 s", "0.200 m/s")
    assert tells(cost, "50 ticks", "500 ms", "0.298 m/s")
    assert [row[0] for row in found.table.rows] == ["qp (this plan)", "scaling", "none (run blind)"]
    assert [row[1] for row in found.table.rows] == ["0 ticks", "25 ticks", "50 ticks"]
    assert found.table.rows[1][2:6] == ("0.248 m/s", "\u22120.029 m", "0.248 / 0.124 m/s", "\u22120.004 m")
    html = rendered(run, tmp_path)
    assert html.index(found.sentences[0]) < html.index(touched[-40:])
    assert html.index(found.sentences[1]) < html.index(found.held) < html.index(touched[-40:])
    answer = summary_text.answers(run, metrics_of(run))[0]
    assert html.index(found.table.title) < html.index(touched[-40:])  # the table stands before the folded details
    assert html.index(found.table.title) < html.index(summary_text.COST)
    assert html.index(answer.short) > html.index(summary_text.SAFE)
    assert tells(answer.short, "Certified", "every")


def test_contacts_while_the_robot_retreats_have_a_count_of_their_own(run: Run) -> None:
    assert run.contact is not None
    assert run.motion is not None
    contact = pd.concat(
        [contact_table(run, "qp", range(95, 125)), frame_of(run.contact[run.contact["method"] != "qp"])]
    )
    tick = np.arange(len(run.motion))
    status = np.where((tick >= 100) & (tick < 110), "retreating", np.where(tick < 114, "braking", "tracking"))
    touching = dataclasses.replace(run, contact=contact, motion=run.motion.assign(status=status))
    found = metrics_of(touching)
    inside = np.arange(102, 125, 3)  # of those while moving
    expected = int(((inside > 100) & (inside <= 114)).sum())  # what was decided at 113 moves it at 114
    assert found["plan_touch_retreating_ticks"]["value"] == expected == 5
    assert found["plan_touch_inside_ticks"]["value"] == len(inside) - expected
    assert found["plan_touch_moving_ticks"]["value"] == 25
    said = verdict.verdict(touching, found)
    assert said is not None
    assert re.search(r"\b5 [^,;.]*moving away", said.details[0])
    assert re.search(r"\b3 [^;.]*robot is at fault", said.details[0])


def test_how_often_the_prediction_held_the_person_stands_beside_the_verdict(run: Run) -> None:
    assert run.contact is not None
    found = verdict.verdict(run, metrics_of(run))
    assert found is not None
    checked, out = int(run.contact["left_m"].notna().sum()), int((run.contact["left_m"] > 0.0).sum())
    assert 0 < out < checked
    share = round(100.0 * (1.0 - out / checked), 1)
    assert tells(found.held, f"{share:.1f} %", f"{checked} checked")
    full = int(run.contact["left_full_m"].notna().sum())
    assert tells(found.held, f"{full} checked")
    kept = dataclasses.replace(run, contact=run.contact.assign(left_m=run.contact["left_m"].clip(upper=0.0)))
    always = verdict.verdict(kept, metrics_of(kept))
    assert always is not None
    assert tells(always.held, f"all {checked} checked")
    unknown = dataclasses.replace(run, contact=run.contact.assign(left_m=np.nan, left_full_m=np.nan))
    nothing = verdict.verdict(unknown, metrics_of(unknown))
    assert nothing is not None
    assert nothing.held == ""


def test_the_first_sentence_says_whose_fault_a_contact_is(run: Run) -> None:
    assert run.contact is not None
    contact = pd.concat(
        [contact_table(run, "qp", range(95, 125)), frame_of(run.contact[run.contact["method"] != "qp"])]
    )
    touching = dataclasses.replace(run, contact=contact)
    found = verdict.verdict(touching, metrics_of(touching))
    assert found is not None
    assert tells(found.sentences[0], "touched", "person", "25 ticks", "250 ms", "0.248 m/s", "at rest", "5 ticks")
    assert tells(found.details[0], "tool", "right lower arm", "1.2 s")
    assert re.search(r"\b8 [^;.]*robot is at fault", found.details[0])
    assert re.search(r"\b17 [^;.]*prediction is at fault", found.details[0])


def test_another_body_counts_and_is_told_apart_from_the_person(run: Run) -> None:
    """The moving robot touches the person at 10 ticks, another body at 25, both at five of them."""
    assert run.contact is not None
    own = contact_table(run, "qp", range(100, 110))
    other = np.isin(np.arange(len(own)), range(105, 130))
    own["other_m"] = np.where(other, -0.02, 1.0)
    own["distance_m"] = np.minimum(own["person_m"], own["other_m"])
    own["source"] = np.where(own["other_m"] < own["person_m"], "xtion, body 7", "ground truth")
    touching = dataclasses.replace(run, contact=pd.concat([own, frame_of(run.contact[run.contact["method"] != "qp"])]))
    touching = dataclasses.replace(touching, counts={"person_frames_beside_others": 902})
    found = metrics_of(touching)
    values = {name: found[name]["value"] for name in found}
    assert values["plan_touch_person_ticks"] == 10
    assert values["plan_touch_other_ticks"] == 25
    assert values["plan_touch_moving_ticks"] == 30
    assert values["plan_other_distance_min_moving_m"] == -0.02
    assert values["plan_touch_inside_ticks"] + values["plan_touch_outside_ticks"] == 10  # the other was not predicted
    assert values["others_frames"] == 902
    said = verdict.verdict(touching, found)
    assert said is not None
    assert tells(said.sentences[0], "person (10 ticks)", "another body (25 ticks)")
    assert tells(said.scope[0], "902 frames")
    assert tells(said.details[0], "xtion, body 7")
    assert tells(lines(touching, found)[-1], "another body (25 ticks)")


def test_what_was_not_recorded_of_a_recorded_programme_is_told(run: Run) -> None:
    whole, gaps = (dataclasses.replace(run, counts={"joint_gaps_ms": ms}) for ms in (0, 2004))
    for lost, one in ((False, whole), (True, gaps)):
        found = metrics_of(one)
        said = verdict.verdict(one, found)
        assert said is not None
        assert tells(said.scope, "2.00 s", "not recorded") == lost
        assert tells(lines(one, found)[-1], "2.00 s", "not recorded") == lost


@pytest.mark.parametrize("shown", [0.0, 0.4, 1.0])
def test_legs_that_were_not_seen_are_told(run: Run, shown: float) -> None:
    ticks = np.arange(100)
    names = [f"{part}_{end}_{axis}" for part in PARTS for end in (0, 1) for axis in "xyz"]
    body = pd.DataFrame({name: np.full(100, float(name.split("_")[-2])) for name in names}).assign(t_ns=ticks)
    hidden = [name for name in names if name.split("_")[0] in ("THIGH", "SHANK", "FOOT")]
    body.loc[ticks >= 100 * shown, hidden] = np.nan
    seen = dataclasses.replace(run, body=body)
    found = metrics_of(seen)
    assert found["contact_legs_known_share"]["value"] == pytest.approx(shown)
    assert found["contact_arms_known_share"]["value"] == 1.0
    said = verdict.verdict(seen, found)
    assert said is not None
    unseen = {0.0: r"legs \(never", 0.4: r"legs \([^)]*60 %", 1.0: "^((?!legs).)*$"}[shown]
    assert re.search(unseen, said.scope[1])
    assert tells(said.sentences[0], "as far as") == (shown < 1.0)


def test_what_is_never_considered_is_always_said(run: Run) -> None:
    found = verdict.verdict(run, metrics_of(run))
    assert found is not None
    for what in ("objects", "table", "fixtures", "robot's own links", "no camera tracked"):
        assert what in found.scope[1]
        assert what in lines(run, metrics_of(run))[-1]


def test_what_is_considered_beside_objects_is_said(run: Run) -> None:
    assert run.motion is not None
    near = frame_of(run.motion).assign(object_distance_m=0.25, self_distance_m=np.nan)
    near.loc[near.index[3], "object_distance_m"] = 0.0314
    found = verdict.verdict(dataclasses.replace(run, motion=near), metrics_of(run))
    assert found is not None
    assert tells(found.scope, "31 mm", "object")
    assert not tells(found.scope, "each other")
    assert "table and fixtures" not in found.scope[-1]
    assert tells(found.scope[-1], "cell file", "no camera tracked")


def test_a_limb_that_nobody_measured_is_said_before_all_else(run: Run) -> None:
    assert run.contact is not None
    shown = dataclasses.replace(run, contact=run.contact.assign(person="camera points"))
    metrics = metrics_of(shown)
    metrics["limb_LRA_unmeasured_share"] = {"value": 1.0, "unit": "1", "meaning": "made up"}
    found = verdict.verdict(run, metrics)
    assert found is not None
    for part in (found.details[0], found.sentences[0]):
        assert "as far as" in part
    for part in (found.table.note, found.scope[1]):
        assert tells(part, "right lower arm (never")
    truth = verdict.verdict(run, metrics | {"contact_person": metrics_of(run)["contact_person"]})
    assert truth is not None
    assert "as far as" not in truth.sentences[0] + truth.details[0]


def test_a_person_who_is_not_known_is_not_said_to_be_safe(run: Run) -> None:
    assert run.contact is not None
    nowhere = dict.fromkeys(("distance_m", "person_m", "outside_m", "left_m", "left_full_m"), np.nan)
    unknown = dataclasses.replace(run, contact=run.contact.assign(**nowhere))
    metrics = metrics_of(unknown)
    assert metrics["plan_touch_moving_ticks"]["value"] is None
    found = verdict.verdict(unknown, metrics)
    assert found is not None
    assert "is not known" in found.sentences[0]
    assert tells(found.details[0], "not known")
    assert "not have touched" not in found.sentences[1]  # nor without a controller


def test_ticks_at_which_nobody_is_known_limit_the_sentence(run: Run) -> None:
    assert run.contact is not None
    hidden = frame_of(run.contact).copy()
    hidden.loc[hidden["t_ns"] >= hidden["t_ns"].iloc[600], ["distance_m", "person_m"]] = np.nan
    found = verdict.verdict(run, metrics_of(dataclasses.replace(run, contact=hidden)))
    assert found is not None
    assert "at any tick" not in found.sentences[0]
    assert tells(found.sentences[0], "600")


def test_the_terminal_says_it_too(run: Run) -> None:
    said = lines(run, metrics_of(run))[-1]
    assert tells(said, "ground truth")
    methods = said.split("; ")
    assert tells(methods, "qp", "nobody", "0.301 m")
    assert tells(methods, "scaling", "person", "25 ticks", "0.248 m/s")
    assert tells(methods, "none", "person", "50 ticks", "0.298 m/s")


def test_a_run_of_an_earlier_version_has_no_such_table(run: Run, tmp_path: Path) -> None:
    with_contact = verdict.verdict(run, metrics_of(run))
    assert with_contact is not None
    earlier = make_run()
    assert metrics_of(earlier)["contact_person"]["value"] is None
    assert verdict.verdict(earlier, metrics_of(earlier)) is None
    assert with_contact.table.title not in rendered(earlier, tmp_path)


def test_names_in_some_rows_are_those_of_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Read in parts; rows in any order and twice; no name, and no such column."""
    monkeypatch.setattr(stored_table, "_GROUPS", 2)
    table = pd.DataFrame({"link": [f"link {k}" for k in range(90)], "limb": ["HD", None, ""] * 30})
    pq.write_table(pa.Table.from_pandas(table, preserve_index=False), tmp_path / "table.parquet", row_group_size=10)
    rows = [89, 0, 20, 19, 20, 40]
    right = [(f"link {k}", "HD" if k % 3 == 0 else "", "") for k in rows]
    for asked in (table, StoredTable(tmp_path / "table.parquet")):
        assert _names_at(asked, rows) == right
        assert _names_at(asked, []) == []
