"""The twins of findHomography, estimateAffine2D and estimateAffinePartial2D."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from point_arrays import HOSTILE_POINTS, LAYOUTS

from mgca_filter import patch_cv2
from mgca_filter.geometry.homography import transfer
from mgca_filter.opencv.twins import estimateAffine2D, estimateAffinePartial2D, findHomography

SIZE = (640, 480)
MAPS = {
    "homography": np.array([[0.9, -0.2, 60.0], [0.25, 1.1, -40.0], [2e-4, -1e-4, 1.0]]),
    "affine": np.array([[0.9, -0.2, 60.0], [0.25, 1.1, -40.0], [0, 0, 1.0]]),
    "similarity": np.array([[0.8, -0.3, 60.0], [0.3, 0.8, -40.0], [0, 0, 1.0]]),
}
# Each function as a script calls it, with the fewest points that do not go to OpenCV.
TWINS: dict[str, tuple[Callable[..., Any], int]] = {
    "homography": (lambda p, q, *a, **k: findHomography(p, q, *(a or (cv2.RANSAC,)), **k), 5),
    "affine": (estimateAffine2D, 4),
    "similarity": (estimateAffinePartial2D, 3),
}
ORIGINALS = {
    "homography": lambda p, q: cv2.findHomography(p, q, cv2.RANSAC),
    "affine": cv2.estimateAffine2D,
    "similarity": cv2.estimateAffinePartial2D,
}
families = pytest.mark.parametrize("family", MAPS)


def points(
    H: np.ndarray, right: int = 120, wrong: int = 180, noise_px: float = 0.4, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (N, 2), (N, 2) and which are right."""
    rng = np.random.default_rng(seed)
    first = rng.uniform((0, 0), SIZE, (right, 2))
    second = transfer(first, H) + rng.normal(0, noise_px, (right, 2))
    first = np.vstack([first, rng.uniform((0, 0), SIZE, (wrong, 2))])
    second = np.vstack([second, rng.uniform((0, 0), SIZE, (wrong, 2))])
    rows = rng.permutation(right + wrong)
    return first[rows], second[rows], (np.arange(right + wrong) < right)[rows]


def as_homography(M: np.ndarray) -> np.ndarray:
    return M if M.shape == (3, 3) else np.vstack([M, [0, 0, 1]])


def corner_error(M: np.ndarray, truth: np.ndarray) -> float:
    corners = np.array([[0.0, 0], [639, 0], [639, 479], [0, 479]])
    return float(np.linalg.norm(transfer(corners, as_homography(M)) - transfer(corners, truth), axis=1).mean())


@families
def test_what_opencv_users_expect(family: str) -> None:
    first, second, inlier = points(MAPS[family])
    M, mask = TWINS[family][0](first, second)
    theirs, their_mask = ORIGINALS[family](first, second)
    assert (M.shape, M.dtype, mask.shape, mask.dtype) == (
        theirs.shape,
        theirs.dtype,
        their_mask.shape,
        their_mask.dtype,
    )
    assert set(np.unique(mask)) == {0, 1}
    assert corner_error(M, MAPS[family]) < 1.0
    assert np.mean(mask.ravel() == inlier) > 0.97
    distance = np.linalg.norm(transfer(first, as_homography(M)) - second, axis=1)
    np.testing.assert_array_equal(mask.ravel() == 1, distance < 3.0)


def test_scale_of_the_homography() -> None:
    first, second, _ = points(MAPS["homography"])
    assert findHomography(first, second, cv2.RANSAC)[0][2, 2] == 1.0


@families
def test_many_wrong_matches_stop_opencv_first(family: str) -> None:
    ours, theirs = 0, 0
    for seed in range(6):
        first, second, _ = points(MAPS[family], right=60, wrong=500, seed=seed)
        ours += corner_error(TWINS[family][0](first, second)[0], MAPS[family]) < 3.0
        M, _ = ORIGINALS[family](first, second)
        theirs += M is not None and corner_error(M, MAPS[family]) < 3.0
    assert ours >= max(theirs, 5)


@pytest.mark.parametrize(
    "method", [cv2.RANSAC, cv2.LMEDS, cv2.RHO, cv2.USAC_DEFAULT, cv2.USAC_MAGSAC, cv2.USAC_PROSAC, cv2.USAC_ACCURATE]
)
def test_robust_methods_go_through_the_filter(method: int) -> None:
    first, second, inlier = points(MAPS["homography"], right=60, wrong=300)
    H, mask = findHomography(first, second, method)
    assert corner_error(H, MAPS["homography"]) < 1.5
    assert np.mean(mask.ravel() == inlier) > 0.95


def test_least_squares_and_unknown_methods_are_opencvs_own() -> None:
    first, second, _ = points(MAPS["homography"])
    for arguments in ((), (0,), (None,)):
        H, mask = findHomography(first, second, *arguments)
        expected, expected_mask = cv2.findHomography(first, second, 0)
        np.testing.assert_array_equal(H, expected)
        np.testing.assert_array_equal(mask, expected_mask)
    with pytest.raises(cv2.error):
        findHomography(first, second, 7)


