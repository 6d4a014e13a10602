"""Homographies: how often is the answer right, for warped photographs, small objects in clutter and turning cameras?

Photographs of scikit-image are warped by known homographies, with noise, blur and another brightness, and matched by
real keypoints; the error is the mean distance of the four corners of image 1 in image 2, pixels. ``--decision``
measures instead how often one homography is claimed for unrelated photographs, and found for small objects: by
``geometry="homography"``, and by the answer of a filter that is not told what to look for.

    python -m benchmarks.homographies --kind warp --pairs 60 --detector sift
    python -m benchmarks.homographies --decision
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
import skimage.data
from numpy.typing import NDArray

from mgca_filter import FilterResult, MatchFilter
from mgca_filter.features import create_detector, detect_keypoints, match_descriptors
from mgca_filter.fit.evidence import match_order
from mgca_filter.fit.homography_fit import HomographyOptions, estimate_homography
from mgca_filter.fit.planarity import find_plane
from mgca_filter.geometry.homography import scaled_homography, transfer
from mgca_filter.inputs.attributes import Column
from mgca_filter.inputs.pair import MatchPair, prepare_pair
from mgca_filter.opencv.twins import findHomography
from mgca_filter.tables import markdown_head, markdown_row

Array = NDArray[np.float64]

# fmt: off
PHOTOGRAPHS = (
    "astronaut", "camera", "chelsea", "coffee", "rocket", "brick", "gravel", "grass", "coins", "moon", "page",
)
# fmt: on
KINDS = ("warp", "object", "rotation")
AUC_PX = (3.0, 5.0, 10.0)
RIGHT_PX = 5.0
BOOTSTRAP_DRAWS = 2000
RATIO, TUTORIAL_RATIO = 0.8, 0.75


@dataclass(frozen=True)
class Pair:
    """Keypoints and lists of matches of two images; ``H`` (3, 3) is the truth, None where they are unrelated."""

    kp1: Sequence[cv2.KeyPoint]
    kp2: Sequence[cv2.KeyPoint]
    lists: dict[str, list[tuple[cv2.DMatch, ...]]]
    size1: tuple[int, int]
    size2: tuple[int, int]
    H: Array | None

    def points(self, name: str) -> tuple[Array, Array]:
        """Pixels (N, 2), (N, 2) of a list."""
        rows = self.lists[name]
        return (
            np.array([self.kp1[row[0].queryIdx].pt for row in rows]).reshape(-1, 2),
            np.array([self.kp2[row[0].trainIdx].pt for row in rows]).reshape(-1, 2),
        )

    def corner_error_px(self, H: Array | None) -> float:
        """Mean distance of the corners of image 1; infinite without a homography."""
        if H is None or not np.isfinite(H).all() or self.H is None:
            return float("inf")
        w, h = self.size1
        corners = np.array([[0, 0], [w - 1, 0], [w - 1, h - 1], [0, h - 1]], dtype=np.float64)
        error = float(np.mean(np.linalg.norm(transfer(corners, H) - transfer(corners, self.H), axis=1)))
        return error if np.isfinite(error) else float("inf")


# The images


@lru_cache
def photograph(name: str) -> NDArray[np.uint8]:
    """Grey photograph of scikit-image, its longer side 800 px at most."""
    image = np.asarray(getattr(skimage.data, name)())
    grey = image if image.ndim == 2 else cv2.cvtColor(image[..., :3], cv2.COLOR_RGB2GRAY)
    scale = min(1.0, 800 / max(grey.shape))
    return np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def plane_view(rng: np.random.Generator, size: tuple[int, int], scale: float, max_tilt_deg: float) -> Array:
    """Homography of a picture of ``size`` seen by a camera that is tilted, turned and ``scale`` times as near."""
    w, h = size
    focal = 1.2 * max(size)
    tilt, azimuth = np.radians(rng.uniform(0, max_tilt_deg)), rng.uniform(0, 2 * np.pi)
    turn = rng.uniform(-np.pi, np.pi) if rng.random() < 0.4 else rng.normal(0, 0.2)
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    R = cv2.Rodrigues(axis * tilt)[0] @ cv2.Rodrigues(np.array([0, 0, turn]))[0]
    M = np.column_stack([R[:, 0], R[:, 1], [0, 0, focal / scale]])
    centred = np.array([[1, 0, -(w - 1) / 2], [0, 1, -(h - 1) / 2], [0, 0, 1]])
    return np.asarray(np.diag([focal, focal, 1.0]) @ M @ centred)


def photometric(rng: np.random.Generator, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Another brightness and contrast, blur and noise."""
    values = image.astype(np.float64)
    values = 255 * (np.clip(values, 0, 255) / 255) ** rng.uniform(0.6, 1.6) * rng.uniform(0.6, 1.2)
    values = np.asarray(cv2.GaussianBlur(values, (0, 0), rng.uniform(0.3, 1.5)), dtype=np.float64)
    values += rng.normal(0, rng.uniform(2, 15), values.shape)
    return np.asarray(np.clip(values, 0, 255), dtype=np.uint8)


