from __future__ import annotations

import base64
import dataclasses
import json
import zlib
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.interpolate import interp1d
from scipy.linalg import expm

from hrcreplay.human.model import skeleton
from hrcreplay.records import JOINTS, LENGTHS, LIMBS, POINTS, Floats
from hrcreplay.reporting import replay_scene
from hrcreplay.reporting.metrics.contact import stop_events
from hrcreplay.reporting.page import replay_page
from hrcreplay.reporting.page.replay_page import MISSING, NumberBlock, replay_data
from hrcreplay.reporting.replay_scene import (
    LONG_VOLUME_HZ,
    SHOWN_POINTS,
    VOLUME_HZ,
    ReplayScene,
    at_rate,
    shown_skeletons,
    volume_track,
)
from hrcreplay.robot.control.static_obstacles import StaticHull
from hrcreplay.robot.control.stops import stop_axis_by_axis, stop_straight
from tests.reporting.moving import joints, moving_run, moving_scene, robot
from tests.reporting.synthetic import LENGTHS_M, T0_NS, frame_of, pose


@pytest.fixture(scope="module")
def scene() -> ReplayScene:
    return moving_scene(moving_run(8.0))


def test_the_screws_move_the_links_as_pinocchio_does(scene: ReplayScene) -> None:
    model, shape = robot(moving_run(2.0)), scene.robot
    q = np.array([0.4, -0.7, 0.3, 1.1, -0.5, 2.0])
    T = [np.eye(4)]
    for turned, screw in zip(q, shape.screws, strict=True):
        v, (x, y, z) = screw[:3], screw[3:]
        twist = np.array([[0, -z, y, v[0]], [z, 0, -x, v[1]], [-y, x, 0, v[2]], [0, 0, 0, 0]])
        T.append(T[-1] @ expm(twist * turned))
    for i, ends in enumerate(model.ends_m(q)):
        moved = T[shape.moved_by[i]]
        np.testing.assert_allclose(shape.ends_m[i] @ moved[:3, :3].T + moved[:3, 3], ends, atol=1e-12)
    tcp = model.pose(q, np.zeros(6)).T_world_tcp[:3, 3]
    np.testing.assert_allclose(T[-1][:3, :3] @ shape.tcp_m + T[-1][:3, 3], tcp, atol=1e-12)


def test_a_scene_has_25_instants_a_second_of_every_table(scene: ReplayScene) -> None:
    assert np.diff(scene.t_ns).tolist() == [40_000_000] * (len(scene.t_ns) - 1)
    assert len(scene.t_ns) == 200
    assert list(scene.methods) == ["qp", "scaling"]
    np.testing.assert_allclose(scene.methods["qp"].q, joints(scene.seconds)[0], atol=1e-9)
    want = skeleton(pose(scene.seconds), np.tile(LENGTHS_M, (200, 1)))[:, [POINTS.index(name) for name in SHOWN_POINTS]]
    known = scene.seconds >= 0.5
    assert np.isnan(scene.points_m[~known]).all()
    assert np.abs(scene.points_m[known] - want[known]).max() < 0.05  # the fused person is a little off
    np.testing.assert_allclose(scene.body_m[:, 3, 0], skeleton(pose(scene.seconds), np.tile(LENGTHS_M, (200, 1)))[:, 9])


def test_a_run_of_more_than_ten_minutes_has_fewer_instants(scene: ReplayScene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay_scene, "WHOLE_S", 4.0)  # so that 8 s are as twenty minutes
    thin = moving_scene(moving_run(8.0))
    assert thin.t_ns.tolist() == scene.t_ns[::2].tolist()
    shown_ns, all_ns = np.unique(thin.volumes.t_ns), np.unique(scene.volumes.t_ns)
    assert np.diff(shown_ns).min() >= 1e9 / LONG_VOLUME_HZ - 1
    assert len(all_ns) == pytest.approx(VOLUME_HZ / LONG_VOLUME_HZ * len(shown_ns), abs=3.0)
    header = json.loads(replay_data(thin)[0])
    assert header["volumes"]["rate_hz"] == LONG_VOLUME_HZ
    assert len(header["volumes"]["at_s"]) == len(thin.volumes.t_ns)
    assert (thin.rate_hz, scene.rate_hz) == (12.5, 25.0)
    np.testing.assert_array_equal(thin.methods["qp"].q, scene.methods["qp"].q[::2])
    assert json.loads(replay_data(thin)[0])["rate_hz"] == 12.5


