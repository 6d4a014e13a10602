"""Weighted eight-point algorithm from matrix products alone, so that it lives in the exported graph.

What is linear in an essential matrix, or in the products of two small vectors, is one product with a constant table:
the fewer operations a graph has, the faster runtimes open it.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

SQUARINGS = 20
SQUARINGS_PER_NORMALISATION = 4  # the largest eigenvalue, at least 1/9, to the 16th is far above the smallest float32
MINIMUM_POINTS = 16  # below this the essential matrix of the network is arbitrary
LABEL_DISTANCE = 1e-4

Array = NDArray[np.float64]

# x2 ⊗ x1, row by row of E, is a product of two selections from (x1, y1, x2, y2, 1).
_OF_IMAGE1, _OF_IMAGE2 = np.zeros((5, 9)), np.zeros((5, 9))
for _i, _row in enumerate((2, 3, 4)):
    for _j, _column in enumerate((0, 1, 4)):
        _OF_IMAGE1[_column, 3 * _i + _j] = _OF_IMAGE2[_row, 3 * _i + _j] = 1.0
# Half of the sum over both coordinates of an image, for each of the four coordinates.
_PER_IMAGE = np.kron(np.eye(2), np.full((2, 2), 0.5)).astype(np.float64)


def _conditioning_table() -> tuple[Array, Array]:
    """(s, s c) of four coordinates @ table + offset = both transforms, row by row, image 2's transposed.

    T = [[s, 0, -s cx], [0, s, -s cy], [0, 0, 1]].
    """
    table, offset = np.zeros((8, 2, 3, 3)), np.zeros((2, 3, 3))
    for image in range(2):
        for axis in range(2):
            table[2 * image + axis, image, axis, axis] = 1.0
            table[4 + 2 * image + axis, image, axis, 2] = -1.0
        offset[image, 2, 2] = 1.0
    table[:, 1] = table[:, 1].transpose(0, 2, 1)
    return table.reshape(8, 18), offset.reshape(18)


def lines_table() -> Array:
    """vec(E) @ table, as (9, 5): x2 ⊗ x1 @ that = x2ᵀ E x1, then a and b of the epipolar lines E x1 and Eᵀ x2."""
    table = np.zeros((3, 3, 3, 3, 5))  # entry of E; entry of x2 ⊗ x1; column
    for i in range(3):
        for j in range(3):
            table[i, j, i, j, 0] = 1.0
            if i < 2:
                table[i, j, 2, j, 1 + i] = 1.0
            if j < 2:
                table[i, j, i, 2, 3 + j] = 1.0
    return table.reshape(9, 45)


_CONDITIONING, _CONDITIONING_OFFSET = _conditioning_table()
_LINES = lines_table()
_NORMALS = np.array([[0, 0], [1, 0], [1, 0], [0, 1], [0, 1]])


def constant(values: Array, like: Tensor) -> Tensor:
    """A table of numbers as a tensor of the type and on the device of another."""
    return torch.tensor(values, dtype=like.dtype, device=like.device)


def smallest_eigenvector(A: Tensor) -> Tensor:
    """Unit eigenvectors (B, n) of the smallest eigenvalues of symmetric positive semi-definite A (B, n, n).

    tr(A) I − A has the same eigenvectors in reversed order; squaring it 20 times leaves the outer product of
    the wanted one with itself, of which the row with the largest entry is taken. No LAPACK.
    """
    v = smallest_eigenvector_row(A)[:, 0]
    return v / v.norm(dim=-1, keepdim=True)


def smallest_eigenvector_row(A: Tensor) -> Tensor:
    """The eigenvectors as rows (B, 1, n), not of unit length."""
    eye = torch.eye(A.shape[-1], device=A.device, dtype=A.dtype)
    M = eye - A / (A * eye).sum((1, 2), keepdim=True).clamp_min(1e-30)
    for step in range(1, SQUARINGS + 1):
        M = M @ M
        if step % SQUARINGS_PER_NORMALISATION == 0:
            M = M / M.amax((1, 2), keepdim=True)  # on the diagonal
    largest = M.amax(2).argmax(-1, keepdim=True)  # its largest entry is on the diagonal
    return F.embedding(largest, eye) @ M


def homogeneous_products(correspondences: Tensor) -> Tensor:
    """x2 ⊗ x1 (B, N, 9) of correspondences (B, N, 4): its product with vec(E) is x2ᵀ E x1."""
    x = F.pad(correspondences, (0, 1), value=1.0)  # (B, N, 5)
    return (x @ constant(_OF_IMAGE1, x)) * (x @ constant(_OF_IMAGE2, x))


def weighted_eight_point(correspondences: Tensor, weights: Tensor) -> Tensor:
    """Essential matrices (B, 3, 3) of unit Frobenius norm, sign free, not forced to rank 2.

    Args:
        correspondences: (B, N, 4) on the normalised image planes.
        weights: (B, N), non-negative, of sum 1.

    Hartley's conditioning with the weights — each image's points centred and scaled to a weighted mean square of 2 —,
    then the smallest eigenvector of Σ w φ φᵀ.
    """
    row = weights.unsqueeze(1)  # (B, 1, N)
    centre = row @ correspondences  # (B, 1, 4)
    centred = correspondences - centre
    spread = (row @ centred.square()) @ constant(_PER_IMAGE, centred)
    scale = torch.rsqrt(spread + 1e-8)  # (B, 1, 4), two equal ones of each image
    phi = homogeneous_products(centred * scale)  # (B, N, 9)
    E = smallest_eigenvector_row((phi.transpose(1, 2) * row) @ phi).view(-1, 1, 3, 3)
    transforms = torch.cat([scale, scale * centre], -1) @ constant(_CONDITIONING, E) + constant(_CONDITIONING_OFFSET, E)
    image1, image2 = transforms.view(-1, 2, 3, 3).split(1, 1)
    # Divided as a vector: else OpenCV, which forgets the shape of what it reshaped, warns of every answer.
    vector = (image2 @ E @ image1).reshape(-1, 1, 9)
    return (vector / vector.norm(dim=2, keepdim=True)).view(-1, 3, 3)


def symmetric_epipolar_distance_squared(correspondences: Tensor, E: Tensor, unit: float = 1.0) -> Tensor:
    """Squared symmetric epipolar distances (B, N) of correspondences (B, N, 4) to E (B, 3, 3), in a unit."""
    table = (E.reshape(-1, 1, 9) @ constant(_LINES, E)).view(-1, 9, 5)
    squares = (homogeneous_products(correspondences) @ table).square()  # of the error and of both lines' coefficients
    normals = squares @ constant(unit * _NORMALS, E) + unit * 1e-15  # (B, N, 2)
    return (squares[..., :1] / normals).sum(-1)


def residual_channel(correspondences: Tensor, E: Tensor, floor: float = 1e-2) -> Tensor:
    """Epipolar residual (B, N) as the next stage sees it: half of log10 of distance² over the label's 1e-4, up to 1.5.

    The published code feeds the bare residual; right and wrong matches differ by factors, hence the logarithm. Its
    ``floor`` (distance² over 1e-4) is a tenth of the label's distance by default: finer, and the rounding errors of the
    eight-point algorithm would decide.
    """
    distance = symmetric_epipolar_distance_squared(correspondences, E, LABEL_DISTANCE)
    return (torch.log(distance + floor) * (0.5 / math.log(10.0))).clamp_max(1.5)