@families
def test_few_points_are_opencvs_own(family: str) -> None:
    twin, fewest = TWINS[family]
    first, second, _ = points(MAPS[family], right=fewest - 1, wrong=0)
    M, mask = twin(first, second)
    expected, expected_mask = ORIGINALS[family](first, second)
    np.testing.assert_array_equal(M, expected)
    np.testing.assert_array_equal(mask, expected_mask)
    with pytest.raises(cv2.error):
        findHomography(np.zeros((2, 2)), np.zeros((2, 2)), cv2.RANSAC)


@families
@pytest.mark.parametrize("extra", [0, 1, 3, 7])
def test_a_handful_of_right_points_is_kept(family: str, extra: int) -> None:
    """Markers and corners clicked by hand: few points, all right."""
    twin, fewest = TWINS[family]
    first, second, _ = points(MAPS[family], right=fewest + extra, wrong=0, noise_px=0.2, seed=extra)
    M, mask = twin(first, second)
    assert mask.all()
    distance = np.linalg.norm(transfer(first, as_homography(M)) - second, axis=1)
    assert distance.max() < 1.5


def test_overloads_agree() -> None:
    pair = points(MAPS["homography"])[:2]
    expected, mask = findHomography(*pair, cv2.RANSAC, 3.0, None, 2000, 0.995)
    params = cv2.UsacParams()
    params.confidence, params.threshold, params.maxIterations = 0.995, 3.0, 2000
    for arguments, options in (
        ((cv2.RANSAC,), {}),
        ((cv2.RANSAC, -1.0), {}),
        ((), {"method": cv2.USAC_MAGSAC, "confidence": 0.995}),
        ((params,), {}),
        ((), {"params": params}),
    ):
        H, again = findHomography(*pair, *arguments, **options)
        np.testing.assert_array_equal(H, expected)
        np.testing.assert_array_equal(again, mask)
    pair = points(MAPS["affine"])[:2]
    expected, mask = estimateAffine2D(*pair, None, cv2.RANSAC, 3.0, 2000, 0.99, 10)
    params.confidence = 0.99
    for arguments, options in (((), {}), ((params,), {}), ((None, cv2.LMEDS, 3.0), {"refineIters": 0})):
        M, again = estimateAffine2D(*pair, *arguments, **options)
        assert corner_error(M, as_homography(expected)) < 0.5
        assert np.mean(again == mask) > 0.97


def test_threshold_is_the_transfer_error_of_the_mask() -> None:
    first, second, _ = points(MAPS["homography"], noise_px=1.0)
    for threshold in (1.0, 3.0, 8.0):
        H, mask = findHomography(first, second, cv2.RANSAC, threshold)
        distance = np.linalg.norm(transfer(first, H) - second, axis=1)
        np.testing.assert_array_equal(mask.ravel() == 1, distance < threshold)


def test_coarse_points_need_a_generous_threshold_and_get_it() -> None:
    first, second, inlier = points(MAPS["homography"], right=60, wrong=10, noise_px=6.0)
    H, mask = findHomography(first, second, cv2.RANSAC, 15.0)
    assert mask.ravel()[inlier].mean() > 0.9
    assert corner_error(H, MAPS["homography"]) < 8.0


def test_iterations_and_seed_are_used() -> None:
    pair = points(MAPS["homography"], right=20, wrong=500, seed=3)[:2]
    few, many = (
        sum(
            findHomography(*points(MAPS["homography"], 14, 500, seed=s)[:2], cv2.RANSAC, 3.0, None, count)[1].sum()
            for s in range(5)
        )
        for count in (1, 20000)
    )
    assert few < many
    params = cv2.UsacParams()
    params.threshold, params.maxIterations = 3.0, 300
    answers = []
    for seed in (0, 0, 5):
        params.randomGeneratorState = seed
        answers.append(findHomography(*pair, params)[0])
    np.testing.assert_array_equal(answers[0], answers[1])
    assert np.any(answers[0] != answers[2])


def test_a_mask_passed_in_is_written_to() -> None:
    first, second, _ = points(MAPS["homography"])
    for function, arguments in ((findHomography, (cv2.RANSAC, 3.0)), (estimateAffine2D, ())):
        buffer = np.full((300, 1), 7, dtype=np.uint8)
        name = "mask" if function is findHomography else "inliers"
        _, mask = function(first, second, *arguments, **{name: buffer})
        assert mask is buffer
        assert set(np.unique(mask)) <= {0, 1}


@pytest.mark.parametrize("laid_out", LAYOUTS.values(), ids=LAYOUTS)
def test_layouts_of_the_points(laid_out: Callable[[np.ndarray], Any]) -> None:
    first, second, _ = points(MAPS["homography"])
    H, mask = findHomography(laid_out(first), laid_out(second), cv2.RANSAC)
    assert mask.shape == (300, 1)
    assert corner_error(H, MAPS["homography"]) < 2.0