def make_images(kind: str, seed: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8], Array | None]:
    """Two images and the homography from the first to the second; None for kind ``"unrelated"``."""
    rng = np.random.default_rng(seed)
    first, second = rng.permutation(len(PHOTOGRAPHS))[:2]
    image1, other = photograph(PHOTOGRAPHS[first]), photograph(PHOTOGRAPHS[second])
    h, w = image1.shape
    if kind == "unrelated":
        return image1, photometric(rng, other), None
    if kind == "object":
        canvas = cv2.resize(other, (960, 720), interpolation=cv2.INTER_CUBIC)
        H = plane_view(rng, (w, h), 1.0, 55)
        corners = transfer(np.array([[0, 0], [w - 1, 0], [w - 1, h - 1], [0, h - 1]], dtype=np.float64), H)
        share = rng.uniform(0.05, 0.15)
        zoom = np.sqrt(share * 960 * 720 / abs(cv2.contourArea(corners.astype(np.float32))))
        low, high = zoom * corners.min(axis=0), zoom * corners.max(axis=0)
        move = [rng.uniform(min(-lo, s - hi), max(-lo, s - hi)) for lo, hi, s in zip(low, high, (960, 720))]
        H = np.array([[1, 0, move[0]], [0, 1, move[1]], [0, 0, 1]]) @ np.diag([zoom, zoom, 1.0]) @ H
        pasted = cv2.warpPerspective(image1, H, (960, 720), flags=cv2.INTER_AREA)
        inside = cv2.warpPerspective(np.full((h, w), 255, np.uint8), H, (960, 720)) > 127
        return image1, photometric(rng, np.where(inside, pasted, canvas).astype(np.uint8)), H
    if kind == "rotation":
        focal = rng.uniform(0.8, 1.5) * w
        K = np.array([[focal, 0, (w - 1) / 2], [0, focal, (h - 1) / 2], [0, 0, 1]])
        yaw_pitch = rng.normal(0, 0.18, 2)
        turn = np.asarray(cv2.Rodrigues(np.array([*yaw_pitch, rng.normal(0, 0.15)]))[0], dtype=np.float64)
        H = np.asarray(K @ turn @ np.linalg.inv(K), dtype=np.float64)
        size2 = (w, h)
    else:
        H = plane_view(rng, (w, h), rng.uniform(0.5, 1.3), 60)
        size2 = (w, h)
        shift = np.array([(w - 1) / 2, (h - 1) / 2]) + rng.uniform(-0.15, 0.15, 2) * (w, h)
        H = np.array([[1, 0, shift[0]], [0, 1, shift[1]], [0, 0, 1]]) @ H
    warped = cv2.warpPerspective(image1, H, size2, flags=cv2.INTER_AREA)
    inside = cv2.warpPerspective(np.full((h, w), 255, np.uint8), H, size2) > 127
    backdrop = cv2.resize(other, size2, interpolation=cv2.INTER_AREA)
    return image1, photometric(rng, np.where(inside, warped, backdrop).astype(np.uint8)), H


