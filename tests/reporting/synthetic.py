"""A made-up run: closed-form motions, so that what the report says about it can be worked out by hand."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hrcreplay.commands.report import compute
from hrcreplay.human.model import skeleton
from hrcreplay.records import DOF, JOINTS, LENGTHS, LIMBS, Floats, Ints
from hrcreplay.reporting.metrics.series import Metric
from hrcreplay.store.run_folder import Run
from hrcreplay.store.stored_table import RunTable

LENGTHS_M = np.array([0.52, 0.22, 0.19, 0.30, 0.30, 0.27, 0.27])
T0_NS = 1_700_000_000_000_000_000
RADII_M = dict(zip(LIMBS, (0.12, 0.15, 0.07, 0.07, 0.07, 0.07), strict=True))


def frame_of(table: RunTable | None) -> pd.DataFrame:
    """A table of a run in memory."""
    assert table is not None
    return table if isinstance(table, pd.DataFrame) else table[list(table.columns)]


def pose(t_s: Floats) -> Floats:
    """(n, 13) a person who walks up, reaches in now and then, and turns."""
    reach = np.clip(np.sin(2 * np.pi * t_s / 9.0), 0.0, None) ** 2
    p = np.zeros((len(t_s), DOF))
    p[:, 0] = 1.15 - 0.35 * np.tanh((t_s - 8.0) / 3.0) + 0.03 * np.sin(t_s)
    p[:, 1] = 0.25 * np.sin(0.35 * t_s)
    p[:, 2] = np.pi + 0.4 * np.sin(0.3 * t_s)
    p[:, 3], p[:, 12] = 0.1 + 0.3 * reach, 0.95
    for first, side in ((4, 1.0), (8, 0.6)):
        p[:, first] = 0.15 + 0.2 * reach
        p[:, first + 1] = 0.2 + 1.2 * side * reach
        p[:, first + 2] = 0.1 * np.sin(0.8 * t_s)
        p[:, first + 3] = 2.4 + 0.5 * reach
    return p


def _human(seconds: float, rate_hz: float) -> tuple[Ints, Floats]:
    t_s = np.arange(int(seconds * rate_hz)) / rate_hz
    return T0_NS + np.round(t_s * 1e9).astype(np.int64), t_s


def state_table(seconds: float, rate_hz: float, rng: np.random.Generator) -> pd.DataFrame:
    """The fused person: truth with small, slow errors; nothing in the first half second."""
    t_ns, t_s = _human(seconds, rate_hz)
    p = pose(t_s) + 0.01 * np.sin(3.0 * t_s[:, None] + np.arange(DOF))
    v = np.gradient(pose(t_s), 1.0 / rate_hz, axis=0) + 0.05 * np.sin(5.0 * t_s[:, None] + np.arange(DOF))
    missing = t_s < 0.5
    p[missing], v[missing] = np.nan, np.nan
    table: dict[str, Any] = {"t_ns": t_ns}
    for i, joint in enumerate(JOINTS):
        table |= {joint: p[:, i], f"{joint}_vel": v[:, i], f"{joint}_std": np.where(missing, np.nan, 0.02)}
    for i, length in enumerate(LENGTHS):
        table[length] = np.where(missing, np.nan, LENGTHS_M[i])
    step = max(1, round(rate_hz / 30))
    tick = np.arange(len(t_ns))
    out = (t_s > 0.6 * seconds) & (t_s < 0.65 * seconds)
    table["valid_kinect"] = (tick % step == 0) & ~missing & ~out
    table["valid_xtion"] = (tick % step == 3) & (t_s > 0.2 * seconds) & ~out & (rng.random(len(t_ns)) > 0.1)
    return pd.DataFrame(table)


def measurement_table(seconds: float, rng: np.random.Generator) -> pd.DataFrame:
    """Two cameras: the second starts late and is noisier, both have holes."""
    parts = []
    for camera, start, noise in (("kinect", 0.5, 0.04), ("xtion", 0.2 * seconds, 0.09)):
        t_s = np.arange(start, seconds - 0.1, 1 / 30.0)
        t_s = t_s[(t_s < 0.6 * seconds) | (t_s > 0.65 * seconds)]
        angles = pose(t_s) + noise * rng.standard_normal((len(t_s), DOF)) * np.where(np.arange(DOF) < 2, 0.3, 1.0)
        angles[rng.random(angles.shape) < 0.03] = np.nan
        capture = T0_NS + np.round(t_s * 1e9).astype(np.int64)
        columns: dict[str, Any] = {"capture_ns": capture, "arrival_ns": capture + 20_000_000, "camera": camera}
        columns |= {joint: angles[:, i] for i, joint in enumerate(JOINTS)}
        columns |= {f"{joint}_std": np.full(len(t_s), noise) for joint in JOINTS}
        columns |= {length: np.full(len(t_s), LENGTHS_M[i]) for i, length in enumerate(LENGTHS)}
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts).sort_values("arrival_ns", kind="stable", ignore_index=True)


def truth_table(seconds: float, rate_hz: float = 100.0) -> pd.DataFrame:
    """The person as posed, but for a hole of half a second."""
    t_ns, t_s = _human(seconds, rate_hz)
    p = pose(t_s)
    p[(t_s > 4.0) & (t_s < 4.5)] = np.nan
    columns: dict[str, Any] = {"t_ns": t_ns} | {joint: p[:, i] for i, joint in enumerate(JOINTS)}
    return pd.DataFrame(columns | {length: np.full(len(t_s), LENGTHS_M[i]) for i, length in enumerate(LENGTHS)})


def volumes_at(t_s: float, spread: float) -> dict[str, Floats]:
    """Swept volumes of the six limbs at one instant: each limb's ends, smeared by ``spread`` [m]."""
    points = skeleton(pose(np.array([t_s])), LENGTHS_M[None])[0]
    ends = {"HD": (2, 3), "THX": (0, 2), "URA": (8, 9), "LRA": (9, 10), "ULA": (4, 5), "LLA": (5, 6)}
    rng = np.random.default_rng(int(1000 * t_s))
    cloud = rng.uniform(-1.0, 1.0, (40, 3)) * spread
    return {limb: np.vstack([points[a] + cloud, points[b] + 1.4 * cloud]) for limb, (a, b) in ends.items()}


