"""Do scores and ``keep_precision`` hold what they say? ``python -m benchmarks.score_calibration BUNDLES``.

The network alone is asked (``method="none"``), on pairs that the calibration was not fitted on: how far the scores are
from the share of right matches, and which precision the matches kept by ``keep_precision`` have.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mgca_filter.data.scene_bundle import ScenePair
from mgca_filter.evaluation.metrics import precision_recall_f, true_matches
from mgca_filter.evaluation.our_rows import filter_pair
from mgca_filter.evaluation.pairs import iterate_pairs
from mgca_filter.evaluation.selection import Selection
from mgca_filter.export.calibration_fit import expected_calibration_error
from mgca_filter.inference.calibration import largest_set_of_precision
from mgca_filter.tables import render_table

from .study import drawn_pairs, run_study, study_parser

ASKED = (0.8, 0.9, 0.95, 0.99)
# Most raw matches are wrong, and known to be: without them the mean gap speaks of those in doubt.
DOUBTFUL_SCORE = 0.2


@dataclass(frozen=True)
class InputKind:
    """Matches as a caller may hold them: those that pass ``selection``, with or without attributes."""

    name: str
    selection: Selection = Selection()
    bare: bool = False


KINDS = (
    InputKind("raw"),
    InputKind("mutual + ratio 0.8", Selection(mutual=True, max_ratio=0.8)),
    InputKind("raw, points only", bare=True),
)


@dataclass(frozen=True)
class ScoredPair:
    """Scores (N,) of a pair's matches and which of them are right (N,)."""

    scores: NDArray[np.float32]
    truth: NDArray[np.bool_]


def score_pairs(pairs: Iterable[ScenePair], kind: InputKind, model: str | None) -> Iterator[ScoredPair]:
    """The filter's scores on every pair."""
    for pair in pairs:
        rows = np.flatnonzero(kind.selection.apply(pair))
        result = filter_pair(pair, rows, model, {"method": "none"}, bare=kind.bare)
        yield ScoredPair(result.scores, true_matches(pair.correspondences[rows], pair.E))


def calibration_cells(kind: str, pairs: Sequence[ScoredPair]) -> list[str]:
    """A row: pairs, matches, expected calibration error of all of them and of those that are not clearly wrong."""
    scores = np.concatenate([pair.scores for pair in pairs]).astype(np.float64)
    truth = np.concatenate([pair.truth for pair in pairs])
    likely = scores > DOUBTFUL_SCORE
    gaps = [expected_calibration_error(scores[rows], truth[rows]) for rows in (slice(None), likely)]
    counts = [str(len(pairs)), str(len(scores)), str(int(likely.sum()))]
    return [kind, *counts[:2], f"{gaps[0]:.3f}", counts[2], f"{gaps[1]:.3f}"]


def precision_cells(kind: str, pairs: Sequence[ScoredPair], asked: float) -> list[str]:
    """A row: precision asked for and reached, of all kept matches together and in the mean of the pairs, and recall."""
    kept = [largest_set_of_precision(pair.scores, asked) for pair in pairs]
    together = precision_recall_f(np.concatenate(kept), np.concatenate([pair.truth for pair in pairs]))
    some = [precision_recall_f(k, pair.truth)[0] for k, pair in zip(kept, pairs) if k.any()]
    figures = [asked, together[0], float(np.mean(some)) if some else 0.0, together[1], 1.0 - len(some) / len(pairs)]
    return [kind, *(f"{100.0 * figure:.1f}" for figure in figures)]


CALIBRATION_HEADER = ["input", "pairs", "matches", "calibration error"] + [
    f"score above {DOUBTFUL_SCORE:g}",
    "calibration error of these",
]
PRECISION_HEADER = ["input", "`keep_precision`, %", "precision of all kept", "mean over pairs", "recall"] + [
    "pairs with none kept"
]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file or option that cannot be used."""
    parser = study_parser("score_calibration", __doc__)
    parser.add_argument("bundles", metavar="BUNDLES", type=Path, help="scenes that the calibration has not seen")
    return run_study(run, parser.parse_args(arguments))


def run(options: argparse.Namespace) -> int:
    """Score the pairs and print both tables."""
    selections = drawn_pairs(options)
    scored = {k.name: list(score_pairs(iterate_pairs(selections), k, options.model)) for k in KINDS}
    print(render_table(CALIBRATION_HEADER, [calibration_cells(name, pairs) for name, pairs in scored.items()]))
    rows = [precision_cells(name, pairs, asked) for name, pairs in scored.items() for asked in ASKED]
    print("\n" + render_table(PRECISION_HEADER, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
