"""The baselines: a classical test of the matches, then a robust estimator of a public library.

Each estimator is called as its documentation says, and runs at the threshold that is best for it. Thresholds are
pixels of the pair; the normalised threshold is px / mean focal length.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any, ClassVar, Protocol

import cv2
import numpy as np

from ..data.scene_bundle import ScenePair
from ..geometry.cameras import mean_focal_length, normalize_points
from ..geometry.epipolar import project_to_essential
from .methods import MIN_MATCHES, Answer, BoolArray, FloatArray, PoseEstimate
from .selection import Selection

REVISION = 1
"""Part of every stored result's key: raise it when a change in this package alters what a baseline gives."""

NEVER_CONFIDENT = 1.0 - 1e-9
"""Confidence of time-matched rows, at which an estimator uses up its iterations instead of stopping early."""

UP_TO = "up to"
"""Words of a row's name, in front of a number of iterations: no more than these."""

LIST_ORDER = "list order"
"""Part of a row's name: the estimator behind it gets the matches as they are listed, whatever is known of them."""

INFINITE_DEPTH = 1e9
"""``recoverPose`` drops points farther than 50 baselines unless told otherwise."""


def estimate_from_essential(E: Any, x1: FloatArray, x2: FloatArray, inliers: BoolArray) -> PoseEstimate:
    """A baseline's pose from what its estimator returned, by ``cv2.recoverPose`` on the inliers.

    Args:
        E: None, (3, 3), or several solutions stacked to (3k, 3), of which the one with most points in front of both
            cameras is taken.
        x1, x2: (N, 2) on the normalised image planes.
        inliers: bool (N,), the points that vote; they are returned as they are, whatever their depth.
    """
    count = len(x1)
    if E is None or E.ndim != 2 or E.shape[1] != 3 or len(E) < 3 or not np.isfinite(E).all():
        return PoseEstimate.failed(count, "no model")
    best_votes, best = 0, PoseEstimate.failed(count, "no point in front of both cameras")
    for first in range(0, len(E) - 2, 3):
        model = np.ascontiguousarray(E[first : first + 3])
        voters = inliers.astype(np.uint8)[:, None]
        votes, R, t, _, _ = cv2.recoverPose(model, x1, x2, np.eye(3), distanceThresh=INFINITE_DEPTH, mask=voters)
        rotation, direction = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64).ravel()
        if votes > best_votes and np.isfinite(rotation).all() and np.isfinite(direction).all():
            best_votes, best = votes, PoseEstimate(rotation, direction, inliers)
    return best


class Estimator(Protocol):
    """A robust estimator with its settings."""

    @property
    def name(self) -> str:
        """Words of the row's name, threshold included."""

    @property
    def ordered(self) -> bool:
        """Whether the best matches must come first."""

    @property
    def seeded(self) -> bool:
        """Whether ``seed`` is used."""

    def settings(self) -> dict[str, Any]:
        """Options and library version."""

    def estimate(self, pair: ScenePair, rows: Any, seed: int) -> PoseEstimate:
        """Pose from the matches ``rows`` (N,) of a pair, N >= 5."""


@dataclass(frozen=True)
class OpenCvEstimator:
    """``cv2.findEssentialMat`` on normalised points, then ``cv2.recoverPose``; OpenCV fixes its seeds itself.

    LMEDS has no threshold.
    """

    kind: str
    threshold_px: float | None
    confidence: float = 0.9999
    max_iterations: int = 5000

    FLAGS: ClassVar[dict[str, int]] = {
        "RANSAC": cv2.RANSAC,
        "LMEDS": cv2.LMEDS,
        "MAGSAC": cv2.USAC_MAGSAC,
        "ACCURATE": cv2.USAC_ACCURATE,
        "PROSAC": cv2.USAC_PROSAC,
    }
    seeded: ClassVar[bool] = False

    @property
    def name(self) -> str:
        threshold = "" if self.threshold_px is None else f" {self.threshold_px:g} px"
        budget = f" {self.max_iterations} iterations" if self.confidence == NEVER_CONFIDENT else ""
        return f"{self.kind}{threshold}{budget}"

    @property
    def ordered(self) -> bool:
        return self.kind == "PROSAC"

    def settings(self) -> dict[str, Any]:
        return {**asdict(self), "opencv": cv2.__version__}

    def estimate(self, pair: ScenePair, rows: Any, seed: int) -> PoseEstimate:
        x1 = normalize_points(pair.points1[rows], pair.K1)
        x2 = normalize_points(pair.points2[rows], pair.K2)
        E, mask = cv2.findEssentialMat(
            x1,
            x2,
            np.eye(3),
            method=self.FLAGS[self.kind],
            prob=self.confidence,
            threshold=(self.threshold_px or 1.0) / mean_focal_length(pair.K1, pair.K2),
            maxIters=self.max_iterations,
        )
        if E is None or mask is None:
            return PoseEstimate.failed(len(x1), "no model")
        return estimate_from_essential(E, x1, x2, mask.ravel() > 0)


