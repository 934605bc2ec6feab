from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from hrcreplay.errors import SettingsError
from hrcreplay.records import Floats
from hrcreplay.robot.model import RobotModel, Segment, from_urdf, irb140
from tests.facts import facts

STOP_S = 0.377
AT_ORIGIN = np.eye(4)

#: Wrist centre (x, z) [mm] of the product specification for (axis 2, axis 3) [deg], the others zero.
GOLDEN = (
    ((450, 712), (0, 0)),
    ((70, 1092), (0, -90)),
    ((314, 421), (0, 50)),
    ((765, 99), (110, -90)),
    ((1, 596), (-90, 50)),
    ((218, 558), (110, -230)),
    ((-670, 352), (-90, -90)),
)


def pedestal() -> Floats:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zyx", [0.7, 0.2, -0.1]).as_matrix()
    T[:3, 3] = 0.4, -1.2, 0.65
    return T


def denavit_hartenberg(q: Floats, tool_m: float) -> list[Floats]:
    """Frames 1 to 6 and the TCP by the standard parameters of the specification: another road to the same robot."""
    d, a = (0.352, 0, 0, 0.380, 0, 0.065), (0.070, 0.360, 0, 0, 0, 0)
    alpha = np.radians((-90, 0, 90, -90, 90, 0))
    frames, T = [], np.eye(4)
    for i, theta in enumerate(q + np.radians((0, -90, 180, 0, 0, 0))):
        A = np.eye(4)
        A[:3, :3] = Rotation.from_euler("ZX", [theta, alpha[i]]).as_matrix()
        A[:3, 3] = a[i] * np.cos(theta), a[i] * np.sin(theta), d[i]
        T = T @ A
        frames.append(T)
    tool = np.eye(4)
    tool[2, 3] = tool_m
    return [*frames, T @ tool]


def samples(robot: RobotModel, count: int, seed: int) -> list[tuple[Floats, Floats]]:
    rng = np.random.default_rng(seed)
    low, high = np.maximum(robot.q_min, -3), np.minimum(robot.q_max, 3)
    return [(rng.uniform(low, high), rng.uniform(-robot.dq_max, robot.dq_max)) for _ in range(count)]


@pytest.mark.parametrize(("wrist_mm", "axes_deg"), GOLDEN)
def test_wrist_centre_is_where_the_specification_has_it(wrist_mm: tuple[int, int], axes_deg: tuple[int, int]) -> None:
    robot = irb140(AT_ORIGIN, stop_s=STOP_S)
    q = np.radians([0, *axes_deg, 0, 0, 0])
    forearm = [s.name for s in robot.segments].index("forearm")
    wrist_m = robot.pose(q, np.zeros(6)).ends_m[forearm, 1]
    assert_allclose(wrist_m * 1e3, [wrist_mm[0], 0, wrist_mm[1]], atol=1.0)


def test_tcp_and_link_ends_agree_with_denavit_hartenberg() -> None:
    T = pedestal()
    robot = irb140(T, stop_s=STOP_S, tool_m=0.17)
    for q, dq in samples(robot, 50, seed=1):
        pose = robot.pose(q, dq)
        frames = [T @ frame for frame in denavit_hartenberg(q, 0.17)]
        assert_allclose(pose.T_world_tcp, frames[6], atol=1e-12)
        at = [frame[:3, 3] for frame in frames]
        shoulder = (T @ [0, 0, 0.352, 1])[:3]
        ends = [(shoulder, at[0]), (at[0], at[1]), (at[2], at[3]), (at[3], at[5]), (at[5], at[6])]
        assert_allclose(pose.ends_m[[0, 1, 3, 4]], np.array(ends)[[0, 1, 3, 4]], atol=1e-12)
        assert_allclose(pose.ends_m[2], [at[1], at[3]], atol=1e-12)  # axis 3 passes through frame 2's origin


