"""Other detectors than SIFT: ``python -m mgca_filter.evaluation.detectors IMAGES BUNDLE``.

Photographs of a folder are detected and matched anew; poses and intrinsics come from the bundle of the same scene.
The filter on all matches stands beside RANSAC and MAGSAC on those that pass the ratio test.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..comparison import fit_baselines
from ..epipolar import pose_error_deg
from ..errors import MgcaFilterError
from ..keypoints import create_detector, detect_keypoints
from ..match_filter import MatchFilter, model_path
from ..matching import match_descriptors, read_matches
from ..scene_bundle import SceneBundle, ScenePair
from .metrics import FAILURE_DEG, mean_average_precision
from .pairs import draw_indices

DETECTORS = ("sift", "orb", "akaze", "brisk")
RATIO = 0.8
THRESHOLD_PX = 0.75


@dataclass(frozen=True)
class Features:
    """Keypoints and descriptors of one photograph, and its (width, height)."""

    keypoints: list[cv2.KeyPoint]
    descriptors: NDArray[Any]
    size: tuple[int, int]


def make_detector(name: str) -> cv2.Feature2D:
    """SIFT, ORB or AKAZE as the package makes them, or BRISK with OpenCV's defaults."""
    if name != "brisk":
        return create_detector(name)
    # OpenCV 5 moved BRISK to the contrib module.
    brisk: Any = getattr(cv2, "BRISK", None) or cv2.xfeatures2d.BRISK
    detector: cv2.Feature2D = brisk.create()
    return detector


def read_features(path: Path, detector: cv2.Feature2D) -> Features:
    """Detect on a photograph.

    Raises:
        ValueError: the file is no image.
    """
    image = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise ValueError(f"{path}: not an image that OpenCV can decode")
    return Features(*detect_keypoints(image, detector, str(path)), (image.shape[1], image.shape[0]))


def errors_of_pair(
    one: Features, two: Features, norm: int, pair: ScenePair, match_filter: MatchFilter
) -> dict[str, float]:
    """Pose error by method, degrees; 180 where there is no pose."""
    knn = match_descriptors(one.descriptors, two.descriptors, norm)
    K1, K2 = (
        _rescaled(K, size, now)
        for K, size, now in ((pair.K1, pair.image_size1, one.size), (pair.K2, pair.image_size2, two.size))
    )
    result = match_filter.filter(one.keypoints, two.keypoints, knn, K1=K1, K2=K2, size1=one.size, size2=two.size)
    poses = {"mgca_filter": (result.R, result.t)}
    putative = read_matches(knn, len(one.keypoints), len(two.keypoints))
    kept = np.zeros(0, np.intp) if putative.ratio is None else np.flatnonzero(putative.ratio < RATIO)
    points1, points2 = (
        np.array([f.keypoints[i].pt for i in index[kept]], dtype=np.float64).reshape(-1, 2)
        for f, index in ((one, putative.index1), (two, putative.index2))
    )
    for fit in fit_baselines(points1, points2, K1, K2, size1=one.size, size2=two.size, threshold_px=THRESHOLD_PX):
        poses[f"ratio {RATIO} + {fit.name}"] = (fit.R, fit.t)
    return {
        name: FAILURE_DEG if R is None or t is None else pose_error_deg(R, t, pair.R, pair.t)
        for name, (R, t) in poses.items()
    }


def _both_exist(images: Path, pair: ScenePair) -> bool:
    return all((images / name).exists() for name in (pair.image1, pair.image2))


def _rescaled(K: NDArray[np.float64], size: tuple[int, int], now: tuple[int, int]) -> NDArray[np.float64]:
    """Intrinsics of a picture that was ``size`` and is ``now``: pixels are areas, their centres shift by halves."""
    sx, sy = now[0] / size[0], now[1] / size[1]
    return np.array([[sx, 0.0, 0.5 * sx - 0.5], [0.0, sy, 0.5 * sy - 0.5], [0.0, 0.0, 1.0]]) @ K


def run(
    images: Path, bundle: SceneBundle, names: Sequence[str], per_scene: int | None, seed: int, model: Path
) -> Iterator[tuple[str, dict[str, list[float]]]]:
    """Detector by detector, pose errors by method, over the pairs of which both photographs are in the folder."""
    cv2.setNumThreads(1)
    match_filter = MatchFilter(model=model)
    there = [p for p in map(bundle.__getitem__, range(len(bundle))) if _both_exist(images, p)]
    pairs = [there[i] for i in draw_indices(len(there), bundle.scene, per_scene, seed)]
    for name in names:
        detector = make_detector(name)
        features: Callable[[str], Features] = cache(lambda image: read_features(images / image, detector))  # noqa: B023
        errors: dict[str, list[float]] = {}
        for pair in pairs:
            one, two = features(pair.image1), features(pair.image2)
            for method, error in errors_of_pair(one, two, detector.defaultNorm(), pair, match_filter).items():
                errors.setdefault(method, []).append(error)
        yield name, errors


HEADER = "| detector | method | pairs | mAP@5 | mAP@20 |\n|---|---|---:|---:|---:|"


def format_rows(detector: str, errors: dict[str, list[float]]) -> str:
    """One row per method: shares of pairs in per cent."""
    lines = []
    for method, values in errors.items():
        figures = [100.0 * mean_average_precision(values, limit) for limit in (5, 20)]
        lines.append(f"| {detector} | {method} | {len(values)} | {figures[0]:.1f} | {figures[1]:.1f} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file or option that cannot be used."""
    parser = argparse.ArgumentParser(prog="python -m mgca_filter.evaluation.detectors", description=__doc__)
    parser.add_argument("images", metavar="IMAGES", type=Path, help="folder of photographs, names as in the bundle")
    parser.add_argument("bundle", metavar="BUNDLE", type=Path, help="scene bundle of the same photographs")
    parser.add_argument("--detectors", nargs="+", choices=DETECTORS, default=DETECTORS)
    parser.add_argument("--per-scene", type=int, metavar="N", help="at most N pairs")
    parser.add_argument("--model", type=Path, default=model_path(), metavar="FILE")
    parser.add_argument("--seed", type=int, default=0, help="of the draw (default 0)")
    options = parser.parse_args(arguments)
    try:
        bundle = SceneBundle(options.bundle)
        print(HEADER)
        settings = (options.detectors, options.per_scene, options.seed, options.model)
        for detector, errors in run(options.images, bundle, *settings):
            print(format_rows(detector, errors), flush=True)
    except (MgcaFilterError, ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
