from __future__ import annotations

import tomllib
from importlib import resources
from typing import Any

import pytest

from hrcreplay.errors import SettingsError
from hrcreplay.robot import task as task_module
from hrcreplay.robot.task import parse_task
from tests.facts import facts


def example() -> dict[str, Any]:
    """The commented task file of ``hrcreplay init``, which is the format's documentation."""
    return tomllib.loads(template())


def template() -> str:
    return (resources.files("hrcreplay.commands") / "task_template.toml").read_text("utf-8")


def pair(**second: Any) -> dict[str, Any]:
    return {"waypoints": [{"joints_deg": [0.0]}, second]}


def test_the_documented_example_is_a_task() -> None:
    task = parse_task(example())
    assert task.repeat
    assert [w.name for w in task.waypoints] == ["home", "above the rack", "rack"]
    assert task.waypoints[0].joints_deg == (0, 0, 0, 0, 90, 0)
    assert task.waypoints[2].position_m == (0.45, 0.30, 0.10)
    assert [w.move for w in task.waypoints] == ["joint", "joint", "linear"]
    assert task.waypoints[2].dwell_s == 0.5
    assert (task.speed, task.acceleration, task.tcp_speed_m_per_s) == (0.6, 0.5, 1.0)


def test_the_example_gives_every_key_but_the_alternatives() -> None:
    given = set(example()) | {key for waypoint in example()["waypoints"] for key in waypoint}
    known = set(task_module.Task.model_fields) | set(task_module.Waypoint.model_fields)
    assert known - given == {"cycles", "joints_rad", "quaternion_wxyz"}
    for key in known - given:
        assert key in template()


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({}, "task: waypoints | missing"),
        ({"waypoints": []}, "task: waypoints | []"),
        ({"waypoints": 3}, "task: waypoints | 3 | list"),
        ({"waypoints": [{"joints_deg": [0]}, 7]}, "task: waypoint 2 | 7 | table"),
        (pair(), "task: waypoint 2 | none | joints_deg"),
        (pair(joints_deg=[1], joints_rad=[1]), "waypoint 2 | joints_deg and joints_rad"),
        (pair(position_m=[1, 2, 3]), "waypoint 2 | position_m with none | rpy_deg"),
        (pair(joints_deg=[1], rpy_deg=[1, 2, 3]), "waypoint 2 | joints_deg with rpy_deg"),
        (
            pair(position_m=[1, 2, 3], rpy_deg=[0, 0, 0], quaternion_wxyz=[1, 0, 0, 0]),
            "waypoint 2 | rpy_deg and quaternion_wxyz",
        ),
        (pair(position_m=[1, 2, 3], quaternion_wxyz=[0, 0, 0, 0]), "waypoint 2 | quaternion_wxyz | 0"),
        (pair(position_m=[1, 2], rpy_deg=[0, 0, 0]), "waypoint 2: position_m.2 | missing"),
        (pair(joints_deg=[float("nan")]), "waypoint 2: joints_deg.0 | nan"),
        (pair(joints_deg=[1], move="arc"), "waypoint 2: move | 'arc' | 'joint' | 'linear'"),
        (pair(joints_deg=[1], dwell_s=-1), "waypoint 2: dwell_s | -1"),
        (pair(joints_deg=[1], mvoe="linear"), "waypoint 2 | 'mvoe' | move"),
        (pair(joints_deg=[1]) | {"sped": 0.5}, "task | 'sped' | speed"),
        (pair(joints_deg=[1]) | {"speed": 1.5}, "task: speed | 1.5 | 1"),
        (pair(joints_deg=[1]) | {"cycles": 2, "repeat": True}, "repeat = true | cycles = 2"),
    ],
)
def test_what_cannot_be_used_is_named(table: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=facts(*message.split(" | "))):
        parse_task(table)


def test_messages_begin_with_the_place() -> None:
    with pytest.raises(SettingsError, match=r"^cell/pick\.toml: waypoint 2"):
        parse_task(pair(), where="cell/pick.toml")
