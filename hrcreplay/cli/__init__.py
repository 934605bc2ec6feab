"""Options that several commands share, and their conversion to settings."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any

import typer

from hrcreplay.cli.commands import completion
from hrcreplay.errors import SettingsError

Source = Annotated[Path, typer.Argument(metavar="LOG_OR_RUN", help="A log, or the run folder of an earlier stage.")]
Config = Annotated[
    Path | None,
    typer.Option("--config", metavar="FILE.toml", help="Settings file; paper: the settings of the printed paper."),
]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="SECTION.KEY=VALUE", help="One setting; wins over the file. May be repeated."),
]
Topic = Annotated[
    list[str] | None,
    typer.Option("--topic", metavar="NAME", help="Skeleton topic to read; default all that can be. May be repeated."),
]
LimitSet = Annotated[
    str | None,
    typer.Option(
        "--limits",
        metavar="SET",
        help="Limit set of the prediction: paper, human, people, or a TOML file.",
        autocompletion=completion(("paper", "human", "people")),
    ),
]
CellFile = Annotated[
    Path | None,
    typer.Option("--cell", metavar="CELL.toml", help="Poses of cameras and robot, as written by calibrate."),
]
Out = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", help="Run folder to make; default reports/<log>/<UTC>-<command>."),
]
Start = Annotated[
    float | None,
    typer.Option("--start", metavar="S", help="First second of the log to use, in seconds from its start."),
]
End = Annotated[
    float | None, typer.Option("--end", metavar="S", help="Last second of the log to use, in seconds from its start.")
]
Smooth = Annotated[
    bool, typer.Option("--smooth", help="Also write smooth.parquet: Rauch-Tung-Striebel pass, for reference.")
]
Chunk = Annotated[
    int, typer.Option("--chunk-ticks", min=1, metavar="N", help="Number of ticks worked on at once; changes no result.")
]


def as_overrides(
    settings: list[str] | None, topics: list[str] | None = None, limits: str | None = None
) -> tuple[str, ...]:
    """Converts options that set a setting into settings."""
    short = [f"logs.topics={json.dumps(topics)}"] if topics else []
    short += [f"limits.prediction={json.dumps(limits)}"] if limits else []
    return (*(settings or ()), *short)


def span(start: float | None, end: float | None) -> dict[str, Any]:
    """Returns the part of the log to use, as arguments. Raises SettingsError if that part is empty."""
    for option, seconds in (("--start", start), ("--end", end)):
        if seconds is not None and not math.isfinite(seconds):
            raise SettingsError(f"{option} {seconds:g}: would be right: seconds from the log's start, e.g. {option} 10")
    if start is not None and end is not None and end <= start:
        raise SettingsError(f"--end {end:g}: not after --start {start:g}; give a later second")
    return {"start_s": start, "end_s": end}