def make_pair(kind: str, seed: int, detector: str) -> Pair:
    """Images, keypoints and matches of one pair."""
    image1, image2, H = make_images(kind, seed)
    finder = create_detector(detector)
    (kp1, d1), (kp2, d2) = detect_keypoints(image1, finder), detect_keypoints(image2, finder)
    raw = list(match_descriptors(d1, d2))
    norm = cv2.NORM_HAMMING if d1.dtype == np.uint8 else cv2.NORM_L2
    lists: dict[str, list[tuple[cv2.DMatch, ...]]] = {
        "raw": raw,
        **{
            f"ratio {limit}": [row for row in raw if len(row) > 1 and row[0].distance < limit * row[1].distance]
            for limit in (RATIO, TUTORIAL_RATIO)
        },
        "cross": [(m,) for m in cv2.BFMatcher(norm, crossCheck=True).match(d1, d2)] if len(d1) and len(d2) else [],
    }
    return Pair(kp1, kp2, lists, image1.shape[::-1], image2.shape[::-1], H)


# The rows


def opencv(method: int, threshold: float) -> Callable[[Pair, str], Array | None]:
    """``cv2.findHomography``."""

    def row(pair: Pair, name: str) -> Array | None:
        try:
            H = cv2.findHomography(*pair.points(name), method, threshold)[0]
        except cv2.error:
            return None
        return None if H is None else np.asarray(H, dtype=np.float64)

    return row


def poselib(threshold: float, progressive: bool = False) -> Callable[[Pair, str], Array | None]:
    """PoseLib's estimator; ``progressive`` gives it the order of our scores."""
    from poselib import estimate_homography as estimate

    def row(pair: Pair, name: str) -> Array | None:
        points1, points2 = pair.points(name)
        if len(points1) < 5:
            return None
        if progressive:
            order = scored(pair, name)[1]
            points1, points2 = points1[order], points2[order]
        options = {"max_reproj_error": threshold, "progressive_sampling": progressive, "max_iterations": 5000}
        H, information = estimate(points1, points2, options, {})
        return np.asarray(H) if information["num_inliers"] else None

    return row


_scores: dict[tuple[int, str], tuple[Array, NDArray[np.intp], Array]] = {}
_filter = MatchFilter(method="none")


def scored(pair: Pair, name: str) -> tuple[Array, NDArray[np.intp], Array]:
    """Scores (N,), order (N,) and keypoint frames (N, 2) of a list."""
    key = (id(pair), name)
    if key not in _scores:
        rows = pair.lists[name]
        result = _filter.filter(pair.kp1, pair.kp2, rows, size1=pair.size1, size2=pair.size2)
        encoded = prepare_pair(MatchPair(pair.kp1, pair.kp2, rows)).attributes
        logits = result.info["logits"]
        order = match_order(logits, encoded[:, Column.RATIO], encoded[:, Column.RATIO_KNOWN] > 0)
        turn = np.arctan2(encoded[:, Column.SIN_TURN], encoded[:, Column.COS_TURN])
        frames = np.column_stack([encoded[:, Column.LOG2_SIZE], turn]).astype(np.float64)
        frames[encoded[:, Column.SHAPE_KNOWN] == 0] = np.nan
        _scores[key] = result.scores.astype(np.float64), order, frames
    return _scores[key]


def ours(threshold: float, frames: bool = True, weighted: bool = True) -> Callable[[Pair, str], Array | None]:
    """The network's scores, then the estimator."""

    def row(pair: Pair, name: str) -> Array | None:
        scores, order, own = scored(pair, name)
        fit = estimate_homography(
            np.hstack(pair.points(name)),
            HomographyOptions(threshold=threshold),
            scores if weighted else None,
            order,
            own if frames else None,
        )
        return None if fit is None else fit.H

    return row


