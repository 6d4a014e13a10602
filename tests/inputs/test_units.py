"""Coordinates that are no pixels, and images that one K cannot fit: recognised or refused, always with a word."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import mgca_filter
from mgca_filter import filter_matches, findEssentialMat, findFundamentalMat
from mgca_filter.geometry.epipolar import pose_error_deg

K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
R, T = cv2.Rodrigues(np.array([0.03, 0.1, -0.02]))[0], np.array([1.0, 0.1, 0.2])
SIZE = (640, 480)


def two_views(seed: int = 0, count: int = 400, wrong: int = 120) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) in two views, the last ``wrong`` of them unrelated."""
    rng = np.random.default_rng(seed)
    u = rng.uniform((0, 0), SIZE, (count, 2))
    X = np.c_[u, np.ones(count)] @ np.linalg.inv(K).T * rng.uniform(4, 10, (count, 1))
    v = (X @ R.T + T) @ K.T
    p, q = u + rng.normal(0, 0.3, u.shape), v[:, :2] / v[:, 2:] + rng.normal(0, 0.3, u.shape)
    q[-wrong:] = rng.uniform((0, 0), SIZE, (wrong, 2))
    return p, q


P, Q = two_views()
RIGHT = np.arange(len(P)) < 280


def in_units(focal: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points in units of which ``focal`` make the focal length, the origin at the principal point, and their K."""
    x1, x2 = ((points - K[:2, 2]) / K[0, 0] * focal for points in (P, Q))
    return x1, x2, np.diag([focal, focal, 1.0])


@pytest.mark.parametrize("focal", [1e-3, 0.02, 1.0, 4.0, 8.0, 12.0, 24.0])
@pytest.mark.parametrize("threshold", [None, 2e-3], ids=["default threshold", "threshold in units"])
def test_normalised_points_and_millimetres(focal: float, threshold: float | None) -> None:
    x1, x2, K_units = in_units(focal)
    options = {} if threshold is None else {"threshold": threshold * focal}
    result = filter_matches(x1, x2, None, K1=K_units, **options)
    assert result.status == "ok"
    assert pose_error_deg(result.R, result.t, R, T) < 1.5
    assert result.mask[RIGHT].mean() > 0.9
    assert result.mask[~RIGHT].mean() < 0.15
    assert any("no pixels" in sentence for sentence in result.info["assumptions"])
    # F holds for the coordinates that came in.
    residual = np.abs(np.einsum("ni,ij,nj->n", np.c_[x2, np.ones(len(x2))], result.F, np.c_[x1, np.ones(len(x1))]))
    assert np.median(residual[RIGHT]) < 0.1 * np.median(residual[~RIGHT])


@pytest.mark.parametrize("focal", [1.0, 12.0])
def test_a_threshold_in_units_counts(focal: float) -> None:
    x1, x2, K_units = in_units(focal)
    kept = [filter_matches(x1, x2, None, K1=K_units, threshold=focal * px / 500).num_inliers for px in (0.2, 1.0)]
    assert kept[0] < 0.8 * kept[1]


def test_normalised_points_without_intrinsics() -> None:
    x1, x2, _ = in_units(1.0)
    result = filter_matches(x1, x2, None)
    assert result.F is not None
    assert result.mask[RIGHT].mean() > 0.8
    assert result.mask[~RIGHT].mean() < 0.2


@pytest.mark.parametrize("focal", [1.0, 12.0])
def test_twins_in_units(focal: float) -> None:
    x1, x2, K_units = in_units(focal)
    E, mask = findEssentialMat(x1, x2, K_units, threshold=2e-3 * focal)
    _, R_found, t_found, _ = cv2.recoverPose(E, x1, x2, K_units, mask=mask.copy())
    assert pose_error_deg(R_found, t_found, R, T) < 1.5
    assert mask[RIGHT].mean() > 0.9


def test_twin_of_the_fundamental_matrix_in_units() -> None:
    x1, x2, _ = in_units(1.0)
    F, mask = findFundamentalMat(x1, x2, cv2.FM_RANSAC, 2e-3)
    assert F.shape == (3, 3)
    assert mask[RIGHT].mean() > 0.8


@pytest.mark.parametrize("factor", [0.25, 2.0, 10.0])
def test_scaling_pixels_with_K_and_threshold_changes_little(factor: float) -> None:
    zoom = np.diag([factor, factor, 1.0])
    result = filter_matches(P * factor, Q * factor, None, K1=zoom @ K, threshold=factor)
    assert result.status == "ok"
    assert pose_error_deg(result.R, result.t, R, T) < 1.5
    assert not result.info["assumptions"] or "no pixels" not in " ".join(result.info["assumptions"])


@pytest.mark.parametrize("size2", [(576, 432), (320, 240), (480, 640)], ids=["resized", "half", "turned"])
def test_one_K_for_two_sizes_is_refused(size2: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=r"K2: one K cannot be right for images of 640x480 and \d+x\d+"):
        filter_matches(P, Q, None, K1=K, size1=SIZE, size2=size2)
    image1, image2 = np.zeros(SIZE[::-1], np.uint8), np.zeros(size2[::-1], np.uint8)
    with pytest.raises(ValueError, match="K2: one K"):
        mgca_filter.match_images(image1, image2, K1=K)
    assert filter_matches(P, Q, None, K1=K, K2=K, size1=SIZE, size2=size2).status == "ok"


def test_a_principal_point_outside_of_the_image_is_told() -> None:
    far = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
    result = filter_matches(P, Q, None, K1=K, K2=far, size1=SIZE, size2=(256, 192))
    assert any("principal point of K2" in sentence for sentence in result.info["assumptions"])
    assert not any("principal point of K1" in sentence for sentence in result.info["assumptions"])
