"""The report of one pair: images, matches, geometry, comparison and reasons in one HTML file."""

from __future__ import annotations

import datetime
import math
import tempfile
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import __version__
from ..atomic_file import replaced_when_done
from ..drawing import as_bgr
from ..geometry.cameras import Intrinsics, mean_focal_length, normalize_points, resolve_intrinsics
from ..geometry.epipolar import (
    essential_from_pose,
    fundamental_from_essential,
    homogeneous,
    pose_error_deg,
    rotation_error_deg,
    sampson_distance,
    triangulated_depths,
)
from ..geometry.homography import homography_distance
from ..result import FilterResult
from ..verdict_text import describe_verdict
from .embedded import embed_images, pack, pack_mask
from .page import LIMIT_BYTES, build_page

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MAX_MATCHES_SHOWN = 20_000
RIGHT_PX = 3.0
_SCRIPTS = ("shell.js", "matches.js", "viewer.js", "panels.js", "scene.js", "pair.js")
_SPARE_BYTES = 4_000
_SMALLEST_RESIDUAL_PX = 1e-3
_LARGEST_PX = 1e6  # a coordinate beyond comes from broken input, and would take the range of all codes
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


class BaselineLike(Protocol):
    """What another method made of the same matches; any object with these attributes serves."""

    @property
    def name(self) -> str:
        """How the report calls the method."""

    @property
    def mask(self) -> NDArray[np.bool_]:
        """bool (M,), the matches that it keeps."""

    @property
    def R(self) -> NDArray[np.float64] | None:
        """(3, 3), or None."""

    @property
    def t(self) -> NDArray[np.float64] | None:
        """(3,), or None."""

    @property
    def fit_ms(self) -> float | None:
        """Its time, milliseconds, or None."""


@dataclass(frozen=True)
class Baseline:
    """A :class:`BaselineLike` for callers who hold a mask."""

    name: str
    mask: NDArray[np.bool_]
    R: NDArray[np.float64] | None = None
    t: NDArray[np.float64] | None = None
    fit_ms: float | None = None


@dataclass(frozen=True)
class Truth:
    """The true geometry of a pair; one of these is enough.

    Attributes:
        R, t: (3, 3) and (3,) with ``X2 = R X1 + t``; the length of ``t`` is ignored.
        E: (3, 3) on the normalised planes. F: (3, 3) in pixels.
    """

    R: ArrayLike | None = None
    t: ArrayLike | None = None
    E: ArrayLike | None = None
    F: ArrayLike | None = None


def write_pair_report(
    path: str | Path,
    image1: NDArray[np.uint8],
    image2: NDArray[np.uint8],
    result: FilterResult,
    *,
    name1: str = "image 1",
    name2: str = "image 2",
    baselines: Sequence[BaselineLike] | None = None,
    truth: Truth | None = None,
    command: str = "",
    K1: ArrayLike | None = None,
    K2: ArrayLike | None = None,
    matches: Sequence[Any] | NDArray[Any] | None = None,
) -> Path:
    """Write a self-contained HTML report of one pair, about one megabyte at most.

    Args:
        path: the file to write.
        image1, image2: the images whose pixels the matches are in, (h, w), (h, w, 3) BGR or (h, w, 4) BGRA uint8.
        result: the filter's answer.
        name1, name2: what the report calls the images; any text.
        baselines: what other methods keep of the same matches, for the comparison.
        truth: the true geometry: matches within 3 pixels (Sampson distance) of it count as right.
        command: what was run, to be shown.
        K1, K2: (3, 3) intrinsics as the filter had them, ``K1`` alone for both images. Where the filter guessed, the
            report guesses alike; where they were given to it and are missing here, the report has no 3D view.
        matches: all putative matches as they went into the filter; rows of ``knnMatch`` show their distance ratio. By
            default the kept ones, ``result.matches``, tell theirs.

    Returns:
        ``path``. Of more than 20 000 matches the kept ones and an even sample of the others are in the file.

    Raises:
        ValueError: an image is empty or no uint8 image, or lengths differ; the message names the argument.
        OSError: the file cannot be written.
    """
    images = (as_bgr(image1, "image1"), as_bgr(image2, "image2"))
    _check_lengths(result, baselines or (), matches)
    sizes = ((images[0].shape[1], images[0].shape[0]), (images[1].shape[1], images[1].shape[0]))
    data = _Pair(result, sizes, (K1, K2), baselines or (), truth, matches).describe()
    data |= {"names": [name1, name2], "sizes": sizes, "why": {**data["why"], "facts": _facts(result, command)}}
    verdict = describe_verdict(
        str(result.status),
        guessed=result.info.get("intrinsics") == "guessed",
        confidence=getattr(result, "confidence", None),
        focal_factor=result.info.get("focal_factor"),
        mirrored=bool(result.info.get("mirrored")),
        focal_doubt=bool(result.info.get("focal_doubt")),
    )
    words = {
        "tone": verdict.tone,
        "headline": verdict.headline,
        "advice": verdict.advice,
        "name1": name1,
        "name2": name2,
        "status": str(result.status).replace("_", " "),
        "counts": f"{result.num_inliers:,} of {len(result.mask):,} matches kept".replace(",", "\u202f"),
    }
    title = f"{name1} and {name2}: {words['status']}"
    frame = len(build_page(title, "pair.html", words, _SCRIPTS, data).encode("utf-8"))
    data["images"] = embed_images(images, LIMIT_BYTES - frame - _SPARE_BYTES)
    page = build_page(title, "pair.html", words, _SCRIPTS, data)
    path = Path(path)
    with replaced_when_done(path) as partial:
        partial.write_text(page, encoding="utf-8")
    return path


