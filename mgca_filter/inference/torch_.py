"""PyTorch: takes over where ONNX Runtime is missing or fails."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import BackendError
from .backend import Float32Array, check_input
from .model_file import ModelFile, ModelMetadata

# The process that PyTorch's threads belong to: a child forked from it inherits their pool, but not the threads.
_process = os.getpid()


class TorchBackend:
    """The network itself, with the weights of a ``.safetensors`` file.

    In a forked child it runs on one thread: PyTorch's others stay behind in the parent, and waiting for them would
    last for ever.

    Args:
        path: the ``.safetensors`` file; its header carries the metadata that the ONNX file carries.

    Raises:
        ModelError: the file is missing, truncated, or of another contract.
        BackendError: PyTorch or safetensors is not installed or does not start.
    """

    name = "torch"

    def __init__(self, path: Path) -> None:
        self._path = path
        self._metadata = ModelFile.read(path).metadata()
        try:
            import torch

            from ..network import load_network
        except Exception as error:  # a broken installation raises whatever its loader raises
            raise BackendError(f"PyTorch or safetensors cannot be imported ({error})") from error
        self._torch: Any = torch
        _use_one_thread_after_a_fork(torch)
        self._network: Any = load_network(path).eval()

    @property
    def metadata(self) -> ModelMetadata:
        """The model file's metadata."""
        return self._metadata

    def infer(self, correspondences: Float32Array, attributes: Float32Array) -> tuple[Float32Array, Float32Array]:
        """One forward pass; see :class:`~mgca_filter.inference.backend.Backend`."""
        check_input(correspondences, attributes)
        torch = self._torch
        _use_one_thread_after_a_fork(torch)
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


def _use_one_thread_after_a_fork(torch: Any) -> None:
    """Once in each forked child, as PyTorch's own data loaders do."""
    global _process
    if os.getpid() != _process:
        _process = os.getpid()
        torch.set_num_threads(1)
