"""What the README states: which command measures it, and which of its figures are kept."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.test_recordings import IMPORTS, SARA, SARA_CELL

Figures = dict[str, Any]

ROOT = Path(__file__).parents[2]
PEOPLE = ROOT / "hrcreplay" / "limits" / "people.toml"
DEMO = "datasets/demo.mcap"

#: Title of a column of the demo's table -> settings of the run.
DEMO_RUNS = {
    ("sound", "people"): "",
    ("sound", "paper"): "--limits paper",
    ("paper", "people"): "--set occupancy.method=paper",
    ("paper", "paper"): "--set occupancy.method=paper --limits paper",
}
#: The run whose speeds the README shows.
PICTURE = ("paper", "paper")
#: What of metrics.json the README tells.
_PLAN = ("stationary_share", "progress_share", "deviation_max_m", "braking_moving_ticks", "ticks")
REPORT_KEYS = (
    *(f"{prefix}_{name}" for prefix in ("plan", "baseline_scaling") for name in _PLAN),
    *("paper_stationary_share_qp", "paper_stationary_share_scaling"),
    *("fusion_angle_rmse_ratio", "fusion_velocity_rmse_ratio"),
)
#: Part of an audit: every limb that was checked, with the lower body where a method has a volume for it.
_PART = "all"
_AUDITED = ("sound", "paper", "positions", "v2_a50")
#: What the audits that change one margin are run on: the worker reaches in, walks away and comes back.
EXCERPT = f"{DEMO} --start 8 --end 23"
#: Audits of it: name -> settings.
MARGINS = {
    "default": "",
    "3 sigma": "--set occupancy.sigmas=3",
    "no hand": "--set occupancy.hand_m=0",
    "no residual": "--set occupancy.residual=false",
    "bare, paper": "--limits paper --set occupancy.sigmas=0 --set occupancy.hand_m=0 --set occupancy.residual=false",
}
#: Motions that are sampled for each method and limit set.
SAMPLES = {
    ("sound", "people"): 2_000_000,
    ("sound", "paper"): 2_000_000,
    ("paper", "people"): 200_000,
    ("paper", "paper"): 200_000,
    ("positions", "people"): 200_000,
    ("positions", "paper"): 200_000,
}
#: Recordings by others: name in the README -> name in tests/test_recordings.py, or the bag.
RECORDINGS = {
    "Azure Kinect, walking": "azure walking",
    "Azure Kinect, squatting": "azure squatting",
    "Azure Kinect, arms and trunk": "azure moving",
    "Kinect v2, waving": "kinect 2 wave",
    "Kinect v2, drawing lines": "kinect 2 lines",
    "Kinect v2, sitting": "kinect 2 sitting",
    "Kinect and optical, exercises": "keraal pair",
    "motion capture, `exp_box`": "exp_box",
    "motion capture, `exp_appraoching`": "exp_appraoching",
}


@dataclass(frozen=True)
class Measurement:
    """Some commands, the last of which leaves the figures."""

    name: str
    commands: tuple[str, ...]  #: arguments of ``python -m``; {data} the recordings, {tmp} an empty folder
    result: str  #: file below {tmp}; none: what the last command prints
    keep: Callable[[Mapping[str, Any]], Figures]
    files: Mapping[str, str]  #: to be written into {tmp} before
    picture: str = ""  #: file below {tmp} that becomes the README's picture
    sampled: bool = False  #: by the sampler, which rests on less of the sources than a run does

    @property
    def needs_data(self) -> bool:
        """Whether it needs recordings by others."""
        return any("{data}" in command for command in self.commands)


def of_report(metrics: Mapping[str, Any]) -> Figures:
    """What is kept of a report's metrics."""
    return {name: metrics[name]["value"] for name in REPORT_KEYS}


