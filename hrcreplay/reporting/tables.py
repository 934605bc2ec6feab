"""Tables of the page and its fixed texts: Table 1 and Table 2 as used, comparisons of metrics, the robot's capsules."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import pandas as pd

from hrcreplay.human.model import LimitSet
from hrcreplay.logs import camera_checks
from hrcreplay.records import BODY, BORDER, JOINTS, OF_PERSON
from hrcreplay.reporting.metrics.series import ANGLES, Metric
from hrcreplay.robot.model import RobotModel

#: Rows of the comparisons: label, and suffix of the metrics' names.
PLAN_SAFETY = (
    ("ticks", "ticks"),
    ("tracking freely", "tracking_share"),
    ("limited", "limited_share"),
    ("braking", "braking_share"),
    ("retreating", "retreating_share"),
    ("ticks with the robot moving", "moving_ticks"),
    ("full stops: ticks braking with the robot still moving", "braking_moving_ticks"),
    ("full stops, of all ticks", "full_stop_share"),
    ("ticks moving without a certificate", "uncertified_moving_ticks"),
    ("horizon of the volumes, median", "horizon_median_s"),
    ("\u2026 largest", "horizon_max_s"),
    ("ticks moving while touching a swept volume", "contact_moving_ticks"),
    ("smallest separation while moving", "separation_min_moving_m"),
    ("smallest separation at all", "separation_min_m"),
    ("\u2026 at", "separation_min_at_s"),
    ("\u2026 limb", "separation_min_limb"),
    ("\u2026 link", "separation_min_link"),
    ("ticks without a known separation", "separation_unknown_ticks"),
)
PLAN_COST = (
    ("stationary share of the near ticks", "stationary_share"),
    ("near ticks", "near_ticks"),
    ("stationary ticks", "stationary_ticks"),
    ("pace, of the programmed", "progress_share"),
    ("time lost", "time_lost_s"),
    ("cycles", "cycles"),
    ("path that the reference travelled", "ref_travelled_m"),
    ("deviation from the path, mean", "deviation_mean_m"),
    ("\u2026 95th percentile", "deviation_p95_m"),
    ("\u2026 largest", "deviation_max_m"),
    ("behind the reference, mean", "tracking_error_mean_m"),
    ("mean TCP speed", "tcp_speed_mean_m_per_s"),
    ("mean programmed speed", "ref_speed_mean_m_per_s"),
)
CAMERA = (
    ("frames with the person", "frames"),
    ("rate", "rate_hz"),
    ("gaps", "gaps"),
    ("longest gap", "gap_max_s"),
    ("ticks whose update used it", "valid_share"),
    ("time available", "available_share"),
    ("lowest foot above the floor, median", "floor_m"),
    ("\u2026 its distance from the floor, 95th percentile", "floor_p95_m"),
    ("standing upright: head above the floor, median", "head_m"),
    ("\u2026 by the sum of the bones", "bones_m"),
)
FUSION = (
    ("angle RMSE, 10 angles pooled", "angle_rmse"),
    ("\u2026 while seen", "seen_angle_rmse"),
    ("angle error, median", "angle_median"),
    ("angular velocity RMSE, pooled", "velocity_rmse"),
    ("\u2026 while seen", "seen_velocity_rmse"),
    ("angular velocity error, median", "velocity_median"),
    ("RMSE of x", "rmse_x"),
    ("RMSE of y", "rmse_y"),
)

#: Explanation of braking or standing, by the recorded reason (``control_step.REASONS``).
REASONS = {
    "no human state": (
        "the positions of people were unknown: the person's newest frame was older than fusion.fresh_s, or none had "
        "arrived yet, and no watched area was known to be without people"
    ),
    "no solution": "no motion satisfied all constraints",
    "separation failed": (
        "the distance from the robot to the space that the person could reach could not be computed as accurately as "
        "the constraint requires; the person's position was known"
    ),
    "not finite": "the robot's own state, its reference or the constraints contained a number that is not finite",
    "not certified": (
        "the proposed step could not be certified: the step and the stop after it came too near to the space that the "
        "person could reach"
    ),
    "inside a volume": (
        "a link was already in the space that the person could reach, and only a slow retreat may start there"
    ),
    "too near": "the person was nearer than the protective separation distance of ISO/TS 15066",
}


def reason_text(reason: str) -> str:
    """Returns the text of a reason to brake or stand; for an unknown reason, the recorded one."""
    return REASONS.get(reason, f"the record says '{reason}'")


#: Limits of validity of a page.
NOT_CLAIMED = (
    "hrcreplay is a research tool. It is not certified, and no page of it makes a robot cell safe or compliant.",
    (
        "Distances and contact were checked only at the ticks, with the recorded motion of the person. A person who "
        "sees a robot move differently may also move differently."
    ),
    (
        "The swept volumes follow from a model of thirteen joints and assumed bounds. Real people bend sideways, lift "
        "shoulders and move faster than Table 1: the method 'paper' does not enclose all that a person can do."
    ),
    (
        "No margin for clothing, tools and camera errors is added to the limbs' radii, unless the settings add "
        "clearance."
    ),
    "The robot is assumed to follow its commands exactly, including those of a stop.",
    "The paper's numbers come from experiments whose logs were never published. They are printed for orientation.",
)


@dataclass(frozen=True)
class PageTable:
    """A table of texts; the first column names the row."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


