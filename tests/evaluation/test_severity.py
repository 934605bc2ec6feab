"""Severity of contact: against the dynamics of a whole arm, and against distances over time."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from hrcreplay.commands import compare, replay
from hrcreplay.evaluation.judging import read_recorded_people
from hrcreplay.evaluation.severity import CONTACT, NEAREST, Meeting, merged_runs, transferred_j
from hrcreplay.human.contact_limits import REGIONS
from hrcreplay.human.model import part_radii
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.robot_mass import robot_mass
from hrcreplay.pipeline.run_config import read_run_config
from hrcreplay.robot.model import Segment, from_urdf, irb140
from hrcreplay.settings.sections import Robot
from hrcreplay.store import run_folder
from hrcreplay.store.columns import COLUMNS
from hrcreplay.store.run_folder import RunWriter
from tests.robot.heavy import LINKS, Arm, urdf
from tests.undrawn import undrawn

#: Links that are hit, and the joint that moves each.
SEGMENTS = tuple(
    Segment(f"link_{joint}", f"link_{joint}", (0.0, 0.0, 0.0), end_m, 0.05)
    for joint, end_m in ((2, (0.0, 0.0, 0.36)), (3, (0.38, 0.0, 0.0)), (5, (0.065, 0.0, 0.0)))
)
BY_NAME = {region.name: region for region in REGIONS}


@pytest.mark.parametrize("payload_kg", [0.0, 3.0])
def test_energy_is_that_of_the_whole_arm_against_a_spring_in_random_contacts(payload_kg: float) -> None:
    robot = from_urdf(urdf(), np.eye(4), stop_s=0.4, tcp_frame="flange", tool_m=0.1, segments=SEGMENTS)
    arm, rng = Arm(payload_kg), np.random.default_rng(38)
    shares: list[float] = []
    while len(shares) < 50:
        q, dq, region = rng.uniform(-1.5, 1.5, 6), rng.uniform(-1.0, 1.0, 6), REGIONS[rng.integers(len(REGIONS))]
        link, along = int(rng.integers(3)), rng.uniform(0.3, 1.0)
        motion = robot.link_motion(q[None], dq[None])
        first_m, last_m = motion.ends_m[0, link]
        point_m = first_m + along * (last_m - first_m)
        velocity = motion.twist[0, link, :3] + np.cross(motion.twist[0, link, 3:], point_m)
        normal = velocity / np.linalg.norm(velocity) + 0.5 * rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        speed = rng.uniform(0.0, 0.8)
        approach = float(velocity @ normal) + speed
        if approach < 0.15:
            continue
        said = transferred_j(region.mass_kg, robot.effective_mass_kg(q, link, point_m, normal, payload_kg), approach)
        person = (region.mass_kg, region.stiffness_n_per_m, speed)
        offset_m = along * np.array(SEGMENTS[link].end_m)
        shares.append(said / arm.push(q, dq, (2, 3, 5)[link], offset_m, normal, person))
    assert np.abs(np.array(shares) - 1.0).max() < 0.10
    assert np.median(np.abs(np.array(shares) - 1.0)) < 0.01


def test_an_effective_mass_is_that_of_a_pendulum_and_near_half_the_arm() -> None:
    bar = [Segment("bar", "link_6", (0.0, 0.0, 0.0), (0.1, 0.0, 0.0), 0.02)]
    robot = from_urdf(urdf(), np.eye(4), stop_s=0.4, tcp_frame="flange", tool_m=0.1, segments=(*SEGMENTS, *bar))
    assert robot.moving_mass_kg == pytest.approx(sum(mass for mass, *_ in LINKS))
    # sideways at the shoulder the first axis gives way, and the wrist's two axes along x hardly help
    q, point_m = np.zeros(6), np.array([0.070, 0.0, 0.352 + 0.36])
    about_z = 0.0
    for (mass, centre_m, moments), at_m in zip(LINKS, _origins(), strict=True):
        x, y = at_m[0] + centre_m[0], at_m[1] + centre_m[1]
        about_z += moments[2] + mass * (x**2 + y**2)
    sideways = robot.effective_mass_kg(q, 0, point_m, np.array([0.0, 1.0, 0.0]))
    assert 0.999 * about_z / 0.070**2 < sideways < about_z / 0.070**2
    assert robot.effective_mass_kg(q, 0, point_m, np.array([0.0, 1.0, 0.0]), 2.0) > sideways
    upright = np.array([0.070, 0.0, 0.352])  # on axis 2: only turning about z moves it, and not upwards
    assert robot.effective_mass_kg(q, 0, upright, np.array([0.0, 0.0, 1.0])) > 1e6
    rng, found = np.random.default_rng(2), []
    for _ in range(300):
        q, normal = rng.uniform(-1.5, 1.5, 6), rng.normal(size=3)
        ends_m = robot.ends_m(q)[1]
        found.append(robot.effective_mass_kg(q, 1, ends_m[1], normal / np.linalg.norm(normal)))
    simple = robot_mass(Robot(urdf=Path("a.urdf"), mass_kg=robot.moving_mass_kg), robot).simple_kg
    assert simple == pytest.approx(0.5 * robot.moving_mass_kg)
    assert 0.2 < np.median(found) / simple < 2.0  # the simple form is a rule of thumb


def _origins() -> list[np.ndarray]:
    """Origins of the links at zero, from the data sheet: 352 up, 70 forward, 360 up, 380 forward, 65 forward [mm]."""
    steps = [(0, 0, 0.352), (0.070, 0, 0), (0, 0, 0.360), (0.380, 0, 0), (0, 0, 0), (0.065, 0, 0)]
    return list(np.cumsum(np.array(steps), axis=0))


def test_what_is_known_of_a_mass_is_told_and_nothing_is_guessed() -> None:
    ours = irb140(np.eye(4), stop_s=0.4)
    assert not ours.inertial
    assert np.isnan(ours.effective_mass_kg(np.zeros(6), 0, np.zeros(3), np.array([1.0, 0.0, 0.0])))
    found = robot_mass(Robot(), ours)
    assert (found.moving_kg, found.payload_kg, found.simple_kg) == (98.0, 6.0, 55.0)
    assert "whole robot" in found.source
    other = Robot(urdf=Path("a.urdf"))
    assert np.isnan(robot_mass(other, ours).simple_kg)
    assert "robot.mass_kg" in robot_mass(other, ours).source
    heavy = from_urdf(urdf(), np.eye(4), stop_s=0.4, segments=SEGMENTS)
    assert robot_mass(other, heavy).simple_kg == pytest.approx(0.5 * sum(mass for mass, *_ in LINKS))
    lacking = from_urdf(
        urdf((*LINKS[:5], (0.0, LINKS[5][1], (0.0, 0.0, 0.0)))), np.eye(4), stop_s=0.4, segments=SEGMENTS
    )
    assert not lacking.inertial
    assert np.isnan(lacking.moving_mass_kg)


def test_stretches_with_short_gaps_are_one() -> None:
    rng = np.random.default_rng(4)
    t_ns = np.cumsum(rng.integers(10_000_000, 150_000_000, 300))
    mask = rng.random(300) < 0.4
    together = []  # for each two neighbours of True: whether one contact
    rows = np.flatnonzero(mask)
    for a, b in zip(rows[:-1].tolist(), rows[1:].tolist(), strict=True):
        together.append(b == a + 1 or t_ns[b] - t_ns[a] <= 200_000_000)
    found = merged_runs(mask, t_ns)
    assert len(found) == 1 + together.count(False)
    assert sorted(i for a, b in found for i in range(a, b) if mask[i]) == rows.tolist()
    assert all(mask[a] and mask[b - 1] for a, b in found)


METHODS = ("qp", "pfl", "none")


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stretch of the demo in which the robot meets hands, with a robot that may touch them and one that is blind."""
    out = tmp_path_factory.mktemp("severity") / "run"
    with undrawn():
        overrides = ('plan.baselines=["pfl","none"]', "fusion.rate_hz=125")
        return replay.run("report", replay.demo_log(), out=out, start_s=7.0, end_s=12.0, overrides=overrides)


