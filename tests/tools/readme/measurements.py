"""What the README states: which command measures it, and which of its figures are kept."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from tests.test_recordings import IMPORTS, SARA, SARA_CELL

Figures = dict[str, Any]

ROOT = Path(__file__).parents[3]
DEMO = "datasets/demo.mcap"

#: Horizons of the audits that the README tells of: what the robot needs at the speeds that it keeps beside people, and
#: from full speed [ms].
HORIZONS_MS = (100, 377)
#: Baselines of the demo's table.
BASELINES = ("scaling", "shield", "ssm", "none")
#: The same worker; but what the robot takes lies where he reaches.
FAR = "tests/data/demo_far.mcap"
#: Base of the robot beside it: as in that log, and nearer [m].
PLACES = (0.0, 0.25)
_CELL = "[T_world_base]\nposition_m = [{x}, 0, 0.65]\n"
#: Run -> log and options; and which one's speeds the README shows.
DEMO_RUNS = {
    "demo": f"{DEMO} --cell datasets/demo_cell.toml --set 'plan.baselines={json.dumps(BASELINES)}'",
    "demo, as printed": f"{DEMO} --config paper",
    **{f"demo, base at {x} m": f"{FAR} --cell {{tmp}}/cell.toml" for x in PLACES},
}
PICTURE = "demo"
#: What of metrics.json the README tells.
_PLAN = (
    *("stationary_share", "null_speed_share", "progress_share", "full_stop_share", "uncertified_moving_ticks"),
    "tcp_speed_max_m_per_s",
)
_TOUCH = ("touch_rest_ticks", "touch_moving_ticks", "touch_contact_speed_max_m_per_s", "body_distance_min_moving_m")
REPORT_KEYS = (
    *("paper_stationary_share_qp", "paper_stationary_share_scaling", "plan_deviation_max_m", "plan_ticks"),
    *("fusion_angle_rmse_ratio", "fusion_velocity_rmse_ratio", "plan_horizon_median_s", "plan_horizon_max_s"),
)
#: What is compared by default, and what is told of it.
VARIANTS = (
    *("none", "ssm:sound:adaptive", "shield:sound:adaptive", "scaling:sound:adaptive", "qp:sound:adaptive"),
    *("qp:sound:fixed", "qp:paper:fixed", "scaling:paper:fixed"),
)
COMPARED = ("touch_ticks", "nearest_moving_m", "pace", "cycles", "standing_share", "coverage", "jerk_rms_rad_per_s3")
#: Part of an audit: every limb that was checked, with the lower body where a method has a volume for it.
_PART = "all"
_AUDITED = ("sound", "paper", "positions")
_COMPARED = ("sound", "v2_a50")
#: What the audits that change one margin are run on: the worker reaches in, walks away and comes back.
EXCERPT = f"{DEMO} --start 8 --end 23"
#: Audits of it: name -> settings.
MARGINS = {
    "default": "",
    "joints": "--limits human",
    "no hand": "--set prediction.hand_m=0",
    "no residual": "--set prediction.residual=false",
    "bare, paper": "--limits paper --set prediction.sigmas=0 --set prediction.hand_m=0 --set prediction.residual=false",
}
#: Motions that are sampled for each method and limit set.
SAMPLES = {
    ("sound", "people"): 10_000_000,
    ("sound", "paper"): 10_000_000,
    ("paper", "people"): 200_000,
    ("paper", "paper"): 200_000,
    ("positions", "people"): 200_000,
    ("positions", "paper"): 200_000,
}
#: What measures the pace of a controller that knows the future, on recordings by others, too.
ORACLE = "tests.tools.oracle"
ORACLED = ("demo", "azure walking", "azure moving", "kinect 2 lines", "kinect 2 sitting", "exp_box")
#: Share of people's speeds at which a point goes as far within the braking time as a limb seen whole departs.
SLOWLY = 0.4
#: What hides people but for their arms, and in which recordings.
PARTLY_SEEN = "tests.tools.partly_seen"
PARTLY_SEEN_OF = ("demo", "azure walking", "azure squatting", "azure moving")
#: What it takes to hold people: which tool, and the factors and horizons that are told.
COVERAGE_COST = "tests.tools.coverage_cost"
COST_FACTORS = (0.6, 0.7, 0.8, 0.9, 1.0)
COST_HORIZONS = 5
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
#: All that need others' recordings.
_OF_OTHERS = (ORACLE, PARTLY_SEEN, COVERAGE_COST)


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
        return any("{data}" in command or command.startswith(_OF_OTHERS) for command in self.commands)


def of_report(metrics: Mapping[str, Any]) -> Figures:
    """What is kept of a report's metrics: of the plan and all baselines that ran."""
    found = {name: metrics[name]["value"] for name in REPORT_KEYS}
    names = _PLAN + _TOUCH if metrics["contact_person"]["value"] else _PLAN
    for prefix in ("plan", *(f"baseline_{method}" for method in BASELINES)):
        if f"{prefix}_progress_share" in metrics:
            found |= {f"{prefix}_{name}": metrics[f"{prefix}_{name}"]["value"] for name in names}
    return found