#: Symbol of a joint of Eq. (37) in Table 1.
SYMBOLS = {
    "x": "x",
    "y": "y",
    "theta": "\u03b8",
    "rho": "\u03c1",
    "z": "z",
    **{f"a{side}{i}": f"\u03b1 {side},{i}" for side in "rl" for i in range(1, 5)},
}


def limit_table(limits: LimitSet, *, use: str) -> PageTable:
    """Makes Table 1 as used: position, velocity and acceleration bounds of every joint.

    Args:
        limits: The limit set.
        use: Its use, e.g. "prediction".
    """
    rows = []
    for i, joint in enumerate(JOINTS):
        kind = "angle" if joint in ANGLES else "length"
        bounds = [
            _bound(float(values[i]), kind)
            for values in (limits.p_min, limits.p_max, limits.v_min, limits.v_max, limits.a_min, limits.a_max)
        ]
        if limits.coupled and joint[:2] in ("ar", "al") and joint[2] in "23":
            bounds[:2] = [f"(34{'b' if joint[2] == '2' else 'c'})"] * 2
        rows.append((SYMBOLS[joint], *bounds))
    return PageTable(
        title=f"Table 1 as used for {use}: limit set '{limits.name}'",
        columns=("joint", "min pos.", "max pos.", "min vel.", "max vel.", "min acc.", "max acc."),
        rows=tuple(rows),
        note="x and y in m, m/s, m/s\u00b2, angles in rad, rad/s, rad/s\u00b2. The velocity and acceleration bounds of "
        "x and y hold forward and to the left in the body's frame. (34b), (34c): bounds that depend on the other "
        "shoulder angles.",
    )


def _bound(value: float, kind: str) -> str:
    """Formats a bound as in Table 1: as a multiple of pi if it is one."""
    if np.isinf(value):
        return "\u221e" if value > 0 else "\u2212\u221e"
    sign = "\u2212" if value < 0 else ""
    share = Fraction(abs(value) / np.pi).limit_denominator(20)
    if kind == "angle" and share and abs(float(share) * np.pi - abs(value)) < 1e-9:
        top = "\u03c0" if share.numerator == 1 else f"{share.numerator}\u03c0"
        return sign + (top if share.denominator == 1 else f"{top}/{share.denominator}")
    return f"{sign}{abs(value):.2f}"


def radius_table(radii_m: Mapping[str, float]) -> PageTable:
    """Makes Table 2 as used: the radius of every body part [m]."""
    rows = tuple((part, f"{radius:.2f}") for part, radius in radii_m.items())
    return PageTable("Table 2 as used: radii of the sphere-swept volumes", ("body part", "radius [m]"), rows)


