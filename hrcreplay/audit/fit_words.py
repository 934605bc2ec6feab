"""What ``fit-limits`` tells the user, line by line."""

from __future__ import annotations

from typing import Any

from hrcreplay.human import fitting
from hrcreplay.human.fitting import Fit
from hrcreplay.human.model import LimitSet
from hrcreplay.records import JOINTS


def lines(found: Fit, limits: LimitSet, facts: dict[str, Any], standard: str) -> list[str]:
    """What the user should know of a fit.

    Args:
        found: The fit.
        limits: The limit set made of it.
        facts: Its provenance.
        standard: Limit set whose positions are taken where nobody was outside of them.
    """
    told = [
        f"{joint}: velocity {limits.v_min[j]:g} to {limits.v_max[j]:g}, acceleration {limits.a_min[j]:g} to "
        f"{limits.a_max[j]:g}; held back {_text(facts['joints'][joint]['held_back'])}"
        for j, joint in enumerate(JOINTS)
        if not found.kept[j]
    ]
    if facts["kept"]:
        told.append(
            f"too little motion to say (fewer than {fitting.EXCURSIONS} horizons with motion), so the bounds of "
            f"{facts['kept_from']} stay: {', '.join(facts['kept'])}"
        )
    if len(facts["kept"]) == len(JOINTS):
        told.append(f"no joint was fitted: these are the rates of {facts['kept_from']} under another name")
    if "and" in facts["positions"]:
        told.append(f"recorded postures leave the positions of {standard}: written are {facts['positions']}")
    for log in facts["logs"]:
        left_out = f"; fitted to the other logs {_text(log['left_out'])}" if "left_out" in log else ""
        told.append(f"{log['name']}: training {_text(log['training'])}; held back {_text(log['held_back'])}{left_out}")
    total = facts["total"]
    told.append(f"all joints: training {_text(total['training'])}; held back {_text(total['held_back'])}")
    if "limbs" in facts:
        if facts["not_checked"]:
            told.append(f"not checked, so nothing is said of it: {', '.join(facts['not_checked'])}")
        legs = "LEGS included" if "LEGS" not in facts["not_checked"] else "not LEGS"
        training, held_back = (_text(facts["limbs"][part]) for part in ("training", "held_back"))
        what = f"every limb that was checked ({legs}) in its volume of {facts['method']}"
        told.append(f"{what}: training {training}; held back {held_back}")
    told[-1] = f"fit-limits: {limits.name}: {told[-1]}"
    return told


def _text(share: dict[str, Any]) -> str:
    if "share" not in share:
        return "unknown"
    numbers = f"{100.0 * share['share']:.1f} %"
    if "low" in share:
        numbers += f" ({100.0 * share['low']:.1f} to {100.0 * share['high']:.1f} %)"
    return f"{numbers} of {share['ticks']} ticks"
