"""What a wrong focal length costs: ``python -m benchmarks.focal_error BUNDLES``.

Every pair is filtered with both focal lengths multiplied by a factor, and without intrinsics; the pose is judged
against the truth, F by the distance that it gives the true matches, in pixels.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mgca_filter.data.scene_bundle import ScenePair
from mgca_filter.evaluation.metrics import mean_average_precision, true_matches
from mgca_filter.evaluation.pairs import iterate_pairs
from mgca_filter.geometry.epipolar import sampson_distance
from mgca_filter.match_filter import MatchFilter
from mgca_filter.result import Status
from mgca_filter.tables import markdown_head, markdown_row

from .study import drawn_pairs, match_pair, result_error_deg, run_study, study_parser

FACTORS = (0.5, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 2.0)
# A true match this close to its epipolar line is placed by a fundamental matrix that can be relied upon.
CLOSE_PX = 2.0


@dataclass(frozen=True)
class FocalOutcome:
    """One pair under one assumption about the focal length.

    Attributes:
        error_deg: pose error, 180 where there is no pose. precision: of the mask. close: share of the true matches
            within two pixels of F's epipolar geometry, 0 without F. suspicious: the status says that the intrinsics
            contradict the matches.
    """

    error_deg: float
    precision: float
    close: float
    suspicious: bool


def run_pair(pair: ScenePair, factor: float | None, match_filter: MatchFilter) -> FocalOutcome:
    """Filter a pair with focal lengths off by ``factor``; None = without intrinsics."""
    K1, K2 = (None, None) if factor is None else (_with_focal(pair.K1, factor), _with_focal(pair.K2, factor))
    result = match_filter.filter_many([replace(match_pair(pair), K1=K1, K2=K2)])[0]
    true = true_matches(pair.correspondences, pair.E)
    close = 0.0
    if result.F is not None and true.any():
        pixels = np.hstack([pair.points1, pair.points2])[true]
        close = float(np.mean(sampson_distance(pixels, result.F) < CLOSE_PX))
    precision = float(true[result.mask].mean()) if result.mask.any() else 0.0
    suspicious = result.status is Status.SUSPICIOUS_INTRINSICS
    return FocalOutcome(result_error_deg(result, pair), precision, close, suspicious)


def _with_focal(K: NDArray[np.float64], factor: float) -> NDArray[np.float64]:
    scaled: NDArray[np.float64] = K * np.array([[factor, factor, 1.0], [1.0, factor, 1.0], [1.0, 1.0, 1.0]])
    return scaled


HEADER = ["focal length", "pairs", "mAP@5", "mAP@20", "precision", f"F within {CLOSE_PX:g} px", "suspicious"]


def cells(name: str, outcomes: Sequence[FocalOutcome]) -> list[str]:
    """A row: means over the pairs under one assumption, per cent."""
    errors = [outcome.error_deg for outcome in outcomes]
    figures = [mean_average_precision(errors, 5), mean_average_precision(errors, 20)]
    figures += [float(np.mean([getattr(row, f) for row in outcomes])) for f in ("precision", "close", "suspicious")]
    return [name, str(len(outcomes)), *(f"{100.0 * value:.1f}" for value in figures)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file or option that cannot be used."""
    parser = study_parser("focal_error", __doc__)
    parser.add_argument("bundles", metavar="BUNDLES", type=Path)
    return run_study(run, parser.parse_args(arguments))


def run(options: argparse.Namespace) -> int:
    """Print a row for each assumption as it is measured, all on the same pairs."""
    match_filter = MatchFilter(model=options.model)
    pairs = list(iterate_pairs(drawn_pairs(options)))
    print(markdown_head(HEADER))
    for factor in (*FACTORS, None):
        name = "not given" if factor is None else f"× {factor:g}"
        print(markdown_row(cells(name, [run_pair(pair, factor, match_filter) for pair in pairs])), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