def test_a_certified_stop_ends_where_it_would(scene: ReplayScene) -> None:
    """On the way of the velocity, half of its time on: as the controller's own stop of that many ticks."""
    q, dq = joints(scene.seconds)
    ticks = 50
    limit = np.abs(dq[77]).max() / (ticks * 0.004) * (1 + 1e-9)
    stop = stop_straight(q[77], dq[77], np.full(6, limit), 0.004)
    assert stop.ticks == ticks  # 0.2 s, as the made-up table has it
    np.testing.assert_allclose(scene.methods["qp"].stop_q[77], stop.q[-1], atol=1e-9)


def test_a_stop_without_certificates_is_that_of_each_axis() -> None:
    run = moving_run(2.0)
    plain = dataclasses.replace(run, meta={**run.meta, "settings": {"plan": {"method": "qp", "certify": False}}})
    found = moving_scene(plain).methods["qp"]
    q, dq = joints(np.array([0.4]))
    np.testing.assert_allclose(
        found.stop_q[10], stop_axis_by_axis(q[0], dq[0], robot(run).ddq_max, 0.01).q[-1], atol=1e-9
    )


def test_a_stop_on_the_path_stays_on_it(scene: ReplayScene) -> None:
    """The made-up baseline's joints follow the clock, so each programmed time has its joints."""
    run = moving_run(8.0)
    table = run.baselines["scaling"]
    s_s = table["programme_s"].to_numpy()
    rate = np.gradient(s_s, 0.01)
    row = 4 * 20
    s_end = s_s[row] + rate[row] * 0.1
    clock_s = np.interp(s_end, s_s, np.arange(len(s_s)) * 0.01)
    np.testing.assert_allclose(scene.methods["scaling"].stop_q[20], joints(np.array([clock_s]))[0][0], atol=2e-3)


def test_every_stop_on_the_path_ends_between_the_driven_joints_beside_it(scene: ReplayScene) -> None:
    """Held against scipy's interpolation over all that was driven."""
    table = frame_of(moving_run(8.0).baselines["scaling"])
    driven = table.drop_duplicates("programme_s").sort_values("programme_s")
    every = interp1d(driven["programme_s"], driven[[f"q{i}" for i in range(1, 7)]], axis=0)
    s_s = table["programme_s"].to_numpy()
    rows = np.searchsorted(table["t_ns"].to_numpy(), scene.t_ns, side="right") - 1
    ends_s = s_s[rows] + np.gradient(s_s, table["t_ns"].to_numpy() * 1e-9)[rows] * 0.1
    within = ends_s <= s_s[-1]
    assert within.sum() > 150
    np.testing.assert_allclose(scene.methods["scaling"].stop_q[within], every(ends_s[within]), atol=1e-9)


def test_stops_on_the_path_end_also_between_joints_that_the_robot_without_a_person_drove() -> None:
    run = moving_run(8.0)
    table = frame_of(run.baselines["scaling"])
    alone = table.assign(programme_s=table["programme_s"] * 1.1 + 0.0037)
    alone = alone.assign(**{f"q{i}": table[f"q{i}"] + 0.01 for i in range(1, 7)})
    found = moving_scene(dataclasses.replace(run, baselines={**run.baselines, "none": alone}))
    driven = pd.concat([table, alone]).drop_duplicates("programme_s").sort_values("programme_s")
    every = interp1d(driven["programme_s"], driven[[f"q{i}" for i in range(1, 7)]], axis=0)
    s_s = table["programme_s"].to_numpy()
    rows = np.searchsorted(table["t_ns"].to_numpy(), found.t_ns, side="right") - 1
    ends_s = s_s[rows] + np.gradient(s_s, table["t_ns"].to_numpy() * 1e-9)[rows] * 0.1
    np.testing.assert_allclose(found.methods["scaling"].stop_q, every(ends_s), atol=1e-9)


