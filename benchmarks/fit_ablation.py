"""What each step of the robust fit is worth: ``python -m benchmarks.fit_ablation BUNDLES``.

The network scores every pair once; then the fit runs as users get it, and with one thing changed at a time. Each row
has its difference to the fit as it is, on the same pairs and the same draws of the bootstrap.

``compare_runs`` asks which run of the estimator wins, and what those after the first bring and cost.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from mgca_filter.data.scene_bundle import ScenePair
from mgca_filter.evaluation.metrics import (
    FAILURE_DEG,
    POSE_STATISTICS,
    FloatArray,
    mean_average_precision,
    mean_over_scenes,
    paired_bootstrap_interval,
)
from mgca_filter.evaluation.our_rows import filter_pair
from mgca_filter.evaluation.pairs import SceneSelection, iterate_pairs
from mgca_filter.fit.ranking import RankedMatches, match_order
from mgca_filter.fit.robust_fit import SINGLE_START, RobustFitOptions, Start, estimate_pose
from mgca_filter.geometry.cameras import mean_focal_length
from mgca_filter.geometry.epipolar import pose_error_deg
from mgca_filter.inputs.attributes import candidate_mask
from mgca_filter.match_filter import MatchFilter
from mgca_filter.result import FilterResult
from mgca_filter.tables import render_table

from .study import drawn_pairs, match_pair, result_error_deg, run_study, study_parser

STATISTICS = ("mAP@5", "mAP@20", "AUC@5")
AS_IT_IS = "the fit as it is"
NO_MODEL = "none"
# From logits (N,), ratios (N,) and whether those are known (N,) to the rows, most promising first.
Order = Callable[[FloatArray, FloatArray, NDArray[np.bool_]], NDArray[np.intp]]


def order_by_logit(logits: FloatArray, ratio: FloatArray, known: NDArray[np.bool_]) -> NDArray[np.intp]:
    """The network's order alone."""
    return np.argsort(-logits, kind="stable")


def order_by_ratio(logits: FloatArray, ratio: FloatArray, known: NDArray[np.bool_]) -> NDArray[np.intp]:
    """The order of users without a network, on the matches that the network accepts."""
    return np.argsort(np.where(known, ratio, 1.0), kind="stable")


@dataclass(frozen=True)
class Variant:
    """A fit with one thing changed: fields of :class:`RobustFitOptions`, the order, or what the network proposes."""

    changes: Mapping[str, Any]
    order: Order = match_order
    network_essential: bool = True


VARIANTS = {
    AS_IT_IS: Variant({}),
    "without network E": Variant({}, network_essential=False),
    "one run, logit > 0": Variant({"starts": SINGLE_START}),
    "one run, logit > −1": Variant({"starts": (Start(-1.0, 1.0),)}),
    "the first two runs": Variant({"starts": RobustFitOptions().runs[:2]}),
    "no refinement, no plane": Variant({"refine": False}),
    "estimator at 0.35 px": Variant({"threshold_px": 0.35}),
    "estimator at 0.75 px": Variant({"threshold_px": 0.75}),
    "refinement cut at 0.75 px": Variant({"refine_threshold_px": 0.75}),
    "refinement cut at 1.5 px": Variant({"refine_threshold_px": 1.5}),
    "20 000 iterations": Variant({"max_iterations": 20000, "confidence": 0.99999}),
    "order by logit": Variant({}, order_by_logit),
    "order by ratio": Variant({}, order_by_ratio),
    "MAGSAC": Variant({"method": "magsac"}),
    "RANSAC": Variant({"method": "ransac"}),
    "PoseLib": Variant({"method": "poselib"}),
}


@dataclass(frozen=True)
class ScoredPair:
    """A pair and what the network says: logits (M,), probabilities (M,), its E (3, 3); the rows (N,) to fit to."""

    pair: ScenePair
    logits: FloatArray
    scores: FloatArray
    essential: FloatArray | None
    rows: NDArray[np.intp]

    @classmethod
    def of(cls, pair: ScenePair, model: str | None) -> ScoredPair:
        """One pass of the network."""
        result = filter_pair(pair, np.arange(len(pair.points1)), model, {"method": "none"})
        rows = np.flatnonzero(candidate_mask(pair.attributes.encode(len(pair.points1))))
        logits, scores = result.info["logits"].astype(np.float64), result.scores.astype(np.float64)
        return cls(pair, logits, scores, result.info["network_essential"], rows)

    def error_deg(self, variant: Variant, options: RobustFitOptions) -> float:
        """Pose error of a fit, 180 without a pose."""
        attributes = self.pair.attributes.encode(len(self.logits))[self.rows]
        order = variant.order(self.logits[self.rows], attributes[:, 0].astype(np.float64), attributes[:, 5] > 0)
        ranked = RankedMatches.of(self.pair.correspondences, self.rows[order], self.scores, self.logits)
        focal_px = mean_focal_length(self.pair.K1, self.pair.K2)
        essential = self.essential if variant.network_essential else None
        pose = estimate_pose(ranked, focal_px, replace(options, **variant.changes), essential)
        return FAILURE_DEG if pose is None else pose_error_deg(*pose, self.pair.R, self.pair.t)


