"""What every inference backend offers: one forward pass over a batch of pairs."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .metadata import ModelMetadata

Float32Array = NDArray[np.float32]


class Backend(Protocol):
    """Runs the network. Implementations are thread-safe and picklable, and reopen their model when unpickled."""

    @property
    def name(self) -> str:
        """``"onnxruntime"`` or ``"torch"``."""

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
            BackendError: the runtime refused (out of memory, say).
        """