@pytest.mark.parametrize("tool_m", [0.0, 0.10])
def test_jacobians_agree_with_finite_differences(tool_m: float) -> None:
    robot = irb140(pedestal(), stop_s=STOP_S, tool_m=tool_m)
    h = 1e-6
    for q, dq in samples(robot, 20, seed=2):
        pose = robot.pose(q, dq)
        for axis in range(6):
            step = h * np.eye(6)[axis]
            before, after = robot.pose(q - step, dq), robot.pose(q + step, dq)
            assert_allclose(pose.J_ends[..., axis], (after.ends_m - before.ends_m) / (2 * h), atol=1e-8)
            moved = (after.T_world_tcp - before.T_world_tcp) / (2 * h)
            assert_allclose(pose.J_tcp[:3, axis], moved[:3, 3], atol=1e-8)
            spin = moved[:3, :3] @ pose.T_world_tcp[:3, :3].T
            assert_allclose(pose.J_tcp[3:, axis], [spin[2, 1], spin[0, 2], spin[1, 0]], atol=1e-8)


def test_jdot_dq_is_the_twists_derivative_at_constant_joint_velocity() -> None:
    robot = irb140(pedestal(), stop_s=STOP_S)
    h = 1e-6
    for q, dq in samples(robot, 20, seed=3):
        before, after = (robot.pose(q + sign * h * dq, dq).J_tcp @ dq for sign in (-1, 1))
        assert_allclose(robot.pose(q, dq).dJdq_tcp, (after - before) / (2 * h), atol=1e-6)


def test_both_ends_of_a_segment_are_on_one_body() -> None:
    robot = irb140(pedestal(), stop_s=STOP_S)
    for q, dq in samples(robot, 20, seed=4):
        pose = robot.pose(q, dq)
        along = pose.ends_m[:, 1] - pose.ends_m[:, 0]
        apart = (pose.J_ends[:, 1] - pose.J_ends[:, 0]) @ dq
        assert_allclose(np.einsum("si,si->s", along, apart), 0, atol=1e-12)  # the term dropped in Eq. (5)


def test_a_pose_keeps_its_values_when_the_next_is_computed() -> None:
    robot = irb140(AT_ORIGIN, stop_s=STOP_S)
    (q1, dq1), (q2, dq2) = samples(robot, 2, seed=5)
    first = robot.pose(q1, dq1)
    kept = [np.copy(v) for v in (first.T_world_tcp, first.J_tcp, first.dJdq_tcp, first.ends_m, first.J_ends)]
    robot.pose(q2, dq2)
    for value, copy in zip(
        (first.T_world_tcp, first.J_tcp, first.dJdq_tcp, first.ends_m, first.J_ends), kept, strict=True
    ):
        assert np.array_equal(value, copy)


def test_pose_takes_read_only_rows_of_a_table() -> None:
    robot = irb140(AT_ORIGIN, stop_s=STOP_S)
    table = np.random.default_rng(6).normal(size=(3, 12))
    table.flags.writeable = False
    whole = robot.pose(np.array(table[1, :6]), np.array(table[1, 6:]))
    view = robot.pose(table[1, :6], table[1, 6:])
    assert np.array_equal(whole.J_ends, view.J_ends)
    assert np.array_equal(whole.dJdq_tcp, view.dJdq_tcp)


def test_limits_are_those_of_the_specification() -> None:
    robot = irb140(AT_ORIGIN, stop_s=STOP_S)
    assert_allclose(np.degrees(robot.q_min), [-180, -90, -230, -200, -115, -400])
    assert_allclose(np.degrees(robot.q_max), [180, 110, 50, 200, 115, 400])
    assert_allclose(np.degrees(robot.dq_max), [200, 200, 260, 360, 360, 450])
    assert robot.ddq_max[0] == pytest.approx(9.26, abs=0.005)
    assert_allclose(robot.dq_max / robot.ddq_max, STOP_S)
    assert_allclose(irb140(AT_ORIGIN, stop_s=STOP_S, acceleration=[1, 2, 3, 4, 5, 6]).ddq_max, [1, 2, 3, 4, 5, 6])