def text_of(metric: Metric | None) -> str:
    """Formats a metric's value for readers; a dash if it does not apply."""
    if metric is None or metric["value"] is None:
        return "\u2013"
    value, unit = metric["value"], metric["unit"]
    if isinstance(value, str):
        return value
    if isinstance(value, int):
        return f"{value:,}".replace(",", "\u202f")
    if unit == "1":
        return f"{value:.3f}"
    if unit == "s" and 0.0 < abs(value) < 1.0:
        return f"{1e3 * value:.0f} ms" if abs(value) >= 0.0005 else "below 1 ms"
    decimals = {"s": 1, "Hz": 1, "m": 3, "m/s": 3, "m^3": 3, "rad": 4, "rad/s": 3}.get(unit, 3)
    return f"{value:.{decimals}f} {unit.replace('^3', chr(0xB3))}"


def percent(metric: Metric | None, decimals: int = 1) -> str:
    """Formats a share as percent; a dash if it does not apply."""
    if metric is None or metric["value"] is None:
        return "\u2013"
    return share_text(metric["value"], decimals)


def share_text(share: float, decimals: int = 1) -> str:
    """Formats a share as percent. Only all is written as 100 and only none as 0: 0.99997 becomes 99.9 %."""
    least = 10.0**-decimals
    value = min(100.0 - least, max(least, 100 * share)) if 0.0 < share < 1.0 else 100 * share
    return f"{value:.{decimals}f} %"


def centimetres(metres: float) -> str:
    """Formats a distance between surfaces, negative in overlap, rounded down: it is never told too large."""
    return f"{math.floor(100.0 * metres + 1e-9)} cm".replace("-", "\u2212")


def counted(number: int, what: str) -> str:
    """Formats a number with its noun: "1 tick", "1 200 ticks"."""
    return f"{number:,} {what}{'' if number == 1 else 's'}".replace(",", "\u202f")


def compare(
    title: str,
    metrics: Mapping[str, Metric],
    columns: Mapping[str, str],
    rows: Sequence[tuple[str, str]],
    note: str = "",
) -> PageTable:
    """Makes a table of metrics side by side.

    Args:
        title: Title of the table.
        metrics: Name -> metric.
        columns: Heading of each column -> prefix of its metrics' names.
        rows: Label and suffix of each row's metrics; shares are written in percent.
        note: Note below the table.
    """
    body = []
    for label, suffix in rows:
        write = percent if suffix.endswith("_share") else text_of
        cells = [write(metrics.get(f"{prefix}_{suffix}")) for prefix in columns.values()]
        if any(cell != "\u2013" for cell in cells):
            body.append((label, *cells))
    return PageTable(title, ("", *columns), tuple(body), note)


def agreement_table(agreement: pd.DataFrame | None) -> tuple[PageTable, ...]:
    """Makes the table of distances between two cameras' views of each limb; none without two cameras."""
    if agreement is None:
        return ()
    pairs = list(dict.fromkeys(zip(agreement["a"], agreement["b"], strict=True)))
    body = []
    for limb in BODY:
        cells = []
        for a, b in pairs:
            found = agreement[(agreement["a"] == a) & (agreement["b"] == b) & (agreement["limb"] == limb)]
            cells.append(
                f"{found['median_m'].iloc[0]:.3f} / {found['p95_m'].iloc[0]:.3f} m" if len(found) else "\u2013"
            )
        body.append((limb_names_text([limb]), *cells))
    return (
        PageTable(
            "Distance between two cameras' views of a limb at the same instant, median / 95th percentile",
            ("", *(f"{a} \u2013 {b}" for a, b in pairs)),
            tuple(body),
            "Over the points in which the limb ends, hands and feet included, clocks corrected; a dash: never shown by "
            "both.",
        ),
    )


_LITRES = 1000.0  # litres in a cubic metre


def summary(robot: RobotModel) -> dict[str, Any]:
    """Returns the robot as JSON for run.json; volumes [m^3], null if a capsule was given and not derived."""
    return {
        "name": robot.name,
        "base_frame": robot.base_frame,
        "tcp_frame": robot.tcp_frame,
        "joints": list(robot.joint_names),
        "locked": list(robot.locked),
        "links": [
            {
                "name": segment.name,
                "body": segment.body,
                "start_m": list(segment.start_m),
                "end_m": list(segment.end_m),
                "radius_m": segment.radius_m,
                "capsule_m3": segment.volume_m3,
                "shape_m3": None if math.isnan(segment.shape_m3) else segment.shape_m3,
            }
            for segment in robot.segments
        ],
    }


