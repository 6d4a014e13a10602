"""OpenCV's twins: the names, orders, types and habits of the functions that they stand in for."""

from __future__ import annotations

import inspect
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import SIZE, K, Scene, make_scene
from point_arrays import HOSTILE_POINTS, LAYOUTS

import mgca_filter
from mgca_filter import Status, filter_matches, findEssentialMat, findFundamentalMat, matchMGCA, patch_cv2
from mgca_filter.geometry.epipolar import pose_error_deg, rotation_error_deg, sampson_distance
from mgca_filter.opencv.twins import (
    _AFFINE_OVERLOADS,
    _ESSENTIAL_OVERLOADS,
    _FUNDAMENTAL_OVERLOADS,
    _HOMOGRAPHY_OVERLOADS,
    _SIMILARITY_OVERLOADS,
    estimateAffine2D,
    estimateAffinePartial2D,
    findHomography,
)

TWINS = {"E": lambda p1, p2: findEssentialMat(p1, p2, K), "F": findFundamentalMat}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(right=150, wrong=100)


def forms(function: Callable[..., Any]) -> list[list[str]]:
    """Parameter names of every overload, as OpenCV's own documentation lists them."""
    lines = re.findall(rf"^{function.__name__}\((.*)\) ->", function.__doc__ or "", re.MULTILINE)
    return [re.findall(r"\w+", line) for line in lines]


@pytest.mark.parametrize(
    ("original", "twins"),
    [
        (cv2.findEssentialMat, _ESSENTIAL_OVERLOADS),
        (cv2.findFundamentalMat, _FUNDAMENTAL_OVERLOADS),
        (cv2.findHomography, _HOMOGRAPHY_OVERLOADS),
        (cv2.estimateAffine2D, _AFFINE_OVERLOADS),
        (cv2.estimateAffinePartial2D, _SIMILARITY_OVERLOADS),
        (cv2.xfeatures2d.matchGMS, [matchMGCA]),
    ],
)
def test_every_overload_of_this_opencv_has_a_twin(original: Callable, twins: list[Callable]) -> None:
    documented = forms(original)
    assert documented
    for names in documented:
        assert names in [list(inspect.signature(twin).parameters) for twin in twins]


def test_none_stands_for_a_default_as_in_opencv(scene: Scene) -> None:
    """Scripts written for the signature of OpenCV 4.4 give the mask, None, where newer ones have maxIters."""
    points = scene.points1, scene.points2
    for function, arguments in (
        (findEssentialMat, (K, cv2.RANSAC, 0.999, 1.0, None)),
        (findEssentialMat, (K, None, None, None, None, None)),
        (findFundamentalMat, (cv2.FM_RANSAC, 3.0, 0.99, None)),
        (findFundamentalMat, (None, None, None)),
    ):
        getattr(cv2, function.__name__)(*points, *arguments)
        defaults = function(*points, *[value for value in arguments if value is K])
        for answer, expected in zip(function(*points, *arguments), defaults):
            np.testing.assert_array_equal(answer, expected)


def test_essential_matrix_is_what_opencv_users_expect(scene: Scene) -> None:
    E, mask = findEssentialMat(scene.points1, scene.points2, K, cv2.RANSAC, 0.999, 1.0)
    assert E.shape == (3, 3)
    assert E.dtype == np.float64
    assert mask.shape == (250, 1)
    assert mask.dtype == np.uint8
    assert set(np.unique(mask)) == {0, 1}
    np.testing.assert_allclose(np.linalg.svd(E, compute_uv=False), [0.5**0.5, 0.5**0.5, 0], atol=1e-9)
    assert np.mean(mask.ravel() == scene.inlier) > 0.9
    _, R, t, _ = cv2.recoverPose(E, scene.points1, scene.points2, K, mask=mask)
    assert pose_error_deg(R, t, scene.R, scene.t) < 1.0


def test_fundamental_matrix_is_what_opencv_users_expect(scene: Scene) -> None:
    F, mask = findFundamentalMat(scene.points1, scene.points2, cv2.FM_RANSAC, 1.0, 0.99)
    assert F[2, 2] == pytest.approx(1.0)
    assert np.linalg.matrix_rank(F, tol=1e-6 * np.linalg.norm(F)) == 2
    assert mask.shape == (250, 1)
    pixels = np.hstack([scene.points1, scene.points2])
    np.testing.assert_array_equal(mask.ravel() == 1, sampson_distance(pixels, F) < 1.0)


