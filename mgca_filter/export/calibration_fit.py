"""Logits to probabilities: Platt scaling fitted on real pairs, and how far it can be trusted.

``python -m mgca_filter.export.calibration_fit MODEL.onnx BUNDLES SCENE …`` fits on the even pairs of the scenes named,
checks on the odd ones, and prints what ``python -m mgca_filter.export --calibration`` takes; ``--calibrate`` there does
both at once.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from ..data.scene_bundle import SceneBundle, ScenePair
from ..evaluation.methods import BoolArray, FloatArray
from ..evaluation.metrics import TRUE_INLIER_DISTANCE_SQUARED
from ..geometry.epipolar import symmetric_epipolar_distance_squared
from ..inference.calibration import Calibration, sigmoid
from ..match_filter import MatchFilter

PAIRS_PER_SCENE = 24
_NEWTON_STEPS = 50
_RIDGE = 1e-9


def collect_logits(model: str | Path, pairs: Sequence[ScenePair]) -> tuple[list[FloatArray], list[BoolArray]]:
    """Logits (M,) of all raw matches of each pair, as the filter gives them, and which are inliers (M,)."""
    match_filter = MatchFilter(model=model, method="none")
    logits, truth = [], []
    for pair in pairs:
        result = match_filter.filter(
            pair.points1, pair.points2, None, K1=pair.K1, K2=pair.K2, attributes=pair.attributes
        )
        logits.append(np.asarray(result.info["logits"], dtype=np.float64))
        distance = symmetric_epipolar_distance_squared(pair.correspondences, pair.E)
        truth.append(np.asarray(distance < TRUE_INLIER_DISTANCE_SQUARED))
    return logits, truth


def fit_calibration(logits: FloatArray, truth: BoolArray) -> Calibration:
    """Scale and offset that maximise the likelihood of the truth (Platt 1999), by Newton's method.

    Args:
        logits: (N,) finite. truth: (N,) inlier or not.

    Raises:
        ValueError: all matches are of one kind.
    """
    if truth.all() or not truth.any():
        raise ValueError("calibration needs inliers and outliers")
    design = np.column_stack([logits, np.ones(len(logits))])
    parameters = np.array([1.0, 0.0])
    for _ in range(_NEWTON_STEPS):
        p = sigmoid(design @ parameters)
        gradient = design.T @ (p - truth) / len(p)
        hessian = (design * (p * (1.0 - p))[:, None]).T @ design / len(p) + _RIDGE * np.eye(2)
        step = np.linalg.solve(hessian, gradient)
        parameters = parameters - step
        if np.abs(step).max() < 1e-8:
            break
    return Calibration(scale=float(parameters[0]), offset=float(parameters[1]))


def expected_calibration_error(probabilities: FloatArray, truth: BoolArray, bins: int = 15) -> float:
    """Mean gap between probability and frequency over equal bins of probability, weighted by their matches.

    Naeini et al., AAAI 2015; ``probabilities`` and ``truth`` (N,).
    """
    index = np.minimum((np.asarray(probabilities) * bins).astype(int), bins - 1)
    count = np.bincount(index, minlength=bins)
    gap = np.bincount(index, probabilities, bins) - np.bincount(index, truth.astype(float), bins)
    return float(np.abs(gap).sum() / max(count.sum(), 1))


def calibrate(
    model: Path, bundles: Path, scenes: Iterable[str], pairs_per_scene: int = PAIRS_PER_SCENE
) -> tuple[Calibration, float]:
    """Calibration of a model file on scenes of a folder, and its expected error on as many other pairs of them.

    ``pairs_per_scene`` are drawn of each bundle of a scene, whatever its detector.
    """
    from ..training.validation import select_pairs  # needs PyTorch, which the fit itself does not

    files = [path for scene in scenes for path in _bundles_of(bundles, scene)]
    pairs = select_pairs([SceneBundle(path) for path in files], pairs_per_scene)
    logits, truth = collect_logits(model, pairs[::2])
    calibration = fit_calibration(np.concatenate(logits), np.concatenate(truth))
    logits, truth = collect_logits(model, pairs[1::2])
    probabilities = calibration.probabilities(np.concatenate(logits)).astype(float)
    return calibration, expected_calibration_error(probabilities, np.concatenate(truth))


def _bundles_of(folder: Path, scene: str) -> list[Path]:
    """``scene.npz`` and ``scene.detector.npz``; the first where there is neither, for the error that names it."""
    found = [*folder.glob(f"{scene}.npz"), *sorted(folder.glob(f"{scene}.*.npz"))]
    return found or [folder / f"{scene}.npz"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print scale, offset and the calibration error on pairs that the fit did not see."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("bundles", type=Path, help="folder of scene bundles")
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--per-scene", type=int, default=PAIRS_PER_SCENE)
    options = parser.parse_args(arguments)
    calibration, error = calibrate(options.model, options.bundles, options.scenes, options.per_scene)
    print(f"{calibration.scale:.4f} {calibration.offset:.4f}")
    print(f"expected calibration error on other pairs of these scenes: {error:.4f}")


if __name__ == "__main__":
    main()
