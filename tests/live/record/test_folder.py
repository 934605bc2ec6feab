from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from hrcreplay.commands import replay
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.live.control.setup import run_config_of
from hrcreplay.live.record import codec, folder
from hrcreplay.live.record.codec import PHASES, Signal
from hrcreplay.live.verify import verify
from hrcreplay.records import BODY, STATUSES
from hrcreplay.store import run_folder
from hrcreplay.store.columns import read_states
from tests.facts import facts
from tests.live import made
from tests.live.flights import BEGIN_NS, Flight


class Stored(Flight):
    """A flight that keeps the volumes of every tenth look, as the loop does at 25 Hz."""

    def _update_perception(self, t_ns: int) -> None:
        super()._update_perception(t_ns)
        perception = self.controller.perception
        if perception is not None and len(self.states) % 10 == 1:
            self.messages.append(codec.encode_volumes(perception))


@pytest.fixture(scope="module")
def flight() -> Flight:
    """Somebody comes near; Ctrl-C after 2 s. By the method with the most limbs."""
    return Stored(
        overrides=("prediction.method=sound",),
        walk=lambda s: (3.0 - 0.9 * s, 0.2),
        signals=lambda s: Signal.INTERRUPT if s > 2.0 else Signal.NONE,
    ).fly(2.3)


@pytest.fixture(scope="module")
def messages(flight: Flight) -> list[bytes]:
    end = {"what": "end", "reason": "Ctrl-C", "counts": {"robot lost": 2}, "dropped": 0, "looks_skipped": 3}
    end |= {"stops": []}
    start = {"what": "start", **flight.start}
    note = codec.encode_event(BEGIN_NS + 2, {"what": "note", "text": "a remark"})
    return [
        codec.encode_event(BEGIN_NS - 1, start),
        *flight.messages,
        note,
        codec.encode_event(BEGIN_NS + 4_000_000_000, end),
    ]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, messages: list[bytes]) -> Path:
    partial = folder.make_partial(tmp_path_factory.mktemp("runs") / "session")
    made.record(partial / "log.mcap", messages, chunk=500)
    return folder.finish(partial)


def test_the_session_is_a_run_like_any_other(run: Path, flight: Flight) -> None:
    assert not run.with_name("session.partial").exists()
    meta = run_folder.read_meta(run)
    assert meta["command"] == "live"
    assert meta["T_world_base"] == flight.start["T_world_base"]
    assert meta["reason"] == "Ctrl-C"
    assert meta["notes"] == ["a remark"]
    assert meta["created"] == "2027-01-15T07:59:59Z"
    assert meta["inputs"] == [{"path": "log.mcap", "sha256": run_folder.sha256(run / "log.mcap")}]
    assert meta["counts"]["robot_lost"] == 2
    assert meta["counts"]["looks_skipped"] == 3
    assert meta["counts"]["answers"] == len(flight.answers)
    assert {*meta["outputs"]} >= {"log.mcap", "state.parquet", "motion.parquet", "contact.parquet", "report.html"}
    assert meta["outputs"] == {name: run_folder.sha256(run / name) for name in meta["outputs"]}
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["ticks"]["value"] == len(flight.states)
    assert metrics["camera_kinect_frames"]["value"] == len(flight.frames) / 2
    assert json.loads((run / "timing.json").read_text())["reply"]["ticks"] == len(flight.said())


def test_states_are_those_of_the_session(run: Path, flight: Flight) -> None:
    (table,) = read_states(run / "state.parquet", 100_000)
    for name in ("t_ns", "p", "v", "a", "j", "p_std", "v_std", "lengths_m", "lengths_std_m", "residual_m", "unseen_s"):
        wanted = np.concatenate([getattr(state, name) for state in flight.states])
        np.testing.assert_array_equal(getattr(table, name), wanted)
    np.testing.assert_array_equal(table.valid, np.concatenate([state.valid for state in flight.states]))
    assert table.cameras == flight.states[0].cameras


def test_a_record_of_another_format_is_refused(flight: Flight) -> None:
    assert run_config_of(flight.start, Path("log.mcap"), "").command == "live"
    older = {name: value for name, value in flight.start.items() if name != "record"}
    for start, found in ((older, "1"), (flight.start | {"record": 99}, "99")):
        with pytest.raises(LogError, match=facts("log.mcap", f"format {found}", f"format {codec.FORMAT}", "version")):
            run_config_of(start, Path("log.mcap"), "")


