from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hrcreplay.egm.robot_double.faults import KINDS, Fault
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.live.record import codec
from hrcreplay.live.record.codec import Decision, Signal, TickEvent
from hrcreplay.live.verify import Verdict, verify
from hrcreplay.records import DOF
from hrcreplay.run import replay
from hrcreplay.store import run_folder
from tests.live import made
from tests.live.flights import BEGIN_NS, Flight


@pytest.fixture(scope="module")
def messages() -> list[bytes]:
    return list(made.session(60))


def _verdict(folder: Path, messages: list[bytes], build: type[made.MadeController] = made.MadeController) -> Verdict:
    """What is said of a killed session with this record."""
    run = folder / "run.partial"
    shutil.rmtree(run, ignore_errors=True)
    run.mkdir()
    made.record(run / "log.mcap", messages, finish=False)
    return verify(run, build)


def _at(messages: list[bytes], kind: bytes, number: int) -> int:
    return [i for i, message in enumerate(messages) if codec.kind(message) == kind][number]


def _float(message: bytes, offset: int, change: float) -> bytes:
    (value,) = struct.unpack_from("<d", message, offset)
    return message[:offset] + struct.pack("<d", value + change) + message[offset + 8 :]


def test_the_same_again_is_identical(tmp_path: Path, messages: list[bytes]) -> None:
    verdict = _verdict(tmp_path, messages)
    assert verdict.identical
    (line,) = verdict.lines
    assert line.startswith("identical: 60 ticks, 60 looks; the record breaks off: ")
    run = tmp_path / "whole"
    run.mkdir()
    made.record(run / "log.mcap", messages)
    meta = {"complete": True, "outputs": {"log.mcap": run_folder.sha256(run / "log.mcap")}}
    (run / "run.json").write_text(json.dumps(meta))
    assert verify(run, made.MadeController) == Verdict(identical=True, lines=("identical: 60 ticks, 60 looks",))


class Drifting(made.MadeController):
    """Decides one thing otherwise from the 20th answer on."""

    answers = 0

    def answer(self, event: TickEvent) -> Decision:
        self.answers += 1
        if self.answers == 20:
            self.q[2] += 1e-15
        return super().answer(event)


def test_the_first_tick_and_quantity_that_differ_are_named(tmp_path: Path, messages: list[bytes]) -> None:
    verdict = _verdict(tmp_path, messages, Drifting)
    assert not verdict.identical
    recorded = codec.decode_decision(messages[_at(messages, codec.DECISION, 19)]).row
    assert recorded is not None
    seconds = 20 * made.TICK_NS / 1e9
    q = float(recorded[2])  # of q_measured, which this controller derives from q
    assert verdict.lines[0].startswith(f"tick 19 at {seconds:.3f} s: q_measured3: recorded {q!r}, again ")
    assert verdict.lines[0] != f"tick 19 at {seconds:.3f} s: q_measured3: recorded {q!r}, again {q!r}"
    assert verdict.lines[-1] == "identical until then: 20 ticks"


@pytest.mark.parametrize(
    ("kind", "number", "offset", "names"),
    [
        (codec.PERCEPTION, 7, struct.calcsize("<cqHHHH") + 8 * (DOF + 3), "rho_vel: recorded "),
        (codec.PERCEPTION, 7, struct.calcsize("<cqHHHH") + 8 * (6 * DOF + 6), "pi_forearm_r: recorded "),
        (codec.DECISION, 7, struct.calcsize("<cqqIIBBhhH") + 1 + 8 * 17, "dq6: recorded "),
        (codec.DECISION, 7, struct.calcsize("<cqqIIBBhhH") + 1 + 8 * 33, "distance_m: recorded 1.25, again 0.25"),
        (codec.VOLUMES, 1, struct.calcsize("<cqHId") + 8 * (7 + 6) + 8 * 4, "vertex 1 of HD, y: recorded "),
        (codec.VOLUMES, 1, struct.calcsize("<cqHId") + 8 * (7 + 5), "radius of LLA: recorded 1.1, again 0.1"),
    ],
)
def test_changed_numbers_are_named(
    tmp_path: Path, messages: list[bytes], kind: bytes, number: int, offset: int, names: str
) -> None:
    changed, at = list(messages), _at(messages, kind, number)
    changed[at] = _float(changed[at], offset, 1.0)
    verdict = _verdict(tmp_path, changed)
    tick = 10 if kind == codec.VOLUMES else 7
    assert verdict.lines[0].startswith(f"tick {tick} at ")
    assert f" s: {names}" in verdict.lines[0]