_answers: dict[tuple[int, str], FilterResult] = {}
_whole_filter = MatchFilter()


def answered(pair: Pair, name: str) -> FilterResult:
    """The filter's own answer to a list, as a user asks for it: nothing but keypoints, matches and sizes."""
    key = (id(pair), name)
    if key not in _answers:
        _answers[key] = _whole_filter.filter(pair.kp1, pair.kp2, pair.lists[name], size1=pair.size1, size2=pair.size2)
    return _answers[key]


def answer(pair: Pair, name: str) -> Array | None:
    """H as it comes with the statuses ``planar`` and ``pure_rotation``, or in doubt; None with every other."""
    return answered(pair, name).H


def on_kept(estimate: Callable[[Pair, str], Array | None]) -> Callable[[Pair, str], Array | None]:
    """Another estimator on the matches that the filter kept, of pairs for which it gives a homography."""

    def row(pair: Pair, name: str) -> Array | None:
        result = answered(pair, name)
        if result.H is None:
            return None
        kept = [match for match, keep in zip(pair.lists[name], result.mask) if keep]
        return estimate(replace(pair, lists={name: kept}), name)

    return row


def twin(pair: Pair, name: str) -> Array | None:
    """``findHomography`` as a script calls it: bare points."""
    H = findHomography(*pair.points(name), cv2.RANSAC, 3.0)[0]
    return None if H is None else np.asarray(H, dtype=np.float64)


ROWS: dict[str, tuple[str, Callable[[Pair, str], Array | None]]] = {
    "raw, cv2 RANSAC 3": ("raw", opencv(cv2.RANSAC, 3.0)),
    "ratio 0.75, cv2 RANSAC 5": (f"ratio {TUTORIAL_RATIO}", opencv(cv2.RANSAC, 5.0)),
    "raw, cv2 MAGSAC 1": ("raw", opencv(cv2.USAC_MAGSAC, 1.0)),
    "raw, cv2 MAGSAC 3": ("raw", opencv(cv2.USAC_MAGSAC, 3.0)),
    "ratio 0.8, cv2 MAGSAC 1": (f"ratio {RATIO}", opencv(cv2.USAC_MAGSAC, 1.0)),
    "ratio 0.8, cv2 MAGSAC 3": (f"ratio {RATIO}", opencv(cv2.USAC_MAGSAC, 3.0)),
    "cross, cv2 MAGSAC 3": ("cross", opencv(cv2.USAC_MAGSAC, 3.0)),
    "raw, PoseLib 3": ("raw", poselib(3.0)),
    "ratio 0.8, PoseLib 3": (f"ratio {RATIO}", poselib(3.0)),
    "raw, scores + PoseLib 3": ("raw", poselib(3.0, True)),
    "raw, answer": ("raw", answer),
    "kept, cv2 RANSAC 3": ("raw", on_kept(opencv(cv2.RANSAC, 3.0))),
    "kept, cv2 MAGSAC 1": ("raw", on_kept(opencv(cv2.USAC_MAGSAC, 1.0))),
    "kept, cv2 least squares": ("raw", on_kept(opencv(0, 3.0))),
    "kept, PoseLib 1": ("raw", on_kept(poselib(1.0))),
    "kept, PoseLib 3": ("raw", on_kept(poselib(3.0))),
    "raw, ours": ("raw", ours(2.0)),
    "raw, ours, no frames": ("raw", ours(2.0, frames=False)),
    "ratio 0.8, ours": (f"ratio {RATIO}", ours(2.0)),
    "cross, ours": ("cross", ours(2.0)),
    "raw, twin": ("raw", twin),
    "ratio 0.75, twin": (f"ratio {TUTORIAL_RATIO}", twin),
}
REFERENCE = "ratio 0.75, cv2 RANSAC 5"


def auc(errors: Array, limit: float) -> float:
    """Area under the share of errors below x, x from 0 to ``limit``, as a share of 1."""
    return float(np.mean(np.clip(1.0 - errors / limit, 0.0, 1.0)))