def test_radii_and_names() -> None:
    robot = irb140(AT_ORIGIN, stop_s=STOP_S)
    assert {s.name: s.radius_m for s in robot.segments} == {
        "shoulder": 0.219,
        "upper_arm": 0.152,
        "forearm": 0.118,
        "wrist": 0.077,
        "tool": 0.045,
    }


def test_the_arm_reaches_as_far_as_said_and_no_further() -> None:
    robot = irb140(pedestal(), stop_s=STOP_S)
    assert_allclose(robot.shoulder_m, (pedestal() @ [0, 0, 0.352, 1])[:3])
    far = [
        float(np.linalg.norm(robot.pose(q, dq).T_world_tcp[:3, 3] - robot.shoulder_m))
        for q, dq in samples(robot, 500, seed=7)
    ]
    assert max(far) < robot.reach_m
    stretched = robot.pose(np.radians([0, 90, -90, 0, 0, 0]), np.zeros(6))
    assert np.linalg.norm(stretched.T_world_tcp[:3, 3] - robot.shoulder_m) == pytest.approx(robot.reach_m)


def joint(name: str, parent: str, child: str, *, kind: str = "revolute", xyz: str = "0 0 0.5", extra: str = "") -> str:
    limit = "<limit lower='-2' upper='1.5' velocity='3' effort='0'/>"
    return (
        f"<joint name='{name}' type='{kind}'><parent link='{parent}'/><child link='{child}'/>"
        f"<origin xyz='{xyz}'/><axis xyz='0 1 0'/>{limit}{extra}</joint>"
    )


def link(name: str, *shapes: str, origin: str = "") -> str:
    collisions = "".join(f"<collision>{origin}<geometry>{shape}</geometry></collision>" for shape in shapes)
    return f"<link name='{name}'>{collisions}</link>"


def robot_xml(*parts: str) -> str:
    return "<?xml version='1.0' encoding='utf-8'?><robot name='other'>" + "".join(parts) + "</robot>"


ONE_AXIS = robot_xml(link("base"), link("arm", "<capsule radius='0.1' length='0.4'/>"), joint("lift", "base", "arm"))


def test_one_axis_keeps_its_two_dimensions() -> None:
    robot = from_urdf(ONE_AXIS, AT_ORIGIN, stop_s=0.5, tool_m=1.0)
    pose = robot.pose(np.array([0.0]), np.array([2.0]))
    assert pose.J_tcp.shape == (6, 1)
    assert_allclose(pose.J_tcp[:, 0], [1, 0, 0, 0, 1, 0])
    assert_allclose(pose.dJdq_tcp, [0, 0, -4, 0, 0, 0])  # towards the axis: omega^2 r
    assert_allclose(pose.ends_m[0], [[0, 0, 0.3], [0, 0, 0.7]])
    assert pose.J_ends.shape == (1, 2, 3, 1)
    assert_allclose(pose.J_ends[0, :, :, 0], [[-0.2, 0, 0], [0.2, 0, 0]])
    assert robot.ddq_max == pytest.approx([6.0])


def test_links_move_as_their_ends_do() -> None:
    """The speed of points of the links, against finite differences of the segments' ends and of a third point."""
    robot = irb140(pedestal(), stop_s=STOP_S)
    rng = np.random.default_rng(8)
    q, dq = rng.uniform(-1.0, 1.0, (20, 6)), rng.normal(size=(20, 6))
    found, step = robot.link_motion(q, dq), 1e-6
    for link in range(len(robot.segments)):
        index = np.full(20, link)
        for end in range(2):
            ahead, behind = (
                np.array([robot.ends_m(row)[link, end] for row in q + sign * step * dq]) for sign in (1.0, -1.0)
            )
            at = np.array([robot.ends_m(row)[link, end] for row in q])
            assert_allclose(found.ends_m[:, link, end], at)
            assert_allclose(found.speed(index, at), np.linalg.norm(ahead - behind, axis=1) / (2 * step), atol=1e-7)
    tool = np.array([robot.pose(row, np.zeros(6)).T_world_tcp for row in q])
    beside = tool[:, :3, 3] + 0.3 * tool[:, :3, 0]  # off the tool's axis: its own turning counts
    J = [robot.pose(a, b).J_tcp @ b for a, b in zip(q, dq, strict=True)]
    expected = [np.linalg.norm(v[:3] + np.cross(v[3:], 0.3 * T[:3, 0])) for v, T in zip(J, tool, strict=True)]
    assert_allclose(found.speed(np.full(20, len(robot.segments) - 1), beside), expected)


