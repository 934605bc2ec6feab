"""A long run is smoothed stretch by stretch: nothing is lost at their borders, for any batches."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from hrcreplay.human.fusion import fuse
from hrcreplay.human.fusion.fuse import Trace
from hrcreplay.human.fusion.inverse_kinematics import measure
from hrcreplay.human.fusion.smoother import smooth
from hrcreplay.human.model import skeleton
from hrcreplay.limits import load_limits
from hrcreplay.pipeline.people_smoother import PeopleSmoother, StretchSmoother
from hrcreplay.pipeline.stages import write_smoothed
from hrcreplay.records import Growing, HumanStates
from hrcreplay.settings.sections import Fusion
from hrcreplay.store.columns import state_columns
from hrcreplay.store.run_folder import TableWriter
from tests.human.sightings import CAMERAS, LENGTHS_M, NEUTRAL, frames_of

TICKS, LATER, N = 40, 15, 130
SETTINGS = Fusion()


@pytest.fixture(scope="module")
def run() -> tuple[HumanStates, Trace]:
    """Somebody who moves an arm, seen 50 times a second for a little more than three stretches."""
    t_ns = 4_000_000 * np.arange(N)
    captured_ns = t_ns[::5]
    p = np.tile(NEUTRAL, (len(captured_ns), 1))
    p[:, 9] += 0.5 * np.sin(10.0 * captured_ns * 1e-9)
    points_m = skeleton(p, np.tile(LENGTHS_M, (len(p), 1))) + np.random.default_rng(1).normal(0, 0.01, (len(p), 20, 3))
    measured = measure(frames_of(points_m, captured_ns * 0, captured_ns), np.tile(np.eye(4), (2, 1, 1)), SETTINGS)
    _, states, _, trace = fuse.fuse(fuse.start(CAMERAS), t_ns, measured, SETTINGS, load_limits("human"), traced=True)
    return states, trace


def smoothed(run: tuple[HumanStates, Trace], size: int, monkeypatch: pytest.MonkeyPatch) -> list[HumanStates]:
    monkeypatch.setattr(StretchSmoother, "TICKS", TICKS)
    monkeypatch.setattr(StretchSmoother, "LATER", LATER)
    one, (states, trace) = StretchSmoother(SETTINGS), run
    parts = []
    for first in range(0, N, size):
        rows = slice(first, first + size)
        parts += one.add(states.rows(rows), trace.rows(rows))
    return parts + one.finish()


@pytest.mark.parametrize("size", [1, 7, 40, 130])
def test_each_stretch_is_smoothed_with_some_ticks_of_the_next(
    run: tuple[HumanStates, Trace], size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts = smoothed(run, size, monkeypatch)
    assert [len(part) for part in parts] == [40, 40, 40, 10]
    states, trace = run
    for k, part in enumerate(parts):
        known = slice(k * TICKS, (k + 1) * TICKS + LATER)
        alone = smooth(states.rows(known), trace.rows(known), SETTINGS).rows(slice(0, len(part)))
        for field in fields(alone):
            of_one, of_all = getattr(alone, field.name), getattr(part, field.name)
            if isinstance(of_one, np.ndarray):
                np.testing.assert_array_equal(of_one, of_all, err_msg=field.name)
    changed = np.abs(np.concatenate([part.p for part in parts]) - states.p)
    assert np.nanmax(changed) > 1e-3  # it does smooth


def test_what_waits_for_the_next_stretch_does_not_keep_the_whole_one(
    run: tuple[HumanStates, Trace], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(StretchSmoother, "TICKS", TICKS)
    monkeypatch.setattr(StretchSmoother, "LATER", LATER)
    monkeypatch.setattr(Growing, "LEAST", 1)
    one, (states, trace) = StretchSmoother(SETTINGS), run
    one.add(states.rows(slice(0, TICKS + LATER)), trace.rows(slice(0, TICKS + LATER)))
    assert len(one._states) == len(one._trace) == LATER
    kept = one._states._columns | one._trace._columns
    assert {"p", "points_m", "cov"} <= kept.keys()
    for array in kept.values():
        assert array.base is None
        assert len(array) == LATER


@pytest.mark.parametrize("size", [10, 45])
def test_who_is_gone_is_smoothed_and_forgotten(run: tuple[HumanStates, Trace], size: int) -> None:
    """A visitor, at 60 of the ticks, comes out when gone: an hour's visitors would fill the memory."""
    states, trace = run
    visit = np.arange(20, 80)
    person = np.concatenate([np.ones(N, np.int64), np.full(len(visit), 2)])
    which = np.concatenate([np.arange(N), visit])
    order = np.lexsort((person, states.t_ns[which]))
    both = replace(states.rows(which[order]), person=person[order])
    traces, tick = trace.rows(which[order]), np.searchsorted(states.t_ns, both.t_ns)
    people, found = PeopleSmoother(SETTINGS), {}
    for first in range(0, N, size):
        rows = np.flatnonzero((tick >= first) & (tick < first + size))
        for part in people.add(both.rows(rows), traces.rows(rows)):
            found[first] = part
        assert sorted(people._each) == ([1, 2] if 20 <= min(first + size, N) - 1 < 80 else [1])
    ((first, visitor),) = found.items()
    assert first <= 80 < first + size + 1
    alone = smooth(states.rows(visit), trace.rows(visit), SETTINGS)
    np.testing.assert_array_equal(visitor.p, alone.p)
    assert set(visitor.numbers.tolist()) == {2}
    nobody = slice(0, 0)
    assert people.add(both.rows(nobody), traces.rows(nobody)) == []  # ticks without rows tell of nobody
    (last,) = people.finish()
    np.testing.assert_array_equal(last.p, smooth(states, trace, SETTINGS).p)


def test_smoothed_people_are_written_some_rows_at_a_time(
    run: tuple[HumanStates, Trace], monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[Mapping[str, Any]] = []

    class Kept:
        """Tables in memory."""

        def table(self, name: str, columns: Mapping[str, Any], /) -> None:
            """Keeps the rows."""
            assert name == "smooth"
            written.append(columns)

    monkeypatch.setattr(TableWriter, "ROWS", 48)
    write_smoothed(run[0], Kept())
    assert [len(part["t_ns"]) for part in written] == [48, 48, 34]
    for name, column in state_columns(run[0]).items():
        np.testing.assert_array_equal(np.concatenate([part[name] for part in written]), column)
