"""Which limbs and points of a recording an audit could check, and which it says nothing of."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hrcreplay.records import BODY
from hrcreplay.report.tables import PageTable


def never(part: Mapping[str, Any], method: str) -> list[str]:
    """Limbs that a method was not checked for at any tick, and points of other limbs that were never seen.

    Args:
        part: One log of audit.json, or its total.
        method: Whose volumes.
    """
    limbs = [limb for limb in BODY if not ticks_of(part, method, limb)]
    points = [
        f"{point} of {limb}"
        for limb, counts in part["points"].items()
        if limb not in limbs
        for point, count in counts.items()
        if not count
    ]
    return limbs + points


def sometimes(part: Mapping[str, Any], method: str) -> list[str]:
    """Limbs and points that were checked at some ticks only, each with the number of those at which it was not."""
    found = []
    for limb, counts in part["points"].items():
        limb_ticks = ticks_of(part, method, limb)
        if 0 < limb_ticks < part["ticks"]:
            found.append(f"{limb} {part['ticks'] - limb_ticks}")
        found += [f"{point} of {limb} {part['ticks'] - n}" for point, n in counts.items() if 0 < n < limb_ticks]
    return found


def ticks_of(part: Mapping[str, Any], method: str, limb: str) -> int:
    """At how many ticks a limb was held against its volume: it was seen to the horizon's end and has a volume."""
    figures = part["methods"][method].get(limb)
    return 0 if figures is None else int(figures["covered_share"]["samples"])


def notes(part: Mapping[str, Any], method: str) -> list[str]:
    """What the reader of a log's figures must know of what was not checked."""
    told = []
    if gaps := never(part, method):
        told.append(f"not checked at all, so nothing is said of it: {', '.join(gaps)}")
    if gaps := sometimes(part, method):
        told.append(f"not seen to the horizon's end, so not checked, of {part['ticks']} ticks: {', '.join(gaps)}")
    return told


def scope(part: Mapping[str, Any], method: str) -> str:
    """The limbs that a headline holds for, in a few words."""
    missing = [limb for limb in BODY if not ticks_of(part, method, limb)]
    return f"not {', '.join(missing)}" if missing else "LEGS included"


def table(total: Mapping[str, Any], method: str) -> PageTable:
    """A row a limb, and one for each point beyond its two ends: at how many ticks it was checked."""
    rows = []
    for limb in BODY:
        ticks = ticks_of(total, method, limb)
        why = "not checked" if limb in total["methods"][method] else "not checked: it has no volume"
        rows.append((limb, str(ticks) if ticks else why))
        for point, count in total["points"].get(limb, {}).items():
            rows.append((f"{limb}: {point}", str(count) if ticks and count else "not checked"))
    return PageTable(
        f"What was checked, of {total['ticks']} ticks",
        ("limb, and points beyond its ends", "ticks"),
        tuple(rows),
        "A limb is checked at a tick where its two ends were seen in the last quarter of the horizon, and so is a "
        "point. What a camera reports with confidence 0 was not seen. Nothing is said of what was not checked.",
    )


def cameras(log: Mapping[str, Any]) -> PageTable:
    """What of each camera's points was not believed."""
    rows = tuple(
        (camera, *("\u2013" if count is None else str(count) for count in counts.values()))
        for camera, counts in log["cameras"].items()
    )
    return PageTable(
        f"{log['log']}: thrown out",
        ("camera", "frames", "not seen", "doubted", "frames with a jump", "points that jump", "outliers in the fusion"),
        rows,
        "No such point is part of the recorded future. Not seen: missing, or of confidence 0. Doubted: the "
        "camera trusts it too little (fusion.confidence_min), or it hangs from such a point, or the person was not "
        "known yet. A point that jumps off the person is rejected with what hangs from it. A dash: the recorded future "
        "is not from cameras. The fusion's own gate is per tick and knows only what came before.",
    )
