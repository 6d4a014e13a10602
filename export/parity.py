"""Do the exported graph and the torch network say the same? Maximum differences over the number of matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mgca_filter.backends import Backend, open_backend

COUNTS = (1, 2, 7, 8, 9, 16, 127, 512, 2000)
LOGIT_TOLERANCE = 1e-3
ESSENTIAL_TOLERANCE = 1e-2
ESSENTIAL_FROM = 16  # below this many matches the essential matrix is arbitrary


@dataclass(frozen=True)
class ParityRow:
    """Differences of two backends on one input: logits, masks at logit > 0, E up to sign (NaN below 16 matches)."""

    count: int
    logit_difference: float
    masks_equal: bool
    essential_difference: float

    @property
    def passed(self) -> bool:
        essential = np.isnan(self.essential_difference) or self.essential_difference < ESSENTIAL_TOLERANCE
        return self.logit_difference < LOGIT_TOLERANCE and self.masks_equal and bool(essential)


def two_view_input(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A pair (1, count, 4), (1, count, 8) with a third of its matches right, as a detector would give it."""
    rng = np.random.default_rng([seed, count])
    angle = 0.15
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    X = np.column_stack([rng.uniform(-2, 2, (count, 2)), rng.uniform(4, 9, count)])
    X2 = X @ R.T + np.array([-1.0, 0.1, 0.2])
    x1, x2 = X[:, :2] / X[:, 2:], X2[:, :2] / X2[:, 2:]
    right = rng.random(count) < 1 / 3
    x2[~right] = rng.uniform(-0.5, 0.5, (int((~right).sum()), 2))
    noise = rng.normal(0, 5e-4, (count, 4))
    attributes = np.zeros((count, 8))
    attributes[:, 0] = np.where(right, rng.uniform(0.4, 0.9, count), rng.uniform(0.7, 0.95, count))
    attributes[:, 1] = 1.0
    attributes[:, 2] = rng.normal(0, np.where(right, 0.1, 1.0))
    turn = np.where(right, rng.normal(0, 0.1, count), rng.uniform(-np.pi, np.pi, count))
    attributes[:, 3], attributes[:, 4] = np.cos(turn), np.sin(turn)
    attributes[:, 5:] = 1.0
    correspondences = np.hstack([x1, x2]) + noise
    return correspondences[None].astype(np.float32), attributes[None].astype(np.float32)


def compare(a: Backend, b: Backend, count: int) -> ParityRow:
    """Run both backends on one input."""
    inputs = two_view_input(count)
    (logits_a, E_a), (logits_b, E_b) = a.infer(*inputs), b.infer(*inputs)
    essential = min(np.abs(E_a - E_b).max(), np.abs(E_a + E_b).max()) if count >= ESSENTIAL_FROM else np.nan
    equal = bool(np.array_equal(logits_a > 0, logits_b > 0))
    return ParityRow(count, float(np.abs(logits_a - logits_b).max()), equal, float(essential))


def check_parity(onnx_path: Path, torch_path: Path, counts: Sequence[int] = COUNTS) -> list[ParityRow]:
    """ONNX Runtime against torch, one row per number of matches."""
    onnx_backend, torch_backend = open_backend(onnx_path, "onnxruntime"), open_backend(torch_path, "torch")
    return [compare(onnx_backend, torch_backend, count) for count in counts]


def format_parity(rows: Sequence[ParityRow]) -> str:
    """Markdown table."""
    lines = ["| N | max \\|Δlogit\\| | masks equal | max \\|ΔE\\| | |", "|---|---|---|---|---|"]
    for row in rows:
        essential = "–" if np.isnan(row.essential_difference) else f"{row.essential_difference:.1e}"
        verdict = "ok" if row.passed else "FAILED"
        lines.append(f"| {row.count} | {row.logit_difference:.1e} | {row.masks_equal} | {essential} | {verdict} |")
    return "\n".join(lines)