HEADER = ["matches, estimator", "AUC@3", "AUC@5", "AUC@10", "within 5 px, %", "AUC@5, difference with 95 % interval"]
DECISIONS = ["pairs", "list", "claimed", "right", "fit alone right", "answer verified", "with a right H", "without H"]


def run_rows(kind: str, pairs: int, detector: str, first_seed: int, words: Sequence[str]) -> None:
    """Print the table of one kind."""
    parts = [word for word in words if word not in ROWS]
    chosen = {
        name: row for name, row in ROWS.items() if not words or name in words or any(part in name for part in parts)
    }
    errors: dict[str, list[float]] = {name: [] for name in chosen}
    for seed in range(first_seed, first_seed + pairs):
        pair = make_pair(kind, seed, detector)
        _scores.clear()
        _answers.clear()
        for name, (matches, estimate) in chosen.items():
            H = estimate(pair, matches)
            errors[name].append(pair.corner_error_px(None if H is None else scaled_homography(H)))
    draws = np.random.default_rng(0).integers(0, pairs, (BOOTSTRAP_DRAWS, pairs))
    print(f"\n{pairs} pairs of kind {kind}, {detector}; differences to '{REFERENCE}':\n")
    print(markdown_head(HEADER))
    base = np.array(errors.get(REFERENCE, np.full(pairs, np.inf)))
    for name, values in errors.items():
        own = np.array(values)
        gain = np.clip(1 - own / RIGHT_PX, 0, 1) - np.clip(1 - base / RIGHT_PX, 0, 1)
        low, high = np.percentile(gain[draws].mean(axis=1), [2.5, 97.5])
        numbers = [f"{100 * auc(own, limit):.1f}" for limit in AUC_PX]
        interval = f"{100 * gain.mean():+.1f} [{100 * low:+.1f}, {100 * high:+.1f}]"
        print(markdown_row([name, *numbers, f"{100 * np.mean(own < RIGHT_PX):.1f}", interval]), flush=True)


def run_decision(pairs: int, detector: str, first_seed: int) -> None:
    """Print how often a homography is claimed for unrelated photographs and found for small objects."""
    print(f"{pairs} pairs a row, {detector}; right within {RIGHT_PX:g} px, per cent:\n")
    print(markdown_head(DECISIONS))
    for kind in ("unrelated", "object", "warp"):
        for name in ("raw", f"ratio {RATIO}", f"ratio {TUTORIAL_RATIO}", "cross"):
            counts = np.zeros(len(DECISIONS) - 2)
            for seed in range(first_seed, first_seed + pairs):
                counts += _decide(make_pair(kind, seed, detector), name)
            print(markdown_row([kind, name, *(f"{100 * count / pairs:.1f}" for count in counts)]), flush=True)


def _decide(pair: Pair, name: str) -> list[bool]:
    """The columns of :data:`DECISIONS` for one list."""
    _scores.clear()
    _answers.clear()
    scores, order, frames = scored(pair, name)
    found = find_plane(np.hstack(pair.points(name)), scores, pair.size1, pair.size2, order=order, frames=frames)
    close = pair.corner_error_px(found.H) < RIGHT_PX
    result = answered(pair, name)
    right = pair.corner_error_px(result.H) < RIGHT_PX
    without = result.verified and result.H is None
    return [found.meaningful, found.meaningful and close, close, result.verified, result.verified and right, without]


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", choices=KINDS, action="append", help="may be repeated; all by default")
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--detector", default="sift", help="sift, orb or akaze")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--rows", nargs="*", default=[], help="only rows whose name is, or contains, one of these")
    parser.add_argument("--decision", action="store_true", help="the decision instead of the accuracy")
    options = parser.parse_args()
    if options.decision:
        run_decision(options.pairs, options.detector, options.first_seed)
        return
    for kind in options.kind or KINDS:
        run_rows(kind, options.pairs, options.detector, options.first_seed, options.rows)


if __name__ == "__main__":
    main()