def test_overloads_of_one_camera_agree(scene: Scene) -> None:
    points = (scene.points1, scene.points2)
    expected, mask = findEssentialMat(*points, K)
    params = cv2.UsacParams()
    params.confidence, params.threshold, params.maxIterations = 0.999, 1.0, 1000
    for arguments, options in (
        ((K, cv2.RANSAC, 0.999, 1.0, 1000), {}),
        ((), {"cameraMatrix": K, "method": cv2.USAC_ACCURATE}),
        ((800.0, (319.5, 239.5)), {}),
        ((), {"focal": 800.0, "pp": (319.5, 239.5), "prob": 0.999}),
        ((K, None, K, None), {}),
        ((K, np.zeros(5), K, np.zeros((1, 5)), cv2.RANSAC, 0.999, 1.0), {}),
        ((K, np.array([]), K, np.array([])), {"threshold": 1.0}),
        ((K, K, None, None, params), {}),
    ):
        E, again = findEssentialMat(*points, *arguments, **options)
        np.testing.assert_array_equal(E, expected)
        np.testing.assert_array_equal(again, mask)


def test_overloads_of_the_fundamental_matrix_agree(scene: Scene) -> None:
    points = (scene.points1, scene.points2)
    expected, mask = findFundamentalMat(*points)
    params = cv2.UsacParams()
    params.confidence, params.threshold, params.maxIterations = 0.99, 3.0, 1000
    for arguments in ((cv2.FM_RANSAC, 3.0, 0.99), (cv2.FM_LMEDS, 3.0, 0.99, 1000), (params,), (cv2.RANSAC, -1.0, 7.0)):
        F, again = findFundamentalMat(*points, *arguments)
        np.testing.assert_array_equal(F, expected)
        np.testing.assert_array_equal(again, mask)


@pytest.mark.parametrize("laid_out", LAYOUTS.values(), ids=LAYOUTS)
def test_layouts_of_the_points(scene: Scene, laid_out: Callable[[np.ndarray], Any]) -> None:
    E, mask = findEssentialMat(laid_out(scene.points1), laid_out(scene.points2), K, threshold=2.0)
    assert mask.shape == (250, 1)
    _, R, t, _ = cv2.recoverPose(E, scene.points1, scene.points2, K, mask=mask)
    assert pose_error_deg(R, t, scene.R, scene.t) < 3.0


def test_two_cameras_and_their_distortion(scene: Scene) -> None:
    bend = np.array([-0.2, 0.05, 0.001, -0.001, 0.0])
    K2 = np.array([[950.0, 0, 300.0], [0, 950.0, 260.0], [0, 0, 1]])
    rays = [np.column_stack([(p - K[:2, 2]) / K[0, 0], np.ones(250)]) for p in (scene.points1, scene.points2)]
    zero = np.zeros(3)
    points1 = cv2.projectPoints(rays[0], zero, zero, K, bend)[0]
    points2 = cv2.projectPoints(rays[1], zero, zero, K2, None)[0]
    E, mask = findEssentialMat(points1, points2, K, bend, K2, None)
    _, E2, R, t, mask2 = cv2.recoverPose(points1, points2, K, bend, K2, None)
    assert mask.sum() > 120
    params = cv2.UsacParams()
    again, _ = findEssentialMat(points1, points2, K, K2, bend, None, params)
    for found in (E, again):
        normalised = [cv2.undistortPoints(points1, K, bend), cv2.undistortPoints(points2, K2, None)]
        _, R, t, _ = cv2.recoverPose(found, normalised[0], normalised[1], np.eye(3), mask=mask.copy())
        assert pose_error_deg(R, t, scene.R, scene.t) < 1.0


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int32, np.int64, np.uint16])
@pytest.mark.parametrize("shape", [(-1, 2), (-1, 1, 2)])
def test_two_cameras_in_every_type_of_points(dtype: type, shape: tuple[int, ...]) -> None:
    """OpenCV itself raises on integers there: they are not undistorted."""
    scene = make_scene(right=300, wrong=120, noise_px=0.0)
    K2 = np.array([[450.0, 0.0, 319.5], [0.0, 450.0, 239.5], [0.0, 0.0, 1.0]])
    rays2 = (scene.points2 - K[:2, 2]) / K[0, 0]
    points1, points2 = (np.clip(p, 0, 2000) for p in (scene.points1, rays2 * 450.0 + K2[:2, 2]))
    if np.issubdtype(dtype, np.integer):
        points1, points2 = np.round(points1), np.round(points2)
    first, second = (np.ascontiguousarray(p.astype(dtype).reshape(shape)) for p in (points1, points2))
    for E, mask in (
        findEssentialMat(first, second, K, None, K2, None),
        findEssentialMat(
            points1=first, points2=second, cameraMatrix1=K, distCoeffs1=None, cameraMatrix2=K2, distCoeffs2=None
        ),
    ):
        normalised = [(points1 - K[:2, 2]) / K[0, 0], (points2 - K2[:2, 2]) / 450.0]
        _, R, t, _ = cv2.recoverPose(E, *normalised, np.eye(3), mask=mask.copy())
        assert pose_error_deg(R, t, scene.R, scene.t) < 2.0
        assert mask[scene.inlier].mean() > 0.75


