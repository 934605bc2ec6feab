"""Does a robot ever touch an object of its cell, its own links or the floor: in any tick, and in any stop after one?

The check shares nothing with the certificate: kinematics from the DH table of the data sheet, the motion within a tick
as the parabola it is, and distances between capsules, boxes and meshes by coal.

    python -m tests.tools.object_overlaps datasets/demo.mcap --cell datasets/demo_cell.toml --start 6 --end 30
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import coal
import numpy as np
from scipy.spatial import ConvexHull

from hrcreplay.calibration.cell_objects import CellObject
from hrcreplay.logs.reader import open_log
from hrcreplay.pipeline import assembly, stages
from hrcreplay.pipeline.run_config import RunConfig, resolve
from hrcreplay.pipeline.surroundings import Forecast
from hrcreplay.records import Floats, HumanStates
from hrcreplay.robot.control.controllers import Controller
from hrcreplay.robot.control.static_obstacles import StaticObstacles
from hrcreplay.robot.control.stops import Stop
from hrcreplay.settings.sections import Plan
from hrcreplay.store.run_folder import Stopwatch
from tests.robot import checker

DT_S = 0.004
#: A half-space as a box of this size [m].
WIDE_M = 100.0
#: Instants between two rows of a stop.
BETWEEN = 3


@dataclass
class Shapes:
    """Objects of a cell as coal's shapes."""

    names: list[str] = field(default_factory=list)
    shapes: list[coal.CollisionObject] = field(default_factory=list)


def shapes_of(objects: tuple[CellObject, ...], T_world_base: Floats) -> Shapes:
    """Makes coal's own shapes of the keys of a cell file; a cylinder is a cylinder here, and hulls are meshes."""
    found = Shapes()
    for one in objects:
        T = (T_world_base if one.frame == "base" else np.eye(4)) @ one.T_frame_object()
        for geometry, own in _geometries(one):
            pose = T @ own
            found.names.append(one.name)
            found.shapes.append(coal.CollisionObject(geometry, coal.Transform3s(pose[:3, :3], pose[:3, 3])))
    return found


def _geometries(one: CellObject) -> Iterator[tuple[coal.CollisionGeometry, Floats]]:
    own = np.eye(4)
    if one.shape == "box" and one.size_m is not None:
        yield coal.Box(*one.size_m), own
    elif one.shape == "sphere" and one.radius_m is not None:
        yield coal.Sphere(one.radius_m), own
    elif one.shape == "capsule" and one.radius_m is not None:
        yield coal.Capsule(one.radius_m, one.length_m), own
    elif one.shape == "cylinder" and one.radius_m is not None:
        yield coal.Cylinder(one.radius_m, one.length_m), own
    elif one.normal is not None:
        z = np.array(one.normal) / np.linalg.norm(one.normal)
        x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
        x /= np.linalg.norm(x)
        own[:3, :3] = np.column_stack([x, np.cross(z, x), z])
        own[:3, 3] = -0.5 * WIDE_M * z
        yield coal.Box(WIDE_M, WIDE_M, WIDE_M), own
    else:
        for points, _ in one.parts():
            yield _mesh(points), own


def _mesh(points: Floats) -> coal.CollisionGeometry:
    hull = ConvexHull(points)
    vertices, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for point in points:
        vertices.append(point)
    for a, b, c in hull.simplices.tolist():
        triangles.append(coal.Triangle(a, b, c))
    return coal.Convex(vertices, triangles)


def instants(before: Stop, stop: Stop) -> Floats:
    """(n, nv) joint positions from a step's beginning to standstill: parabolas between the rows."""
    q, dq = np.vstack((before.q[:1], stop.q)), np.vstack((before.dq[:1], stop.dq))
    if len(q) == 1:
        return q
    u = np.diff(dq, axis=0) / DT_S
    t = np.arange(BETWEEN)[:, None] * (DT_S / BETWEEN)
    inner = (q[:-1, None] + t * dq[:-1, None] + 0.5 * t**2 * u[:, None]).reshape(-1, q.shape[1])
    return np.vstack((inner, q[-1:]))


@dataclass
class Overlaps:
    """The smallest distances found, surface to surface [m]."""

    ticks: int = 0
    poses: int = 0
    objects: dict[tuple[str, str], float] = field(default_factory=dict)  #: by link and object
    links: dict[tuple[str, str], float] = field(default_factory=dict)  #: by link and other link