def show(result: FilterResult, image1: NDArray[np.uint8], image2: NDArray[np.uint8], **options: Any) -> Path:
    """Write a report into a temporary file and open it in the browser; returns the file, which stays.

    ``options`` are those of :func:`write_pair_report`, which says what raises. Where there is no browser the file is
    written all the same.
    """
    path = Path(tempfile.mkdtemp(prefix="mgca_filter-")) / "pair.html"
    write_pair_report(path, image1, image2, result, **options)
    webbrowser.open(path.as_uri())
    return path


def _check_lengths(
    result: FilterResult, baselines: Sequence[BaselineLike], matches: Sequence[Any] | NDArray[Any] | None
) -> None:
    count = len(result.mask)
    if len(result.points1) != count or len(result.points2) != count:
        raise ValueError(f"result: expected points1 and points2 of {count} rows, one for each match")
    for baseline in baselines:
        if np.shape(baseline.mask) != (count,):
            raise ValueError(f"baselines: {baseline.name}: expected a mask of length {count}")
    if matches is not None and len(matches) != count:
        raise ValueError(f"matches: expected {count} rows as in result.mask, got {len(matches)}")


class _Pair:
    """A pair on its way into the page: what the scripts draw, as plain values."""

    def __init__(
        self,
        result: FilterResult,
        sizes: tuple[tuple[int, int], tuple[int, int]],
        intrinsics: tuple[ArrayLike | None, ArrayLike | None],
        baselines: Sequence[BaselineLike],
        truth: Truth | None,
        matches: Sequence[Any] | NDArray[Any] | None,
    ) -> None:
        self.result, self.sizes, self.baselines, self.truth = result, sizes, baselines, truth
        self.ratios = _ratios(result, matches)
        points = np.hstack([result.points1, result.points2]).astype(np.float64)  # (M, 4)
        points[~(np.abs(points) < _LARGEST_PX).all(axis=1)] = np.nan
        self.points = points
        self.cameras = self._cameras(*intrinsics)
        self.residual_px = self._residuals()
        self.true_F = None if truth is None else _true_fundamental(truth, self.cameras)
        self.true_px = None if self.true_F is None else sampson_distance(points, self.true_F)
        self.rows = _shown_rows(result.mask, [np.asarray(b.mask, dtype=bool) for b in baselines])

    def describe(self) -> dict[str, Any]:
        """Everything but names, images and what ran."""
        result, rows = self.result, self.rows
        homography = result.info.get("homography")
        # Decades: residuals reach from thousandths of a pixel to the width of the image.
        log_residual = np.log10(np.maximum(self.residual_px[rows], _SMALLEST_RESIDUAL_PX))
        columns = {name: self.points[rows, i] for i, name in enumerate(("x1", "y1", "x2", "y2"))}
        columns |= {"score": result.scores[rows], "log_residual": log_residual, "ratio": self.ratios[rows]}
        return {
            "rows": rows,
            "total": len(result.mask),
            "columns": {name: pack(column) for name, column in columns.items()},
            "mask": pack_mask(result.mask[rows]),
            "right": None if self.true_px is None else pack_mask(self.true_px[rows] < RIGHT_PX),
            "right_px": RIGHT_PX,
            "F": result.F,
            "true_F": self.true_F,
            "homography": homography,
            "by_homography": result.F is None and homography is not None,
            "methods": self._methods(),
            "scene": self._scene(),
            "why": self._reasons(),
        }

    def _cameras(self, K1: ArrayLike | None, K2: ArrayLike | None) -> tuple[Intrinsics, Intrinsics] | None:
        """Intrinsics that the filter had, or None where the caller does not say."""
        if K1 is None and self.result.info.get("intrinsics") == "given":
            return None
        points1, points2 = self.points[:, :2], self.points[:, 2:]
        return resolve_intrinsics(points1, points2, K1=K1, K2=K2, size1=self.sizes[0], size2=self.sizes[1])

    def _normalized(self, cameras: tuple[Intrinsics, Intrinsics]) -> Array:
        return np.hstack([cameras[0].normalize(self.points[:, :2]), cameras[1].normalize(self.points[:, 2:])])

    def _residuals(self) -> Array:
        """Distance (M,) to the model that made the mask, pixels; NaN where there is none."""
        result, homography = self.result, self.result.info.get("homography")
        if result.F is not None:
            # As the verdict measures it: with known intrinsics on the normalised planes.
            if self.cameras is not None and not self.cameras[0].guessed and result.E is not None:
                focal_px = mean_focal_length(self.cameras[0].K, self.cameras[1].K)
                return sampson_distance(self._normalized(self.cameras), result.E) * focal_px
            return sampson_distance(self.points, result.F)
        if homography is not None:
            H = np.asarray(homography, dtype=np.float64)
            return homography_distance(self.points[:, :2], self.points[:, 2:], H)
        return np.full(len(result.mask), np.nan)

    def _methods(self) -> list[dict[str, Any]]:
        """The filter and its baselines: what each keeps, how much of it is right, how far its pose is off."""
        result, truth = self.result, self.truth
        total_ms = result.info.get("timings_ms", {}).get("total")
        ours = Baseline("mgca_filter", result.mask, result.R, result.t, total_ms)
        listed = []
        for method in (ours, *self.baselines):
            mask = np.asarray(method.mask, dtype=bool)
            kept = int(np.count_nonzero(mask))
            right = None if self.true_px is None else int(np.count_nonzero(mask & (self.true_px < RIGHT_PX)))
            error = None
            if truth is not None and truth.R is not None and truth.t is not None and method.R is not None:
                error = None if method.t is None else pose_error_deg(method.R, method.t, truth.R, truth.t)
            row = {"name": str(method.name), "kept": kept, "right": right, "error_deg": error, "ms": method.fit_ms}
            listed.append({**row, "wrong": None if right is None else kept - right, "mask": pack_mask(mask[self.rows])})
        return listed

    def _scene(self) -> dict[str, Any] | None:
        """Cameras and triangulated points in the frame of camera 1, the baseline as unit; None without a rotation."""
        result, cameras, truth = self.result, self.cameras, self.truth
        if result.R is None or cameras is None:
            return None
        scene: dict[str, Any] = {
            "R": result.R,
            "t": np.zeros(3) if result.t is None else result.t,
            "has_baseline": result.t is not None,
            "guessed": cameras[0].guessed,
            "corners": [_corner_rays(camera, size) for camera, size in zip(cameras, self.sizes)],
            "focal_px": [float((camera.K[0, 0] + camera.K[1, 1]) / 2) for camera in cameras],
            "rotation_deg": rotation_error_deg(result.R, np.eye(3)),
            "truth": None,
            "rows": [],
            "points": [],
        }
        if truth is not None and truth.R is not None and truth.t is not None:
            t = np.asarray(truth.t, dtype=np.float64).ravel()
            scene["truth"] = {"R": np.asarray(truth.R), "t": t / max(float(np.linalg.norm(t)), 1e-12)}
        if result.t is not None:
            shown = np.flatnonzero(result.mask[self.rows])
            scene |= _triangulate(self._normalized(cameras)[self.rows[shown]], result.R, result.t, shown)
        return scene

    def _reasons(self) -> dict[str, Any]:
        """From the raw matches to the kept ones, times, and what was assumed."""
        result, info = self.result, self.result.info
        accepted = info.get("num_accepted")
        asked = info.get("ended") != "before the network"
        funnel = [
            ("raw", len(result.mask), "putative matches that came in"),
            ("candidates", info.get("num_network_matches") if asked else None, "of them went through the network"),
            (
                "accepted",
                accepted,
                "of those it takes for right" if asked else "of them agree with what they explain alone",
            ),
            (
                "supporting",
                None if accepted is None else info.get("support"),
                "of the accepted ones agree with the fit",
            ),
            ("kept", result.num_inliers, "of all raw matches agree with the final model: each was tested again"),
        ]
        matrices = {name: getattr(result, name) for name in ("E", "F", "R", "t")}
        return {
            "funnel": [step for step in funnel if step[1] is not None],
            "times_ms": {name: ms for name, ms in info.get("timings_ms", {}).items() if name != "total"},
            "assumptions": [str(sentence) for sentence in info.get("assumptions", ())],
            "left_out": len(result.mask) - len(self.rows),
            "matrices": {name: matrix for name, matrix in matrices.items() if matrix is not None},
        }


