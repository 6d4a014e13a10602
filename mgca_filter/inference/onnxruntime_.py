"""ONNX Runtime: the default backend."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import BackendError, ModelError
from ..types import Providers
from .backend import OUTPUT_NAMES, Float32Array, check_input, check_names
from .model_file import ModelFile, ModelMetadata

if TYPE_CHECKING:
    import onnxruntime


CPU_PROVIDER = "CPUExecutionProvider"
# What ONNX Runtime raises for a file that is damaged or no ONNX model; anything else is the runtime's fault.
_FILE_ERRORS = ("InvalidProtobuf", "InvalidGraph", "InvalidArgument", "NoModel", "NoSuchFile")
_LOG_ERRORS_ONLY = 3
# The product that this fusion makes of a mean over the matches rounds by the number of threads, and what a rounding
# moves across a nearest-neighbour choice moves logits by tenths. Without it all numbers of threads give the same bits.
_DISABLED_OPTIMIZERS = ["MatMulScaleFusion"]
# Squaring a matrix twenty times, the heart of the eight-point algorithm, is beyond half precision and TF32: providers
# that would use them by default are told not to. What the caller sets stays. In the providers' own names.
_FULL_PRECISION = {
    "CUDAExecutionProvider": {"use_tf32": "0"},
    "TensorrtExecutionProvider": {"trt_fp16_enable": "0"},
}
# As a provider (ONNX Runtime 1.24) OpenVINO does not find what the network's loops take from outside them; by itself it
# does: docs/how_to/runtimes.md.
_REFUSED = ("OpenVINOExecutionProvider",)
PROVIDERS_VARIABLE = "MGCA_FILTER_PROVIDERS"
THREADS_VARIABLE = "MGCA_FILTER_NUM_THREADS"
TELEMETRY_VARIABLE = "ORT_DISABLE_TELEMETRY"


class OnnxBackend:
    """Session of ONNX Runtime over a model file of this package's contract.

    It runs on as many threads as the environment variable ``MGCA_FILTER_NUM_THREADS`` says, else one per core.

    Args:
        path: the ``.onnx`` file.
        providers: execution providers in ONNX Runtime's form; None = those that the environment variable
            ``MGCA_FILTER_PROVIDERS`` lists, separated by commas, else the CPU. One that is missing, fails, or is
            known not to run the network (OpenVINO) gives way to the CPU with one warning.

    Raises:
        ModelError: the file is missing, truncated, or of another contract.
        BackendError: ONNX Runtime is not installed or does not start.
    """

    name = "onnxruntime"

    def __init__(self, path: Path, providers: Providers | None = None) -> None:
        self._path, self._providers = path, providers
        file = ModelFile.read(path)
        check_names(file)
        self._metadata = file.metadata()
        try:
            runtime = _import_runtime()
        except Exception as error:  # a broken installation raises whatever its loader raises
            raise BackendError(f"ONNX Runtime cannot be imported ({error})") from error
        self._session = _open_session(runtime, file, providers)

    @property
    def metadata(self) -> ModelMetadata:
        """The model file's metadata."""
        return self._metadata

    def infer(self, correspondences: Float32Array, attributes: Float32Array) -> tuple[Float32Array, Float32Array]:
        """One forward pass; see :class:`~mgca_filter.inference.backend.Backend`."""
        check_input(correspondences, attributes)
        try:
            logits, essential = self._session.run(
                OUTPUT_NAMES, {"correspondences": correspondences, "attributes": attributes}
            )
        except Exception as error:  # each failure has a class of its own in ONNX Runtime
            raise BackendError(f"ONNX Runtime failed on {self._path} ({error})") from error
        return logits, essential

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self._path, "providers": self._providers}

    def __setstate__(self, state: dict[str, Any]) -> None:
        OnnxBackend.__init__(self, state["path"], state["providers"])


def available_providers() -> list[str]:
    """Execution providers of the ONNX Runtime that is installed, the preferred ones first.

    Raises:
        BackendError: ONNX Runtime is not installed or does not start.
    """
    try:
        return list(_import_runtime().get_available_providers())
    except Exception as error:
        raise BackendError(f"ONNX Runtime cannot be imported ({error})") from error