def study(
    selections: Sequence[SceneSelection], model: str | None, seeds: Sequence[int]
) -> tuple[dict[str, dict[str, FloatArray]], dict[str, float]]:
    """By variant: pose errors (S, P) of each scene, and the median processor time of a fit in milliseconds."""
    options = MatchFilter(model=model).fit_options
    errors: dict[str, dict[str, list[list[float]]]] = {name: {} for name in VARIANTS}
    times: dict[str, list[float]] = {name: [] for name in VARIANTS}
    total = sum(map(len, selections))
    for pair in tqdm(iterate_pairs(selections), total=total, unit="pair", disable=None):
        scored = ScoredPair.of(pair, model)
        for name, variant in VARIANTS.items():
            started = time.process_time()
            row = [scored.error_deg(variant, replace(options, seed=seed)) for seed in seeds]
            times[name].append(1e3 * (time.process_time() - started) / len(seeds))
            errors[name].setdefault(pair.scene, []).append(row)
    pose_errors = {name: {scene: np.array(rows).T for scene, rows in scenes.items()} for name, scenes in errors.items()}
    return pose_errors, {name: float(np.median(values)) for name, values in times.items()}


def format_study(errors: Mapping[str, Mapping[str, FloatArray]], times: Mapping[str, float]) -> str:
    """Markdown: a row for each variant, per cent, with 95 % paired bootstrap intervals of the differences."""
    body = []
    for name, scenes in errors.items():
        cells = [f"{100 * mean_over_scenes(POSE_STATISTICS[key], scenes):.1f}" for key in STATISTICS]
        for key in STATISTICS[1:]:
            statistic = POSE_STATISTICS[key]
            means = [100 * mean_over_scenes(statistic, one) for one in (scenes, errors[AS_IT_IS])]
            low, high = (100 * x for x in paired_bootstrap_interval(scenes, errors[AS_IT_IS], statistic))
            cells.append("" if name == AS_IT_IS else f"{means[0] - means[1]:+.1f} [{low:+.1f}, {high:+.1f}]")
        body.append([name, *cells, f"{times[name]:.1f}"])
    differences = [f"difference in {key}" for key in STATISTICS[1:]]
    return render_table(["", *STATISTICS, *differences, "ms of the fit"], body)


@dataclass(frozen=True)
class RunOutcome:
    """One pair with all runs of the estimator and with the first alone.

    Attributes:
        origin: the run that gave the answer, ``"plane"``, or ``"none"``.
        error_deg, first_error_deg: pose error with all runs and with the first alone, 180 without a pose.
        cpu_ms, first_cpu_ms: processor time of the whole filter, likewise.
    """

    origin: str
    error_deg: float
    first_error_deg: float
    cpu_ms: float
    first_cpu_ms: float


def compare_runs(pairs: Iterable[ScenePair], model: str | None) -> list[RunOutcome]:
    """Filter every pair twice: with all runs of the estimator, and with the first alone."""
    every, first = MatchFilter(model=model), MatchFilter(model=model)
    first.fit_options = replace(first.fit_options, starts=first.fit_options.runs[:1])
    outcomes = []
    for pair in pairs:
        (result, cpu_ms), (first_result, first_cpu_ms) = (_filter(one, pair) for one in (every, first))
        errors = (result_error_deg(result, pair), result_error_deg(first_result, pair))
        outcomes.append(RunOutcome(result.info["origin"] or NO_MODEL, *errors, cpu_ms, first_cpu_ms))
    return outcomes


def _filter(match_filter: MatchFilter, pair: ScenePair) -> tuple[FilterResult, float]:
    """The answer, and the processor time in milliseconds."""
    started = time.process_time()
    result = match_filter.filter_many([match_pair(pair)])[0]
    return result, 1e3 * (time.process_time() - started)


def run_table(groups: Mapping[str, Sequence[RunOutcome]]) -> str:
    """A row for each group: shares of the origins, mAP@5 of all runs and of the first, the others' share of time."""
    body = []
    for name, outcomes in groups.items():
        origins = Counter(outcome.origin for outcome in outcomes)
        shares = ", ".join(f"{origin} {100.0 * origins[origin] / len(outcomes):.0f} %" for origin in sorted(origins))
        accuracy = [
            f"{100.0 * mean_average_precision(errors, 5):.1f}"
            for errors in ([one.error_deg for one in outcomes], [one.first_error_deg for one in outcomes])
        ]
        share = 1.0 - sum(one.first_cpu_ms for one in outcomes) / sum(one.cpu_ms for one in outcomes)
        body.append([name, str(len(outcomes)), shares, *accuracy, f"{100.0 * share:.0f} %"])
    header = ["pairs", "number", "the answer came from", "mAP@5, all runs", "mAP@5, first alone", "time of the others"]
    return render_table(header, body, align="lrlr")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file or option that cannot be used."""
    parser = study_parser("fit_ablation", __doc__)
    parser.add_argument("bundles", metavar="BUNDLES", nargs="+", help="scene bundles, or folders of them")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="of the estimators (default 0)")
    return run_study(run, parser.parse_args(arguments))


def run(options: argparse.Namespace) -> int:
    """Run all variants and print the table."""
    selections = drawn_pairs(options)
    errors, times = study(selections, options.model, options.seeds)
    count = sum(map(len, selections))
    print(f"{count} pairs, {len(selections)} scenes, seeds {', '.join(map(str, options.seeds))}; means over scenes.\n")
    print(format_study(errors, times))
    return 0


if __name__ == "__main__":
    sys.exit(main())
