from __future__ import annotations

import dataclasses
import json
import math
from typing import Any

import numpy as np
import pandas as pd
import pytest

from hrcreplay.records import JOINTS, Floats
from hrcreplay.reporting.metrics import series
from hrcreplay.reporting.metrics.fusion import frames_of
from hrcreplay.reporting.metrics.planning import add_plan, cycles, tracking_error_m, waited_s
from hrcreplay.reporting.metrics.series import MetricTable, feet_in_turn
from hrcreplay.store.run_folder import Run
from tests.reporting.synthetic import T0_NS, frame_of, make_run, metrics_of

ANGLES = JOINTS[2:12]


@pytest.fixture(scope="module")
def run() -> Run:
    return make_run()


@pytest.fixture(scope="module")
def found(run: Run) -> dict[str, dict[str, Any]]:
    return metrics_of(run)


def truth_at(run: Run, t_ns: int, joint: str) -> float:
    """By a loop over the samples, without the report's interpolation."""
    assert run.truth is not None
    t, values = run.truth["t_ns"].tolist(), run.truth[joint].tolist()
    for k in range(len(t) - 1):
        if t[k] <= t_ns <= t[k + 1]:
            share = (t_ns - t[k]) / (t[k + 1] - t[k])
            return float(values[k] + share * (values[k + 1] - values[k])) if 0 < share < 1 else values[k + round(share)]
    return math.nan


def test_every_metric_has_value_unit_and_meaning_and_json_takes_it(found: dict[str, dict[str, Any]]) -> None:
    text = json.dumps(found, allow_nan=False)
    assert list(found) == sorted(found)
    for name, metric in found.items():
        assert metric["unit"], name
        assert metric["meaning"], name
        assert (metric["value"] is None) == ("reason" in metric), name
        assert type(metric["value"]) in (int, float, str, type(None)), name
    assert json.loads(text) == found


def test_two_computations_agree(run: Run, found: dict[str, dict[str, Any]]) -> None:
    assert metrics_of(run) == found


def test_fused_rmse(run: Run, found: dict[str, dict[str, Any]]) -> None:
    assert run.state is not None
    squares: list[float] = []
    for joint in ANGLES:
        errors = [
            value - truth_at(run, int(t), joint) for t, value in zip(run.state["t_ns"], run.state[joint], strict=True)
        ]  # none is near half a turn
        kept = [e * e for e in errors if math.isfinite(e)]
        assert found[f"fusion_rmse_{joint}"]["value"] == pytest.approx(math.sqrt(sum(kept) / len(kept)), rel=1e-9)
        squares += kept
    assert found["fusion_angle_rmse"]["value"] == pytest.approx(math.sqrt(sum(squares) / len(squares)), rel=1e-9)
    assert found["fusion_angle_median"]["value"] == pytest.approx(math.sqrt(np.median(squares)), rel=1e-9)


def test_fused_rmse_while_the_person_is_seen(run: Run) -> None:
    """An error that grows only after the cameras are gone for longer than 0.2 s does not count."""
    assert run.state is not None
    state = frame_of(run.state).copy()
    t_s = (state["t_ns"].to_numpy() - T0_NS) * 1e-9
    gone = (t_s > 0.6 * 12 + 0.25) & (t_s < 0.65 * 12)
    state.loc[gone, list(ANGLES)] += 1.0
    spoilt = metrics_of(dataclasses.replace(run, state=state))
    whole = metrics_of(run)
    assert spoilt["fusion_angle_rmse"]["value"] > 5 * whole["fusion_angle_rmse"]["value"]
    assert spoilt["fusion_seen_angle_rmse"]["value"] == whole["fusion_seen_angle_rmse"]["value"]