def test_forward_motion_of_a_visual_odometry_front_end() -> None:
    """Normalised points in the order current, reference, focal 1, principal point (0, 0), a threshold of 0.0003."""
    rng = np.random.default_rng(0)
    camera = np.array([[718.9, 0.0, 607.2], [0.0, 718.9, 185.2], [0.0, 0.0, 1.0]])
    u = rng.uniform((0, 0), (1241, 376), (800, 2))
    reference = (u - camera[:2, 2]) / camera[0, 0]
    X = np.column_stack([reference, np.ones(800)]) * rng.uniform(6, 60, (800, 1))
    R_true, t_true = cv2.Rodrigues(np.array([0.01, -0.03, 0.0]))[0], np.array([0.03, -0.01, -1.0])
    Y = X @ R_true.T + t_true
    current = Y[:, :2] / Y[:, 2:]
    reference, current = (x + rng.normal(0, 0.2 / camera[0, 0], x.shape) for x in (reference, current))
    current[400:] = current[400 + rng.permutation(400)]
    E, mask = findEssentialMat(
        current, reference, focal=1, pp=(0.0, 0.0), method=cv2.RANSAC, prob=0.999, threshold=0.0003
    )
    _, R, t, _ = cv2.recoverPose(E, current, reference, focal=1, pp=(0.0, 0.0), mask=mask.copy())
    assert pose_error_deg(R, t, R_true.T, -R_true.T @ t_true) < 1.5
    assert mask[:400].mean() > 0.5
    assert mask[400:].mean() < 0.1


def test_normalised_points_give_what_pixels_give(scene: Scene) -> None:
    x1, x2 = ((p - K[:2, 2]) / K[0, 0] for p in (scene.points1, scene.points2))
    pixels_E, pixels_mask = findEssentialMat(scene.points1, scene.points2, K, threshold=0.8)
    for E, mask in (
        findEssentialMat(x1, x2, np.eye(3), threshold=1e-3),
        findEssentialMat(x1, x2, threshold=1e-3),
    ):
        _, R, t, _ = cv2.recoverPose(E, x1, x2, np.eye(3), mask=mask.copy())
        assert pose_error_deg(R, t, scene.R, scene.t) < 1.0
        assert np.mean(mask == pixels_mask) > 0.97
    F, mask = findFundamentalMat(x1, x2, cv2.FM_RANSAC, 1e-3, 0.99)
    assert np.mean(mask.ravel() == scene.inlier) > 0.85
    assert np.median(sampson_distance(np.hstack([x1, x2]), F)[scene.inlier]) < 1e-3


@pytest.fixture(scope="module")
def hard() -> Scene:
    return make_scene(right=40, wrong=300, noise_px=0.8, seed=2)  # not solved by the first sample


@pytest.mark.parametrize("options", [{"prob": 0.01}, {"maxIters": 1}], ids=str)
def test_every_argument_of_the_fit_counts(hard: Scene, options: dict) -> None:
    E, _ = findEssentialMat(hard.points1, hard.points2, K)
    other, _ = findEssentialMat(hard.points1, hard.points2, K, **options)
    assert other is None or not np.array_equal(E, other)


@pytest.mark.parametrize("method", [cv2.LMEDS, cv2.RHO, cv2.USAC_MAGSAC, cv2.USAC_PROSAC, cv2.USAC_FAST])
def test_all_robust_methods_are_one(scene: Scene, method: int) -> None:
    E, mask = findEssentialMat(scene.points1, scene.points2, K)
    other, other_mask = findEssentialMat(scene.points1, scene.points2, K, method)
    np.testing.assert_array_equal(E, other)
    np.testing.assert_array_equal(mask, other_mask)


def test_parameters_of_usac_count(hard: Scene) -> None:
    def answer(**changes: Any) -> np.ndarray:
        params = cv2.UsacParams()
        for name, value in changes.items():
            setattr(params, name, value)
        return findFundamentalMat(hard.points1, hard.points2, params)

    F, mask = answer()
    assert not np.array_equal(answer(randomGeneratorState=3)[0], F)
    assert answer(threshold=20.0)[1].sum() > mask.sum()


