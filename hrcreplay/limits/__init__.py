"""Named limit sets: ``paper`` (Table 1), ``human`` (the literature) and ``people`` (fitted); others are files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, create_model

from hrcreplay.errors import SettingsError
from hrcreplay.human.model import Departure, LimitSet, alpha_2_bounds, alpha_3_bounds
from hrcreplay.records import BODY, JOINTS, Floats
from hrcreplay.store.run_folder import write_whole
from hrcreplay.toml_file import read_toml, validate

_HERE = Path(__file__).parent
NAMES = ("paper", "human", "people")
_QUANTITIES = ("position", "velocity", "acceleration")
_COUPLED = ("ar2", "ar3", "al2", "al3")
_STRICT = ConfigDict(extra="forbid", frozen=True, strict=True)
_PAIR = "[low, high] with low <= high"
#: Rows of departures that do not belong to a limb.
_OF_BODY = ("horizon_s", "rise_m", "sink_m")
#: Rows of a limb; the last one may be left out.
_OF_LIMB = ("beyond_m", "residuals", "swings_s")
#: Description of a valid value, by the key.
_RIGHT = {
    "coupled": "true or false",
    "joints": "a table with a row for each joint",
    **dict.fromkeys(JOINTS, f"a row with {', '.join(_QUANTITIES)}"),
    **dict.fromkeys(_QUANTITIES, _PAIR),
    "departure": f"horizon_s, rise_m, sink_m and a row for each of {', '.join(BODY)}, or leave it out",
    "horizon_s": "[s...], above 0 and increasing",
    **dict.fromkeys(("rise_m", "sink_m"), "a number for each horizon, at least 0"),
    **dict.fromkeys(BODY, "a row with beyond_m, residuals, and swings_s or not"),
    **dict.fromkeys(("beyond_m", "residuals", "swings_s"), "a number for each horizon"),
    "provenance": "a table, or leave it out",
}


def load_limits(name_or_path: str | Path) -> LimitSet:
    """Loads a shipped limit set by its name, or one of the user's by the path of its TOML file.

    ``paper`` is Table 1.

    Args:
        name_or_path: ``paper``, ``human``, ``people`` or a file of the same form: ``coupled`` and a table ``joints``
            with a row ``{ position = [low, high], velocity = [...], acceleration = [...] }`` for each of JOINTS [m, m,
            rad..., m; per second; per second squared]. If coupled, alpha_2 and alpha_3 have no position; without a row
            ``z``, that of ``human`` is used. A table ``departure`` may bound the departure of limbs from constant
            velocity: ``horizon_s = [...]``, ``rise_m = [...]``, ``sink_m = [...]`` and a row ``{ beyond_m = [...],
            residuals = [...], swings_s = [...] }`` for each of BODY, the last one if the bounds grow with the limb's
            present speed. A table ``provenance`` may give the origin of the bounds; it has no
            effect.

    Raises:
        SettingsError: The file cannot be read, or a key or a bound is invalid.
    """
    path = _HERE / f"{name_or_path}.toml" if name_or_path in NAMES else Path(name_or_path)
    known = f"name one of {', '.join(NAMES)} or a file"
    if not path.exists():
        raise SettingsError(f"{name_or_path}: no limit set (there is no such file); {known}")
    file = validate(_LimitFile, read_toml(path, known), path, _RIGHT).model_dump()
    rows, coupled = file["joints"], file["coupled"]
    rows["z"] = rows["z"] or read_toml(_HERE / "human.toml", "")["joints"]["z"]
    bounds = np.array([_bounds(rows[joint], joint, f"{path}: joints.{joint}", coupled) for joint in JOINTS])
    if coupled:
        _enclose(bounds)
    p, v, a = (np.ascontiguousarray(bounds[:, k].T) for k in range(len(_QUANTITIES)))
    return LimitSet(path.stem, p[0], p[1], v[0], v[1], a[0], a[1], coupled, _departure(file["departure"], str(path)))


def _departure(table: dict[str, Any] | None, where: str) -> Departure | None:
    if table is None:
        return None
    horizon_s = np.array(table["horizon_s"])
    grows = len(horizon_s) > 0 and (np.diff(horizon_s, prepend=0.0) > 0.0).all()
    if not (grows and np.isfinite(horizon_s).all()):
        raise SettingsError(
            f"{where}: departure.horizon_s: found {table['horizon_s']}; would be right: {_RIGHT['horizon_s']}"
        )
    zeros = [0.0] * len(horizon_s)
    table = table | {limb: table[limb] | {"swings_s": table[limb]["swings_s"] or zeros} for limb in BODY}
    rows = {f"{limb}.{name}": table[limb][name] for limb in BODY for name in _OF_LIMB}
    for name, row in {**rows, "rise_m": table["rise_m"], "sink_m": table["sink_m"]}.items():
        if len(row) != len(horizon_s) or not (np.array(row) >= 0.0).all() or not np.isfinite(row).all():
            raise SettingsError(
                f"{where}: departure.{name}: found {row}; would be right: {len(horizon_s)} numbers, one for each "
                "horizon, at least 0"
            )
    beyond, residuals, swings = (np.array([table[limb][name] for limb in BODY]) for name in _OF_LIMB)
    rise, sink = np.array(table["rise_m"]), np.array(table["sink_m"])
    return Departure(horizon_s, beyond, residuals, rise, sink, swings if swings.any() else None)


def write_limits(limits: LimitSet, provenance: dict[str, Any], path: Path) -> None:
    """Writes a limit set that ``load_limits`` reads, complete or not at all.

    Args:
        limits: Bounds; its name is that of the file.
        provenance: Origin of the bounds: texts, numbers, lists and tables.
        path: File to create.

    Raises:
        SettingsError: The file exists, or its folder cannot be written.
    """
    write_whole(path, _toml(limits, provenance))


def _toml(limits: LimitSet, provenance: dict[str, Any]) -> str:
    pairs = ((limits.p_min, limits.p_max), (limits.v_min, limits.v_max), (limits.a_min, limits.a_max))
    lines = [
        "# [m, m, rad..., m; per second; per second squared]; x forward, y to the left",
        f"coupled = {_value(limits.coupled)}",
        "",
        "[joints]",
    ]
    for j, joint in enumerate(JOINTS):
        row = {name: [float(low[j]), float(high[j])] for name, (low, high) in zip(_QUANTITIES, pairs, strict=True)}
        if limits.coupled and joint in _COUPLED:
            del row["position"]
        lines.append(f"{joint} = {_value(row)}")
    known = limits.departure
    if known is not None:
        lines += ["", "[departure]"]
        lines += [f"{name} = {_value(getattr(known, name).tolist())}" for name in _OF_BODY]
        for k, limb in enumerate(BODY):
            row = {"beyond_m": known.beyond_m[k].tolist(), "residuals": known.residuals[k].tolist()}
            if known.swings_s is not None:
                row["swings_s"] = known.swings_s[k].tolist()
            lines.append(f"{limb} = {_value(row)}")
    lines += ["", "[provenance]", *(f"{key} = {_value(value)}" for key, value in provenance.items())]
    return "\n".join(lines) + "\n"


def _value(value: Any) -> str:
    """Returns the TOML of a value; a table on one line."""
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


def _ordered(pair: list[float]) -> list[float]:
    if not pair[0] <= pair[1]:
        raise ValueError
    return pair


_Pair = Annotated[list[float], Field(min_length=2, max_length=2), AfterValidator(_ordered)]


class _Row(BaseModel):
    model_config = _STRICT
    position: _Pair | None = None
    velocity: _Pair
    acceleration: _Pair


class _LimbRow(BaseModel):
    model_config = _STRICT
    beyond_m: list[float]
    residuals: list[float]
    swings_s: list[float] | None = None


_rows: Any = dict.fromkeys(JOINTS, (_Row, ...)) | {"z": (_Row | None, None)}
_Joints = create_model("_Joints", __config__=_STRICT, **_rows)
_limbs: Any = dict.fromkeys(_OF_BODY, (list[float], ...)) | dict.fromkeys(BODY, (_LimbRow, ...))
_Departures = create_model("_Departures", __config__=_STRICT, **_limbs)
_LimitFile = create_model(
    "_LimitFile",
    __config__=_STRICT,
    coupled=(bool, ...),
    joints=(_Joints, ...),
    departure=(_Departures | None, None),
    provenance=(dict[str, Any], {}),
)


def _bounds(row: dict[str, Any], joint: str, where: str, coupled: bool) -> list[list[float]]:
    """Returns the three pairs of bounds of one joint; positions from Eq. (34) are set in ``_enclose``."""
    enclosed = coupled and joint in _COUPLED
    position = row["position"]
    if enclosed and position is not None:
        raise SettingsError(f"{where}: found a position; Eq. (34) gives it where coupled = true, leave it out")
    if not enclosed and position is None:
        raise SettingsError(f"{where}.position: found None; would be right: {_PAIR}")
    pairs = [position or [0.0, 0.0], row["velocity"], row["acceleration"]]
    if joint == "theta" and pairs[0] != [-np.inf, np.inf]:
        raise SettingsError(f"{where}.position: found {pairs[0]}; heading has no stop, so [-inf, inf] would be right")
    if joint not in JOINTS[:3] and not np.isfinite(pairs[0]).all():
        raise SettingsError(f"{where}.position: found {pairs[0]}; an angle or a height of the body needs finite bounds")
    if not np.isfinite(pairs[1:]).all():
        raise SettingsError(f"{where}: found an infinite rate; velocity and acceleration need finite bounds")
    if not (pairs[1][0] <= 0 <= pairs[1][1] and pairs[2][0] < 0 < pairs[2][1]):
        raise SettingsError(f"{where}: found rates without 0; a person must be able to stand still and to change speed")
    return pairs


def _enclose(bounds: Floats) -> None:
    """Writes the widest bounds from Eq. (34b), (34c) as position bounds of alpha_2 and alpha_3 into (13, 3, 2)."""
    for first in (JOINTS.index("ar1"), JOINTS.index("al1")):
        bounds[first + 1, 0] = alpha_2_bounds(*bounds[first, 0])
        bounds[first + 2, 0] = alpha_3_bounds(*bounds[first, 0], *bounds[first + 1, 0])
