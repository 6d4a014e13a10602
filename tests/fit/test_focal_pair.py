"""Two focal lengths from matches: found where they differ, left alone where they do not or nothing tells."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from conftest import K, make_scene

from mgca_filter.fit.focal_pair import FocalBelief, FocalPairFit, TwoFocals
from mgca_filter.geometry.pose_refinement import refine_pose, rotation_from_vector

BELIEF = FocalBelief(-0.3, 0.35)
GUESS = 1000.0


def fitted(points1: np.ndarray, points2: np.ndarray, R: np.ndarray, t: np.ndarray, log_factor: float, noise: float):
    """The fit from the true pose under one focal length."""
    rows = np.hstack([points1 - K[:2, 2], points2 - K[:2, 2]]) / GUESS
    return FocalPairFit(rows, 2.0 / GUESS, max(noise, 0.1) / GUESS, BELIEF).differing(R, t, log_factor)[0]


def zoomed(zoom: float, noise: float = 0.0, seed: int = 0, kind: str = "skew", swap: bool = False) -> TwoFocals | None:
    """A scene of which image 2 was taken with ``zoom`` times the focal length of image 1, which is 800 px."""
    scene = make_scene(kind, right=200, wrong=0, noise_px=0.0, seed=seed)
    rng = np.random.default_rng(seed)
    points1 = scene.points1 + rng.normal(0, noise, scene.points1.shape)
    points2 = (scene.points2 - K[:2, 2]) * zoom + K[:2, 2] + rng.normal(0, noise, scene.points2.shape)
    start = np.log(K[0, 0] / GUESS * np.sqrt(zoom))
    t = scene.t if scene.t.any() else np.array([1.0, 0.0, 0.0])
    if swap:
        return fitted(points2, points1, scene.R.T, -scene.R.T @ t, start, noise)
    return fitted(points1, points2, scene.R, t, start, noise)


@pytest.mark.parametrize("zoom", [0.5, 0.75, 1.3, 2.0])
def test_exact_matches_give_both_focal_lengths(zoom: float) -> None:
    found = zoomed(zoom)
    assert found is not None
    np.testing.assert_allclose(GUESS * np.exp(found.logs), K[0, 0] * np.array([1.0, zoom]), rtol=0.03)
    assert found.log_ratio == pytest.approx(np.log(zoom), abs=0.02)


@pytest.mark.parametrize("seed", range(3))
def test_one_camera_has_one_focal_length(seed: int) -> None:
    assert zoomed(1.0, noise=0.5, seed=seed) is None


@pytest.mark.parametrize("kind", ["planar", "rotation"])
def test_a_plane_tells_no_zoom(kind: str) -> None:
    assert zoomed(1.0, noise=0.3, kind=kind) is None


def test_swapping_the_images_swaps_the_focal_lengths() -> None:
    one, other = zoomed(2.0, noise=0.3), zoomed(2.0, noise=0.3, swap=True)
    assert one is not None
    assert other is not None
    np.testing.assert_allclose(one.logs, other.logs[::-1], atol=0.02)
    np.testing.assert_allclose(one.sigmas, other.sigmas[::-1], rtol=0.2)


def test_what_is_said_of_the_spread_holds() -> None:
    """At least two thirds of the errors are within one standard deviation, which grows with the noise."""
    within, sigmas = [], {0.2: [], 0.8: []}
    for seed in range(15):
        rng = np.random.default_rng(100 + seed)
        zoom = float(np.exp(rng.choice([-1, 1]) * rng.uniform(0.3, 0.8)))
        for noise in sigmas:
            found = zoomed(zoom, noise=noise, seed=seed)
            if found is not None:
                error = found.logs - np.log(K[0, 0] / GUESS * np.array([1.0, zoom]))
                within.extend(np.abs(error) < found.sigmas)
                sigmas[noise].append(found.sigmas.mean())
    assert len(within) >= 40
    assert np.mean(within) > 2 / 3
    assert np.mean(sigmas[0.8]) > 1.5 * np.mean(sigmas[0.2])


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.2, 0.5, 1.0])
def test_two_standard_deviations_hold_the_truth_whatever_the_noise(noise: float) -> None:
    within = []
    for seed in range(12):
        rng = np.random.default_rng(1000 + seed)
        zoom = float(np.exp(rng.choice([-1, 1]) * rng.uniform(0.3, 0.8)))
        found = zoomed(zoom, noise=noise, seed=seed)
        if found is not None:
            within.extend(np.abs(found.logs - np.log(K[0, 0] / GUESS * np.array([1.0, zoom]))) < 2.0 * found.sigmas)
    assert len(within) >= 16
    assert np.mean(within) > 0.9


def test_the_pose_moves_as_the_derivative_says() -> None:
    """The pose refined under a focal length of image 2 that is a little off."""
    scene = make_scene("skew", right=200, wrong=0, noise_px=0.0)
    rows = np.hstack([scene.points1 - K[:2, 2], scene.points2 - K[:2, 2]]) / K[0, 0]
    derivative = FocalPairFit(rows, np.inf, 1.0, BELIEF).pose_derivative(scene.R, scene.t)
    step = 1e-3
    R, _ = refine_pose(rows / [1, 1, np.exp(step), np.exp(step)], scene.R, scene.t, 0.1, 30)
    turned = cv2.Rodrigues(R @ scene.R.T)[0].ravel()
    np.testing.assert_allclose(turned, derivative[:3, 1] * step, atol=0.1 * np.abs(turned).max())


def test_rotation_alone_starts_nothing() -> None:
    """Degenerate starts do not raise."""
    points = make_scene(right=40, wrong=0).points1
    assert fitted(points, points, rotation_from_vector(np.zeros(3)), np.array([0.0, 0.0, 1.0]), 0.0, 0.3) is None


@pytest.mark.parametrize("seed", range(6))
def test_matches_that_leave_most_of_it_open_do_not_raise(seed: int) -> None:
    """Five different ones, more sharply seen than any: nothing bounds the steps but their damping."""
    scene = make_scene("skew", right=40, wrong=0)
    rows = np.hstack([scene.points1 - K[:2, 2], scene.points2 - K[:2, 2]]) / GUESS
    few = np.repeat(rows[np.random.default_rng(seed).choice(len(rows), 5, replace=False)], 2, axis=0)
    found, ratio_sigma = FocalPairFit(few, 2e-3, 1e-7, BELIEF).differing(scene.R, scene.t, 0.0)
    assert ratio_sigma > 0.0
    assert found is None or np.isfinite(found.logs).all()
    assert np.isfinite(FocalPairFit(few, np.inf, 1.0, BELIEF).pose_derivative(scene.R, scene.t)).all()
