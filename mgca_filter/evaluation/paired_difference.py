"""One method against another on the same pairs: figures and the interval of their difference, ready for a table."""

from __future__ import annotations

from .metrics import FloatArray, Statistic, paired_bootstrap_interval


def paired_cells(errors: FloatArray, baseline: FloatArray, statistic: Statistic, replicates: int = 1000) -> str:
    """Cells ``first | second | difference [low, high]``: per cent, with a 95 % paired bootstrap interval.

    Args:
        errors, baseline: (S, P) pose errors of the two on the same P pairs, degrees; each averages over its S runs.
        statistic: one of :data:`metrics.POSE_STATISTICS`.
        replicates: of the bootstrap.
    """
    bounds = paired_bootstrap_interval({"all": errors}, {"all": baseline}, statistic, replicates=replicates)
    first, second, low, high = (100.0 * value for value in (statistic(errors), statistic(baseline), *bounds))
    return f"{first:.1f} | {second:.1f} | {first - second:+.1f} [{low:+.1f}, {high:+.1f}]"