def _import_runtime() -> Any:
    """ONNX Runtime, told not to report home: from 1.29 on it would on Linux as well, from the import on."""
    wish = os.environ.setdefault(TELEMETRY_VARIABLE, "1")
    import onnxruntime

    if wish == "1":
        onnxruntime.disable_telemetry_events()  # the caller may have imported it before
    return onnxruntime


def _open_session(runtime: Any, file: ModelFile, providers: Providers | None) -> onnxruntime.InferenceSession:
    """Open what was read with the wanted providers, else on the CPU with one warning."""
    options = _session_options(runtime)
    wanted = list(providers) if providers else os.environ.get(PROVIDERS_VARIABLE, CPU_PROVIDER).split(",")
    names = [_name_of(provider) for provider in wanted]
    available = runtime.get_available_providers()
    missing = [name for name in names if name not in available]
    refused = [name for name in names if name in _REFUSED and name in available]
    usable = [provider for provider, name in zip(wanted, names) if name not in (*missing, *refused)]
    reasons = [f"this ONNX Runtime has no {', '.join(missing)}"] if missing else []
    reasons += [f"{name} does not run the network's loops" for name in refused]
    reason = "; ".join(reasons)
    if usable and usable != [CPU_PROVIDER]:
        try:
            session = _open_in_full_precision(runtime, file, options, usable)
            lost = [name for name in map(_name_of, usable) if name not in session.get_providers()]
            reason = reason or (f"{', '.join(lost)} did not start" if lost else "")
            if reason:
                _warn_about_provider(reason)
            return session
        except Exception as error:
            reason = f"{_name_of(usable[0])} failed ({error})"
    if reason:
        _warn_about_provider(reason)
    try:
        return runtime.InferenceSession(
            file.content, options, providers=[CPU_PROVIDER], disabled_optimizers=_DISABLED_OPTIMIZERS
        )
    except Exception as error:
        if type(error).__name__ in _FILE_ERRORS:
            raise ModelError(f"{file.path}: not a readable ONNX model, truncated or damaged ({error})") from error
        raise BackendError(f"ONNX Runtime cannot start ({error})") from error


def _name_of(provider: Any) -> str:
    return str(provider if isinstance(provider, str) else provider[0])


def _open_in_full_precision(runtime: Any, file: ModelFile, options: Any, providers: list[Any]) -> Any:
    """A session whose providers compute in float32; as they are where a provider does not know that option yet."""
    told = [_in_full_precision(provider) for provider in providers]
    try:
        return runtime.InferenceSession(file.content, options, providers=told, disabled_optimizers=_DISABLED_OPTIMIZERS)
    except Exception:
        if told == providers:
            raise
    return runtime.InferenceSession(
        file.content, options, providers=providers, disabled_optimizers=_DISABLED_OPTIMIZERS
    )


def _in_full_precision(provider: str | tuple[str, dict[str, Any]]) -> str | tuple[str, dict[str, Any]]:
    """A provider with the options that keep it in float32 in front of the caller's."""
    name, options = _name_of(provider), {} if isinstance(provider, str) else provider[1]
    precision = _FULL_PRECISION.get(name)
    return provider if precision is None else (name, {**precision, **options})


def _session_options(runtime: Any) -> Any:
    options = runtime.SessionOptions()
    options.log_severity_level = _LOG_ERRORS_ONLY
    # Threads that wait for the next pass would take the processor from the robust fit.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    threads = os.environ.get(THREADS_VARIABLE, "")
    if threads:
        if not threads.isdecimal() or int(threads) == 0:
            raise BackendError(f"{THREADS_VARIABLE}: expected a positive number of threads, got {threads!r}")
        options.intra_op_num_threads = int(threads)
    return options


def _warn_about_provider(reason: str) -> None:
    warnings.warn(f"mgca_filter runs on another provider than asked for: {reason}", RuntimeWarning, stacklevel=2)
