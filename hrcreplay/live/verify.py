"""The command ``verify``: computes a recorded run again and compares it with the record.

A live session is computed again from its log, message by message. A replay is computed again by its command and its
run.json. Every bit is compared. On another machine numbers may differ by ``differences.TOLERANCE``; the verdict is then
``same decisions``.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

import numpy as np

from hrcreplay.commands import replay
from hrcreplay.egm import motion_link_pb2 as egm
from hrcreplay.errors import EXIT_DIFFERS, EXIT_SAME_DECISIONS, LogError, SettingsError
from hrcreplay.live.control import setup
from hrcreplay.live.differences import (
    TOLERANCE,
    Difference,
    decisions_differing,
    differing,
    json_differing,
    messages_differing,
    numbers_differing,
    tables_differing,
    worst,
)
from hrcreplay.live.record import codec
from hrcreplay.live.record.codec import Decision, Perception, Signal, TickEvent
from hrcreplay.live.record.recorder import SessionLogReader
from hrcreplay.pipeline.run_config import versions
from hrcreplay.records import STATUSES, SweptVolumes, of_person
from hrcreplay.store import run_folder
from hrcreplay.store.columns import state_columns
from hrcreplay.store.machine import describe_machine, name_machine

COMMANDS = ("fuse", "predict", "plan", "report")
_CONTEXT = ("versions", "limits", "task", "cell")  #: entries of run.json that may explain a difference


class Agreement(IntEnum):
    """Outcome of computing a run again; the value is the exit code."""

    IDENTICAL = 0
    DIFFERS = EXIT_DIFFERS
    SAME_DECISIONS = EXIT_SAME_DECISIONS


@dataclass(frozen=True, slots=True)
class Verdict:
    """Outcome of computing a run again, with its explanation."""

    agreement: Agreement
    lines: tuple[str, ...]

    @property
    def identical(self) -> bool:
        """Return whether every bit is equal."""
        return self.agreement is Agreement.IDENTICAL


#: Entry of a machine in run.json -> its name in messages.
_PARTS = {
    **dict.fromkeys(("processor", "architecture", "features"), "processor"),
    "blas": "BLAS kernels",
    "numpy_simd": "numpy loops",
    "numba_target": "numba target",
    "c_library": "C library",
    "environment": "environment variables",
}


def find_other_parts(recorded: dict[str, Any]) -> str:
    """Parts of this machine that differ from the recorded machine, in words.

    Empty if no part differs or the record has no machine. Other versions are listed only with another part, because
    other versions alone do not explain a difference.
    """
    machine, now = recorded.get("machine"), describe_machine()
    if not isinstance(machine, dict):
        return ""
    parts = [label for name, label in _PARTS.items() if machine.get(name) != now[name]]
    parts += ["versions"] if parts and recorded.get("versions") != versions() else []
    return ", ".join(dict.fromkeys(parts))


def _origin(recorded: dict[str, Any]) -> tuple[str, ...]:
    """Machines on which a run was recorded and computed again."""
    here = describe_machine()
    machine = recorded.get("machine")
    if machine == here:
        return (f"recorded and computed again on {name_machine(here)}",)
    return (f"recorded on {name_machine(machine)}", f"computed again on {name_machine(here)}")


def _same_decisions(other: str) -> str:
    within = np.format_float_scientific(TOLERANCE, trim="-", exp_digits=1)
    return f"same decisions, numbers within {within} (other {other})"


def _replay(run: Path) -> Verdict:
    """Runs a replay again and compares its outputs.

    Raises:
        SettingsError: The folder is no complete run of a replay.
        LogError: The log of the run is missing.
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
        line = f"{log}: is not the log of this run: SHA-256 recorded {digest}, now {now}"
        return Verdict(Agreement.DIFFERS, (line, *_changed(run)))
    with TemporaryDirectory(prefix="hrcreplay-") as temporary:
        # A run folder with a complete run.json and no outputs, so that the new run reuses no results.
        plan = Path(temporary) / "plan"
        plan.mkdir()
        (plan / "run.json").write_text(json.dumps({**meta, "stages": {}, "outputs": {}}))
        smooth = "smooth.parquet" in meta["outputs"]
        made = replay.run(meta["command"], plan, out=Path(temporary) / "again", smooth=smooth)
        return _compared(run, meta, made)