def test_changed_decisions_and_replies_are_named(tmp_path: Path, messages: list[bytes]) -> None:
    at = _at(messages, codec.DECISION, 58)
    assert codec.decode_decision(messages[at]).reason == "Ctrl-C"
    changed = list(messages)
    changed[at] = changed[at].replace(b"Ctrl-C", b"SIGINT")
    assert "tick 58 at" in (line := _verdict(tmp_path, changed).lines[0])
    assert line.endswith("s: reason: recorded 'SIGINT', again 'Ctrl-C'")

    changed = list(messages)
    changed[at + 1] = changed[at + 1][:-3] + bytes([changed[at + 1][-3] ^ 1]) + changed[at + 1][-2:]
    reply = codec.decode_reply(messages[at + 1])[1]
    value = reply[-3]
    assert (
        _verdict(tmp_path, changed)
        .lines[0]
        .endswith(f"s: byte {len(reply) - 3} of the reply: recorded {value ^ 1}, again {value}")
    )

    changed = list(messages)
    del changed[at + 1]
    assert _verdict(tmp_path, changed).lines[0].endswith(f"s: reply: recorded 'none', again '{len(reply)} bytes'")


def test_a_volume_that_is_not_stored_is_compared_by_digest(tmp_path: Path, messages: list[bytes]) -> None:
    changed, at = list(messages), _at(messages, codec.PERCEPTION, 7)
    changed[at] = changed[at][:-1] + bytes([changed[at][-1] ^ 64])
    assert "s: volume of LLA (digest): recorded '" in _verdict(tmp_path, changed).lines[0]
    at = _at(messages, codec.PERCEPTION, -1)
    changed = [*messages[:at], messages[at][:-1] + bytes([messages[at][-1] ^ 64])]
    assert "tick 59 at" in _verdict(tmp_path, changed).lines[0]  # nothing follows it


@pytest.mark.parametrize(
    ("kind", "number"), [(codec.ROBOT, 5), (codec.SKELETON, 3), (codec.TIMEOUT, 0), (codec.EVENT, 0)]
)
def test_inputs_that_are_missing_or_changed_show(
    tmp_path: Path, messages: list[bytes], kind: bytes, number: int
) -> None:
    at = _at(messages, kind, number)
    if kind == codec.EVENT:
        with pytest.raises(LogError, match="does not begin with the start"):
            _verdict(tmp_path, messages[1:])
        return
    verdict = _verdict(tmp_path, messages[:at] + messages[at + 1 :])
    assert not verdict.identical
    if kind != codec.TIMEOUT:
        assert "s: the record has " in verdict.lines[0]


def test_any_nan_is_like_any_other(tmp_path: Path, messages: list[bytes]) -> None:
    changed = list(messages)
    quiet, other = struct.pack("<d", np.nan), b"\x01\0\0\0\0\0\xf8\xff"
    for i, message in enumerate(messages):
        if codec.kind(message) == codec.PERCEPTION:
            changed[i] = message.replace(quiet, other)
            assert changed[i] != message
    assert _verdict(tmp_path, changed).identical


def test_a_look_that_failed_fails_again(tmp_path: Path, messages: list[bytes]) -> None:
    class Blind(made.MadeController):
        def update_perception(self, t_ns: int, skeletons: object) -> None:  # type: ignore[override]
            """A bug."""

    t_ns = made.START_NS + 10
    record = [messages[0], codec.encode_skeleton(t_ns, made.skeleton(0)), codec.encode_event(t_ns, {"what": "blind"})]
    assert _verdict(tmp_path, record, Blind).identical
    assert "look: recorded 'failed'" in _verdict(tmp_path, record).lines[0]


def test_a_flipped_bit_is_named_with_its_chunk(tmp_path: Path, messages: list[bytes]) -> None:
    run = tmp_path / "run.partial"
    run.mkdir()
    path = made.record(run / "log.mcap", messages)
    data = bytearray(path.read_bytes())
    at = len(data) // 2
    data[at] ^= 4
    path.write_bytes(data)
    verdict = verify(run, made.MadeController)
    assert not verdict.identical
    assert verdict.lines[0].startswith(f"{path}: byte ")
    assert "between 0." in verdict.lines[0]
    assert int(verdict.lines[0].split("byte ")[1].split(",")[0]) <= at
    assert verdict.lines[-1].startswith("identical until then: ")


