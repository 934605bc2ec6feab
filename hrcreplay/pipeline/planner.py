"""Runs a method beside the people of each batch: in one kernel where it can, otherwise tick by tick in Python."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hrcreplay.kernels import Held
from hrcreplay.pipeline.batch.ticks import (
    LEFT,
    MotionColumns,
    Moving,
    PeopleAhead,
    Way,
    empty_columns,
    look_after,
    run_blindly,
    run_ticks,
)
from hrcreplay.pipeline.surroundings import Forecast
from hrcreplay.records import RECORDED, Ints, Motion
from hrcreplay.robot.control.control_step import (
    REASONS,
    RobotState,
    nearest_of,
    observe,
)
from hrcreplay.robot.control.controllers import (
    BlindController,
    Controller,
    PathController,
    QpController,
    ScalingController,
)
from hrcreplay.robot.control.static_obstacles import StaticObstacles
from hrcreplay.robot.model import RobotModel

#: The methods beside people that the kernel knows.
_WAYS: dict[type[Controller], Way] = {
    QpController: Way(by_qp=True, by_rows=True),
    **{path: Way(by_qp=False, by_rows=path.by_rows) for path in (PathController, ScalingController)},
}
#: Approximate relative time of a tick by method: of tasks in several processes the long ones start first.
METHOD_COST = {"qp": 5, "ssm": 4, "pfl": 4, "none": 3, "shield": 3, "scaling": 3, RECORDED: 2}
#: Largest number of ticks in Python after one that the kernel does not decide: others like it often follow.
_MOST_LEFT = 16


@dataclass
class Planner:
    """Runs one method near the people of each tick."""

    controller: Controller
    chosen: bool  #: the run's method, not a baseline

    @property
    def robot(self) -> RobotModel:
        """The robot."""
        return self.controller.robot

    @property
    def static(self) -> StaticObstacles | None:
        """Objects of the cell and pairs of links; None: there are none."""
        return self.controller.static

    @property
    def dt_s(self) -> float:
        """The time between two ticks [s]."""
        return self.controller.settings.dt_s

    def follow(self, t_ns: Ints, outlook: Forecast, limbs: tuple[str, ...]) -> Motion:
        """The motion of a batch of ticks with the predicted volumes of each; ``limbs`` names all possible volumes."""
        columns = empty_columns(len(t_ns), self.robot.nv)
        if isinstance(self.controller, BlindController):
            self._go_blindly(outlook, columns)
        else:
            self._go(outlook, columns)
        links = tuple(segment.name for segment in self.robot.segments)
        return Motion(t_ns=t_ns, **columns._asdict(), limbs=limbs, links=links, reasons=REASONS)

    def _go(self, outlook: Forecast, columns: MotionColumns) -> None:
        """Moves a robot that heeds people."""
        way, tick, patience = _WAYS.get(type(self.controller)), 0, 1
        while tick < len(columns.status):
            last = len(columns.status)
            if way is not None and outlook.ahead is not None:
                done = self._run(way, outlook.person.held, outlook.ahead, columns, tick)
                patience = 1 if done > tick else min(2 * patience, _MOST_LEFT)
                tick, last = done, min(done + patience, last)
            for one in range(tick, last):
                self._step(outlook, one, columns)
            tick = last

    def _run(self, way: Way, prepared: Held | None, people: PeopleAhead, columns: MotionColumns, tick: int) -> int:
        """Moves the robot in the kernel as far as it can from a tick on; returns the first tick that is not done."""
        own = self.controller
        if not way.by_qp and not self._on_path:
            return tick  # it continues the stop of another method
        done, moving = run_ticks(own.scene, way, prepared, people, Moving(own.moment, own.point), columns, tick)
        self._take(moving)
        return done

    def _go_blindly(self, outlook: Forecast, columns: MotionColumns) -> None:
        """Moves a robot that ignores people, and only then measures its distances from them."""
        own, tick = self.controller, 0
        while tick < len(columns.status) and not self._on_path:  # it continues the stop of another method
            self._step(outlook, tick, columns)
            tick += 1
        self._take(run_blindly(own.scene, Moving(own.moment, own.point), columns, tick))
        by_hand = np.arange(tick, len(columns.status))
        if outlook.ahead is not None:
            look_after(own.scene, outlook.person.held, outlook.ahead, columns, tick)
            by_hand = by_hand[outlook.ahead.what[tick:] == LEFT]
        for one in by_hand.tolist():
            self._look(outlook, one, columns)

    @property
    def _on_path(self) -> bool:
        """Whether the robot's stop is one along its path."""
        return not np.isnan(self.controller.stop.along[0, 0])

    def _take(self, moving: Moving) -> None:
        """Gives the controller the robot and the reference from the kernel."""
        own = self.controller
        (own.stop, own.u, own.s_s, _, own.planes), own.point = moving

    def _step(self, outlook: Forecast, tick: int, columns: MotionColumns) -> None:
        """One tick in Python."""
        row = self.controller.step(outlook.predict(tick)).row
        for name, column in columns._asdict().items():
            column[tick] = getattr(row, name) if name != "reason" else REASONS.index(row.reason)

    def _look(self, outlook: Forecast, tick: int, columns: MotionColumns) -> None:
        """Measures the distances of one tick in Python."""
        people = outlook.obstacles(tick, float(columns.horizon_s[tick]))
        state = RobotState(columns.q[tick], columns.dq[tick])
        sight = observe(self.robot, state, people, self.controller.settings.plan.clearance_m)
        for name, value in nearest_of(sight).items():
            getattr(columns, name)[tick] = value
