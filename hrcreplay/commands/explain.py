"""The command ``why``: finds the cause that limited the robot at one tick of a run, from the run's tables.

The tick is computed again from the recorded ticks before it, with the same code. A cause is given only if the result
equals the recorded step bit by bit. Of the robot as recorded no cause is known: where it was is told, how near to the
person's volumes and to the recorded body, and what each controller of the run did at that instant.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq

from hrcreplay.errors import SettingsError
from hrcreplay.logs.reader import Log, open_log
from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.run_config import RunConfig, resolve
from hrcreplay.pipeline.surroundings import Forecast, Surroundings
from hrcreplay.records import (
    ALLOWING_CONTACT,
    LIMBS,
    RECORDED,
    STATUSES,
    Floats,
    HumanStates,
    Ints,
    of_person,
    ticks_of,
)
from hrcreplay.reporting.metrics.planning import stationary
from hrcreplay.reporting.metrics.series import true_runs
from hrcreplay.reporting.tables import PageTable, neighbour_text, reason_text
from hrcreplay.robot.control import control_step
from hrcreplay.robot.control.active_constraints import TickContext, explain_refusal, propose_explained
from hrcreplay.robot.control.certificate import NO_PLANES
from hrcreplay.robot.control.control_step import REASONS, standstill_reason
from hrcreplay.robot.control.controllers import Controller, QpController
from hrcreplay.robot.control.stops import Stop, at_rest, stop_axis_by_axis, stop_straight
from hrcreplay.store.columns import motion_columns, read_states_at
from hrcreplay.store.run_folder import arrow_table
from hrcreplay.store.stored_table import RunTable, StoredTable, number_columns, text_column

#: A TCP slower than this counts as stationary [m/s].
_STANDS = 1e-3
#: Numbers of ticks before the requested one at which the computation starts, if one tick does not reproduce the record.
_BEFORE = (0, 25, 250)
#: Ticks whose people, and whose robot, are read together.
_BATCH = 4096


@dataclass
class Record:
    """A run folder whose ticks can be computed again."""

    folder: Path
    method: str
    run_config: RunConfig
    log: Log
    motion: RunTable

    def __post_init__(self) -> None:
        self._axes = range(1, 1 + sum(name[0] == "u" and name[1:].isdigit() for name in self.motion.columns))
        self._status = text_column(self.motion, "status")
        self.states = StoredTable(self.folder / "state.parquet")
        self.ticks_ns, self.first = ticks_of(self.states["t_ns"].to_numpy())
        self._batch: tuple[int, HumanStates] | None = None
        self._rows: tuple[int, dict[str, Floats]] | None = None
        plan = self.run_config.settings.plan.model_copy(update={"method": self.method, "baselines": ()})
        self.run_config = replace(self.run_config, settings=self.run_config.settings.model_copy(update={"plan": plan}))

    @cached_property
    def programme(self) -> assembly.RunProgramme:
        """The robot and its programme."""
        robot = assembly.robot(self.run_config, assembly.robot_base(self.run_config, self.log))
        return assembly.programme(self.run_config, self.log, robot)

    @cached_property
    def surroundings(self) -> Surroundings:
        """Returns the obstacles of the robot."""
        return assembly.surroundings(self.run_config, self.programme.path.model)

    @cached_property
    def controller(self) -> Controller:
        """Makes the method's controller, at the start of its programme."""
        (planner,) = assembly.planners(self.run_config, self.programme, int(self.ticks_ns[0])).values()
        return planner.controller

    def read_as_recorded(self, tick: int) -> bool:
        """Returns True if the row of the robot as recorded comes out again from the log and the volumes of the tick."""
        if self.programme.recorded is None:
            return False
        motion = assembly.recorded_motion(self.run_config, self.programme.path.model, self.programme.recorded, None)
        t_ns = self.motion["t_ns"].to_numpy()[tick : tick + 1]
        again = arrow_table(motion_columns(motion.follow(t_ns, self.forecast(tick), self.names))).to_pylist()[0]
        row = self.motion.iloc[tick]
        return all(row[name] == value or (pd.isna(row[name]) and pd.isna(value)) for name, value in again.items())

    def forecast(self, tick: int) -> Forecast:
        """Predicts the obstacles at a tick."""
        return Forecast(self.surroundings, self.people(tick))

    def people(self, tick: int) -> HumanStates:
        """The fused people at a tick, one row each."""
        start = tick - tick % _BATCH
        if self._batch is None or self._batch[0] != start:
            batch_ns = self.ticks_ns[start : start + _BATCH]
            self._batch = start, read_states_at(self.folder / "state.parquet", batch_ns)
        states, before = self._batch[1], int(self.first[start])
        return states.rows(slice(int(self.first[tick]) - before, int(self.first[tick + 1]) - before))

    def robot(self, what: str, tick: int) -> Floats:
        """(axes,) ``q`` [rad], ``dq`` [rad/s] or ``u`` [rad/s^2] as recorded at a tick."""
        start = tick - tick % _BATCH
        if self._rows is None or self._rows[0] != start:
            rows, found = self.motion.iloc[start : start + _BATCH], {}
            for name in ("q", "dq", "u"):  # row by row, as everywhere else: kernels are compiled anew for other layouts
                found[name] = np.ascontiguousarray(number_columns(rows, [f"{name}{i}" for i in self._axes]))
            self._rows = start, found
        return self._rows[1][what][tick - start]

    @cached_property
    def frames(self) -> dict[str, tuple[Ints, Ints]]:
        """Camera -> arrivals of its frames in order, and the newest capture until each [ns]; empty if not kept."""
        path = self.folder / "measurements.parquet"
        if not path.exists():
            return {}
        table = pq.read_table(path, columns=["camera", "capture_ns", "arrival_ns"], read_dictionary=["camera"])
        frames, found = table.to_pandas(), {}
        for camera, rows in frames.groupby("camera", observed=True):
            rows = rows.sort_values("arrival_ns", kind="stable")
            found[str(camera)] = rows["arrival_ns"].to_numpy(), rows["capture_ns"].cummax().to_numpy()
        return found

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all volumes, in the order of ``MotionRow.limb``."""
        people = self.states["person"].to_numpy() if "person" in self.states else np.ones(1, np.int64)
        return self.surroundings.names_of(int(people.max()))

    def again(self, tick: int) -> TickContext | None:
        """Computes the tick again; None if no attempt gives the recorded step bit by bit."""
        for first, current_stop in self._starts(tick):
            controller = self.controller
            controller.stop, controller.s_s = current_stop, float(self.motion["programme_s"].iloc[first])
            controller.point = controller.reference.sample(controller.s_s)
            controller.u = self.robot("u", first - 1).copy() if first else np.zeros(controller.robot.nv)
            controller.planes = NO_PLANES
            context = None
            for now in range(first, tick + 1):
                context = self._context(now)
                with np.errstate(all="ignore"):
                    step = controller.step(context.seen.predict).step
                if not self._as_recorded(now, step):
                    context = None
                    break
            if context is not None:
                return context
        return None

    def _context(self, tick: int) -> TickContext:
        controller = self.controller
        with np.errstate(all="ignore"):
            return TickContext(
                controller.stop, controller.u, controller.s_s, controller.observe(self.forecast(tick).predict(0))
            )

    def _as_recorded(self, tick: int, step: control_step.Step) -> bool:
        """Returns True if a step equals the recorded one bit by bit."""
        row = self.motion.iloc[tick]
        same = STATUSES[step.status] == row["status"] and REASONS[step.reason] == (row["reason"] or "")
        same = same and np.array_equal(step.u, self.robot("u", tick)) and step.certified == row["certified"]
        same = same and np.array_equal(step.distance_m, row["distance_m"], equal_nan=True)
        if tick + 1 < len(self.motion):
            same = same and np.array_equal(step.next.q, self.robot("q", tick + 1))
            same = same and np.array_equal(step.next.dq, self.robot("dq", tick + 1))
        return bool(same)

    def _starts(self, tick: int) -> Iterator[tuple[int, Stop]]:
        """Yields ticks at which the computation can start, nearest first, with the stop under way there."""
        if isinstance(self.controller, QpController):
            for before in _BEFORE:
                first = max(0, tick - before)
                for stop in self._stops(first):
                    yield first, stop
        else:
            at_rest_there = np.all([self.motion[f"dq{i}"].to_numpy() == 0.0 for i in self._axes], axis=0)
            rest = np.flatnonzero(at_rest_there[: tick + 1])[::-1]
            programme_s = self.motion["programme_s"].to_numpy(dtype=float)
            for first in rest[[i for i in (0, 25, 250) if i < len(rest)]].tolist():
                yield first, at_rest(self.robot("q", first), np.array([programme_s[first], 0.0]))
        first_s = float(self.motion["programme_s"].iloc[0])
        yield 0, at_rest(self.robot("q", 0), np.array([first_s, 0.0]))

    def _stops(self, tick: int) -> Iterator[Stop]:
        """Returns the stops that may be under way at a tick of ``qp``: the stop after the last step that was taken."""
        q = self.robot("q", tick)
        if not self.robot("dq", tick).any():
            yield at_rest(q)
            return
        first = tick
        while first and self._status[first - 1] == "braking":
            first -= 1
        robot, dt_s = self.controller.robot, self.controller.settings.dt_s
        for form in (stop_straight, stop_axis_by_axis):
            stop = form(self.robot("q", first), self.robot("dq", first), robot.ddq_max, dt_s)
            gone = tick - first
            if gone <= stop.ticks and np.array_equal(stop.q[gone], q):
                yield Stop(stop.q[gone:], stop.dq[gone:], stop.along[gone:])


def open_record(folder: Path, method: str | None = None) -> Record:
    """Opens the record of a run, for its own method or a baseline.

    Args:
        folder: Run folder with a plan.
        method: None: the run's own.

    Raises:
        SettingsError: The folder is not such a run folder, or the method was not run.
    """
    run_config = resolve("plan", folder)
    own = run_config.settings.plan.method
    name = "motion" if method in (None, own) else f"motion_{method}"
    path = folder / f"{name}.parquet"
    if not path.is_file() or not (folder / "state.parquet").is_file():
        raise SettingsError(f"{folder}: holds no {name}.parquet; give a run folder of plan or report that ran it")
    log = open_log(run_config.log, run_config.settings.logs)
    return Record(folder, method or own, run_config, log, pq.read_table(path).to_pandas())


def explain(folder: Path, at_s: float, method: str | None = None) -> dict[str, Any]:
    """Explain the robot's step at an instant of a run.

    Args:
        folder: Run folder with a plan.
        at_s: Time after the first tick [s].
        method: None: the run's own; else one of its baselines, or recorded.

    Raises:
        SettingsError: The run has no such instant or method, or the tick cannot be reproduced as recorded.
    """
    record = open_record(folder, method)
    t_ns = record.motion["t_ns"].to_numpy()
    ends_s = float(t_ns[-1] - t_ns[0]) * 1e-9
    if not 0.0 <= at_s <= ends_s:
        raise SettingsError(f"--at {at_s:g}: would be right: seconds from the first tick, 0 to {ends_s:.3f}")
    tick = int(np.argmin(np.abs(t_ns - t_ns[0] - round(at_s * 1e9))))
    found = facts_as_recorded(record, tick) if record.method == RECORDED else facts(record, tick)
    if found is None:
        raise SettingsError(
            f"{folder}: the tick at {at_s:g} s could not be reproduced as recorded, so there is no explanation; run "
            "plan or report again with this version"
        )
    return found


def facts(record: Record, tick: int) -> dict[str, Any] | None:
    """Collects all facts about a tick; None if it cannot be reproduced as recorded.

    Args:
        record: Record of the run.
        tick: Row of its motion.
    """
    context = record.again(tick)
    if context is None:
        return None
    robot, settings, row = record.controller.robot, record.controller.settings, record.motion.iloc[tick]
    links, obstacles = [segment.name for segment in robot.segments], context.seen.obstacles
    limbs = [record.names[obstacles.among_all(k)] for k in range(len(obstacles.radius_m))]  # of the hulls of this tick
    people = record.people(tick)
    found: dict[str, Any] = {
        "at_s": float(row["t_ns"] - record.motion["t_ns"].iloc[0]) * 1e-9,
        "tick": tick,
        "method": record.method,
        "status": str(row["status"]),
        "reason": str(row["reason"] or ""),
        "tcp_speed_m_per_s": float(row["tcp_speed"]),
        "horizon_s": context.seen.horizon_s,
        "tau_s": float(row["tau_s"]),
        "cameras": _cameras(record, tick),
    }
    sight = context.seen.sight
    if sight.limb >= 0:
        found["nearest"] = {"link": links[sight.link], "limb": record.names[sight.limb]}
        found["nearest"] |= {"distance_m": sight.distance_m, "overlap_m": sight.overlap_m}
        found["unseen_s"] = _unseen(people, record.names[sight.limb])
    if people.person is not None:
        found["people"] = [_described(people, row, record.surroundings.fresh_s) for row in range(len(people))]
    if people.nobody_s is not None:
        found["watched"] = {
            name: float(since.max()) if since is not None and np.isfinite(since).all() else None
            for name, since in (("nobody_s", people.nobody_s), ("nobody_else_s", people.nobody_else_s))
        }
    if record.method == "none" or (record.method not in ALLOWING_CONTACT and standstill_reason(sight, settings)):
        return found
    proposals, more = propose_explained(record.controller, context)
    for row in more.get("binding", ()):
        if "volume" in row:  # among all volumes, not only those that are kept clear of
            row["beside"] = record.names[row.pop("volume")]
    found |= _named(more, links, limbs) | _objects(record, tick)
    if isinstance(proposals, list) and settings.certified and record.motion["reason"].iloc[tick] == "not certified":
        until, static = (context.seen.obstacles, context.seen.horizon_s), record.controller.static
        found["refused"] = [
            _named(explain_refusal(robot, context.current_stop, proposal, *until, settings, static), links, limbs)
            for proposal in proposals
        ]
    return found


def facts_as_recorded(record: Record, tick: int) -> dict[str, Any] | None:
    """Collects all facts about the robot as recorded at a tick; None if they do not come out again as recorded.

    Args:
        record: Record of the run, for the method ``recorded``.
        tick: Row of its motion.
    """
    if not record.read_as_recorded(tick):
        return None
    row = record.motion.iloc[tick]
    speed, horizon, stop, apart = (_known(row[name]) for name in ("tcp_speed", "horizon_s", "tau_s", "distance_m"))
    found: dict[str, Any] = {
        "at_s": float(row["t_ns"] - record.motion["t_ns"].iloc[0]) * 1e-9,
        "tick": tick,
        "method": record.method,
        "status": "as recorded",
        "reason": str(row["reason"] or ""),
        "tcp_speed_m_per_s": speed,
        "horizon_s": horizon,
        "tau_s": stop,
        "cameras": _cameras(record, tick),
        "beside": _beside(record.folder, tick),
    }
    if apart is not None:
        found["nearest"] = {"link": str(row["link"]), "limb": str(row["limb"])}
        found["nearest"] |= {"distance_m": apart, "overlap_m": float(row["overlap_m"])}
    path = record.folder / "contact.parquet"
    if path.is_file():
        contact = pq.read_table(path, filters=[("method", "=", RECORDED), ("t_ns", "=", int(row["t_ns"]))]).to_pandas()
        if len(contact) and np.isfinite(contact["distance_m"].iloc[0]):
            body = contact.iloc[0]
            found["body"] = {name: str(body[name]) for name in ("link", "limb", "source")}
            found["body"] |= {"distance_m": float(body["distance_m"]), "moving": bool(body["moving"])}
    return found | _objects(record, tick)


def _known(value: float) -> float | None:
    """Returns a number; None if it is unknown."""
    return float(value) if np.isfinite(value) else None


def _beside(folder: Path, tick: int) -> dict[str, dict[str, Any]]:
    """Method -> what each controller of a run did at a tick."""
    found = {}
    for path in sorted(folder.glob("motion*.parquet")):
        method = path.stem.removeprefix("motion").removeprefix("_") or resolve("plan", folder).settings.plan.method
        if method != RECORDED:
            row = pq.read_table(path, columns=["status", "reason", "tcp_speed"]).slice(tick, 1).to_pylist()[0]
            found[method] = {"status": row["status"], "reason": row["reason"] or ""}
            found[method] |= {"tcp_speed_m_per_s": row["tcp_speed"]}
    return found


def _objects(record: Record, tick: int) -> dict[str, Any]:
    """Nearest object and nearest pair of links at a tick; nothing for a cell without objects."""
    row = record.motion.iloc[tick]
    found: dict[str, Any] = {}
    if "object_distance_m" in row and np.isfinite(row["object_distance_m"]):
        found["nearest_object"] = {"link": str(row["object_link"]), "object": str(row["object"])}
        found["nearest_object"] |= {"distance_m": float(row["object_distance_m"])}
    if "self_distance_m" in row and np.isfinite(row["self_distance_m"]):
        found["nearest_links"] = {"link": str(row["self_link"]), "other_link": str(row["self_other_link"])}
        found["nearest_links"] |= {"distance_m": float(row["self_distance_m"])}
    return found


def _cameras(record: Record, tick: int) -> dict[str, dict[str, float | None]]:
    """Camera -> time since its frames last entered the fused person, and the age of its newest frame then [s]."""
    states, t_ns, found = record.states, int(record.ticks_ns[tick]), {}
    for valid in [name for name in states.columns if name.startswith("valid_")]:
        camera, newest, ago = valid.removeprefix("valid_"), None, None
        if camera in record.frames:
            arrival_ns, newest_ns = record.frames[camera]
            arrived = int(np.searchsorted(arrival_ns, t_ns, side="right"))
            newest = (t_ns - int(newest_ns[arrived - 1])) * 1e-9 if arrived else None
        used = states[valid].to_numpy(dtype=bool)[: record.first[tick + 1]][::-1]
        if used.any():
            ago = (t_ns - int(states["t_ns"].to_numpy()[len(used) - 1 - int(used.argmax())])) * 1e-9
        found[camera] = {"used_s_ago": ago, "newest_frame_s_ago": newest}
    return found


def _unseen(people: HumanStates, name: str) -> float | None:
    """Time since a camera last saw the joints of a limb [s]; None for the lower body and for a limb not seen before.

    Args:
        people: The fused people at the tick.
        name: Name of the limb's volume.
    """
    for row, number in enumerate(people.numbers.tolist()):
        for k, limb in enumerate(LIMBS):
            since = people.unseen_s[row, k]
            if name == of_person(limb, number) and np.isfinite(since):
                return float(since)
    return None


def _described(people: HumanStates, row: int, fresh_s: float) -> dict[str, Any]:
    """The facts about one of several people at a tick: number, state, and age of the newest frame [s]."""
    age_s = float(people.frame_age_s[row])
    fused = "known" if age_s <= fresh_s else "unknown, as no camera shows this person"
    state = fused if np.isfinite(people.p[row, 0]) else "only just seen: counts by the points alone"
    return {"person": int(people.numbers[row]), "state": state, "frame_age_s": age_s if np.isfinite(age_s) else None}


def _named(found: dict[str, Any], links: Sequence[str], limbs: Sequence[str]) -> dict[str, Any]:
    """Replaces the numbers of links and limbs by their names, at any depth."""
    named: dict[str, Any] = {}
    for key, value in found.items():
        if key in ("link", "other_link", "limb"):
            named[key] = (limbs if key == "limb" else links)[value]
        elif isinstance(value, dict):
            named[key] = _named(value, links, limbs)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            named[key] = [_named(part, links, limbs) for part in value]
        else:
            named[key] = value
    return named


def longest_stops(motion: RunTable, slow_m_per_s: float, most: int = 10) -> Ints:
    """Returns (k, 2) the longest stretches of ticks, [first, past the last), of an unplanned standstill.

    Args:
        motion: A table of motion.
        slow_m_per_s: A TCP slower than this counts as stationary [m/s].
        most: Maximum number of stretches.
    """
    _, standing = stationary(motion, np.inf, slow_m_per_s)
    runs = true_runs(standing)
    return runs[np.argsort(runs[:, 0] - runs[:, 1], kind="stable")[:most]]


def sentences(found: Mapping[str, Any]) -> list[str]:
    """Returns the facts of a tick in words, the cause first.

    Args:
        found: Result of ``facts``.
    """
    lines = [f"{found['at_s']:.3f} s, tick {found['tick']}, {found['method']}: {_state(found)}."]
    lines += [f"Cause: {cause(found)}."]
    if "nearest" in found and found["horizon_s"] is not None:
        near = found["nearest"]
        apart = f"{1e3 * near['overlap_m']:.1f} mm deep" if near["overlap_m"] else f"{1e3 * near['distance_m']:.1f} mm"
        lines.append(
            f"Nearest: {_pair(near)}, {apart}; volumes up to {1e3 * found['horizon_s']:.0f} ms after the tick."
        )
    if "body" in found:
        body = found["body"]
        apart = f"{1e3 * body['distance_m']:.1f} mm between their surfaces"
        lines.append(f"Recorded body ({body['source']}): {_pair(body)}, {apart}.")
    for method, did in found.get("beside", {}).items():
        lines.append(f"Beside it, {method}: {_state(did)}.")
    for near in (found[key] for key in ("nearest_object", "nearest_links") if key in found):
        lines.append(f"Nearest of the cell: {_pair(near)}, {1e3 * near['distance_m']:.1f} mm.")
    lines += [f"Active row: {_row(row)}, multiplier {row['multiplier']:.3g}." for row in _weighted(found)[1:]]
    lines += [f"Limit that holds: {_row(row)}." for row in found.get("limits", ())]
    lines += [f"Next row: {_row(row)}, {1e3 * row['margin_m_per_s']:.1f} mm/s left." for row in found.get("next", ())]
    for stop, one in zip(("first", "second"), found.get("refused", ()), strict=False):
        lines.append(f"The {stop} stop proposed, {1e3 * one['stop_s']:.0f} ms long: {_failure(one)}.")
    if found.get("unseen_s") is not None:
        lines.append(f"That limb was last seen {1e3 * found['unseen_s']:.0f} ms before.")
    for one in found.get("people", ()):
        aged = "" if one["frame_age_s"] is None else f", newest frame {1e3 * one['frame_age_s']:.0f} ms old"
        lines.append(f"Person {one['person']}: {one['state']}{aged}.")
    if "watched" in found:
        lines += [_watched_text(found["watched"])]
    for camera, ages in found["cameras"].items():
        used, newest = ages["used_s_ago"], ages["newest_frame_s_ago"]
        words = "not used yet" if used is None else f"last used {1e3 * used:.0f} ms before"
        lines.append(
            f"Camera {camera}: {words}" + (f", its newest frame {1e3 * newest:.0f} ms old." if newest else ".")
        )
    return lines


def _watched_text(since_s: Mapping[str, float | None]) -> str:
    """Time since the watched area was without people, in words."""
    parts = [
        f"{whom} {'never' if since is None else f'{1e3 * since:.0f} ms before'}"
        for whom, since in (("anybody", since_s["nobody_s"]), ("anybody but the person", since_s["nobody_else_s"]))
    ]
    return f"The watched area was last known to be without {' and without '.join(parts)}."


def _state(found: Mapping[str, Any]) -> str:
    speed = found["tcp_speed_m_per_s"]
    if speed is None:
        return f"the robot is not known ({found['reason']})"
    moved = "the robot stood" if speed < _STANDS else f"the TCP moved at {speed:.3f} m/s"
    return f"{moved}, {found['status']}" + (f" ({found['reason']})" if found["reason"] else "")


def cause(found: Mapping[str, Any]) -> str:
    """Returns the cause that limited the robot, as a sentence without its full stop."""
    if found["method"] == RECORDED:
        return "not known, as the log says where the robot was, not why"
    if found.get("conflict"):
        return f"no velocity keeps all of these: {'; '.join(_row(row) for row in found['conflict'])}"
    if found.get("refused"):
        return f"no certificate: {_failure(found['refused'][0])}"
    if "protective" in found and found["reason"] == "too near":
        near = found["protective"]
        apart = f"{1e3 * near['distance_m']:.1f} mm apart, and {1e3 * near['needed_m']:.1f} mm are needed"
        return f"{_pair(near)} are {apart}"
    if found["reason"] == "inside a volume" and "nearest" in found:
        return f"{_pair(found['nearest'])} overlap by {1e3 * found['nearest']['overlap_m']:.1f} mm"
    if found["reason"]:
        return reason_text(found["reason"])
    if rows := _weighted(found):
        return _row(rows[0])
    return "no person: its programme, or the robot's own limits"


def _weighted(found: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Returns the active rows of people, the largest multiplier first; for ``scaling`` the tightest row."""
    return [{"multiplier": 1.0, **row} for row in found.get("binding", ())]


