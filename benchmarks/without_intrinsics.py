"""Photographs without K: how good is the pose, and how sure are the focal lengths?

``python -m benchmarks.without_intrinsics [BUNDLES]``, on pairs of scene bundles: the pose that comes without K; what
F would have given with the true K, that of the same answer and that of ``geometry="fundamental"``; and the pose under
a focal length that is guessed. ``ok`` as it is and as it would be if the estimated focal lengths were taken for known,
and what is verified whatever the pose is worth. ``--zooms`` enlarges image 2 about its principal point, as if another
lens had taken it. Without bundles the pairs are made up. Of a folder with ``QUALITY.csv`` the scenes whose poses can
be trusted. ``--fit`` adds the coefficients of ``mgca_filter/fit/focal_estimate.py``, and what they give where scenes
are left out in turn.
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
from mgca_filter.evaluation.metrics import FAILURE_DEG, mean_average_precision
from mgca_filter.evaluation.pairs import iterate_pairs, select_pairs
from mgca_filter.export.choice_fit import area_under_roc, cross_validated, fit_logistic, sound_scenes
from mgca_filter.fit.robust_fit import pose_from_essential
from mgca_filter.geometry.cameras import mean_focal_length
from mgca_filter.geometry.epipolar import pose_error_deg, project_to_essential
from mgca_filter.geometry.pose_refinement import rotation_from_vector
from mgca_filter.inputs.attributes import MatchAttributes
from mgca_filter.match_filter import MatchFilter
from mgca_filter.result import FilterResult, Status
from mgca_filter.tables import markdown_head, markdown_row

from .study import match_pair, result_error_deg, run_study, study_parser

Array = NDArray[np.float64]

SIZE = (1000, 750)
RIGHT, WRONG, NOISE_PX = 300, 100, 0.5
RIGHT_DEG = 10.0
# Pairs that are not zoomed weigh as much as all others of the usual two zooms: most photographs are of one camera.
ZOOMED_WEIGHT = 0.5


@dataclass(frozen=True)
class Outcome:
    """One pair: pose errors in degrees, 180 without a pose, and the focal lengths.

    Attributes:
        pose, own_F, with_true_K, guessed: without K; by F of the answer, and by F where nothing else is asked for, with
            the true K; by the guessed focal length.
        status, intrinsics: words of the result. verified, kept: whether, and how many matches, are to be used.
        confidence, fitted_confidence, sigma_deg: of the answer with an estimated focal length, else None.
        errors: (2,) logarithms of the estimated focal lengths over the true ones, None where none are estimated.
        sigmas: (2,) what the filter says of them. two: they differ.
    """

    scene: str
    zoom: float
    pose: float
    own_F: float
    with_true_K: float
    guessed: float
    status: str
    intrinsics: str
    verified: bool
    kept: int
    confidence: float | None
    fitted_confidence: float | None
    sigma_deg: float | None
    errors: Array | None
    sigmas: Array | None
    two: bool

    @property
    def ok(self) -> bool:
        """``ok``, with a pose."""
        return self.status == Status.OK and self.pose < FAILURE_DEG

    @property
    def ok_if_known(self) -> bool:
        """The same where the estimated focal lengths are taken for known."""
        return self.ok or (self.status == Status.LOW_SUPPORT and self.verified)

    @property
    def right(self) -> bool:
        """The pose is near the truth."""
        return self.pose < RIGHT_DEG


def zoomed(pair: ScenePair, zoom: float) -> ScenePair:
    """The pair with its second image taken at ``zoom`` times the focal length; what leaves the image is left out."""
    if zoom == 1.0:
        return pair
    centre = pair.K2[:2, 2]
    points2 = (pair.points2 - centre) * zoom + centre
    inside = np.flatnonzero(((points2 >= 0) & (points2 < np.array(pair.image_size2))).all(axis=1))
    K2 = pair.K2.copy()
    K2[:2, :2] *= zoom
    return replace(pair, points2=points2, K2=K2).take(inside)


def make_pair(seed: int, zoom: float) -> ScenePair:
    """A made-up pair: cameras of usual focal lengths that look about the same way, past each other."""
    rng = np.random.default_rng(seed)
    focal1 = 1.2 * SIZE[0] * np.exp(np.clip(rng.normal(-0.3, 0.3), -0.8, 0.4))
    centre = (np.array(SIZE) - 1) / 2
    K1, K2 = (np.array([[f, 0, centre[0]], [0, f, centre[1]], [0, 0, 1.0]]) for f in (focal1, zoom * focal1))
    while True:
        R, t = rotation_from_vector(rng.normal(0, 0.2, 3)), rng.normal(0, 1.0, 3)
        points1 = rng.uniform((0, 0), SIZE, (20 * RIGHT, 2))
        X = np.column_stack([points1, np.ones(len(points1))]) @ np.linalg.inv(K1).T
        X2 = (X * rng.uniform(3, 9, (len(X), 1))) @ R.T + t
        with np.errstate(all="ignore"):
            points2 = (X2 @ K2.T)[:, :2] / X2[:, 2:]
        seen = np.flatnonzero((X2[:, 2] > 0.5) & ((points2 > 0) & (points2 < np.array(SIZE))).all(axis=1))[:RIGHT]
        if len(seen) == RIGHT:
            break
    ends1, ends2 = (
        np.vstack([p[seen] + rng.normal(0, NOISE_PX, (RIGHT, 2)), rng.uniform((0, 0), SIZE, (WRONG, 2))])
        for p in (points1, points2)
    )
    right = np.arange(RIGHT + WRONG) < RIGHT
    ratio = np.where(right, rng.uniform(0.3, 0.85, len(right)), rng.uniform(0.7, 1.0, len(right))).astype(np.float32)
    attributes = MatchAttributes(ratio=ratio, best=np.ones(len(right), dtype=bool))
    pose = R, t / np.linalg.norm(t)
    return ScenePair("made up", seed, "1", "2", ends1, ends2, K1, K2, SIZE, SIZE, *pose, attributes, right)


def run_pair(pair: ScenePair, zoom: float, match_filter: MatchFilter, without_estimate: MatchFilter) -> Outcome:
    """Filter a pair, zoomed already, without K."""
    bare = replace(match_pair(pair), K1=None, K2=None)
    result, guessed = match_filter.filter_many([bare])[0], without_estimate.filter_many([bare])[0]
    errors = sigmas = None
    two = False
    if result.info["intrinsics"] == "estimated":
        estimated = np.array(result.info["focal_px"])
        errors = np.log(estimated / [mean_focal_length(K, K) for K in (pair.K1, pair.K2)])
        sigmas = np.array(result.info["focal_sigma"])
        sides = np.array([max(pair.image_size1), max(pair.image_size2)])
        two = bool(abs(np.diff(np.log(estimated / sides))[0]) > 1e-6)
    return Outcome(
        pair.scene,
        zoom,
        result_error_deg(result, pair),
        _error_with_true_K(result, pair),
        _error_with_true_K(guessed, pair),
        result_error_deg(guessed, pair),
        str(result.status),
        result.info["intrinsics"],
        result.verified,
        result.num_inliers if result.verified else 0,
        result.confidence,
        result.info.get("fitted_confidence"),
        result.info.get("focal_sigma_deg"),
        errors,
        sigmas,
        two,
    )


def _error_with_true_K(result: FilterResult, pair: ScenePair) -> float:
    """Pose error of F under the true intrinsics."""
    if result.F is None or not result.mask.any():
        return FAILURE_DEG
    E = project_to_essential(pair.K2.T @ result.F @ pair.K1)
    pose = pose_from_essential(E, pair.correspondences[result.mask], mean_focal_length(pair.K1, pair.K2))
    return FAILURE_DEG if pose is None else pose_error_deg(*pose, pair.R, pair.t)


POSES = ["zoom", "pairs", "R, t mAP@20", "its F with the true K", "F alone with the true K", "guessed focal length"]
VERDICTS = [
    *("zoom", "ok if known", f"of these within {RIGHT_DEG:g}°", "ok", f"of these within {RIGHT_DEG:g}°"),
    *("right ones left, %", "verified", "matches kept"),
]
FOCALS = ["zoom", "estimated", "two found", "error, %", "within 1 sigma, %", "within 2, %"]


def pose_cells(zoom: float, outcomes: Sequence[Outcome]) -> list[str]:
    """A row of accuracies, per cent."""
    kinds = ([getattr(o, name) for o in outcomes] for name in ("pose", "own_F", "with_true_K", "guessed"))
    accuracies = (f"{100 * mean_average_precision(errors, 20):.1f}" for errors in kinds)
    return [f"{zoom:g}", str(len(outcomes)), *accuracies]


def verdict_cells(zoom: float, outcomes: Sequence[Outcome]) -> list[str]:
    """A row of what the filter says of its answers: before and after the focal lengths' uncertainty has its say."""
    row = _counts([o for o in outcomes if o.ok_if_known], [o for o in outcomes if o.ok])
    return [f"{zoom:g}", *row, str(sum(o.verified for o in outcomes)), str(sum(o.kept for o in outcomes))]


