"""The command ``verify``: computes a recorded run again and compares it with the record, bit for bit.

A live session is computed again from its log, message by message; a replay by running its command from its run.json.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hrcreplay.egm.codec import AXES
from hrcreplay.errors import LogError, SettingsError
from hrcreplay.live.control import setup
from hrcreplay.live.record import codec
from hrcreplay.live.record.codec import Decision, Perception, Signal, TickEvent
from hrcreplay.live.record.recorder import SessionLogReader
from hrcreplay.records import STATUSES, Floats, SweptVolumes
from hrcreplay.run import replay
from hrcreplay.store import run_folder
from hrcreplay.store.columns import state_columns

COMMANDS = ("fuse", "predict", "plan", "report")
_CONTEXT = ("versions", "limits", "task", "cell")  #: of run.json: what else may make a difference


def replay_again(run: Path) -> Iterator[str]:
    """What is not the same when a replay is run again; nothing where all of it is.

    Raises:
        SettingsError: No complete run of a replay.
        LogError: The log of the run is gone.
    """
    meta = run_folder.read_meta(run)
    if meta["command"] not in COMMANDS:
        raise SettingsError(
            f"{run}: a run of {meta['command']}; those that can be run again are live sessions, {', '.join(COMMANDS)}"
        )
    log, digest = Path(meta["inputs"][0]["path"]), meta["inputs"][0]["sha256"]
    if not log.exists():
        raise LogError(f"{log}: the log of {run} is gone; put it back, or start where its path leads to it")
    if (now := run_folder.sha256(log)) != digest:
        yield f"{log}: is not the log of this run: SHA-256 recorded {digest}, now {now}"
        return
    with TemporaryDirectory(prefix="hrcreplay-") as temporary:
        # A run folder that says all of itself and holds nothing, so that nothing can be taken over from it.
        plan = Path(temporary) / "plan"
        plan.mkdir()
        (plan / "run.json").write_text(json.dumps({**meta, "stages": {}, "outputs": {}}))
        smooth = "smooth.parquet" in meta["outputs"]
        made = replay.run(meta["command"], plan, out=Path(temporary) / "again", smooth=smooth)
        yield from _compared(run, meta, made)


def _compared(run: Path, meta: dict[str, Any], made: Path) -> Iterator[str]:
    now = run_folder.read_meta(made)
    recorded, found = meta["outputs"], now["outputs"]
    different = [name for name in sorted({*recorded, *found}) if recorded.get(name) != found.get(name)]
    for name in different:
        if name not in found:
            yield f"{name}: recorded, but not made again"
        elif name not in recorded:
            yield f"{name}: not recorded, but made again"
        else:
            where = _table(run / name, made / name) if name.endswith(".parquet") else None
            yield f"{name}: {where or 'not the same bytes again'}"
    for key in _CONTEXT if different else ():
        yield from _context(key, meta.get(key), now.get(key))


def _context(key: str, recorded: Any, now: Any) -> Iterator[str]:
    if recorded == now:
        return
    if not isinstance(recorded, dict) or not isinstance(now, dict):
        yield f"{key}: not that of the run"
        return
    for name in sorted({*recorded, *now}):
        if recorded.get(name) != now.get(name):
            values = f": recorded {recorded.get(name)}, now {now.get(name)}" if key == "versions" else ""
            yield f"{key} of {name}{values}" if values else f"{key}: {name} is not that of the run"


def _table(recorded: Path, made: Path) -> str | None:
    """The first row, and in it the first column, that differs between two tables."""
    try:
        tables = pq.read_table(recorded), pq.read_table(made)
    except (OSError, pa.ArrowException):
        return None
    names = [table.column_names for table in tables]
    if names[0] != names[1]:
        return f"columns: recorded {len(names[0])}, again {len(names[1])}"
    rows = min(len(table) for table in tables)
    firsts = {name: _row(*(table.column(name)[:rows] for table in tables)) for name in names[0]}
    row = min((found for found in firsts.values() if found is not None), default=None)
    if row is None:
        lengths = [len(table) for table in tables]
        return None if lengths[0] == lengths[1] else f"rows: recorded {lengths[0]}, again {lengths[1]}"
    name = next(name for name, found in firsts.items() if found == row)
    mine, yours = (table.column(name)[row].as_py() for table in tables)
    return f"row {row}, {name}: recorded {mine!r}, again {yours!r}"


def _row(recorded: pa.ChunkedArray, made: pa.ChunkedArray) -> int | None:
    """The first row in which two columns differ by a bit."""
    if recorded.type != made.type:
        return 0
    if pa.types.is_floating(recorded.type):
        mine, yours = (column.to_numpy().view(np.int64) for column in (recorded, made))
        different = np.flatnonzero(mine != yours)
        return int(different[0]) if len(different) else None
    if recorded.equals(made):
        return None
    pairs = zip(recorded.to_pylist(), made.to_pylist(), strict=True)
    return next((i for i, (mine, yours) in enumerate(pairs) if mine != yours), None)


LOG = "log.mcap"
_ROW = (
    *(f"{name}{axis}" for name in ("q_measured", "q", "dq", "u") for axis in range(1, AXES + 1)),
    *("ref_x", "ref_y", "ref_z", "tcp_x", "tcp_y", "tcp_z", "tcp_speed", "ref_speed", "programme_s", "distance_m"),
    *("horizon_s", "tau_s", "certified"),
)  #: the numbers of a MotionRow, named as in motion.parquet


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether a run came out the same again, and what there is to say of it."""

    identical: bool
    lines: tuple[str, ...]


