"""What ``mgca-match`` gives back: summary, picture, JSON and NPZ of one pair of images."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..drawing import Image, MatchPanel, draw_matches, draw_overlay
from ..geometry.cameras import Distortion, Fisheye, Intrinsics, mean_focal_length, resolve_intrinsics
from ..html_report import Truth, write_pair_report
from ..match_images import ImageMatchResult
from ..result import FilterResult, Status
from .compare import BaselineFit, describe_rotation, describe_translation
from .truth import TruePose

# Relative standard deviation from which on an estimated focal length is none.
_POOR_SIGMA = 0.3


@dataclass(frozen=True)
class MatchReport:
    """One run of the command: inputs, answer, and the baselines where they were asked for.

    Attributes:
        path1, path2: the image files; image1, image2: their pixels (h, w, 3) uint8.
        K1, K2: (3, 3) as given or as the EXIF data have it, or None; dist1, dist2: lens distortion as given, or None.
        matched: keypoints, raw matches and the filter's result.
        total_ms: from the images in memory to the result, milliseconds.
        baselines: fits of the estimators alone, or None.
        by_exif: K1 and K2 come from EXIF data.
        truth: the true pose, or None.
    """

    path1: Path
    path2: Path
    image1: Image
    image2: Image
    K1: NDArray[np.float64] | None
    K2: NDArray[np.float64] | None
    matched: ImageMatchResult
    total_ms: float
    baselines: Sequence[BaselineFit] | None = None
    by_exif: bool = False
    dist1: Distortion | None = None
    dist2: Distortion | None = None
    truth: TruePose | None = None

    def with_baselines(self, baselines: Sequence[BaselineFit]) -> MatchReport:
        """The same report with the fits of the estimators alone."""
        return replace(self, baselines=baselines)

    @property
    def result(self) -> FilterResult:
        """The filter's answer."""
        return self.matched.result

    @cached_property
    def indices(self) -> NDArray[np.int64]:
        """Keypoint indices (M, 2) of the raw matches."""
        pairs = [(candidates[0].queryIdx, candidates[0].trainIdx) for candidates in self.matched.matches]
        return np.array(pairs, dtype=np.int64).reshape(-1, 2)

    @cached_property
    def points1(self) -> NDArray[np.float64]:
        """Pixels (M, 2) of the raw matches in image 1."""
        return _pixels(self.matched.keypoints1)[self.indices[:, 0]]

    @cached_property
    def points2(self) -> NDArray[np.float64]:
        """Pixels (M, 2) of the raw matches in image 2."""
        return _pixels(self.matched.keypoints2)[self.indices[:, 1]]

    @property
    def sizes(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """(width, height) of both images."""
        (h1, w1), (h2, w2) = self.image1.shape[:2], self.image2.shape[:2]
        return (w1, h1), (w2, h2)

    @property
    def intrinsics(self) -> str:
        """``"given"``, ``"exif"``, ``"estimated"`` or ``"guessed"``."""
        return "exif" if self.by_exif else str(self.result.info.get("intrinsics"))

    @cached_property
    def cameras(self) -> tuple[Intrinsics, Intrinsics]:
        """Intrinsics and lenses of both images, guessed where none are known."""
        lenses = {"dist1": self.dist1, "dist2": self.dist2}
        size1, size2 = self.sizes
        return resolve_intrinsics(
            self.points1, self.points2, K1=self.K1, K2=self.K2, **lenses, size1=size1, size2=size2
        )

    @cached_property
    def right(self) -> NDArray[np.bool_] | None:
        """Which matches (M,) are right by the true pose; None without one, or without intrinsics."""
        if self.truth is None or self.K1 is None:
            return None
        camera1, camera2 = self.cameras
        normalized = np.hstack([camera1.normalize(self.points1), camera2.normalize(self.points2)])
        return self.truth.right(normalized, mean_focal_length(camera1.K, camera2.K))

    @property
    def filter_ms(self) -> float:
        """Time of the filter alone, from matches to result, milliseconds."""
        return float(self.result.info["timings_ms"]["total"])

    @property
    def found_geometry(self) -> bool:
        """A model explains the pair; with ``method="none"`` nothing was fitted and there is none."""
        fitted = any(model is not None for model in (self.result.F, self.result.R, self.result.H))
        return fitted and (self.result.verified or self.result.status is Status.SUSPICIOUS_INTRINSICS)


def _pixels(keypoints: Sequence[Any]) -> NDArray[np.float64]:
    return np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64).reshape(-1, 2)


