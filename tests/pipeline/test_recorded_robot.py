"""The robot as recorded, from the log to the verdict: its TCP, its contacts, what is not known, what does not fit."""

from __future__ import annotations

import json
import shutil
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from hrcreplay.commands import compare, explain, replay, report
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.evaluation.recorded_person import RecordedPeople, SmoothedPeople
from hrcreplay.evaluation.recording import read_people
from hrcreplay.human.model import part_radii
from hrcreplay.logs.reader import open_log
from hrcreplay.logs.writer import LogWriter
from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.run_config import RunConfig, read_run_config, resolve
from hrcreplay.records import Floats, HumanStates, Ints
from hrcreplay.reporting import verdict
from hrcreplay.robot import irb140
from hrcreplay.robot.recorded import RecordedCapsules, RecordedJoints
from hrcreplay.settings.sections import Settings
from hrcreplay.store import run_folder
from hrcreplay.store.columns import read_states
from tests.facts import facts, tells
from tests.realdata import data_path
from tests.test_recordings import SARA, SARA_CELL, TASK
from tests.undrawn import undrawn

SECOND = 1_000_000_000
TICK_NS = 4_000_000
AXES = tuple(f"joint_{i}" for i in range(1, 7))
#: In the demo's own time: a robot that follows the task without reaction touches the person from 10.56 s to 10.82 s.
FIRST_S, LAST_S, GAP_S = 9.6, 12.4, (11.2, 11.76)
FASTER = ("plan.method=scaling", "plan.baselines=[]", "prediction.store_hz=1")


def begin_ns() -> int:
    return open_log(replay.demo_log()).header.start_ns


def task_q(t_s: Floats) -> Floats:
    """(n, 6) joints of the demo's task, followed by the clock [rad]."""
    run_config, demo = resolve("plan", replay.demo_log()), open_log(replay.demo_log())
    model = assembly.robot(run_config, assembly.robot_base(run_config, demo))
    path = assembly.programme(run_config, demo, model).path
    return np.array([path.sample(s).q for s in t_s])


def stamps_ns() -> Ints:
    """Instants of ticks, 12 to 40 ms apart, with a gap."""
    steps = np.random.default_rng(5).integers(3, 11, 400)
    t_ns = TICK_NS * np.concatenate([[0], np.cumsum(steps)])
    first, last = (round((at_s - FIRST_S) * SECOND) for at_s in GAP_S)
    kept = (t_ns <= round((LAST_S - FIRST_S) * SECOND)) & ~((t_ns > first) & (t_ns < last))
    return np.concatenate([t_ns[kept & (t_ns < first)], [first, last], t_ns[kept & (t_ns > last)]])


def write(path: Path, names: tuple[str, ...], t_ns: Ints, q: Floats, *, task: bool = False) -> Path:
    """The demo's frames beside these joints; instants count from ``FIRST_S``."""
    demo = open_log(replay.demo_log())
    begin = demo.header.start_ns + round(FIRST_S * SECOND)
    with LogWriter(path) as writer:
        for camera in demo.header.cameras:
            writer.camera(camera, demo.header.T_world_camera[camera])
        assert demo.header.T_world_base is not None
        writer.base(demo.header.T_world_base)
        if task:
            assert demo.header.task is not None
            writer.task(demo.header.task)
        writer.joints(names, t_ns + begin, q)
        for frames in demo.frames(begin, begin + 3 * SECOND):
            writer.frames(frames)
    return path


@dataclass(frozen=True)
class Ran:
    folder: Path
    log: Path
    t_ns: Ints  #: of the joint states
    q: Floats
    recorded: pd.DataFrame
    contact: pd.DataFrame


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Ran:
    tmp, t_ns = tmp_path_factory.mktemp("recorded"), stamps_ns()
    q = task_q(np.asarray(FIRST_S + t_ns * 1e-9))
    log = write(tmp / "log.mcap", AXES, t_ns, q)
    with undrawn():
        folder = replay.run("report", log, out=tmp / "run", overrides=FASTER)
    tables = (pq.read_table(folder / f"{name}.parquet").to_pandas() for name in ("motion_recorded", "contact"))
    recorded, contact = tables
    return Ran(
        folder,
        log,
        t_ns + begin_ns() + round(FIRST_S * SECOND),
        q,
        recorded,
        contact[contact["method"] == "recorded"].reset_index(drop=True),
    )


