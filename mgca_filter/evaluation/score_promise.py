"""Do scores and ``keep_precision`` hold their promise? ``python -m mgca_filter.evaluation.score_promise BUNDLES``.

The network alone is asked (``method="none"``), on pairs that the calibration was not fitted on: how far the scores are
from the share of right matches, and which precision the matches kept by ``keep_precision`` have.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..data.scene_bundle import ScenePair
from ..errors import MgcaFilterError
from ..export.calibration_fit import expected_calibration_error
from ..geometry.epipolar import symmetric_epipolar_distance_squared
from ..inference.calibration import largest_set_of_precision
from .metrics import TRUE_INLIER_DISTANCE_SQUARED, precision_recall_f
from .pairs import iterate_pairs, select_pairs
from .product import filter_pair
from .selection import Selection

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
        distance = symmetric_epipolar_distance_squared(pair.correspondences[rows], pair.E)
        yield ScoredPair(result.scores, distance < TRUE_INLIER_DISTANCE_SQUARED)


def format_calibration(kind: str, pairs: Sequence[ScoredPair]) -> str:
    """A row: pairs, matches, expected calibration error of all of them and of those that are not clearly wrong."""
    scores = np.concatenate([pair.scores for pair in pairs]).astype(np.float64)
    truth = np.concatenate([pair.truth for pair in pairs])
    likely = scores > DOUBTFUL_SCORE
    gaps = [expected_calibration_error(scores[rows], truth[rows]) for rows in (slice(None), likely)]
    counts = [len(pairs), len(scores), int(likely.sum())]
    return f"| {kind} | {counts[0]} | {counts[1]} | {gaps[0]:.3f} | {counts[2]} | {gaps[1]:.3f} |"


def format_precision(kind: str, pairs: Sequence[ScoredPair], asked: float) -> str:
    """A row: precision asked for and reached, of all kept matches together and in the mean of the pairs, and recall."""
    kept = [largest_set_of_precision(pair.scores, asked) for pair in pairs]
    together = precision_recall_f(np.concatenate(kept), np.concatenate([pair.truth for pair in pairs]))
    some = [precision_recall_f(k, pair.truth)[0] for k, pair in zip(kept, pairs) if k.any()]
    figures = [asked, together[0], float(np.mean(some)) if some else 0.0, together[1], 1.0 - len(some) / len(pairs)]
    return f"| {kind} | " + " | ".join(f"{100.0 * figure:.1f}" for figure in figures) + " |"


CALIBRATION_HEADER = (
    f"| input | pairs | matches | calibration error | score above {DOUBTFUL_SCORE:g} | calibration error of these |\n"
    "|---|---:|---:|---:|---:|---:|"
)
PRECISION_HEADER = (
    "| input | `keep_precision`, % | precision of all kept | mean over pairs | recall | pairs with none kept |\n"
    "|---|---:|---:|---:|---:|---:|"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file or option that cannot be used."""
    parser = argparse.ArgumentParser(prog="python -m mgca_filter.evaluation.score_promise", description=__doc__)
    parser.add_argument("bundles", metavar="BUNDLES", type=Path, help="scenes that the calibration has not seen")
    parser.add_argument("--per-scene", type=int, metavar="N", help="at most N pairs of a scene")
    parser.add_argument("--model", metavar="FILE")
    parser.add_argument("--seed", type=int, default=0, help="of the draw (default 0)")
    options = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    try:
        selections = select_pairs(options.bundles, None, options.per_scene, options.seed)
        scored = {k.name: list(score_pairs(iterate_pairs(selections), k, options.model)) for k in KINDS}
    except (MgcaFilterError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print("\n".join([CALIBRATION_HEADER, *(format_calibration(name, pairs) for name, pairs in scored.items())]))
    rows = [format_precision(name, pairs, asked) for name, pairs in scored.items() for asked in ASKED]
    print("\n" + "\n".join([PRECISION_HEADER, *rows]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