def occupancy_table(seconds: float, store_hz: float = 25.0) -> pd.DataFrame:
    """Swept volumes at the stored ticks; their volume is a number that depends on the limb only."""
    t_ns, t_s = _human(seconds, store_hz)
    rows = []
    for k, t in zip(t_ns[t_s >= 0.5], t_s[t_s >= 0.5], strict=True):
        for i, (limb, vertices) in enumerate(volumes_at(float(t), 0.06).items()):
            rows.append((k, limb, "paper", RADII_M[limb], 0.01 * (i + 1), vertices.ravel()))
    return pd.DataFrame(rows, columns=["t_ns", "limb", "method", "radius_m", "volume_m3", "vertices"])


def motion_table(seconds: float, rate_hz: float, *, held: float) -> pd.DataFrame:
    """A TCP on an ellipse that evades by up to ``0.2 - held`` and slows when the person reaches in."""
    t_ns, t_s = _human(seconds, rate_hz)
    reach = np.clip(np.sin(2 * np.pi * t_s / 9.0), 0.0, None) ** 2
    pace = 1.0 - np.clip(held * 1.6 * reach, 0.0, 1.0)
    phase = 2 * np.pi * np.cumsum(pace) / rate_hz / 5.0
    ref = np.column_stack([0.45 + 0.12 * np.cos(phase), 0.35 * np.sin(phase), 0.75 + 0.1 * np.cos(2 * phase)])
    slope = np.column_stack([-0.12 * np.sin(phase), 0.35 * np.cos(phase), -0.2 * np.sin(2 * phase)])
    programmed = np.linalg.norm(slope, axis=1) * 2 * np.pi / 5.0
    tcp = ref + (0.22 * (1.0 - held) * reach)[:, None] * np.array([-0.8, 0.1, 0.59])
    speed = np.linalg.norm(np.gradient(tcp, 1.0 / rate_hz, axis=0), axis=1)
    distance = 0.9 - 0.85 * reach + 0.05 * np.sin(2 * t_s)
    status = np.where(
        t_s < 0.5, "braking", np.where(reach > 0.92, "braking", np.where(reach > 0.3, "limited", "tracking"))
    )
    reason = np.where(t_s < 0.5, "no person yet", np.where(reach > 0.92, "no admissible motion", ""))
    distance[t_s < 0.5] = np.nan
    speed[t_s < 0.5] = 0.0
    columns: dict[str, Any] = {"t_ns": t_ns}
    for i, axis in enumerate("xyz"):
        columns |= {f"ref_{axis}": ref[:, i], f"tcp_{axis}": tcp[:, i]}
    columns |= {"tcp_speed": speed, "ref_speed": programmed, "distance_m": distance, "status": status, "reason": reason}
    columns |= {"programme_s": (np.cumsum(pace) - pace[0]) / rate_hz}
    columns |= {"limb": [None if t < 0.5 else "LRA" for t in t_s], "link": "tool"}
    return pd.DataFrame(columns)


