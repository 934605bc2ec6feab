"""What was wrong with a log, in lines for a page's first screen and a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from hrcreplay.logs.clean import DEFECTS

#: Between groups of digits.
NARROW = "\u202f"
_CAMERA = "_<camera>"
#: How ``DEFECTS`` begins what is none, and what is no count.
_NONE, _INSTANT = "no defect", "an instant"


def flaws(counts: Mapping[str, int], notes: Sequence[str]) -> tuple[str, ...]:
    """The notes of a run, then what was counted of each defect of its log; nothing of a clean log.

    Args:
        counts: ``counts`` of run.json; what is no defect of the log is left out.
        notes: ``notes`` of run.json.
    """
    found = [(_text(name), count) for name, count in sorted(counts.items()) if count]
    return (*notes, *(f"{text}: {f'{count:,}'.replace(',', NARROW)}" for text, count in found if text))


def _text(name: str) -> str:
    """What ``DEFECTS`` says of a counter; empty where it counts no defect. A note tells of the instant."""
    for known, text in DEFECTS.items():
        stem = known.removesuffix(_CAMERA)
        of_camera = stem != known and name.startswith(f"{stem}_")
        if (name == known or (of_camera and name not in DEFECTS)) and not text.startswith((_NONE, _INSTANT)):
            return f"camera {name.removeprefix(f'{stem}_')}, {text}" if of_camera else text
    return ""
