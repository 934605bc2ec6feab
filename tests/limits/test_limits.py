from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hrcreplay.errors import SettingsError
from hrcreplay.limits import load_limits
from hrcreplay.records import JOINTS
from tests.facts import facts

PI = np.pi
INF = np.inf
#: Table 1, typed once more: joint -> position, velocity, acceleration.
TABLE_1 = {
    "x": ((-INF, INF), (0.0, 0.80), (-0.10, 0.10)),
    "y": ((-INF, INF), (-0.80, 0.80), (-0.10, 0.10)),
    "theta": ((-INF, INF), (-PI / 4, PI / 4), (-PI / 8, PI / 8)),
    "rho": ((-PI / 6, PI / 2), (-PI / 10, PI / 10), (-PI / 20, PI / 20)),
    "1": ((-PI / 20, 8 * PI / 9), (-PI / 2, PI / 2), (-PI / 4, PI / 4)),
    "2": (None, (-PI / 2, PI / 2), (-PI / 4, PI / 4)),
    "3": (None, (-PI / 2, PI / 2), (-PI / 4, PI / 4)),
    "z": ((0.0, 1.3), (0.0, 0.0), (-0.1, 0.1)),  # not in the table: the pelvis stays at its height
    "4": ((PI / 9, PI), (-3 * PI / 10, 3 * PI / 10), (-3 * PI / 20, 3 * PI / 20)),
}


def test_paper_is_table_1() -> None:
    limits = load_limits("paper")
    assert limits.name == "paper"
    assert limits.coupled
    pairs = ((limits.p_min, limits.p_max), (limits.v_min, limits.v_max), (limits.a_min, limits.a_max))
    for j, joint in enumerate(JOINTS):
        expected = TABLE_1.get(joint, TABLE_1.get(joint[-1]))
        assert expected is not None
        for (low, high), bounds in zip(pairs, expected, strict=True):
            if bounds is not None:
                np.testing.assert_allclose([low[j], high[j]], bounds, atol=1e-9)


def test_paper_encloses_what_34_allows() -> None:
    limits = load_limits("paper")
    for a1 in np.linspace(-9, 160, 50):
        for a2 in np.linspace(-43 + a1 / 3, 153 - a1 / 6, 30):
            low, high = -90 + 7 * a1 / 9 - a2 / 9 + 2 * a1 * a2 / 810, 60 + 4 * a1 / 9 - 5 * a2 / 9 + 5 * a1 * a2 / 810
            for first in (4, 8):
                assert limits.p_min[first + 1] <= np.radians(a2) + 1e-12
                assert limits.p_max[first + 1] >= np.radians(a2) - 1e-12
                assert limits.p_min[first + 2] <= np.radians(low) + 1e-12
                assert limits.p_max[first + 2] >= np.radians(high) - 1e-12


def test_human_holds_everything_that_paper_does_and_steps_backward() -> None:
    paper, human = load_limits("paper"), load_limits("human")
    for kind in "va":
        assert (getattr(human, f"{kind}_min") < getattr(paper, f"{kind}_min")).all()
        assert (getattr(human, f"{kind}_max") > getattr(paper, f"{kind}_max")).all()
    assert (human.p_min <= paper.p_min).all()
    assert (human.p_max >= paper.p_max).all()
    assert human.v_min[0] <= -1.0
    assert not human.coupled


def shipped(name: str = "human") -> str:
    return (Path(load_limits.__code__.co_filename).parent / f"{name}.toml").read_text()


def test_a_file_of_the_users_own(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(shipped().replace("velocity = [-1.3, 2.5]", "velocity = [0.0, 3]"))
    limits = load_limits(path)
    assert limits.name == "mine"
    assert (limits.v_min[0], limits.v_max[0]) == (0.0, 3.0)


@pytest.mark.parametrize(
    ("base", "found", "wrong", "message"),
    [
        ("human", "coupled = false", "coupled = 1", "coupled | 1 | true or false"),
        (
            "human",
            "coupled = false",
            "coupled = false\nspeed = 1",
            "'speed' | coupled, joints, departure, provenance",
        ),
        ("human", "\nar4 ", "\nar5 ", "joints | 'ar5' | x, y, theta"),
        ("human", "\nar4 ", "\n#ar4 ", "joints.ar4 | missing | position, velocity"),
        ("human", "{ position = [-inf, inf], velocity = [-1.3, 2.5]", "{ speed = 1", "joints.x | 'speed'"),
        ("human", "velocity = [-1.3, 2.5]", "velocity = [2.5, -1.3]", "joints.x.velocity | [2.5, -1.3]"),
        ("human", "velocity = [-1.3, 2.5]", "velocity = [2.5]", "joints.x.velocity | [2.5]"),
        ("human", "velocity = [-1.3, 2.5]", "velocity = [nan, 2.5]", "joints.x.velocity | [nan, 2.5]"),
        ("human", "velocity = [-1.3, 2.5]", "velocity = [-inf, inf]", "joints.x | infinite"),
        ("human", "velocity = [-1.3, 2.5]", "velocity = [1.0, 2.5]", "joints.x | rates without 0"),
        (
            "human",
            "theta = { position = [-inf, inf]",
            "theta = { position = [-3, 3]",
            "joints.theta.position | [-inf, inf]",
        ),
        ("paper", "ar2   = { ", "ar2   = { position = [0, 1], ", "joints.ar2 | Eq. (34)"),
        (
            "people",
            "rise_m = [",
            "rise_m = [0.1, ",
            "departure.rise_m | [0.1 | 5 numbers",
        ),
        ("people", "sink_m = [", "sink_m = [-", "departure.sink_m | [-0.01 | 5 numbers | at least 0"),
        (
            "people",
            "sink_m = [",
            "sank_m = [",
            "departure | 'sank_m' | horizon_s, rise_m, sink_m",
        ),
        ("human", "[joints]", "[joints", "not TOML"),
    ],
)
def test_a_wrong_file_is_refused_in_one_clear_line(
    tmp_path: Path, base: str, found: str, wrong: str, message: str
) -> None:
    text = shipped(base)
    assert found in text
    path = tmp_path / "wrong.toml"
    path.write_text(text.replace(found, wrong))
    with pytest.raises(SettingsError, match=facts(*message.split(" | "))) as caught:
        load_limits(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_an_unknown_name_is_refused_with_the_known_ones() -> None:
    with pytest.raises(SettingsError, match=facts("humans", "paper", "human", "people")):
        load_limits("humans")