def test_camera_rmse_and_ratio(run: Run, found: dict[str, dict[str, Any]]) -> None:
    assert run.measurements is not None
    pooled = {}
    for camera, rows in frame_of(run.measurements).groupby("camera"):
        squares = []
        for joint in ANGLES:
            for t, value in zip(rows["capture_ns"], rows[joint], strict=True):
                error = value - truth_at(run, int(t), joint)
                if math.isfinite(error):
                    squares.append(error * error)
        pooled[str(camera)] = math.sqrt(sum(squares) / len(squares))
        assert found[f"camera_{camera}_angle_rmse"]["value"] == pytest.approx(pooled[str(camera)], rel=1e-9)
    better = min(pooled, key=lambda name: pooled[name])
    assert found["fusion_angle_better_camera"]["value"] == better == "kinect"
    ratio = found["fusion_angle_rmse"]["value"] / pooled[better]
    assert found["fusion_angle_rmse_ratio"]["value"] == pytest.approx(ratio, rel=1e-9)


def test_differenced_velocity_of_a_camera() -> None:
    """A camera with a constant angular rate that is off by 0.25 rad/s, and one pair across a gap."""
    t_s = np.array([0.0, 0.1, 0.2, 0.3, 2.0, 2.1])
    truth_s = np.arange(0, 3, 0.01)
    columns = {"t_ns": T0_NS + np.round(truth_s * 1e9).astype(np.int64)}
    truth = pd.DataFrame(columns | dict.fromkeys(JOINTS, 1.0 * truth_s))
    capture = T0_NS + np.round(t_s * 1e9).astype(np.int64)
    raw = pd.DataFrame({"capture_ns": capture, "camera": "one"} | dict.fromkeys(JOINTS, 1.25 * t_s))
    raw.loc[4, "ar1"] = np.nan
    run = dataclasses.replace(make_run(2.0), measurements=raw, truth=truth, state=None, motion=None, baselines={})
    found = metrics_of(run)
    assert found["camera_one_velocity_rmse"]["value"] == pytest.approx(0.25, abs=1e-6)
    assert found["camera_one_rmse_x"]["value"] == pytest.approx(0.25 * math.sqrt(np.mean(t_s**2)), rel=1e-6)
    assert found["fusion_angle_rmse"]["value"] is None
    assert found["fusion_angle_rmse_ratio"]["value"] is None
    assert found["camera_one_gaps"]["value"] == 1
    assert found["camera_one_gap_max_s"]["value"] == pytest.approx(1.7)
    assert found["camera_one_rate_hz"]["value"] == pytest.approx(10.0)


def test_headings_on_either_side_of_half_a_turn_are_near() -> None:
    run = make_run(4.0)
    assert run.truth is not None
    assert run.state is not None
    truth, state = run.truth.copy(), frame_of(run.state).copy()
    truth["theta"], state["theta"] = np.pi - 0.01, -np.pi + 0.01
    found = metrics_of(dataclasses.replace(run, truth=truth, state=state))
    assert found["fusion_rmse_theta"]["value"] == pytest.approx(0.02)


def test_stationary_share(run: Run, found: dict[str, dict[str, Any]]) -> None:
    for prefix, motion in (("plan", run.motion), ("baseline_scaling", run.baselines["scaling"])):
        assert motion is not None
        near = [row for row in frame_of(motion).to_dict("records") if row["distance_m"] <= 0.5]
        programme_s = dict(zip(motion["t_ns"], motion["programme_s"].diff().shift(-1), strict=True))
        stands = [
            row
            for row in near
            if row["tcp_speed"] < 0.001 and (row["ref_speed"] >= 0.001 or programme_s[row["t_ns"]] < 0.005)
        ]
        assert found[f"{prefix}_near_ticks"]["value"] == len(near)
        assert found[f"{prefix}_stationary_ticks"]["value"] == len(stands)
        assert found[f"{prefix}_stationary_share"]["value"] == pytest.approx(len(stands) / len(near))
    assert found["baseline_scaling_stationary_share"]["value"] > found["plan_stationary_share"]["value"]


