"""From logits to probabilities; the prior; and that no data raise, whatever the caller has set in numpy."""

from __future__ import annotations

from math import erf, sqrt

import numpy as np
import pytest
from conftest import K, make_scene

from mgca_filter import MatchFilter
from mgca_filter.inference.calibration import AttributePrior, Calibration, gelu, largest_set_of_precision, sigmoid
from mgca_filter.inference.scoring import INVALID_LOGIT, prior_logits, select_network_input


def test_calibration_and_prior_follow_their_formulas() -> None:
    probabilities = Calibration(2.0, -1.0).probabilities([-1000.0, 0.5, 1000.0])
    np.testing.assert_allclose(probabilities, [0.0, 0.5, 1.0], atol=1e-7)
    x = np.linspace(-6, 6, 101)
    exact = np.array([0.5 * v * (1 + erf(v / sqrt(2))) for v in x])
    np.testing.assert_allclose(gelu(x), exact, atol=1e-6)
    prior = AttributePrior(np.eye(8)[:2], np.array([0.0, 1.0]), np.array([2.0, -1.0]), 0.5)
    attributes = np.random.default_rng(0).random((5, 8)).astype(np.float32)
    expected = 2 * gelu(attributes[:, 0].astype(float)) - gelu(attributes[:, 1] + 1.0) + 0.5
    np.testing.assert_allclose(prior.logits(attributes), expected, atol=1e-6)


def test_nothing_raises_where_numpy_is_told_to(match_filter: MatchFilter) -> None:
    extremes = np.array([-1e30, -1000.0, INVALID_LOGIT, -1e-300, 0.0, 1e-300, 100.0, 1e30])
    prior = AttributePrior(1e3 * np.eye(8), np.full(8, -40.0), np.full(8, 1e-45), 0.0)
    attributes = np.random.default_rng(0).normal(size=(9, 8)).astype(np.float32)
    plain = Calibration(1.5, -0.3).probabilities(extremes), prior.logits(attributes), gelu(extremes)
    with np.errstate(all="raise"):
        strict = Calibration(1.5, -0.3).probabilities(extremes), prior.logits(attributes), gelu(extremes)
        assert sigmoid(extremes)[[0, -1]].tolist() == [0.0, 1.0]
        assert largest_set_of_precision(plain[0], 0.5).any()
    for one, other in zip(strict, plain):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("coordinate", [0.0, 1e-300, -1e-42, 999.0])
def test_scoring_takes_any_usable_coordinates(match_filter: MatchFilter, coordinate: float) -> None:
    backend = match_filter._backends[0]
    correspondences, attributes = np.full((40, 4), coordinate), np.zeros((40, 8), np.float32)
    valid = np.arange(40) > 0
    with np.errstate(all="raise"):
        sent = select_network_input(correspondences, attributes, valid, backend, seed=0)
        logits = prior_logits(attributes, valid, backend.metadata)
    assert sent.rows.tolist() == list(range(1, 40))
    assert logits[0] == INVALID_LOGIT
    assert (logits[1:] > INVALID_LOGIT).all()


def test_a_row_without_coordinates_raises_nothing(match_filter: MatchFilter) -> None:
    scene = make_scene()
    points1 = scene.points1.copy()
    points1[0] = np.nan
    plain = match_filter.filter(points1, scene.points2, None, K1=K, attributes=scene.attributes)
    with np.errstate(all="raise"):
        strict = match_filter.filter(points1, scene.points2, None, K1=K, attributes=scene.attributes)
    np.testing.assert_array_equal(strict.scores, plain.scores)
    np.testing.assert_array_equal(strict.mask, plain.mask)
    assert plain.scores[0] == 0.0