def _compared(run: Path, meta: dict[str, Any], made: Path) -> Verdict:
    now = run_folder.read_meta(made)
    recorded, again = meta["outputs"], now["outputs"]
    different = [name for name in sorted({*recorded, *again}) if recorded.get(name) != again.get(name)]
    changed = list(_changed(run))
    if not different and not changed:
        return Verdict(Agreement.IDENTICAL, ("identical",))
    other = find_other_parts(meta)
    found = {name: _output_differing(name, run, made, recorded, again) for name in different}
    drawn = [name for name in different if not found[name]]
    small = [one.at(f"{name}: ") for name, ones in found.items() for one in ones]
    if other and not changed and all(one.tolerable for one in small):
        lines = [_same_decisions(other), *_origin(meta)]
        lines += [f"largest difference: {worst(small).text}"] if small else []
        lines += [f"not compared number by number, since drawn from the tables: {', '.join(drawn)}"] if drawn else []
        return Verdict(Agreement.SAME_DECISIONS, tuple(lines))
    lines = []
    for name in different:
        ones = found[name]
        shown = (worst(ones) if other else ones[0]).text if ones else "not the same bytes again"
        lines.append(f"{name}: {shown}")
    for key in _CONTEXT if different else ():
        lines += _context(key, meta.get(key), now.get(key))
    return Verdict(Agreement.DIFFERS, (*lines, *(_origin(meta) if different else ()), *changed))


def _output_differing(
    name: str, run: Path, made: Path, recorded: dict[str, str], again: dict[str, str]
) -> list[Difference]:
    """Differences within an output whose bytes differ; none for a drawn output, which has no numbers to compare."""
    if name not in again:
        return [Difference("recorded, but not made again", np.inf)]
    if name not in recorded:
        return [Difference("not recorded, but made again", np.inf)]
    if not name.endswith((".parquet", ".json")):
        return []
    found = (tables_differing if name.endswith(".parquet") else json_differing)(run / name, made / name)
    return found or [Difference("not the same bytes again", np.inf)]


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


LOG = "log.mcap"


class DecisionMaker(Protocol):
    """Source of a session's decisions: ``SessionController``, or a substitute in tests."""

    def update_perception(self, t_ns: int, skeletons: Sequence[bytes]) -> Perception | None:
        """Perception of the people."""

    def answer(self, event: TickEvent) -> Decision:
        """Decision for the robot."""

    def silence(self, t_ns: int, signals: Signal) -> None:
        """Handles a time-out without a packet from the robot."""


ControllerFactory = Callable[[dict[str, Any]], DecisionMaker]


def verify(run: Path, build: ControllerFactory = setup.build_controller) -> Verdict:
    """Computes a live session or a replay again from its run folder, and compares the results.

    Args:
        run: Run folder; the session may still be running or may have been killed.
        build: Makes a session's controller from its start event.

    Raises:
        SettingsError: The folder is no run folder, or its command cannot be run again.
        LogError: The log of the run cannot be read.
    """
    return _session(run, build) if (run / LOG).exists() else _replay(run)


def _session(run: Path, build: ControllerFactory) -> Verdict:
    log = SessionLogReader(run / LOG)
    start = log.start()
    other = find_other_parts(start)
    again = SessionRecomputation(build(start))
    found, largest = list[Difference](), list[Difference]()
    for message in log.messages():
        if log.flaws or again.crashed:
            break
        found = again.differences_at(message)
        if found and not (other and all(one.tolerable for one in found)):
            break
        largest = [worst([*largest, *found])] if found else largest
    else:
        found = again.pending_differences()
    stopped = bool(found) and not (other and all(one.tolerable for one in found))
    largest = [worst([*largest, *found])] if found and not stopped else largest
    lines = [f"{log.path}: {flaw}" for flaw in log.flaws]
    if stopped:
        lines += [(worst(found) if other else found[0]).text, *_origin(start)]
    lines += _changed(run)
    if lines:
        until = "within the tolerance" if largest else "identical"
        return Verdict(Agreement.DIFFERS, (*lines, f"{until} until then: {again.ticks} ticks"))
    end = "" if again.ended and log.finished else "; the record breaks off: the session or its recorder was killed"
    end = f"; then control crashed: {again.crashed}" if again.crashed else end
    counts = f"{again.ticks} ticks, {again.looks} looks{end}"
    if not largest:
        return Verdict(Agreement.IDENTICAL, (f"identical: {counts}",))
    lines = [f"{_same_decisions(other)}: {counts}", *_origin(start), f"largest difference: {largest[0].text}"]
    if again.by_digest:
        lines.append(f"{again.by_digest} volumes that are not recorded whole: within {codec.GRID_M * 1e6:g} um")
    return Verdict(Agreement.SAME_DECISIONS, tuple(lines))