def _pair(of: Mapping[str, Any]) -> str:
    if "limb" in of:
        return f"{of['link']} and {neighbour_text(of['limb'])}"
    other = of["other_link"] if "other_link" in of else f"the object {of['object']}"
    return f"{of['link']} and {other}"


def _row(row: Mapping[str, Any]) -> str:
    """Describes a row in words."""
    if row["kind"] == "axis":
        return f"axis {row['axis']}, {row['side']} bound on its next velocity"
    if row["kind"] == "tcp":
        turn = "turning about" if row["direction"] >= 3 else "along"
        return f"TCP {turn} {'xyz'[row['direction'] % 3]}, {row['side']} bound"
    if row["kind"] == "speed":
        return "TCP, the programme's speed limit"
    if row["kind"] == "contact":
        return f"{row['link']} may move at {row['speed_m_per_s']:.3f} m/s beside {neighbour_text(row['beside'])}"
    if row["kind"] == "path":
        return str(row["what"])
    if row["kind"] in ("object", "self"):
        return f"{_pair(row)}, {('first', 'second')[row['end']]} end of the link"
    at = ", ".join(f"{value:.3f}" for value in row["vertex_m"])
    which = ("first", "second")[row["end"]]
    return f"{_pair(row)}, {which} row of Eq. (12), vertex {row['vertex']} at ({at}) m"


