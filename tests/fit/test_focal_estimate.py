"""What estimated focal lengths leave of the confidence in a pose."""

from __future__ import annotations

import numpy as np
import pytest

from mgca_filter.fit.focal_estimate import FocalEstimate, confidence_under_estimate


@pytest.mark.parametrize("fitted", [0.0, 0.3, 0.9, 0.99, 1.0])
def test_a_pose_is_never_surer_than_with_known_focal_lengths(fitted: float) -> None:
    answers = [confidence_under_estimate(fitted, sigma_deg) for sigma_deg in (0.05, 0.5, 2.0, 10.0, 60.0, 180.0)]
    assert 0.0 <= min(answers) <= max(answers) <= fitted
    assert answers == sorted(answers, reverse=True)


def test_a_degree_does_no_harm_and_ten_do() -> None:
    assert confidence_under_estimate(0.95, 1.0) > 0.85
    assert confidence_under_estimate(0.95, 10.0) <= 0.5
    assert confidence_under_estimate(1.0, 10.0) <= 0.5
    assert confidence_under_estimate(0.95, 2.0) > confidence_under_estimate(0.7, 2.0)


@pytest.mark.parametrize("factors", [(1.0, 1.0), (0.8, 1.3)])
def test_focal_lengths_move_together_and_against_each_other(factors: tuple[float, float]) -> None:
    """The variance of their ratio is the one that was measured, up to a limit; that of their mean is the rest."""
    for ratio_sigma, expected in ((0.0, 0.0), (0.1, 0.1), (5.0, 0.5)):
        covariance = FocalEstimate(factors, (0.2, 0.2), ratio_sigma).covariance
        ratio, mean = np.array([-1.0, 1.0]), np.array([0.5, 0.5])
        assert np.sqrt(ratio @ covariance @ ratio) == pytest.approx(expected)
        assert np.sqrt(mean @ covariance @ mean) == pytest.approx(0.2)
