"""How often volumes until T_s held the recorded person, by report, compare and audit: one figure, to the last digit."""

from __future__ import annotations

import json
from pathlib import Path

from hrcreplay.commands import audit, compare

VARIANT = "qp:sound:adaptive"


def assert_one_coverage(run: Path, scratch: Path) -> int:
    """Compares and audits what a report ran on, and asks whether all three say the same; the ticks that were checked.

    Args:
        run: Run folder of ``report``, on one log, with volumes by ``sound``.
        scratch: Folder for the other two runs.
    """
    metrics = json.loads((run / "metrics.json").read_text())
    said = [metrics[f"volumes_full_{name}"]["value"] for name in ("checked_ticks", "held_share", "left_max_m")]
    folder = compare.run([run], methods=f"{VARIANT},none", out=scratch / "compare", processes=1)
    compared = json.loads((folder / "compare.json").read_text())["logs"][0]["methods"][VARIANT]
    audited = json.loads((audit.run([run], out=scratch / "audit") / "audit.json").read_text())
    found = audited["logs"][0]["methods"]["sound"]["all"]
    assert said == [found["covered_share"]["samples"], found["covered_share"]["value"], found["escape_max_m"]]
    assert said[:2] == [compared["full_checked_ticks"], compared["full_coverage"]]
    return int(said[0] or 0)
