"""A million sampled motions, of which none may leave a sound volume, and some must leave the printed ones."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hrcreplay.human.prediction.swept_volumes import METHODS
from hrcreplay.pipeline import assembly
from hrcreplay.pipeline.run_config import resolve_without_log
from hrcreplay.records import LIMBS, HumanStates, SweptVolumes
from hrcreplay.settings.load import load_settings
from tests.tools.soundness import run as sampling
from tests.tools.soundness.__main__ import main
from tests.tools.soundness.run import Plan, Result, escaped, run, sample_states

SEED = 2020
#: A million in all.
SHARES = {
    "exact": (Plan("sound", "paper", SEED), 300_000),
    "as predicted by default": (Plan("sound", "people", SEED, sigmas=1.0, hand_m=0.19), 100_000),
    "people": (Plan("sound", "human", SEED), 150_000),
    "likely": (Plan("sound", "paper", SEED, sigmas=3.0, latency_s=0.05, hand_m=0.19), 200_000),
    "unseen": (Plan("sound", "paper", SEED, sigmas=3.0, unseen_s=0.8), 50_000),
    "beyond": (Plan("sound", "paper", SEED, beyond=True), 100_000),
    "people, likely and beyond": (Plan("sound", "human", SEED, sigmas=3.0, hand_m=0.19, beyond=True), 100_000),
}


@pytest.mark.parametrize("share", SHARES)
def test_no_motion_leaves_a_sound_volume(share: str) -> None:
    plan, motions = SHARES[share]
    result = run(plan, motions, processes=1)
    assert result.motions == motions
    assert result.limbs == (*LIMBS, "LEGS")
    assert not escaped(result), dict(zip(result.limbs, result.margin_m, strict=True))
    assert result.escapes.sum() == 0
    assert result.margin_m.max() > -1e-5  # the sampler comes as far as anyone can


def test_a_million_in_all() -> None:
    assert sum(motions for _, motions in SHARES.values()) == 1_000_000


@pytest.mark.parametrize("method", ["paper", "positions"])
def test_motions_leave_the_printed_volumes(method: str) -> None:
    result = run(Plan(method, "paper", SEED), 60_000, processes=1)
    share = dict(zip((*LIMBS, "any"), result.states_with_escapes / result.states, strict=True))
    worst_m = dict(zip(LIMBS, result.margin_m, strict=True))
    assert share["any"] > (0.4 if method == "paper" else 0.05)
    assert worst_m["THX"] > 0.01
    if method == "paper":
        assert share["LRA"] + share["LLA"] > 0.1
        assert min(worst_m.values()) > 0.005


def shortened(
    predict: Callable[[HumanStates, Plan], SweptVolumes],
) -> Callable[[HumanStates, Plan], SweptVolumes]:
    return lambda states, plan: predict(states, replace(plan, horizon_s=0.995 * plan.horizon_s))


def test_a_horizon_half_a_percent_short_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampling, "predict", shortened(sampling.predict))
    result = run(Plan("sound", "paper", SEED), 40_000, processes=1)
    assert (result.escapes > 0).all()
    assert (result.states_with_escapes > 0.5 * result.states).sum() >= 3
    assert 1e-5 < result.margin_m.max() < 5e-3


def same(a: Result, b: Result) -> bool:
    return all(np.array_equal(value, getattr(b, name)) for name, value in vars(a).items())


def test_any_split_over_any_processes_gives_the_same() -> None:
    plan = Plan("paper", "paper", SEED, motions_a_state=200)
    whole = run(plan, 12 * 200, processes=1)
    assert same(run(plan, 12 * 200, processes=2), whole)
    parts = sample_states(plan, 0, 5)
    parts.add(sample_states(plan, 5, 7))
    assert same(parts, whole)
    assert not same(run(replace(plan, seed=SEED + 1), 12 * 200, processes=1), whole)


def test_the_command_tells_of_escapes(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--samples", "3000", "--processes", "1", "--limits", "paper"]
    assert main([*arguments, "--method", "paper"]) == 0  # the print encloses less: that is no failure
    out = capsys.readouterr().out
    assert "within 0 sigma, hand of 0 m, seed 0: 3,000 motions from 3 states" in " ".join(out.split())
    assert "motions escaped; worst margin outside" in out
    assert main(["--samples", "1000", "--method", "sound", "--limits", "paper", "--processes", "1"]) == 0
    assert "no motion escaped; worst margin inside by 0.00" in capsys.readouterr().out


def test_the_command_fails_where_a_motion_leaves_a_sound_volume(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampling, "predict", shortened(sampling.predict))
    assert main(["--samples", "1000", "--processes", "1"]) == 1


@pytest.mark.parametrize("method", METHODS)
def test_the_command_samples_what_predict_does_by_default(method: str, capsys: pytest.CaptureFixture[str]) -> None:
    """And prints one line for machines that says so."""
    assert main(["--samples", "2000", "--method", method, "--processes", "1", "--json"]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    found = json.loads(line)
    sound = method == "sound"
    settings = load_settings()
    prediction_stage = assembly.prediction_stage(resolve_without_log("predict", Path(), settings, None))
    assert (found["method"], found["limits"]) == (method, prediction_stage.limits.name)
    assert found["horizon_s"] == prediction_stage.horizon_s
    assert found["latency_s"] == prediction_stage.settings.latency_s
    assert found["sigmas"] == (prediction_stage.settings.sigmas if sound else 0.0)  # the print knows no margins
    assert found["hand_m"] == (prediction_stage.settings.hand_m if sound else 0.0)
    plan = Plan(method, "people", 0, sigmas=found["sigmas"], hand_m=found["hand_m"])
    result = run(plan, 2000, processes=1)
    assert (found["samples"], found["states"]) == (2000, 2)
    assert found["states_let_out"] == result.states_with_escapes[-1]
    assert found["share"] == result.states_with_escapes[-1] / 2
    assert found["worst_mm"] == 1e3 * result.margin_m.max()


def test_the_command_tells_of_wrong_limits(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--samples", "10", "--limits", "nobody", "--processes", "1"]) == 2
    assert "nobody" in capsys.readouterr().err