def test_motions_are_those_of_the_session(run: Path, flight: Flight) -> None:
    table = pd.read_parquet(run / "motion.parquet")
    rows = [(answer, answer.row) for answer in flight.answers if answer.row is not None]
    assert len(table) == len(rows)
    measured = [answer.measured for answer, _ in rows]
    np.testing.assert_array_equal(table[[f"q_measured{i}" for i in range(1, 7)]], measured)
    for column in ("q", "dq", "u"):
        wanted = np.array([getattr(row, column) for _, row in rows])
        np.testing.assert_array_equal(table[[f"{column}{i}" for i in range(1, 7)]], wanted)
    np.testing.assert_array_equal(table[["tcp_x", "tcp_y", "tcp_z"]], [row.tcp_m for _, row in rows])
    np.testing.assert_array_equal(table["distance_m"], [row.distance_m for _, row in rows])
    np.testing.assert_array_equal(table["overlap_m"], [row.overlap_m for _, row in rows])
    assert table["phase"].tolist() == [PHASES[answer.phase] for answer, _ in rows]
    assert table["status"].tolist() == [STATUSES[answer.status] for answer, _ in rows]
    assert table["reason"].tolist() == [answer.reason for answer, _ in rows]
    assert set(table["limb"].dropna()) <= set(BODY)
    links = [segment.name for segment in flight.robot.segments]
    assert table["link"].dropna().tolist() == [links[answer.link] for answer, _ in rows if answer.link >= 0]


def test_volumes_are_those_that_were_stored(run: Path, messages: list[bytes]) -> None:
    table = pd.read_parquet(run / "occupancy.parquet")
    stored = [codec.decode_volumes(m, BODY, "").volumes for m in messages if codec.kind(m) == codec.VOLUMES]
    known = [volumes for volumes in stored if np.isfinite(volumes.vertices_m).all()]
    assert sorted(set(table["t_ns"])) == [int(volumes.t_ns[0]) for volumes in known]
    last = table[table["t_ns"] == known[-1].t_ns[0]]
    assert last["limb"].tolist() == list(BODY)
    for i, row in enumerate(last.itertuples()):
        given = {tuple(vertex) for vertex in known[-1].vertices(0, i).tolist()}
        assert {tuple(vertex) for vertex in np.reshape(row.vertices, (-1, 3)).tolist()} <= given


def test_a_real_pilot_says_the_same_again(run: Path) -> None:
    verdict = verify(run)
    assert verdict.identical, verdict.lines


def test_the_record_can_be_replayed(run: Path, tmp_path: Path) -> None:
    own = replay.run("plan", run, out=tmp_path / "a", end_s=1.0)  # with the settings of the session
    log = replay.run("plan", run / "log.mcap", out=tmp_path / "b", end_s=1.0, overrides=("prediction.method=sound",))
    assert run_folder.read_meta(own)["outputs"] == run_folder.read_meta(log)["outputs"]
    assert run_folder.read_meta(log)["T_world_base"] == run_folder.read_meta(run)["T_world_base"]


def test_a_killed_session_can_be_finished(
    tmp_path: Path, messages: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(folder, "write_report", lambda *_: None)  # it takes long, and is the same for any session
    partial = folder.make_partial(tmp_path / "session")
    with pytest.raises(SettingsError, match=facts("session.partial", "under way")):
        folder.make_partial(tmp_path / "session")
    assert json.loads((partial / "run.json").read_text()) == {"complete": False}
    made.record(partial / "log.mcap", messages[:800], chunk=300, finish=False)
    assert verify(partial).identical
    run = folder.finish(partial)
    assert run == tmp_path / "session"
    assert run_folder.read_meta(run)["notes"] == [folder.NO_END]
    assert verify(run).identical
    with pytest.raises(SettingsError, match=facts(str(run), "finished")):
        folder.finish(run)
    with pytest.raises(SettingsError, match=facts(str(run), "exists")):
        folder.make_partial(run)


def test_a_session_in_which_nothing_happened_is_a_run(tmp_path: Path, messages: list[bytes]) -> None:
    partial = folder.make_partial(tmp_path / "session")
    made.record(partial / "log.mcap", [messages[0], messages[-1]])
    run = folder.finish(partial)
    assert run_folder.read(run).state is None
    assert verify(run).lines == ("identical: 0 ticks, 0 looks",)


def test_a_record_that_cannot_be_read_is_left_as_it_is(tmp_path: Path, messages: list[bytes]) -> None:
    partial = folder.make_partial(tmp_path / "session")
    made.record(partial / "log.mcap", messages[1:100])
    with pytest.raises(LogError, match=facts(str(partial), "start")):
        folder.finish(partial)
    assert (partial / "log.mcap").exists()
    (tmp_path / "session").mkdir()
    with pytest.raises(SettingsError, match=facts(str(tmp_path / "session"), "exists")):
        folder.finish(partial)
    shutil.rmtree(partial)


def test_a_record_of_another_version_is_left_as_it_is(tmp_path: Path, messages: list[bytes], flight: Flight) -> None:
    perception = flight.controller.perception
    assert perception is not None
    other = replace(perception.states, residual_m=perception.states.residual_m[:, 1:])
    partial = folder.make_partial(tmp_path / "session")
    made.record(partial / "log.mcap", [messages[0], codec.encode_perception(replace(perception, states=other), 0)])
    with pytest.raises(LogError, match=facts("session.partial", "287", "288")):
        folder.finish(partial)
    assert (partial / "log.mcap").exists()