def test_the_list_of_stops_has_each_once() -> None:
    run = moving_run(8.0)
    assert run.motion is not None
    assert run.contact is not None
    t_s = (run.motion["t_ns"].to_numpy() - T0_NS) * 1e-9
    braking = ((t_s >= 2.0) & (t_s < 2.3)) | ((t_s >= 2.35) & (t_s < 2.5)) | ((t_s >= 6.0) & (t_s < 6.1))
    still = (t_s >= 2.5) & (t_s < 3.1)
    dq = {f"dq{i}": np.where(still, 0.0, run.motion[f"dq{i}"]) for i in range(1, 7)}
    motion = run.motion.assign(
        **dq,
        status=np.where(braking | still, "braking", "tracking"),
        reason=np.where(braking, "not certified", ""),
        tcp_speed=np.where(still, 0.0, 0.4),
        distance_m=0.3,
        link=[f"link at {at_s:.2f} s" for at_s in t_s],
    )
    first, second = stop_events(motion, run.contact[run.contact["method"] == "qp"], T0_NS, 0.001)
    assert (first.kind, first.reason, first.link, first.limb) == ("stop", "not certified", "link at 2.00 s", "LRA")
    assert (first.at_s, first.moving_s, first.rest_s) == pytest.approx((2.0, 0.45, 0.6))
    assert (first.speed_m_per_s, first.distance_m) == pytest.approx((0.4, 0.3))
    assert (second.at_s, second.moving_s, second.rest_s) == pytest.approx((6.0, 0.1, 0.0))
    for_good = motion.assign(**{name: np.where(t_s >= 6.1, 0.0, motion[name]) for name in (*dq, "tcp_speed")})
    *_, last = stop_events(for_good, None, T0_NS, 0.001)
    assert (last.at_s, last.moving_s, last.rest_s) == pytest.approx((6.0, 0.1, t_s[-1] + 0.01 - 6.1))
    near = run.contact[run.contact["method"] == "scaling"]
    near = near.assign(link=[f"{distance_m:.3f} m" for distance_m in near["distance_m"]])
    (touch,) = stop_events(motion.assign(status="tracking"), near, T0_NS, 0.001)
    assert (touch.kind, touch.link) == ("touch", f"{touch.distance_m:.3f} m"), "the link that came nearest"
    assert (touch.at_s, touch.moving_s) == pytest.approx((3.0, 0.5))
    assert (touch.speed_m_per_s, touch.distance_m) == pytest.approx((0.3, -0.02 - 0.01 * 0.49))


def unpacked(header: dict[str, Any], entry: dict[str, Any], stream: bytes) -> Floats:
    """An array of the block again, by other means than the page's."""
    size, at = entry["rows"] * entry["columns"], entry["at"]
    low, high = (np.frombuffer(stream, np.uint8, size, at + k * size).astype(np.uint16) for k in (0, 1))
    steps = (low + 256 * high).astype(np.int16).reshape(entry["columns"], entry["rows"])
    counts = np.cumsum(steps, axis=1, dtype=np.int64).astype(np.int16).T
    return np.where(counts == MISSING, np.nan, counts * entry["unit"])


def test_the_numbers_come_back_to_the_millimetre(scene: ReplayScene) -> None:
    text, numbers = replay_data(scene)
    header = json.loads(text)
    block = base64.b64decode(numbers)
    motion, hulls = zlib.decompress(block[: header["bytes"][0]]), zlib.decompress(block[header["bytes"][0] :])
    points = unpacked(header, header["entries"]["points"], motion)
    np.testing.assert_allclose(points, scene.points_m.reshape(200, -1), atol=0.5001e-3)
    np.testing.assert_allclose(
        unpacked(header, header["entries"]["scaling/q"], motion), scene.methods["scaling"].q, atol=0.51e-4
    )
    entries = header["volumes"]["entries"]
    assert header["volumes"]["limbs"] == list(LIMBS)
    assert header["volumes"]["rate_hz"] == 12.5
    count = unpacked(header, entries["count"], hulls)[:, 0].astype(int)
    vertices = np.split(unpacked(header, entries["vertices"], hulls), np.cumsum(count)[:-1])
    stored = {(int(t), limb): i for i, (t, limb) in enumerate(zip(scene.volumes.t_ns, scene.volumes.limb, strict=True))}
    for at_s, limb, found in zip(
        header["volumes"]["at_s"], unpacked(header, entries["limb"], hulls)[:, 0], vertices, strict=True
    ):
        i = stored[scene.t0_ns + round(at_s * 1e9), int(limb)]
        want = scene.volumes.vertices_m[scene.volumes.offsets[i] : scene.volumes.offsets[i + 1]]
        assert np.abs(found.mean(axis=0) - want.mean(axis=0)).max() < 0.5001e-3  # the order of vertices is another
        np.testing.assert_allclose(np.sort(found[:, 2]), np.sort(want[:, 2]), atol=0.5001e-3)


def test_numbers_too_large_for_16_bits_come_with_larger_steps() -> None:
    block = NumberBlock()
    values = np.array([[-400.0], [np.nan], [123.4], [400.0]])
    block.add("far", values, 1e-3)
    stream = zlib.decompress(block.deflated())
    np.testing.assert_allclose(unpacked({}, block.entries["far"], stream), values, atol=0.51 * 400 / 32767)


