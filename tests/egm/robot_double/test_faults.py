"""Scripts of faults, faults by seed, and what they do to datagrams."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from hrcreplay.egm.robot_double.faults import (
    KINDS,
    LINK_FAULTS,
    Datagram,
    Fault,
    FaultyChannel,
    load_faults,
    random_faults,
)
from hrcreplay.egm.robot_double.servo import PERIOD_NS
from hrcreplay.errors import SettingsError
from tests.facts import facts

MS = 1_000_000


def carried(fault: Fault, count: int = 100, seed: int = 1) -> list[Datagram]:
    """What becomes of numbered datagrams, a period apart from 0, in order of departure."""
    channel = FaultyChannel([fault], (seed,))
    out: list[Datagram] = []
    for number in range(count):
        out += channel.transmit(Datagram(number * PERIOD_NS, b"%03d" % number), number * PERIOD_NS * 1e-9)
    return sorted(out, key=lambda datagram: datagram.t_ns)


def names(datagrams: list[Datagram]) -> list[str]:
    return [datagram.data.decode() for datagram in datagrams]


ALL = [f"{number:03}" for number in range(100)]


def test_a_way_without_faults_changes_nothing() -> None:
    datagram = Datagram(5, b"x")
    assert FaultyChannel([], (0,)).transmit(datagram, 0.0) == [datagram]


def test_loss_drops_within_its_time_only() -> None:
    assert names(carried(Fault("loss", 0.1, 0.1))) == ALL[:25] + ALL[50:]


def test_loss_by_probability_drops_that_share() -> None:
    kept = carried(Fault("loss", 0.0, 100.0, probability=0.3), count=5000)
    assert len(kept) / 5000 == pytest.approx(0.7, abs=0.02)


def test_a_burst_drops_so_many_in_a_row() -> None:
    assert names(carried(Fault("burst", 0.1, count=7))) == ALL[:25] + ALL[32:]


def test_duplicates_follow_at_once() -> None:
    assert names(carried(Fault("duplicate", 0.1))) == [*ALL[:26], ALL[25], *ALL[26:]]


def test_reordering_lets_the_next_overtake() -> None:
    assert names(carried(Fault("reorder", 0.1))) == [*ALL[:25], ALL[26], ALL[25], *ALL[27:]]


def test_delay_shifts_and_lets_later_ones_overtake() -> None:
    out = carried(Fault("delay", 0.1, delay_s=0.01))
    assert names(out) == [*ALL[:25], ALL[26], ALL[27], ALL[25], *ALL[28:]]
    assert out[27].t_ns == 25 * PERIOD_NS + 10 * MS


def test_jitter_stays_within_its_bound() -> None:
    late = [d.t_ns - int(d.data) * PERIOD_NS for d in carried(Fault("jitter", 0.0, 1.0, delay_s=0.003))]
    assert 0 <= min(late) < 200_000
    assert 2_800_000 < max(late) <= 3 * MS


def test_a_stall_delivers_all_at_once_in_their_order() -> None:
    out = carried(Fault("stall", 0.1, 0.05))
    assert names(out) == ALL
    assert [d.t_ns for d in out[25:38]] == [150 * MS] * 13
    assert out[38].t_ns == 38 * PERIOD_NS


def test_what_two_stalls_hold_waits_for_the_later() -> None:
    channel = FaultyChannel([Fault("stall", 0.1, 0.3), Fault("stall", 0.15, 0.1)], (0,))
    assert channel.transmit(Datagram(200 * MS, b""), 0.2) == [Datagram(400 * MS, b"")]


@pytest.mark.parametrize("kind", ["garbage", "empty"])
def test_nonsense_goes_beside_what_is_right(kind: str) -> None:
    out = carried(Fault(kind, 0.1, 0.04))
    good = [d.data for d in out if d.data in {name.encode() for name in ALL}]
    other = [d.data for d in out if d.data not in {name.encode() for name in ALL}]
    assert good == [name.encode() for name in ALL]
    assert len(other) == 10
    assert all((data == b"") == (kind == "empty") for data in other)


def test_faults_of_the_same_seed_are_the_same() -> None:
    jitter = Fault("jitter", 0.0, 1.0, probability=0.5)
    assert carried(jitter, seed=4) == carried(jitter, seed=4)
    assert carried(jitter, seed=4) != carried(jitter, seed=5)
    assert random_faults(7, duration_s=10.0) == random_faults(7, duration_s=10.0)
    assert random_faults(7, duration_s=10.0) != random_faults(8, duration_s=10.0)


def test_every_kind_comes_up_by_chance_within_its_time() -> None:
    drawn = [fault for seed in range(100) for fault in random_faults(seed, duration_s=9.0, count=4, after_s=2.0)]
    assert set(Counter(fault.kind for fault in drawn)) == set(KINDS)
    assert all(2.0 <= fault.at_s <= 9.0 for fault in drawn)
    assert {fault.direction for fault in drawn if fault.of_link} == {"out", "in", "both"}
    assert {fault.of_link for fault in drawn if fault.kind in LINK_FAULTS} == {True}


def test_a_script_is_read_in_the_order_of_time(tmp_path: Path) -> None:
    script = tmp_path / "faults.toml"
    script.write_text(
        '[[fault]]\nkind = "teleport"\nat_s = 4\nduration_s = 0.5\naxis = 3\nangle_deg = -20.0\n'
        '[[fault]]\nkind = "loss"\nat_s = 1.5\nduration_s = 2\nprobability = 0.3\ndirection = "both"\n'
    )
    assert load_faults(script, seed=0, duration_s=10.0) == (
        Fault("loss", 1.5, 2, probability=0.3, direction="both"),
        Fault("teleport", 4, 0.5, axis=3, angle_deg=-20.0),
    )


def test_a_script_may_leave_it_to_chance(tmp_path: Path) -> None:
    script = tmp_path / "faults.toml"
    script.write_text('[random]\ncount = 5\nafter_s = 1.0\nkinds = ["loss", "stall"]\n')
    faults = load_faults(script, seed=3, duration_s=10.0)
    assert faults == random_faults(3, duration_s=10.0, count=5, after_s=1.0, kinds=["loss", "stall"])
    assert {fault.kind for fault in faults} <= {"loss", "stall"}


BAD: dict[str, Any] = {
    "[[fault": "not TOML",
    "faults = 1": "'faults' | [[fault]] | [random]",
    "fault = 1": "fault | tables",
    '[[fault]]\nkind = "los"\nat_s = 1': "fault 1 | kind | 'los' | loss, burst",
    '[[fault]]\nkind = "loss"': "fault 1 | at_s | missing",
    '[[fault]]\nkind = "loss"\nat_s = 1\naxis = 2': "fault 1 | loss | 'axis' | at_s, direction",
    '[[fault]]\nkind = "loss"\nat_s = -1': "fault 1 | at_s | -1 | 0",
    '[[fault]]\nkind = "loss"\nat_s = nan': "fault 1 | at_s | nan",
    '[[fault]]\nkind = "loss"\nat_s = "1"': "fault 1 | at_s | '1'",
    '[[fault]]\nkind = "loss"\nat_s = true': "fault 1 | at_s | True",
    '[[fault]]\nkind = "loss"\nat_s = 1\nprobability = 2': "probability | 2 | 0 to 1",
    '[[fault]]\nkind = "loss"\nat_s = 1\ndirection = "up"': "direction | 'up' | out, in, both",
    '[[fault]]\nkind = "nan"\nat_s = 1\naxis = 7': "fault 1 | axis | 7 | 1 to 6",
    '[[fault]]\nkind = "burst"\nat_s = 1\ncount = 2.5': "fault 1 | count | 2.5 | whole number",
    "random = 3": "random | 3 | [random]",
    "[random]\nseed = 3": "random | 'seed' | after_s, count, kinds",
    '[random]\nkinds = ["x"]': "random | kinds | ['x'] | loss",
}


@pytest.mark.parametrize("text", BAD)
def test_a_bad_script_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    script = tmp_path / "faults.toml"
    script.write_text(text)
    with pytest.raises(SettingsError, match=facts("faults.toml", *BAD[text].split(" | "))) as caught:
        load_faults(script, seed=0, duration_s=10.0)
    assert "\n" not in str(caught.value)


def test_random_faults_need_a_session_with_an_end(tmp_path: Path) -> None:
    script = tmp_path / "faults.toml"
    script.write_text("[random]\ncount = 2")
    with pytest.raises(SettingsError, match=facts("faults.toml", "--duration")):
        load_faults(script, seed=0, duration_s=math.inf)


def test_a_script_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=facts("none.toml", "No such file")):
        load_faults(tmp_path / "none.toml", seed=0, duration_s=10.0)
