"""Slow cameras: what comes back where parallax is a few pixels or less? ``python -m benchmarks.small_motion``.

Tracks of a hand-held camera are made up: points at random depths, a little rotation, noise as of a tracker or of
keypoints, a fifth of the matches wrong, and a baseline that gives the median point the parallax named. The filter gets
bare points, as an odometry script has them. The spread of the direction of translation that it tells
(``info["translation_sigma_deg"]``) is compared with the error.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mgca_filter.geometry.epipolar import rotation_error_deg, translation_error_deg
from mgca_filter.geometry.pose_refinement import rotation_from_vector
from mgca_filter.match_filter import MatchFilter
from mgca_filter.tables import markdown_head, markdown_row

from .study import run_study, study_parser

Array = NDArray[np.float64]

K = np.array([[800.0, 0.0, 639.5], [0.0, 800.0, 359.5], [0.0, 0.0, 1.0]])
SIZE = (1280, 720)
DEPTHS = (4.0, 12.0)
PARALLAX_PX = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
NOISE_PX = (0.1, 0.3)
MATCHES, WRONG_SHARE = 400, 0.2
ROTATION_DEG = 0.5


@dataclass(frozen=True)
class Tracks:
    """Pixels (N, 2), (N, 2) of both images, which are right (N,), and the pose; ``t`` is zero where nothing moved."""

    points1: Array
    points2: Array
    right: NDArray[np.bool_]
    R: Array
    t: Array


@dataclass(frozen=True)
class Outcome:
    """What came back: errors are None without a translation, ``sigma_deg`` is what the filter says of its own."""

    status: str
    recall: float
    wrong_kept: float
    rotation_deg: float | None
    translation_deg: float | None
    sigma_deg: float | None


def make_tracks(parallax_px: float, noise_px: float, seed: int) -> Tracks:
    """A pair of frames whose median parallax, rotation aside, is ``parallax_px``."""
    rng = np.random.default_rng(seed)
    R = rotation_from_vector(rng.normal(0, np.radians(ROTATION_DEG) / np.sqrt(3), 3))
    points1 = rng.uniform((0, 0), SIZE, (MATCHES, 2))
    rays = np.column_stack([points1, np.ones(MATCHES)]) @ np.linalg.inv(K).T
    X = rays * rng.uniform(*DEPTHS, (MATCHES, 1))
    direction = rng.normal(0, 1, 3)
    direction /= np.linalg.norm(direction)
    still = _project(X @ R.T)
    # Parallax is all but proportional to the baseline as long as that is short.
    short = 1e-3
    unit_px = float(np.median(np.linalg.norm(_project(X @ R.T + short * direction) - still, axis=1))) / short
    t = parallax_px / unit_px * direction
    points2 = _project(X @ R.T + t) + rng.normal(0, noise_px, (MATCHES, 2))
    wrong = np.arange(MATCHES) < WRONG_SHARE * MATCHES
    points2[wrong] = rng.uniform((0, 0), SIZE, (int(wrong.sum()), 2))
    return Tracks(points1 + rng.normal(0, noise_px, (MATCHES, 2)), points2, ~wrong, R, t)


def _project(X: Array) -> Array:
    projected = X @ K.T
    return np.asarray(projected[:, :2] / projected[:, 2:])


def run_pair(tracks: Tracks, match_filter: MatchFilter) -> Outcome:
    """Filter the tracks."""
    result = match_filter.filter(tracks.points1, tracks.points2, None, K1=K, size1=SIZE, size2=SIZE)
    recall, wrong_kept = (float(result.mask[rows].mean()) for rows in (tracks.right, ~tracks.right))
    rotation = None if result.R is None else rotation_error_deg(result.R, tracks.R)
    moved = result.t is not None and tracks.t.any()
    translation = translation_error_deg(result.t, tracks.t) if moved and result.t is not None else None
    sigma = result.info.get("translation_sigma_deg") if translation is not None else None
    return Outcome(str(result.status), recall, wrong_kept, rotation, translation, sigma)


HEADER = ["parallax, px", "noise, px", "status", "right kept, %", "wrong kept, %"] + [
    *("rotation, °", "with a direction, %", "direction, °", "said, °", "within 1 sigma, %", "within 2, %")
]


def cells(parallax_px: float, noise_px: float, outcomes: Sequence[Outcome]) -> list[str]:
    """A row: statuses, means of the shares, medians of the errors and of what the filter says of them."""
    statuses = Counter(outcome.status for outcome in outcomes)
    words = ", ".join(f"{count} {word}" for word, count in statuses.most_common())
    rotations = [outcome.rotation_deg for outcome in outcomes if outcome.rotation_deg is not None]
    told = [(o.translation_deg, o.sigma_deg) for o in outcomes if o.translation_deg is not None and o.sigma_deg]
    row = [f"{parallax_px:g}", f"{noise_px:g}", words]
    row += [f"{100 * np.mean([getattr(o, name) for o in outcomes]):.1f}" for name in ("recall", "wrong_kept")]
    row += [f"{np.median(rotations):.3f}" if rotations else "", f"{100 * len(told) / len(outcomes):.0f}"]
    if not told:
        return [*row, "", "", "", ""]
    error, sigma = np.array(told).T
    row += [f"{np.median(error):.2f}", f"{np.median(sigma):.2f}"]
    return row + [f"{100 * np.mean(error < factor * sigma):.0f}" for factor in (1.0, 2.0)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = an option that cannot be used."""
    parser = study_parser("small_motion", __doc__, per_scene=False)
    parser.add_argument("--pairs", type=int, default=20, help="frames a row (default 20)")
    return run_study(run, parser.parse_args(arguments))


def run(options: argparse.Namespace) -> int:
    """Print a row for each parallax and noise as it is measured."""
    match_filter = MatchFilter(model=options.model)
    print(markdown_head(HEADER))
    for noise_px in NOISE_PX:
        for parallax_px in PARALLAX_PX:
            seeds = range(options.seed, options.seed + options.pairs)
            outcomes = [run_pair(make_tracks(parallax_px, noise_px, seed), match_filter) for seed in seeds]
            print(markdown_row(cells(parallax_px, noise_px, outcomes)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