class Brute:
    """Measures poses of the IRB 140."""

    def __init__(self, controller: Controller, shapes: Shapes, tool_m: float) -> None:
        self._robot, self._shapes, self._tool_m = controller.robot, shapes, tool_m
        self._names = [segment.name for segment in controller.robot.segments]
        static = controller.static
        assert isinstance(static, StaticObstacles)
        self._pairs = [tuple(pair) for pair in static.pairs.tolist()]
        self._request = coal.DistanceRequest()
        self.found = Overlaps()

    def look(self, q: Floats) -> None:
        """Measures all links at poses (n, 6)."""
        ends, _ = checker.links(q, np.zeros_like(q), self._robot.T_world_base, self._tool_m)
        for row in ends:
            self.found.poses += 1
            capsules = [self._capsule(a, b, r) for (a, b), r in zip(row, checker.RADII, strict=True)]
            for link, capsule in zip(self._names, capsules, strict=True):
                for name, shape in zip(self._shapes.names, self._shapes.shapes, strict=True):
                    key = link, name
                    self.found.objects[key] = min(self.found.objects.get(key, np.inf), self._distance(capsule, shape))
            for one, two in self._pairs:
                key = self._names[one], self._names[two]
                apart = self._distance(capsules[one], capsules[two])
                self.found.links[key] = min(self.found.links.get(key, np.inf), apart)

    def _distance(self, one: coal.CollisionObject, two: coal.CollisionObject) -> float:
        result = coal.DistanceResult()
        return float(coal.distance(one, two, self._request, result))

    @staticmethod
    def _capsule(a: Floats, b: Floats, radius: float) -> coal.CollisionObject:
        along = b - a
        length = float(np.linalg.norm(along))
        z = along / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
        x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
        x /= np.linalg.norm(x)
        turn = np.column_stack([x, np.cross(z, x), z])
        return coal.CollisionObject(coal.Capsule(radius, length), coal.Transform3s(turn, 0.5 * (a + b)))


def states_of(run_config: RunConfig) -> HumanStates:
    """The fused person of a run."""
    log = open_log(run_config.log, run_config.settings.logs)
    ticks = stages.span_ticks(run_config, log)
    sink = stages.Sink(_Nowhere(), Stopwatch(lambda: 0), lambda _stage, _ticks: None)
    fused = stages.fuse_batches(log, ticks, 250, assembly.fusion_stage(run_config, log), sink)
    return HumanStates.join(list(fused))


class _Nowhere:
    def table(self, name: str, columns: object, /) -> None:
        """Forgets rows."""


def check(run_config: RunConfig, method: str = "qp", every: int = 1) -> Overlaps:
    """Plans a run and measures each tick, and the stop after one tick in ``every``."""
    own = run_config.settings.plan.model_copy(update={"method": method, "baselines": ()})
    assert isinstance(own, Plan)
    settings = run_config.settings.model_copy(update={"plan": own})
    run_config = RunConfig(**{**vars(run_config), "settings": settings})
    states, log = states_of(run_config), open_log(run_config.log, run_config.settings.logs)
    model = assembly.robot(run_config, assembly.robot_base(run_config, log))
    programme = assembly.programme(run_config, log, model)
    (planner,) = assembly.planners(run_config, programme, int(states.t_ns[0])).values()
    controller, robot = planner.controller, planner.controller.robot
    assert run_config.cell is not None
    brute = Brute(controller, shapes_of(run_config.cell.objects, robot.T_world_base), settings.robot.tool_m)
    forecast = Forecast(assembly.surroundings(run_config, robot), states)
    for tick in range(len(forecast.t_ns)):
        before = controller.stop
        taken = controller.step(forecast.predict(tick))
        brute.look(taken.state.q[None])
        if tick % every == 0:
            brute.look(instants(before, taken.step.stop))
        brute.found.ticks += 1
    return brute.found


def main() -> None:
    """Prints the smallest distance of every pair."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.object_overlaps", description=__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("--cell", type=Path, required=True)
    parser.add_argument("--start", type=float)
    parser.add_argument("--end", type=float)
    parser.add_argument("--method", default="qp")
    parser.add_argument("--every", type=int, default=1)
    given = parser.parse_args()
    run_config = resolve("plan", given.log, cell_file=given.cell, start_s=given.start, end_s=given.end)
    found = check(run_config, given.method, given.every)
    print(f"{found.ticks} ticks, {found.poses} poses")  # noqa: T201
    for (link, other), apart in sorted({**found.objects, **found.links}.items()):
        print(f"{link:>12} {other:<12} {1e3 * apart:9.2f} mm")  # noqa: T201


if __name__ == "__main__":
    main()
