"""Everything that metrics.json holds, from a run's tables alone."""

from __future__ import annotations

from hrcreplay.report.limbs import add_limbs
from hrcreplay.report.metrics_fusion import add_fusion
from hrcreplay.report.metrics_plan import add_plan
from hrcreplay.report.metrics_quality import add_occupancy, add_quality
from hrcreplay.report.metrics_table import Metric, MetricTable
from hrcreplay.runs import Run


def compute(run: Run, *, near_m: float, stationary_m_per_s: float, gap_s: float = 0.2) -> dict[str, Metric]:
    """Metrics of a run: name -> value, unit, meaning; null with a reason where one does not apply, never 0.

    Args:
        run: The run's tables; those of stages that were not run are None.
        near_m: The stationary share counts ticks with a separation of at most this [m].
        stationary_m_per_s: A TCP slower than this stands [m/s].
        gap_s: A camera silent for longer has a gap [s].

    Returns:
        Sorted by name, plain Python values, finite numbers only.
    """
    plan = run.meta.get("settings", {}).get("plan", {})
    metrics = MetricTable()
    add_quality(metrics, run, gap_s)
    add_limbs(metrics, run)
    add_occupancy(metrics, run.occupancy)
    add_fusion(metrics, run, gap_s)
    add_plan(
        metrics,
        run.motion,
        run.baselines,
        method=str(plan.get("method", "qp")),
        near_m=near_m,
        stationary_m_per_s=stationary_m_per_s,
        leash_m=float(plan.get("leash_m", 0.25)),
    )
    return metrics.sorted()
