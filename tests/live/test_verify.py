from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hrcreplay.commands import replay
from hrcreplay.egm import motion_link_pb2 as egm
from hrcreplay.egm.robot_double.faults import KINDS, Fault
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.live.record import codec
from hrcreplay.live.record.codec import Decision, Perception, Signal, TickEvent
from hrcreplay.live.record.recorder import SessionLogReader
from hrcreplay.live.verify import Agreement, Verdict, verify
from hrcreplay.pipeline.run_config import versions
from hrcreplay.records import DOF
from hrcreplay.store import run_folder
from hrcreplay.store.machine import describe_machine
from tests.facts import facts, tells
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
    assert tells(line, "identical", "60 ticks, 60 looks", "breaks off")
    run = tmp_path / "whole"
    run.mkdir()
    made.record(run / "log.mcap", messages)
    meta = {"complete": True, "outputs": {"log.mcap": run_folder.sha256(run / "log.mcap")}}
    (run / "run.json").write_text(json.dumps(meta))
    assert verify(run, made.MadeController) == Verdict(Agreement.IDENTICAL, lines=("identical: 60 ticks, 60 looks",))


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
    recorded = codec.decode_decision(messages[_at(messages, codec.DECISION, 19)])
    seconds = 20 * made.TICK_NS / 1e9
    q = float(recorded.measured[2])  # which this controller derives from q
    assert verdict.lines[0].startswith(f"tick 19 at {seconds:.3f} s: q_measured3: recorded {q!r}, again ")
    assert verdict.lines[0] != f"tick 19 at {seconds:.3f} s: q_measured3: recorded {q!r}, again {q!r}"
    assert verdict.lines[-1] == "identical until then: 20 ticks"