def frames_of(q: Floats, T_world_base: Floats) -> dict[str, Floats]:
    """Link and joint frames of the IRB 140 by its URDF alone, (4, 4) each."""
    tree = ET.fromstring(irb140.urdf())
    found, left = {}, list(tree.findall("joint"))
    children = {joint.find("child").get("link") for joint in left}  # type: ignore[union-attr]
    for link in tree.findall("link"):
        if link.get("name") not in children:
            found[str(link.get("name"))] = T_world_base
    axis = 0
    while left:
        joint = next(j for j in left if str(j.find("parent").get("link")) in found)  # type: ignore[union-attr]
        left.remove(joint)
        origin, T = joint.find("origin"), np.eye(4)
        if origin is not None:
            T[:3, 3] = [float(v) for v in origin.get("xyz", "0 0 0").split()]
            T[:3, :3] = Rotation.from_euler("xyz", [float(v) for v in origin.get("rpy", "0 0 0").split()]).as_matrix()
        turn = np.eye(4)
        if joint.get("type") != "fixed":
            about = np.array([float(v) for v in joint.find("axis").get("xyz").split()])  # type: ignore[union-attr]
            turn[:3, :3] = Rotation.from_rotvec(q[axis] * about).as_matrix()
            axis += 1
        here = found[joint.find("parent").get("link")] @ T @ turn  # type: ignore[union-attr,index]
        found[joint.find("child").get("link")] = found[str(joint.get("name"))] = here  # type: ignore[union-attr,index]
    return found


def base(log: Path) -> Floats:
    T = open_log(log).header.T_world_base
    assert T is not None
    return T


def test_the_tcp_at_its_stamps_is_as_recorded(ran: Ran) -> None:
    """Within 0.1 mm of the forward kinematics of each message, with the tool of 0.1 m along the flange's z."""
    tool = np.array([0.0, 0.0, 0.1, 1.0])
    rows = ran.recorded.set_index("t_ns")
    held = [t for t in ran.t_ns.tolist() if t in rows.index]
    assert len(held) == len(ran.t_ns)
    for t_ns, q in zip(ran.t_ns.tolist(), ran.q, strict=True):
        expected = (frames_of(q, base(ran.log))["flange"] @ tool)[:3]
        found = rows.loc[t_ns, ["tcp_x", "tcp_y", "tcp_z"]].to_numpy(dtype=float)
        assert np.linalg.norm(found - expected) < 1e-4


def test_what_is_not_recorded_has_no_number_but_a_reason(ran: Ran) -> None:
    t_ns = ran.recorded["t_ns"].to_numpy()
    gap = (t_ns > ran.t_ns[np.argmax(np.diff(ran.t_ns))]) & (t_ns < ran.t_ns[np.argmax(np.diff(ran.t_ns)) + 1])
    after = t_ns > ran.t_ns[-1]
    assert gap.sum() == 139
    assert after.sum() == 45
    reason = ran.recorded["reason"].to_numpy()
    assert set(reason[gap]) == {"gap in the robot states"}
    assert set(reason[after]) == {"after the last robot state"}
    for name in ("q1", "dq1", "tcp_x", "tcp_speed", "distance_m"):
        assert ran.recorded[name].isna().to_numpy()[gap | after].all()
    assert ran.recorded["q1"].notna().to_numpy()[~(gap | after)].all()
    assert ran.contact["distance_m"].isna().to_numpy()[gap | after].all()
    assert not ran.contact["moving"].to_numpy()[gap | after].any()


def people_of(folder: Path, run_config: RunConfig) -> RecordedPeople:
    opened = open_log(run_config.log, run_config.settings.logs)
    states = HumanStates.join(list(read_states(folder / "state.parquet", 4096)))
    smooth = HumanStates.join(list(read_states(folder / "smooth.parquet", 4096)))
    return read_people(
        opened, states.t_ns, assembly.fusion_stage(run_config, opened), lambda: SmoothedPeople.of(smooth)
    )


def capsule(ends: Floats, radius_m: float) -> tuple[Any, Any]:
    """A capsule of coal, whose axis is z, and where it is."""
    axis = ends[1] - ends[0]
    length = float(np.linalg.norm(axis))
    turn = Rotation.align_vectors([axis / length], [[0.0, 0.0, 1.0]])[0].as_matrix() if length > 1e-9 else np.eye(3)
    return coal.Capsule(radius_m, length), coal.Transform3s(turn, ends.mean(axis=0))


