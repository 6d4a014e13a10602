"""The filter's own rows, run through its public functions as users call them."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..data.scene_bundle import ScenePair
from ..geometry.cameras import normalize_points
from ..inputs.attributes import MatchAttributes
from ..result import FilterResult
from .baselines import REVISION, Estimator, estimate_from_essential
from .methods import MIN_MATCHES, Answer, FloatArray, PoseEstimate
from .selection import Selection

VARIANTS = {
    "product": "filter_matches, default options, with attributes, intrinsics and image sizes",
    "product poselib": "the same with method='poselib'",
    "product bare": "the same as product without attributes: positions only",
    "network E": "recoverPose on the deep network's essential matrix with the 10 % best-scored matches, no RANSAC",
    "network RANSAC": "findEssentialMat(RANSAC, 1e-3 normalised) on the matches of logit > 0, the papers' protocol",
}
"""Names of the rows and what they run."""

NETWORK_ORDER = "network order"
"""Part of a row's name: the estimator behind it gets the plain matches, best logit first."""

ANSWER_PACKAGES = ("fit", "geometry", "inference", "inputs", "network")
"""Folders of the package whose code decides what the filter answers."""

OTHER_PACKAGES = ("cli", "data", "evaluation", "export", "html_report", "pipelines", "opencv", "training")
"""Folders of the package that only ask for answers; a test holds both lists against the tree."""

BEST_SHARE = 0.1
PAPER_THRESHOLD_NORM = 1e-3


@dataclass(frozen=True)
class ProductMethod:
    """One of :data:`VARIANTS` on the matches that ``selection`` leaves (all of them by default)."""

    variant: str
    selection: Selection = Selection()
    model: str | None = None

    @property
    def name(self) -> str:
        return " + ".join([*self.selection.parts, self.variant])

    @property
    def seeded(self) -> bool:
        """The filter's fit draws by a seed, and is averaged over the same ones as the baselines that take a seed."""
        return self.variant.startswith("product")

    def settings(self) -> dict[str, Any]:
        settings = {
            "revision": REVISION,
            "variant": self.variant,
            "selection": self.selection.settings(),
            **model_settings(self._model, self._options(seed=0)),
        }
        if self.variant == "product poselib":
            import poselib

            settings["poselib"] = poselib.__version__
        return settings

    def run(self, pair: ScenePair, seed: int) -> Answer:
        kept = self.selection.apply(pair)
        rows = np.flatnonzero(kept)
        result = filter_pair(pair, rows, self._model, self._options(seed), bare=self.variant == "product bare")
        logits = np.asarray(result.info["logits"], dtype=np.float64)
        verdict: dict[str, Any] = {}
        if self.variant.startswith("product"):
            estimate = _pose_of_result(result)
            verdict = {"status": result.status.value, "confidence": result.confidence}
        else:
            x1 = normalize_points(pair.points1[rows], pair.K1)
            x2 = normalize_points(pair.points2[rows], pair.K2)
            if self.variant == "network E":
                estimate = pose_without_ransac(result.info.get("network_essential"), logits, x1, x2)
            else:
                estimate = pose_by_paper_protocol(logits, x1, x2)
        # What the selection took away counts as rejected with certainty.
        all_logits, scores = np.full(len(kept), -np.inf), np.zeros(len(kept))
        all_logits[rows], scores[rows] = logits, result.scores
        mask = np.zeros(len(kept), dtype=bool)
        mask[rows] = estimate.inliers
        return Answer(estimate.R, estimate.t, all_logits > 0, mask, estimate.failure, all_logits, scores, **verdict)

    @property
    def _model(self) -> str | None:
        """What a row on a network's own answer asks is one network."""
        return _deep_model(self.model) if self.variant.startswith("network") else self.model

    def _options(self, seed: int) -> dict[str, Any]:
        """What differs from the defaults of ``filter_matches``."""
        if self.variant.startswith("network"):
            return {"method": "none"}
        return {"method": "poselib", "seed": seed} if self.variant == "product poselib" else {"seed": seed}


@dataclass(frozen=True)
class NetworkOrderMethod:
    """A baseline's matches and estimator, sorted by the network's logits in the place of the ratio."""

    selection: Selection
    estimator: Estimator
    model: str | None = None

    @property
    def name(self) -> str:
        return " + ".join([*(self.selection.parts or ["NN"]), NETWORK_ORDER, self.estimator.name])

    @property
    def seeded(self) -> bool:
        return self.estimator.seeded

    def settings(self) -> dict[str, Any]:
        return {
            "revision": REVISION,
            "variant": NETWORK_ORDER,
            "selection": self.selection.settings(),
            "estimator": self.estimator.settings(),
            **model_settings(_deep_model(self.model), {"method": "none"}),
        }

    def run(self, pair: ScenePair, seed: int) -> Answer:
        result = filter_pair(pair, np.arange(len(pair.points1)), _deep_model(self.model), {"method": "none"})
        logits = np.asarray(result.info["logits"], dtype=np.float64)
        scores = np.asarray(result.scores, dtype=np.float64)
        kept = self.selection.apply(pair)
        rows = np.flatnonzero(kept)
        mask = np.zeros(len(kept), dtype=bool)
        if len(rows) < MIN_MATCHES:
            return Answer(None, None, kept, mask, "fewer than 5 matches", logits, scores)
        rows = rows[np.argsort(-logits[rows], kind="stable")]
        estimate = self.estimator.estimate(pair, rows, seed)
        mask[rows] = estimate.inliers
        return Answer(estimate.R, estimate.t, kept, mask, estimate.failure, logits, scores)


