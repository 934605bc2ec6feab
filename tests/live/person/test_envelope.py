"""Frames that are sealed, and what somebody without the secret can do with them: nothing."""

from __future__ import annotations

import hashlib
import hmac
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hrcreplay.live.person.envelope import Opener, Sealer, UnverifiedError
from hrcreplay.live.person.source import CameraSubscription
from hrcreplay.settings.sections import ZenohKey
from tests.facts import facts, tells
from tests.live.person.test_zenoh import NOW_NS, notes, own, skeletons

SECRET = b"sixteen bytes or"
LATE_S = 0.3


def opener(*sources: str, secret: bytes = SECRET) -> Opener:
    return Opener(secret, sources, LATE_S)


def test_an_envelope_is_as_its_description_says() -> None:
    """Built by hand from the text of the module, so that others can build it too."""
    head = b"HRC1" + b"\x04left" + struct.pack("<QQ", 7, NOW_NS)
    by_hand = head + hmac.new(SECRET, head + b"frame", hashlib.sha256).digest() + b"frame"
    assert Sealer(SECRET, "left", first=7).seal(b"frame", NOW_NS) == by_hand
    assert opener("left").open(by_hand, NOW_NS) == b"frame"


def test_frames_in_order_are_opened_and_none_of_them_twice() -> None:
    sealer, one = Sealer(SECRET, "left"), opener("left")
    sealed = [sealer.seal(b"%d" % n, NOW_NS + n) for n in range(4)]
    assert [one.open(sealed[n], NOW_NS) for n in (0, 1, 3)] == [b"0", b"1", b"3"]
    for n in (0, 1, 2, 3):
        with pytest.raises(UnverifiedError, match="twice"):
            one.open(sealed[n], NOW_NS)


def test_a_source_that_starts_again_counts_from_the_beginning() -> None:
    one = opener("left")
    one.open(Sealer(SECRET, "left", first=900).seal(b"a", NOW_NS), NOW_NS)
    assert one.open(Sealer(SECRET, "left").seal(b"b", NOW_NS + 1), NOW_NS) == b"b"


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "not sealed"),
        (b"frame of a stranger", "not sealed"),
        (b"HRC1\x04left", "cut short"),
        (Sealer(b"another secret!!", "left").seal(b"frame", NOW_NS), "another secret"),
        (Sealer(SECRET, "right").seal(b"frame", NOW_NS), "'right' is not in live.zenoh.sources"),
        (Sealer(SECRET, "left").seal(b"frame", NOW_NS - 310_000_000), r"sealed 0\.310 s before its arrival"),
        (Sealer(SECRET, "left").seal(b"frame", NOW_NS + 310_000_000), r"sealed -0\.310 s before"),
    ],
)
def test_what_does_not_verify_is_not_opened(data: bytes, why: str) -> None:
    with pytest.raises(UnverifiedError, match=why):
        opener("left").open(data, NOW_NS)


def test_whoever_has_the_secret_may_send_where_no_source_is_named() -> None:
    assert opener().open(Sealer(SECRET, "anybody").seal(b"frame", NOW_NS), NOW_NS) == b"frame"


@given(st.integers(0, 10_000), st.integers(1, 255))
def test_no_byte_of_an_envelope_can_be_changed(at: int, by: int) -> None:
    sealed = bytearray(Sealer(SECRET, "left").seal(b"a frame", NOW_NS))
    sealed[at % len(sealed)] ^= by
    with pytest.raises(UnverifiedError):
        opener("left").open(bytes(sealed), NOW_NS)


@pytest.mark.parametrize("name", ["", "x" * 256])
def test_a_source_without_a_usable_name_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=facts("1 to 255")):
        Sealer(SECRET, name)


def test_a_camera_s_frames_are_used_when_sealed_and_else_counted_and_told() -> None:
    """Five by a stranger, beside one that is right: only that one reaches the controller."""
    camera = CameraSubscription("left", ZenohKey(key="a"), opener("left"))
    messages = [list(camera.take("a", own(NOW_NS - 1000), NOW_NS)) for _ in range(5)]
    assert skeletons([one for lot in messages for one in lot]) == []
    (note,) = notes([one for lot in messages for one in lot])
    assert tells(note, "live.zenoh.keys.left", "1 not verified", "not sealed")
    sealed = Sealer(SECRET, "left").seal(own(NOW_NS - 1000), NOW_NS)
    assert len(skeletons(list(camera.take("a", sealed, NOW_NS)))) == 1
    assert skeletons(list(camera.take("a", sealed, NOW_NS))) == []
