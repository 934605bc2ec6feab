"""The samples between which values are interpolated, against a search through all of them."""

from __future__ import annotations

import numpy as np
import pytest

from hrcreplay.records import find_neighbours

T_NS = np.array([0, 10, 20, 200, 210]) * 1_000_000


@pytest.mark.parametrize("gap_s", [None, 0.05])
def test_neighbours_are_the_nearest_samples_on_either_side(gap_s: float | None) -> None:
    at_ns = np.array([-1, 0, 4, 10, 19, 20, 110, 200, 207, 210, 211]) * 1_000_000
    found = find_neighbours(T_NS, at_ns, gap_s)
    for k, t in enumerate(at_ns.tolist()):
        earlier = [i for i, sample in enumerate(T_NS.tolist()) if sample <= t]
        later = [i for i, sample in enumerate(T_NS.tolist()) if sample >= t]
        in_gap = gap_s is not None and 20_000_000 < t < 200_000_000
        assert found.known[k] == bool(earlier and later and not in_gap), t
        if found.known[k]:
            before, after = earlier[-1], later[0]
            assert (found.before[k], found.after[k]) == (before, after)
            way = (t - T_NS[before]) / (T_NS[after] - T_NS[before]) if before != after else 0.0
            assert found.share[k] == pytest.approx(way)
        else:
            assert found.share[k] == 0.0


def test_a_single_sample_is_known_at_its_own_instant_only() -> None:
    found = find_neighbours(T_NS[:1], np.array([-1, 0, 1]))
    assert found.known.tolist() == [False, True, False]