def _deep_model(model: str | None) -> str:
    """The model file whose network alone is asked."""
    from ..match_filter import model_path

    return str(model_path()) if model is None else model


def filter_pair(
    pair: ScenePair, rows: NDArray[np.intp], model: str | None, options: dict[str, Any], *, bare: bool = False
) -> FilterResult:
    """What ``filter_matches`` says of the matches ``rows`` (N,); ``bare`` withholds all but their positions."""
    from ..match_filter import filter_matches

    attributes: MatchAttributes | None = None if bare else pair.attributes.take(rows)
    scores = None if bare or pair.match_scores is None else pair.match_scores[rows]
    return filter_matches(
        pair.points1[rows],
        pair.points2[rows],
        None if scores is None else scored_matches(scores),
        K1=pair.K1,
        K2=pair.K2,
        size1=pair.image_size1,
        size2=pair.image_size2,
        attributes=attributes,
        model=model,
        **options,
    )


def scored_matches(scores: NDArray[np.float32]) -> list[cv2.DMatch]:
    """Row i ↔ row i at the distance 1 − score (M,), as OpenCV's ``LightGlueMatcher`` hands its matches over."""
    return [cv2.DMatch(row, row, 1.0 - float(score)) for row, score in enumerate(scores)]


def model_settings(model: str | None, options: dict[str, Any]) -> dict[str, Any]:
    """Hashes and versions that an answer of the filter depends on.

    The filter is opened once here, so that a model that cannot be used stops the run instead of failing every pair.

    Raises:
        ModelError, BackendError, ImportError: as :class:`mgca_filter.MatchFilter`.
    """
    import onnxruntime

    from ..match_filter import MatchFilter, find_models

    MatchFilter(model=model, **options)
    paths = find_models(model)
    return {
        "model": " + ".join(path.name for path in paths),
        "model_sha256": " + ".join(hashlib.sha256(path.read_bytes()).hexdigest() for path in paths),
        "source_sha256": runtime_source_digest(),
        "opencv": cv2.__version__,
        "onnxruntime": onnxruntime.__version__,
    }


def _pose_of_result(result: FilterResult) -> PoseEstimate:
    if result.R is None or result.t is None:
        return PoseEstimate(None, None, result.mask, result.status.value)
    return PoseEstimate(result.R, result.t, result.mask)


def pose_without_ransac(E: FloatArray | None, logits: FloatArray, x1: FloatArray, x2: FloatArray) -> PoseEstimate:
    """Pose by ``recoverPose`` on the network's E (3, 3), the 10 % best-scored of the N matches voting."""
    if E is None:
        return PoseEstimate.failed(len(logits), "no essential matrix from the network")
    count = max(int(np.ceil(BEST_SHARE * len(logits))), MIN_MATCHES)
    best = np.zeros(len(logits), dtype=bool)
    best[np.argsort(-logits, kind="stable")[:count]] = True
    return estimate_from_essential(np.asarray(E, dtype=np.float64), x1, x2, best)


def pose_by_paper_protocol(logits: FloatArray, x1: FloatArray, x2: FloatArray) -> PoseEstimate:
    """Pose by OpenCV's plain RANSAC at 1e-3 on the normalised planes, from the matches of logit > 0."""
    rows = np.flatnonzero(logits > 0)
    if len(rows) < MIN_MATCHES:
        return PoseEstimate.failed(len(logits), "fewer than 5 matches")
    E, mask = cv2.findEssentialMat(
        x1[rows], x2[rows], np.eye(3), method=cv2.RANSAC, prob=0.999, threshold=PAPER_THRESHOLD_NORM
    )
    if E is None or mask is None:
        return PoseEstimate.failed(len(logits), "no model")
    inliers = np.zeros(len(logits), dtype=bool)
    inliers[rows] = mask.ravel() > 0
    return estimate_from_essential(E, x1, x2, inliers)


@lru_cache(maxsize=1)
def runtime_source_digest() -> str:
    """SHA-256 over the sources that an answer depends on, so that results of other code are not taken for its own.

    The modules of the package itself, and, however deep, those of :data:`ANSWER_PACKAGES`.
    """
    package = Path(__file__).resolve().parent.parent
    modules = [*package.glob("*.py"), *(path for name in ANSWER_PACKAGES for path in (package / name).rglob("*.py"))]
    digest = hashlib.sha256()
    for path in sorted(modules):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()