class DecisionMaker(Protocol):
    """What makes a session's decisions: ``SessionController``, or a substitute in tests."""

    def update_perception(self, t_ns: int, skeletons: Sequence[bytes]) -> Perception | None:
        """What is known of the person."""

    def answer(self, event: TickEvent) -> Decision:
        """What the robot is told."""

    def silence(self, t_ns: int, signals: Signal) -> None:
        """The robot said nothing."""


ControllerFactory = Callable[[dict[str, Any]], DecisionMaker]


def verify(run: Path, build: ControllerFactory = setup.build_controller) -> Verdict:
    """Runs a live session or a replay again from what its folder holds, and compares.

    Args:
        run: Run folder; also that of a session under way or killed.
        build: Makes a session's controller from its start event.

    Raises:
        SettingsError: No run folder, or one of a command that cannot be run again.
        LogError: The log of the run cannot be read.
    """
    if not (run / LOG).exists():
        lines = [*replay_again(run), *_changed(run)]
        return Verdict(identical=False, lines=tuple(lines)) if lines else Verdict(identical=True, lines=("identical",))
    return _session(run, build)


def _session(run: Path, build: ControllerFactory) -> Verdict:
    log = SessionLogReader(run / LOG)
    again = SessionRecomputation(build(log.start()))
    difference = None
    for message in log.messages():
        if log.flaws or again.crashed:
            break
        difference = again.difference_at(message)
        if difference is not None:
            break
    else:
        difference = again.pending_difference()
    lines = [f"{log.path}: {flaw}" for flaw in log.flaws]
    if difference is not None:
        lines.append(difference)
    lines += _changed(run)
    if lines:
        return Verdict(identical=False, lines=(*lines, f"identical until then: {again.ticks} ticks"))
    end = "" if again.ended and log.finished else "; the record breaks off: the session or its recorder was killed"
    end = f"; then control crashed: {again.crashed}" if again.crashed else end
    return Verdict(identical=True, lines=(f"identical: {again.ticks} ticks, {again.looks} looks{end}",))


def _changed(run: Path) -> Iterator[str]:
    """The files of a complete run that are not those it left."""
    try:
        meta = run_folder.read_meta(run, broken_off=True)
    except SettingsError as error:
        if run.suffix != ".partial":  # of which only the log counts
            yield str(error)
        return
    for name, digest in sorted(meta.get("outputs", {}).items()):
        path = run / name
        if not path.exists():
            yield f"{path}: is gone"
        elif run_folder.sha256(path) != digest:
            yield f"{path}: is not as the run left it"


