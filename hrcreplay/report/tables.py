"""Tables of the page: the paper's Table 1 and Table 2 as used, and comparisons of metrics side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from hrcreplay.human.model import LimitSet
from hrcreplay.records import JOINTS
from hrcreplay.report.metrics_table import Metric
from hrcreplay.report.series import ANGLES


@dataclass(frozen=True)
class PageTable:
    """A table of texts; the first column names the row."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


#: How a joint of Eq. (37) is written in Table 1.
SYMBOLS = {
    "x": "x",
    "y": "y",
    "theta": "\u03b8",
    "rho": "\u03c1",
    **{f"a{side}{i}": f"\u03b1 {side},{i}" for side in "rl" for i in range(1, 5)},
}


def limit_table(limits: LimitSet, *, use: str) -> PageTable:
    """Table 1 as used: position, velocity and acceleration bounds of every joint.

    Args:
        limits: The limit set.
        use: What it bounds, e.g. "prediction".
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
    """A bound as Table 1 writes it: multiples of pi where it is one."""
    if np.isinf(value):
        return "\u221e" if value > 0 else "\u2212\u221e"
    sign = "\u2212" if value < 0 else ""
    share = Fraction(abs(value) / np.pi).limit_denominator(20)
    if kind == "angle" and share and abs(float(share) * np.pi - abs(value)) < 1e-9:
        top = "\u03c0" if share.numerator == 1 else f"{share.numerator}\u03c0"
        return sign + (top if share.denominator == 1 else f"{top}/{share.denominator}")
    return f"{sign}{abs(value):.2f}"


def radius_table(radii_m: Mapping[str, float]) -> PageTable:
    """Table 2 as used: the radius of every body part [m]."""
    rows = tuple((part, f"{radius:.2f}") for part, radius in radii_m.items())
    return PageTable("Table 2 as used: radii of the sphere-swept volumes", ("body part", "radius [m]"), rows)


def text_of(metric: Metric | None) -> str:
    """A metric's value as a reader wants it; a dash where it does not apply."""
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
    """A share as percent; a dash where it does not apply."""
    if metric is None or metric["value"] is None:
        return "\u2013"
    return f"{100 * metric['value']:.{decimals}f} %"


def compare(
    title: str,
    metrics: Mapping[str, Metric],
    columns: Mapping[str, str],
    rows: Sequence[tuple[str, str]],
    note: str = "",
) -> PageTable:
    """Metrics side by side.

    Args:
        title: Of the table.
        metrics: Name -> metric.
        columns: Heading of each column -> prefix of its metrics' names.
        rows: Label and suffix of each row's metrics; shares are written in percent.
        note: Below the table.
    """
    body = []
    for label, suffix in rows:
        write = percent if suffix.endswith("_share") else text_of
        cells = [write(metrics.get(f"{prefix}_{suffix}")) for prefix in columns.values()]
        if any(cell != "\u2013" for cell in cells):
            body.append((label, *cells))
    return PageTable(title, ("", *columns), tuple(body), note)