def test_the_ticks_in_contact_are_those_of_brute_force(ran: Ran) -> None:
    """Link capsules by the URDF, at positions interpolated by numpy, against every recorded body by coal."""
    settings = Settings()
    radii_m = part_radii(settings.prediction, settings.report.leg_radius_m)
    people = people_of(ran.folder, resolve("report", ran.log))
    t_ns = ran.recorded["t_ns"].to_numpy()
    shown = np.flatnonzero(ran.recorded["q1"].notna())
    shown = shown[(np.arange(len(shown)) % 9 == 0) | (np.abs(ran.contact["distance_m"].to_numpy()[shown]) < 0.12)]
    q = np.column_stack([np.interp(t_ns[shown], ran.t_ns, column) for column in ran.q.T])
    least = np.full(len(shown), np.inf)
    for track in people.tracks:
        axes = track.axes_m(t_ns[shown], settings.prediction.hand_m)
        for i in range(len(shown)):
            frames = frames_of(q[i], base(ran.log))
            for _, body, start_m, end_m, radius_m in irb140.capsules(0.10):
                T = frames[body]
                ends = np.array([T[:3, :3] @ np.array(end) + T[:3, 3] for end in (start_m, end_m)])
                link, at = capsule(ends, radius_m)
                for part in np.flatnonzero(np.isfinite(axes[i]).all(axis=(1, 2))):
                    apart = np.linalg.norm(axes[i, part].mean(axis=0) - ends.mean(axis=0))
                    if apart < 1.0:
                        limb, there = capsule(axes[i, part], float(radii_m[part]))
                        gap = coal.distance(link, at, limb, there, coal.DistanceRequest(), coal.DistanceResult())
                        least[i] = min(least[i], gap)
    found = ran.contact["distance_m"].to_numpy()[shown]
    close = least < 0.3
    assert (least <= 0.0).sum() > 40
    assert_array_equal(found <= 0.0, least <= 0.0)
    assert_allclose(found[close], least[close], atol=1e-4)


def test_the_recorded_robot_is_told_first_and_its_unknown_ticks_with_it(ran: Ran) -> None:
    run = run_folder.read(ran.folder)
    metrics = json.loads((ran.folder / "metrics.json").read_text())
    assert "recorded" not in run.baselines
    touching = int((ran.contact["moving"] & (ran.contact["distance_m"] <= 0.0)).sum())
    assert metrics["recorded_touch_moving_ticks"]["value"] == touching > 40
    known = int(ran.recorded["q1"].notna().sum())
    assert metrics["recorded_known_ticks"]["value"] == known
    assert metrics["recorded_unknown_ticks_gap_in_the_robot_states"]["value"] == 139
    assert metrics["recorded_body_known_ticks"]["value"] <= known
    found = verdict.verdict(run, metrics)
    assert found is not None
    assert found.sentences[0].startswith("As it ran, the moving robot touched the person")
    assert found.table.rows[0][0] == "recorded (as it ran)"
    assert found.table.rows[1][0] == "scaling (this plan)"
    assert "gap in the robot states: 139" in found.sentences[0]
    assert "Was it safe as it ran?" in (ran.folder / "report.html").read_text()


def test_the_replay_shows_the_recorded_robot_without_a_certificate(ran: Ran) -> None:
    scene = report.scene_of(read_run_config(ran.folder), run_folder.read(ran.folder))
    assert scene is not None
    assert list(scene.methods) == ["scaling", "recorded"]
    track = scene.methods["recorded"]
    assert set(track.certified.tolist()) == {-1}
    assert track.names["status"][0] == ("as recorded",)
    assert_array_equal(np.isnan(track.q).any(axis=1), np.isnan(track.tcp_m).any(axis=1))
    assert 0 < np.isnan(track.q).any(axis=1).sum() < len(track.q)


def test_contact_of_the_robot_at_rest_is_told_with_the_answer(ran: Ran) -> None:
    metrics = json.loads((ran.folder / "metrics.json").read_text())
    metrics["recorded_touch_moving_ticks"]["value"] = 0
    metrics["recorded_touch_rest_ticks"]["value"] = 430
    metrics["recorded_body_distance_min_moving_m"]["value"] = 0.246
    metrics["recorded_body_distance_min_rest_m"]["value"] = -0.124
    found = verdict.in_short_as_it_ran(metrics)
    assert "24 cm away" in found
    assert found.endswith("The robot at rest was in contact at 430 ticks, up to 12 cm deep.")


