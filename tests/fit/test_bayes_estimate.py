"""The pose expected nearest to the truth: laws of the draws and of the answer."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import Scene, make_scene
from fit_inputs import COEFFICIENTS, FOCAL, normalized

from mgca_filter.fit import bayes_estimate, choice
from mgca_filter.fit.bayes_estimate import expected_best
from mgca_filter.geometry.epipolar import pose_error_deg
from mgca_filter.geometry.pose_refinement import apply_step, refine_pose

Poses = tuple[np.ndarray, np.ndarray]


def moved(scene: Scene, steps: np.ndarray) -> Poses:
    """The true pose after each of some steps (S, 5)."""
    R, t = zip(*(apply_step(scene.R, scene.t, step) for step in steps))
    return np.stack(R), np.stack(t)


def around(scene: Scene, count: int = 5, size: float = 0.02, seed: int = 0) -> Poses:
    return moved(scene, np.random.default_rng(seed).normal(0.0, size, (count, 5)))


def scores_of(scene: Scene) -> np.ndarray:
    return np.where(scene.inlier, 0.9, 0.05)


def expected(scene: Scene, poses: Poses, scale: float = 1.0) -> Poses | None:
    return expected_best(normalized(scene), scores_of(scene), *poses, scale, FOCAL, COEFFICIENTS)


def test_draws_fill_a_normal_distribution_evenly() -> None:
    for count, tolerance in ((96, 0.08), (1000, 0.05)):
        normals = bayes_estimate._quasi_normals(count)
        assert normals.shape == (count + 1, 5)
        np.testing.assert_array_equal(normals[0], 0.0)
        np.testing.assert_allclose(normals.mean(axis=0), 0.0, atol=tolerance)
        np.testing.assert_allclose(np.cov(normals.T), np.eye(5), atol=tolerance)


def test_where_the_matches_hold_one_pose_the_answer_is_that_one() -> None:
    scene = make_scene()
    refined = refine_pose(normalized(scene), scene.R, scene.t, 1.0 / FOCAL)
    answer = expected(scene, (refined[0][None], refined[1][None]))
    assert answer is not None
    assert pose_error_deg(*answer, *refined) < 0.5
    np.testing.assert_allclose(answer[0] @ answer[0].T, np.eye(3), atol=1e-12)
    assert np.linalg.norm(answer[1]) == pytest.approx(1.0)


def test_same_input_gives_the_same_bits_whatever_the_order_of_the_hypotheses() -> None:
    scene = make_scene(right=25, wrong=10, noise_px=1.5)
    R, t = around(scene)
    first, again, reversed_ = expected(scene, (R, t)), expected(scene, (R, t)), expected(scene, (R[::-1], t[::-1]))
    assert first is not None
    for one, other, third in zip(first, again, reversed_):
        np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(one, third)


def test_what_no_match_is_near_is_not_asked() -> None:
    scene = make_scene(right=40, wrong=0)
    turned = make_scene("wide", seed=3)
    assert expected(scene, (turned.R[None], turned.t[None])) is None
    few = make_scene(right=5, wrong=0)
    assert expected(few, (few.R[None], few.t[None])) is None


def test_an_answer_explains_most_of_what_the_best_hypothesis_does() -> None:
    for seed in range(10):
        scene = make_scene("planar", right=30, wrong=20, noise_px=1.5, seed=seed)
        poses = around(scene, seed=seed)
        answer = expected(scene, poses)
        if answer is None:
            continue
        both = [np.concatenate([many, one[None]]) for many, one in zip(poses, answer)]
        residuals = choice.measure_residuals(normalized(scene), *both, FOCAL)
        explained = ((residuals.distance_px < choice.INLIER_PX) & ~residuals.behind).sum(axis=1)
        assert explained[-1] >= 8
        likely = choice.log_likelihoods(residuals, choice.prior(scores_of(scene), COEFFICIENTS), COEFFICIENTS)[:-1, 0]
        assert explained[-1] >= 0.5 * explained[int(np.argmax(likely))]


@pytest.mark.parametrize("focal_px", [1e-3, 1.0, 1e7])
def test_any_unit_of_length_will_do(focal_px: float) -> None:
    scene = make_scene(right=30, wrong=10)
    rows = normalized(scene) * (FOCAL / focal_px if focal_px > FOCAL else 1.0)
    answer = expected_best(rows, scores_of(scene), *around(scene, size=1e-4), 1.0, focal_px, COEFFICIENTS)
    assert answer is None or np.isfinite(np.concatenate([answer[0].ravel(), answer[1]])).all()