def tables(ran: Path, method: str) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    contact, met = (pq.read_table(ran / f"{name}.parquet").to_pandas() for name in ("contact", "severity"))
    motion = pq.read_table(ran / ("motion.parquet" if method == "qp" else f"motion_{method}.parquet")).to_pandas()
    return (
        motion,
        contact[contact["method"] == method].reset_index(drop=True),
        met[met["method"] == method].reset_index(drop=True),
    )


def test_a_row_is_the_worst_of_its_contacts_ticks_each_looked_at_alone(ran: Path) -> None:
    meeting, several = read_meeting(ran), 0
    for method in ("none", "pfl"):
        motion, contact, met = tables(ran, method)
        touching = ((contact["distance_m"] <= 0.0) & contact["moving"]).to_numpy()
        runs = merged_runs(touching, contact["t_ns"].to_numpy())
        for (first, last), (_, row) in zip(runs, met[met["kind"] == CONTACT].iterrows(), strict=True):
            ticks = first + np.flatnonzero(touching[first:last])
            each = [next(meeting.impacts(method, CONTACT, motion, contact, np.array([tick]))) for tick in ticks]
            worst = max(each, key=lambda one: (np.nan_to_num(one.share, nan=-1.0), np.nan_to_num(one.relative_speed)))
            assert (row["t_ns"], row["transient_n"], row["energy_j"]) == pytest.approx(
                (worst.t_ns, worst.transient_n, worst.energy_j), rel=1e-12, nan_ok=True
            )
            several += worst.t_ns != each[0].t_ns
    assert several > 0, "the worst tick is not always the first"