def test_compare_puts_the_recorded_robot_first_with_the_contacts_of_the_report(ran: Ran, tmp_path: Path) -> None:
    folder = compare.run([ran.log], methods="none", out=tmp_path / "c", processes=1)
    found = json.loads((folder / "compare.json").read_text())
    assert next(iter(found["logs"][0]["methods"])) in ("none", "recorded")  # JSON sorts its keys
    rows = (folder / "compare.csv").read_text().splitlines()
    assert [row.split(",")[1] for row in rows[1:3]] == ["recorded", "none"]
    mine = found["logs"][0]["methods"]["recorded"]
    metrics = json.loads((ran.folder / "metrics.json").read_text())
    for name, key in (("touch_ticks", "touch_moving_ticks"), ("nearest_moving_m", "body_distance_min_moving_m")):
        assert mine[name] == metrics[f"recorded_{key}"]["value"]
    for name in ("pace", "standing_share", "uncertified_ticks", "braking_events", "jerk_rms_rad_per_s3", "coverage"):
        assert mine[name] is None


def recorded_of(log: Path, *overrides: str, **options: Any) -> tuple[RecordedJoints | None, assembly.RunProgramme]:
    run_config = resolve("plan", log, overrides=overrides, **options)
    opened = open_log(run_config.log, run_config.settings.logs)
    model = assembly.robot(run_config, assembly.robot_base(run_config, opened))
    programme = assembly.programme(run_config, opened, model)
    assert not isinstance(programme.recorded, RecordedCapsules)
    return programme.recorded, programme


def test_why_tells_where_the_recorded_robot_was_and_what_a_controller_did(ran: Ran, tmp_path: Path) -> None:
    t_ns, touching = ran.contact["t_ns"].to_numpy(), (ran.contact["distance_m"] <= 0.0) & ran.contact["moving"]
    at_s = float(t_ns[np.flatnonzero(touching)[5]] - t_ns[0]) * 1e-9
    found = explain.explain(ran.folder, at_s, "recorded")
    row, body = ran.recorded.iloc[found["tick"]], ran.contact.iloc[found["tick"]]
    assert (found["method"], found["status"]) == ("recorded", "as recorded")
    assert found["tcp_speed_m_per_s"] == row["tcp_speed"]
    assert found["nearest"] == {
        "link": row["link"],
        "limb": row["limb"],
        "distance_m": row["distance_m"],
        "overlap_m": row["overlap_m"],
    }
    assert found["body"]["distance_m"] == body["distance_m"] <= 0.0
    assert (found["body"]["link"], found["body"]["limb"], found["body"]["moving"]) == (body["link"], body["limb"], True)
    own = pq.read_table(ran.folder / "motion.parquet").to_pandas().iloc[found["tick"]]
    assert found["beside"] == {
        "scaling": {"status": own["status"], "reason": own["reason"], "tcp_speed_m_per_s": own["tcp_speed"]}
    }
    said = explain.sentences(found)
    assert tells(said, "recorded", "TCP moved", "as recorded")
    assert tells(said, "Cause", "not known", "log")
    assert tells(said, "Recorded body", body["source"], body["link"])
    assert tells(said, "Beside it, scaling")
    gap_s = (GAP_S[0] + GAP_S[1]) / 2.0 - FIRST_S
    unknown = explain.explain(ran.folder, gap_s, "recorded")
    assert json.loads(json.dumps(unknown, allow_nan=False))["tcp_speed_m_per_s"] is None
    assert tells(explain.sentences(unknown), "not known", "gap in the robot states")
    spoiled = tmp_path / "run"
    shutil.copytree(ran.folder, spoiled)
    table = ran.recorded.copy()
    table.loc[found["tick"], "q1"] += 1e-12
    table.to_parquet(spoiled / "motion_recorded.parquet")
    with pytest.raises(SettingsError, match=facts("could not be reproduced")):
        explain.explain(spoiled, at_s, "recorded")


def test_the_contact_of_the_recorded_robot_has_its_severity(ran: Ran) -> None:
    found = pq.read_table(ran.folder / "severity.parquet").to_pandas()
    found = found[found["method"] == "recorded"]
    touching = (ran.contact["distance_m"] <= 0.0) & ran.contact["moving"]
    within = ran.contact["t_ns"][touching]
    assert len(found)
    assert found["t_ns"].isin(within).all()
    metrics = json.loads((ran.folder / "metrics.json").read_text())
    assert metrics["recorded_contacts"]["value"] == len(found)
    energy = metrics["recorded_contact_energy_max_j"]["value"]
    assert energy == pytest.approx(found["energy_simple_j"].max())
    assert energy > 0.0