def summary(report: MatchReport) -> str:
    """A few lines for a person: matches in, kept, pose, time."""
    result, matched = report.result, report.matched
    count = len(result.mask)
    share = f" ({100.0 * result.num_inliers / count:.1f} %)" if count else ""
    lines = []
    sides = zip((report.path1, report.path2), report.sizes, (matched.keypoints1, matched.keypoints2))
    for path, (width, height), keypoints in sides:
        lines.append(f"{path}: {width} x {height}, {len(keypoints)} keypoints")
    if report.by_exif and report.K1 is not None and report.K2 is not None:
        lines.append(f"focal lengths {report.K1[0, 0]:.0f} and {report.K2[0, 0]:.0f} px, from EXIF data")
    lines.append(f"{count} matches in, {result.num_inliers} kept{share}, status {result.status.value}")
    if result.R is not None:
        sure = (
            ""
            if result.confidence is None
            else f", within 10 deg of the truth with probability {result.confidence:.2f}"
        )
        lines.append(f"rotation {describe_rotation(result.R)}, translation {describe_translation(result.t)}{sure}")
    if report.truth is not None:
        turned, moved = report.truth.errors_deg(result.R, result.t)
        off = [
            f"{name} off by {deg:.2f} deg"
            for name, deg in (("rotation", turned), ("translation", moved))
            if deg is not None
        ]
        if report.right is not None:
            kept = int(np.count_nonzero(report.right & result.mask))
            off.append(f"{kept} of {result.num_inliers} kept matches right, {np.count_nonzero(report.right)} of all")
        lines.append("against the truth: " + (", ".join(off) or "no pose"))
    lines += _focal_lines(report)
    lines.append(f"{report.total_ms:.0f} ms, of which the filter took {report.filter_ms:.0f}")
    return "\n".join(lines)


def _focal_lines(report: MatchReport) -> list[str]:
    """What was taken for the focal length where nobody said it, and what to do."""
    info = report.result.info
    how_to = "--K fx,fy,cx,cy or --K FILE (K.txt, cameras.txt, OpenCV's YAML)"
    if report.intrinsics == "estimated":
        sigma = max(info["focal_sigma"])
        accuracy = f", good to about {100.0 * sigma:.0f} %" if sigma < _POOR_SIGMA else ", which hardly tell it"
        focal = " and ".join(dict.fromkeys(f"{focal:.0f}" for focal in info["focal_px"]))
        lines = [f"focal length {focal} px estimated from the matches{accuracy}: {how_to} makes the pose surer"]
        if info.get("focal_doubt"):
            lines.append("which makes the pose doubtful, and not the kept matches or F")
        return lines
    if report.intrinsics != "guessed":
        return []
    focal = " and ".join(dict.fromkeys(f"{camera.K[0, 0]:.0f}" for camera in report.cameras))
    return [f"focal length {focal} px guessed: F and the kept matches do not need it, R and t do: give {how_to}"]


def picture(report: MatchReport) -> Image:
    """Kept and rejected matches side by side, (H, W, 3) uint8."""
    result = report.result
    facts = (f"{len(result.mask)} matches in", f"{result.num_inliers} kept", f"{report.total_ms:.0f} ms")
    panel = MatchPanel(result.mask, result.status.value, facts, success=result.ok)
    return draw_matches(report.image1, report.image2, report.points1, report.points2, panel)


def overlay(report: MatchReport) -> Image | None:
    """Image 1 warped onto image 2 by the homography, both undistorted where lenses are known; None without one."""
    if report.result.H is None:
        return None
    one, two = report.image1, report.image2
    if report.dist1 is not None or report.dist2 is not None:
        one, two = (_undistorted(image, camera) for image, camera in zip((one, two), report.cameras))
    return draw_overlay(one, two, report.result.H)


def to_json(report: MatchReport) -> str:
    """The report as a JSON object; matrices are nested lists, what does not exist is null.

    ``docs/reference/command-line-output.md`` lists the keys. Numbers are rounded to what they can be relied upon:
    pixels to thousandths, scores and probabilities to four places, milliseconds to hundredths, matrices to nine
    digits.
    """
    result, info = report.result, report.result.info
    mask = result.mask
    document: dict[str, Any] = {
        "version": __version__,
        "image1": _side(report.path1, report.sizes[0], report.matched.keypoints1),
        "image2": _side(report.path2, report.sizes[1], report.matched.keypoints2),
        "status": result.status.value,
        "confidence": _places(result.confidence, 4),
        "verified": result.verified,
        "num_matches": len(mask),
        "num_inliers": result.num_inliers,
        **{name: _digits(getattr(result, name)) for name in ("E", "F", "R", "t", "H")},
        "K1": _digits(report.K1),
        "K2": _digits(report.K2),
        "dist1": _lens(report.dist1),
        "dist2": _lens(report.dist2),
        "homography": _digits(info.get("homography")),
        "intrinsics": report.intrinsics,
        "focal_px": None if "focal_px" not in info else [_places(focal, 2) for focal in info["focal_px"]],
        "assumptions": list(info.get("assumptions", ())),
        "backend": info.get("backend"),
        "model": info.get("model"),
        "model_sha256": info.get("model_sha256"),
        "networks": list(info.get("networks", ())),
        "timings_ms": {
            name: _places(ms, 2)
            for name, ms in {**info["timings_ms"], "filter": report.filter_ms, "total": report.total_ms}.items()
        },
        "kept": {
            "indices": report.indices[mask],
            "points1": _places(report.points1[mask], 3),
            "points2": _places(report.points2[mask], 3),
            "scores": _places(result.scores[mask], 4),
        },
    }
    if report.truth is not None:
        document["truth"] = {
            "R": _digits(report.truth.R),
            "t": _digits(report.truth.t),
            "num_right": None if report.right is None else int(np.count_nonzero(report.right)),
            **_judged(report, result),
        }
    if report.baselines is not None:
        document["comparison"] = [
            {
                "name": fit.name,
                "num_inliers": fit.num_inliers,
                **{name: _digits(getattr(fit, name)) for name in ("E", "R", "t")},
                "fit_ms": _places(fit.fit_ms, 2),
                **({} if report.truth is None else _judged(report, fit)),
            }
            for fit in report.baselines
        ]
    return json.dumps(_plain(document), allow_nan=False)


