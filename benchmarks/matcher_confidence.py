"""What would a matcher's own confidence add? ``python -m benchmarks.matcher_confidence BUNDLES [BUNDLES ...]``.

A learned matcher scores its matches (bundles ``scene.*lightglue.npz``), and the networks take no such input. A logistic
regression on both is the least that one which did would make of it, cross-validated over scenes: how well it tells
right matches from wrong, and the poses that the filter finds on its answers.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mgca_filter.data.scene_bundle import ScenePair
from mgca_filter.evaluation.metrics import POSE_STATISTICS, true_matches
from mgca_filter.export.calibration_fit import expected_calibration_error
from mgca_filter.export.choice_fit import cross_validated
from mgca_filter.inference import Backend, ModelMetadata, shared_backend
from mgca_filter.inference.calibration import Calibration, sigmoid
from mgca_filter.match_filter import MatchFilter, find_models
from mgca_filter.tables import render_table

from .match_lists import KINDS, open_detector_scenes
from .study import match_pair, paired_cells, result_error_deg, run_study, study_parser

Array = NDArray[np.float64]

MIN_MATCHES = 8
_SURE = 1e-4  # log odds are those of probabilities between this and one less
NETWORK, CONFIDENCE = "network", "matcher's confidence"
INFORMED = {"the network": (NETWORK,), "the confidence": (CONFIDENCE,), "both": (NETWORK, CONFIDENCE)}
"""What a regression is told, by the words of the tables."""


@dataclass(frozen=True)
class ListedPair:
    """A learned matcher's list: N matches, the log odds of each by name of who says so, and which are right (N,)."""

    scene: str
    pair: ScenePair
    log_odds: Mapping[str, Array]
    truth: NDArray[np.bool_]

    def features(self, told: Sequence[str]) -> Array:
        """(N, D) of those who are asked."""
        return np.column_stack([self.log_odds[name] for name in told])


class Replaced:
    """A backend whose logits are those of ``probabilities`` (N,), which are set for the pair that comes next."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend
        self.probabilities: Array | None = None

    @property
    def name(self) -> str:
        return self._backend.name

    @property
    def metadata(self) -> ModelMetadata:
        return self._backend.metadata

    def infer(
        self, correspondences: NDArray[np.float32], attributes: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        logits, essential = self._backend.infer(correspondences, attributes)
        if self.probabilities is None:
            return logits, essential
        return self.metadata.calibration.logits(self.probabilities)[None], essential


def log_odds(probabilities: Array) -> Array:
    """Logarithms of the odds, of neither certainty."""
    return Calibration().logits(np.clip(probabilities, _SURE, 1.0 - _SURE)).astype(np.float64)


def read_pairs(options: argparse.Namespace) -> list[ListedPair]:
    """The learned matchers' lists, with what the network alone says of them."""
    ask = MatchFilter(model=options.model or "fast", method="none")
    pairs = []
    for scene in open_detector_scenes(options.bundles, per_scene=options.per_scene, seed=options.seed):
        lists = scene.lists(KINDS["learned"])
        if lists is None:
            continue
        for index in lists.indices:
            pair = lists.source[index]
            if len(pair.points1) < MIN_MATCHES:
                continue
            scores = ask.filter_many([match_pair(pair)])[0].scores.astype(np.float64)
            told = {NETWORK: log_odds(scores), CONFIDENCE: log_odds(np.asarray(pair.match_scores, dtype=np.float64))}
            pairs.append(ListedPair(scene.scene, pair, told, true_matches(pair.correspondences, pair.E)))
    if len({one.scene for one in pairs}) < 2:
        raise ValueError("BUNDLES: expected learned matchers' lists of two scenes or more")
    return pairs


def cross_fitted(pairs: Sequence[ListedPair], told: Sequence[str]) -> list[Array]:
    """Probabilities of each pair's matches by a regression that saw no pair of its scene; each list weighs the same."""
    counts = [len(one.truth) for one in pairs]
    features = np.concatenate([one.features(told) for one in pairs])
    truth = np.concatenate([one.truth for one in pairs])
    weight = np.repeat(np.mean(counts) / np.array(counts), counts)
    p = cross_validated(features, truth, weight, [one.scene for one in pairs for _ in one.truth])
    return np.split(p, np.cumsum(counts)[:-1])


def score_cells(name: str, pairs: Sequence[ListedPair], probabilities: Sequence[Array]) -> list[str]:
    """A row: log loss, mean over lists; average precision, mean over lists that hold both kinds; calibration error."""
    loss = [-np.mean(np.where(one.truth, np.log(p), np.log1p(-p))) for one, p in zip(pairs, probabilities)]
    mixed = [(one, p) for one, p in zip(pairs, probabilities) if one.truth.any() and not one.truth.all()]
    precision = [average_precision(p, one.truth) for one, p in mixed]
    error = expected_calibration_error(np.concatenate(probabilities), np.concatenate([one.truth for one in pairs]))
    return [name, f"{np.mean(loss):.3f}", f"{100.0 * np.mean(precision):.1f}", f"{error:.3f}"]


def average_precision(scores: Array, truth: NDArray[np.bool_]) -> float:
    """Mean precision at the ranks of the right matches, best score first."""
    ranked = truth[np.argsort(-scores, kind="stable")]
    return float(np.mean((np.cumsum(ranked) / np.arange(1, len(ranked) + 1))[ranked]))


def pose_errors(pairs: Sequence[ListedPair], probabilities: Sequence[Array | None], model: str | None) -> Array:
    """Errors (1, P) of the filter on those scores, degrees; None = the network's own."""
    backend = Replaced(shared_backend(find_models(model or "fast")[0], "auto", None))
    pose_filter, errors = MatchFilter.over(backend), []
    for one, p in zip(pairs, probabilities):
        backend.probabilities = p
        errors.append(result_error_deg(pose_filter.filter_many([match_pair(one.pair)])[0], one.pair))
    return np.array([errors])


SCORE_HEADER = ["scores by", "log loss", "average precision, %", "calibration error"]
POSE_HEADER = ["scores by", "statistic", "of these", "of the network as it is", "difference"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file or option that cannot be used."""
    parser = study_parser("matcher_confidence", __doc__)
    parser.add_argument("bundles", metavar="BUNDLES", type=Path, nargs="+", help="folders or files of bundles")
    return run_study(run, parser.parse_args(arguments))


def run(options: argparse.Namespace) -> int:
    """Fit, and print both tables."""
    pairs = read_pairs(options)
    fitted = {name: cross_fitted(pairs, told) for name, told in INFORMED.items()}
    rows = [score_cells("the network as it is", pairs, [sigmoid(one.log_odds[NETWORK]) for one in pairs])]
    rows += [score_cells(f"regression on {name}", pairs, probabilities) for name, probabilities in fitted.items()]
    right = 100.0 * float(np.mean([one.truth.mean() for one in pairs]))
    print(f"{len(pairs)} lists of {len({one.scene for one in pairs})} scenes, {right:.0f} % right in the mean.\n")
    print(render_table(SCORE_HEADER, rows))
    own = pose_errors(pairs, [None] * len(pairs), options.model)
    rows = []
    for name, probabilities in fitted.items():
        errors = pose_errors(pairs, probabilities, options.model)
        for statistic in ("mAP@5", "mAP@20", "AUC@5"):
            rows.append([f"regression on {name}", statistic, *paired_cells(errors, own, POSE_STATISTICS[statistic])])
    print("\n" + render_table(POSE_HEADER, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
