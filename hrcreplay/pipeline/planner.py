"""Runs a method beside the people of each batch: in one kernel where it can, otherwise tick by tick in Python."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hrcreplay.kernels import Held
from hrcreplay.pipeline.batch.ticks import MotionColumns, Moving, PeopleAhead, Way, empty_columns, run_ticks
from hrcreplay.pipeline.surroundings import Forecast
from hrcreplay.records import RECORDED, Ints, Motion
from hrcreplay.robot.control.control_step import REASONS
from hrcreplay.robot.control.controllers import (
    BlindController,
    Controller,
    PathController,
    QpController,
    ScalingController,
)
from hrcreplay.robot.control.static_obstacles import StaticObstacles
from hrcreplay.robot.model import RobotModel

#: The methods that the kernel knows.
_WAYS: dict[type[Controller], Way] = {
    QpController: Way(by_qp=True, careful=True, by_rows=True),
    **{
        path: Way(by_qp=False, careful=path.careful, by_rows=path.by_rows)
        for path in (PathController, ScalingController, BlindController)
    },
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
        way, tick, patience = _WAYS.get(type(self.controller)), 0, 1
        while tick < len(t_ns):
            last = len(t_ns)
            if way is not None and outlook.ahead is not None:
                done = self._run(way, outlook.person.held, outlook.ahead, columns, tick)
                patience = 1 if done > tick else min(2 * patience, _MOST_LEFT)
                tick, last = done, min(done + patience, len(t_ns))
            for one in range(tick, last):
                self._step(outlook, one, columns)
            tick = last
        links = tuple(segment.name for segment in self.robot.segments)
        return Motion(t_ns=t_ns, **columns._asdict(), limbs=limbs, links=links, reasons=REASONS)

    def _run(self, way: Way, person: Held | None, people: PeopleAhead, columns: MotionColumns, tick: int) -> int:
        """Moves the robot in the kernel as far as it can from a tick on; returns the first tick that is not done."""
        own = self.controller
        if not way.by_qp and np.isnan(own.stop.along[0, 0]):
            return tick  # it continues the stop of another method
        done, moving = run_ticks(own.scene, way, person, people, Moving(own.moment, own.point), columns, tick)
        (own.stop, own.u, own.s_s, _, own.planes), own.point = moving
        return done

    def _step(self, outlook: Forecast, tick: int, columns: MotionColumns) -> None:
        """One tick in Python."""
        row = self.controller.step(outlook.predict(tick)).row
        for name, column in columns._asdict().items():
            column[tick] = getattr(row, name) if name != "reason" else REASONS.index(row.reason)