def _true_fundamental(truth: Truth, cameras: tuple[Intrinsics, Intrinsics] | None) -> Array | None:
    """F (3, 3) in pixels of the true geometry; None where it needs intrinsics and there are none but guessed ones."""
    if truth.F is not None:
        return np.asarray(truth.F, dtype=np.float64)
    E = truth.E
    if E is None and truth.R is not None and truth.t is not None:
        E = essential_from_pose(truth.R, truth.t)
    if E is None or cameras is None or cameras[0].guessed:
        return None
    return fundamental_from_essential(E, cameras[0].K, cameras[1].K)


def _triangulate(normalized: Array, R: Array, t: Array, rows: NDArray[np.intp]) -> dict[str, Any]:
    """Points of correspondences (N, 4) in the frame of camera 1, those in front of both cameras, and their ``rows``."""
    x1, x2 = normalized[:, :2], normalized[:, 2:]
    depth1, depth2 = triangulated_depths(normalized, R, t)
    in_front = np.isfinite(depth1) & np.isfinite(depth2) & (depth1 > 0) & (depth2 > 0)
    rays1, rays2 = homogeneous(x1[in_front]) @ R.T, homogeneous(x2[in_front])
    cosine = np.sum(rays1 * rays2, axis=1) / np.linalg.norm(rays1, axis=1) / np.linalg.norm(rays2, axis=1)
    parallax_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return {
        "rows": rows[in_front],
        "points": np.round(homogeneous(x1[in_front]) * depth1[in_front, None], 3),
        "behind": int(np.count_nonzero(~in_front)),
        "parallax_deg": float(np.median(parallax_deg)) if in_front.any() else None,
    }