def focal_cells(zoom: float, outcomes: Sequence[Outcome]) -> list[str]:
    """A row of the focal lengths: their median error, and how often it lies within what is said of them."""
    known = [(o.errors, o.sigmas) for o in outcomes if o.errors is not None and o.sigmas is not None]
    row = [f"{zoom:g}", str(len(known)), str(sum(o.two for o in outcomes))]
    if not known:
        return [*row, "", "", ""]
    errors, sigmas = (np.concatenate(values) for values in zip(*known))
    within = (f"{100 * np.mean(np.abs(errors) < factor * sigmas):.0f}" for factor in (1.0, 2.0))
    return [*row, f"{100 * np.median(np.abs(errors)):.1f}", *within]


def _counts(before: Sequence[Outcome], after: Sequence[Outcome]) -> list[str]:
    """Numbers of answers, the second among the first, what part of each is right, and which of the right are left."""
    right_before, right_after = (sum(o.right for o in outcomes) for outcomes in (before, after))
    shares = [100 * right / max(len(of), 1) for right, of in ((right_before, before), (right_after, after))]
    left = 100 * right_after / max(right_before, 1)
    return [str(len(before)), f"{shares[0]:.1f}", str(len(after)), f"{shares[1]:.1f}", f"{left:.0f}"]


