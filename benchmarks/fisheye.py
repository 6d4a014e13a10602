"""Wide lenses: how many right matches are kept from the middle to the rim? ``python -m benchmarks.fisheye``.

Two views through a fisheye of 170 degrees are made up; matches carry noise in the image, a third of them are wrong. The
rows: the lens as it is; the same points undistorted by the caller, whose residuals then are those of the stretched
image plane; and the four coefficients read as a pinhole's, which is legal and wrong.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mgca_filter import Fisheye
from mgca_filter.geometry.cameras import resolve_intrinsics
from mgca_filter.geometry.epipolar import pose_error_deg
from mgca_filter.geometry.pose_refinement import rotation_from_vector
from mgca_filter.match_filter import MatchFilter
from mgca_filter.result import FilterResult
from mgca_filter.tables import markdown_head, markdown_row

from .study import run_study, study_parser

Array = NDArray[np.float64]

K = np.array([[300.0, 0.0, 511.5], [0.0, 300.0, 511.5], [0.0, 0.0, 1.0]])
LENS = Fisheye(-0.02, 0.004, -0.001, 0.0002)
RINGS_DEG = ((0, 40), (40, 60), (60, 70), (70, 85))
RIGHT, WRONG, NOISE_PX = 600, 300, 0.3
ROWS = ("fisheye", "undistorted before", "read as a pinhole's")


@dataclass(frozen=True)
class Views:
    """Pixels (N, 2), (N, 2), angles off the first axis in degrees (N,), which are right (N,), and the pose."""

    points1: Array
    points2: Array
    angle_deg: Array
    right: NDArray[np.bool_]
    R: Array
    t: Array


def make_views(seed: int) -> Views:
    """Two views of points in front of both cameras, with matches up to the rim."""
    rng = np.random.default_rng(seed)
    R = rotation_from_vector(rng.normal(0, 0.15, 3))
    t = rng.normal(0, 1, 3) * np.array([1.0, 1.0, 0.4])
    t /= np.linalg.norm(t)
    count = RIGHT + WRONG
    theta, phi = np.radians(85) * np.sqrt(rng.random(8 * count)), rng.uniform(0, 2 * np.pi, 8 * count)
    rays = np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    X1 = rays * rng.uniform(4, 12, (8 * count, 1))
    X2 = X1 @ R.T + t
    seen = np.flatnonzero(X2[:, 2] > np.cos(np.radians(85)) * np.linalg.norm(X2, axis=1))[:count]
    points1, points2 = (_project(X[seen]) + rng.normal(0, NOISE_PX, (count, 2)) for X in (X1, X2))
    points2[:WRONG] = points2[rng.permutation(WRONG)]
    return Views(points1, points2, np.degrees(theta[seen]), np.arange(count) >= WRONG, R, t)


def _project(X: Array) -> Array:
    coefficients, nowhere = np.array([LENS.k1, LENS.k2, LENS.k3, LENS.k4]), np.zeros(3)
    return np.asarray(cv2.fisheye.projectPoints(X[:, None], nowhere, nowhere, K, coefficients)[0][:, 0])


def run_pair(views: Views, row: str, match_filter: MatchFilter) -> FilterResult:
    """Filter the views as a row of the table has them."""
    points1, points2 = views.points1, views.points2
    lens: ArrayLike | Fisheye | None = LENS
    if row == "undistorted before":
        cameras = resolve_intrinsics(points1, points2, K1=K, dist1=LENS)
        points1, points2 = (c.project(c.normalize(p)) for c, p in zip(cameras, (points1, points2)))
        lens = None
    elif row == "read as a pinhole's":
        lens = [LENS.k1, LENS.k2, LENS.k3, LENS.k4]
    return match_filter.filter(points1, points2, None, K1=K, dist1=lens)


def recalls(views: Views, mask: NDArray[np.bool_]) -> list[float]:
    """Share of the right matches that a mask keeps, ring by ring."""
    rings = [(low <= views.angle_deg) & (views.angle_deg < high) & views.right for low, high in RINGS_DEG]
    return [float(mask[ring].mean()) for ring in rings]


HEADER = [
    "lens",
    "pairs",
    "ok",
    "within 1°",
    *(f"{low}–{high}°, %" for low, high in RINGS_DEG),
    "wrong kept, %",
    "told",
]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = an option that cannot be used."""
    parser = study_parser("fisheye", __doc__, per_scene=False)
    parser.add_argument("--pairs", type=int, default=10, help="pairs of views (default 10)")
    return run_study(run, parser.parse_args(arguments))


def run(options: argparse.Namespace) -> int:
    """Print a row for each reading of the lens, all on the same views."""
    match_filter = MatchFilter(model=options.model)
    pairs = [make_views(seed) for seed in range(options.seed, options.seed + options.pairs)]
    print(markdown_head(HEADER))
    for row in ROWS:
        results = [run_pair(views, row, match_filter) for views in pairs]
        right = [
            r.t is not None and r.R is not None and pose_error_deg(r.R, r.t, v.R, v.t) < 1.0
            for r, v in zip(results, pairs)
        ]
        kept = np.mean([recalls(v, r.mask) for r, v in zip(results, pairs)], axis=0)
        wrong = np.mean([r.mask[~v.right].mean() for r, v in zip(results, pairs)])
        told = sum(any("Fisheye(" in text for text in r.info["assumptions"]) for r in results)
        cells = [row, str(len(pairs)), str(sum(r.ok for r in results)), str(sum(right))]
        cells += [*(f"{100 * share:.1f}" for share in kept), f"{100 * wrong:.1f}", f"{told} of {len(pairs)}"]
        print(markdown_row(cells), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