def _failure(one: Mapping[str, Any]) -> str:
    """Describes in words the place at which a stop is not clear."""
    if "link" not in one:
        return one["why"] + (f", axis {one['axis']}" if "axis" in one else "")
    when = f"{1e3 * one['failed_s']:.0f} ms after the tick"
    if one["gap_m"] <= 0.0:
        return f"{_pair(one)} overlap by {-1e3 * one['gap_m']:.1f} mm {when}"
    moves = f"may move by {1e3 * one['travel_m']:.1f} mm until the next"
    return f"{_pair(one)} are {1e3 * one['gap_m']:.1f} mm apart {when}, and {moves}"


def stop_table(record: Record, slow_m_per_s: float) -> tuple[PageTable, list[dict[str, Any]]]:
    """Returns the longest stops of a run, and the facts of the first tick of each.

    Args:
        record: Record of the run.
        slow_m_per_s: A TCP slower than this counts as stationary [m/s].
    """
    rows, every, t_ns = [], [], record.motion["t_ns"].to_numpy()
    for first, past in longest_stops(record.motion, slow_m_per_s).tolist():
        found = facts(record, first)
        lasted_s = float(t_ns[past - 1] - t_ns[first]) * 1e-9 + record.controller.settings.dt_s
        at_s = float(t_ns[first] - t_ns[0]) * 1e-9
        words = reason_text(str(record.motion["reason"].iloc[first] or "")) if found is None else cause(found)
        rows.append((f"{at_s:.2f} s", f"{lasted_s:.2f} s", str(record.motion["status"].iloc[first]), words))
        every.append({"at_s": at_s, "duration_s": lasted_s, "cause": words})
    note = "Cause at the first tick of each stop. hrcreplay why RUN --at SECONDS explains any tick."
    return PageTable("The longest stops", ("at", "for", "status", "held by"), tuple(rows), note), every
