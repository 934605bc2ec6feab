"""A scene whose robot has meshes, which the IRB 140 has not."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping

import numpy as np
from scipy.spatial import ConvexHull

from hrcreplay.records import Floats
from hrcreplay.report.replay_scene import LinkMesh, ReplayScene


def box_on(seed: int) -> Floats:
    """(8, 3) corners of a box about the origin, of its own size and turn."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * rng.uniform(0.05, 0.2, 3) @ turn.T


def with_meshes(scene: ReplayScene, corners_m: Mapping[int, Floats]) -> ReplayScene:
    """The same scene with a convex mesh about the middle of some links."""
    meshes = tuple(
        LinkMesh(link, corners + scene.robot.ends_m[link].mean(axis=0), ConvexHull(corners).simplices.astype(np.int64))
        for link, corners in corners_m.items()
    )
    return dataclasses.replace(scene, robot=dataclasses.replace(scene.robot, meshes=meshes))
