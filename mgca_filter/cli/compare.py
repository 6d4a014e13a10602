"""RANSAC and MAGSAC on the raw matches, to be read next to the filter's answer."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..fit.evidence import Evidence, distinct_rows, one_to_one
from ..fit.robust_fit import fit_alone
from ..geometry.cameras import Distortion, mean_focal_length, resolve_intrinsics
from ..geometry.epipolar import rotation_error_deg, sampson_distance
from ..inputs.options import FilterOptions
from ..result import FilterResult
from .truth import TruePose

BASELINES = {"RANSAC": "ransac", "MAGSAC": "magsac"}


@dataclass(frozen=True)
class BaselineFit:
    """What an estimator makes of all matches, unscored and in the order they came.

    Attributes:
        name: "RANSAC" or "MAGSAC".
        mask: bool (M,), Sampson distance below the threshold under the estimator's model, as in ``FilterResult``.
        E: (3, 3) of unit Frobenius norm, R: (3, 3), t: (3,) unit norm; None where nothing was found.
        fit_ms: time of the estimator, milliseconds.
    """

    name: str
    mask: NDArray[np.bool_]
    E: NDArray[np.float64] | None
    R: NDArray[np.float64] | None
    t: NDArray[np.float64] | None
    fit_ms: float

    @property
    def num_inliers(self) -> int:
        """Number of True in ``mask``."""
        return int(np.count_nonzero(self.mask))


def fit_baselines(
    points1: NDArray[np.float64],
    points2: NDArray[np.float64],
    K1: NDArray[np.float64] | None,
    K2: NDArray[np.float64] | None,
    *,
    size1: tuple[int, int],
    size2: tuple[int, int],
    threshold_px: float,
    seed: int = 0,
    dist1: Distortion | None = None,
    dist2: Distortion | None = None,
) -> list[BaselineFit]:
    """Fit by each baseline, with the filter's threshold and OpenCV's usual confidence.

    Args:
        points1, points2: matched pixels (M, 2), row by row.
        K1, K2: (3, 3) intrinsics, or None: a fundamental matrix is fitted then, and the pose rests on a guess.
        size1, size2: (width, height) of the images, for that guess.
        threshold_px: inlier threshold, pixels.
        seed: of the estimators' random numbers.
        dist1, dist2: lens distortion, as of the filter.
    """
    camera1, camera2 = resolve_intrinsics(
        points1, points2, K1=K1, K2=K2, dist1=dist1, dist2=dist2, size1=size1, size2=size2
    )
    correspondences = np.hstack([camera1.normalize(points1), camera2.normalize(points2)])
    focal_px = mean_focal_length(camera1.K, camera2.K)
    fits = []
    for name, method in BASELINES.items():
        start = time.perf_counter()
        rows = np.sort(distinct_rows(correspondences))
        evidence = Evidence(
            rows,
            correspondences[rows],
            one_to_one(correspondences[rows]),
            np.ones(len(rows), dtype=bool),
            np.full(len(rows), np.nan),
            np.ones(len(rows)),
            focal_px,
            calibrated=not camera1.guessed,
        )
        model = fit_alone(
            evidence, method, threshold_px, FilterOptions(confidence=0.999, max_iterations=5000, seed=seed)
        )
        fit_ms = 1e3 * (time.perf_counter() - start)
        if model is None:
            fits.append(BaselineFit(name, np.zeros(len(points1), bool), None, None, None, fit_ms))
            continue
        mask = sampson_distance(correspondences, model.M) * focal_px < threshold_px
        fits.append(BaselineFit(name, mask, model.E, model.R, model.t, fit_ms))
    return fits


def describe_rotation(R: NDArray[np.float64] | None) -> str:
    """Angle of the rotation in words, "-" where there is none."""
    return "-" if R is None else f"{rotation_error_deg(R, np.eye(3)):.1f} deg"


def describe_translation(t: NDArray[np.float64] | None) -> str:
    """Direction of the translation in words, "-" where there is none."""
    return "-" if t is None else "(" + ", ".join(f"{value:+.2f}" for value in t) + ")"


def comparison_table(
    result: FilterResult,
    filter_ms: float,
    baselines: Sequence[BaselineFit],
    truth: TruePose | None = None,
    right: NDArray[np.bool_] | None = None,
) -> str:
    """Counts, poses and times of the filter and the baselines, one row each.

    A count of kept matches is no accuracy: a wrong model gathers matches as well. With the true pose the table says how
    far each pose is off, and with ``right`` (M,), which matches are right by it, how many of the kept ones are.
    """
    rows: list[FilterResult | BaselineFit] = [result, *baselines]
    columns: list[tuple[str, str, list[str]]] = [
        ("", "<", ["mgca_filter", *(fit.name for fit in baselines)]),
        ("kept", ">", [str(row.num_inliers) for row in rows]),
    ]
    if right is not None:
        columns.append(("right", ">", [str(int(np.count_nonzero(row.mask & right))) for row in rows]))
    columns += [
        ("rotation", ">", [describe_rotation(row.R) for row in rows]),
        ("translation", "<", [describe_translation(row.t) for row in rows]),
    ]
    if truth is not None:
        errors = [truth.errors_deg(row.R, row.t) for row in rows]
        for name, place in (("rotation off", 0), ("translation off", 1)):
            found = [error[place] for error in errors]
            columns.append((name, ">", ["-" if off is None else f"{off:.2f} deg" for off in found]))
    columns.append(("time", ">", [f"{ms:.0f} ms" for ms in (filter_ms, *(fit.fit_ms for fit in baselines))]))
    widths = [max(len(cell) for cell in (head, *cells)) for head, _, cells in columns]
    lines = []
    for k in range(-1, len(rows)):
        cells = [head if k < 0 else cells[k] for head, _, cells in columns]
        lines.append("  ".join(f"{cell:{side}{width}}" for cell, (_, side, _), width in zip(cells, columns, widths)))
    return "\n".join(lines)
