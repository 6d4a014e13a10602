"""Inference backends behind one protocol; ONNX Runtime by default, PyTorch where that is not to be had."""

from __future__ import annotations

import warnings
from pathlib import Path

from ..errors import BackendError, MgcaFilterError
from .base import Backend
from .metadata import CONTRACT_VERSION, METADATA_KEYS, ModelMetadata
from .onnx_backend import OnnxBackend, Providers
from .torch_backend import TorchBackend

BACKENDS = ("auto", "onnxruntime", "torch")

__all__ = [
    "BACKENDS",
    "CONTRACT_VERSION",
    "METADATA_KEYS",
    "Backend",
    "ModelMetadata",
    "OnnxBackend",
    "Providers",
    "TorchBackend",
    "open_backend",
]


def open_backend(path: Path, backend: str = "auto", providers: Providers | None = None) -> Backend:
    """Open a model file.

    Args:
        path: ``.onnx`` or ``.safetensors``; the PyTorch backend takes the ``.safetensors`` file beside an
            ``.onnx`` file.
        backend: ``"onnxruntime"``, ``"torch"``, or ``"auto"``: ONNX Runtime, and PyTorch with one warning where
            that cannot be started (or without one, for a ``.safetensors`` file).
        providers: execution providers of ONNX Runtime.

    Raises:
        ModelError: the file is missing, truncated or of another contract.
        BackendError: no runtime for it can be started.
    """
    weights = path.with_suffix(".safetensors")
    if backend == "torch" or (backend == "auto" and path == weights):
        return TorchBackend(weights)
    try:
        return OnnxBackend(path, providers)
    except BackendError as error:
        if backend != "auto":
            raise
        try:
            fallback = TorchBackend(weights)
        except MgcaFilterError as fallback_error:
            raise BackendError(f"no backend can be started: {error}; {fallback_error}") from fallback_error
        warnings.warn(f"mgca_filter falls back to PyTorch: {error}", RuntimeWarning, stacklevel=2)
        return fallback
