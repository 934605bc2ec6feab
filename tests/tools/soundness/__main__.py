"""Samples motions in search of a point outside a predicted volume.

python -m tests.tools.soundness --samples 1000000 --method sound --limits people --seed 1 --processes 2
python -m tests.tools.soundness --samples 200000 --method positions --limits paper --json

Limits, horizon and margins are the defaults of ``predict``. The printed methods know no margins, so their people are
where they are estimated to be, and their lower arms end at the wrist.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from hrcreplay.errors import HrcReplayError
from hrcreplay.human.prediction.swept_volumes import METHODS, PRINTED
from hrcreplay.settings.load import Settings
from tests.tools.soundness.run import Plan, Result, escaped, run

#: What ``predict`` does unless it is told otherwise.
_DEFAULTS = Settings()


def main(arguments: list[str] | None = None) -> int:
    """Runs and prints; 1 where a motion escaped from a volume that it should not leave, 2 for a wrong argument."""
    options = _parser().parse_args(arguments)
    plan = _plan(options)
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
    if options.json:
        sys.stdout.write(json.dumps(figures(plan, result)) + "\n")
    else:
        _tell(Console(), plan, result)
    return int(escaped(result) and plan.method not in PRINTED)


def figures(plan: Plan, result: Result) -> dict[str, Any]:
    """What the sampling found, for machines: ``worst_mm`` is how far outside the worst point was, negative inside."""
    return {
        "method": plan.method,
        "limits": plan.limits,
        "samples": result.motions,
        "states": result.states,
        "states_let_out": int(result.states_with_escapes[-1]),
        "share": int(result.states_with_escapes[-1]) / result.states,
        "worst_mm": float(result.margin_m.max()) * 1e3,
        "worst_mm_by_limb": dict(zip(result.limbs, (result.margin_m * 1e3).tolist(), strict=True)),
        "motions_a_state": plan.motions_a_state,
        "horizon_s": plan.horizon_s,
        "latency_s": plan.latency_s,
        "sigmas": plan.sigmas,
        "hand_m": plan.hand_m,
        "unseen_s": plan.unseen_s,
        "beyond": plan.beyond,
        "seed": plan.seed,
    }


def _plan(options: argparse.Namespace) -> Plan:
    """What the arguments ask for; margins that are not given are the method's own."""
    prediction, bare = _DEFAULTS.prediction, options.method in PRINTED
    sigmas = 0.0 if bare else prediction.sigmas
    hand_m = 0.0 if bare else prediction.hand_m
    latency_s = 0.0 if bare else prediction.latency_s
    return Plan(
        method=options.method,
        limits=options.limits,
        seed=options.seed,
        horizon_s=options.horizon,
        latency_s=latency_s if options.latency is None else options.latency,
        sigmas=sigmas if options.sigmas is None else options.sigmas,
        hand_m=hand_m if options.hand is None else options.hand,
        unseen_s=options.unseen,
        beyond=options.beyond,
    )


def _parser() -> argparse.ArgumentParser:
    own = _DEFAULTS.prediction
    parser = argparse.ArgumentParser(
        prog="python -m tests.tools.soundness", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--samples", type=_positive, default=1_000_000, help="motions to follow")
    parser.add_argument("--method", choices=METHODS, default=own.method)
    parser.add_argument("--limits", default=_DEFAULTS.limits.prediction, help="paper, human, people or a TOML file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=_positive, default=os.cpu_count() or 1, help="the result is the same")
    parser.add_argument("--horizon", type=float, default=own.stop_s, help="T_s [s]")
    parser.add_argument("--latency", type=float, help="added to the horizon [s]")
    parser.add_argument("--sigmas", type=float, help="draw the truth within so many sigma of the estimate")
    parser.add_argument("--hand", type=float, help="length of the hand beyond the wrist [m]")
    parser.add_argument("--unseen", type=float, default=0.0, help="for how long nobody has seen the person [s]")
    beyond = "also velocities above their bounds that come back, and limits that bring joints to rest at once"
    parser.add_argument("--beyond", action="store_true", help=beyond)
    parser.add_argument("--json", action="store_true", help="print the figures as one line of JSON")
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
        f"method {plan.method}, limits {plan.limits}, within {plan.sigmas:g} sigma, hand of {plan.hand_m:g} m, seed "
        f"{plan.seed}: {result.motions:,} motions from {result.states:,} states",
        highlight=False,
    )
    console.print(table)
    count = int(result.escapes[-1])
    verdict = f"{count:,} motions escaped" if escaped(result) else "no motion escaped"
    side = "outside" if result.margin_m.max() > 0.0 else "inside by"
    console.print(f"{verdict}; worst margin {side} {abs(result.margin_m.max()) * 1e3:.6f} mm", highlight=False)


if __name__ == "__main__":
    sys.exit(main())