def test_the_lower_body_has_its_own_volume_and_no_part_in_the_six(run: Run, found: dict[str, dict[str, Any]]) -> None:
    occupancy = run.occupancy
    assert occupancy is not None
    legs = occupancy[occupancy["limb"] == "HD"].assign(limb="LEGS", volume_m3=0.7)
    sound = metrics_of(
        dataclasses.replace(run, occupancy=pd.concat([frame_of(occupancy), frame_of(legs)]).assign(method="sound"))
    )
    assert sound["occupancy_sound_LEGS_m3"]["value"] == pytest.approx(0.7)
    assert sound["occupancy_sound_sum_m3"]["value"] == pytest.approx(found["occupancy_paper_sum_m3"]["value"])
    assert "occupancy_paper_LEGS_m3" not in found


def test_a_robot_that_dwells_as_programmed_is_not_stationary(run: Run) -> None:
    assert run.motion is not None
    n = len(run.motion)
    motion = run.motion.assign(tcp_speed=0.0, ref_speed=0.0, distance_m=0.5, programme_s=0.01 * np.arange(n))
    found = metrics_of(dataclasses.replace(run, motion=motion))
    assert found["plan_near_ticks"]["value"] == n
    assert found["plan_stationary_share"]["value"] == 0.0


def test_both_standing_shares_are_told_and_dwells_count_in_one(run: Run) -> None:
    """A robot that dwells for the first 60 ticks, and stands for 40 more while its programme would go on."""
    assert run.motion is not None
    n, tick = len(run.motion), np.arange(len(run.motion))
    ref_speed, tcp_speed = np.where(tick < 60, 0.0, 0.3), np.where(tick < 100, 0.0, 0.3)
    motion = run.motion.assign(
        tcp_speed=tcp_speed, ref_speed=ref_speed, distance_m=0.4, programme_s=1e-9 * (run.motion["t_ns"] - T0_NS)
    )
    found = metrics_of(dataclasses.replace(run, motion=motion))
    assert found["plan_stationary_share"]["value"] == pytest.approx(40 / n)
    assert found["plan_null_speed_ticks"]["value"] == 100
    assert found["plan_null_speed_share"]["value"] == pytest.approx(100 / n)
    assert "dwell" in found["plan_stationary_share"]["meaning"]


def test_the_greatest_speeds_at_all_and_near_the_body(run: Run) -> None:
    """The TCP is fastest away from the body; a tick without a known body is near nothing."""
    assert run.motion is not None
    n = len(run.motion)
    speed = 0.2 + 0.001 * (np.arange(n) % 100)
    speed[[5, 6, 7]] = 1.4, 0.9, 1.2
    apart = np.full(n, 0.8)
    apart[10:60], apart[6], apart[7] = 0.3, -0.01, np.nan
    motion = run.motion.assign(tcp_speed=speed, ref_speed=np.where(np.arange(n) == 3, 0.7, 0.1))
    rows = pd.DataFrame(
        {"t_ns": motion["t_ns"], "method": "qp", "tcp_speed": speed, "distance_m": apart, "moving": True}
    )
    metrics = MetricTable()
    bounds = {"near_m": 0.5, "stationary_m_per_s": 0.001, "max_reference_lead_m": 0.4}
    add_plan(metrics, motion, {"scaling": motion}, method="qp", contact=rows, recorded=None, **bounds)
    found = metrics.sorted()
    assert found["plan_tcp_speed_max_m_per_s"]["value"] == 1.4
    assert found["plan_ref_speed_max_m_per_s"]["value"] == 0.7
    assert found["plan_tcp_speed_near_body_max_m_per_s"]["value"] == 0.9
    assert found["baseline_scaling_tcp_speed_max_m_per_s"]["value"] == 1.4
    assert found["baseline_scaling_tcp_speed_near_body_max_m_per_s"]["value"] is None  # it has no row of contact


