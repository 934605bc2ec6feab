"""Named limit sets: ``paper`` (Table 1), ``human`` (the literature) and ``people`` (fitted); others are files."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from hrcreplay.errors import SettingsError
from hrcreplay.human.model import LimitSet, alpha_2_bounds, alpha_3_bounds
from hrcreplay.records import JOINTS, Floats
from hrcreplay.store.run_folder import write_whole

_HERE = Path(__file__).parent
NAMES = ("paper", "human", "people")
_QUANTITIES = ("position", "velocity", "acceleration")
_COUPLED = ("ar2", "ar3", "al2", "al3")


def load_limits(name_or_path: str | Path) -> LimitSet:
    """A limit set that ships with the package, by its name, or one of the user's, by the path of its TOML file.

    ``paper`` is Table 1.

    Args:
        name_or_path: ``paper``, ``human``, ``people`` or a file like theirs: ``coupled`` and a table ``joints`` with
            a row ``{ position = [low, high], velocity = [...], acceleration = [...] }`` for each of JOINTS
            [m, m, rad...; per second; per second squared]. Where coupled, alpha_2 and alpha_3 have no position.
            A table ``provenance`` may say where the bounds come from; it changes nothing.

    Raises:
        SettingsError: The file cannot be read, or a key or a bound is not what it should be.
    """
    path = _HERE / f"{name_or_path}.toml" if name_or_path in NAMES else Path(name_or_path)
    try:
        table = tomllib.loads(path.read_text())
    except OSError as error:
        known = ", ".join(NAMES)
        raise SettingsError(
            f"{name_or_path}: no limit set ({error.strerror}); name one of {known} or a file"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: not TOML ({error})") from error
    _known(table, ("coupled", "joints", "provenance"), str(path))
    if not isinstance(table.get("provenance", {}), dict):
        raise SettingsError(f"{path}: provenance: found {table['provenance']!r}; write a table, or leave it out")
    coupled, joints = table.get("coupled"), table.get("joints")
    if not isinstance(coupled, bool):
        raise SettingsError(f"{path}: coupled: found {coupled!r}; write true or false")
    if not isinstance(joints, dict):
        raise SettingsError(f"{path}: joints: found {joints!r}; write a table with a row for each joint")
    _known(joints, JOINTS, f"{path}: joints")
    bounds = np.array([_joint(joints.get(joint), joint, f"{path}: joints.{joint}", coupled) for joint in JOINTS])
    if coupled:
        _enclose(bounds)
    p, v, a = (np.ascontiguousarray(bounds[:, k].T) for k in range(len(_QUANTITIES)))
    return LimitSet(path.stem, p[0], p[1], v[0], v[1], a[0], a[1], coupled)


def write_limits(limits: LimitSet, provenance: dict[str, Any], path: Path) -> None:
    """Writes a limit set that ``load_limits`` reads, whole or not at all.

    Args:
        limits: Bounds; its name is that of the file.
        provenance: Where they come from: texts, numbers, lists and tables.
        path: File to make.

    Raises:
        SettingsError: The file exists, or its folder cannot be written.
    """
    write_whole(path, _toml(limits, provenance))


def _toml(limits: LimitSet, provenance: dict[str, Any]) -> str:
    pairs = ((limits.p_min, limits.p_max), (limits.v_min, limits.v_max), (limits.a_min, limits.a_max))
    lines = [
        "# [m, m, rad...; per second; per second squared]; x forward, y to the left",
        f"coupled = {_value(limits.coupled)}",
        "",
        "[joints]",
    ]
    for j, joint in enumerate(JOINTS):
        row = {name: [float(low[j]), float(high[j])] for name, (low, high) in zip(_QUANTITIES, pairs, strict=True)}
        if limits.coupled and joint in _COUPLED:
            del row["position"]
        lines.append(f"{joint} = {_value(row)}")
    lines += ["", "[provenance]", *(f"{key} = {_value(value)}" for key, value in provenance.items())]
    return "\n".join(lines) + "\n"


def _value(value: Any) -> str:
    """TOML of a value; a table on one line."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_value(part)}" for key, part in value.items()) + " }"
    if isinstance(value, list | tuple):
        several = any(isinstance(part, dict) for part in value)
        return (
            ("[\n  " + ",\n  ".join(map(_value, value)) + ",\n]") if several else f"[{', '.join(map(_value, value))}]"
        )
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=False)


def _known(table: dict[str, Any], keys: tuple[str, ...], where: str) -> None:
    for key in table:
        if key not in keys:
            raise SettingsError(f"{where}: unknown key {key!r}; known here: {', '.join(keys)}")


def _joint(row: Any, joint: str, where: str, coupled: bool) -> list[tuple[float, float]]:
    """The three pairs of bounds of one joint; a position that (34) gives is left for ``_enclose``."""
    if not isinstance(row, dict):
        raise SettingsError(f"{where}: found {row!r}; write a row with {', '.join(_QUANTITIES)}")
    _known(row, _QUANTITIES, where)
    pairs = []
    for quantity in _QUANTITIES:
        if quantity == "position" and coupled and joint in _COUPLED:
            if quantity in row:
                raise SettingsError(f"{where}: found a position; Eq. (34) gives it where coupled = true, leave it out")
            pairs.append((0.0, 0.0))
        else:
            pairs.append(_pair(row.get(quantity), f"{where}.{quantity}"))
    if joint == "theta" and pairs[0] != (-np.inf, np.inf):
        raise SettingsError(f"{where}.position: found {list(pairs[0])}; heading has no stop, write [-inf, inf]")
    if joint not in JOINTS[:3] and not np.isfinite(pairs[0]).all():
        raise SettingsError(f"{where}.position: found {list(pairs[0])}; an angle of the body needs finite bounds")
    if not np.isfinite(pairs[1:]).all():
        raise SettingsError(f"{where}: found an infinite rate; velocity and acceleration need finite bounds")
    if not (pairs[1][0] <= 0 <= pairs[1][1] and pairs[2][0] < 0 < pairs[2][1]):
        raise SettingsError(f"{where}: found rates without 0; a person must be able to stand still and to change speed")
    return pairs


def _pair(value: Any, where: str) -> tuple[float, float]:
    numbers = isinstance(value, list) and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
    if not numbers or len(value) != 2 or not value[0] <= value[1]:
        raise SettingsError(f"{where}: found {value!r}; write [low, high] with low <= high")
    return float(value[0]), float(value[1])


def _enclose(bounds: Floats) -> None:
    """Writes what Eq. (34b), (34c) allow at most as the position bounds of alpha_2 and alpha_3 into (12, 3, 2)."""
    for first in (JOINTS.index("ar1"), JOINTS.index("al1")):
        bounds[first + 1, 0] = alpha_2_bounds(*bounds[first, 0])
        bounds[first + 2, 0] = alpha_3_bounds(*bounds[first, 0], *bounds[first + 1, 0])