def test_each_contact_has_its_row_and_a_method_without_one_its_nearest_tick(ran: Path) -> None:
    assert tuple(pq.read_schema(ran / "severity.parquet").names) == COLUMNS["severity"]
    for method in METHODS:
        _, contact, met = tables(ran, method)
        touching = (contact["distance_m"] <= 0.0) & contact["moving"]
        runs = merged_runs(touching.to_numpy(), contact["t_ns"].to_numpy())
        if method == "qp":
            assert not touching.any()
            assert met["kind"].tolist() == [NEAREST]
            row = contact[contact["moving"]].sort_values("distance_m").iloc[0]
            assert (met["t_ns"][0], met["distance_m"][0]) == (row["t_ns"], pytest.approx(row["distance_m"], abs=1e-12))
            continue
        assert met["kind"].tolist() == [CONTACT] * len(runs)
        assert len(runs)
        for (first, last), (_, row) in zip(runs, met.iterrows(), strict=True):
            assert contact["t_ns"][first] <= row["t_ns"] <= contact["t_ns"][last - 1]
            assert row["duration_s"] == pytest.approx(
                (contact["t_ns"][last - 1] - contact["t_ns"][first]) / 1e9 + 0.008
            )
            at = contact[contact["t_ns"] == row["t_ns"]].iloc[0]
            assert (row["link"], row["limb"], row["source"]) == (at["link"], at["limb"], at["source"])


def test_speeds_are_how_fast_the_distance_shrinks(ran: Path) -> None:
    """The recorded distances of neighbouring ticks know nothing of normals, Jacobians and points of contact."""
    compared = 0
    for method in METHODS:
        motion, contact, met = tables(ran, method)
        people = contact["t_ns"].to_numpy()
        for _, row in met.iterrows():
            i = int(np.searchsorted(people, row["t_ns"]))
            near = contact.iloc[i - 1 : i + 2]
            pairs = near["link"].eq(row["link"]) & near["limb"].eq(row["limb"])
            rows = near[pairs]
            if len(rows) < 2:
                continue
            slope = -(rows["distance_m"].iloc[-1] - rows["distance_m"].iloc[0]) / (
                (rows["t_ns"].iloc[-1] - rows["t_ns"].iloc[0]) * 1e-9
            )
            assert row["robot_speed"] + row["person_speed"] == pytest.approx(slope, abs=0.03)
            assert row["robot_speed"] <= motion["tcp_speed"].max() + 0.5
            compared += 1
    assert compared >= 3


def test_energies_and_forces_follow_from_the_columns(ran: Path) -> None:
    for method in METHODS:
        for _, row in tables(ran, method)[2].iterrows():
            region = BY_NAME[row["region"]]
            assert (row["person_kg"], row["stiffness_n_per_m"]) == (region.mass_kg, region.stiffness_n_per_m)
            approach = max(0.0, row["robot_speed"] + row["person_speed"])
            reduced = 1.0 / (1.0 / row["person_kg"] + 1.0 / 55.0)
            assert row["robot_simple_kg"] == 55.0
            assert np.isnan(row["robot_kg"])  # the data sheet gives no inertia
            assert row["energy_simple_j"] == pytest.approx(0.5 * reduced * approach**2)
            assert row["transient_n"] == pytest.approx(approach * np.sqrt(reduced * row["stiffness_n_per_m"]))
            own = max(0.0, row["robot_speed"])
            assert row["clamped_n"] == pytest.approx(own * np.sqrt(55.0 * row["stiffness_n_per_m"]))