class SessionRecomputation:
    """Computes a session again: a new controller gets the recorded inputs and must give the recorded outputs."""

    def __init__(self, controller: DecisionMaker) -> None:
        self.ticks = 0  #: answers so far
        self.looks = 0
        self.ended = False
        self.crashed = ""  #: how control crashed, after which no controller answered
        self._pilot = controller
        self._start_ns: int | None = None
        self._last_ns = 0
        self._frames: list[bytes] = []
        self._datagrams: list[bytes] = []
        self._reply: bytes | None = None  # due as the next message
        self._perception: Perception | None = None
        self._suspect = ""  # a limb whose volume is not that of the record; perhaps it is there whole
        self._take = {
            codec.ROBOT: self._robot,
            codec.REPLY: self._replied,
            codec.SKELETON: self._frame,
            codec.PERCEPTION: self._look,
            codec.VOLUMES: self._volumes,
            codec.DECISION: self._answer,
            codec.TIMEOUT: self._silence,
            codec.EVENT: self._event,
        }

    def difference_at(self, message: bytes) -> str | None:
        """The first thing about a message, or due before it, that is not the same again."""
        kind, t_ns = codec.kind(message), codec.clock_ns(message)
        if self._start_ns is None:
            self._start_ns = t_ns
        self._last_ns = t_ns
        found = None
        if kind == codec.EVENT and (event := codec.decode_event(message)).get("what") == "crash":
            self.crashed = str(event["text"])
            return None
        if self._reply is not None and kind != codec.REPLY:
            found = _both("reply", "none", f"{len(self._reply)} bytes")
        elif self._suspect and kind != codec.VOLUMES:
            found = self._suspect
        else:
            found = self._take[kind](message)
        return None if found is None else self._at(t_ns, found)

    def pending_difference(self) -> str | None:
        """What differs that the message after the last one would have shown."""
        return self._at(self._last_ns, self._suspect) if self._suspect else None

    def _at(self, t_ns: int, found: str) -> str:
        return f"tick {max(0, self.ticks - 1)} at {(t_ns - (self._start_ns or 0)) / 1e9:.3f} s: {found}"

    def _robot(self, message: bytes) -> None:
        self._datagrams.append(codec.body(message))

    def _frame(self, message: bytes) -> None:
        self._frames.append(codec.body(message))

    def _silence(self, message: bytes) -> None:
        self._pilot.silence(codec.clock_ns(message), codec.decode_timeout(message))

    def _event(self, message: bytes) -> str | None:
        what = codec.decode_event(message).get("what")
        self.ended = what == "end"
        if what != "blind":
            return None
        frames, self._frames = self._frames, []
        self._perception = self._pilot.update_perception(codec.clock_ns(message), frames)
        return None if self._perception is None else _both("look", "failed", "none of it")

    def _look(self, message: bytes) -> str | None:
        frames, self._frames = self._frames, []
        recorded = codec.decode_perception(message)
        if len(frames) != recorded.skeletons:
            return f"the record has {len(frames)} of the {recorded.skeletons} skeletons of this look"
        perception = self._perception = self._pilot.update_perception(recorded.t_ns, frames)
        self.looks += 1
        if perception is None:
            return _both("look", "done", "failed")
        if codec.encode_perception(perception.states, perception.volumes, len(frames)) == message:
            return None
        columns = state_columns(perception.states)
        cameras = [f"valid_{camera}" for camera in perception.states.cameras]
        names = [name for name in columns if name != "t_ns" and name not in cameras]
        found = _first(names, recorded.state, codec.state_numbers(perception.states))
        found = found or _first(cameras, list(recorded.valid), list(perception.states.valid[0].tobytes()))
        if found is None:
            digests = [codec.volume_digest(perception.volumes, limb) for limb in range(len(perception.volumes.limbs))]
            whole = [f"volume of {limb} (digest)" for limb in perception.volumes.limbs]
            self._suspect = _first(whole, [d.hex() for d in recorded.digests], [d.hex() for d in digests]) or ""
        return found

    def _volumes(self, message: bytes) -> str | None:
        suspect, self._suspect = self._suspect, ""
        if self._perception is None:
            return _both("volumes", "some", "none")
        volumes, horizon_s = self._perception.volumes, self._perception.horizon_s
        if codec.encode_volumes(volumes, horizon_s) == message:
            return suspect or None
        recorded, held_s = codec.decode_volumes(message, volumes.limbs, volumes.method)
        return _first(["horizon_s"], [held_s], [horizon_s]) or _volume(recorded, volumes) or suspect or None

    def _answer(self, message: bytes) -> str | None:
        datagrams, self._datagrams = tuple(self._datagrams), []
        recorded = codec.decode_decision(message)
        self.ticks += 1
        if len(datagrams) != recorded.datagrams:
            return f"the record has {len(datagrams)} of the {recorded.datagrams} packets of this tick"
        again = self._pilot.answer(TickEvent(recorded.t_ns, datagrams, recorded.signals))
        self._reply = again.datagram
        said = codec.decode_decision(codec.encode_decision(again, recorded.signals, len(datagrams), recorded.took_us))
        return _first(
            ("phase", "status", "reason", "look_ns", "limb", "link"), _decision(recorded), _decision(said)
        ) or (_first(_ROW, _numbers(recorded), _numbers(said)))

    def _replied(self, message: bytes) -> str | None:
        _, recorded = codec.decode_reply(message)
        again, self._reply = self._reply, None
        if again is None:
            return _both("reply", f"{len(recorded)} bytes", "none")
        if again == recorded:
            return None
        if len(again) != len(recorded):
            return _both("length of the reply", len(recorded), len(again))
        return _first([f"byte {i} of the reply" for i in range(len(again))], list(recorded), list(again))