@dataclass(frozen=True)
class PoseLibEstimator:
    """``poselib.estimate_relative_pose`` at its defaults but for threshold, seed and ``progressive_sampling``.

    ``iterations`` makes it a time-matched row: that many, whatever was found before. ``max_iterations`` takes the place
    of PoseLib's own limit of 100 000.
    """

    threshold_px: float
    progressive: bool = False
    iterations: int | None = None
    max_iterations: int | None = None

    seeded: ClassVar[bool] = True

    @property
    def name(self) -> str:
        budget = "" if self.iterations is None else f" {self.iterations} iterations"
        if self.max_iterations is not None:
            budget = f" {UP_TO} {self.max_iterations} iterations"
        return f"PoseLib {'progressive ' if self.progressive else ''}{self.threshold_px:g} px{budget}"

    @property
    def ordered(self) -> bool:
        return self.progressive

    def settings(self) -> dict[str, Any]:
        import poselib

        options = {key: value for key, value in asdict(self).items() if value is not None}
        return {**options, "poselib": poselib.__version__}

    def estimate(self, pair: ScenePair, rows: Any, seed: int) -> PoseEstimate:
        import poselib

        options = {
            "max_epipolar_error": self.threshold_px,
            "progressive_sampling": self.progressive,
            "seed": seed,
        }
        if self.max_iterations is not None:
            options["max_iterations"] = self.max_iterations
        if self.iterations is not None:
            options |= {"min_iterations": self.iterations, "max_iterations": self.iterations}
        camera1, camera2 = _pinhole(pair.K1, pair.image_size1), _pinhole(pair.K2, pair.image_size2)
        pose, info = poselib.estimate_relative_pose(
            pair.points1[rows], pair.points2[rows], camera1, camera2, options, {}
        )
        t = np.asarray(pose.t, dtype=np.float64)
        # Without a model PoseLib returns the identity, which must not pass for a pose.
        if info["num_inliers"] < MIN_MATCHES or not np.linalg.norm(t) > 0 or not np.isfinite(t).all():
            return PoseEstimate.failed(len(rows), "no model")
        inliers = np.asarray(info["inliers"], dtype=bool)
        return PoseEstimate(np.asarray(pose.R, dtype=np.float64), t / np.linalg.norm(t), inliers)


def _pinhole(K: FloatArray, size: tuple[int, int]) -> dict[str, Any]:
    """PoseLib's camera for intrinsics without skew."""
    parameters = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    return {"model": "PINHOLE", "width": size[0], "height": size[1], "params": [float(value) for value in parameters]}


@dataclass(frozen=True)
class DegensacEstimator:
    """``pydegensac.findFundamentalMatrix`` (Chum et al., CVPR 2005) at its defaults but for threshold and seed.

    It knows no intrinsics: E = K2ᵀ F K1, then ``cv2.recoverPose``. ``iterations`` makes it a time-matched row.
    """

    threshold_px: float
    iterations: int | None = None

    seeded: ClassVar[bool] = True
    ordered: ClassVar[bool] = False
    MIN_MATCHES: ClassVar[int] = 8

    @property
    def name(self) -> str:
        budget = "" if self.iterations is None else f" {self.iterations} iterations"
        return f"DEGENSAC {self.threshold_px:g} px{budget}"

    def settings(self) -> dict[str, Any]:
        import pydegensac  # noqa: F401  (raises ImportError where it is not installed)

        options = {key: value for key, value in asdict(self).items() if value is not None}
        return {**options, "pydegensac": version("pydegensac"), "opencv": cv2.__version__}

    def estimate(self, pair: ScenePair, rows: Any, seed: int) -> PoseEstimate:
        import pydegensac

        if len(rows) < self.MIN_MATCHES:
            return PoseEstimate.failed(len(rows), "fewer than 8 matches")
        budget = {} if self.iterations is None else {"conf": NEVER_CONFIDENT, "max_iters": self.iterations}
        points1, points2 = pair.points1[rows], pair.points2[rows]
        F, mask = pydegensac.findFundamentalMatrix(points1, points2, self.threshold_px, seed=seed, **budget)
        if not np.isfinite(F).all() or not F.any():
            return PoseEstimate.failed(len(rows), "no model")
        E = project_to_essential(pair.K2.T @ F @ pair.K1)
        x1, x2 = normalize_points(points1, pair.K1), normalize_points(points2, pair.K2)
        return estimate_from_essential(E, x1, x2, np.asarray(mask, dtype=bool).ravel())


@dataclass(frozen=True)
class Baseline:
    """A selection of matches followed by a robust estimator.

    An estimator that wants the best matches first gets them in :attr:`ScenePair.order`: by ratio, or by the matcher's
    score; with ``in_list_order`` as they are listed, for lists of which neither is known.
    """

    selection: Selection
    estimator: Estimator
    in_list_order: bool = False

    @property
    def name(self) -> str:
        order = [LIST_ORDER] * self.in_list_order
        return " + ".join([*(self.selection.parts or ["NN"]), *order, self.estimator.name])

    @property
    def seeded(self) -> bool:
        return self.estimator.seeded

    def settings(self) -> dict[str, Any]:
        settings: dict[str, Any] = {
            "revision": REVISION,
            "selection": self.selection.settings(),
            "estimator": self.estimator.settings(),
        }
        if self.in_list_order:
            settings["order"] = LIST_ORDER
        if self.selection.gms:
            settings |= {"opencv": cv2.__version__, "gms_points": "inside the image"}
        return settings

    def run(self, pair: ScenePair, seed: int) -> Answer:
        kept = self.selection.apply(pair)
        rows = np.flatnonzero(kept)
        mask = np.zeros(len(kept), dtype=bool)
        if len(rows) < MIN_MATCHES:
            return Answer(None, None, kept, mask, "fewer than 5 matches")
        if self.estimator.ordered and not self.in_list_order:
            order = pair.order
            if order is None:
                raise ValueError(f"{self.estimator.name} needs the distance ratios of the matches, or their scores")
            rows = rows[np.argsort(order[rows], kind="stable")]
        estimate = self.estimator.estimate(pair, rows, seed)
        mask[rows] = estimate.inliers
        return Answer(estimate.R, estimate.t, kept, mask, estimate.failure)