def test_the_robot_that_may_touch_people_is_slow_enough_for_the_energy_limit(ran: Path) -> None:
    meeting, (motion, contact, _) = read_meeting(ran), tables(ran, "pfl")
    touching = (contact["distance_m"] <= 0.0) & contact["moving"]
    assert touching.sum() >= 3
    assert not motion["certified"].any()  # it claims no certificate
    impacts = list(meeting.impacts("pfl", CONTACT, motion, contact, np.flatnonzero(touching)))
    for impact in impacts:
        region = BY_NAME[impact.region]
        assert impact.robot_speed <= region.speed_m_per_s(55.0) + 1e-3
        by_robot = transferred_j(region.mass_kg, 55.0, max(0.0, impact.robot_speed))
        assert by_robot <= region.energy_j * 1.01
        assert impact.limb != "HD"
    blind, against, _ = tables(ran, "none")
    hits = np.flatnonzero((against["distance_m"] <= 0.0) & against["moving"])
    fastest = max(one.robot_speed for one in meeting.impacts("none", CONTACT, blind, against, hits))
    assert fastest > 2.0 * max(one.robot_speed for one in impacts)
    metrics = json.loads((ran / "metrics.json").read_text())
    assert metrics["baseline_pfl_progress_share"]["value"] > 0.1
    assert metrics["baseline_pfl_touch_inside_ticks"]["reason"] == "the method may touch people"


def read_meeting(ran: Path) -> Meeting:
    """Robot and bodies of the run."""

    class Folder(RunWriter):
        @property
        def partial(self) -> Path:
            return self.folder

    config = read_run_config(ran)
    log = open_log(config.log, config.settings.logs)
    people = read_recorded_people(config, log, Folder(ran))
    robot, settings = assembly.robot(config, assembly.robot_base(config, log)), config.settings
    radii_m = part_radii(settings.prediction, settings.report.leg_radius_m)
    mass = robot_mass(settings.robot, robot)
    return Meeting(robot, None, mass, people.names, people.tracks, radii_m, settings.prediction.hand_m)


def test_page_and_metrics_show_what_the_table_holds(ran: Path) -> None:
    metrics, page = json.loads((ran / "metrics.json").read_text()), (ran / "report.html").read_text()
    for method, prefix in (("qp", "plan"), ("pfl", "baseline_pfl"), ("none", "baseline_none")):
        met = tables(ran, method)[2]
        hits = met[met["kind"] == CONTACT]
        assert metrics[f"{prefix}_contacts"]["value"] == len(hits)
        over = int((hits["transient_n"] > hits["transient_limit_n"]).sum())
        assert metrics[f"{prefix}_contacts_over"]["value"] == over
        assert metrics[f"{prefix}_contacts_over_clamped"]["value"] == int(
            (hits["clamped_n"] > hits["clamped_limit_n"]).sum()
        )
        most = metrics[f"{prefix}_contact_energy_max_j"]["value"]
        assert most == (pytest.approx(hits["energy_simple_j"].max()) if len(hits) else None)
    assert "Severity of contact, estimated" in page
    assert "Estimated, not measured" in page
    assert "whole robot by its data sheet" in page


def test_compare_has_the_contacts_of_the_report(ran: Path, tmp_path: Path) -> None:
    folder = compare.run([ran], methods="none,pfl,qp", out=tmp_path / "compared", processes=1)
    found = json.loads((folder / "compare.json").read_text())
    with (folder / "severity.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    for label, method in (("none", "none"), ("pfl:sound:adaptive", "pfl"), ("qp:sound:adaptive", "qp")):
        met, mine = tables(ran, method)[2], [row for row in rows if row["variant"] == label]
        assert [int(row["t_ns"]) for row in mine] == met["t_ns"].tolist()
        assert [float(row["energy_simple_j"]) for row in mine] == pytest.approx(met["energy_simple_j"].tolist())
        assert [row["energy_j"] for row in mine] == [""] * len(mine)
        figures = found["logs"][0]["methods"][label]
        assert figures["contacts"] == int((met["kind"] == CONTACT).sum())
        assert figures["worst_contact"]["region"] in set(met["region"])
    assert found["total"]["none"]["contacts"] == found["logs"][0]["methods"]["none"]["contacts"]
    assert "Severity of contact, estimated" in (folder / "compare.md").read_text()
    assert run_folder.read_meta(folder)["outputs"]["severity.csv"]
