"""A trained network as an ONNX file of the package's contract, and the safetensors file beside it.

Needs the ``[export]`` extra. The network itself knows nothing of exporting; what differs is done to a copy.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import onnx
import torch
from torch import Tensor, nn

from ..fit.choice import fitted_coefficients
from ..inference.backend import INPUT_NAMES, OUTPUT_NAMES
from ..inference.calibration import Calibration
from ..inference.model_file import CONTRACT_VERSION, METADATA_KEYS
from ..inputs.attributes import CANDIDATE_MAX_RATIO, CANDIDATE_MIN_COUNT
from ..network import MGCANet, save_network
from ..network.config import ATTRIBUTE_CHANNELS
from ..network.mgca_net import Prior
from .compact_network import compact
from .speed_passes import simplify

OPSET = 17
MINIMUM_ONNXRUNTIME = "1.15"
NORMALIZATION = (
    "correspondences = (x1, y1, x2, y2) = K^-1 (u, v, 1), undistorted pixels, centre of the top-left pixel (0, 0); "
    "attributes = ratio, best of list, log2(size2 / size1), cos and sin of angle2 - angle1, "
    "flags ratio known, best known, size and angle known; zeros where unknown"
)


@dataclass(frozen=True)
class ModelDescription:
    """What the weights cannot tell of themselves; becomes metadata of the model files."""

    name: str
    version: str
    git_commit: str
    training_data: str
    license: str
    detector: str = "SIFT"
    calibration: Calibration = Calibration()
    decision_threshold: float = 0.0


class _Contract(nn.Module):
    """The network with the contract's two outputs."""

    def __init__(self, network: MGCANet) -> None:
        super().__init__()
        self.network = network

    def forward(self, correspondences: Tensor, attributes: Tensor) -> tuple[Tensor, Tensor]:
        output = self.network(correspondences, attributes)
        return output.logits, output.essential


def model_metadata(network: MGCANet, description: ModelDescription) -> dict[str, str]:
    """All keys of the contract, as strings.

    Raises:
        ValueError: the network has no prior (``attributes=False``): the contract scores non-candidates with it.
    """
    if network.prior is None:
        raise ValueError("a network without attributes has no prior and does not fit the contract")
    rule = {"max_ratio": CANDIDATE_MAX_RATIO, "min_count": CANDIDATE_MIN_COUNT}
    calibration = {"scale": description.calibration.scale, "offset": description.calibration.offset}
    metadata = {
        "contract_version": CONTRACT_VERSION,
        "name": description.name,
        "version": description.version,
        "git_commit": description.git_commit,
        "training_data": description.training_data,
        "detector": description.detector,
        "config": network.config.to_json(),
        "normalization": NORMALIZATION,
        "calibration": json.dumps(calibration),
        "decision_threshold": repr(description.decision_threshold),
        "candidate_rule": json.dumps(rule),
        "prior": json.dumps(_prior_weights(network.prior)),
        "choice": json.dumps(fitted_coefficients()),
        "license": description.license,
        "minimum_onnxruntime": MINIMUM_ONNXRUNTIME,
    }
    assert set(metadata) == set(METADATA_KEYS)
    return metadata


def _prior_weights(prior: Prior) -> dict[str, object]:
    return {
        "weight1": prior.hidden.weight.tolist(),
        "bias1": prior.hidden.bias.tolist(),
        "weight2": prior.output.weight[0].tolist(),
        "bias2": float(prior.output.bias),
    }


def export_onnx(network: MGCANet, path: str | Path, metadata: Mapping[str, str]) -> None:
    """Write the ONNX file: opset 17, dynamic batch and N, declared output shapes, metadata inside."""
    contract = _Contract(compact(network).cpu()).eval()
    example = torch.rand(2, 64, 4) - 0.5, torch.rand(2, 64, ATTRIBUTE_CHANNELS)
    dynamic = {name: {0: "B", 1: "N"} for name in (*INPUT_NAMES, "logits")} | {"essential": {0: "B"}}
    with warnings.catch_warnings():
        # The tracing exporter is the one that writes opset 17; its deprecation and tracing notes are known.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            contract,
            example,
            str(path),
            input_names=INPUT_NAMES,
            output_names=OUTPUT_NAMES,
            dynamic_axes=dynamic,
            opset_version=OPSET,
            dynamo=False,
        )
    model = onnx.load(str(path))
    for axis in (1, 2):  # tracing loses the two fixed axes of the essential matrix
        model.graph.output[1].type.tensor_type.shape.dim[axis].dim_value = 3
    model = simplify(model, windows=network.config.windows)
    onnx.helper.set_model_props(model, dict(metadata))
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(path))


def export_model(network: MGCANet, folder: str | Path, description: ModelDescription) -> tuple[Path, Path]:
    """Write ``<name>.onnx`` and ``<name>.safetensors`` with equal metadata into a folder; returns both paths."""
    metadata = model_metadata(network, description)
    onnx_path, torch_path = (Path(folder) / f"{description.name}.{suffix}" for suffix in ("onnx", "safetensors"))
    export_onnx(network, onnx_path, metadata)
    save_network(network, torch_path, metadata)
    return onnx_path, torch_path