def test_a_retreat_begins_inside_a_volume(run: Run) -> None:
    assert run.motion is not None
    assert metrics_of(run)["plan_retreating_overlap_max_m"]["value"] is None
    status = run.motion["status"].astype(str).to_numpy()
    status[[100, 101, 102]] = "retreating"
    overlap = np.zeros(len(status))
    overlap[[99, 100, 101, 102]] = 0.05, 0.01, 0.02, np.nan  # at the first one it still stood
    found = metrics_of(dataclasses.replace(run, motion=run.motion.assign(status=status, overlap_m=overlap)))
    assert found["plan_retreating_overlap_max_m"]["value"] == 0.02
    assert found["plan_retreating_share"]["value"] == pytest.approx(3 / len(status))
    without = metrics_of(dataclasses.replace(run, motion=run.motion.assign(status=status)))
    assert "does not contain it" in without["plan_retreating_overlap_max_m"]["reason"]


def test_a_robot_whose_programme_waits_for_it_at_a_waypoint_is_stationary(run: Run) -> None:
    assert run.motion is not None
    n = len(run.motion)
    programme_s = 0.01 * np.minimum(np.arange(n), 100)  # held from the second on
    motion = run.motion.assign(tcp_speed=0.0, ref_speed=0.0, distance_m=0.5, programme_s=programme_s)
    found = metrics_of(dataclasses.replace(run, motion=motion))
    assert found["plan_stationary_ticks"]["value"] == n - 101  # of the last tick nobody knows


def test_never_near_is_null_and_not_zero(run: Run) -> None:
    assert run.motion is not None
    found = metrics_of(dataclasses.replace(run, motion=run.motion.assign(distance_m=0.51)))
    assert found["plan_near_ticks"]["value"] == 0
    assert found["plan_stationary_share"]["value"] is None
    assert "0.5 m" in found["plan_stationary_share"]["reason"]


def test_status_and_separation(run: Run, found: dict[str, dict[str, Any]]) -> None:
    motion = run.motion
    assert motion is not None
    counts = motion["status"].value_counts()
    assert found["plan_braking_share"]["value"] == pytest.approx(counts["braking"] / len(motion))
    assert sum(found[f"plan_{s}_share"]["value"] for s in ("tracking", "limited", "braking")) == pytest.approx(1.0)
    reasons = [found[n]["value"] for n in found if n.startswith("plan_braking_share_")]
    assert sum(reasons) == pytest.approx(found["plan_braking_share"]["value"])
    assert found["plan_braking_share_no_person_yet"]["value"] == pytest.approx(50 / len(motion))
    nearest = frame_of(motion).sort_values("distance_m").iloc[0]
    assert found["plan_separation_min_m"]["value"] == nearest["distance_m"]
    assert found["plan_separation_min_at_s"]["value"] == pytest.approx((nearest["t_ns"] - T0_NS) * 1e-9)
    assert found["plan_separation_min_limb"]["value"] == "LRA"
    assert found["plan_separation_unknown_ticks"]["value"] == 50
    moving = motion[motion["tcp_speed"] >= 0.001]
    assert found["plan_separation_min_moving_m"]["value"] == moving["distance_m"].min()
    late = motion[(motion["status"] == "braking") & (motion["tcp_speed"] >= 0.001)]
    assert found["plan_braking_moving_ticks"]["value"] == len(late) > 0
    assert found["plan_braking_moving_separation_min_m"]["value"] == late["distance_m"].min()


def test_a_joint_that_turns_about_a_still_tcp_is_a_moving_robot(run: Run) -> None:
    assert run.motion is not None
    still = run.motion.assign(tcp_speed=0.0, dq1=0.0, dq2=np.where(np.arange(len(run.motion)) < 7, -0.01, 0.0))
    found = metrics_of(dataclasses.replace(run, motion=still))
    assert found["plan_moving_ticks"]["value"] == 7
    assert found["plan_braking_moving_ticks"]["value"] == 7  # the first half second brakes


