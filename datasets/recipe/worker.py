"""The worker: a body with more freedom than the filter's twelve joints.

The spine bends in two parts and sideways, the chest twists against the pelvis, each shoulder lifts and slides on its
own as the arm rises, the head sits before the spine and nods, the pelvis sinks, sways and steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datasets.recipe import script
from datasets.recipe.curves import ease, rot_x, rot_y, rot_z, smooth, sway, turn, unit
from datasets.recipe.gait import Feet, feet
from hrcreplay.records import POINTS, Floats

RATE_HZ = 200.0  #: of the simulation
UPPER_ARM_M = 0.305
FOREARM_M = 0.262
HAND_M = 0.088
HALF_SHOULDER_M = 0.172
LUMBAR_M = 0.250
THORAX_M = 0.255
HALF_HIP_M = 0.088
HIP_DROP_M = 0.045
THIGH_M = 0.430
SHANK_M = 0.415
ANKLE_M = 0.085
PELVIS_M = 0.962
LEAST_BEND = np.radians(24.0)  #: people do not lock their elbows


@dataclass(frozen=True)
class Trunk:
    """Pelvis, spine and head over time."""

    pelvis_m: Floats  #: (n, 3)
    R_pelvis: Floats  #: (n, 3, 3)
    chest_m: Floats
    neck_m: Floats
    R_chest: Floats
    head_m: Floats


def simulate(seed: int) -> tuple[Floats, Floats]:
    """The whole session.

    Args:
        seed: Of the aimless sway; the same seed gives the same motion.

    Returns:
        (n,) instants [s] at ``RATE_HZ`` and (n, 20, 3) POINTS in the world [m].
    """
    t_s = np.arange(round(script.DURATION_S * RATE_HZ) + 1) / RATE_HZ
    root_m, heading = script.floor_way(t_s)
    return t_s, body(t_s, root_m, heading, (script.LEFT, script.RIGHT), np.random.default_rng(seed))


def body(
    t_s: Floats,
    root_m: Floats,
    heading: Floats,
    reaches: tuple[tuple[script.Reach, ...], tuple[script.Reach, ...]],
    rng: np.random.Generator,
) -> Floats:
    """(n, 20, 3) POINTS in the world of a body whose way is known [m].

    Args:
        t_s: (n,) evenly spaced [s].
        root_m: (n, 2) its place on the floor [m].
        heading: (n,) [rad], unwrapped.
        reaches: What the left and the right arm do, beside swinging.
        rng: Of the aimless sway.
    """
    steps = feet(t_s, root_m, heading, ANKLE_M)
    trunk = _trunk(t_s, root_m, heading, steps, rng)
    points = np.full((len(t_s), len(POINTS), 3), np.nan)
    for name in ("pelvis", "chest", "neck", "head"):
        points[:, POINTS.index(name)] = getattr(trunk, f"{name}_m")
    for i, (side, s, plan) in enumerate((("l", 1.0, reaches[0]), ("r", -1.0, reaches[1]))):
        arm = _arm(t_s, trunk, s, plan, _arm_swing(root_m, heading, steps.ankle_m[:, 1 - i]), rng)
        leg = _leg(trunk, s, steps.ankle_m[:, i], steps.yaw[:, i], steps.swing[:, i])
        for name, value in (arm | leg).items():
            points[:, POINTS.index(f"{name}_{side}")] = value
    return points


def _trunk(t_s: Floats, root_m: Floats, heading: Floats, steps: Feet, rng: np.random.Generator) -> Trunk:
    lean = script.degrees(t_s, 3.0, script.LEAN_DEG) + sway(t_s, rng, 0.018, 0.05, 0.5)
    bend = script.degrees(t_s, -2.0, script.BEND_DEG) + sway(t_s, rng, 0.028, 0.04, 0.4)
    twist = script.degrees(t_s, 0.0, script.TWIST_DEG) + sway(t_s, rng, 0.030, 0.06, 0.5)
    stride = smooth(_ahead(root_m, heading, steps.ankle_m[:, 0]) - _ahead(root_m, heading, steps.ankle_m[:, 1]), 16.0)
    load = smooth(steps.swing[:, 1] - steps.swing[:, 0], 20.0)  # > 0: the left leg carries

    yaw = heading - 0.22 * stride
    R_pelvis = rot_z(yaw) @ rot_y(0.45 * lean) @ rot_x(0.045 * load - 0.25 * bend)
    spine = 0.55 * lean + 0.06  # the spine is never quite straight
    R_lumbar = R_pelvis @ rot_z(0.4 * twist + 0.16 * stride) @ rot_y(0.35 * spine - 0.10) @ rot_x(0.55 * bend)
    R_chest = R_lumbar @ rot_z(0.6 * twist + 0.20 * stride) @ rot_y(0.65 * spine + 0.16) @ rot_x(0.70 * bend)

    pelvis = _pelvis(t_s, root_m, heading, lean, load, steps, rng)
    chest = pelvis + turn(R_lumbar, (0.0, 0.0, LUMBAR_M))
    neck = chest + turn(R_chest, (0.0, 0.0, THORAX_M))
    nod = script.degrees(t_s, 1.0, script.NOD_DEG) + sway(t_s, rng, 0.05, 0.08, 0.6)
    gaze = script.degrees(t_s, 0.0, script.GAZE_DEG) + sway(t_s, rng, 0.06, 0.07, 0.5)
    R_head = R_chest @ rot_z(gaze) @ rot_y(nod) @ rot_x(-1.7 * bend)
    head = neck + turn(R_chest, (-0.03, 0.0, 0.075)) + turn(R_head, (0.02, 0.0, 0.135))
    return Trunk(pelvis, R_pelvis, chest, neck, R_chest, head)


def _pelvis(
    t_s: Floats, root_m: Floats, heading: Floats, lean: Floats, load: Floats, steps: Feet, rng: np.random.Generator
) -> Floats:
    """(n, 3) the pelvis: over the feet, back when the trunk leans forward, as low as the longer leg allows."""
    left = script.channel(t_s, 0.02, script.SHIFT_M) + 0.028 * load + sway(t_s, rng, 0.008, 0.05, 0.4)
    back = -0.16 * np.sin(lean) + sway(t_s, rng, 0.008, 0.05, 0.4)
    x = root_m[:, 0] + back * np.cos(heading) - left * np.sin(heading)
    y = root_m[:, 1] + back * np.sin(heading) + left * np.cos(heading)
    gap = np.hypot(steps.ankle_m[:, :, 0] - x[:, None], steps.ankle_m[:, :, 1] - y[:, None])
    longest = 0.995 * (THIGH_M + SHANK_M)
    room = np.sqrt(np.maximum(longest**2 - np.maximum(gap - 0.10, 0.0) ** 2, 0.0))  # a trailing heel comes up
    highest = np.min(steps.ankle_m[:, :, 2] + room + 0.3 * (steps.swing > 0.0), axis=1) + HIP_DROP_M
    z = np.minimum(PELVIS_M, highest) - script.channel(t_s, 0.0, script.CROUCH_M)
    return np.column_stack([x, y, smooth(z, 14.0)])


def _ahead(root_m: Floats, heading: Floats, ankle_m: Floats) -> Floats:
    """(n,) how far a foot is before the body [m]."""
    off = ankle_m[:, :2] - root_m
    return off[:, 0] * np.cos(heading) + off[:, 1] * np.sin(heading)


def _arm_swing(root_m: Floats, heading: Floats, other_ankle_m: Floats) -> Floats:
    """(n,) how far a hanging hand swings forward: with the foot of the other side [m]."""
    return 0.55 * smooth(_ahead(root_m, heading, other_ankle_m), 18.0)


def _arm(
    t_s: Floats, trunk: Trunk, s: float, plan: tuple[script.Reach, ...], swing: Floats, rng: np.random.Generator
) -> dict[str, Floats]:
    """Shoulder, elbow, wrist and hand of the left (s = 1) or right (s = -1) arm."""
    hollow = trunk.neck_m + turn(trunk.R_chest, (0.0, s * HALF_SHOULDER_M, -0.02))
    wish = _wrist(t_s, hollow, trunk.R_chest, s, plan, swing, rng)
    shoulder = _shoulder(t_s, hollow, wish, trunk.R_chest, s, rng)

    across = wish - shoulder
    distance = np.linalg.norm(across, axis=1)
    straight = np.sqrt(UPPER_ARM_M**2 + FOREARM_M**2 + 2 * UPPER_ARM_M * FOREARM_M * np.cos(LEAST_BEND))
    reach = _soft_limit(distance, straight)
    axis = across / distance[:, None]
    wrist = shoulder + axis * reach[:, None]

    along = (UPPER_ARM_M**2 - FOREARM_M**2 + reach**2) / (2.0 * reach)
    out = turn(trunk.R_chest, (-0.60, s * (0.30 + sway(t_s, rng, 0.07, 0.05, 0.4)), -0.55))
    out = unit(out - np.sum(out * axis, axis=1, keepdims=True) * axis)
    elbow = shoulder + axis * along[:, None] + out * np.sqrt(UPPER_ARM_M**2 - along**2)[:, None]
    flex = turn(trunk.R_chest, (0.05, 0.0, -0.25 + sway(t_s, rng, 0.12, 0.1, 0.7)))
    hand = wrist + HAND_M * unit(unit(wrist - elbow) + flex)
    return {"shoulder": shoulder, "elbow": elbow, "wrist": wrist, "hand": hand}


def _wrist(
    t_s: Floats,
    hollow_m: Floats,
    R_chest: Floats,
    s: float,
    plan: tuple[script.Reach, ...],
    swing: Floats,
    rng: np.random.Generator,
) -> Floats:
    """(n, 3) where the wrist wants to be: one place after another, some in the room, some on the body."""
    tremor = [sway(t_s, rng, std, 0.08, 0.9) for std in (0.012, 0.012, 0.010)]

    def on_body(place: tuple[float, float, float], swings: Floats | float) -> Floats:
        x, y, z = place
        return hollow_m + turn(R_chest, (x + swings, s * y, z + 0.12 * np.abs(swings)))

    wish = on_body(script.REST, swing)
    for reach in plan:
        in_room = reach.frame == "world"
        place = (
            np.asarray(reach.place_m)
            if in_room
            else on_body(reach.place_m, swing if reach.place_m == script.REST else 0.0)
        )
        progress = ease(t_s, reach.start_s, reach.duration_s)[:, None]
        wish = wish + (place - wish) * progress
        wish[:, 2] += 0.25 * (progress * (1.0 - progress))[:, 0]  # hands rise a little on their way
    return np.asarray(wish + np.column_stack(tremor))


def _shoulder(
    t_s: Floats, hollow_m: Floats, wish_m: Floats, R_chest: Floats, s: float, rng: np.random.Generator
) -> Floats:
    """(n, 3) the shoulder joint: the girdle lifts with the arm and slides forward with a far reach."""
    there = np.einsum("nji,nj->ni", R_chest, wish_m - hollow_m)
    distance = np.linalg.norm(there, axis=1)
    raised = 0.5 * (1.0 + there[:, 2] / distance)  # 0 hanging, 0.5 level
    far = np.clip(distance / (UPPER_ARM_M + FOREARM_M), 0.0, 1.1)
    lift = 0.10 * raised**1.2 + sway(t_s, rng, 0.012, 0.04, 0.3)
    forward = 0.075 * far * np.maximum(there[:, 0], 0.0) / distance + sway(t_s, rng, 0.010, 0.04, 0.3)
    return hollow_m + turn(R_chest, (forward - 0.01, -s * 0.18 * lift, lift - 0.02))


def _soft_limit(value: Floats, limit: float) -> Floats:
    """(n,) ``value`` far below ``limit``, never above it, and smooth."""
    width = 0.06
    over = np.maximum(value - (limit - width), 0.0)
    return np.minimum(value, limit - width) + width * np.tanh(over / width)


def _leg(trunk: Trunk, s: float, ankle_m: Floats, yaw: Floats, swing: Floats) -> dict[str, Floats]:
    """Hip, knee, ankle and foot of the left (s = 1) or right (s = -1) leg."""
    hip = trunk.pelvis_m + turn(trunk.R_pelvis, (0.0, s * HALF_HIP_M, -HIP_DROP_M))
    across = ankle_m - hip
    distance = np.linalg.norm(across, axis=1)
    reach = np.minimum(distance, 0.998 * (THIGH_M + SHANK_M))
    axis = across / distance[:, None]
    ankle = hip + axis * reach[:, None]
    along = (THIGH_M**2 - SHANK_M**2 + reach**2) / (2.0 * reach)
    front = turn(rot_z(yaw), (1.0, 0.1 * s, 0.0))
    front = unit(front - np.sum(front * axis, axis=1, keepdims=True) * axis)
    knee = hip + axis * along[:, None] + front * np.sqrt(THIGH_M**2 - along**2)[:, None]
    toe = 0.16 * unit(turn(rot_z(yaw), (1.0, 0.12 * s, -0.30)) + 0.4 * swing[:, None] * np.array([0.0, 0.0, -1.0]))
    return {"hip": hip, "knee": knee, "ankle": ankle, "foot": ankle + toe}
