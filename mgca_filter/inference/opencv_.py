"""OpenCV's own DNN module, for those who want no further dependency."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..errors import BackendError
from .backend import INPUT_NAMES, OUTPUT_NAMES, Float32Array, ProcessLock, check_input, check_names
from .model_file import ModelFile, ModelMetadata

MINIMUM_OPENCV = 5


class OpenCvBackend:
    """The ONNX file in the DNN module of OpenCV 5, by its new graph engine.

    OpenCV 4 cannot run the graph: its importer knows no shapes that depend on the number of matches.

    Args:
        path: the ``.onnx`` file.

    Raises:
        ModelError: the file is missing, truncated, or of another contract.
        BackendError: this OpenCV is older than 5, or its DNN module does not take the file.
    """

    name = "opencv"

    def __init__(self, path: Path) -> None:
        self._path = path
        file = ModelFile.read(path)
        check_names(file)
        self._metadata = file.metadata()
        if int(cv2.__version__.split(".")[0]) < MINIMUM_OPENCV:
            raise BackendError(
                f"backend='opencv' needs OpenCV {MINIMUM_OPENCV} or newer, this is {cv2.__version__}: "
                f"python -m pip install 'opencv-contrib-python-headless>={MINIMUM_OPENCV}', "
                "or use backend='onnxruntime'"
            )
        self._lock = ProcessLock()  # setInput and forward belong together
        try:
            # From the path: the overload that reads a buffer does not heed the engine.
            self._net: Any = cv2.dnn.readNetFromONNX(str(path), engine=cv2.dnn.ENGINE_NEW)
        except cv2.error as error:
            raise BackendError(f"OpenCV's DNN module cannot read {path} ({error})") from error

    @property
    def metadata(self) -> ModelMetadata:
        """The model file's metadata."""
        return self._metadata

    def infer(self, correspondences: Float32Array, attributes: Float32Array) -> tuple[Float32Array, Float32Array]:
        """One forward pass; see :class:`~mgca_filter.inference.backend.Backend`."""
        check_input(correspondences, attributes)
        try:
            with self._lock:
                for name, value in zip(INPUT_NAMES, (correspondences, attributes)):
                    self._net.setInput(np.ascontiguousarray(value), name)
                # The network reuses its buffers in the next pass.
                logits, essential = (np.array(output, dtype=np.float32) for output in self._net.forward(OUTPUT_NAMES))
        except cv2.error as error:
            raise BackendError(f"OpenCV's DNN module failed on {self._path} ({error})") from error
        return logits, essential

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self._path}

    def __setstate__(self, state: dict[str, Any]) -> None:
        OpenCvBackend.__init__(self, state["path"])