def test_another_order_in_the_messages_changes_nothing(ran: Ran, tmp_path: Path) -> None:
    order = [3, 0, 5, 1, 4, 2]
    t_ns = ran.t_ns - ran.t_ns[0]
    log = write(tmp_path / "a.mcap", tuple(AXES[i] for i in order), t_ns, ran.q[:, order])
    mine, _ = recorded_of(log)
    assert mine is not None
    assert_array_equal(mine.q, ran.q)
    assert_array_equal(mine.t_ns, ran.t_ns)


def test_joints_that_do_not_fit_stop_a_run_by_them_and_leave_a_task_alone(ran: Ran, tmp_path: Path) -> None:
    t_ns = ran.t_ns - ran.t_ns[0]
    spoiled = {
        "degrees": (AXES, np.degrees(ran.q), ("divided by 57.3", "logs.joints_unit = deg")),
        "missing": (AXES[:5], ran.q[:, :5], ("joint_6", "logs.joint_names")),
    }
    for name, (names, q, words) in spoiled.items():
        with pytest.raises(LogError, match=facts(*words)):
            recorded_of(write(tmp_path / f"{name}.mcap", names, t_ns, q))
        recorded, programme = recorded_of(write(tmp_path / f"{name}_task.mcap", names, t_ns, q, task=True))
        assert recorded is None
        (note,) = programme.notes
        assert note.startswith("the robot as recorded is not judged: ")
        assert words[-1] in note
    found, _ = recorded_of(tmp_path / "degrees.mcap", "logs.joints_unit=deg")
    assert found is not None
    assert_allclose(found.q, ran.q, atol=1e-12)


def test_with_a_task_the_recorded_robot_is_judged_beside_it(ran: Ran, tmp_path: Path) -> None:
    log = write(tmp_path / "log.mcap", AXES, ran.t_ns - ran.t_ns[0], ran.q, task=True)
    recorded, programme = recorded_of(log)
    assert recorded is not None
    assert programme.begin_ns is None
    assert_array_equal(recorded.q, ran.q)


def test_a_log_without_joints_has_no_recorded_robot() -> None:
    recorded, programme = recorded_of(replay.demo_log())
    assert recorded is None
    assert programme.notes == ()


def test_its_own_waiting_is_cut_from_the_programme_and_told(tmp_path: Path) -> None:
    """The robot stands for 0.8 s in the middle of a move, and 0.3 s where the task has it stand."""
    t_s = np.arange(0.0, 2.6, 0.01)
    wait_s = 0.8
    at_s = FIRST_S + np.where(t_s < 0.9, t_s, np.maximum(0.9, t_s - wait_s))
    q = task_q(at_s)
    log = write(tmp_path / "log.mcap", AXES, np.round(t_s * 1e9).astype(np.int64), q)
    recorded, cut = recorded_of(log, "plan.waiting_s=0.4")
    _, kept = recorded_of(log, "plan.waiting_s=keep")
    assert recorded is not None
    (begin, end) = cut.cuts_ns[0]
    assert len(cut.cuts_ns) == 1
    assert_allclose((end - begin) * 1e-9, wait_s, atol=0.15)
    assert kept.cuts_ns == ()
    assert_allclose(kept.path.duration_s - cut.path.duration_s, (end - begin) * 1e-9, atol=0.01)
    assert any("1 standstill in the middle of a move" in note for note in cut.notes)
    start_ns = begin_ns() + round(FIRST_S * SECOND)
    assert cut.start_s(start_ns) == pytest.approx(0.0, abs=1e-6)
    assert cut.start_s(start_ns + SECOND * 2) == pytest.approx(2.0 - (end - begin) * 1e-9, abs=1e-6)


@pytest.mark.parametrize(
    "name",
    ["robot_kuka_order", "robot_gripper_topic_first", "robot_gripper_first", "robot_clock_2s_ahead", "robot_gap2s"],
)
def test_reported_logs_give_the_robot_of_the_right_one(name: str) -> None:
    """The same robot in messages that mean something else than they seem to: the same positions at every tick.

    A clock that is ahead is shifted as if the quickest message took no time; it takes 1 ms.
    """
    folder = data_path(f"reported/{name}")
    mine, _ = recorded_of(folder, cell_file=data_path("reported/cell_ma.toml"))
    right, _ = recorded_of(data_path("reported/robot_ok"), cell_file=data_path("reported/cell_ma.toml"))
    assert mine is not None
    assert right is not None
    later_ns = 1_000_000 if name == "robot_clock_2s_ahead" else 0
    at_ns = np.arange(right.t_ns[0], right.t_ns[-1] - later_ns, TICK_NS)
    found, expected = mine.sample(at_ns + later_ns), right.sample(at_ns)
    known = found.reason == 0
    assert known.sum() == pytest.approx(len(at_ns) - (500 if name == "robot_gap2s" else 0), abs=1)
    assert_allclose(found.q[known], expected.q[known], atol=1e-6)