def make_run(seconds: float = 12.0, rate_hz: float = 100.0, *, human: bool = True, robot: bool = True) -> Run:
    """A run of all stages, or without the later ones."""
    rng = np.random.default_rng(7)
    meta = {
        "command": "report",
        "versions": {"hrcreplay": "0.1.0", "numpy": "2.4"},
        "inputs": [{"path": "/somewhere/on/disk/demo.mcap", "sha256": "ab" * 32}],
        "settings": {
            "fusion": {"rate_hz": rate_hz},
            "occupancy": {"method": "paper", "stop_s": 0.377},
            "plan": {"method": "qp", "reference": "path", "task": "/somewhere/task.toml"},
            "report": {"near_m": 0.5, "stationary_m_per_s": 0.001},
        },
        "T_world_base": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.65], [0, 0, 0, 1]],
    }
    return Run(
        folder=Path("nowhere"),
        meta=meta,
        state=state_table(seconds, rate_hz, rng),
        measurements=measurement_table(seconds, rng),
        truth=truth_table(seconds) if human else None,
        occupancy=occupancy_table(seconds) if human else None,
        motion=motion_table(seconds, rate_hz, held=0.3) if robot else None,
        baselines={"scaling": motion_table(seconds, rate_hz, held=1.0)} if robot else {},
        counts={"frames_duplicate": 3, "points_not_finite": 17},
        notes=("header stamps are zero: arrival times used",),
    )


def contact_table(run: Run, method: str, touching: range, *, person: str = "ground truth") -> pd.DataFrame:
    """0.3 m away, but for some ticks in contact at a speed of its own each; the robot rests in the first 100 ticks."""
    assert run.motion is not None
    n = len(run.motion)
    tick = np.arange(n)
    touch = np.isin(tick, touching)
    distance = np.where(touch, -0.001 * (tick - touching.start), 0.3 + 1e-5 * tick)
    left_m = np.where(tick % 10 == 0, np.where(tick == 500, 0.04, 0.0), np.nan)
    return pd.DataFrame(
        {
            "t_ns": run.motion["t_ns"],
            "method": method,
            "person": person,
            "moving": tick >= 100,
            "distance_m": distance,
            "person_m": distance,
            "other_m": np.nan,
            "source": person,
            "limb": np.where(touch, "LRA", "THX"),
            "link": np.where(touch, "tool", "forearm"),
            "tcp_speed": 0.001 * tick,
            "contact_speed": 0.002 * tick,
            "outside_m": np.where(touch & (tick >= 100), np.where(tick % 3 == 0, -0.02, 0.01), np.nan),
            "left_m": left_m,
            "left_limb": ["ULA" if out_m > 0.0 else None for out_m in left_m],
            "left_full_m": np.where(tick % 20 == 0, left_m, np.nan),
            "left_full_limb": ["ULA" if out_m > 0.0 else None for out_m in left_m],
        }
    )


def contact_run() -> Run:
    """A certified run with its contacts: the plan touches nobody, its baselines do."""
    made = make_run()
    plan = {**made.meta["settings"]["plan"], "certify": True, "horizon": "adaptive"}
    meta = {**made.meta, "settings": {**made.meta["settings"], "plan": plan}}
    meta |= {"limits": {"prediction": {"name": "people"}}}
    assert made.motion is not None
    motion = made.motion.assign(certified=True, horizon_s=0.02, tau_s=0.012)
    blind = contact_table(made, "none", range(90, 150))
    blind["outside_m"] = np.nan
    contact = pd.concat([contact_table(made, "qp", range(0)), blind, contact_table(made, "scaling", range(95, 125))])
    baselines = {"none": made.motion, "scaling": made.baselines["scaling"]}
    return dataclasses.replace(made, meta=meta, motion=motion, baselines=baselines, contact=contact)


def metrics_of(run: Run) -> dict[str, Metric]:
    """What ``hrcreplay report`` computes of it."""
    return compute(run, near_m=0.5, stationary_m_per_s=0.001)