def test_capsules_enclose_the_collision_shapes() -> None:
    turned = "<origin xyz='0.1 0.2 0.3' rpy='0.4 -0.5 1.1'/>"
    shapes = (
        "<cylinder radius='0.05' length='0.4'/>",
        "<box size='0.1 0.6 0.2'/>",
        "<sphere radius='0.07'/>",
        "<capsule radius='0.03' length='0.2'/>",
    )
    xml = robot_xml(
        link("base", "<mesh filename='b.stl'/>"), link("arm", *shapes, origin=turned), joint("j", "base", "arm")
    )
    robot = from_urdf(xml, AT_ORIGIN, stop_s=0.5)
    assert [s.name for s in robot.segments] == ["arm_1", "arm_2", "arm_3", "arm_4"]
    R, centre = Rotation.from_euler("xyz", [0.4, -0.5, 1.1]), np.array([0.1, 0.2, 0.3])
    turn = np.linspace(0, 2 * np.pi, 60)
    rim = np.column_stack([0.05 * np.cos(turn), 0.05 * np.sin(turn), np.full(60, 0.2)])
    corners = np.array([[x, y, z] for x in (-0.05, 0.05) for y in (-0.3, 0.3) for z in (-0.1, 0.1)])
    for segment, surface in zip(robot.segments, (np.vstack([rim, -rim]), corners), strict=False):
        a, b = np.array(segment.start_m), np.array(segment.end_m)
        p = R.apply(surface) + centre
        share = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        distance = np.linalg.norm(p - a - share[:, None] * (b - a), axis=1)
        assert -1e-12 <= segment.radius_m - distance.max() <= 1e-4
    assert np.linalg.norm(np.subtract(robot.segments[1].end_m, robot.segments[1].start_m)) < 0.6
    assert robot.segments[2].start_m == robot.segments[2].end_m == pytest.approx((0.1, 0.2, 0.3))
    assert np.linalg.norm(np.subtract(robot.segments[3].end_m, robot.segments[3].start_m)) == pytest.approx(0.2)


def test_an_endless_axis_has_no_ends() -> None:
    xml = ONE_AXIS.replace("revolute", "continuous")
    robot = from_urdf(xml, AT_ORIGIN, stop_s=0.5)
    assert robot.q_max == np.inf
    assert robot.q_min == -np.inf
    assert robot.nv == 1
    assert_allclose(robot.pose(np.array([7.0]), np.zeros(1)).ends_m[0, 1, 0], 0.2 * np.sin(7.0))


def test_fingers_and_a_second_arm_are_held() -> None:
    parts = (
        link("base"),
        *(link(name, "<sphere radius='0.1'/>") for name in ("upper", "lower", "hand", "finger", "other")),
        joint("z_first", "base", "upper"),
        joint("a_second", "upper", "lower"),
        joint("mount", "lower", "hand", kind="fixed"),
        joint("grip", "hand", "finger", kind="prismatic"),
        joint("other_arm", "base", "other"),
    )
    robot = from_urdf(robot_xml(*parts), AT_ORIGIN, stop_s=0.5, tcp_frame="hand")
    assert robot.joint_names == ("z_first", "a_second")
    assert [s.name for s in robot.segments] == ["upper", "lower", "hand", "finger"]
    zero = robot.pose(np.zeros(2), np.zeros(2))
    assert_allclose(zero.T_world_tcp[:3, 3], [0, 0, 1.5])
    assert_allclose(zero.J_tcp[0], [1.0, 0.5])
    assert_allclose(zero.ends_m[3], [[0, 0, 2.0], [0, 0, 2.0]])
    assert from_urdf(robot_xml(*parts), AT_ORIGIN, stop_s=0.5, tcp_frame="a_second").reach_m == 0.5
    fixed = tuple(part for part in parts if "finger" not in part)
    assert from_urdf(robot_xml(*fixed), AT_ORIGIN, stop_s=0.5).joint_names == ("z_first", "a_second")


