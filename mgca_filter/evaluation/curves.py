"""Curves for the pictures: recall over the pose error, precision over recall, probability against frequency."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from .methods import PairOutcome
from .metrics import FloatArray, SceneErrors, mean_over_scenes, share_below
from .predict import SceneOutcomes
from .score_counts import LOGIT_EDGES, ScoreCounts, precision_recall_curve, reliability

RECALL_STEP_DEG = 0.5
RECALL_LIMIT_DEG = 20.0
_DIGITS = 4


def recall_curves(errors: Mapping[str, SceneErrors]) -> dict[str, Any]:
    """``error_deg`` from 0 to 20 and by method the share of pairs below each, mean over scenes."""
    limits = np.arange(0.0, RECALL_LIMIT_DEG + RECALL_STEP_DEG, RECALL_STEP_DEG)
    methods = {
        name: [round(mean_over_scenes(partial(share_below, limit_deg=limit), scenes), _DIGITS) for limit in limits]
        for name, scenes in errors.items()
    }
    return {"error_deg": [float(limit) for limit in limits], "methods": methods}


def precision_recall_curves(results: Mapping[str, SceneOutcomes]) -> dict[str, Any]:
    """``logit`` thresholds and by method precision and recall at each: matches of a scene together, mean over scenes.

    Methods without logits are left out; None stands where no scene has a value.
    """
    methods = {}
    for name, outcomes in results.items():
        scenes = [counts for runs in outcomes.values() if (counts := _counts(runs[0]))]
        if not scenes:
            continue
        curves = [precision_recall_curve(counts) for counts in scenes]
        methods[name] = {
            "precision": _mean_of_known([precision for precision, _ in curves]),
            "recall": _mean_of_known([recall for _, recall in curves]),
        }
    return {"logit": list(LOGIT_EDGES), "methods": methods}


def reliability_tables(results: Mapping[str, SceneOutcomes]) -> dict[str, Any]:
    """By method the bins of :func:`score_counts.reliability` over all pairs, and ``error``, their mean gap.

    The gap is the expected calibration error (Naeini et al., AAAI 2015).
    """
    tables = {}
    for name, outcomes in results.items():
        counts = [one for runs in outcomes.values() for one in _counts(runs[0])]
        if not counts:
            continue
        bins = reliability(counts)
        matches = sum(one["matches"] for one in bins)
        gap = sum(one["matches"] * abs(one["probability"] - one["share_right"]) for one in bins)
        tables[name] = {"bins": bins, "error": gap / matches if matches else 0.0}
    return tables


def _counts(outcomes: list[PairOutcome]) -> list[ScoreCounts]:
    return [outcome.counts for outcome in outcomes if outcome.counts is not None]


def _mean_of_known(curves: list[FloatArray]) -> list[float | None]:
    stacked = np.array(curves)
    known = np.isfinite(stacked)
    total, count = np.where(known, stacked, 0.0).sum(axis=0), known.sum(axis=0)
    return [round(float(t / c), _DIGITS) if c else None for t, c in zip(total, count)]