def test_a_small_budget_costs_the_volumes_their_rate_and_nothing_else(scene: ReplayScene) -> None:
    whole, numbers = replay_data(scene)
    header = json.loads(whole)
    motion_bytes = header["bytes"][0]
    text, small = replay_data(scene, budget_bytes=len(numbers) // 2)
    assert json.loads(text)["volumes"]["rate_hz"] < header["volumes"]["rate_hz"]
    assert len(small) <= len(numbers) // 2
    assert base64.b64decode(small)[:motion_bytes] == base64.b64decode(numbers)[:motion_bytes]
    none = json.loads(replay_data(scene, budget_bytes=motion_bytes)[0])
    assert none["volumes"]["rate_hz"] is None
    assert none["volumes"]["at_s"] == []


def test_hulls_that_are_stored_a_few_at_a_time_give_the_same_block(
    scene: ReplayScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = replay_data(scene)
    monkeypatch.setattr(replay_page, "_TOGETHER", 5)
    assert replay_data(scene) == whole
    far = dataclasses.replace(
        scene, volumes=dataclasses.replace(scene.volumes, vertices_m=scene.volumes.vertices_m * 50.0)
    )
    text, numbers = replay_data(far)
    header = json.loads(text)
    entry = header["volumes"]["entries"]["vertices"]
    assert entry["unit"] == pytest.approx(np.abs(far.volumes.vertices_m).max() / 32767)
    hulls = zlib.decompress(base64.b64decode(numbers)[header["bytes"][0] :])
    largest = np.abs(unpacked(header, entry, hulls)).max()
    assert largest == pytest.approx(np.abs(far.volumes.vertices_m).max(), rel=1e-4)


def test_a_run_without_a_recorded_body_has_a_block_too() -> None:
    run = moving_run(3.0)
    header = json.loads(replay_data(moving_scene(dataclasses.replace(run, body=None, contact=None)))[0])
    assert (header["entries"]["body"]["rows"], header["entries"]["body"]["columns"]) == (header["count"], 0)
    assert header["entries"]["points"]["columns"] == 3 * len(SHOWN_POINTS)


def test_the_same_run_gives_the_same_block() -> None:
    first, second = (replay_data(moving_scene(moving_run(3.0))) for _ in range(2))
    assert first == second


def test_the_page_has_the_surfaces_of_objects(scene: ReplayScene) -> None:
    corners = np.array([[x, y, z] for x in (0.4, 1.0) for y in (-0.5, 0.5) for z in (0.70, 0.74)])
    one = dataclasses.replace(scene, objects=(StaticHull("table", corners, 0.0),))
    (shown,) = json.loads(replay_data(one)[0])["objects"]
    assert shown["name"] == "table"
    assert sorted(np.reshape(shown["corners"], (-1, 3)).tolist()) == sorted(corners.tolist())
    assert sorted(set(shown["triangles"])) == list(range(8))
    assert len(shown["triangles"]) == 36
    assert "objects" not in json.loads(replay_data(scene)[0])


def test_volumes_and_skeletons_are_the_same_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside those of the tables, row by row; parts end within a table."""
    run = moving_run(4.0)
    assert run.occupancy is not None
    assert run.measurements is not None
    monkeypatch.setattr(replay_scene, "_TOGETHER", 11)
    occupancy = frame_of(run.occupancy)
    occupancy["vertices"] = [hull[: 3 * (2 + k % 5)] for k, hull in enumerate(occupancy["vertices"])]  # all unlike
    track, shown = volume_track(occupancy, VOLUME_HZ), occupancy.iloc[at_rate(occupancy["t_ns"].to_numpy(), VOLUME_HZ)]
    assert len(track.t_ns) == len(shown) > 11
    for i, (_, row) in enumerate(shown.iterrows()):
        assert (track.t_ns[i], track.limbs[track.limb[i]], track.radius_m[i]) == (row.t_ns, row.limb, row.radius_m)
        hull = track.vertices_m[track.offsets[i] : track.offsets[i + 1]]
        np.testing.assert_array_equal(hull, np.reshape(row.vertices, (-1, 3)))
    late = frame_of(run.measurements).iloc[::-1]  # by arrival, in whatever order they are stored
    for camera in sorted(set(late["camera"])):
        rows = late[late["camera"] == camera].sort_values("arrival_ns", kind="stable")
        found = list(shown_skeletons(late, camera))
        assert [t_ns for t_ns, _, _ in found] == rows["arrival_ns"].tolist()
        assert {number for _, _, number in found} == {1}
        want = skeleton(rows[list(JOINTS)].to_numpy(dtype=float), rows[list(LENGTHS)].to_numpy(dtype=float))
        np.testing.assert_array_equal(np.array([points for _, points, _ in found]), want)
        assert len(found) > 11
