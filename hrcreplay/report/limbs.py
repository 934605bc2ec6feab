"""Which limbs the cameras measured, and for how much of the time.

An unmeasured limb is where the model supposes it, so a reader has to know.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from hrcreplay.records import JOINTS, LIMBS, Bools, Floats
from hrcreplay.report.metrics import Metric, MetricTable
from hrcreplay.store.run_folder import Run

#: A limb unmeasured at more than this share of the time has to be spoken of.
MOST = 0.5

#: The tables and columns that this rests on.
COLUMNS = {"state": tuple(f"unseen_{limb}" for limb in LIMBS), "measurements": JOINTS}

#: What people call LIMBS.
NAMES = {
    "HD": "head",
    "THX": "trunk",
    "URA": "right upper arm",
    "LRA": "right lower arm",
    "ULA": "left upper arm",
    "LLA": "left lower arm",
}

#: What people call the parts of a recorded body that are no LIMBS.
LEG_NAMES = {"THIGH_R": "right thigh", "SHANK_R": "right shank", "THIGH_L": "left thigh", "SHANK_L": "left shank"}

#: Joints that place a limb beside those that carry it; a part of an arm has been seen when one of its two has.
OWN_JOINTS = {
    "HD": JOINTS[:4],
    "THX": JOINTS[:4],
    "URA": ("ar1", "ar2"),
    "LRA": ("ar3", "ar4"),
    "ULA": ("al1", "al2"),
    "LLA": ("al3", "al4"),
}


def unmeasured_shares(unseen_s: Floats, memory_s: float) -> Floats:
    """Per limb the share of the ticks with the person in view at which it had not been measured for too long.

    Args:
        unseen_s: (n, 6) since the joints of LIMBS were last measured, as ``HumanStates`` has it; inf before [s].
        memory_s: A limb not measured for longer is lost [s].

    Returns:
        (6,) in [0, 1]; exactly 1 for a limb that was never measured. NaN where nobody ever came into view: the person
        is in view where any limb has been measured within the memory.
    """
    lost: Bools = ~(unseen_s <= memory_s)
    in_view = ~lost.all(axis=1)
    if not in_view.any():
        return np.full(unseen_s.shape[1], np.nan)
    return np.asarray(lost[in_view].mean(axis=0), dtype=np.float64)


def add_limbs(metrics: MetricTable, run: Run) -> None:
    """Adds for how much of the time each limb was not measured, and which of its joints never were."""
    names = list(COLUMNS["state"])
    shares = np.full(len(LIMBS), np.nan)
    memory_s = float(run.meta.get("settings", {}).get("fusion", {}).get("memory_s", 0.5))
    if run.state is not None and set(names) <= set(run.state.columns):
        shares = unmeasured_shares(run.state[names].to_numpy(dtype=float), memory_s)
    never = _never_measured(run.measurements)
    for limb, share in zip(LIMBS, shares.tolist(), strict=True):
        metrics.add(
            f"limb_{limb}_unmeasured_share",
            share,
            "1",
            f"share of the ticks with the person in view at which the {NAMES[limb]} had not been measured for "
            f"{memory_s:g} s; 1: never",
            reason="nobody came into view, or it was not fused",
        )
        metrics.add(
            f"limb_{limb}_joints_unmeasured",
            ", ".join(joint for joint in OWN_JOINTS[limb] if joint in never) or None,
            "name",
            f"joints of the {NAMES[limb]} that no frame measured",
            reason="each was measured, or there is no table of measurements",
        )


def _never_measured(measurements: pd.DataFrame | None) -> frozenset[str]:
    if measurements is None or not len(measurements):
        return frozenset()
    return frozenset(joint for joint in JOINTS if not np.isfinite(measurements[joint].to_numpy(dtype=float)).any())


def part_name_text(part: str) -> str:
    """A part of a recorded body as a reader calls it."""
    return NAMES.get(part) or LEG_NAMES.get(part, part)


def limb_names_text(limbs: list[str]) -> str:
    """Limbs as a reader calls them, with their abbreviations: "left lower arm (LLA) and head (HD)"."""
    names = [f"{NAMES[limb]} ({limb})" for limb in limbs]
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def unmeasured(metrics: Mapping[str, Metric]) -> tuple[list[str], dict[str, float]]:
    """Limbs that were never measured, and those unmeasured most of the time with that share."""
    shares = {limb: metrics[f"limb_{limb}_unmeasured_share"]["value"] for limb in LIMBS}
    never = [limb for limb, share in shares.items() if share == 1.0]
    return never, {limb: share for limb, share in shares.items() if share is not None and MOST < share < 1.0}


def remarks(run: Run, told: Sequence[str] = ()) -> list[str]:
    """What a user has to know of limbs that were not measured, or not whole; a line each.

    Args:
        run: Its tables of the first stage.
        told: Notes on the log, which may already say of a limb that no camera gave its points.
    """
    table = MetricTable()
    add_limbs(table, run)
    metrics = table.sorted()
    never, mostly = unmeasured(metrics)
    lines = []
    for limb in never:
        begin = f"limb {limb} was never measured"
        if not any(note.startswith(begin) for note in told):
            lines.append(
                f"{begin}: its points never agreed, or not with the confidence that fusion.confidence_min asks for; "
                "its volume holds all that its joints allow"
            )
    lines += [
        f"the {limb_names_text([limb])} was not measured at {100 * share:.0f} % of the ticks with the person in view"
        for limb, share in mostly.items()
    ]
    for limb in LIMBS:
        joints = metrics[f"limb_{limb}_joints_unmeasured"]["value"]
        if joints is not None and limb not in never and limb != "HD":  # the head hangs on the trunk's joints
            lines.append(f"the {limb_names_text([limb])} was measured only in part: never its {joints}")
    return lines