def test_threshold_moves_the_mask_only(scene: Scene) -> None:
    (E, tight), (again, loose) = (findEssentialMat(scene.points1, scene.points2, K, threshold=t) for t in (0.2, 4.0))
    np.testing.assert_array_equal(E, again)
    assert tight.sum() < loose.sum()


def test_a_mask_passed_in_is_written_to(scene: Scene) -> None:
    buffer = np.full((250, 1), 7, dtype=np.uint8)
    _, mask = findEssentialMat(scene.points1, scene.points2, K, mask=buffer)
    assert mask is buffer
    np.testing.assert_array_equal(mask, findEssentialMat(scene.points1, scene.points2, K)[1])
    _, other = findFundamentalMat(scene.points1, scene.points2, mask=np.zeros(3, np.uint8))
    assert other.shape == (250, 1)


def test_solvers_are_opencvs_own(scene: Scene) -> None:
    right = scene.inlier
    for method, rows in ((cv2.FM_8POINT, np.flatnonzero(right)), (cv2.FM_7POINT, np.flatnonzero(right)[:7])):
        points = (scene.points1[rows], scene.points2[rows])
        F, mask = findFundamentalMat(*points, method)
        expected, _ = cv2.findFundamentalMat(*points, method)
        np.testing.assert_array_equal(F, expected)
        assert mask.shape == (len(rows), 1)
    assert findFundamentalMat(np.zeros((3, 2)), np.zeros((3, 2)), cv2.FM_8POINT)[0] is None


def test_a_rotation_keeps_its_matches_and_a_matrix_to_hand_on() -> None:
    turned = make_scene("rotation")
    E, mask = findEssentialMat(turned.points1, turned.points2, K)
    assert mask[turned.inlier].mean() > 0.8
    _, R, _, _ = cv2.recoverPose(E, turned.points1, turned.points2, K, mask=mask)
    assert rotation_error_deg(R, turned.R) < 1.0


@pytest.mark.parametrize("seed", range(3))
def test_a_standing_camera_does_not_stop_an_unchanged_script(seed: int) -> None:
    rng = np.random.default_rng(seed)
    before = rng.uniform((0, 0), (640, 480), (500, 2)).astype(np.float32)
    after = before + rng.normal(0, 0.02, before.shape).astype(np.float32)
    with mgca_filter.patch_cv2():
        E, mask = cv2.findEssentialMat(after, before, K, cv2.RANSAC, 0.999, 1.0)
        _, R, _, _ = cv2.recoverPose(E, after, before, K, mask=mask.copy())
        F, _ = cv2.findFundamentalMat(after, before, cv2.FM_RANSAC)
    assert rotation_error_deg(R, np.eye(3)) < 1.0
    assert mask.mean() > 0.9
    assert F.shape == (3, 3)


@pytest.mark.parametrize("count", [5, 6, 7, 8, 30])
def test_a_matrix_wherever_opencv_has_one(count: int) -> None:
    points1, points2 = np.random.default_rng(count).uniform(0, 600, (2, count, 2))
    E, mask = findEssentialMat(points1, points2, K)
    theirs, _ = cv2.findEssentialMat(points1, points2, K)
    assert (E is None) == (theirs is None)
    assert E is None or E.shape == (3, 3)
    assert not mask.any()


@pytest.mark.parametrize("arguments", [("K",), (K, "ransac"), (K, None, K), (K, 8, 0.999, 1.0, 1000, None, 1)])
def test_arguments_that_fit_no_overload(scene: Scene, arguments: tuple) -> None:
    with pytest.raises(TypeError, match="findEssentialMat"):
        findEssentialMat(scene.points1, scene.points2, *arguments)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"prob": 1.0}, "prob"),
        ({"threshold": 0.0}, "threshold"),
        ({"maxIters": 0}, "maxIters"),
        ({"points2": np.zeros((3, 2))}, "points2"),
        ({"points1": np.zeros((250, 3))}, "points1"),
        ({"cameraMatrix": np.zeros((2, 2))}, "K1"),
    ],
)
def test_misuse_names_the_argument(scene: Scene, options: dict, word: str) -> None:
    arguments = {"points1": scene.points1, "points2": scene.points2, "cameraMatrix": K, **options}
    with pytest.raises(ValueError, match=word):
        findEssentialMat(**arguments)


