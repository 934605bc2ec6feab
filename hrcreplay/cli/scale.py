"""The commands of speed and of many logs: warmup, bench and sweep.

Slow imports are inside the functions, so that ``--help`` answers at once.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from hrcreplay.cli import CellFile, Chunk, Config, End, LimitSet, Set, Start, Topic, as_overrides, span
from hrcreplay.cli.commands import give_back_memory
from hrcreplay.errors import RunsFailed


def register(app: typer.Typer) -> None:
    """Adds the commands to the command line."""
    app.command()(warmup)
    app.command()(bench)
    app.command()(sweep)


def warmup() -> None:
    """Compile the kernels of all commands now, in two processes, as the first run of another command would."""
    from hrcreplay.pipeline.kernel_build import ensure_compiled

    if not ensure_compiled():
        raise typer.Exit(1)


def bench(
    log: Annotated[
        Path | None, typer.Argument(metavar="[LOG]", help="A log or run folder; default: the log of the demo.")
    ] = None,
    config: Config = None,
    settings: Set = None,
    topic: Topic = None,
    limits: LimitSet = None,
    cell: CellFile = None,
    start: Start = None,
    seconds: Annotated[
        float, typer.Option("--seconds", metavar="S", help="Length of the stretch of the log that is timed.")
    ] = 20.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the times as JSON.")] = False,
) -> None:
    """Time every stage on a log, beside well-known programs for the same tasks in the same run."""
    from rich.console import Console

    from hrcreplay.commands import bench as benching
    from hrcreplay.commands import replay
    from hrcreplay.pipeline.progress import ProgressBar

    if log is None:
        log, cell = replay.demo_log(), cell or replay.demo_cell()
    with ProgressBar("reading the log") as bar:
        found = benching.run(
            log,
            seconds=seconds,
            progress=bar,
            config=config,
            overrides=as_overrides(settings, topic, limits),
            cell_file=cell,
            start_s=span(start, None)["start_s"],
        )
    if as_json:
        sys.stdout.write(json.dumps(found.to_dict(), indent=2) + "\n")
    else:
        benching.print_table(found, Console())


def sweep(
    logs: Annotated[list[str], typer.Argument(metavar="LOG...", help="Logs, by path or URL such as s3://bucket/log.")],
    grid: Annotated[
        list[str] | None,
        typer.Option("--grid", metavar="SECTION.KEY=A,B,C", help="Values of one setting. May be repeated."),
    ] = None,
    base: Annotated[
        list[str] | None,
        typer.Option("--base", metavar="X,Y,Z,YAW", help="A pose of the robot base, in m and deg. May be repeated."),
    ] = None,
    command: Annotated[
        str, typer.Option("--command", metavar="NAME", help="Command of each run: report, or plan, which is faster.")
    ] = "report",
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="A Dask scheduler; default: workers on this computer."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, metavar="N", help="Number of workers on this computer.")
    ] = None,
    out: Annotated[
        str | None,
        typer.Option("--out", metavar="DIR", help="Folder or URL of the results; default reports/sweep-<digest>."),
    ] = None,
    config: Config = None,
    settings: Set = None,
    topic: Topic = None,
    limits: LimitSet = None,
    cell: CellFile = None,
    start: Start = None,
    end: End = None,
    chunk_ticks: Chunk = 250,
) -> None:
    """Run every log with every setting of a grid on a Dask cluster; the same command again runs what is missing."""
    give_back_memory()
    from hrcreplay.commands import sweep as sweeping

    found = sweeping.run(
        logs,
        grid=grid or (),
        bases=base or (),
        command=command,
        out=out,
        scheduler=scheduler,
        workers=workers,
        chunk_ticks=chunk_ticks,
        config=config,
        overrides=as_overrides(settings, topic, limits),
        cell_file=cell,
        **span(start, end),
    )
    sys.stdout.write(f"{found.where}/sweep.html\n")
    if found.failed:
        raise RunsFailed(f"{len(found.failed)} runs failed; their errors are in {found.where}/failed")
