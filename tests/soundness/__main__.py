"""Samples motions in search of a point outside a predicted volume.

python -m tests.soundness --samples 1000000 --method sound --limits paper --seed 1 --processes 2
"""

from __future__ import annotations

import argparse
import os
import sys
import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from hrcreplay.errors import HrcReplayError
from hrcreplay.human.reach import METHODS
from tests.soundness.run import Plan, Result, escaped, run


def main(arguments: list[str] | None = None) -> int:
    """Runs and prints; 1 where a motion escaped, 2 for a wrong argument."""
    options = _parser().parse_args(arguments)
    plan = Plan(
        method=options.method,
        limits=options.limits,
        seed=options.seed,
        horizon_s=options.horizon,
        latency_s=options.latency,
        sigmas=options.sigmas,
        hand_m=options.hand,
        unseen_s=options.unseen,
        beyond=options.beyond,
    )
    console = Console(stderr=True)
    columns = (TextColumn("motions"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    start = time.perf_counter()
    try:
        with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
            task = progress.add_task("motions", total=options.samples)
            result = run(plan, options.samples, options.processes, lambda n: progress.advance(task, n))
    except HrcReplayError as error:
        console.print(str(error), highlight=False)
        return 2
    rate = result.motions / (time.perf_counter() - start)
    console.print(f"{rate:,.0f} motions/s with {options.processes} processes", highlight=False)
    _tell(Console(), plan, result)
    return int(escaped(result))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.soundness", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--samples", type=_positive, default=1_000_000, help="motions to follow")
    parser.add_argument("--method", choices=METHODS, default="sound")
    parser.add_argument("--limits", default="paper", help="paper, human or a TOML file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=_positive, default=os.cpu_count() or 1, help="the result is the same")
    parser.add_argument("--horizon", type=float, default=0.377, help="T_s [s]")
    parser.add_argument("--latency", type=float, default=0.0, help="added to the horizon [s]")
    parser.add_argument("--sigmas", type=float, default=0.0, help="draw the truth within so many sigma of the estimate")
    parser.add_argument("--hand", type=float, default=0.0, help="length of the hand beyond the wrist [m]")
    parser.add_argument("--unseen", type=float, default=0.0, help="for how long nobody has seen the person [s]")
    beyond = "also velocities above their bounds that come back, and limits that bring joints to rest at once"
    parser.add_argument("--beyond", action="store_true", help=beyond)
    return parser


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"found {text}; take 1 or more")
    return value


def _tell(console: Console, plan: Plan, result: Result) -> None:
    table = Table("limb", "worst margin [mm]", "escapes [%]", "states with an escape [%]", "worst in state")
    for k, limb in enumerate((*result.limbs, "any")):
        worst = k if k < len(result.limbs) else int(result.margin_m.argmax())
        table.add_row(
            limb,
            f"{result.margin_m[worst] * 1e3:.6f}",
            f"{result.escapes[k] / result.motions:.4%}"[:-1],
            f"{result.states_with_escapes[k] / result.states:.2%}"[:-1],
            str(result.state[worst]),
        )
    console.print(
        f"method {plan.method}, limits {plan.limits}, seed {plan.seed}: {result.motions:,} motions from "
        f"{result.states:,} states",
        highlight=False,
    )
    console.print(table)
    count = int(result.escapes[-1])
    verdict = f"{count:,} motions escaped" if escaped(result) else "no motion escaped"
    side = "outside" if result.margin_m.max() > 0.0 else "inside by"
    console.print(f"{verdict}; worst margin {side} {abs(result.margin_m.max()) * 1e3:.6f} mm", highlight=False)


if __name__ == "__main__":
    sys.exit(main())
