"""The baselines see the same matches and are counted in the same way as the filter."""

import numpy as np
import pytest
from conftest import SIZE, K, make_scene

from mgca_filter.cli.compare import BASELINES, comparison_table, fit_baselines
from mgca_filter.geometry.cameras import normalize_points
from mgca_filter.geometry.epipolar import pose_error_deg, sampson_distance
from mgca_filter.result import FilterResult, Status


def fits_of(scene, K1=K, K2=K, threshold_px=1.0, seed=0):
    return fit_baselines(
        scene.points1, scene.points2, K1, K2, size1=SIZE, size2=SIZE, threshold_px=threshold_px, seed=seed
    )


def test_easy_scenes_are_solved():
    scene = make_scene(right=300, wrong=100)
    fits = fits_of(scene)
    assert [fit.name for fit in fits] == list(BASELINES)
    for fit in fits:
        assert pose_error_deg(fit.R, fit.t, scene.R, scene.t) < 3.0
        assert fit.mask[scene.inlier].mean() > 0.8
        assert fit.fit_ms > 0


@pytest.mark.parametrize("threshold_px", [0.5, 3.0])
def test_mask_is_the_sampson_distance_in_pixels(threshold_px):
    scene = make_scene(right=300, wrong=100)
    x = np.hstack([normalize_points(scene.points1, K), normalize_points(scene.points2, K)])
    for fit in fits_of(scene, threshold_px=threshold_px):
        np.testing.assert_array_equal(fit.mask, sampson_distance(x, fit.E) * K[0, 0] < threshold_px)
        assert fit.num_inliers == fit.mask.sum()


def test_seed_changes_the_draws_and_repeats_them():
    scene = make_scene(right=80, wrong=80, noise_px=1.0)
    first, again, other = fits_of(scene, seed=1), fits_of(scene, seed=1), fits_of(scene, seed=2)
    for index in range(len(BASELINES)):
        np.testing.assert_array_equal(first[index].E, again[index].E)
        assert not np.array_equal(first[index].E, other[index].E)


def test_unknown_intrinsics_are_guessed():
    scene = make_scene(right=300, wrong=50)
    for fit in fits_of(scene, K1=None, K2=None):
        assert fit.mask[scene.inlier].mean() > 0.5


def test_hopeless_input_gives_no_pose():
    scene = make_scene(right=3, wrong=0)
    for fit in fits_of(scene):
        assert fit.E is None
        assert fit.R is None
        assert fit.mask.shape == (3,)
        assert fit.num_inliers == 0


def test_table_has_one_aligned_row_each():
    scene = make_scene(right=3, wrong=0)
    nothing = FilterResult(np.zeros(3, bool), np.zeros(3, np.float32), [], *[None] * 5, Status.NO_GEOMETRY, 0)
    solved = fits_of(make_scene(right=100, wrong=10))
    lines = comparison_table(nothing, 12.0, [*fits_of(scene), *solved]).splitlines()
    assert len(lines) == 1 + 1 + 4
    assert len({len(line) for line in lines}) == 1
