"""Which chain of a URDF is the robot, and which joints are held."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from hrcreplay.errors import SettingsError
from hrcreplay.pipeline.assembly import _robot as build_robot
from hrcreplay.pipeline.run_config import UrdfFiles
from hrcreplay.robot.model import from_urdf
from hrcreplay.robot.urdf import describe, disabled_pairs
from hrcreplay.settings.load import load_settings
from tests.facts import facts
from tests.robot.test_model import AT_ORIGIN, joint, link, pedestal, robot_xml

BALL = "<sphere radius='0.05'/>"


def arm(*more: str) -> str:
    """Two axes and a hand, and what else is given."""
    return robot_xml(
        link("base", BALL),
        link("upper", BALL),
        link("hand", BALL),
        joint("one", "base", "upper"),
        joint("two", "upper", "hand"),
        *more,
    )


def finger(name: str, kind: str, extra: str = "") -> str:
    return link(name, BALL) + joint(f"grip_{name}", "hand", name, kind=kind, extra=extra)


MIMIC = "<mimic joint='grip_left'/>"


@pytest.mark.parametrize(
    ("more", "tcp"),
    [
        ("", "hand"),
        (link("tool0") + joint("f", "hand", "tool0", kind="fixed"), "tool0"),
        # a frame of its own goes before a finger that is fixed deeper in the tree
        (
            link("pad", BALL)
            + joint("f1", "hand", "pad", kind="fixed")
            + link("tip", BALL)
            + joint("f2", "pad", "tip", kind="fixed")
            + link("tool0")
            + joint("f3", "hand", "tool0", kind="fixed"),
            "tool0",
        ),
        (finger("left", "prismatic") + finger("right", "prismatic", MIMIC), "hand"),
        (finger("left", "revolute") + finger("right", "revolute", MIMIC), "hand"),
        (finger("left", "revolute") + finger("right", "revolute"), "hand"),
        (finger("left", "revolute"), "left"),  # nothing tells a jaw from an axis
    ],
)
def test_the_tool_is_on_the_last_frame_that_axes_of_rotation_move(more: str, tcp: str) -> None:
    assert describe(arm(more)).tcp == tcp


def test_of_two_arms_one_has_to_be_named() -> None:
    second = link("other", BALL) + joint("a", "base", "other") + link("end", BALL) + joint("b", "other", "end")
    with pytest.raises(SettingsError, match=facts("2 axes", "hand, end", "robot.tcp_frame")):
        describe(arm(second))
    found = describe(arm(second), "end")
    assert found.joints == ("a", "b")
    assert found.locked == ("one", "two")
    assert [shape.link for shape in found.shapes] == ["other", "end"]


def test_joints_off_the_chain_are_held_at_zero_or_at_the_nearest_end_of_their_range() -> None:
    away = "<limit lower='0.3' upper='0.9' velocity='3' effort='0'/>"
    slide = finger("left", "prismatic").replace("<limit lower='-2' upper='1.5' velocity='3' effort='0'/>", away)
    robot = from_urdf(arm(slide), AT_ORIGIN, stop_s=0.5)
    assert robot.locked == ("grip_left",)
    assert [segment.name for segment in robot.segments] == ["upper", "hand", "left"]
    # 0.5 m up to each joint, and the finger 0.3 m out along its axis y
    assert_allclose(robot.pose(np.zeros(2), np.zeros(2)).ends_m[2, 0], [0.0, 0.3, 1.5])
    turned = robot.pose(np.array([0.0, np.pi / 2]), np.zeros(2))
    assert_allclose(turned.ends_m[2, 0], [0.5, 0.3, 1.0], atol=1e-12)


def test_what_lies_before_another_base_is_held_and_the_base_is_where_it_was_put() -> None:
    xml = robot_xml(
        link("rail", BALL),
        link("cart", BALL),
        joint("slide", "rail", "cart", kind="prismatic"),
        arm().split("<robot name='other'>")[1].removesuffix("</robot>"),
        joint("mount", "cart", "base", kind="fixed", xyz="0.4 0 0.2"),
    )
    with pytest.raises(SettingsError, match=facts("'slide'", "prismatic", "robot.base_frame")):
        describe(xml)
    robot, alone = (from_urdf(text, pedestal(), stop_s=0.5, base_frame="base") for text in (xml, arm()))
    assert robot.locked == ("slide",)
    assert robot.base_frame == "base"
    q = np.array([0.4, -0.9])
    assert_allclose(robot.pose(q, q).T_world_tcp, alone.pose(q, q).T_world_tcp, atol=1e-12)
    assert_allclose(robot.pose(q, q).ends_m, alone.pose(q, q).ends_m, atol=1e-12)
    with pytest.raises(SettingsError, match=facts("robot.base_frame", "'x'", "rail, cart")):
        describe(xml, base_frame="x")
    with pytest.raises(SettingsError, match=facts("'hand'", "robot.base_frame")):
        describe(xml, base_frame="hand")


def test_a_joint_off_the_arm_with_the_name_of_a_link_is_told() -> None:
    claw = link("claw", BALL) + joint("claw", "hand", "claw", kind="prismatic")
    claw += link("tip", BALL) + joint("end", "claw", "tip", kind="fixed")
    with pytest.raises(SettingsError, match=facts("claw", "rename")):
        from_urdf(arm(claw), AT_ORIGIN, stop_s=0.5)


def test_the_tcp_is_beyond_the_flange_by_the_offset_too() -> None:
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    T[:3, 3] = 0.1, 0.2, 0.3
    robot = from_urdf(arm(), AT_ORIGIN, stop_s=0.5, tool_m=0.05, T_tool_tcp=T)
    tcp = robot.pose(np.zeros(2), np.zeros(2)).T_world_tcp
    assert_allclose(tcp[:3, 3], [0.1, 0.2, 1.0 + 0.05 + 0.3])
    assert_allclose(tcp[:3, :3], T[:3, :3])
    assert robot.tcp_outside_m == pytest.approx(np.sqrt(0.1**2 + 0.2**2 + 0.35**2) - 0.05)
    assert from_urdf(arm(), AT_ORIGIN, stop_s=0.5).tcp_outside_m == 0.0


@pytest.mark.parametrize("text", ["", arm()])
def test_the_capsule_that_is_proposed_guards_the_tool(text: str) -> None:
    files = UrdfFiles(text, (), ()) if text else None
    offset = "robot.tcp_offset={position_m = [0.1, 0.2, 0.3]}"
    bare = build_robot(load_settings(None, (offset,)).robot, files, 0.5, AT_ORIGIN)
    assert bare.unguarded_tool is not None
    assert f"{bare.tcp_outside_m:.3f} m" in bare.unguarded_tool
    setting = bare.unguarded_tool[bare.unguarded_tool.index("robot.tool_links") :].replace(" = ", "=", 1)
    guarded = build_robot(load_settings(None, (offset, setting)).robot, files, 0.5, AT_ORIGIN)
    assert guarded.unguarded_tool is None
    assert repr(guarded.segments[:-1]) == repr(bare.segments)  # some volumes are NaN, which equals nothing
    q = np.linspace(0.1, 0.6, guarded.nv)
    tcp, ends = guarded.pose(q, q).T_world_tcp[:3, 3], guarded.ends_m(q)[-1]
    assert_allclose(ends[1], tcp, atol=1e-3)
    assert build_robot(load_settings().robot, None, 0.5, AT_ORIGIN).unguarded_tool is None


def test_macros_are_no_urdf() -> None:
    xml = "<robot name='a' xmlns:xacro='http://www.ros.org/wiki/xacro'><xacro:arm/><link name='b'/></robot>"
    with pytest.raises(SettingsError, match=facts("xacro FILE.xacro")):
        describe(xml)
    expanded = arm().replace("<robot ", "<robot xmlns:xacro='http://www.ros.org/wiki/xacro' ")
    assert describe(expanded).joints == ("one", "two")


def test_an_srdf_names_the_pairs_that_are_not_kept_apart() -> None:
    pairs = "<disable_collisions link1='b' link2='a' reason='Adjacent'/><disable_collisions link1='a' link2='c'/>"
    assert disabled_pairs(f"<robot name='r'><group name='arm'/>{pairs}</robot>") == (("a", "c"), ("b", "a"))
    for text in ("<robot", "<semantic/>", "<robot><disable_collisions link1='a'/></robot>"):
        with pytest.raises(SettingsError, match=r"robot\.srdf"):
            disabled_pairs(text)
