"""What every inference backend offers: one forward pass over a batch of pairs."""

from __future__ import annotations

import os
import threading
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import BackendError, ModelError
from ..inputs.attributes import ATTRIBUTE_COUNT
from .model_file import ModelFile, ModelMetadata

Float32Array = NDArray[np.float32]

INPUT_NAMES = ["correspondences", "attributes"]
OUTPUT_NAMES = ["logits", "essential"]


class Backend(Protocol):
    """Runs the network. Implementations are thread-safe and picklable, and reopen their model when unpickled."""

    @property
    def name(self) -> str:
        """``"onnxruntime"``, ``"opencv"`` or ``"torch"``."""

    @property
    def metadata(self) -> ModelMetadata:
        """The model file's metadata."""

    def infer(self, correspondences: Float32Array, attributes: Float32Array) -> tuple[Float32Array, Float32Array]:
        """One forward pass.

        Args:
            correspondences: (B, N, 4) on the normalised image planes, N ≥ 1, finite.
            attributes: (B, N, 8), as ``MatchAttributes.encode`` writes them.

        Returns:
            Logits (B, N) and essential matrices (B, 3, 3) of unit Frobenius norm and free sign.

        Raises:
            BackendError: the input is empty, not finite or of another shape, or the runtime refused (out of memory,
                say).
        """


class ProcessLock:
    """A lock that a fork cannot leave locked: each process takes its own, and a forked child's is free."""

    def __init__(self) -> None:
        self._locks: dict[int, threading.Lock] = {}

    def __enter__(self) -> None:
        self._locks.setdefault(os.getpid(), threading.Lock()).acquire()

    def __exit__(self, *_: object) -> None:
        self._locks[os.getpid()].release()


def check_input(correspondences: Float32Array, attributes: Float32Array) -> None:
    """Raise BackendError unless the arrays are what :meth:`Backend.infer` takes."""
    for name, array, width in (("correspondences", correspondences, 4), ("attributes", attributes, ATTRIBUTE_COUNT)):
        if array.ndim != 3 or array.shape[2] != width or array.dtype != np.float32:
            raise BackendError(f"{name}: expected float32 (B, N, {width}), got {array.dtype} {array.shape}")
        if not np.isfinite(array).all():
            raise BackendError(f"{name}: expected finite values, got NaN or infinite ones")
    if correspondences.shape[:2] != attributes.shape[:2]:
        raise BackendError(f"correspondences {correspondences.shape} and attributes {attributes.shape} differ in size")
    if 0 in correspondences.shape:
        raise BackendError(f"expected at least one match, got correspondences of shape {correspondences.shape}")


def check_names(file: ModelFile) -> None:
    """Raise ModelError unless an ONNX file has the contract's inputs and outputs."""
    if sorted(file.inputs) != sorted(INPUT_NAMES):
        raise ModelError(f"{file.path}: inputs {file.inputs}, expected {INPUT_NAMES}")
    if not set(OUTPUT_NAMES) <= set(file.outputs):
        raise ModelError(f"{file.path}: outputs {file.outputs}, expected {OUTPUT_NAMES}")
