"""Weighted eight-point algorithm from matrix products alone, so that it lives in the exported graph."""

from __future__ import annotations

import torch
from torch import Tensor

SQUARINGS = 20
SQUARINGS_PER_NORMALISATION = 4  # (1 / 9)^16 is far above the smallest float32
MINIMUM_POINTS = 16  # below this the essential matrix of the network is arbitrary
LABEL_DISTANCE = 1e-4


def smallest_eigenvector(A: Tensor) -> Tensor:
    """Unit eigenvectors (B, n) of the smallest eigenvalues of symmetric positive semi-definite A (B, n, n).

    tr(A) I − A has the same eigenvectors in reversed order; squaring it 20 times leaves the outer product of
    the wanted one with itself, of which the column with the largest diagonal entry is taken. No LAPACK.
    """
    eye = torch.eye(A.shape[-1], device=A.device, dtype=A.dtype)

    def unit_trace(M: Tensor) -> Tensor:
        return M / (M * eye).sum((-2, -1), keepdim=True).clamp_min(1e-30)

    M = unit_trace(unit_trace(A) * -1.0 + eye)
    for step in range(1, SQUARINGS + 1):
        M = M @ M
        if step % SQUARINGS_PER_NORMALISATION == 0:
            M = unit_trace(M)
    column = (M * eye).sum(-1).argmax(-1).view(-1, 1, 1)
    v = M.gather(2, column.expand(-1, M.shape[1], 1))[..., 0]
    return v / (v * v).sum(-1, keepdim=True).clamp_min(1e-30).sqrt()


def _conditioning(points: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Points (B, N, 2) centred and scaled to a weighted mean square of 2; centre (B, 1, 2), scale (B, 1, 1)."""
    centre = (points * weights).sum(1, keepdim=True)
    centred = points - centre
    spread = (centred.square() * weights).sum((1, 2), keepdim=True)
    scale = torch.rsqrt(0.5 * spread + 1e-8)
    return centred * scale, centre, scale


def _undo_conditioning(M: Tensor, centre: Tensor, scale: Tensor) -> Tensor:
    """M T (B, 3, 3) with T = [[s, 0, -s cx], [0, s, -s cy], [0, 0, 1]], the transform of the conditioning."""
    scaled = M[..., :2] * scale
    return torch.cat([scaled, M[..., 2:] - (scaled * centre).sum(-1, keepdim=True)], -1)


def weighted_eight_point(correspondences: Tensor, weights: Tensor) -> Tensor:
    """Essential matrices (B, 3, 3) of unit Frobenius norm, sign free, not forced to rank 2.

    Args:
        correspondences: (B, N, 4) on the normalised image planes.
        weights: (B, N), non-negative, of sum 1.

    Hartley's conditioning with the weights, then the smallest eigenvector of Σ w φ φᵀ.
    """
    w = weights.unsqueeze(-1)  # (B, N, 1)
    p1, centre1, scale1 = _conditioning(correspondences[..., :2], w)
    p2, centre2, scale2 = _conditioning(correspondences[..., 2:], w)
    q1 = torch.cat([p1, torch.ones_like(w)], -1)
    # φ holds x2 ⊗ x1, row by row of E.
    phi = torch.cat([p2[..., 0:1] * q1, p2[..., 1:2] * q1, q1], -1)  # (B, N, 9)
    v = smallest_eigenvector((phi * w).transpose(1, 2) @ phi)
    E = _undo_conditioning(v.view(-1, 3, 3), centre1, scale1)
    E = _undo_conditioning(E.transpose(1, 2), centre2, scale2).transpose(1, 2)
    return E / E.square().sum((-2, -1), keepdim=True).clamp_min(1e-30).sqrt()


def symmetric_epipolar_distance_squared(correspondences: Tensor, E: Tensor) -> Tensor:
    """Squared symmetric epipolar distances (B, N) of correspondences (B, N, 4) to E (B, 3, 3)."""
    one = torch.ones_like(correspondences[..., :1])
    x1 = torch.cat([correspondences[..., :2], one], -1)  # (B, N, 3)
    x2 = torch.cat([correspondences[..., 2:], one], -1)
    line2, line1 = x1 @ E.transpose(1, 2), x2 @ E
    error = (x2 * line2).sum(-1)
    n2, n1 = line2[..., :2].square().sum(-1), line1[..., :2].square().sum(-1)
    return error.square() * (1.0 / (n2 + 1e-15) + 1.0 / (n1 + 1e-15))


def residual_channel(correspondences: Tensor, E: Tensor, floor: float = 1e-2) -> Tensor:
    """Epipolar residual (B, N) as the next stage sees it: half of log10 of distance² over the label's 1e-4, up to 1.5.

    The published code feeds the bare residual; right and wrong matches differ by factors, hence the logarithm. Its
    ``floor`` (distance² over 1e-4) is a tenth of the label's distance by default: finer, and the rounding errors of the
    eight-point algorithm would decide.
    """
    distance = symmetric_epipolar_distance_squared(correspondences, E) / LABEL_DISTANCE
    return torch.log10(distance + floor).clamp_max(3.0) * 0.5
