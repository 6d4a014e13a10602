"""Figures of the pose protocol against cases computed by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mgca_filter.evaluation.metrics import (
    FAILURE_DEG,
    POSE_STATISTICS,
    ReliabilityBin,
    area_under_recall,
    area_under_roc,
    calibration_gap,
    mean_average_precision,
    mean_over_pairs,
    mean_over_scenes,
    median_error,
    paired_bootstrap_interval,
    percentile_interval,
    pool_pairs,
    precision_recall_f,
    resampled_figures,
    share_below,
)

ERRORS = [1.0, 4.9, 5.0, 12.0, FAILURE_DEG]


def test_precision_recall_and_f_of_one_pair():
    kept = [True, True, False, False]
    truth = [True, False, True, True]
    assert precision_recall_f(kept, truth) == pytest.approx((1 / 2, 1 / 3, 2 / 5))


@pytest.mark.parametrize(
    ("kept", "truth", "expected"),
    [
        ([0, 0, 0], [1, 0, 1], (0.0, 0.0, 0.0)),
        ([1, 0, 0], [0, 0, 0], (0.0, 0.0, 0.0)),
        ([1, 0, 0], [0, 1, 0], (0.0, 0.0, 0.0)),
        ([], [], (0.0, 0.0, 0.0)),
        ([1, 1, 0], [1, 1, 0], (1.0, 1.0, 1.0)),
    ],
)
def test_undefined_quotients_count_as_zero(kept, truth, expected):
    assert precision_recall_f(kept, truth) == expected


def test_precision_needs_equal_shapes():
    with pytest.raises(ValueError, match="shape"):
        precision_recall_f([True], [True, False])


def test_share_below_is_strict():
    assert share_below(ERRORS, 5.0) == pytest.approx(2 / 5)


@pytest.mark.parametrize(("limit", "expected"), [(5, 0.4), (10, 0.5), (15, 0.6), (20, 0.65)])
def test_map_is_the_mean_of_the_shares(limit, expected):
    # shares below 5, 10, 15, 20 degrees: 2, 3, 4, 4 of 5
    assert mean_average_precision(ERRORS, limit) == pytest.approx(expected)


@pytest.mark.parametrize("limit", [0, 7, -5])
def test_map_refuses_other_limits(limit):
    with pytest.raises(ValueError, match="multiple of 5"):
        mean_average_precision(ERRORS, limit)


def test_auc_is_the_area_of_the_trapezoids():
    # (0, 0) (1, 1/4) (3, 1/2) then level to 5: 0.125 + 0.75 + 1
    assert area_under_recall([3.0, FAILURE_DEG, 1.0, FAILURE_DEG], 5.0) == pytest.approx(1.875 / 5.0)
    # up to 2 degrees the curve is cut level after the first error: 0.125 + 0.25
    assert area_under_recall([3.0, FAILURE_DEG, 1.0, FAILURE_DEG], 2.0) == pytest.approx(0.375 / 2.0)


@given(
    st.lists(st.one_of(st.floats(0.0, 30.0), st.just(FAILURE_DEG)), min_size=1, max_size=40),
    st.sampled_from([5.0, 10.0, 20.0]),
)
def test_auc_equals_the_trapezoids_of_the_sorted_errors(errors, limit):
    below = sorted(error for error in errors if error < limit)
    x = [0.0, *below, limit]
    y = [i / len(errors) for i in (*range(len(below) + 1), len(below))]
    area = sum((x[i + 1] - x[i]) * (y[i] + y[i + 1]) / 2 for i in range(len(x) - 1))
    assert area_under_recall(errors, limit) == pytest.approx(area / limit)


def test_figures_of_many_resamples_at_once_are_those_of_each():
    errors = np.random.default_rng(0).uniform(0.0, 30.0, (4, 3, 17))
    for statistic in (*POSE_STATISTICS.values(), median_error):
        np.testing.assert_allclose(statistic(errors), [statistic(one) for one in errors])


def test_auc_at_its_bounds():
    assert area_under_recall([0.0, 0.0], 5.0) == pytest.approx(1.0)
    assert area_under_recall([FAILURE_DEG, 90.0], 20.0) == 0.0
    assert area_under_recall([5.0], 5.0) == 0.0


def test_auc_and_map_are_different_figures():
    errors = np.full(10, 4.0)
    assert mean_average_precision(errors, 5) == 1.0
    # the tenth of ten errors lifts the curve to 1 at 4 degrees at once
    assert area_under_recall(errors, 5.0) == pytest.approx((0.5 * 4.0 * 0.1 + 1.0) / 5.0)


def test_runs_with_different_seeds_are_averaged():
    runs = np.array([[1.0, 30.0], [1.0, 2.0]])
    assert mean_average_precision(runs, 5) == pytest.approx(0.75)
    expected = (area_under_recall(runs[0], 5.0) + area_under_recall(runs[1], 5.0)) / 2
    assert area_under_recall(runs, 5.0) == pytest.approx(expected)
    assert median_error(runs) == pytest.approx((15.5 + 1.5) / 2)


def test_mean_over_scenes_and_over_pairs_differ_with_the_scenes_sizes():
    errors = {"small": np.array([[1.0]]), "large": np.array([[1.0, 30.0, 30.0]])}
    assert mean_over_scenes(POSE_STATISTICS["mAP@5"], errors) == pytest.approx((1 + 1 / 3) / 2)
    assert mean_over_pairs(POSE_STATISTICS["mAP@5"], errors) == pytest.approx(2 / 4)
    assert pool_pairs(errors).shape == (1, 4)


def interval(errors, statistic, *, level=0.95, seed=0):
    """Of the mean over scenes."""
    return percentile_interval(resampled_figures(errors, statistic, replicates=1000, seed=seed).mean(axis=0), level)


def test_bootstrap_interval_of_two_pairs():
    # one pair right, one wrong: a resample holds none, one or two right ones
    errors = {"scene": np.array([[1.0, 30.0]])}
    assert interval(errors, POSE_STATISTICS["mAP@5"]) == (0.0, 1.0)
    assert interval(errors, POSE_STATISTICS["mAP@5"], level=0.4) == (0.5, 0.5)


def test_bootstrap_is_seeded_and_shrinks_with_the_number_of_pairs():
    rng = np.random.default_rng(0)
    few, many = ({"scene": rng.uniform(0, 10, (1, count))} for count in (20, 500))
    statistic = POSE_STATISTICS["AUC@5"]
    low, high = interval(few, statistic, seed=3)
    assert (low, high) == interval(few, statistic, seed=3)
    assert low < mean_over_scenes(statistic, few) < high
    narrow_low, narrow_high = interval(many, statistic)
    assert narrow_high - narrow_low < (high - low) / 2


def test_paired_difference_cancels_what_both_share():
    rng = np.random.default_rng(1)
    theirs = {"a": rng.uniform(0, 10, (3, 60)), "b": rng.uniform(0, 10, (3, 40))}
    statistic = POSE_STATISTICS["AUC@5"]
    assert paired_bootstrap_interval(theirs, theirs, statistic) == (0.0, 0.0)
    ours = {scene: errors * 0.9 for scene, errors in theirs.items()}
    low, high = paired_bootstrap_interval(ours, theirs, statistic)
    assert 0 < low < high
    alone = interval(ours, statistic)
    assert high - low < alone[1] - alone[0]


def test_paired_difference_needs_the_same_pairs():
    statistic = POSE_STATISTICS["mAP@5"]
    ours = {"a": np.ones((1, 3))}
    with pytest.raises(ValueError, match="scenes differ"):
        paired_bootstrap_interval(ours, {"b": np.ones((1, 3))}, statistic)
    with pytest.raises(ValueError, match="numbers of pairs"):
        paired_bootstrap_interval(ours, {"a": np.ones((1, 4))}, statistic)


@given(st.lists(st.floats(0.0, 180.0), min_size=1, max_size=40), st.sampled_from(sorted(POSE_STATISTICS)))
def test_a_smaller_error_never_lowers_a_figure(errors, name):
    statistic = POSE_STATISTICS[name]
    before = statistic(np.array([errors]))
    improved = statistic(np.array([[errors[0] / 2, *errors[1:]]]))
    assert 0.0 <= before <= improved + 1e-12 <= 1.0 + 2e-12


def test_area_under_roc_by_hand():
    # (0.9 right), (0.5 right) against (0.5 wrong), (0.1 wrong): 1, 1, ½ and 1 of the four comparisons
    assert area_under_roc([0.9, 0.5, 0.5, 0.1], [True, True, False, False]) == pytest.approx(3.5 / 4)
    assert np.isnan(area_under_roc([0.5, 0.9], [True, True]))
    assert np.isnan(area_under_roc([], []))


@given(st.lists(st.tuples(st.integers(0, 9), st.booleans()), min_size=2))
def test_area_under_roc_turns_with_the_sign_and_keeps_the_scale(pairs):
    values, truth = np.array([value for value, _ in pairs], dtype=float), np.array([right for _, right in pairs])
    area = area_under_roc(values, truth)
    np.testing.assert_allclose(area_under_roc(-values, truth), 1 - area)
    np.testing.assert_allclose(area_under_roc(np.exp(values), truth), area)


def test_calibration_gap_by_hand():
    bins = [ReliabilityBin(0.9, 0.7, 30), ReliabilityBin(0.1, 0.2, 10)]
    assert calibration_gap(bins) == pytest.approx((30 * 0.2 + 10 * 0.1) / 40)
    assert calibration_gap([]) == 0.0
