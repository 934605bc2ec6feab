"""Remarks on the results of a run, the same for ``report``, which has one motion, and for ``compare``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from hrcreplay.reporting import tables, verdict
from hrcreplay.reporting.metrics import fusion as fusion_metrics
from hrcreplay.robot.model import RobotModel
from hrcreplay.store import run_folder
from hrcreplay.store.run_folder import Run

_FIRST_S = 1.0  # with a person; earlier the volumes are large, as little is known yet


def notes_of(
    folder: Path,
    meta: dict[str, Any],
    told: list[str],
    motions: Mapping[str, Path],
    robot: RobotModel | None,
    rate_hz: float,
) -> list[str]:
    """Returns all notes of a run, each once.

    Args:
        folder: Tables of the run.
        meta: Entries of run.json so far.
        told: Notes of the stages.
        motions: Method -> its table of motion; ``none`` is left out.
        robot: None for a run without a robot.
        rate_hz: Ticks a second [Hz].
    """
    notes = [*told, *_unmeasured(folder, meta, told), *_overlaps(folder, motions, rate_hz)]
    return list(dict.fromkeys([*notes, *([] if robot is None else tables.remarks(robot))]))


def _unmeasured(folder: Path, meta: dict[str, Any], told: list[str]) -> list[str]:
    """Returns remarks on limbs that were not measured, from the tables of stage 1."""

    def table(name: str) -> Any:
        path = folder / f"{name}.parquet"
        if not path.exists():
            return None
        optional = [column for column in run_folder.OPTIONAL if column in pq.read_schema(path).names]
        return pq.read_table(path, columns=[*optional, *fusion_metrics.LIMB_COLUMNS[name]]).to_pandas()

    run = Run(folder, meta, state=table("state"), measurements=table("measurements"))
    return verdict.limb_remarks(run.of_person(1), told)


def _overlaps(folder: Path, motions: Mapping[str, Path], rate_hz: float) -> list[str]:
    """Returns a remark on robots that start inside people; it names the methods if not all do."""
    found: dict[str, list[str]] = {}
    for method, path in motions.items():
        remark = initial_overlap(folder / "state.parquet", path, rate_hz)
        if remark is not None:
            found.setdefault(remark, []).append(method)
    return [text if len(of) == len(motions) else f"{', '.join(of)}: {text}" for text, of in found.items()]


def initial_overlap(state: Path, motion: Path, rate_hz: float) -> str | None:
    """Returns a remark if robot and person overlap at every tick of the first second with a person in view, else None.

    Args:
        state: Table of the fused person.
        motion: Table of the robot's motion, at the same ticks.
        rate_hz: Ticks a second [Hz].
    """
    people = pq.read_table(state, columns=["t_ns", "x"]).to_pandas()
    person = people.groupby("t_ns", sort=True)["x"].first().to_numpy()  # the first known one of each tick
    table = pq.read_table(motion, columns=["distance_m", "link", "limb"])
    near = np.flatnonzero(np.isfinite(person) & table["limb"].is_valid().to_numpy())
    near = near[: max(1, round(_FIRST_S * rate_hz))]
    if not len(near) or not (table["distance_m"].to_numpy()[near] <= 0.0).all():
        return None
    link, limb = (table[name][int(near[0])].as_py() for name in ("link", "limb"))
    return (
        f"the robot's link {link} stands inside the volume of the person's {limb} from the first "
        f"tick with a person on, for {len(near) / rate_hz:.2f} s at least; is T_world_base right? "
        "hrcreplay calibrate prints the person's position"
    )