def test_a_changed_file_of_a_complete_session_is_named(tmp_path: Path, messages: list[bytes]) -> None:
    made.record(tmp_path / "log.mcap", messages)
    outputs = {"log.mcap": run_folder.sha256(tmp_path / "log.mcap"), "motion.parquet": "0" * 64, "gone.svg": "0" * 64}
    (tmp_path / "run.json").write_text(json.dumps({"complete": True, "outputs": outputs}))
    (tmp_path / "motion.parquet").write_text("")
    lines = verify(tmp_path, made.MadeController).lines
    assert lines[:2] == (
        f"{tmp_path / 'gone.svg'}: is gone",
        f"{tmp_path / 'motion.parquet'}: is not as the run left it",
    )


@pytest.fixture(scope="module")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("replay")
    log = shutil.copyfile(replay.demo_log(), folder / "demo.mcap")
    return replay.run("plan", log, out=folder / "run", end_s=2.0)


def test_a_replay_comes_out_the_same_again(replayed: Path) -> None:
    assert verify(replayed) == Verdict(identical=True, lines=("identical",))


def test_a_replay_that_does_not_is_named_by_row_and_column(replayed: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(replayed, run)
    table = pq.read_table(run / "motion.parquet")
    q3 = table.column("q3").to_numpy().copy()
    was = float(q3[7])
    q3[7:] += 1e-12
    table = table.set_column(table.column_names.index("q3"), "q3", pa.array(q3))
    pq.write_table(table, run / "motion.parquet")
    changed = verify(run).lines
    assert changed == (f"{run / 'motion.parquet'}: is not as the run left it",)  # it came out the same all the same

    meta = json.loads((run / "run.json").read_text())
    meta["outputs"]["motion.parquet"] = run_folder.sha256(run / "motion.parquet")
    meta["versions"]["numpy"] = "1.0"
    (run / "run.json").write_text(json.dumps(meta))
    lines = verify(run).lines
    assert lines[0] == f"motion.parquet: row 7, q3: recorded {float(q3[7])!r}, again {was!r}"
    assert lines[1].startswith("versions of numpy: recorded 1.0, now ")


def test_a_replay_of_another_log_is_not_run(replayed: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    meta = json.loads((replayed / "run.json").read_text())
    log = Path(meta["inputs"][0]["path"])
    other = tmp_path / "other.mcap"
    other.write_bytes(log.read_bytes() + b"\0")
    (run / "run.json").write_text(json.dumps(meta | {"inputs": [meta["inputs"][0] | {"path": str(other)}]}))
    assert verify(run).lines[0].startswith(f"{other}: is not the log of this run: SHA-256 recorded ")
    other.unlink()
    with pytest.raises(LogError, match="is gone"):
        verify(run)
    (run / "run.json").write_text(json.dumps(meta | {"command": "audit"}))
    with pytest.raises(SettingsError, match="a run of audit"):
        verify(run)
    with pytest.raises(SettingsError, match="no run folder"):
        verify(tmp_path / "nothing")


def test_signals_are_part_of_what_is_told(tmp_path: Path, messages: list[bytes]) -> None:
    changed, at = list(messages), _at(messages, codec.DECISION, 30)
    offset = struct.calcsize("<cqqI")
    changed[at] = changed[at][:offset] + struct.pack("<I", Signal.INTERRUPT) + changed[at][offset + 4 :]
    assert "status: recorded 'tracking', again 'braking'" in _verdict(tmp_path, changed).lines[0]


def test_a_session_with_every_fault_is_identical(tmp_path: Path) -> None:
    faults = tuple(
        Fault(kind=kind, at_s=1.0 + 0.3 * k, duration_s=0.06, direction="both") for k, kind in enumerate(KINDS)
    )
    flight = Flight(overrides=("live.resume=true", "live.resume_s=0.05"), faults=faults)
    flight.fly(1.3 + 0.3 * len(KINDS))
    assert len(flight.controller.stops) >= 3
    run = tmp_path / "run.partial"
    run.mkdir()
    made.record(run / "log.mcap", [codec.encode_event(BEGIN_NS - 1, flight.start), *flight.messages], chunk=500)
    verdict = verify(run)
    assert verdict.identical, verdict.lines