def describe_fit(outcomes: Sequence[Outcome], usable: float) -> str:
    """Coefficients of the confidence under estimated focal lengths, and what they do on scenes that they do not know.

    Args:
        usable: the confidence from which on a pose is ``ok``.
    """
    judged = [o for o in outcomes if o.fitted_confidence is not None and o.sigma_deg is not None]
    fitted = np.array([o.fitted_confidence for o in judged], dtype=np.float64)
    p = np.clip(fitted, 1e-3, 1 - 1e-3)
    features = np.column_stack([np.log(p / (1 - p)), np.log(np.array([o.sigma_deg for o in judged], dtype=np.float64))])
    right = np.array([o.right for o in judged])
    weight = np.array([1.0 if o.zoom == 1.0 else ZOOMED_WEIGHT for o in judged])
    weights = fit_logistic(features, right, weight)
    confidence = np.minimum(cross_validated(features, right, weight, [o.scene for o in judged]), fitted)
    lines = ["log odds of the fit {:.3f}, log sigma {:.3f}, offset {:.3f}".format(*weights)]
    lines.append(f"AUROC {area_under_roc(fitted, right):.3f} -> {area_under_roc(confidence, right):.3f}")
    lines.append(markdown_head(["confidence", "poses", "mean", "right", "poses before", "right before"]))
    for low, high in zip((0.0, 0.2, 0.4, 0.6, 0.8, 0.9), (0.2, 0.4, 0.6, 0.8, 0.9, 1.01)):
        now, before = ((low <= values) & (values < high) for values in (confidence, fitted))
        row = [f"{low:g} to {min(high, 1.0):g}", str(now.sum()), f"{confidence[now].mean() if now.any() else 0:.2f}"]
        row += [f"{right[now].mean() if now.any() else 0:.2f}", str(before.sum())]
        lines.append(markdown_row([*row, f"{right[before].mean() if before.any() else 0:.2f}"]))
    for zoom in (*sorted({o.zoom for o in judged}), None):
        rows = [k for k, o in enumerate(judged) if (zoom is None or o.zoom == zoom) and o.ok_if_known]
        counts = _counts([judged[k] for k in rows], [judged[k] for k in rows if confidence[k] >= usable])
        name = "all" if zoom is None else f"zoom {zoom:g}"
        lines.append("{}: ok {}, right {} %; now {}, {} %, of the right ones {} %".format(name, *counts))
    return "\n".join(lines)


def _table(header: list[str], rows: Sequence[list[str]]) -> str:
    return "\n".join([markdown_head(header), *map(markdown_row, rows)])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file or option that cannot be used."""
    parser = study_parser("without_intrinsics", __doc__)
    parser.add_argument("bundles", metavar="BUNDLES", type=Path, nargs="?", help="scene bundles; none = made-up pairs")
    parser.add_argument("--zooms", type=float, nargs="+", default=[1.0, 0.6, 1.6], help="default 1 0.6 1.6")
    parser.add_argument("--pairs", type=int, default=30, help="made-up pairs a row (default 30)")
    parser.add_argument("--fit", action="store_true", help="fit the confidence anew, on bundles")
    return run_study(run, parser.parse_args(arguments))


def run(options: argparse.Namespace) -> int:
    """Print a row for each zoom in each of three tables, all on the same pairs."""
    if options.fit and options.bundles is None:
        raise ValueError("--fit: made-up pairs are all right, it needs scene bundles")
    filters = MatchFilter(model=options.model), MatchFilter(model=options.model, geometry="fundamental")
    if options.bundles is not None:
        scenes = sound_scenes(options.bundles)
        pairs = list(iterate_pairs(select_pairs(options.bundles, scenes, options.per_scene, options.seed)))
    rows: dict[float, list[Outcome]] = {}
    for zoom in options.zooms:
        if options.bundles is None:
            drawn = [make_pair(seed, zoom) for seed in range(options.seed, options.seed + options.pairs)]
        else:
            drawn = [zoomed(pair, zoom) for pair in pairs]
        rows[zoom] = [run_pair(pair, zoom, *filters) for pair in drawn]
    tables = ((POSES, pose_cells), (VERDICTS, verdict_cells), (FOCALS, focal_cells))
    print("\n\n".join(_table(header, [cells(*row) for row in rows.items()]) for header, cells in tables))
    if options.fit:
        print(
            "\n"
            + describe_fit(
                [outcome for row in rows.values() for outcome in row], filters[0].metadata.choice["verdict"][1]
            )
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
