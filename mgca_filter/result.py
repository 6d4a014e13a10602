"""What the filter gives back."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .drawing import MatchPanel, draw_matches
from .verdict_text import describe_verdict


class Status(str, enum.Enum):
    """Verdict on a pair of images; only ``OK`` and ``PLANAR`` come with a pose that can be used as it is.

    A status is its word: ``status == "ok"``, ``print(status)`` and ``json.dumps(status)`` all see ``"ok"``.
    """

    OK = "ok"
    TOO_FEW_MATCHES = "too_few_matches"
    NO_GEOMETRY = "no_geometry"
    LOW_SUPPORT = "low_support"
    UNRELATED = "unrelated"
    PLANAR = "planar"
    PURE_ROTATION = "pure_rotation"
    SUSPICIOUS_INTRINSICS = "suspicious_intrinsics"

    def __str__(self) -> str:
        return self.value

    def __format__(self, spec: str) -> str:
        return format(self.value, spec)


# With these a model explains the pair, pose and all; words are found among them as well.
EXPLAINED = frozenset((Status.OK, Status.PLANAR, Status.PURE_ROTATION))


@dataclass(frozen=True, eq=False)
class FilterResult:
    """Answer of :func:`mgca_filter.filter_matches`; M is the number of matches that came in.

    Conventions: ``x2^T E x1 = 0`` on the normalised image planes, ``p2^T F p1 = 0`` in pixels,
    ``X2 = R X1 + t``.

    Attributes:
        mask: bool (M,), in the order of the input: the match agrees with the final model.
        scores: float32 (M,), calibrated probability that the match is an inlier.
        matches: the kept matches, in the type that came in.
        E: (3, 3) float64 essential matrix (two equal singular values, unit Frobenius norm), or None.
        F: (3, 3) float64 fundamental matrix of unit Frobenius norm, or None.
        R, t: (3, 3) rotation and (3,) unit translation, or None.
        H: (3, 3) homography, ``p2 ~ H p1`` in pixels, with H[2, 2] = 1, where one explains the pair (a plane, a camera
            that only turned) or was asked for; else None.
        status: the verdict.
        num_inliers: number of True in ``mask``.
        confidence: calibrated probability that the pose is within 10 degrees of the truth, in rotation and in
            direction; None where there is no pose, or no intrinsics to trust.
        points1, points2: (M, 2) float64 pixels of every match, as they came in; NaN where a row holds no match.
        indices: (M, 2) rows of the keypoints, −1 where a row holds no match.
        info: always ``logits`` (M,) float32, ``timings_ms`` by step, ``backend``, ``model`` and ``model_sha256`` (of
            several networks in the order in which they are asked, " + " between them), ``networks`` (list of the names
            of those that were asked; empty where the pair ended before),
            ``intrinsics`` ("given", "guessed", or "estimated" with ``focal_px``, the focal lengths of both images,
            equal unless the matches ask for two, and ``focal_sigma``, their relative standard deviations),
            ``assumptions`` (list of sentences), ``num_network_matches`` and
            ``network_rows`` (those that entered the first network), ``num_accepted`` (those above the decision
            threshold), ``network_essential`` (3, 3) or None as the last network gave it, ``fitted_essential`` (3, 3) or
            None as the robust fit left it, before the verdict, its ``origin`` (name of the source that proposed it:
            "list", "network", "accepted", "score order", …, "plane"; or "expected best", where many poses explain the
            matches about as well and the answer is the one expected nearest to the truth), where the search ``ended``
            ("before the network", where the scores come from the residuals, "first sources" or "all sources"). Where
            they were measured:
            ``support`` (number of accepted matches that agree), ``log10_false_alarms``, ``translation_sigma_deg``
            (standard deviation of the direction of translation), ``homography`` (the same as ``H``), ``mirrored``
            (True where one of the images was flipped: there is no pose, and H mirrors where the pair is planar),
            ``focal_sigma_deg`` (standard deviation of the pose that comes of that of estimated focal lengths) with
            ``fitted_confidence`` (what ``confidence`` would be if they were known), ``focal_doubt`` (True where they
            alone make the pose doubtful: ``LOW_SUPPORT``, with matches that are right all the same),
            ``focal_factor`` where the matches ask for focal lengths that many times those given (rough, a power of
            1.2).
    """

    mask: NDArray[np.bool_]
    scores: NDArray[np.float32]
    matches: Sequence[Any] | NDArray[np.intp]
    E: NDArray[np.float64] | None
    F: NDArray[np.float64] | None
    R: NDArray[np.float64] | None
    t: NDArray[np.float64] | None
    H: NDArray[np.float64] | None
    status: Status
    num_inliers: int
    confidence: float | None = None
    points1: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    points2: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    indices: NDArray[np.intp] = field(default_factory=lambda: np.zeros((0, 2), dtype=np.intp))
    info: dict[str, Any] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """The geometry may be used as it is: ``status`` is ``OK`` or ``PLANAR``."""
        return self.status in (Status.OK, Status.PLANAR)

    @property
    def verified(self) -> bool:
        """The kept matches may be used, whatever the pose is worth: a model explains the pair.

        With ``OK``, ``PLANAR`` and ``PURE_ROTATION``; and with ``LOW_SUPPORT`` where estimated focal lengths alone make
        the pose doubtful (``info["focal_doubt"]``), of which matches and F know nothing.
        """
        return self.status in EXPLAINED or bool(self.info.get("focal_doubt"))

    def __bool__(self) -> bool:
        """As :attr:`ok`."""
        return self.ok

    @property
    def dmatches(self) -> list[cv2.DMatch]:
        """The kept matches as plain ``cv2.DMatch``, whatever came in: what ``cv2.drawMatches`` takes.

        The distance is the caller's, of a ``knnMatch`` row that of its first candidate; 0 where indices came in.
        """
        kept: list[cv2.DMatch] = []
        for row, (query, train) in zip(self.matches, self.indices[self.mask]):
            match = row if isinstance(row, cv2.DMatch) else row[0]
            kept.append(match if isinstance(match, cv2.DMatch) else cv2.DMatch(int(query), int(train), 0.0))
        return kept

    def relative_pose(self, baseline: float = 1.0) -> NDArray[np.float64] | None:
        """The pose of camera 2 relative to camera 1 as one matrix (4, 4): ``X2 = T X1`` in homogeneous coordinates.

        Args:
            baseline: distance between the camera centres, in the unit that the matrix shall have; two views do not
                tell it, so that it is 1 unless the caller knows better.

        Returns:
            The matrix, float64, or None where the pair has no rotation or no direction of translation.
        """
        if self.R is None or self.t is None:
            return None
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.R, baseline * self.t
        return T

    def draw(self, image1: NDArray[np.uint8], image2: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Picture (H, W, 3) uint8 BGR of kept and rejected matches, side by side.

        Args:
            image1, image2: the images whose pixels the keypoints are in, (h, w), (h, w, 3) BGR or (h, w, 4) BGRA uint8.

        Raises:
            ValueError: an image is empty or no uint8 image.
        """
        facts = (f"{len(self.mask)} matches", f"{self.num_inliers} kept")
        panel = MatchPanel(self.mask, self.status.value, facts, self.ok)
        return draw_matches(image1, image2, self.points1, self.points2, panel)

    def __repr__(self) -> str:
        """The verdict and the counts; the arrays would fill the screen."""
        confidence = "" if self.confidence is None else f", confidence {self.confidence:.2f}"
        kept = f"{self.num_inliers} of {len(self.mask)} matches kept"
        return f"FilterResult(status={self.status.value!r}, {kept}{confidence})"

    def _repr_html_(self) -> str:
        """The verdict in words and the counts as a small table, for notebooks."""
        verdict = describe_verdict(
            self.status.value,
            guessed=self.info.get("intrinsics") == "guessed",
            confidence=self.confidence,
            focal_factor=self.info.get("focal_factor"),
            mirrored=bool(self.info.get("mirrored")),
            focal_doubt=bool(self.info.get("focal_doubt")),
        )
        rows = {"status": self.status.value, "kept": f"{self.num_inliers} of {len(self.mask)} matches"}
        if self.R is not None:
            cosine = (float(np.trace(self.R)) - 1.0) / 2.0
            rows["rotation"] = f"{np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))):.1f}°"
        if self.t is not None:
            rows["translation"] = ", ".join(f"{value:+.2f}" for value in self.t)
        if self.confidence is not None:
            rows["confidence"] = f"{100.0 * self.confidence:.0f} %"
        cells = "".join(
            f"<tr><th style='text-align:left'>{name}</th><td>{word}</td></tr>" for name, word in rows.items()
        )
        return f"<p><b>{verdict.headline}</b><br>{verdict.advice}</p><table>{cells}</table>"
