"""Shipped descriptions of topics and orders of points (presets.toml), and the places of points in a description."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from hrcreplay.errors import SettingsError
from hrcreplay.logs.messages import AZURE_INDEX, KINECT2_INDEX
from hrcreplay.records import POINTS
from hrcreplay.settings.sections import Decoder

#: For each body point its alternatives, each of one key or of several of which it is the middle. A key is the name or
#: place of a point in the message, as ``plain`` writes it.
Places = Mapping[str, tuple[tuple[str, ...], ...]]


def plain(name: object) -> str:
    """Returns a name without case, spaces and separators, as names of points compare."""
    return re.sub(r"[\s_.-]", "", str(name)).lower()


def places(index: Mapping[str, int | str]) -> Places:
    """Parses the places of body points: ``a + b`` is a middle, ``a | b`` are alternatives."""
    return {
        point: tuple(tuple(map(plain, middle.split("+"))) for middle in str(given).split("|"))
        for point, given in index.items()
    }


def places_of(how: Decoder) -> Places:
    """Returns the places of a description's body points. Raises SettingsError for an unknown order."""
    return places(order(how.index, f"logs.decoders: {how.topic}") if isinstance(how.index, str) else how.index)


def order(name: str, where: str) -> Mapping[str, int | str]:
    """Returns a shipped order of points. Raises SettingsError if there is none of this name."""
    known = _orders()
    if name not in known:
        raise SettingsError(f"{where}: found the order {name!r}; would be right: {', '.join(sorted(known))}")
    return known[name]


@cache
def _orders() -> Mapping[str, Mapping[str, int | str]]:
    return {
        "points": {point: i for i, point in enumerate(POINTS)},
        "azure": {POINTS[at]: joint for joint, at in AZURE_INDEX.items()},
        "kinect2": {POINTS[at]: joint for joint, at in KINECT2_INDEX.items()},
        **_shipped()["orders"],
    }


@cache
def _shipped() -> dict[str, Any]:
    return tomllib.loads(Path(__file__).with_name("presets.toml").read_text(encoding="utf-8"))


@dataclass(frozen=True)
class Preset:
    """A shipped description of a message type: its variants, each the keys of a decoder."""

    name: str
    types: tuple[str, ...]
    variants: tuple[Mapping[str, Any], ...]


@cache
def presets() -> tuple[Preset, ...]:
    """Returns the shipped presets in order."""
    found: dict[str, tuple[list[str], list[Mapping[str, Any]]]] = {}
    for table in _shipped()["presets"]:
        types, variants = found.setdefault(table["preset"], ([], []))
        types.extend(table.get("types", ()))
        variants.append({key: value for key, value in table.items() if key not in ("preset", "types")})
    return tuple(Preset(name, tuple(types), tuple(variants)) for name, (types, variants) in found.items())


def variants(how: Decoder) -> tuple[Decoder, ...]:
    """Returns the descriptions that a decoder of the settings stands for: itself, or its preset's with its keys.

    Raises:
        SettingsError: There is no such preset.
    """
    if how.preset is None:
        return (how,)
    preset = next((preset for preset in presets() if preset.name == how.preset), None)
    if preset is None:
        known = ", ".join(preset.name for preset in presets())
        raise SettingsError(f"logs.decoders: {how.topic}: found the preset {how.preset!r}; would be right: {known}")
    given = {key: getattr(how, key) for key in how.model_fields_set}
    return tuple(Decoder(**(dict(variant) | given)) for variant in preset.variants)


def of_type(msgtype: str, topic: str, unit: str) -> list[tuple[Decoder, ...]]:
    """Returns the descriptions of the presets that read a message type, each with its variants."""
    return [
        tuple(Decoder(topic=topic, preset=preset.name, unit=unit, **variant) for variant in preset.variants)
        for preset in presets()
        if msgtype in preset.types
    ]


def lacking(found: Collection[str]) -> str:
    """Lists the body points that are not among those found, in words; empty if none is missing."""
    missing = [point for point in POINTS if point not in found]
    both = {point[:-2] for point in missing if point[-2:] == "_l" and f"{point[:-2]}_r" in missing}
    told = [point for point in missing if point[:-2] not in both or point[-2:] == "_l"]
    names = {"foot_l": "feet"} if "foot" in both else {}
    return ", ".join(names.get(point, f"{point[:-2]}s" if point[:-2] in both else point) for point in told)