def remarks(robot: RobotModel) -> tuple[str, ...]:
    """Returns remarks on a robot from a URDF: its chain, its capsules, locked joints, unguarded parts."""
    found = []
    derived = [segment for segment in robot.segments if segment.shape_m3 > 0]
    if derived:
        shapes, capsules = (sum(values) for values in zip(*((s.shape_m3, s.volume_m3) for s in derived), strict=True))
        widest = max(derived, key=lambda segment: segment.volume_m3 - segment.shape_m3)
        found.append(
            f"robot {robot.name}: {robot.nv} axes from {robot.base_frame} to {robot.tcp_frame}; its {len(derived)} "
            f"capsules add {100 * (capsules / shapes - 1):.0f} % to the volume of the shapes in them, most at "
            f"{widest.name}: {_LITRES * widest.volume_m3:.1f} L around {_LITRES * widest.shape_m3:.1f} L"
        )
    if robot.locked:
        found.append(
            f"robot {robot.name}: locked at zero, or at the end of their range next to it: {', '.join(robot.locked)}"
        )
    if robot.unguarded_tool is not None:
        found.append(robot.unguarded_tool)
    return tuple(found)


def robot_table(robot: Mapping[str, Any]) -> PageTable:
    """Makes the table of the links' capsules, with the volume that each adds to the hull of its shape.

    Args:
        robot: Result of :func:`summary`.
    """
    rows = []
    for link in robot["links"]:
        inside = link["shape_m3"]
        added = "\u2013" if not inside else f"{100 * (link['capsule_m3'] / inside - 1):+.0f} %"
        rows.append(
            (
                link["name"],
                f"{math.dist(link['start_m'], link['end_m']):.3f}",
                f"{link['radius_m']:.3f}",
                f"{_LITRES * link['capsule_m3']:.2f}",
                "\u2013" if inside is None else f"{_LITRES * inside:.2f}",
                added,
            )
        )
    locked = f" Locked: {', '.join(robot['locked'])}." if robot["locked"] else ""
    return PageTable(
        f"Capsules of the links: {robot['name']}",
        ("link", "length [m]", "radius [m]", "capsule [L]", "shape's hull [L]", "added"),
        tuple(rows),
        f"{len(robot['joints'])} axes from {robot['base_frame']} to {robot['tcp_frame']}.{locked} A dash: the capsule "
        "was given, not derived from a shape.",
    )


#: Names of BODY for readers.
LIMB_NAMES = camera_checks.LIMB_NAMES

#: Names for readers of the parts of a recorded body that are not in LIMBS.
_PART_NAMES = {
    "THIGH_R": "right thigh",
    "SHANK_R": "right shank",
    "THIGH_L": "left thigh",
    "SHANK_L": "left shank",
    "HAND_R": "right hand",
    "HAND_L": "left hand",
    "FOOT_R": "right foot",
    "FOOT_L": "left foot",
    "LEGS": "legs",
    BORDER: "border of the watched area",
}


def part_name_text(part: str) -> str:
    """Returns the name for readers of a part of a recorded body."""
    limb, of, number = part.partition(OF_PERSON)
    if of:
        return f"{part_name_text(limb)}{of}{number}"
    return LIMB_NAMES.get(part) or _PART_NAMES.get(part, part)


def neighbour_text(part: str) -> str:
    """Describes the neighbour of a link: a part of the person, or the border beyond which others may be."""
    if OF_PERSON in part:
        return f"the {part_name_text(part)}"
    return f"the {part_name_text(part)}" if part == BORDER else f"the person's {part_name_text(part)}"


def limb_names_text(limbs: list[str]) -> str:
    """Returns the names of limbs for readers, with their abbreviations: "left lower arm (LLA) and head (HD)"."""
    names = [f"{LIMB_NAMES[limb]} ({limb})" for limb in limbs]
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