def _changed(run: Path) -> Iterator[str]:
    """Describes the files of a complete run that have changed since."""
    try:
        meta = run_folder.read_meta(run, broken_off=True)
    except SettingsError as error:
        if run.suffix != ".partial":  # a partial folder only needs its log
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
        self.by_digest = 0  #: number of volumes with other bits, equal on a grid and not recorded completely
        self.ended = False
        self.crashed = ""  #: crash of control; after it no controller answered
        self._pilot = controller
        self._start_ns: int | None = None
        self._last_ns = 0
        self._frames: list[bytes] = []
        self._datagrams: list[bytes] = []
        self._reply: bytes | None = None  # expected as the next message
        self._perception: Perception | None = None
        self._suspects: list[Difference] = []  # limbs with another digest; the complete volume may follow
        self._take: dict[bytes, Callable[[bytes], list[Difference]]] = {
            codec.ROBOT: self._robot,
            codec.REPLY: self._replied,
            codec.SKELETON: self._frame,
            codec.PERCEPTION: self._look,
            codec.VOLUMES: self._volumes,
            codec.DECISION: self._answer,
            codec.TIMEOUT: self._silence,
            codec.EVENT: self._event,
        }

    def differences_at(self, message: bytes) -> list[Difference]:
        """Differences in a message, or in messages that were expected before it; in the order of the record."""
        kind, t_ns = codec.kind(message), codec.clock_ns(message)
        if self._start_ns is None:
            self._start_ns = t_ns
        self._last_ns = t_ns
        if kind == codec.EVENT and (event := codec.decode_event(message)).get("what") == "crash":
            self.crashed = str(event["text"])
            return []
        due: list[Difference] = []
        if self._reply is not None and kind != codec.REPLY:
            return self._at(t_ns, [differing("reply", "none", f"{len(self._reply)} bytes")])
        if kind != codec.VOLUMES:
            due = self._at(t_ns, self._unproven())
            if not all(one.tolerable for one in due):
                return due
        return due + self._at(t_ns, self._take[kind](message))

    def pending_differences(self) -> list[Difference]:
        """Differences that the next message would show, for use after the last message."""
        return self._at(self._last_ns, self._unproven())

    def _unproven(self) -> list[Difference]:
        """Differences of volumes whose digests alone are recorded."""
        found, self._suspects = self._suspects, []
        self.by_digest += sum(one.tolerable for one in found)
        return found

    def _at(self, t_ns: int, found: list[Difference]) -> list[Difference]:
        where = f"tick {max(0, self.ticks - 1)} at {(t_ns - (self._start_ns or 0)) / 1e9:.3f} s: "
        return [one.at(where) for one in found]

    def _robot(self, message: bytes) -> list[Difference]:
        self._datagrams.append(codec.body(message))
        return []

    def _frame(self, message: bytes) -> list[Difference]:
        self._frames.append(codec.body(message))
        return []

    def _silence(self, message: bytes) -> list[Difference]:
        self._pilot.silence(codec.clock_ns(message), codec.decode_timeout(message))
        return []

    def _event(self, message: bytes) -> list[Difference]:
        what = codec.decode_event(message).get("what")
        self.ended = what == "end"
        if what != "blind":
            return []
        frames, self._frames = self._frames, []
        self._perception = self._pilot.update_perception(codec.clock_ns(message), frames)
        return [] if self._perception is None else [differing("look", "failed", "none of it")]

    def _look(self, message: bytes) -> list[Difference]:
        frames, self._frames = self._frames, []
        recorded = codec.decode_perception(message)
        if len(frames) != recorded.skeletons:
            text = f"the record has {len(frames)} of the {recorded.skeletons} skeletons of this look"
            return [Difference(text, np.inf)]
        perception = self._perception = self._pilot.update_perception(recorded.t_ns, frames)
        self.looks += 1
        if perception is None:
            return [differing("look", "done", "failed")]
        if codec.encode_perception(perception, len(frames)) == message:
            return []
        states = perception.states
        if (again := states.numbers.tolist()) != (people := recorded.people.tolist()):
            return [differing("people", people, again)]
        columns = state_columns(replace(states, person=None))
        cameras = [f"valid_{camera}" for camera in states.cameras]
        names = [name for name in columns if name != "t_ns" and name not in cameras]
        self._suspects = _digests_differing(recorded.digests, perception)
        numbers, found = codec.state_numbers(states), list[Difference]()
        for row, number in enumerate(people):
            ones = numbers_differing(names, recorded.state[row], numbers[row])
            ones += decisions_differing(cameras, recorded.valid[row].tolist(), states.valid[row].tolist())
            found += [one.at("" if number == 1 else f"person {number}: ") for one in ones]
        return found

    def _volumes(self, message: bytes) -> list[Difference]:
        suspects, self._suspects = self._suspects, []
        if self._perception is None:
            return [differing("volumes", "some", "none")]
        look = self._perception
        recorded = codec.decode_volumes(message, look.volumes.limbs, look.volumes.method)
        if (again := look.states.numbers.tolist()) != (people := recorded.people.tolist()):
            return [differing("people of the volumes", people, again)]
        found = [
            *numbers_differing(["horizon_s"], np.array([recorded.horizon_s]), np.array([look.horizon_s])),
            *_volumes_differing(recorded, look.volumes),
        ]
        # the digests of the recorded volumes must give the same differences as the recorded digests
        digests = _digests_differing(codec.volume_digests(recorded.volumes), look) if suspects else []
        return found if [one.text for one in digests] == [one.text for one in suspects] else [*found, *suspects]

    def _answer(self, message: bytes) -> list[Difference]:
        datagrams, self._datagrams = tuple(self._datagrams), []
        recorded = codec.decode_decision(message)
        self.ticks += 1
        if len(datagrams) != recorded.datagrams:
            text = f"the record has {len(datagrams)} of the {recorded.datagrams} packets of this tick"
            return [Difference(text, np.inf)]
        again = self._pilot.answer(TickEvent(recorded.t_ns, datagrams, recorded.signals))
        self._reply = again.datagram
        said = codec.decode_decision(codec.encode_decision(again, recorded.signals, len(datagrams), recorded.took_us))
        names = ("phase", "status", "reason", "look_ns", "limb", "link")
        return [
            *decisions_differing(names, _decision(recorded), _decision(said)),
            *numbers_differing(codec.number_names_of(len(recorded.numbers)), recorded.numbers, said.numbers),
        ]

    def _replied(self, message: bytes) -> list[Difference]:
        _, recorded = codec.decode_reply(message)
        again, self._reply = self._reply, None
        if again is None:
            return [differing("reply", f"{len(recorded)} bytes", "none")]
        return messages_differing(egm.SensorMessage, recorded, again)