def of_audit(metrics: Mapping[str, Any]) -> Figures:
    """What is kept of an audit's metrics."""
    found: Figures = {"ticks": metrics["audit_ticks"]["value"]}
    for method in _AUDITED:
        found[f"{method}_share"] = metrics[f"audit_{method}_{_PART}_covered_share"]["value"]
        found[f"{method}_union_m3"] = metrics[f"audit_{method}_{_PART}_union_m3"]["value"]
    found["legs_share"] = metrics["audit_sound_LEGS_covered_share"]["value"]
    return found


def of_sampling(found: Mapping[str, Any]) -> Figures:
    """What is kept of a sampling."""
    return {name: found[name] for name in ("samples", "states", "states_let_out", "share", "worst_mm")}


def of_people() -> Figures:
    """How the limit set ``people`` did on what it was not fitted on, as it tells itself."""
    logs = tomllib.loads(PEOPLE.read_text())["provenance"]["logs"]
    parts = [log["held_back"] for log in logs]
    ticks = sum(part["ticks"] for part in parts)
    held = sum(round(part["share"] * part["ticks"]) for part in parts)
    return {"logs": len(logs), "ticks": ticks, "held": held}


def measurements() -> list[Measurement]:
    """All of them, the quick ones first."""
    found = [_audit(f"audit demo, {limits}", (f"{DEMO} --limits {limits}",), {}) for limits in ("people", "paper")]
    for (method, limits), options in DEMO_RUNS.items():
        command = f"hrcreplay report {DEMO} {options} --out {{tmp}}/run".replace("  ", " ")
        picture = "run/figures/fig14_speed.png" if (method, limits) == PICTURE else ""
        found.append(Measurement(f"demo, {method}, {limits}", (command,), "run/metrics.json", of_report, {}, picture))
    found += [
        _audit(f"audit excerpt, {name}", (f"{EXCERPT} {options}".strip(),), {}) for name, options in MARGINS.items()
    ]
    for name, key in RECORDINGS.items():
        found += [_recording(name, key, limits) for limits in ("people", "paper")]
    for (method, limits), samples in sorted(SAMPLES.items(), key=lambda item: item[1]):
        command = f"tests.soundness --json --samples {samples} --method {method} --limits {limits}"
        found.append(Measurement(f"soundness, {method}, {limits}", (command,), "", of_sampling, {}, sampled=True))
    return found


def _audit(name: str, commands: tuple[str, ...], files: Mapping[str, str]) -> Measurement:
    """``commands``: those before, and the arguments of the audit."""
    *before, audit = commands
    last = f"hrcreplay audit {audit} --out {{tmp}}/run"
    return Measurement(name, (*before, last), "run/metrics.json", of_audit, files)


def _recording(name: str, key: str, limits: str) -> Measurement:
    title = f"recording, {name}, {limits}"
    if key not in IMPORTS:
        bag = f"{{data}}/sara_human_robot_bags/{key}.bag --config {{tmp}}/settings.toml --cell {{tmp}}/cell.toml"
        return _audit(title, (f"{bag} --limits {limits}",), {"settings.toml": SARA, "cell.toml": SARA_CELL})
    kind, files, options = IMPORTS[key]
    sources = [
        f"{{data}}/{file}" if kind == "keraal" else f"{camera}={{data}}/{file}" for camera, file in files.items()
    ]
    names = {"reference": "--reference", "up": "--up", "height_m": "--height"}
    given = "".join(f" {names[option]} {value}" for option, value in options.items())
    return _audit(
        title,
        (
            f"hrcreplay import {kind} {' '.join(sources)} --out {{tmp}}/log.mcap",
            f"hrcreplay calibrate {{tmp}}/log.mcap --out {{tmp}}/cell.toml{given}",
            f"{{tmp}}/log.mcap --cell {{tmp}}/cell.toml --limits {limits}",
        ),
        {},
    )


def load(path: Path) -> dict[str, Any]:
    """The figures of docs/figures.json; nothing where there is none yet."""
    return dict(json.loads(path.read_text())) if path.exists() else {}
