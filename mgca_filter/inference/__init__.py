"""Inference backends behind one protocol; ONNX Runtime by default, PyTorch where that is not to be had, or OpenCV."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from ..errors import BackendError, MgcaFilterError
from ..types import Providers
from .backend import Backend, ProcessLock
from .model_file import CONTRACT_VERSION, METADATA_KEYS, ModelMetadata
from .onnxruntime_ import OnnxBackend
from .opencv_ import OpenCvBackend
from .torch_ import TorchBackend

BACKENDS = ("auto", "onnxruntime", "opencv", "torch")
_PROBE_MATCHES = 16

# By path, backend and providers: time and size of the file, and what was opened from it.
_open_backends: dict[tuple[Path, str, str], tuple[tuple[int, int] | None, Backend]] = {}
_open_lock = ProcessLock()

__all__ = [
    "BACKENDS",
    "CONTRACT_VERSION",
    "METADATA_KEYS",
    "Backend",
    "ModelMetadata",
    "OnnxBackend",
    "OpenCvBackend",
    "TorchBackend",
    "open_backend",
    "shared_backend",
]


def open_backend(path: Path, backend: str = "auto", providers: Providers | None = None) -> Backend:
    """Open a model file.

    Args:
        path: ``.onnx`` or ``.safetensors``; the PyTorch backend takes the ``.safetensors`` file beside an
            ``.onnx`` file.
        backend: ``"onnxruntime"``, ``"opencv"`` (the DNN module of OpenCV 5), ``"torch"``, or ``"auto"``: ONNX
            Runtime, and PyTorch with one warning where that cannot be started (or without one, for a
            ``.safetensors`` file).
        providers: execution providers of ONNX Runtime.

    Raises:
        ModelError: the file is missing, truncated or of another contract.
        BackendError: no runtime for it can be started.
    """
    weights = path.with_suffix(".safetensors")
    if backend == "torch" or (backend == "auto" and path == weights):
        return TorchBackend(weights)
    if backend == "opencv":
        return OpenCvBackend(path)
    try:
        opened = OnnxBackend(path, providers)
        if backend == "auto":
            # A session may open and still not run: better to know before the first pair.
            opened.infer(np.zeros((1, _PROBE_MATCHES, 4), np.float32), np.zeros((1, _PROBE_MATCHES, 8), np.float32))
        return opened
    except BackendError as error:
        if backend != "auto":
            raise
        try:
            fallback = TorchBackend(weights)
        except MgcaFilterError as fallback_error:
            raise BackendError(f"no backend can be started: {error}; {fallback_error}") from fallback_error
        warnings.warn(f"mgca_filter falls back to PyTorch: {error}", RuntimeWarning, stacklevel=2)
        return fallback


def shared_backend(path: Path, backend: str = "auto", providers: Providers | None = None) -> Backend:
    """The open backend of a model file, opened once per process and again when the file changes.

    Arguments and errors as :func:`open_backend`.
    """
    path = path.resolve()
    stamp = (path.stat().st_mtime_ns, path.stat().st_size) if path.is_file() else None
    key = (path, backend, repr(providers))
    with _open_lock:
        known = _open_backends.get(key)
        if known is None or known[0] != stamp:
            known = _open_backends[key] = (stamp, open_backend(path, backend, providers))
        return known[1]
