"""The envelope of a frame on a network: it proves the source, the order, the time and the shared secret.

The session uses a frame only if a named source sealed it with the shared secret, and if it is not repeated, late or out
of order. This file needs only Python's standard library, so a camera's computer can use it without hrcreplay:

    sealer = Sealer(Path("secret").read_bytes(), "left camera")
    session.put("cell/left", sealer.seal(data, time.time_ns()))

An envelope: ``HRC1``, the length of the source's name (1 byte), the name, the number of the frame and its time [ns]
(8 bytes each, little-endian), an HMAC-SHA256 of all that and of the frame (32 bytes), the frame.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
from collections.abc import Collection
from typing import Final

_MAGIC: Final = b"HRC1"
_NUMBERS: Final = struct.Struct("<QQ")
_MAC_BYTES: Final = 32
#: A shorter secret can be guessed.
SHORTEST_SECRET: Final = 16


class UnverifiedError(ValueError):
    """A frame that must not be used; the text gives the reason."""


class Sealer:
    """Seals the frames of one source."""

    def __init__(self, secret: bytes, source: str, first: int = 0) -> None:
        """Creates the sealer of a source.

        Args:
            secret: Secret that is shared with the opener of the frames.
            source: Name of the source, at most 255 bytes in UTF-8.
            first: Number of the first frame. After a restart a source may count from 0, because its time has advanced.
        """
        self._secret, self._name, self._number = secret, source.encode(), first
        if not 0 < len(self._name) <= 255:
            raise ValueError(f"source {source!r}: found {len(self._name)} bytes; 1 to 255 would be right")

    def seal(self, frame: bytes, t_ns: int) -> bytes:
        """The envelope of a frame that is sent at ``t_ns``, Unix time [ns]."""
        head = _MAGIC + bytes([len(self._name)]) + self._name + _NUMBERS.pack(self._number, t_ns)
        self._number += 1
        return head + _mac(self._secret, head + frame) + frame


class Opener:
    """Opens the envelopes of one camera: each frame once, in order, and not later than ``late_s``."""

    def __init__(self, secret: bytes, sources: Collection[str], late_s: float) -> None:
        """Creates the opener of a camera.

        Args:
            secret: Secret that is shared with the sources.
            sources: Names of the allowed sources; empty: every source that has the secret.
            late_s: Largest absolute difference between the envelope's time and the session's time [s].
        """
        self._secret, self._sources = secret, frozenset(sources)
        self._late_ns = round(late_s * 1e9)
        self._last: dict[str, tuple[int, int]] = {}  # of each source: time [ns] and number

    def open(self, data: bytes, now_ns: int) -> bytes:
        """The frame in an envelope.

        Args:
            data: The envelope.
            now_ns: Present Unix time of this computer [ns].

        Raises:
            UnverifiedError: The frame must not be used.
        """
        head, mac, frame, name = _parts(data)
        if not hmac.compare_digest(mac, _mac(self._secret, head + frame)):
            raise UnverifiedError("sealed with another secret, or changed on the way")
        if self._sources and name not in self._sources:
            raise UnverifiedError(f"its source {name!r} is not in live.zenoh.sources")
        number, t_ns = _NUMBERS.unpack(head[-_NUMBERS.size :])
        if abs(now_ns - t_ns) > self._late_ns:
            raise UnverifiedError(
                f"sealed {(now_ns - t_ns) / 1e9:.3f} s before its arrival; set the clocks, or find who sends old frames"
            )
        last_ns, last = self._last.get(name, (-1, -1))
        if t_ns < last_ns or (t_ns == last_ns and number <= last):
            raise UnverifiedError("arrived twice, or after a newer frame")
        self._last[name] = (t_ns, number)
        return frame


def _parts(data: bytes) -> tuple[bytes, bytes, bytes, str]:
    """Head, HMAC, frame and the source's name."""
    if len(data) < 5 or data[:4] != _MAGIC:
        raise UnverifiedError("not sealed")
    end = 5 + data[4] + _NUMBERS.size
    if len(data) < end + _MAC_BYTES:
        raise UnverifiedError("cut short")
    name = data[5 : 5 + data[4]].decode(errors="replace")
    return data[:end], data[end : end + _MAC_BYTES], data[end + _MAC_BYTES :], name


def _mac(secret: bytes, data: bytes) -> bytes:
    return hmac.new(secret, data, hashlib.sha256).digest()