def test_given_segments_may_sit_on_the_base() -> None:
    column = Segment("column", "base", (0, 0, 0), (0, 0, 0.4), 0.2)
    robot = from_urdf(ONE_AXIS, pedestal(), stop_s=0.5, segments=[column])
    pose = robot.pose(np.array([0.3]), np.array([1.0]))
    column_m = np.array([[0, 0, 0, 1], [0, 0, 0.4, 1]]) @ pedestal().T
    assert_allclose(pose.ends_m[0], column_m[:, :3])
    assert not pose.J_ends.any()


MESH = robot_xml(link("base"), link("arm", "<mesh filename='a.stl'/>"), joint("j", "base", "arm"))


@pytest.mark.parametrize(
    ("xml", "options", "message"),
    [
        ("<robot", {}, "robot: not a URDF"),
        ("<sdf><link name='a'/></sdf>", {}, "robot | <sdf>"),
        (
            MESH,
            {},
            "'arm' | 'a.stl' | robot.packages | robot.links",
        ),
        (MESH.replace("<mesh filename='a.stl'/>", "<cone/>"), {}, "'arm' | cone | robot.links"),
        (MESH.replace("mesh", "sphere"), {}, "sphere | 'arm' | no size"),
        (ONE_AXIS.replace("radius='0.1'", "radius='-1'"), {}, "capsule | 'arm' | no size"),
        (ONE_AXIS.replace("length='0.4'", ""), {}, "capsule | 'arm' | no size"),
        (MESH.replace("mesh filename='a.stl'", "box size='1 2'"), {}, "box | 'arm' | no size"),
        (MESH.replace("mesh filename='a.stl'", "box size='1 2 0'"), {}, "box | 'arm' | no size"),
        (
            ONE_AXIS.replace("<collision>", "<collision><origin xyz='0 0 x'/>"),
            {},
            "capsule | arm | <collision>",
        ),
        (robot_xml(link("base"), link("arm"), joint("j", "base", "arm")), {}, "moving | robot.links"),
        (ONE_AXIS, {"tcp_frame": "tool0"}, "robot.tcp_frame | 'tool0' | base, arm"),
        (ONE_AXIS, {"tcp_frame": "base"}, "axis | 'base'"),
        (ONE_AXIS, {"acceleration": [1.0, 2.0]}, "robot.acceleration | 2 values | 1 axes"),
        (ONE_AXIS, {"segments": [Segment("a", "b", (0, 0, 0), (0, 0, 1), 0.1)]}, "robot.links | a | 'b'"),
        (ONE_AXIS.replace("revolute", "prismatic"), {}, "'lift' | prismatic"),
        (ONE_AXIS.replace("</joint>", "<mimic joint='x'/></joint>"), {}, "'lift' | mimic"),
        (ONE_AXIS.replace("velocity='3'", ""), {}, "'lift' | -2.0 to 1.5 rad | 0.0"),
        (ONE_AXIS.replace("velocity='3'", "velocity='fast'"), {}, "limits | 'lift'"),
        (
            ONE_AXIS.replace("parent link='base'", "parent link='nowhere'"),
            {},
            "'lift' | nowhere | arm",
        ),
        (
            ONE_AXIS.replace("<link name='base'>", "<link name='x'/><link name='base'>"),
            {},
            "2 links | x, base",
        ),
        (ONE_AXIS.replace("0 0 0.5", "0 0 high"), {}, "URDF | other"),
    ],
)
def test_what_cannot_be_used_is_named(xml: str, options: dict[str, object], message: str) -> None:
    with pytest.raises(SettingsError, match=facts(*message.split(" | "))):
        from_urdf(xml, AT_ORIGIN, stop_s=0.5, **options)  # type: ignore[arg-type]
