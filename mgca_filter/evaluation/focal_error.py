"""What a wrong focal length costs: ``python -m mgca_filter.evaluation.focal_error BUNDLES``.

Every pair is filtered with both focal lengths multiplied by a factor, and without intrinsics; the pose is judged
against the truth, F by the distance that it gives the true matches, in pixels.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..data.scene_bundle import SceneBundle, ScenePair, load_scene_bundles
from ..errors import MgcaFilterError
from ..geometry.epipolar import pose_error_deg, sampson_distance, symmetric_epipolar_distance_squared
from ..inputs.pair import MatchPair
from ..match_filter import MatchFilter, model_path
from ..result import Status
from .metrics import FAILURE_DEG, TRUE_INLIER_DISTANCE_SQUARED, mean_average_precision
from .pairs import draw_indices

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
    cameras = (K1, K2, None, None, pair.image_size1, pair.image_size2)
    result = match_filter.filter_many([MatchPair(pair.points1, pair.points2, None, *cameras, pair.attributes)])[0]
    error = FAILURE_DEG
    if result.R is not None and result.t is not None:
        error = pose_error_deg(result.R, result.t, pair.R, pair.t)
    true = symmetric_epipolar_distance_squared(pair.correspondences, pair.E) < TRUE_INLIER_DISTANCE_SQUARED
    close = 0.0
    if result.F is not None and true.any():
        pixels = np.hstack([pair.points1, pair.points2])[true]
        close = float(np.mean(sampson_distance(pixels, result.F) < CLOSE_PX))
    precision = float(true[result.mask].mean()) if result.mask.any() else 0.0
    return FocalOutcome(error, precision, close, result.status is Status.SUSPICIOUS_INTRINSICS)


def _with_focal(K: NDArray[np.float64], factor: float) -> NDArray[np.float64]:
    scaled: NDArray[np.float64] = K * np.array([[factor, factor, 1.0], [1.0, factor, 1.0], [1.0, 1.0, 1.0]])
    return scaled


HEADER = "| focal length | pairs | mAP@5 | mAP@20 | precision | F within 2 px | suspicious |\n|---|" + "---:|" * 6


def format_row(name: str, outcomes: Sequence[FocalOutcome]) -> str:
    """Means over the pairs under one assumption, per cent."""
    errors = [outcome.error_deg for outcome in outcomes]
    figures = [mean_average_precision(errors, 5), mean_average_precision(errors, 20)]
    figures += [float(np.mean([getattr(row, f) for row in outcomes])) for f in ("precision", "close", "suspicious")]
    return f"| {name} | {len(outcomes)} | " + " | ".join(f"{100.0 * value:.1f}" for value in figures) + " |"


def run(
    bundles: Sequence[SceneBundle], per_scene: int | None, seed: int, model: Path
) -> Iterator[tuple[str, list[FocalOutcome]]]:
    """Assumption by assumption, the outcomes over the same pairs of all bundles."""
    cv2.setNumThreads(1)
    match_filter = MatchFilter(model=model)
    pairs = [b[i] for b in bundles for i in draw_indices(len(b), b.scene, per_scene, seed)]
    for factor in (*FACTORS, None):
        name = "not given" if factor is None else f"× {factor:g}"
        yield name, [run_pair(pair, factor, match_filter) for pair in pairs]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file or option that cannot be used."""
    parser = argparse.ArgumentParser(prog="python -m mgca_filter.evaluation.focal_error", description=__doc__)
    parser.add_argument("bundles", metavar="BUNDLES", type=Path)
    parser.add_argument("--per-scene", type=int, metavar="N", help="at most N pairs of a scene")
    parser.add_argument("--model", type=Path, default=model_path(), metavar="FILE")
    parser.add_argument("--seed", type=int, default=0, help="of the draw (default 0)")
    options = parser.parse_args(arguments)
    try:
        bundles = load_scene_bundles(options.bundles)
        print(HEADER)
        for name, outcomes in run(bundles, options.per_scene, options.seed, options.model):
            print(format_row(name, outcomes), flush=True)
    except MgcaFilterError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
