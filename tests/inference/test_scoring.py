"""Scores of matches that never enter the network: below the threshold, in the order of the prior."""

from __future__ import annotations

import numpy as np
from conftest import make_scene

from mgca_filter import MatchAttributes, MatchFilter
from mgca_filter.inference.scoring import _below


def test_no_two_logits_come_out_alike_and_none_reaches_the_ceiling() -> None:
    logits = np.linspace(-6.0, 6.0, 1001).astype(np.float32)
    for ceiling in (-1e-3, 0.7):
        below = _below(logits, ceiling)
        assert (np.diff(below) > 0).all()
        assert below.max() < ceiling
        far = logits < ceiling - 0.25
        np.testing.assert_array_equal(below[far], logits[far])
        assert np.abs(below - np.minimum(logits, ceiling)).max() < 0.13  # three hundredths of a probability


def test_matches_that_do_not_enter_the_network_have_scores_of_their_own(match_filter: MatchFilter) -> None:
    """They lost the keypoint to another match, which their ratio does not say."""
    scene = make_scene(right=120, wrong=80)
    best = np.ones(200, dtype=bool)
    best[::2] = False
    attributes = MatchAttributes(ratio=scene.attributes.ratio, best=best)
    result = match_filter.filter(scene.points1, scene.points2, None, attributes=attributes, size1=(640, 480))
    outside = np.setdiff1d(np.arange(200), result.info["network_rows"])
    assert len(outside) >= 100
    rank = outside[np.argsort(-scene.attributes.ratio[outside])]
    ratio = scene.attributes.ratio[rank]
    assert (np.diff(result.scores[rank])[np.diff(ratio) < 0] > 0).all()
    assert result.info["logits"][outside].max() < match_filter.metadata.decision_threshold
