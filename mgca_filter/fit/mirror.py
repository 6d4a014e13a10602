"""Is one of the images mirrored? No camera sees an opaque surface from both sides.

A picture and its mirrored copy agree with a whole family of essential matrices, those of a camera that looks at the
picture from behind, and so pass for a scene with a well-supported pose. A homography that turns the orientation of what
it maps tells the two apart.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..geometry.homography import sampson_distance_to_homography
from ..inputs.options import FilterOptions
from ..inputs.pair import PairInput
from ..result import Status
from .evidence import MIN_MATCHES, Evidence
from .homography_fit import HomographyOptions, estimate_homography
from .planarity import MEANINGFUL_LOG10_NFA, homography_false_alarms
from .verdict import Verdict

Array = NDArray[np.float64]

# This share of the matches that agree with a pose lies on the mirrored plane; in front of a facade others join them,
# which mistake one window of a row for another.
LEAST_SHARE = 0.25
_THRESHOLD_PX = 2.0
_TRIPLES = 300


def judge_mirror(
    pair: PairInput, evidence: Evidence, verdict: Verdict, mask_threshold_px: float, options: FilterOptions
) -> Verdict:
    """The verdict with the mirroring homography in the place of a pose, where that is what the matches tell.

    Args:
        pair: the pair, M matches. evidence: what the model was fitted to. verdict: on that model.
        mask_threshold_px: Sampson distance below which a match is kept, pixels.
        options: confidence, seed, and whether a homography was asked for.

    Returns:
        ``verdict`` itself, or one with H, the mask of the matches that agree with it, ``info["mirrored"]`` and no pose.
    """
    rows = evidence.rows[evidence.accepted()]
    if verdict.R is not None:
        rows = rows[verdict.mask[rows]]
    matches = np.hstack(pair.pixels(rows))
    if verdict.status is Status.PURE_ROTATION or len(matches) < MIN_MATCHES or not turns_orientation(matches):
        return verdict
    plane = HomographyOptions(_THRESHOLD_PX, confidence=options.confidence, seed=options.seed, reflection=True)
    fit = estimate_homography(matches, plane)
    if fit is None or np.count_nonzero(fit.inlier) < LEAST_SHARE * len(matches) or np.linalg.det(fit.H) > 0:
        return verdict
    log10_nfa = homography_false_alarms(matches, fit.H, _THRESHOLD_PX)
    if log10_nfa > MEANINGFUL_LOG10_NFA:
        return verdict
    mask = np.zeros(len(pair.valid), dtype=bool)
    pixels = np.hstack(pair.pixels(pair.valid))
    mask[pair.valid] = sampson_distance_to_homography(pixels, fit.H) < mask_threshold_px
    H = pair.homography_in_units(fit.H)
    support = int(np.count_nonzero(fit.inlier))
    info = {"support": support, "log10_false_alarms": log10_nfa, "homography": H, "mirrored": True}
    status = Status.OK if options.geometry == "homography" else Status.PLANAR
    return replace(verdict, status=status, mask=mask, E=None, F=None, R=None, t=None, H=H, info=info)


def turns_orientation(matches: Array) -> bool:
    """True where most triangles of matches (N, 4) are seen from their other side in image 2."""
    triples = np.random.default_rng(0).integers(0, len(matches), (_TRIPLES, 3))
    first, second, third = (matches[column] for column in triples.T)
    a, b = second - first, third - first
    orientation1 = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    orientation2 = a[:, 2] * b[:, 3] - a[:, 3] * b[:, 2]
    agreement = np.sign(orientation1 * orientation2)
    return bool(np.count_nonzero(agreement < 0) > np.count_nonzero(agreement > 0))