@pytest.mark.parametrize(
    ("kind", "number", "offset", "names"),
    [
        (codec.PERCEPTION, 7, struct.calcsize("<cqHHHHH") + 8 + 8 * (DOF + 3), "rho_vel: recorded "),
        (codec.PERCEPTION, 7, struct.calcsize("<cqHHHHH") + 8 + 8 * (6 * DOF + 6), "pi_forearm_r: recorded "),
        (codec.DECISION, 7, struct.calcsize("<cqqIIBBhhHB") + 8 * 17, "dq6: recorded "),
        (codec.DECISION, 7, struct.calcsize("<cqqIIBBhhHB") + 8 * 33, "distance_m: recorded 1.25, again 0.25"),
        (codec.VOLUMES, 1, struct.calcsize("<cqHHId") + 8 * (8 + 6) + 8 * 4, "vertex 1 of HD, y: recorded "),
        (codec.VOLUMES, 1, struct.calcsize("<cqHHId") + 8 * (8 + 5), "radius of LLA: recorded 1.1, again 0.1"),
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
    replies = [codec.decode_reply(one[at + 1])[1] for one in (changed, messages)]
    mine, yours = (egm.SensorMessage.FromString(reply).planned.joints.joints[5] for reply in replies)
    line = _verdict(tmp_path, changed).lines[0]
    assert f"s: reply.planned.joints.joints[5]: recorded {mine!r}, again {yours!r}" in line

    changed = list(messages)
    del changed[at + 1]
    line = _verdict(tmp_path, changed).lines[0]
    assert line.endswith(f"s: reply: recorded 'none', again '{len(replies[1])} bytes'")


def test_a_volume_that_is_not_stored_is_compared_by_digest(tmp_path: Path, messages: list[bytes]) -> None:
    changed, at = list(messages), _at(messages, codec.PERCEPTION, 7)
    changed[at] = changed[at][:-1] + bytes([changed[at][-1] ^ 64])
    assert tells(_verdict(tmp_path, changed).lines[0], "volume of LLA (digest)")
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
        with pytest.raises(LogError, match="start"):
            _verdict(tmp_path, messages[1:])
        return
    verdict = _verdict(tmp_path, messages[:at] + messages[at + 1 :])
    assert not verdict.identical
    if kind != codec.TIMEOUT:
        assert tells(verdict.lines[0], "record")


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
    assert tells(lines[0], str(tmp_path / "gone.svg"), "gone")
    assert tells(lines[1], str(tmp_path / "motion.parquet"))
    assert not tells(lines, str(tmp_path / "log.mcap"), "left")


@pytest.fixture(scope="module")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("replay")
    log = shutil.copyfile(replay.demo_log(), folder / "demo.mcap")
    return replay.run("plan", log, out=folder / "run", end_s=2.0)


def test_a_replay_comes_out_the_same_again(replayed: Path) -> None:
    assert verify(replayed) == Verdict(Agreement.IDENTICAL, lines=("identical",))


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
    (line,) = changed  # it came out the same all the same
    assert tells(line, str(run / "motion.parquet"))

    meta = json.loads((run / "run.json").read_text())
    meta["outputs"]["motion.parquet"] = run_folder.sha256(run / "motion.parquet")
    meta["versions"]["numpy"] = "1.0"
    (run / "run.json").write_text(json.dumps(meta))
    lines = verify(run).lines
    assert lines[0] == f"motion.parquet: row 7, q3: recorded {float(q3[7])!r}, again {was!r}, 1.0e-12 apart"
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
    with pytest.raises(LogError, match=facts(str(other), "gone")):
        verify(run)
    (run / "run.json").write_text(json.dumps(meta | {"command": "audit"}))
    with pytest.raises(SettingsError, match=facts("audit")):
        verify(run)
    with pytest.raises(SettingsError, match=facts(str(tmp_path / "nothing"))):
        verify(tmp_path / "nothing")


def test_signals_are_part_of_what_is_told(tmp_path: Path, messages: list[bytes]) -> None:
    changed, at = list(messages), _at(messages, codec.DECISION, 30)
    offset = struct.calcsize("<cqqI")
    changed[at] = changed[at][:offset] + struct.pack("<I", Signal.INTERRUPT) + changed[at][offset + 4 :]
    assert tells(_verdict(tmp_path, changed).lines[0], "status", "'tracking'", "'braking'")


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


OTHER = {**describe_machine(), "processor": "Another CPU", "features": ["sse4_2"]}


@pytest.fixture(scope="module")
def elsewhere(messages: list[bytes]) -> list[bytes]:
    """The same session as another machine records it."""
    start = {**made.START, "machine": OTHER, "versions": versions()}
    return [codec.encode_event(made.START_NS, start), *messages[1:]]


class Rounding(made.MadeController):
    """Rounds otherwise, the person as well as the robot."""

    def update_perception(self, t_ns: int, skeletons: Sequence[bytes]) -> Perception:
        self.p = np.nextafter(self.p, np.inf)
        return super().update_perception(t_ns, skeletons)

    def answer(self, event: TickEvent) -> Decision:
        self.q = np.nextafter(self.q, np.inf)
        return super().answer(event)


def test_another_machine_may_round_otherwise(tmp_path: Path, messages: list[bytes], elsewhere: list[bytes]) -> None:
    verdict = _verdict(tmp_path, elsewhere, Rounding)
    assert verdict.agreement is Agreement.SAME_DECISIONS
    assert not verdict.identical
    first, recorded, here, largest, unstored = verdict.lines
    assert first.startswith("same decisions, numbers within 1e-9 (other processor): 60 ticks, 60 looks")
    assert recorded.startswith("recorded on Another CPU (sse4_2; ")
    assert here.startswith(f"computed again on {describe_machine()['processor']} (")
    assert 0.0 < float(largest.removesuffix(" apart").rpartition(", ")[2]) <= 1e-9
    stored = sum(codec.kind(message) == codec.VOLUMES for message in messages)
    assert 0 < int(unstored.split()[0]) <= (60 - stored) * 6
    # the same on the machine that recorded it, and in a record that does not say where it is from, is a difference
    for machine in ({"machine": describe_machine(), "versions": versions()}, {}):
        there = [codec.encode_event(made.START_NS, made.START | machine), *messages[1:]]
        assert _verdict(tmp_path, there, Rounding).agreement is Agreement.DIFFERS
    assert _verdict(tmp_path, elsewhere).agreement is Agreement.IDENTICAL


_ANSWER = struct.calcsize("<cqqIIBBhhHB")
_LOOKED = struct.calcsize("<cqHHHHH") + 8


@pytest.mark.parametrize(
    ("kind", "number", "offset", "change", "name"),
    [
        (codec.DECISION, 7, _ANSWER + 8 * 8, 1e-6, "q3"),
        (codec.DECISION, 7, _ANSWER + 8 * 14, 1e-6, "dq3"),
        (codec.DECISION, 7, _ANSWER + 8 * 20, 1e-3, "u3"),
        (codec.DECISION, 7, _ANSWER + 8 * 33, 1e-6, "distance_m"),
        (codec.DECISION, 7, _ANSWER + 8 * 35, 1e-12, "horizon_s"),
        (codec.DECISION, 7, _ANSWER + 8 * 37, 1e-12, "certified"),
        (codec.DECISION, 7, _ANSWER + 8 * 33, np.nan, "distance_m"),
        (codec.PERCEPTION, 7, _LOOKED + 8 * 3, 1e-6, "theta"),
        (codec.VOLUMES, 1, struct.calcsize("<cqHHId") + 8 * (8 + 6) + 8 * 4, 1e-6, "vertex 1 of HD, y"),
        (codec.VOLUMES, 1, struct.calcsize("<cqHHI"), 1e-12, "horizon_s"),
    ],
)
def test_a_changed_number_differs_on_any_machine(
    tmp_path: Path, elsewhere: list[bytes], kind: bytes, number: int, offset: int, change: float, name: str
) -> None:
    changed, at = list(elsewhere), _at(elsewhere, kind, number)
    changed[at] = _float(changed[at], offset, change)
    verdict = _verdict(tmp_path, changed, Rounding)
    assert verdict.agreement is Agreement.DIFFERS
    assert f"s: {name}: recorded " in verdict.lines[0] or kind == codec.PERCEPTION
    if np.isfinite(change):
        assert float(verdict.lines[0].removesuffix(" apart").rpartition(", ")[2]) == pytest.approx(change, rel=0.1)
    assert verdict.lines[1].startswith("recorded on Another CPU")


def _patched(message: bytes, offset: int, form: str, value: int) -> bytes:
    return message[:offset] + struct.pack(form, value) + message[offset + struct.calcsize(form) :]


@pytest.mark.parametrize(
    ("kind", "offset", "form", "value"),
    [
        (codec.DECISION, struct.calcsize("<cqqII"), "<B", codec.HOLDING),
        (codec.DECISION, struct.calcsize("<cqqIIB"), "<B", 1),
        (codec.DECISION, struct.calcsize("<cqqIIBB"), "<h", 3),
        (codec.DECISION, struct.calcsize("<cqqIIBBh"), "<h", 0),
        (codec.DECISION, struct.calcsize("<cq"), "<q", 5),
        (codec.PERCEPTION, -6 * 24 - 2, "<B", 1),
        (codec.PERCEPTION, -24, "<24s", 0),
    ],
    ids=["phase", "status", "limb", "link", "look", "camera", "digest"],
)
def test_a_changed_decision_differs_on_any_machine(
    tmp_path: Path, elsewhere: list[bytes], kind: bytes, offset: int, form: str, value: int
) -> None:
    changed, at = list(elsewhere), _at(elsewhere, kind, 7)
    message = changed[at]
    if form == "<24s":
        changed[at] = message[:offset] + bytes(24)
    else:
        changed[at] = _patched(message, offset % len(message), form, value)
    assert changed[at] != message
    verdict = _verdict(tmp_path, changed, Rounding)
    assert verdict.agreement is Agreement.DIFFERS
    assert verdict.lines[0].startswith("tick 7 at ")


def test_a_reply_that_says_another_angle_differs_on_any_machine(tmp_path: Path, elsewhere: list[bytes]) -> None:
    at = _at(elsewhere, codec.REPLY, 7)
    for change, outcome in ((1e-6, Agreement.DIFFERS), (1e-13, Agreement.SAME_DECISIONS)):
        reply = egm.SensorMessage.FromString(codec.decode_reply(elsewhere[at])[1])
        reply.planned.joints.joints[2] += change
        changed = list(elsewhere)
        changed[at] = codec.encode_reply(codec.clock_ns(elsewhere[at]), reply.SerializeToString(), sent=True)
        verdict = _verdict(tmp_path, changed, Rounding)
        assert verdict.agreement is outcome
    reply.header.seqno += 1
    changed[at] = codec.encode_reply(codec.clock_ns(elsewhere[at]), reply.SerializeToString(), sent=True)
    assert _verdict(tmp_path, changed, Rounding).agreement is Agreement.DIFFERS


def test_a_replay_of_another_machine(replayed: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(replayed, run)
    original = pq.read_table(run / "motion.parquet")
    meta = json.loads((run / "run.json").read_text())
    assert meta["machine"] == describe_machine()

    def tell(name: str, row: int, value: object) -> Verdict:
        column = original.column(name).to_pylist()
        column[row] = value
        changed = pa.array(column, type=original.column(name).type)
        table = original.set_column(original.column_names.index(name), name, changed)
        pq.write_table(table, run / "motion.parquet")
        outputs = meta["outputs"] | {"motion.parquet": run_folder.sha256(run / "motion.parquet")}
        (run / "run.json").write_text(json.dumps(meta | {"machine": OTHER, "outputs": outputs}))
        return verify(run)

    q3 = original.column("q3")[7].as_py()
    verdict = tell("q3", 7, q3 + 1e-12)
    assert verdict.agreement is Agreement.SAME_DECISIONS
    assert "motion.parquet: row 7, q3: " in verdict.lines[-1]
    verdict = tell("q3", 7, q3 + 1e-6)
    assert verdict.agreement is Agreement.DIFFERS
    assert verdict.lines[0].startswith(f"motion.parquet: row 7, q3: recorded {q3 + 1e-6!r}, again {q3!r}")
    assert tell("status", 7, "braking").agreement is Agreement.DIFFERS


_FLY = """
import sys
from pathlib import Path
from hrcreplay.live.record import codec
from tests.live import made
from tests.live.flights import BEGIN_NS, Flight

flight = Flight()
flight.fly(1.5)
made.record(Path(sys.argv[1]), [codec.encode_event(BEGIN_NS - 1, flight.start), *flight.messages], chunk=500)
"""


@pytest.mark.skipif(not describe_machine()["blas"]["core"], reason="this BLAS does not choose its kernels by a name")
def test_a_session_recorded_with_other_blas_kernels_has_the_same_decisions(tmp_path: Path) -> None:
    run = tmp_path / "run.partial"
    run.mkdir()
    here = describe_machine()["blas"]["core"]
    kernels = {"OPENBLAS_CORETYPE": "Nehalem" if here != "Nehalem" else "Sandybridge"}
    subprocess.run([sys.executable, "-c", _FLY, str(run / "log.mcap")], check=True, env={**os.environ, **kernels})
    start = SessionLogReader(run / "log.mcap").start()
    assert start["machine"]["blas"]["core"] == kernels["OPENBLAS_CORETYPE"]
    assert start["machine"]["environment"].items() >= kernels.items()
    verdict = verify(run)
    assert verdict.agreement in (Agreement.IDENTICAL, Agreement.SAME_DECISIONS), verdict.lines