def _decision(found: codec.RecordedDecision) -> list[Any]:
    return [
        codec.PHASES[found.phase],
        STATUSES[found.status],
        found.reason,
        found.look_ns,
        found.limb,
        found.link,
    ]


def _of_all(names: Sequence[str], people: Sequence[int]) -> list[str]:
    """The names for every person, person after person."""
    return [of_person(name, number) for number in people for name in names]


def _digests_differing(recorded: tuple[bytes, ...], look: Perception) -> list[Difference]:
    """Limbs whose volume has another digest; tolerable if its numbers are equal on a grid."""
    again = codec.volume_digests(look.volumes)
    names = [f"volume of {limb} (digest)" for limb in _of_all(look.volumes.limbs, look.states.numbers.tolist())]
    found = decisions_differing(names, [one.hex() for one in recorded], [one.hex() for one in again])
    grid = {name for name, one, other in zip(names, recorded, again, strict=False) if codec.same_on_a_grid(one, other)}
    return [Difference(one.text, 0.0) if one.text.partition(":")[0] in grid else one for one in found]


def _volumes_differing(recorded: codec.RecordedVolumes, again: SweptVolumes) -> list[Difference]:
    """The numbers that differ in the volumes of a perception update."""
    found: list[Difference] = []
    for one, name in enumerate(_of_all(again.limbs, recorded.people.tolist())):
        row, limb = divmod(one, len(again.limbs))
        mine, yours = recorded.volumes.vertices(row, limb), again.vertices(row, limb)
        if len(mine) != len(yours):
            return [*found, differing(f"vertices of {name}", len(mine), len(yours))]
        names = [f"vertex {i} of {name}, {axis}" for i in range(len(mine)) for axis in "xyz"]
        radii = (volumes.radius_m[row, limb : limb + 1] for volumes in (recorded.volumes, again))
        found += numbers_differing(names, mine.ravel(), yours.ravel())
        found += numbers_differing([f"radius of {name}"], *radii)
    return found