def _judged(report: MatchReport, answer: FilterResult | BaselineFit) -> dict[str, Any]:
    """How far an answer is off the truth, and how many of the matches that it keeps are right."""
    assert report.truth is not None
    turned, moved = report.truth.errors_deg(answer.R, answer.t)
    right = None if report.right is None else int(np.count_nonzero(report.right & answer.mask))
    return {
        "rotation_error_deg": _places(turned, 3),
        "translation_error_deg": _places(moved, 3),
        "num_inliers_right": right,
    }


def _places(value: Any, places: int) -> Any:
    """Numbers rounded to decimal places; None stays None."""
    return None if value is None else np.round(np.asarray(value, dtype=np.float64), places)


def _digits(matrix: Any) -> Any:
    """Numbers rounded to nine digits each, of a matrix whose entries may differ by orders of magnitude."""
    return None if matrix is None else np.vectorize(lambda x: float(f"{x:.9g}"), otypes=[np.float64])(matrix)


def _lens(lens: Distortion | None) -> Any:
    return {"fisheye": list(vars(lens).values())} if isinstance(lens, Fisheye) else lens


def _side(path: Path, size: tuple[int, int], keypoints: Sequence[Any]) -> dict[str, Any]:
    return {"path": str(path), "width": size[0], "height": size[1], "num_keypoints": len(keypoints)}


def _plain(value: Any) -> Any:
    """Arrays to lists; NaN and infinity, which JSON has no word for, to null."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain(value.tolist())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def write_npz(path: Path, report: MatchReport) -> None:
    """Everything per match, and the models that exist.

    Arrays: ``indices`` (M, 2) int64, ``points1``, ``points2`` (M, 2) float64 pixels, ``scores`` (M,) float32,
    ``mask`` (M,) bool, ``status`` (a string), and of ``E``, ``F``, ``R``, ``t``, ``K1``, ``K2`` those that exist.
    """
    result = report.result
    arrays: dict[str, Any] = {
        "indices": report.indices,
        "points1": report.points1,
        "points2": report.points2,
        "scores": result.scores,
        "mask": result.mask,
        "status": np.array(result.status.value),
    }
    optional = {name: getattr(result, name) for name in ("E", "F", "R", "t")} | {"K1": report.K1, "K2": report.K2}
    arrays.update({name: array for name, array in optional.items() if array is not None})
    with path.open("wb") as file:  # given a name, numpy would append .npz to it
        np.savez_compressed(file, **arrays)


def write_html(path: Path, report: MatchReport, command: str) -> None:
    """The report as one HTML file; ``command`` is what was run. Of distorted images it shows the undistorted ones."""
    result, images = report.result, [report.image1, report.image2]
    if report.dist1 is not None or report.dist2 is not None:
        points = []
        for k, (camera, pixels) in enumerate(zip(report.cameras, (result.points1, result.points2))):
            points.append(camera.project(camera.normalize(pixels)))
            images[k] = _undistorted(images[k], camera)
        result = replace(result, points1=points[0], points2=points[1])
    write_pair_report(
        path,
        images[0],
        images[1],
        result,
        name1=report.path1.name,
        name2=report.path2.name,
        baselines=report.baselines,
        truth=None if report.truth is None else Truth(report.truth.R, report.truth.t),
        command=command,
        K1=report.K1,
        K2=report.K2,
        matches=report.matched.matches,
    )


def _undistorted(image: Image, camera: Intrinsics) -> Image:
    if camera.distortion is None:
        return image
    if isinstance(camera.distortion, Fisheye):
        coefficients = np.array(list(vars(camera.distortion).values()))
        return np.asarray(cv2.fisheye.undistortImage(image, camera.K, coefficients, Knew=camera.K), dtype=np.uint8)
    return np.asarray(cv2.undistort(image, camera.K, camera.distortion), dtype=np.uint8)
