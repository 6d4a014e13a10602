"""What training minimises: classification of every match and geometry of every essential matrix."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from ..network import NetworkOutput
from ..network.eight_point import symmetric_epipolar_distance_squared
from ..network.essential_refinement import refine_essential
from .pairs import NEGATIVE, POSITIVE

GEOMETRIC_CLAMP = 0.1
REFINED_DISTANCE = 1e-4  # squared: about ten pixels, half a degree


def balanced_cross_entropy(logits: Tensor, labels: Tensor) -> Tensor:
    """Cross-entropy in which right and wrong matches weigh one half each, per pair; mean over pairs.

    ``logits`` and ``labels`` (B, N); labels 1, 0, −1 = left out. A pair without right (wrong) matches
    contributes its other half alone.
    """
    positive, negative = (labels == POSITIVE).float(), (labels == NEGATIVE).float()
    loss_positive = (F.softplus(-logits) * positive).sum(1) / positive.sum(1).clamp_min(1.0)
    loss_negative = (F.softplus(logits) * negative).sum(1) / negative.sum(1).clamp_min(1.0)
    return 0.5 * (loss_positive + loss_negative).mean()


def geometric_loss(essential: Tensor, virtual: Tensor, valid: Tensor) -> Tensor:
    """Mean distance of virtual points (B, V, 4) on the true geometry to predicted E (B, 3, 3), clamped at 0.1.

    Squared symmetric epipolar distance; pairs with ``valid`` (B,) 0 don't count.
    """
    return _mean_of_valid(_virtual_distance(essential, virtual), valid)


def refined_loss(essential: Tensor, virtual: Tensor, valid: Tensor) -> Tensor:
    """Mean log(1 + d² / 1e-4) of refined E (B, 3, 3), d² the mean squared distance of virtual points (B, V, 4) to it.

    The logarithm lets a pair that is nearly right teach as much as one that is lost. Pairs with ``valid`` (B,) 0
    don't count.
    """
    return _mean_of_valid(torch.log1p(_virtual_distance(essential, virtual) / REFINED_DISTANCE), valid)


def network_loss(
    output: NetworkOutput, batch: dict[str, Tensor], geometric_weight: float, refined_weight: float = 0.0
) -> tuple[Tensor, dict[str, Tensor]]:
    """Loss summed over all heads and, where it has a weight, the refined answer; its last parts for the log.

    ``batch`` holds ``correspondences`` (B, N, 4), ``labels`` (B, N), ``virtual`` (B, V, 4), ``virtual_valid`` (B,).
    Without a weight the answer is not refined, and its part is 0.
    """
    total = output.logits.new_zeros(())
    for head in output.heads:
        classification = balanced_cross_entropy(head.logits, batch["labels"])
        geometry = geometric_loss(head.essential, batch["virtual"], batch["virtual_valid"])
        total = total + classification + geometric_weight * geometry
    refined = total.new_zeros(())
    if refined_weight:
        essential = refine_essential(batch["correspondences"], output.logits, output.heads[-1].essential)
        refined = refined_loss(essential, batch["virtual"], batch["virtual_valid"])
        total = total + refined_weight * refined
    parts = {"classification": classification, "geometric": geometry, "refined": refined}
    return total, {name: part.detach() for name, part in parts.items()}


def _virtual_distance(essential: Tensor, virtual: Tensor) -> Tensor:
    """Mean clamped distance² (B,) of each pair's virtual points."""
    return symmetric_epipolar_distance_squared(virtual, essential).clamp_max(GEOMETRIC_CLAMP).mean(1)


def _mean_of_valid(values: Tensor, valid: Tensor) -> Tensor:
    """Mean of ``values`` (B,) where ``valid`` (B,) is 1; 0 where none is."""
    return (values * valid).sum() / valid.sum().clamp_min(1.0)


def precision_recall(logits: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
    """Mean precision and recall over pairs at logit > 0, of the matches that have a label."""
    kept = (logits > 0) & (labels >= 0)
    right = (kept & (labels == POSITIVE)).sum(1).float()
    precision = right / kept.sum(1).clamp_min(1)
    recall = right / (labels == POSITIVE).sum(1).clamp_min(1)
    return precision.mean(), recall.mean()
