"""What a session records of a look and of a decision, against the same written one number after the other."""

from __future__ import annotations

import hashlib
import math
import struct

import numpy as np

from hrcreplay.live.record import codec
from hrcreplay.live.record.codec import Decision, Signal
from hrcreplay.records import MotionRow, SweptVolumes, number_names

LIMBS = ("HEAD", "THX", "LEGS")
#: Vertices of each limb of two people; one is unknown, which is one vertex that is NaN.
VERTICES = (5, 1, 8, 4, 30, 1)


def volumes(shift_m: float = 0.0) -> SweptVolumes:
    """Volumes of two people, with coordinates on both sides of zero and next to it."""
    rng = np.random.default_rng(8)
    points_m = rng.normal(size=(sum(VERTICES), 3)) + shift_m
    points_m[:3] = [[0.0, -0.0, 1e-9], [-1e-9, 4.9e-8, -4.9e-8], [1e-7, -1e-7, 1.5e-7]]
    points_m[5] = math.nan
    offsets = np.cumsum((0, *VERTICES))
    return SweptVolumes(np.array([7, 7]), offsets, points_m, rng.uniform(0.05, 0.4, (2, 3)), LIMBS, "sound")


def digest_by_hand(numbers: list[float], cell: float, shift: float) -> bytes:
    """The hash of numbers, or of their cells on a grid, fed number by number."""
    found = hashlib.blake2b(digest_size=8)
    for number in numbers:
        if cell and not math.isnan(number):
            number = float(math.floor(number / cell + shift))
        found.update(struct.pack("<d", number))
    return found.digest()


def test_a_digest_is_that_of_the_vertices_and_the_radius_of_one_limb() -> None:
    made = volumes()
    digests = codec.volume_digests(made)
    assert len(digests) == len(VERTICES)
    for one, digest in enumerate(digests):
        row, limb = divmod(one, len(LIMBS))
        numbers = [*made.vertices(row, limb).ravel().tolist(), float(made.radius_m[row, limb])]
        grids = ((0.0, 0.0), (codec.GRID_M, 0.0), (codec.GRID_M, 0.5))
        assert digest == b"".join(digest_by_hand(numbers, *grid) for grid in grids)


def test_volumes_that_differ_by_a_little_are_the_same_on_a_grid_and_others_are_not() -> None:
    recorded = codec.volume_digests(volumes())
    known = [limb for limb in range(1, len(VERTICES)) if VERTICES[limb] > 1]  # the first limb's points do not move
    for shift_m, same in ((1e-12, True), (1e-6, False)):
        again = codec.volume_digests(volumes(shift_m))
        assert not any(recorded[limb] == again[limb] for limb in known)
        assert [codec.same_on_a_grid(recorded[limb], again[limb]) for limb in known] == [same] * len(known)


def test_no_people_have_no_digests() -> None:
    nobody = SweptVolumes(
        np.empty(0, np.int64), np.zeros(1, np.int64), np.empty((0, 3)), np.empty((0, 3)), LIMBS, "sound"
    )
    assert codec.volume_digests(nobody) == ()


def test_a_decision_is_recorded_with_each_number_in_its_place() -> None:
    axes = 7
    values = iter(np.random.default_rng(9).normal(size=200).tolist())
    numbers = {
        name: np.array([next(values) for _ in names]) if len(names) > 1 else next(values)
        for name in MotionRow._fields
        if name not in ("status", "limb", "link", "reason", "certified")
        for names in [number_names(name, axes)]
    }
    row = MotionRow(**numbers, limb=3, link=-1, status=1, reason="no plan", certified=True)  # type: ignore[arg-type]
    measured = np.array([next(values) for _ in range(axes)])
    found = Decision(5_000, 4_000, b"reply", codec.FOLLOWING, measured, row, "", None)
    recorded = codec.decode_decision(codec.encode_decision(found, Signal.NONE, 2, 310))
    assert recorded.row is not None
    assert recorded.row._replace(**{name: getattr(row, name) for name in numbers}) == row
    for name, value in numbers.items():
        assert np.array_equal(getattr(recorded.row, name), value), name
    wanted = [f"q_measured{axis}" for axis in range(1, axes + 1)]
    told = dict(zip(codec.number_names_of(len(recorded.numbers)), recorded.numbers.tolist(), strict=True))
    assert [told[name] for name in wanted] == measured.tolist()
    assert (told["tau_s"], told["certified"], told["ref_y"]) == (row.tau_s, 1.0, row.ref_m[1])
