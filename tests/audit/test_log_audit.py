"""One log's audit takes the margins and the horizon of the run that it audits."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from hrcreplay.commands import audit, replay
from hrcreplay.records import DOF, JOINTS


def _audit(out: Path, *overrides: str) -> tuple[dict[str, Any], pd.DataFrame]:
    """Of two seconds in which the demo's person is busy."""
    overrides = ("limits.prediction=paper", *overrides)
    folder = audit.run([replay.demo_log()], out=out, overrides=overrides, start_s=10.0, end_s=12.0)
    return json.loads((folder / "audit.json").read_text()), pd.read_parquet(folder / "audit.parquet")


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], pd.DataFrame]:
    return _audit(tmp_path_factory.mktemp("bare") / "run", "prediction.sigmas=0")


def _inside(found: dict[str, Any], method: str) -> list[float]:
    joints = found["total"]["joints"][method]
    return [joints[joint]["inside_share"]["value"] for joint in JOINTS]


def test_the_joints_have_the_intervals_of_the_runs_own_margins(
    tmp_path: Path, bare: tuple[dict[str, Any], pd.DataFrame]
) -> None:
    wide, _ = _audit(tmp_path / "run", "prediction.sigmas=6")
    narrow = bare[0]
    assert _inside(wide, "sound") == [1.0] * DOF  # six deviations of the velocity alone are 3 rad/s
    assert min(_inside(narrow, "sound")) < 0.9
    assert _inside(narrow, "paper") == _inside(wide, "paper")  # the print knows no margins


def test_the_person_must_stay_until_the_robot_has_reacted_and_braked(
    tmp_path: Path, bare: tuple[dict[str, Any], pd.DataFrame]
) -> None:
    late, rows = _audit(tmp_path / "run", "prediction.sigmas=0", "prediction.latency_s=0.2", "prediction.hand_m=0.5")
    found, before = bare
    assert found["horizon_s"] == pytest.approx(0.377)
    assert late["horizon_s"] == pytest.approx(0.577)
    assert found["total"]["ticks"] - late["total"]["ticks"] == 5  # 0.2 s at 25 Hz have no whole future any more
    # the print looks ahead as far as it did, and the person had longer to leave
    early, long = (table[table["method"] == "paper"].set_index(["t_ns", "limb"]) for table in (before, rows))
    deeper = long["escape_m"] - early["escape_m"].reindex(long.index)
    assert (deeper >= 0.0).all()
    assert deeper.max() > 0.02
    # a peer looks further ahead: of its ball around the forearm and the hand, radius and length grow
    early, long = (
        table[(table["method"] == "iso_13855") & (table["limb"] == "LRA")].set_index("t_ns") for table in (before, rows)
    )
    early = early.loc[long.index]
    np.testing.assert_allclose(long["radius_m"] - early["radius_m"], 2.0 * 0.2)
    np.testing.assert_allclose(_axis_m(long) - _axis_m(early), 0.5 - 0.19)


def _axis_m(capsules: pd.DataFrame) -> pd.Series:
    """Lengths of capsules from their volumes and radii [m]."""
    radius, volume = capsules["radius_m"], capsules["volume_m3"]
    return (volume - 4.0 / 3.0 * np.pi * radius**3) / (np.pi * radius**2)
