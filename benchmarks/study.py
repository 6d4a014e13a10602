"""What the commands of this folder share: arguments, errors in one line, pairs to run on, two methods side by side."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

from mgca_filter.data.scene_bundle import ScenePair
from mgca_filter.errors import MgcaFilterError
from mgca_filter.evaluation.environment import one_thread
from mgca_filter.evaluation.metrics import FAILURE_DEG, FloatArray, Statistic, paired_bootstrap_interval
from mgca_filter.evaluation.our_rows import scored_matches
from mgca_filter.evaluation.pairs import SceneSelection, select_pairs
from mgca_filter.geometry.epipolar import pose_error_deg
from mgca_filter.inputs.pair import MatchPair
from mgca_filter.result import FilterResult

CONFIDENCE_LIMITS = (0.5, 0.8, 0.9, 0.95, 0.98, 0.99)
"""Where a caller might draw the line; two studies tell what each of these costs and what it keeps out."""


def study_parser(name: str, description: str | None, *, per_scene: bool = True) -> argparse.ArgumentParser:
    """Parser of ``python -m benchmarks.NAME`` with ``--seed``, ``--model`` and, where it is wanted, ``--per-scene``."""
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.{name}", description=description)
    if per_scene:
        parser.add_argument("--per-scene", type=int, metavar="N", help="at most N pairs of a scene")
    parser.add_argument("--seed", type=int, default=0, help="of what is drawn: pairs, rendered worlds (default 0)")
    parser.add_argument("--model", metavar="FILE", help="of the filter (default: the one in the package)")
    return parser


def run_study(run: Callable[[argparse.Namespace], int], options: argparse.Namespace) -> int:
    """Exit status of a study, run on one thread; 2 = a file, package or option that cannot be used, in one line."""
    try:
        with one_thread():
            return run(options)
    except (MgcaFilterError, ValueError, OSError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def drawn_pairs(options: argparse.Namespace) -> list[SceneSelection]:
    """Pairs of the scene bundles ``options.bundles``, as ``--per-scene`` and ``--seed`` say.

    Raises:
        DatasetError, ValueError: as :func:`mgca_filter.evaluation.pairs.select_pairs`.
    """
    return select_pairs(options.bundles, None, options.per_scene, options.seed)


def match_pair(pair: ScenePair) -> MatchPair:
    """The matches of a pair as the filter takes them, with intrinsics, image sizes, attributes and scores if any."""
    cameras = (pair.K1, pair.K2, None, None, pair.image_size1, pair.image_size2)
    matches = None if pair.match_scores is None else scored_matches(pair.match_scores)
    return MatchPair(pair.points1, pair.points2, matches, *cameras, pair.attributes)


def result_error_deg(result: FilterResult, pair: ScenePair) -> float:
    """Pose error of an answer, degrees; 180 without a pose."""
    if result.R is None or result.t is None:
        return FAILURE_DEG
    return pose_error_deg(result.R, result.t, pair.R, pair.t)


def paired_cells(errors: FloatArray, baseline: FloatArray, statistic: Statistic, replicates: int = 1000) -> list[str]:
    """Cells first, second, difference [low, high]: per cent, with a 95 % paired bootstrap interval.

    Args:
        errors, baseline: (S, P) pose errors of the two on the same P pairs, degrees; each averages over its S runs.
        statistic: one of :data:`mgca_filter.evaluation.metrics.POSE_STATISTICS`.
        replicates: of the bootstrap.
    """
    bounds = paired_bootstrap_interval({"all": errors}, {"all": baseline}, statistic, replicates=replicates)
    first, second, low, high = (100.0 * value for value in (statistic(errors), statistic(baseline), *bounds))
    return [f"{first:.1f}", f"{second:.1f}", f"{first - second:+.1f} [{low:+.1f}, {high:+.1f}]"]
