"""A network in memory as a backend: what is still being trained runs through the filter as a model file does.

Needs PyTorch, and is no choice of :func:`mgca_filter.inference.open_backend`: whoever holds a network imports it.
"""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import torch

from ..errors import BackendError
from ..fit.choice import fitted_coefficients
from ..inputs.attributes import ATTRIBUTE_COUNT, CANDIDATE_MAX_RATIO, CANDIDATE_MIN_COUNT
from ..network import MGCANet
from . import ModelMetadata
from .backend import Float32Array, check_input
from .calibration import AttributePrior, Calibration

# What does not enter a network that has no prior is rejected, whatever the calibration.
_NO_PRIOR_LOGIT = -100.0


class NetworkBackend:
    """The network itself, in evaluation mode, on the device where it is; see :class:`mgca_filter.inference.Backend`.

    Args:
        network: its weights must not change while the backend is in use: the metadata hold those of the prior.
        metadata: what a model file of the network would say; None = :func:`network_metadata`.
    """

    name = "network"

    def __init__(self, network: MGCANet, metadata: ModelMetadata | None = None) -> None:
        self._network = network.eval()
        self.metadata = network_metadata(network) if metadata is None else metadata

    @torch.inference_mode()
    def infer(self, correspondences: Float32Array, attributes: Float32Array) -> tuple[Float32Array, Float32Array]:
        """One forward pass; see :class:`~mgca_filter.inference.backend.Backend`."""
        check_input(correspondences, attributes)
        device = next(self._network.parameters()).device
        try:
            output = self._network(*(torch.from_numpy(array).to(device) for array in (correspondences, attributes)))
        except RuntimeError as error:
            raise BackendError(f"PyTorch failed on a network in memory ({error})") from error
        return output.logits.float().cpu().numpy(), output.essential.float().cpu().numpy()


def network_metadata(network: MGCANet) -> ModelMetadata:
    """What a model file of a network would say before anyone fitted its calibration.

    The candidate rule is the contract's, the decision threshold 0, the prior the network's; a network without
    attributes has none, and what does not enter it is rejected. Texts are empty, as there is no file.
    """
    nothing = np.zeros(0)
    prior = AttributePrior(np.zeros((0, ATTRIBUTE_COUNT)), nothing, nothing, _NO_PRIOR_LOGIT)
    if network.prior is not None:
        weight1, bias1, weight2, bias2 = (
            tensor.detach().double().cpu().numpy()
            for layer in (network.prior.hidden, network.prior.output)
            for tensor in (layer.weight, layer.bias)
        )
        prior = AttributePrior(weight1, bias1, weight2[0], float(bias2[0]))
    texts = ("version", "git_commit", "training_data", "detector", "normalization", "license", "minimum_onnxruntime")
    return ModelMetadata(
        name="network",
        **dict.fromkeys((*texts, "sha256"), ""),
        config=asdict(network.config),
        calibration=Calibration(),
        decision_threshold=0.0,
        candidate_max_ratio=CANDIDATE_MAX_RATIO,
        candidate_min_count=CANDIDATE_MIN_COUNT,
        prior=prior,
        choice=fitted_coefficients(),
    )
