"""The model card inside a model file: what a caller of the network has to know, read and checked at load."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ModelError
from ..fit.choice import check_coefficients
from ..inputs.attributes import ATTRIBUTE_COUNT
from .calibration import AttributePrior, Calibration
from .checksums import check_checksum, sha256_of

CONTRACT_VERSION = "2"
# The largest preset takes 20 MB; more than this is another file, and is not read into memory.
MAX_MODEL_BYTES = 2**29
_TEXT_KEYS = (
    "name",
    "version",
    "git_commit",
    "training_data",
    "detector",
    "normalization",
    "license",
    "minimum_onnxruntime",
)
METADATA_KEYS = (
    "contract_version",
    *_TEXT_KEYS,
    "config",
    "calibration",
    "decision_threshold",
    "candidate_rule",
    "prior",
    "choice",
)


@dataclass(frozen=True)
class ModelMetadata:
    """Metadata of a model file; strings in the file, typed here.

    Attributes:
        name, version, git_commit, training_data, detector, normalization, license, minimum_onnxruntime: text.
        config: the network's configuration.
        calibration: logits to probabilities.
        decision_threshold: a match above this logit counts as accepted.
        candidate_max_ratio, candidate_min_count: which matches enter the network (``candidate_mask``).
        prior: scores of the matches that do not.
        choice: coefficients of the choice among hypotheses and of its confidence (``fit/choice.py``).
        sha256: of the model file, hexadecimal.
    """

    name: str
    version: str
    git_commit: str
    training_data: str
    detector: str
    normalization: str
    license: str
    minimum_onnxruntime: str
    config: dict[str, Any]
    calibration: Calibration
    decision_threshold: float
    candidate_max_ratio: float
    candidate_min_count: int
    prior: AttributePrior
    choice: dict[str, list[float]]
    sha256: str


def parse_metadata(properties: Mapping[str, str], path: Path) -> ModelMetadata:
    """Check and read the metadata of the model file at ``path``.

    Raises:
        ModelError: a key is missing, a value cannot be read, or the contract is another.
    """
    missing = [key for key in METADATA_KEYS if key not in properties]
    if missing:
        raise ModelError(f"{path}: not a model of this package, metadata missing: {', '.join(missing)}")
    version = properties["contract_version"]
    if version != CONTRACT_VERSION:
        raise ModelError(f"{path}: contract version {version}, this package reads version {CONTRACT_VERSION}")
    key = ""
    try:
        key = "config"
        config = dict(json.loads(properties[key]))
        key = "calibration"
        calibration = json.loads(properties[key])
        scale, offset = _finite(calibration["scale"]), _finite(calibration["offset"])
        key = "decision_threshold"
        threshold = _finite(properties[key])
        key = "candidate_rule"
        rule = json.loads(properties[key])
        max_ratio, min_count = _finite(rule["max_ratio"]), int(rule["min_count"])
        key = "prior"
        prior = _parse_prior(json.loads(properties[key]))
        key = "choice"
        choice = check_coefficients(json.loads(properties[key]))
    except (ValueError, TypeError, KeyError) as error:
        raise ModelError(f"{path}: metadata '{key}' cannot be read ({type(error).__name__}: {error})") from error
    return ModelMetadata(
        **{field: properties[field] for field in _TEXT_KEYS},
        config=config,
        calibration=Calibration(scale, offset),
        decision_threshold=threshold,
        candidate_max_ratio=max_ratio,
        candidate_min_count=min_count,
        prior=prior,
        choice=choice,
        sha256=sha256_of(path),
    )


def _finite(value: Any) -> float:
    number = float(value)
    if not np.isfinite(number):
        raise ValueError(f"expected a finite number, got {value!r}")
    return number


def _parse_prior(values: Mapping[str, Any]) -> AttributePrior:
    weight1 = np.asarray(values["weight1"], dtype=np.float64)
    bias1, weight2 = (np.asarray(values[key], dtype=np.float64) for key in ("bias1", "weight2"))
    hidden = len(bias1)
    if weight1.shape != (hidden, ATTRIBUTE_COUNT) or bias1.shape != (hidden,) or weight2.shape != (hidden,):
        raise ValueError(f"shapes {weight1.shape}, {bias1.shape}, {weight2.shape} do not fit together")
    if not all(np.isfinite(array).all() for array in (weight1, bias1, weight2)):
        raise ValueError("weights hold NaN or infinite values")
    return AttributePrior(weight1, bias1, weight2, _finite(values["bias2"]))


def check_model_file(path: Path) -> None:
    """Raise ModelError where ``path`` is no file of a model's size, or a shipped model that was damaged."""
    if not path.is_file():
        raise ModelError(f"{path}: model file not found")
    size = path.stat().st_size
    if size == 0:
        raise ModelError(f"{path}: model file is empty")
    if size > MAX_MODEL_BYTES:
        raise ModelError(f"{path}: {size} bytes is no model of this package, at most {MAX_MODEL_BYTES} are read")
    check_checksum(path)
