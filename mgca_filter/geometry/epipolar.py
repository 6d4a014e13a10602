"""Two-view geometry in numpy: the reference that labels, metrics and tests share.

Conventions, everywhere in the package: ``X2 = R X1 + t`` and ``x2^T E x1 = 0`` with points
normalised by their own intrinsics; ``correspondences`` is (N, 4) = (x1, y1, x2, y2).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


def cross_matrix(t: ArrayLike) -> FloatArray:
    """Matrix (3, 3) of the cross product with ``t`` (3,)."""
    x, y, z = np.asarray(t, dtype=np.float64).ravel()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


_OF_AXES = np.stack([cross_matrix(axis) for axis in np.eye(3)]).reshape(3, 9)


def cross_matrices(t: FloatArray) -> FloatArray:
    """The same (N, 3, 3) of many (N, 3)."""
    return np.asarray((t @ _OF_AXES).reshape(-1, 3, 3))


def essential_from_pose(R: ArrayLike, t: ArrayLike) -> FloatArray:
    """Essential matrix (3, 3) of the relative pose ``X2 = R X1 + t``, of unit Frobenius norm."""
    E: FloatArray = cross_matrix(t) @ np.asarray(R, dtype=np.float64)
    norm = float(np.linalg.norm(E))
    return np.asarray(E / norm if norm > 0 else E, dtype=np.float64)


def fundamental_from_essential(E: ArrayLike, K1: ArrayLike, K2: ArrayLike) -> FloatArray:
    """F (3, 3) for pixels, of unit Frobenius norm, from E and the intrinsics of both images."""
    F: FloatArray = np.linalg.inv(np.asarray(K2, float)).T @ np.asarray(E, float) @ np.linalg.inv(np.asarray(K1, float))
    return F / np.linalg.norm(F)


def homogeneous(points: ArrayLike) -> FloatArray:
    """Append a column of ones to points (N, 2)."""
    p = np.asarray(points, dtype=np.float64)
    return np.concatenate([p, np.ones((len(p), 1))], axis=1)


def homogeneous_columns(points: ArrayLike) -> FloatArray:
    """Points (N, 2) as columns (3, N) with a row of ones: products with matrices from the left are fastest so."""
    p = np.asarray(points, dtype=np.float64)
    columns = np.ones((3, len(p)))
    columns[:2] = p.T
    return columns


def _epipolar_terms(
    correspondences: ArrayLike, E: ArrayLike, stretch1: FloatArray | None = None, stretch2: FloatArray | None = None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Algebraic error (..., N) and the squared norms (..., N) of its derivatives by the points of image 2 and 1.

    These are the normals of the epipolar lines, or, through the lenses, the derivatives by what was seen.
    """
    c = np.asarray(correspondences, dtype=np.float64)
    E = np.asarray(E, dtype=np.float64)
    x1, x2 = homogeneous_columns(c[:, :2]), homogeneous_columns(c[:, 2:4])
    line2 = E @ x1  # (..., 3, N)
    normal2, normal1 = line2[..., :2, :], np.swapaxes(E, -1, -2)[..., :2, :] @ x2
    if stretch1 is not None:
        normal1 = np.einsum("...in,nij->...jn", normal1, stretch1)
    if stretch2 is not None:
        normal2 = np.einsum("...in,nij->...jn", normal2, stretch2)
    return _column_products(x2, line2), _column_products(normal2, normal2), _column_products(normal1, normal1)


def _column_products(a: FloatArray, b: FloatArray) -> FloatArray:
    """Scalar products (..., N) of columns (..., K, N)."""
    return np.asarray(np.einsum("...in,...in->...n", a, b), dtype=np.float64)


def symmetric_epipolar_distance_squared(correspondences: ArrayLike, E: ArrayLike) -> FloatArray:
    """Squared distances to both epipolar lines, summed, (N,); the field's label at 1e-4.

    (x2^T E x1)^2 (1 / |E x1|^2_12 + 1 / |E^T x2|^2_12), in the squared unit of the coordinates.
    Works for F and pixels as well.
    """
    error, n2, n1 = _epipolar_terms(correspondences, E)
    tiny = np.finfo(np.float64).tiny
    return error**2 * (1.0 / np.maximum(n2, tiny) + 1.0 / np.maximum(n1, tiny))