@pytest.mark.parametrize(("scale1", "scale2"), [(1 / 640, 1 / 640), (0.01, 1.0), (1.0, 0.002), (50.0, 1.0)])
def test_planes_in_other_units(scale1: float, scale2: float) -> None:
    """Normalised points, and a floor plan in metres: the threshold is in the unit of the second points."""
    first, second, inlier = points(MAPS["homography"])
    H, mask = findHomography(scale1 * first, scale2 * second, cv2.RANSAC, 3.0 * scale2)
    H = np.diag([1 / scale2, 1 / scale2, 1]) @ H @ np.diag([scale1, scale1, 1])
    assert corner_error(H, MAPS["homography"]) < 1.5
    assert np.mean(mask.ravel() == inlier) > 0.95
    _, by_median = findHomography(scale1 * first[inlier], scale2 * second[inlier], cv2.LMEDS)
    assert by_median.mean() > 0.9


@families
def test_a_y_axis_that_points_up_is_no_obstacle(family: str) -> None:
    if family == "similarity":
        mirror = np.diag([1.0, 1.0, 1.0])  # a similarity of OpenCV's never mirrors
    else:
        mirror = np.array([[1.0, 0, 0], [0, -1, 480], [0, 0, 1]])
    first, second, inlier = points(MAPS[family] @ mirror)
    M, mask = TWINS[family][0](first, second)
    assert corner_error(M, MAPS[family] @ mirror) < 1.5
    assert mask.ravel()[inlier].mean() > 0.95


def test_a_standing_camera() -> None:
    first, second, _ = points(np.eye(3), right=300, wrong=0, noise_px=0.02)
    H, mask = findHomography(first, second, cv2.RANSAC, 5.0)
    np.testing.assert_allclose(H, np.eye(3), atol=0.01)
    assert mask.all()


@families
@pytest.mark.parametrize("count", [6, 8, 12, 30, 300])
def test_a_matrix_wherever_opencv_has_one(family: str, count: int) -> None:
    first, second = np.random.default_rng(count).uniform(0, 600, (2, count, 2))
    M, mask = TWINS[family][0](first, second)
    theirs, _ = ORIGINALS[family](first, second)
    assert M is not None or theirs is None
    assert mask.shape == (count, 1)


@pytest.mark.slow  # chance needs many draws
def test_chance_keeps_nothing() -> None:
    kept = 0
    for seed in range(20):
        first, second = np.random.default_rng(seed).uniform(0, 600, (2, 300, 2))
        kept += findHomography(first, second, cv2.RANSAC, 5.0)[1].any()
    assert kept == 0


@families
@pytest.mark.parametrize("bad", HOSTILE_POINTS.values(), ids=HOSTILE_POINTS)
def test_data_never_raises(family: str, bad: np.ndarray) -> None:
    for second in (bad, bad[::-1].copy()):
        M, mask = TWINS[family][0](bad, second)
        assert M is None or np.isfinite(M).all()
        assert (mask.shape, mask.dtype) == ((60, 1), np.uint8)


def test_points_in_three_coordinates_are_opencvs_own() -> None:
    first, second, _ = points(MAPS["homography"], wrong=0)
    ones = np.ones((120, 1))
    H, mask = findHomography(np.hstack([first, ones]), np.hstack([second, ones]), cv2.RANSAC)
    expected, _ = cv2.findHomography(np.hstack([first, ones]), np.hstack([second, ones]), cv2.RANSAC)
    np.testing.assert_array_equal(H, expected)
    assert mask.shape == (120, 1)


@pytest.mark.parametrize("arguments", [("RANSAC",), (8, "3"), (8, 3.0, 7), (8, 3.0, None, 2000, 0.99, 1)])
def test_arguments_that_fit_no_overload(arguments: tuple) -> None:
    with pytest.raises(TypeError, match="findHomography"):
        findHomography(*points(MAPS["homography"])[:2], *arguments)


def test_misuse_names_the_argument() -> None:
    first, second, _ = points(MAPS["homography"])
    with pytest.raises(ValueError, match="maxIters"):
        findHomography(first, second, cv2.RANSAC, 3.0, None, 0)
    with pytest.raises(ValueError, match="points2"):
        findHomography(first, second[:-1], cv2.RANSAC)


def test_under_the_patch() -> None:
    first, second, _ = points(MAPS["homography"])
    expected = findHomography(first, second, cv2.RANSAC, 5.0)[0]
    with patch_cv2():
        H, _ = cv2.findHomography(first, second, cv2.RANSAC, 5.0)
        least_squares, _ = cv2.findHomography(first, second)
        M, _ = cv2.estimateAffinePartial2D(first, second)
    np.testing.assert_array_equal(H, expected)
    np.testing.assert_array_equal(least_squares, cv2.findHomography(first, second)[0])
    assert M.shape == (2, 3)