def test_a_robot_recorded_by_its_capsules_is_judged_by_them(tmp_path: Path) -> None:
    """A bag of others without joints: the TCP at each message, and the contacts by plain numpy over the messages.

    The base is placed nearer to the person than it was, so that there are contacts.
    """
    bag = data_path("sara_human_robot_bags/exp_box.bag")
    (tmp_path / "s.toml").write_text(SARA)
    (tmp_path / "cell.toml").write_text(SARA_CELL.replace("[0, 0, 1.0]", "[0.1, 0.35, 1.0]"))
    (tmp_path / "task.toml").write_text(TASK)
    with undrawn():
        folder = replay.run(
            "report",
            bag,
            out=tmp_path / "run",
            config=tmp_path / "s.toml",
            cell_file=tmp_path / "cell.toml",
            end_s=6.0,
            overrides=(f"plan.task={tmp_path / 'task.toml'}", *FASTER),
        )
    with AnyReader([bag]) as reader:
        sent: list[tuple[int, list[tuple[float, ...]]]] = []
        for of, t_ns, raw in reader.messages([c for c in reader.connections if "robot" in c.topic]):
            message: Any = reader.deserialize(raw, of.msgtype)
            sent.append((t_ns, [(*_xyz(c.p1), *_xyz(c.p2), c.r) for c in message.capsules.capsules[:7]]))
    at_ns, numbers = np.array([t_ns for t_ns, _ in sent]), np.array([row for _, row in sent])
    motion = pq.read_table(folder / "motion_recorded.parquet").to_pandas()
    contact = pq.read_table(folder / "contact.parquet").to_pandas()
    contact = contact[contact["method"] == "recorded"]
    assert motion["q1"].isna().all()
    ticks_ns = motion["t_ns"].to_numpy()
    base = np.array([0.1, 0.35, 1.0])
    within = (ticks_ns >= at_ns[0]) & (ticks_ns <= at_ns[-1])
    tip = np.column_stack([np.interp(ticks_ns, at_ns, numbers[:, 6, 3 + k]) + base[k] for k in range(3)])
    assert np.abs(motion[["tcp_x", "tcp_y", "tcp_z"]].to_numpy()[within] - tip[within]).max() < 1e-4
    run_config = resolve("report", bag, config=tmp_path / "s.toml", cell_file=tmp_path / "cell.toml", end_s=6.0)
    people = people_of(folder, run_config)
    settings = run_config.settings
    radii_m = part_radii(settings.prediction, settings.report.leg_radius_m)
    rows = np.flatnonzero(within)[::5]
    shares = np.linspace(0.0, 1.0, 60)[:, None]
    least = np.full(len(rows), np.inf)
    for track in people.tracks:
        axes = track.axes_m(ticks_ns[rows], settings.prediction.hand_m)
        for i, row in enumerate(rows.tolist()):
            for link in range(7):
                n = [np.interp(ticks_ns[row], at_ns, numbers[:, link, k]) for k in range(7)]
                a, b = np.array(n[:3]) + base, np.array(n[3:6]) + base
                for part in np.flatnonzero(np.isfinite(axes[i]).all(axis=(1, 2))):
                    c, d = axes[i, part]
                    gaps = np.linalg.norm((a + shares * (b - a))[:, None] - (c + shares * (d - c))[None], axis=2)
                    least[i] = min(least[i], gaps.min() - n[6] - radii_m[part])
    found = contact["distance_m"].to_numpy()[rows]
    clear = np.abs(least) > 2e-3  # sampled axes are up to this far from the nearest points
    assert (least[clear] <= 0.0).sum() > 20
    assert_array_equal((found <= 0.0)[clear], (least <= 0.0)[clear])
    assert_allclose(found, least, atol=2e-3)
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["recorded_contact_moving_ticks"]["value"] is None
    assert "not known" in (folder / "report.html").read_text()


def _xyz(point: Any) -> tuple[float, float, float]:
    return point.x, point.y, point.z
