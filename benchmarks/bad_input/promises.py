"""What is promised of every answer, whatever the data; ``docs/trust.md`` says it in words."""

from __future__ import annotations

from typing import Any

import numpy as np

from mgca_filter.result import FilterResult, Status

_ORTHONORMAL = 1e-6


def broken_promises(result: FilterResult, count: int) -> list[str]:
    """The promises that the answer on ``count`` matches does not keep, in words; empty where it keeps all."""
    broken = []
    if result.mask.shape != (count,) or result.mask.dtype != bool:
        broken.append(f"mask {result.mask.dtype} {result.mask.shape} for {count} matches")
    scores = result.scores
    if scores.shape != (count,) or not ((scores >= 0) & (scores <= 1)).all():
        broken.append("scores are not probabilities, one a match")
    if not result.num_inliers == np.count_nonzero(result.mask) == len(result.matches):
        broken.append("num_inliers, mask and matches disagree")
    if not isinstance(result.status, Status):
        broken.append("status is none of the documented")
    if (result.t is None) != (result.E is None) or (result.R is None and result.t is not None):
        broken.append("pose and E do not come together")
    models = (result.E, result.F, result.R, result.H)  # of a plane in a mirror H alone
    if all(model is None for model in models) and result.mask.any():
        broken.append("matches kept without a model")
    broken += broken_essential(result.E)
    if result.F is not None:
        broken += _broken_matrix(result.F, "F")
    if result.R is not None and not (
        np.allclose(result.R @ result.R.T, np.eye(3), atol=_ORTHONORMAL) and np.linalg.det(result.R) > 0
    ):
        broken.append("R is no rotation")
    if result.t is not None and abs(float(np.linalg.norm(result.t)) - 1.0) > _ORTHONORMAL:
        broken.append("t has no unit length")
    return broken


def broken_essential(E: Any) -> list[str]:
    """The same of an essential matrix or None: (3, 3), finite, singular values (s, s, 0)."""
    if E is None:
        return []
    broken = _broken_matrix(E, "E")
    if not broken:
        s = np.linalg.svd(E, compute_uv=False)
        if abs(s[0] - s[1]) > 1e-6 * s[0] or s[2] > 1e-6 * s[0]:
            broken.append(f"E has the singular values {s.tolist()}")
    return broken


def broken_twin_answer(answer: Any, count: int, essential: bool) -> list[str]:
    """The same of what a twin of OpenCV returned: a matrix or None, and the mask."""
    M, mask = answer
    broken = broken_essential(M) if essential else ([] if M is None else _broken_matrix(M, "F"))
    if mask.shape != (count, 1) or mask.dtype != np.uint8 or (mask > 1).any():
        broken.append(f"mask {mask.dtype} {mask.shape} for {count} points")
    return broken


def _broken_matrix(M: Any, name: str) -> list[str]:
    if np.shape(M) != (3, 3) or M.dtype != np.float64 or not np.isfinite(M).all():
        return [f"{name} is no finite (3, 3) matrix"]
    return []