def test_no_separation_at_all_is_null(run: Run) -> None:
    assert run.motion is not None
    found = metrics_of(dataclasses.replace(run, motion=run.motion.assign(distance_m=np.nan, limb=None)))
    for name in ("plan_separation_min_m", "plan_separation_min_limb", "plan_stationary_share"):
        assert found[name]["value"] is None
    assert found["plan_separation_unknown_ticks"]["value"] == found["plan_ticks"]["value"]


def path_feet(points: Floats, path: Floats) -> Floats:
    """(n, 3) the feet of all points; NaN for an unknown one."""
    feet = np.full(points.shape, np.nan)
    for rows, found in feet_in_turn(points, path):
        assert np.isnan(feet[rows]).all()
        feet[rows] = found
    return feet


def test_distance_from_a_path_is_to_its_segments() -> None:
    path = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    points = np.array([[0.3, 0.2, 0.0], [1.5, 0.6, 0.0], [2.0, 0.0, 0.0], [np.nan, 0, 0]])
    feet = path_feet(points, path)
    assert feet[:3] == pytest.approx(np.array([[0.3, 0, 0], [1, 0.6, 0], [1, 0, 0]]))
    assert np.isnan(feet[3]).all()


def test_distance_from_a_path_that_was_driven_many_times() -> None:
    """Cycles in other phases of one curve, with standing: as near as to all of its segments, one by one.

    The chords of another cycle are off by as much as a chord of 6 mm is off its arc.
    """
    rng = np.random.default_rng(5)
    turn = np.sort(np.concatenate([2 * np.pi * np.arange(900) / 300.7, np.full(50, 2.0)]))
    path = np.column_stack([np.cos(turn), np.sin(turn), 0.2 * np.sin(2 * turn)]) * 0.3
    points = rng.normal(scale=0.3, size=(200, 3))
    start, along = path[:-1], np.diff(path, axis=0)
    length2 = np.maximum((along**2).sum(axis=1), 1e-300)
    share = np.clip(((points[:, None] - start) * along).sum(axis=2) / length2, 0.0, 1.0)
    want = np.linalg.norm(start + share[..., None] * along - points[:, None], axis=2).min(axis=1)
    np.testing.assert_allclose(np.linalg.norm(path_feet(points, path) - points, axis=1), want, atol=2e-5)
    np.testing.assert_allclose(path_feet(path, path), path, atol=2e-5)
    points[::7] = np.nan
    together = path_feet(points, path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(series, "_TOGETHER", 11)
        np.testing.assert_array_equal(path_feet(points, path), together)


def test_the_tracking_error_is_the_distance_from_the_reference() -> None:
    rng = np.random.default_rng(8)
    tcp, ref = rng.normal(size=(2, 50, 3))
    motion = pd.DataFrame(
        {f"{what}_{axis}": at[:, k] for what, at in (("tcp", tcp), ("ref", ref)) for k, axis in enumerate("xyz")}
    )
    np.testing.assert_allclose(tracking_error_m(motion), [math.dist(a, b) for a, b in zip(tcp, ref, strict=True)])


def test_a_reference_waits_where_its_time_stands() -> None:
    """10 s, of which the reference waits in the seconds 2 to 7."""
    t_s = np.arange(0, 10, 0.01)
    goes_on = (t_s < 2) | (t_s >= 7)
    programme_s = np.concatenate([[0.0], np.cumsum(np.where(goes_on, 0.01, 0.0))[:-1]])
    motion = pd.DataFrame({"t_ns": (t_s * 1e9).round().astype(np.int64), "programme_s": programme_s})
    waited = waited_s(motion)
    assert waited.sum() == pytest.approx(5.0, abs=1e-9)
    assert waited[~goes_on] == pytest.approx(0.01)
    assert waited[goes_on] == pytest.approx(0.0)


def test_pace_is_that_of_the_robot_whatever_the_reference_does(run: Run, found: dict[str, dict[str, Any]]) -> None:
    for prefix in ("plan", "baseline_scaling"):
        lost, pace = found[f"{prefix}_time_lost_s"]["value"], found[f"{prefix}_progress_share"]["value"]
        assert lost == pytest.approx((1 - pace) * found["span_s"]["value"])
        assert "own progress" in found[f"{prefix}_progress_share"]["meaning"]
    settings = {**run.meta["settings"], "plan": {"method": "qp", "reference": "time"}}
    other = metrics_of(dataclasses.replace(run, meta={**run.meta, "settings": settings}))
    assert other["plan_progress_share"] == found["plan_progress_share"]


def test_cycles_count_returns() -> None:
    angle = np.linspace(0, 2 * np.pi * 3.2, 3000)
    motion = pd.DataFrame({"ref_x": 0.3 * np.cos(angle), "ref_y": 0.3 * np.sin(angle), "ref_z": 0.0})
    assert cycles(motion) == 3


def test_validity_of_cameras(run: Run, found: dict[str, dict[str, Any]]) -> None:
    assert run.state is not None
    valid = run.state[["valid_kinect", "valid_xtion"]].to_numpy()
    assert found["camera_kinect_valid_share"]["value"] == pytest.approx(valid[:, 0].mean())
    assert found["ticks_without_camera"]["value"] == int((~valid.any(axis=1)).sum())
    longest = current = 0
    for row in valid:
        current = 0 if row.any() else current + 1
        longest = max(longest, current)
    assert found["longest_without_camera_s"]["value"] == pytest.approx(longest / 100.0)
    recent = 0
    last = -10_000
    for k, row in enumerate(valid):
        last = k if row[1] else last
        recent += k - last <= 20
    assert found["camera_xtion_available_share"]["value"] == pytest.approx(recent / len(valid))
    assert found["ticks_before_first_state"]["value"] == 50
    assert found["ticks_state_lost"]["value"] == 0
    assert found["count_points_not_finite"]["value"] == 17


def test_volumes(found: dict[str, dict[str, Any]]) -> None:
    assert found["occupancy_paper_URA_m3"]["value"] == pytest.approx(0.03)
    assert found["occupancy_paper_sum_m3"]["value"] == pytest.approx(0.21)


def test_a_fused_run_without_truth_and_robot() -> None:
    found = metrics_of(make_run(human=False, robot=False))
    for name in ("fusion_angle_rmse", "camera_kinect_velocity_rmse", "plan_method", "occupancy_ticks"):
        assert found[name]["value"] is None
        assert found[name]["reason"]
    assert "ground truth" in found["fusion_angle_rmse"]["reason"]
    assert not any(name.startswith("plan_near") for name in found)


def test_the_papers_numbers_are_labelled_as_the_papers(found: dict[str, dict[str, Any]]) -> None:
    assert found["paper_stationary_share_qp"]["value"] == 0.3006
    assert found["paper_stationary_share_scaling"]["value"] == 0.8644
    assert found["paper_deviation_m"]["value"] == 0.221
    assert all("the paper prints" in m["meaning"] for n, m in found.items() if n.startswith("paper_"))


def test_frames_of_a_camera_come_in_the_order_of_capture() -> None:
    measurements = frame_of(make_run(2.0).measurements)
    mixed = measurements.iloc[np.random.default_rng(8).permutation(len(measurements))].reset_index(drop=True)
    for camera in sorted(set(measurements["camera"])):
        found, want = frames_of(mixed, camera), measurements[measurements["camera"] == camera]
        want = want.sort_values("capture_ns")
        assert found["capture_ns"].tolist() == want["capture_ns"].tolist()
        np.testing.assert_array_equal(found[list(JOINTS)].to_numpy(), want[list(JOINTS)].to_numpy())