def of_audit(metrics: Mapping[str, Any]) -> Figures:
    """What is kept of an audit's metrics."""
    found: Figures = {"ticks": metrics["audit_ticks"]["value"]}
    for method in _AUDITED:
        found[f"{method}_points_share"] = metrics[f"audit_{method}_{_PART}_points_share"]["value"]
        found[f"{method}_union_m3"] = metrics[f"audit_{method}_{_PART}_union_m3"]["value"]
    for method, until in product(_COMPARED, HORIZONS_MS):
        for key in ("covered_share", "union_m3"):
            found[f"{method}_{until}ms_{key}"] = metrics[f"audit_{method}_{until}ms_{key}"]["value"]
    return found


def of_comparison(found: Mapping[str, Any]) -> Figures:
    """What is kept of a comparison's total, method by method."""
    return {f"{name} {key}": found["total"][name][key] for name in VARIANTS for key in COMPARED}


def of_sampling(found: Mapping[str, Any]) -> Figures:
    """What is kept of a sampling."""
    return {name: found[name] for name in ("samples", "states", "states_let_out", "share", "worst_mm")}


def of_oracle(found: Mapping[str, Any]) -> Figures:
    """What is kept of both controllers, recording by recording."""
    return {f"{name} {key}": value for name in ORACLED for key, value in found[name].items()}


def of_partly_seen(found: Mapping[str, Any]) -> Figures:
    """What is kept of people who are partly out of sight, recording by recording."""
    return {f"{name} {key}": value for name in PARTLY_SEEN_OF for key, value in found[name].items()}


def of_coverage_cost(found: Mapping[str, Any]) -> Figures:
    """What is kept of what it takes to hold people, factor by factor."""
    return {
        f"{factor:g} {key} {k}": found[f"{factor:g}"][key][k]
        for factor in COST_FACTORS
        for key in ("shares", "union_m3")
        for k in range(COST_HORIZONS)
    }


def measurements() -> list[Measurement]:
    """All of them, the quick ones first."""
    found = [_audit("audit demo", (DEMO,), {})]
    for name, options in DEMO_RUNS.items():
        command = f"hrcreplay report {options} --out {{tmp}}/run"
        files = {"cell.toml": _CELL.format(x=name.split()[-2])} if "{tmp}/cell.toml" in options else {}
        picture = "run/figures/fig14_speed.png" if name == PICTURE else ""
        found.append(Measurement(name, (command,), "run/metrics.json", of_report, files, picture))
    found += [
        _audit(f"audit excerpt, {name}", (f"{EXCERPT} {options}".strip(),), {}) for name, options in MARGINS.items()
    ]
    command = f"hrcreplay compare {DEMO} --out {{tmp}}/run"
    found.append(Measurement("compare", (command,), "run/compare.json", of_comparison, {}))
    found += [_recording(name, key) for name, key in RECORDINGS.items()]
    found.append(
        Measurement("partly seen", (f"{PARTLY_SEEN} --json {shlex.join(PARTLY_SEEN_OF)}",), "", of_partly_seen, {})
    )
    command = f"{COVERAGE_COST} --json {shlex.join(RECORDINGS.values())}"
    found.append(Measurement("coverage cost", (command,), "", of_coverage_cost, {}))
    found.append(Measurement("oracle", (f"{ORACLE} --json {shlex.join(ORACLED)}",), "", of_oracle, {}))
    for (method, limits), samples in sorted(SAMPLES.items(), key=lambda item: item[1]):
        command = f"tests.tools.soundness --json --samples {samples} --method {method} --limits {limits}"
        found.append(Measurement(f"soundness, {method}, {limits}", (command,), "", of_sampling, {}, sampled=True))
    return found


def _audit(name: str, commands: tuple[str, ...], files: Mapping[str, str]) -> Measurement:
    """``commands``: those before, and the arguments of the audit."""
    *before, audit = commands
    last = f"hrcreplay audit {audit} --out {{tmp}}/run"
    return Measurement(name, (*before, last), "run/metrics.json", of_audit, files)


def _recording(name: str, key: str) -> Measurement:
    title = f"recording, {name}"
    if key not in IMPORTS:
        bag = f"{{data}}/sara_human_robot_bags/{key}.bag --config {{tmp}}/settings.toml --cell {{tmp}}/cell.toml"
        return _audit(title, (bag,), {"settings.toml": SARA, "cell.toml": SARA_CELL})
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
            "{tmp}/log.mcap --cell {tmp}/cell.toml",
        ),
        {},
    )


def load(path: Path) -> dict[str, Any]:
    """The figures of docs/figures.json; nothing where there is none yet."""
    return dict(json.loads(path.read_text())) if path.exists() else {}
