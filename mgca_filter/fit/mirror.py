"""Is one of the images mirrored? No camera sees an opaque surface from both sides.

A picture and its mirrored copy agree with a whole family of essential matrices, those of a camera that looks at the
picture from behind, and so pass for a scene with a well-supported pose; a scene with depth of which one image was
mirrored agrees with one. Triangles of matches tell: a mirror turns the orientation of nearly all of them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..geometry.homography import sampson_distance_to_homography
from ..inputs.options import FilterOptions
from ..inputs.pair import PairInput
from ..result import Status
from .evidence import FIRM_MATCHES, Evidence
from .homography_fit import HomographyOptions, estimate_homography
from .planarity import MEANINGFUL_LOG10_NFA, homography_false_alarms
from .verdict import Verdict

Array = NDArray[np.float64]

# This share of the matches that agree with a pose lies on the mirrored plane; in front of a facade others join them,
# which mistake one window of a row for another.
LEAST_SHARE = 0.25
_THRESHOLD_PX = 2.0
_TRIANGLES = 300
# Share of triangles that turn: of a mirrored plane with wrong matches about it; of a mirrored scene with depth, of
# whose pose nothing else tells.
_TURNED_PLANE, _TURNED_SCENE = 0.5, 0.7


def judge_mirror(
    pair: PairInput, evidence: Evidence, verdict: Verdict, mask_threshold_px: float, options: FilterOptions
) -> Verdict:
    """The verdict with the mirroring homography in the place of a pose, where that is what the matches tell.

    Args:
        pair: the pair, M matches. evidence: what the model was fitted to. verdict: on that model.
        mask_threshold_px: Sampson distance below which a match is kept, pixels.
        options: confidence, seed, and whether a homography was asked for.

    Returns:
        ``verdict`` itself; or one with ``info["mirrored"]`` and no pose: with H and the mask of the matches that agree
        with it, or, of a scene with depth, with F, its mask and low support.
    """
    rows = evidence.rows[evidence.accepted()]
    if verdict.R is not None:
        rows = rows[verdict.mask[rows]]
    matches = np.hstack(pair.pixels(rows))
    if verdict.status is Status.PURE_ROTATION or len(matches) < FIRM_MATCHES:
        return verdict
    turned = share_of_turned_triangles(matches)
    if turned < _TURNED_PLANE:
        return verdict
    plane = HomographyOptions(_THRESHOLD_PX, confidence=options.confidence, seed=options.seed, reflection=True)
    fit = estimate_homography(matches, plane)
    log10_nfa = float("inf")
    if fit is not None and np.count_nonzero(fit.inlier) > LEAST_SHARE * len(matches) and np.linalg.det(fit.H) < 0:
        log10_nfa = homography_false_alarms(matches, fit.H, _THRESHOLD_PX)
    if fit is None or log10_nfa > MEANINGFUL_LOG10_NFA:
        if verdict.t is None or turned < _TURNED_SCENE:
            return verdict
        info = {**verdict.info, "mirrored": True}
        return replace(verdict, status=Status.LOW_SUPPORT, E=None, R=None, t=None, info=info)
    mask = np.zeros(len(pair.valid), dtype=bool)
    pixels = np.hstack(pair.pixels(pair.valid))
    mask[pair.valid] = sampson_distance_to_homography(pixels, fit.H) < mask_threshold_px
    H = pair.homography_in_units(fit.H)
    support = int(np.count_nonzero(fit.inlier))
    info = {"support": support, "log10_false_alarms": log10_nfa, "homography": H, "mirrored": True}
    status = Status.OK if options.geometry == "homography" else Status.PLANAR
    return replace(verdict, status=status, mask=mask, E=None, F=None, R=None, t=None, H=H, info=info)


def share_of_turned_triangles(matches: Array) -> float:
    """Share of the triangles of matches (N, 4) that are seen from their other side in image 2."""
    triples = np.random.default_rng(0).integers(0, len(matches), (_TRIANGLES, 3))
    first, second, third = (matches[column] for column in triples.T)
    a, b = second - first, third - first
    orientation1 = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    orientation2 = a[:, 2] * b[:, 3] - a[:, 3] * b[:, 2]
    agreement = np.sign(orientation1 * orientation2)
    turned, kept = int(np.count_nonzero(agreement < 0)), int(np.count_nonzero(agreement > 0))
    return turned / max(turned + kept, 1)
