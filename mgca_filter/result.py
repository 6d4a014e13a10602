"""What the filter gives back."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Status(enum.Enum):
    """Verdict on a pair of images; only ``OK`` and ``PLANAR`` come with a pose that can be used as it is."""

    OK = "ok"
    TOO_FEW_MATCHES = "too_few_matches"
    NO_GEOMETRY = "no_geometry"
    LOW_SUPPORT = "low_support"
    UNRELATED = "unrelated"
    PLANAR = "planar"
    PURE_ROTATION = "pure_rotation"
    SUSPICIOUS_INTRINSICS = "suspicious_intrinsics"


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
        status: the verdict.
        num_inliers: number of True in ``mask``.
        info: always ``logits`` (M,) float32, ``timings_ms`` by step, ``backend``, ``model`` (name), ``model_sha256``,
            ``intrinsics`` ("given" or "guessed"), ``assumptions`` (list of sentences), ``num_network_matches``,
            ``network_essential`` (3, 3) or None as the network gave it, ``fitted_essential`` (3, 3) or None as the
            robust fit left it, before the verdict, and its ``origin`` ("network", "start 1", …, "plane"). Where they
            were measured: ``support`` (number of accepted matches that agree), ``log10_false_alarms``, ``homography``
            (3, 3) that explains the pair, ``focal_factor`` where the matches ask for focal lengths that many times
            those given (rough, a power of 1.2).
    """

    mask: NDArray[np.bool_]
    scores: NDArray[np.float32]
    matches: Sequence[Any] | NDArray[np.intp]
    E: NDArray[np.float64] | None
    F: NDArray[np.float64] | None
    R: NDArray[np.float64] | None
    t: NDArray[np.float64] | None
    status: Status
    num_inliers: int
    info: dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        """The verdict and the counts; the arrays would fill the screen."""
        return f"FilterResult(status={self.status.value!r}, {self.num_inliers} of {len(self.mask)} matches kept)"
