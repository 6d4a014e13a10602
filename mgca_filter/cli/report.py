"""What ``mgca-match`` gives back: summary, picture, JSON and NPZ of one pair of images."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..drawing import Image, MatchPanel, draw_matches
from ..html_report import write_pair_report
from ..match_images import ImageMatchResult
from ..result import FilterResult, Status
from .compare import BaselineFit, describe_rotation, describe_translation

_EXPLAINED = (Status.OK, Status.PLANAR, Status.PURE_ROTATION, Status.SUSPICIOUS_INTRINSICS)
# Only these come with a pose that can be used as it is.
_USABLE = (Status.OK, Status.PLANAR)


@dataclass(frozen=True)
class MatchReport:
    """One run of the command: inputs, answer, and the baselines where they were asked for.

    Attributes:
        path1, path2: the image files; image1, image2: their pixels (h, w, 3) uint8.
        K1, K2: (3, 3) as given or as the EXIF data have it, or None.
        matched: keypoints, raw matches and the filter's result.
        total_ms: from the images in memory to the result, milliseconds.
        baselines: fits of the estimators alone, or None.
        by_exif: K1 and K2 come from EXIF data.
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

    @property
    def filter_ms(self) -> float:
        """Time of the filter alone, from matches to result, milliseconds."""
        return float(self.result.info["timings_ms"]["total"])

    @property
    def found_geometry(self) -> bool:
        """A model explains the pair; with ``method="none"`` nothing was fitted and there is none."""
        fitted = any(model is not None for model in (self.result.F, self.result.R, self.result.H))
        return fitted and self.result.status in _EXPLAINED


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
        guessed = report.intrinsics == "guessed"
        remark = ", focal length guessed: trust F rather than the pose" if guessed else ""
        lines.append(f"rotation {describe_rotation(result.R)}, translation {describe_translation(result.t)}{remark}")
    lines.append(f"{report.total_ms:.0f} ms, of which the filter took {report.filter_ms:.0f}")
    return "\n".join(lines)


def picture(report: MatchReport) -> Image:
    """Kept and rejected matches side by side, (H, W, 3) uint8."""
    result = report.result
    facts = (f"{len(result.mask)} matches in", f"{result.num_inliers} kept", f"{report.total_ms:.0f} ms")
    panel = MatchPanel(result.mask, result.status.value, facts, success=result.status in _USABLE)
    return draw_matches(report.image1, report.image2, report.points1, report.points2, panel)


def to_json(report: MatchReport) -> str:
    """The report as a JSON object; matrices are nested lists, what does not exist is null.

    Conventions: X2 = R X1 + t, x2ᵀ E x1 = 0 on the normalised planes, p2ᵀ F p1 = 0 in pixels. ``kept`` lists the
    kept matches: keypoint indices, pixels and scores, one list each.
    """
    result, info = report.result, report.result.info
    mask = result.mask
    document: dict[str, Any] = {
        "version": __version__,
        "image1": _side(report.path1, report.sizes[0], report.matched.keypoints1),
        "image2": _side(report.path2, report.sizes[1], report.matched.keypoints2),
        "status": result.status.value,
        "num_matches": len(mask),
        "num_inliers": result.num_inliers,
        **{name: getattr(result, name) for name in ("E", "F", "R", "t")},
        "K1": report.K1,
        "K2": report.K2,
        "homography": info.get("homography"),
        "intrinsics": report.intrinsics,
        "assumptions": list(info.get("assumptions", ())),
        "backend": info.get("backend"),
        "model": info.get("model"),
        "model_sha256": info.get("model_sha256"),
        "timings_ms": {**info["timings_ms"], "filter": report.filter_ms, "total": report.total_ms},
        "kept": {
            "indices": report.indices[mask],
            "points1": report.points1[mask],
            "points2": report.points2[mask],
            "scores": result.scores[mask],
        },
    }
    if report.baselines is not None:
        document["comparison"] = [
            {"name": fit.name, "num_inliers": fit.num_inliers, "E": fit.E, "R": fit.R, "t": fit.t, "fit_ms": fit.fit_ms}
            for fit in report.baselines
        ]
    return json.dumps(_plain(document), allow_nan=False)


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
    """The report as one HTML file; ``command`` is what was run."""
    write_pair_report(
        path,
        report.image1,
        report.image2,
        report.result,
        name1=report.path1.name,
        name2=report.path2.name,
        baselines=report.baselines,
        command=command,
        K1=report.K1,
        K2=report.K2,
        matches=report.matched.matches,
    )
