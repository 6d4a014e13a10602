"""PyTorch: takes over where ONNX Runtime is missing or fails."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import BackendError, ModelError
from .backend import Float32Array, check_input
from .metadata import ModelMetadata, check_model_file, parse_metadata

_HEADER_LENGTH_BYTES = 8


class TorchBackend:
    """The network itself, with the weights of a ``.safetensors`` file.

    Args:
        path: the ``.safetensors`` file; its header carries the metadata that the ONNX file carries.

    Raises:
        ModelError: the file is missing, truncated, or of another contract.
        BackendError: PyTorch or safetensors is not installed or does not start.
    """

    name = "torch"

    def __init__(self, path: Path) -> None:
        self._path = path
        check_model_file(path)
        self._metadata = parse_metadata(read_safetensors_metadata(path), path)
        try:
            import torch

            from ..network import load_network
        except Exception as error:  # a broken installation raises whatever its loader raises
            raise BackendError(f"PyTorch or safetensors cannot be imported ({error})") from error
        self._torch: Any = torch
        self._network: Any = load_network(path).eval()

    @property
    def metadata(self) -> ModelMetadata:
        """The model file's metadata."""
        return self._metadata

    def infer(self, correspondences: Float32Array, attributes: Float32Array) -> tuple[Float32Array, Float32Array]:
        """One forward pass; see :class:`~mgca_filter.inference.backend.Backend`."""
        check_input(correspondences, attributes)
        torch = self._torch
        try:
            with torch.inference_mode():
                output = self._network(torch.from_numpy(correspondences), torch.from_numpy(attributes))
            return output.logits.numpy().astype(np.float32), output.essential.numpy().astype(np.float32)
        except RuntimeError as error:
            raise BackendError(f"PyTorch failed on {self._path} ({error})") from error

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self._path}

    def __setstate__(self, state: dict[str, Any]) -> None:
        TorchBackend.__init__(self, state["path"])


def read_safetensors_metadata(path: Path) -> dict[str, str]:
    """The ``__metadata__`` of a safetensors file: eight bytes of length, then a JSON header, then the tensors.

    Raises:
        ModelError: the header is not there or the tensors that it lists are cut off.
    """
    try:
        with path.open("rb") as file:
            (length,) = struct.unpack("<Q", file.read(_HEADER_LENGTH_BYTES))
            size = path.stat().st_size
            if length > size:
                raise ValueError("the header is longer than the file")
            header: dict[str, Any] = json.loads(file.read(length))
        properties = dict(header.pop("__metadata__", {}))
        end = max((entry["data_offsets"][1] for entry in header.values()), default=0)
        if _HEADER_LENGTH_BYTES + length + end > size:
            raise ValueError("the tensors are cut off")
    except (struct.error, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ModelError(f"{path}: not a readable safetensors file, truncated or damaged ({error})") from error
    return properties
