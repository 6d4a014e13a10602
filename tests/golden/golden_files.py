"""The golden files: what goes into the filter and what it answers, readable from Python and C++."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime

import mgca_filter
from mgca_filter import FilterResult
from mgca_filter.geometry.epipolar import pose_error_deg
from mgca_filter.inputs.attributes import MatchAttributes

FOLDER = Path(__file__).parent
# Another version of OpenCV draws other samples, as another seed does: what is asked of masks and poses across versions.
MIN_IOU, MAX_POSE_DEG = 0.98, 0.1
_DECIMALS = 5
# A case is stable where this many other seeds change nothing by more than this part of what is allowed.
_OTHER_SEEDS, _SHARE = 4, 0.7


@dataclass(frozen=True)
class GoldenInput:
    """One pair.

    Attributes:
        name: of the file.
        keypoints1, keypoints2: rows (x, y, size, angle) of ``cv2.KeyPoint``, or (x, y) of bare points; null = NaN.
        matches: rows (query, train), (query, train, distance) or (…, second distance), or empty; None = row i matches
            row i.
        K1, K2, dist1, dist2, size1, size2, attributes, resolution: as the arguments of the filter.
        fisheye1: coefficients of a fisheye, in the place of dist1.
    """

    name: str
    keypoints1: list[list[float | None]]
    keypoints2: list[list[float | None]]
    matches: list[list[float | None]] | None
    K1: list[list[float]] | None = None
    K2: list[list[float]] | None = None
    dist1: list[float] | None = None
    dist2: list[float] | None = None
    size1: list[float] | None = None
    size2: list[float] | None = None
    attributes: dict[str, list[Any]] | None = None
    fisheye1: list[float] | None = None
    resolution: float = 1.0

    @classmethod
    def read(cls, path: Path) -> GoldenInput:
        return cls(**json.loads(path.read_text(encoding="utf-8")))

    def arguments(self) -> dict[str, Any]:
        """The arguments of :func:`mgca_filter.filter_matches`."""
        known = None
        if self.attributes is not None:
            kinds = {"best": np.bool_}
            known = MatchAttributes(
                **{name: np.array(v, dtype=kinds.get(name, np.float32)) for name, v in self.attributes.items()}
            )
        cameras = {name: getattr(self, name) for name in ("K1", "K2", "dist1", "dist2", "size1", "size2")}
        arrays: dict[str, Any] = {
            name: None if value is None else np.array(value, float) for name, value in cameras.items()
        }
        if self.fisheye1 is not None:
            arrays["dist1"] = mgca_filter.Fisheye(*self.fisheye1)
        return {
            "resolution": self.resolution,
            "kp1": _keypoints(self.keypoints1),
            "kp2": _keypoints(self.keypoints2),
            "matches": _matches(self.matches),
            "attributes": known,
            **arrays,
        }


@dataclass(frozen=True)
class Case:
    """An input with options of the filter."""

    name: str
    input: str
    options: dict[str, Any] = field(default_factory=dict)


def _keypoints(rows: list[list[float | None]]) -> Any:
    values = np.array([[np.nan if x is None else x for x in row] for row in rows], dtype=float).reshape(len(rows), -1)
    if values.shape[1] == 2:
        return values
    return [cv2.KeyPoint(float(x), float(y), float(size), float(angle)) for x, y, size, angle in values]


def _matches(rows: list[list[Any]] | None) -> Any:
    if rows is None:
        return None
    if not rows:
        return []
    longest = max(len(row) for row in rows)
    if longest == 2:
        return np.array(rows, dtype=np.intp)
    if longest == 3:
        return [cv2.DMatch(*row) for row in rows]
    knn = []
    for row in rows:
        first = [cv2.DMatch(row[0], row[1], row[2])] if row else []
        knn.append(first + ([cv2.DMatch(row[0], 0, row[3])] if len(row) == 4 else []))
    return knn


def answer(case: Case, golden: GoldenInput, seed: int = 0) -> FilterResult:
    """The filter's answer with the shipped model."""
    options = {**case.options, "seed": case.options.get("seed", 0) + seed}
    return mgca_filter.filter_matches(**golden.arguments(), **options)


def run_case(case: Case, golden: GoldenInput, stable: bool | None = None) -> dict[str, Any]:
    """The answer and whether it is a stable one, ready for JSON; ``stable`` where that is known."""
    result = answer(case, golden)
    if stable is None:
        stable = all(_agree(result, answer(case, golden, seed)) for seed in range(1, _OTHER_SEEDS + 1))
    return {**describe(result), "stable": stable}


def _agree(a: FilterResult, b: FilterResult) -> bool:
    if a.status != b.status or iou(a.mask, b.mask) < 1.0 - _SHARE * (1.0 - MIN_IOU):
        return False
    if a.R is None or b.R is None or a.t is None or b.t is None or a.info["intrinsics"] == "guessed":
        return (a.R is None) == (b.R is None)
    return pose_error_deg(a.R, a.t, b.R, b.t) < _SHARE * MAX_POSE_DEG


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two masks; 1 where both are empty."""
    union = np.count_nonzero(a | b)
    return 1.0 if union == 0 else float(np.count_nonzero(a & b) / union)


def describe(result: FilterResult) -> dict[str, Any]:
    """A result as the golden files hold it."""

    def numbers(value: Any) -> list[float] | None:
        return None if value is None else [float(f"{x:.12g}") for x in np.ravel(value)]

    return {
        "opencv": cv2.__version__,
        "onnxruntime": onnxruntime.__version__,
        "status": str(result.status),
        "confidence": None if result.confidence is None else round(result.confidence, _DECIMALS),
        "mask": "".join("01"[int(kept)] for kept in result.mask),
        "scores": [round(float(score), _DECIMALS) for score in result.scores],
        "logits": [round(float(logit), _DECIMALS) for logit in result.info["logits"]],
        "E": numbers(result.E),
        "F": numbers(result.F),
        "R": numbers(result.R),
        "t": numbers(result.t),
        "H": numbers(result.H),
        "origin": result.info["origin"],
        "ended": result.info["ended"],
        "num_network_matches": result.info["num_network_matches"],
        "networks": result.info["networks"],
        "intrinsics": result.info["intrinsics"],
        "assumptions": result.info["assumptions"],
        "support": result.info.get("support"),
        "focal_factor": result.info.get("focal_factor"),
        "focal_px": numbers(result.info.get("focal_px")),
        "focal_sigma": numbers(result.info.get("focal_sigma")),
        "translation_sigma_deg": result.info.get("translation_sigma_deg"),
        "mirrored": bool(result.info.get("mirrored")),
    }