def sampson_distance(
    correspondences: ArrayLike, E: ArrayLike, stretch1: FloatArray | None = None, stretch2: FloatArray | None = None
) -> FloatArray:
    """First-order distance (..., N) to the epipolar geometry, in the unit of the coordinates.

    |x2^T E x1| / sqrt(|E x1|^2_12 + |E^T x2|^2_12) (Hartley & Zisserman, 2nd ed., eq. 11.9).
    Works for F and pixels as well.

    Args:
        correspondences: (N, 4). E: (..., 3, 3).
        stretch1, stretch2: (N, 2, 2), derivatives of the points by where the lens showed them, or None = none: the
            distance is then that in the distorted images.
    """
    error, n2, n1 = _epipolar_terms(correspondences, E, stretch1, stretch2)
    return np.abs(error) / np.sqrt(np.maximum(n2 + n1, np.finfo(np.float64).tiny))


def parallax(correspondences: FloatArray, R: FloatArray) -> FloatArray:
    """Sine (N,) of the angle between the viewing rays of matches (N, 4), normalised, once the rotation is undone."""
    x1, x2 = homogeneous_columns(correspondences[:, :2]), homogeneous_columns(correspondences[:, 2:])
    # A rotation keeps the length of a ray.
    lengths = np.einsum("in,in->n", x1, x1) * np.einsum("in,in->n", x2, x2)
    cosine_squared = np.einsum("in,in->n", R @ x1, x2) ** 2 / lengths
    return np.asarray(np.sqrt(np.maximum(1.0 - cosine_squared, 0.0)))


def project_to_essential(M: ArrayLike) -> FloatArray:
    """Closest matrix with singular values (s, s, 0), scaled to unit Frobenius norm."""
    U, _, Vt = np.linalg.svd(np.asarray(M, dtype=np.float64))
    projected: FloatArray = U @ np.diag([1.0, 1.0, 0.0]) @ Vt / np.sqrt(2.0)
    return projected


def decompose_essential(M: ArrayLike) -> list[tuple[FloatArray, FloatArray]]:
    """The four poses (R, t) of the essential matrix closest to ``M``; t has unit norm (Hartley & Zisserman 9.6.2).

    The smaller rotation comes first, and of a direction the sign that makes its largest part positive, so that the
    order does not depend on who computes the singular vectors.
    """
    U, _, Vt = np.linalg.svd(np.asarray(M, dtype=np.float64))
    turned = np.stack([U[:, 1], -U[:, 0], U[:, 2]], axis=1)  # U W
    rotations = np.stack([turned, turned * (-1.0, -1.0, 1.0)]) @ Vt
    if np.linalg.det(rotations[0]) < 0.0:
        rotations = -rotations
    smaller = int(np.trace(rotations[1]) > np.trace(rotations[0]))
    t = U[:, 2]
    if t[np.argmax(np.abs(t))] < 0.0:
        t = -t
    return [(rotations[i], sign * t) for i in (smaller, 1 - smaller) for sign in (1.0, -1.0)]


def triangulated_depths(correspondences: ArrayLike, R: ArrayLike, t: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Depths (N,), (N,) in camera 1 and 2 of the points closest to both viewing rays.

    Least squares of ``d2 x2 = d1 R x1 + t`` (mid-point of the rays), in the unit of ``t``. Rays that
    are parallel to the accuracy of float64 give infinite depths.
    """
    c = np.asarray(correspondences, dtype=np.float64)
    t = np.asarray(t, dtype=np.float64).ravel()
    a = np.asarray(R, dtype=np.float64) @ homogeneous_columns(c[:, :2])
    b = homogeneous_columns(c[:, 2:4])
    aa, bb, ab = _column_products(a, a), _column_products(b, b), _column_products(a, b)
    at, bt = t @ a, t @ b
    det = aa * bb - ab**2
    with np.errstate(divide="ignore", invalid="ignore"):
        depth1 = (ab * bt - bb * at) / det
        depth2 = (aa * bt - ab * at) / det
    parallel = det <= 1e-15 * aa * bb
    return np.where(parallel, np.inf, depth1), np.where(parallel, np.inf, depth2)


def rotation_error_deg(R_estimated: ArrayLike, R_true: ArrayLike) -> float:
    """Geodesic angle between two rotations, degrees, 0 … 180."""
    cosine = (np.trace(np.asarray(R_estimated, float).T @ np.asarray(R_true, float)) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def translation_error_deg(t_estimated: ArrayLike, t_true: ArrayLike) -> float:
    """Angle between two translation directions with the sign ignored, degrees, 0 … 90."""
    a, b = np.ravel(np.asarray(t_estimated, float)), np.ravel(np.asarray(t_true, float))
    norm = np.linalg.norm(a) * np.linalg.norm(b)
    if norm == 0:
        return 90.0
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(float(a @ b)))))


def pose_error_deg(R_estimated: ArrayLike, t_estimated: ArrayLike, R_true: ArrayLike, t_true: ArrayLike) -> float:
    """Larger of rotation and translation error, degrees: the pose error of the field's protocol."""
    return max(rotation_error_deg(R_estimated, R_true), translation_error_deg(t_estimated, t_true))
