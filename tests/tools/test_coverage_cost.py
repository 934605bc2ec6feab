"""What it costs to hold people, beside volumes that are asked for one by one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from hrcreplay.audit.departures import LimbDepartures, tube_stage
from hrcreplay.pipeline.surroundings import PredictionStage
from hrcreplay.records import BODY
from tests.tools.coverage_cost import cost, departed


def test_narrow_lines_hold_fewer_people_in_less_room(tmp_path: Path) -> None:
    stage, sample = departed("kinect 2 sitting", tmp_path)
    narrow, plain = cost(stage, [sample], 0.6), cost(stage, [sample], 1.0)
    assert (np.array(narrow["shares"]) <= plain["shares"]).all()
    assert narrow["shares"][-1] < plain["shares"][-1] - 0.02
    assert (1.2 * np.array(narrow["union_m3"]) < plain["union_m3"]).all()
    np.testing.assert_allclose(cost(stage, [sample, sample], 1.0)["shares"], plain["shares"])
    assert narrow["shares"] == _held_shares(stage, sample, 0.6)


def _held_shares(stage: PredictionStage, sample: LimbDepartures, factor: float) -> list[float]:
    """The same from the radii of the volumes themselves, and the departures from tubes without a ball."""
    known = stage.limits.departure
    assert known is not None
    assert known.swings_s is not None
    beyond_m, swings_s = (np.ceil(factor * of / 1e-3 - 1e-9) * 1e-3 for of in (known.beyond_m, known.swings_s))
    residuals = np.ceil(factor * known.residuals / 1e-2 - 1e-9) * 1e-2
    scaled = tube_stage(stage, replace(known, beyond_m=beyond_m, residuals=residuals, swings_s=swings_s))
    thick_m = np.tile(scaled.predictor.rules.body_m, (len(sample.states), 1))
    new = np.isnan(sample.states.residual_m[:, BODY.index("THX")])
    thick_m[new, BODY.index("LEGS")] += stage.settings.residual_unknown_m  # their departures are beside it
    shares = []
    for k, horizon_s in enumerate(known.horizon_s.tolist()):
        departs_m = scaled.volumes(sample.states, horizon_s).radius_m - thick_m
        out_m = sample.beyond_m(k, float(known.rise_m[k]), float(known.sink_m[k])) - departs_m
        worst_m = np.where(np.isnan(out_m), -np.inf, out_m).max(axis=1)
        shares.append(float((worst_m[worst_m > -np.inf] <= 1e-9).mean()))
    return shares
