"""Had the robot stood where these people work: every recording of others beside three bases, by every method.

    python -m tests.tools.bases [--seconds 20] [NAME...]

The robot stands where the person's hands are most of the time: before the person, and to either side. Prints a line a
base and method: pace, standing of the near ticks, full stops, ticks moving without a certificate, ticks moving in
contact with the recorded person: inside the volume that the motion was certified with, inside one that the robot was
moving out of, and outside; then every contact, tick by tick. Leaves with 1 where a tick moved without a certificate, or
in contact with a person who was inside while the robot did not retreat.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hrcreplay.commands import inputs, replay
from hrcreplay.human.model import skeleton
from hrcreplay.records import POINTS, Floats, HumanStates
from hrcreplay.reporting.metrics.contact import retreats
from hrcreplay.store import run_folder
from hrcreplay.store.columns import read_states
from tests.realdata import data_path
from tests.test_recordings import IMPORTS, SARA, SARA_CELL, TASK

METHODS = ("qp", "scaling", "shield", "ssm", "none")
BAGS = ("exp_appraoching", "exp_box")
#: From the hands to the base: turned from the way the person faces [deg], distance [m].
BASES = ((0.0, 0.75), (60.0, 0.65), (-60.0, 0.85))
BELOW_M = 0.35  #: of the hands


def hands_and_front(states: HumanStates) -> tuple[Floats, Floats]:
    """Where the hands are most of the time (3,) [m], and from the pelvis towards them (2,)."""
    points = skeleton(states.p, states.lengths_m)[states.valid.any(axis=1)]
    wrists = points[:, [POINTS.index("wrist_l"), POINTS.index("wrist_r")]].mean(axis=1)
    hands, pelvis = np.nanmedian(wrists, axis=0), np.nanmedian(points[:, POINTS.index("pelvis")], axis=0)
    front = hands[:2] - pelvis[:2]
    return hands, front / max(float(np.linalg.norm(front)), 1e-9)


def bases(states: HumanStates) -> Iterator[str]:
    """``--base`` of each: x, y, z [m] and yaw [deg]; the robot looks at the hands."""
    hands, front = hands_and_front(states)
    for turn_deg, away_m in BASES:
        turn = np.radians(turn_deg)
        way = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ front
        x, y = hands[:2] + away_m * way
        yaw = np.degrees(np.arctan2(-way[1], -way[0]))
        yield f"{x:.3f},{y:.3f},{hands[2] - BELOW_M:.3f},{yaw:.1f}"


def parser(tool: str, says: str | None, each: str = "recording by recording") -> argparse.ArgumentParser:
    """The arguments of a tool that measures recordings by their names."""
    given = argparse.ArgumentParser(prog=f"python -m tests.tools.{tool}", description=says)
    given.add_argument("names", nargs="*", metavar="NAME")
    given.add_argument("--json", action="store_true", help=f"print one JSON object, {each}")
    return given


def with_base(cell: Path, base: str, out: Path) -> Path:
    """A cell file beside another base."""
    x, y, z, yaw = base.split(",")
    text = cell.read_text().split("[T_world_base]")[0].rstrip()
    out.write_text(f"{text}\n\n[T_world_base]\nposition_m = [{x}, {y}, {z}]\nyaw_deg = {yaw}\n")
    return out


def recorded(name: str, tmp: Path) -> tuple[Path, Path, Path | None]:
    """Log, cell file and settings file of a recording."""
    cell = tmp / "cell.toml"
    if name in BAGS:
        cell.write_text(SARA_CELL)
        (tmp / "s.toml").write_text(SARA)
        return data_path(f"sara_human_robot_bags/{name}.bag"), cell, tmp / "s.toml"
    kind, files, options = IMPORTS[name]
    paths = [f"{c}={data_path(file)}" if kind != "keraal" else str(data_path(file)) for c, file in files.items()]
    inputs.import_files(kind, paths, tmp / "log.mcap", 30.0)
    place = {"reference": None, "up": None, "height_m": None, "base": None, **options}
    inputs.calibrate(tmp / "log.mcap", cell, None, (), **place)
    return tmp / "log.mcap", cell, None


def tried(name: str, seconds: float, tmp: Path) -> int:
    """Prints what came of one recording; returns the ticks at fault."""
    log, cell, config = recorded(name, tmp)
    fused = replay.run("fuse", log, out=tmp / "fused", config=config, cell_file=cell, end_s=seconds)
    states = HumanStates.join(list(read_states(fused / "state.parquet", 4096)))
    (tmp / "task.toml").write_text(TASK)
    others = ", ".join(f'"{method}"' for method in METHODS[1:])
    overrides = (f"plan.task={tmp / 'task.toml'}", f"plan.baselines=[{others}]", "prediction.store_hz=1")
    faults = 0
    for number, base in enumerate(bases(states)):
        place = with_base(cell, base, tmp / f"cell{number}.toml")
        out = tmp / f"run{number}"
        replay.run("report", log, out=out, config=config, cell_file=place, end_s=seconds, overrides=overrides)
        faults += told(name, base, out)
    return faults


def told(name: str, base: str, folder: Path) -> int:
    """Prints what came of one base; returns the ticks at fault."""
    run = run_folder.read(folder)
    assert run.motion is not None
    assert run.contact is not None
    faults = 0
    for method, motion in {"qp": run.motion, **run.baselines}.items():
        rows = run.contact[run.contact["method"] == method]
        moving = rows["moving"].to_numpy(dtype=bool)
        touch = moving & (rows["distance_m"].to_numpy(dtype=float) <= 0.0)
        outside_m = rows["outside_m"].to_numpy(dtype=float)
        near = motion["distance_m"].to_numpy(dtype=float) <= 0.5
        stands = motion["tcp_speed"].to_numpy(dtype=float) < 0.001
        uncertified = int((moving & ~motion["certified"].to_numpy(dtype=bool)).sum())
        retreat = touch & ~(outside_m > 0.0) & retreats(motion, rows["t_ns"].to_numpy())
        at_fault = touch & ~(outside_m > 0.0) & ~retreat
        pace = float(motion["programme_s"].iloc[-1]) / (0.004 * len(motion))
        print(  # noqa: T201
            f"{name} | {base} | {method} | pace {pace:.1%} | standing {(stands & near).sum() / max(1, near.sum()):.1%} "
            f"of {near.sum()} near | full stops {((motion['status'].astype(str) == 'braking') & moving).mean():.1%} | "
            f"uncertified {uncertified} | contact inside {at_fault.sum()}, retreating {retreat.sum()}, "
            f"outside {(touch & ~at_fault & ~retreat).sum()}",
            flush=True,
        )
        if method == "none":
            continue
        faults += uncertified + int(at_fault.sum())
        for i in np.flatnonzero(touch):
            print(f"    tick {i}: {rows['link'].iloc[i]} and {rows['limb'].iloc[i]}, {outside_m[i]:.3f} m outside")  # noqa: T201
    return faults


def main() -> int:
    """Runs the recordings."""
    options = argparse.ArgumentParser(prog="python -m tests.tools.bases", description=__doc__)
    options.add_argument("names", nargs="*")
    options.add_argument("--seconds", type=float, default=20.0)
    given = options.parse_args()
    faults = 0
    for name in given.names or [*IMPORTS, *BAGS]:
        with tempfile.TemporaryDirectory() as tmp:
            faults += tried(name, given.seconds, Path(tmp))
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main())