def _decision(found: codec.RecordedDecision) -> list[Any]:
    return [
        codec.PHASES[found.phase],
        STATUSES[found.status],
        found.reason,
        found.look_ns,
        found.limb,
        found.link,
    ]


def _numbers(found: codec.RecordedDecision) -> Floats:
    return np.empty(0) if found.row is None else found.row


def _volume(recorded: SweptVolumes, again: SweptVolumes) -> str | None:
    """The first number that differs in the volumes of a perception update."""
    for limb, name in enumerate(again.limbs):
        mine, yours = recorded.vertices(0, limb), again.vertices(0, limb)
        if len(mine) != len(yours):
            return _both(f"vertices of {name}", len(mine), len(yours))
        names = [f"vertex {i} of {name}, {axis}" for i in range(len(mine)) for axis in "xyz"]
        found = _first(names, mine.ravel(), yours.ravel())
        found = found or _first(
            [f"radius of {name}"], recorded.radius_m[0, limb : limb + 1], again.radius_m[0, limb : limb + 1]
        )
        if found is not None:
            return found
    return None


def _first(names: Sequence[str], recorded: Sequence[Any] | Floats, again: Sequence[Any] | Floats) -> str | None:
    """The first of some quantities that differs by a bit; any NaN is like any other."""
    if len(recorded) != len(again):
        return _both(f"how many of {names[0]} ... there are" if names else "numbers", len(recorded), len(again))
    for name, mine, yours in zip(names, recorded, again, strict=False):
        if isinstance(mine, float) and isinstance(yours, float):
            same = np.float64(mine).tobytes() == np.float64(yours).tobytes() or (mine != mine and yours != yours)
            mine, yours = float(mine), float(yours)
        else:
            same = mine == yours
        if not same:
            return _both(name, mine, yours)
    return None


def _both(name: str, recorded: Any, again: Any) -> str:
    return f"{name}: recorded {recorded!r}, again {again!r}"
