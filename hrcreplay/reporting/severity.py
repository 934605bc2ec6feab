"""Severity of contact for readers: metrics, and a table of the worst contact of each method. All of it is estimated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
import pandas as pd

from hrcreplay.evaluation.severity import CONTACT, Impact
from hrcreplay.records import RECORDED
from hrcreplay.reporting.metrics.contact import method_prefixes
from hrcreplay.reporting.metrics.planning import method_text
from hrcreplay.reporting.metrics.series import MetricTable
from hrcreplay.reporting.tables import PageTable, part_name_text
from hrcreplay.store.run_folder import Run

_COLUMNS = (
    "",
    "contacts",
    "above the limit if it gives way / if clamped",
    "worst: link and region",
    "approach, of it the robot m/s",
    "masses, robot and region kg",
    "energy / limit J",
    "force if it gives way / limit N",
    "force if clamped / limit N",
)

#: What stands below every table of severity.
NOTE = (
    "Estimated, not measured: two bodies and a spring as in ISO/TS 15066:2016, A.3, which ISO 10218-2:2025 absorbed, "
    "with the masses, spring constants and force limits of its Tables A.2 and A.3. A head counts as face, a trunk as "
    "chest, a foot as lower leg: the strictest region that the log does not exclude; for the head no short contact is "
    "allowed either. Pressure is not looked at, as the area of contact is not known, nor are edges, pushing motors and "
    "their inertia: forces may be larger. A method without contact is shown at its nearest tick, as if it had touched."
)


#: Type of each column with numbers, for rows that were JSON in between.
NUMBERS = {field.name: float for field in fields(Impact) if field.type == "float"}


#: Names of the figures of ``summary``.
FIGURES = (
    *("contacts", "contacts_over", "contacts_over_clamped", "contact_energy_max_j", "contact_force_share_max", "worst"),
)


def summary(rows: pd.DataFrame) -> dict[str, Any]:
    """Returns the severity of a method in figures; None if not known or without contact.

    Args:
        rows: Rows of severity.parquet of the method.

    Returns:
        ``contacts``, ``contacts_over``, ``contacts_over_clamped``, ``contact_energy_max_j``,
        ``contact_force_share_max``, and ``worst``: the row with the largest share of the force limit, or of the nearest
        tick, as JSON.
    """
    touching = rows[rows["kind"] == CONTACT]
    share, clamped = (touching[f"{how}_n"] / touching[f"{how}_limit_n"] for how in ("transient", "clamped"))
    energy = touching[["energy_j", "energy_simple_j"]].max(axis=1)
    return {
        "contacts": len(touching),
        "contacts_over": _above(share),
        "contacts_over_clamped": _above(clamped),
        "contact_energy_max_j": _largest(energy),
        "contact_force_share_max": _largest(share),
        "worst": worst(rows),
    }


def _above(share: pd.Series[float]) -> int | None:
    """Returns the number of contacts above a limit; None if one is not known."""
    return None if share.isna().any() else int((share > 1.0).sum())


def worst(rows: pd.DataFrame) -> dict[str, Any] | None:
    """Returns the row with the largest share of the force limit, or else the fastest, as JSON; None without a row."""
    if rows.empty:
        return None
    share = (rows["transient_n"] / rows["transient_limit_n"]).fillna(-1.0)
    speed = (rows["robot_speed"] + rows["person_speed"]).fillna(-np.inf)
    row = rows.loc[max(rows.index, key=lambda i: (share[i], speed[i]))]
    return {
        name: value if isinstance(value, str) else int(value) if name == "t_ns" else _finite(value)
        for name, value in row.items()
        if isinstance(name, str)
    }


def _largest(values: pd.Series[float]) -> float | None:
    known = values.dropna()
    return float(known.max()) if len(known) else None


def _finite(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None


def add_severity(metrics: MetricTable, run: Run) -> None:
    """Adds the severity of contact of the plan, the baselines and the robot as recorded.

    Args:
        metrics: Table that the metrics are added to.
        run: The run's tables.
    """
    if run.motion is None or run.severity is None:
        return
    for method, prefix in method_prefixes(run).items():
        what, found = method_text(prefix), summary(run.severity[run.severity["method"] == method])
        none = "no contact, or the robot's mass is not known"
        metrics.add(
            f"{prefix}_contacts", found["contacts"], "1", f"contacts of the moving robot with anybody recorded, {what}"
        )
        for name, how in (("over", "gives way"), ("over_clamped", "is clamped")):
            metrics.add(
                f"{prefix}_contacts_{name}",
                found[f"contacts_{name}"],
                "1",
                f"of these, contacts whose estimated force, if the part {how}, is above the limit of the body region "
                f"for it, {what}",
                reason="the robot's mass or the speed of a body is not known",
            )
        metrics.add(
            f"{prefix}_contact_energy_max_j",
            found["contact_energy_max_j"],
            "J",
            f"largest energy that a contact transfers, estimated, {what}",
            reason=none,
        )
        metrics.add(
            f"{prefix}_contact_force_share_max",
            found["contact_force_share_max"],
            "1",
            f"largest estimated force of a short contact as a share of the body region's limit, {what}",
            reason=none,
        )


def severity_tables(run: Run) -> tuple[PageTable, ...]:
    """Returns the table of the worst contact of each method of a run; none for a run of an earlier version."""
    if run.motion is None or run.severity is None:
        return ()
    names = {method: method + (" (as it ran)" if method == RECORDED else "") for method in method_prefixes(run)}
    found = {name: summary(run.severity[run.severity["method"] == method]) for method, name in names.items()}
    return (severity_table(found, run.meta.get("robot", {}).get("mass", "see robot.mass_kg of its settings")),)


def severity_table(found: Mapping[str, Mapping[str, Any]], mass: str) -> PageTable:
    """Makes the table of the worst contact of each method.

    Args:
        found: Name of a row -> result of ``summary``.
        mass: Source of the robot's mass, in words.
    """
    rows = tuple((name, *_cells(one)) for name, one in found.items())
    return PageTable("Severity of contact, estimated", _COLUMNS, rows, f"{NOTE} The robot's mass: {mass}.")


def _cells(one: Mapping[str, Any]) -> tuple[str, ...]:
    row = one["worst"]
    over = f"{_number(one['contacts_over'], 0)} / {_number(one['contacts_over_clamped'], 0)}"
    contacts = (_number(one["contacts"], 0), over)
    if row is None:
        return (*contacts, *("\u2013",) * (len(_COLUMNS) - 3))
    speeds = row["robot_speed"], row["person_speed"]
    both = None if None in speeds else max(0.0, sum(speeds))
    where = f"{row['link']}, {row['region']} ({part_name_text(row['limb'])})"
    nearest = "" if row["kind"] == CONTACT else f"no contact; nearest {row['distance_m']:.3f} m: "
    robot_kg = " or ".join(f"{row[name]:.1f}" for name in ("robot_kg", "robot_simple_kg") if row[name] is not None)
    energies = [row[name] for name in ("energy_j", "energy_simple_j") if row[name] is not None]
    return (
        *contacts,
        nearest + where,
        f"{_number(both, 2)}, {_number(speeds[0], 2)}",
        f"{robot_kg or 'not known'}, {row['person_kg']:g}",
        f"{_number(max(energies, default=None), 2)} / {row['energy_limit_j']:.2f}",
        f"{_number(row['transient_n'], 0)} / {row['transient_limit_n']:.0f}",
        f"{_number(row['clamped_n'], 0)} / {row['clamped_limit_n']:.0f}",
    )


def _number(value: float | None, decimals: int) -> str:
    """Formats a number; a dash if it is not known."""
    if value is None:
        return "\u2013"
    rounded = round(value, decimals) + 0.0  # without the minus of a rounded 0
    return f"{rounded:,.{decimals}f}".replace(",", "\u202f").replace("-", "\u2212")