def _corner_rays(camera: Intrinsics, size: tuple[int, int]) -> Array:
    """Normalised corners (4, 2) of an image, clockwise from the top left."""
    right, bottom = size[0] - 0.5, size[1] - 0.5
    return normalize_points([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]], camera.K)


def _ratios(result: FilterResult, matches: Sequence[Any] | NDArray[Any] | None) -> Array:
    """Distance to the nearest neighbour over that to the second (M,), NaN where a match does not know it."""
    ratios = np.full(len(result.mask), np.nan)
    known = list(range(len(ratios))) if matches is not None else np.flatnonzero(result.mask).tolist()
    for row, candidates in zip(known, result.matches if matches is None else matches):
        if isinstance(candidates, (tuple, list)) and len(candidates) > 1 and isinstance(candidates[0], cv2.DMatch):
            second = candidates[1].distance
            ratios[row] = candidates[0].distance / second if second > 0 else math.nan
    return ratios


def _shown_rows(mask: Mask, others: Sequence[Mask]) -> NDArray[np.intp]:
    """Rows in the file: all, or what somebody keeps and an even sample of the rest."""
    if len(mask) <= MAX_MATCHES_SHOWN:
        return np.arange(len(mask))
    wanted = np.any([mask, *others], axis=0)
    if np.count_nonzero(wanted) > MAX_MATCHES_SHOWN:
        wanted = mask
    kept = _even_sample(np.flatnonzero(wanted), MAX_MATCHES_SHOWN)
    return np.sort(np.concatenate([kept, _even_sample(np.flatnonzero(~wanted), MAX_MATCHES_SHOWN - len(kept))]))


def _even_sample(rows: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    return rows if len(rows) <= count else rows[np.linspace(0, len(rows) - 1, count).astype(np.intp)]


def _facts(result: FilterResult, command: str) -> list[tuple[str, Any]]:
    """What ran: names and values, those that are known."""
    info = result.info
    facts = [
        ("Model", " on ".join(str(info[key]) for key in ("model", "backend") if info.get(key))),
        ("Model file", " + ".join(digest[:16] for digest in str(info.get("model_sha256", "")).split(" + "))),
        ("Networks asked", (" + ".join(info["networks"]) or "none") if "networks" in info else None),
        ("Intrinsics", info.get("intrinsics")),
        ("Origin of the fit", info.get("origin")),
        ("As good by chance", _power_of_ten(info.get("log10_false_alarms"))),
        ("Version", f"mgca_filter {__version__}, OpenCV {cv2.__version__}"),
        ("Written", datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M")),
        ("Command", command),
    ]
    return [fact for fact in facts if fact[1]]


def _power_of_ten(exponent: Any) -> str | None:
    if exponent is None or not math.isfinite(exponent):
        return None
    return "10" + f"{exponent:.0f}".translate(_SUPERSCRIPT)