@pytest.mark.parametrize("twin", TWINS.values(), ids=TWINS)
@pytest.mark.parametrize(
    "points",
    [
        *(np.random.default_rng(0).uniform(0, 400, (n, 2)) for n in range(8)),
        *HOSTILE_POINTS.values(),
    ],
    ids=[*map(str, range(8)), *HOSTILE_POINTS],
)
def test_data_never_raises(twin: Callable, points: np.ndarray) -> None:
    other = points[::-1].copy()
    for second in (points, other):
        with np.errstate(all="raise"):  # as in a program that wants numpy to raise
            M, mask = twin(points, second)
        assert M is None or M.shape == (3, 3)
        assert mask.shape == (len(points), 1)
        assert mask.dtype == np.uint8


@pytest.mark.slow  # chance needs many draws
def test_only_outliers_keep_nothing() -> None:
    draws = [np.random.default_rng(seed).uniform(0, 600, (2, 300, 2)) for seed in range(20)]
    answers = {name: [twin(*points) for points in draws] for name, twin in TWINS.items()}
    assert sum(mask.any() for _, mask in answers["E"]) <= 1
    # Without intrinsics chance fits better: of uniformly random points one F in ten passes.
    assert sum(mask.any() for _, mask in answers["F"]) <= 2


def test_twenty_thousand_points() -> None:
    many = make_scene(right=14000, wrong=6000)
    E, mask = findEssentialMat(many.points1, many.points2, K)
    assert E.shape == (3, 3)
    assert mask.shape == (20000, 1)
    assert mask[many.inlier].mean() > 0.9


def test_match_mgca_returns_the_kept_matches(scene: Scene) -> None:
    kp1, kp2 = scene.keypoints()
    knn = scene.knn_matches()
    flat = [row[0] for row in knn]
    kept = matchMGCA(SIZE, SIZE, kp1, kp2, flat)
    assert isinstance(kept, tuple)
    expected = filter_matches(kp1, kp2, flat, size1=SIZE, size2=SIZE).matches
    assert [m.queryIdx for m in kept] == [m.queryIdx for m in expected]
    assert np.mean(scene.inlier[[m.queryIdx for m in kept]]) > 0.9
    assert matchMGCA(SIZE, SIZE, kp1, kp2, flat, withRotation=True, withScale=True, thresholdFactor=2.0) == kept
    assert all(isinstance(m, cv2.DMatch) for m in matchMGCA(SIZE, SIZE, kp1, kp2, knn))
    assert matchMGCA(SIZE, SIZE, kp1, kp2, []) == ()


def originals() -> tuple[Callable, ...]:
    return (
        cv2.findEssentialMat,
        cv2.findFundamentalMat,
        cv2.findHomography,
        cv2.estimateAffine2D,
        cv2.estimateAffinePartial2D,
        cv2.xfeatures2d.matchGMS,
    )


OPENCV = originals()


@pytest.fixture(autouse=True)
def _opencv_is_itself_again() -> Iterator[None]:
    yield
    assert originals() == OPENCV


def test_patch_swaps_and_restores(scene: Scene) -> None:
    with patch_cv2():
        assert originals() == (
            findEssentialMat,
            findFundamentalMat,
            findHomography,
            estimateAffine2D,
            estimateAffinePartial2D,
            matchMGCA,
        )
        E, _ = cv2.findEssentialMat(scene.points1, scene.points2, K)
    np.testing.assert_array_equal(E, findEssentialMat(scene.points1, scene.points2, K)[0])
    assert originals() == OPENCV


def test_patch_restores_after_an_exception_and_when_nested() -> None:
    with pytest.raises(cv2.error), patch_cv2(), patch_cv2():
        cv2.findHomography(np.zeros((2, 2)), np.zeros((2, 2)))
    assert originals() == OPENCV
    with patch_cv2():
        with patch_cv2():
            pass
        assert originals() != OPENCV


def test_patch_overlapping_in_threads_ends_with_the_last() -> None:
    first, second = ExitStack(), ExitStack()
    barrier = threading.Barrier(2, timeout=30)

    def hold() -> None:
        with second:
            second.enter_context(patch_cv2())
            barrier.wait()
            barrier.wait()

    thread = threading.Thread(target=hold)
    first.enter_context(patch_cv2())
    thread.start()
    barrier.wait()
    first.close()
    assert originals() != OPENCV
    barrier.wait()
    thread.join()
    assert originals() == OPENCV


def test_the_filter_itself_is_the_same_under_the_patch(scene: Scene) -> None:
    plain = filter_matches(scene.points1, scene.points2, None, K1=K)
    with patch_cv2():
        patched = filter_matches(scene.points1, scene.points2, None, K1=K)
    assert plain.status is patched.status is Status.OK
    np.testing.assert_array_equal(plain.E, patched.E)


def test_public_names() -> None:
    assert {"findEssentialMat", "findFundamentalMat", "matchMGCA", "patch_cv2"} <= set(mgca_filter.__all__)
