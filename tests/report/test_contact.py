"""What metrics, page and terminal say of robot and recorded body, of contacts made up by hand."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from hrcreplay.report import verdict
from hrcreplay.report.story import lines
from hrcreplay.run.report import compute
from hrcreplay.store.run_folder import Run
from tests.report.synthetic import make_run
from tests.report.test_page import read, rendered


def contact_table(run: Run, method: str, touching: range, *, person: str = "truth") -> pd.DataFrame:
    """0.3 m away, but for some ticks in contact at a speed of its own each; the robot rests in the first 100 ticks."""
    assert run.motion is not None
    n = len(run.motion)
    tick = np.arange(n)
    touch = np.isin(tick, touching)
    return pd.DataFrame(
        {
            "t_ns": run.motion["t_ns"],
            "method": method,
            "person": person,
            "moving": tick >= 100,
            "distance_m": np.where(touch, -0.001 * (tick - touching.start), 0.3 + 1e-5 * tick),
            "limb": np.where(touch, "LRA", "THX"),
            "link": np.where(touch, "tool", "forearm"),
            "tcp_speed": 0.001 * tick,
            "contact_speed": 0.002 * tick,
            "outside_m": np.where(touch & (tick >= 100), np.where(tick % 3 == 0, -0.02, 0.01), np.nan),
            "left_m": np.where(tick % 10 == 0, np.where(tick == 500, 0.04, -0.05), np.nan),
            "left_limb": ["ULA" if k % 10 == 0 else None for k in tick],
        }
    )


@pytest.fixture(scope="module")
def run() -> Run:
    made = make_run()
    plan = {**made.meta["settings"]["plan"], "certify": True, "horizon": "adaptive"}
    meta = {**made.meta, "settings": {**made.meta["settings"], "plan": plan}}
    meta |= {"limits": {"prediction": {"name": "people"}}}
    assert made.motion is not None
    motion = made.motion.assign(certified=True, horizon_s=0.02, tau_s=0.012)
    blind = contact_table(made, "none", range(90, 150))
    blind["outside_m"] = np.nan
    contact = pd.concat([contact_table(made, "qp", range(0)), blind, contact_table(made, "scaling", range(95, 125))])
    baselines = {"none": made.motion, "scaling": made.baselines["scaling"]}
    return dataclasses.replace(made, meta=meta, motion=motion, baselines=baselines, contact=contact)


def metrics_of(run: Run) -> dict[str, dict[str, Any]]:
    return compute(run, near_m=0.5, stationary_m_per_s=0.001)


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
    text = " ".join(read(rendered(standing, tmp_path)).text)
    assert "at 5.0 % of the ticks a link was already where the person could reach" in text
    assert "standing: inside a volume" in text


def test_the_first_sentences_of_a_robot_that_touched_nobody(run: Run, tmp_path: Path) -> None:
    found = verdict.verdict(run, metrics_of(run))
    assert found is not None
    assert found.sentences[0] == (
        "With this controller, the moving robot would never have touched the person: it kept 30 cm away or more."
    )
    assert found.sentences[1].endswith("; without a controller the robot would have hit the person at up to 0.298 m/s.")
    pace = metrics_of(run)["plan_progress_share"]["value"]
    assert found.sentences[1].startswith(
        f"The task would have taken {1 / pace:.1f} times as long ({100 * pace:.0f} % of its pace);"
    )
    touched, cost = found.details
    assert touched == (
        "Had this controller been running, no moving part of the robot would have touched the person: the smallest "
        "distance was 0.301 m, between its forearm and the person's trunk, 1.0 s after the start; that link then moved "
        "at 0.200 m/s."
    )
    assert cost.endswith(
        "; without any controller the robot would have touched the person for 500 ms in all, at up to 0.298 m/s."
    )
    assert [row[0] for row in found.table.rows] == ["qp (this plan)", "scaling", "none (run blind)"]
    assert [row[1] for row in found.table.rows] == ["0 ticks", "25 ticks", "50 ticks"]
    assert found.table.rows[1][2:6] == ("0.248 m/s", "\u22120.029 m", "0.248 / 0.124 m/s", "\u22120.004 m")
    html = rendered(run, tmp_path)
    assert html.index(found.sentences[0]) < html.index(touched[:40])
    assert html.index(found.sentences[1]) < html.index(found.held) < html.index(touched[:40])
    assert html.index(touched[:40]) < html.index("Robot against the recorded person") < html.index("What would it have")
    assert "At every tick of this replay, and certified." in html


def test_contacts_while_the_robot_retreats_have_a_count_of_their_own(run: Run) -> None:
    assert run.contact is not None
    assert run.motion is not None
    contact = pd.concat([contact_table(run, "qp", range(95, 125)), run.contact[run.contact["method"] != "qp"]])
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
    assert "at 5 the robot was moving away, and the person came after it" in said.details[0]
    assert "at 3 of these ticks the person was where the prediction said, so the robot is at fault" in said.details[0]


def test_how_often_the_prediction_held_the_person_stands_beside_the_verdict(run: Run) -> None:
    assert run.contact is not None
    found = verdict.verdict(run, metrics_of(run))
    assert found is not None
    checked, out = int(run.contact["left_m"].notna().sum()), int((run.contact["left_m"] > 0.0).sum())
    assert 0 < out < checked
    share = 100.0 * (1.0 - out / checked)
    assert found.held == (
        f"The predicted volumes held the whole person until their horizon at {share:.1f} % of {checked} ticks that "
        "were checked."
    )
    kept = dataclasses.replace(run, contact=run.contact.assign(left_m=run.contact["left_m"].clip(upper=0.0)))
    always = verdict.verdict(kept, metrics_of(kept))
    assert always is not None
    assert f"at all {checked} ticks" in always.held
    unknown = dataclasses.replace(run, contact=run.contact.assign(left_m=np.nan))
    nothing = verdict.verdict(unknown, metrics_of(unknown))
    assert nothing is not None
    assert nothing.held == ""


def test_the_first_sentence_says_whose_fault_a_contact_is(run: Run) -> None:
    assert run.contact is not None
    contact = pd.concat([contact_table(run, "qp", range(95, 125)), run.contact[run.contact["method"] != "qp"]])
    touching = dataclasses.replace(run, contact=contact)
    found = verdict.verdict(touching, metrics_of(touching))
    assert found is not None
    assert found.sentences[0] == (
        "With this controller the moving robot would have touched the person: for 250 ms, at up to 0.248 m/s."
    )
    assert found.details[0] == (
        "Had this controller been running, the moving robot would have touched the person for 250 ms in all, at up to "
        "0.248 m/s; the deepest contact was of its tool and the person's right lower arm 1.2 s after the start; at 8 "
        "of these ticks the person was where the prediction said, so the robot is at fault; at 17 the person was not "
        "where the prediction said, so the prediction is at fault."
    )


def test_the_smoothed_person_has_no_legs(run: Run) -> None:
    assert run.contact is not None
    smoothed = dataclasses.replace(run, contact=run.contact.assign(person="smoothed"))
    found = verdict.verdict(smoothed, metrics_of(smoothed))
    assert found is not None
    assert "the fused one, smoothed" in found.table.note
    assert "of the legs nothing is known" in found.table.note


def test_a_limb_that_nobody_measured_is_said_before_all_else(run: Run) -> None:
    assert run.contact is not None
    metrics = metrics_of(dataclasses.replace(run, contact=run.contact.assign(person="smoothed")))
    metrics["limb_LRA_unmeasured_share"] = {"value": 1.0, "unit": "1", "meaning": "made up"}
    found = verdict.verdict(run, metrics)
    assert found is not None
    begin = "Had this controller been running, as far as the person was measured (never: right lower arm), no moving "
    assert found.details[0].startswith(begin)
    assert "as far as the cameras saw the person" in found.sentences[0]
    assert "never measured, so not known: the right lower arm" in found.table.note
    truth = verdict.verdict(run, metrics | {"contact_person": metrics_of(run)["contact_person"]})
    assert truth is not None
    assert "as far as" not in truth.sentences[0] + truth.details[0]


def test_a_person_who_is_not_known_is_not_said_to_be_safe(run: Run) -> None:
    assert run.contact is not None
    unknown = dataclasses.replace(run, contact=run.contact.assign(distance_m=np.nan, outside_m=np.nan, left_m=np.nan))
    metrics = metrics_of(unknown)
    assert metrics["plan_touch_moving_ticks"]["value"] is None
    found = verdict.verdict(unknown, metrics)
    assert found is not None
    assert found.sentences[0].startswith("Nobody can say whether the robot would have touched the person")
    assert "it is not known whether the robot would have touched the person" in found.details[0]


def test_the_terminal_says_it_too(run: Run) -> None:
    said = lines(run, metrics_of(run))[-1]
    assert said.startswith(
        "report: moving robot touched the recorded person (ground truth): qp never (nearest 0.301 m); scaling in 25 "
        "ticks, at up to 0.248 m/s; none in 50 ticks, at up to 0.298 m/s."
    )


def test_a_run_of_an_earlier_version_has_no_such_table(tmp_path: Path) -> None:
    run = make_run()
    assert metrics_of(run)["contact_person"]["value"] is None
    assert verdict.verdict(run, metrics_of(run)) is None
    assert "Robot against the recorded person" not in rendered(run, tmp_path)
