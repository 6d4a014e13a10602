"""A model file, read once and hashed once: its bytes, what it says of itself, and whether it is what it should be.

ONNX files are read from their bytes; neither onnx nor a runtime is needed. An ONNX file is a protobuf message: a
sequence of fields, each a tag (number and wire type) and a value, messages inside messages as length-delimited values
(https://protobuf.dev/programming-guides/encoding/). A safetensors file is eight bytes of length, a JSON header, and
the tensors (https://huggingface.co/docs/safetensors). Beside the shipped models lies ``SHA256SUMS``, in the form that
``sha256sum -c`` reads.
"""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ModelError
from ..fit.choice import check_coefficients
from ..inputs.attributes import ATTRIBUTE_COUNT
from .calibration import AttributePrior, Calibration

CONTRACT_VERSION = "2"
# The largest preset takes 20 MB; more than this is another file, and is not read into memory.
MAX_MODEL_BYTES = 2**29
SUMS_NAME = "SHA256SUMS"
WEIGHTS_SUFFIX = ".safetensors"
_MODEL_SUFFIXES = (".onnx", WEIGHTS_SUFFIX)
_TEXT_KEYS = (
    "name",
    "version",
    "git_commit",
    "training_data",
    "detector",
    "normalization",
    "license",
    "minimum_onnxruntime",
)
METADATA_KEYS = (
    "contract_version",
    *_TEXT_KEYS,
    "config",
    "calibration",
    "decision_threshold",
    "candidate_rule",
    "prior",
    "choice",
)

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_FIXED_SIZES = {_FIXED64: 8, _FIXED32: 4}
# Field numbers of onnx.proto
_MODEL_GRAPH, _MODEL_METADATA = 7, 14
_GRAPH_INPUT, _GRAPH_OUTPUT = 11, 12
_VALUE_NAME = 1
_ENTRY_KEY, _ENTRY_VALUE = 1, 2
_HEADER_LENGTH_BYTES = 8


@dataclass(frozen=True)
class ModelMetadata:
    """Metadata of a model file; strings in the file, typed here.

    Attributes:
        name, version, git_commit, training_data, detector, normalization, license, minimum_onnxruntime: text.
        config: the network's configuration.
        calibration: logits to probabilities.
        decision_threshold: a match above this logit counts as accepted.
        candidate_max_ratio, candidate_min_count: which matches enter the network (``candidate_mask``).
        prior: scores of the matches that do not.
        choice: coefficients of the choice among hypotheses and of its confidence (``fit/choice.py``).
        sha256: of the model file, hexadecimal.
    """

    name: str
    version: str
    git_commit: str
    training_data: str
    detector: str
    normalization: str
    license: str
    minimum_onnxruntime: str
    config: dict[str, Any]
    calibration: Calibration
    decision_threshold: float
    candidate_max_ratio: float
    candidate_min_count: int
    prior: AttributePrior
    choice: dict[str, list[float]]
    sha256: str


@dataclass(frozen=True)
class ModelFile:
    """An ``.onnx`` or ``.safetensors`` file as it was when it was read.

    Attributes:
        path: where it was read. content: its bytes. sha256: of them, hexadecimal.
        properties: metadata as they stand in the file.
        inputs, outputs: names in an ONNX graph; empty for weights.
    """

    path: Path
    content: bytes
    sha256: str
    properties: dict[str, str]
    inputs: list[str]
    outputs: list[str]

    @classmethod
    def read(cls, path: Path) -> ModelFile:
        """Read a file, the only time that a backend does so itself.

        Raises:
            ModelError: the file is missing, empty, too large for a model, truncated, or of another format; or the
                ``SHA256SUMS`` beside it lists another file of this name. A file that is not listed, a user's own
                model, is not compared.
        """
        if not path.is_file():
            raise ModelError(f"{path}: model file not found")
        size = path.stat().st_size
        if size == 0:
            raise ModelError(f"{path}: model file is empty")
        if size > MAX_MODEL_BYTES:
            raise ModelError(f"{path}: {size} bytes is no model of this package, at most {MAX_MODEL_BYTES} are read")
        content = path.read_bytes()
        sha256 = hashlib.sha256(content).hexdigest()
        if read_checksums(path.parent).get(path.name, sha256) != sha256:
            raise ModelError(f"{path}: damaged or replaced, its SHA-256 is not the one in {path.parent / SUMS_NAME}")
        if path.suffix == WEIGHTS_SUFFIX:
            return cls(path, content, sha256, _safetensors_properties(content, path), [], [])
        return cls(path, content, sha256, *_onnx_description(content, path))

    def metadata(self) -> ModelMetadata:
        """What a caller of the network has to know, checked.

        Raises:
            ModelError: a key is missing, a value cannot be read, or the contract is another.
        """
        return _parse_metadata(self.properties, self.sha256, self.path)


def sha256_of(path: Path) -> str:
    """Hexadecimal digest of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def read_checksums(folder: Path) -> dict[str, str]:
    """Digests by file name, as ``SHA256SUMS`` in the folder lists them; empty without such a file."""
    path = folder / SUMS_NAME
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return {name: digest for digest, name in (line.split(maxsplit=1) for line in lines if line.strip())}


def record_checksums(folder: Path) -> Path:
    """Write ``SHA256SUMS`` for the model files of a folder."""
    files = sorted(path for path in folder.iterdir() if path.suffix in _MODEL_SUFFIXES)
    sums = folder / SUMS_NAME
    sums.write_text("".join(f"{sha256_of(path)}  {path.name}\n" for path in files), encoding="utf-8")
    return sums


def _parse_metadata(properties: Mapping[str, str], sha256: str, path: Path) -> ModelMetadata:
    missing = [key for key in METADATA_KEYS if key not in properties]
    if missing:
        raise ModelError(f"{path}: not a model of this package, metadata missing: {', '.join(missing)}")
    version = properties["contract_version"]
    if version != CONTRACT_VERSION:
        raise ModelError(f"{path}: contract version {version}, this package reads version {CONTRACT_VERSION}")
    key = ""
    try:
        key = "config"
        config = dict(json.loads(properties[key]))
        key = "calibration"
        calibration = json.loads(properties[key])
        scale, offset = _finite(calibration["scale"]), _finite(calibration["offset"])
        key = "decision_threshold"
        threshold = _finite(properties[key])
        key = "candidate_rule"
        rule = json.loads(properties[key])
        max_ratio, min_count = _finite(rule["max_ratio"]), int(rule["min_count"])
        key = "prior"
        prior = _parse_prior(json.loads(properties[key]))
        key = "choice"
        choice = check_coefficients(json.loads(properties[key]))
    except (ValueError, TypeError, KeyError) as error:
        raise ModelError(f"{path}: metadata '{key}' cannot be read ({type(error).__name__}: {error})") from error
    return ModelMetadata(
        **{field: properties[field] for field in _TEXT_KEYS},
        config=config,
        calibration=Calibration(scale, offset),
        decision_threshold=threshold,
        candidate_max_ratio=max_ratio,
        candidate_min_count=min_count,
        prior=prior,
        choice=choice,
        sha256=sha256,
    )


def _finite(value: Any) -> float:
    number = float(value)
    if not np.isfinite(number):
        raise ValueError(f"expected a finite number, got {value!r}")
    return number


def _parse_prior(values: Mapping[str, Any]) -> AttributePrior:
    weight1 = np.asarray(values["weight1"], dtype=np.float64)
    bias1, weight2 = (np.asarray(values[key], dtype=np.float64) for key in ("bias1", "weight2"))
    hidden = len(bias1)
    if weight1.shape != (hidden, ATTRIBUTE_COUNT) or bias1.shape != (hidden,) or weight2.shape != (hidden,):
        raise ValueError(f"shapes {weight1.shape}, {bias1.shape}, {weight2.shape} do not fit together")
    if not all(np.isfinite(array).all() for array in (weight1, bias1, weight2)):
        raise ValueError("weights hold NaN or infinite values")
    return AttributePrior(weight1, bias1, weight2, _finite(values["bias2"]))


def _safetensors_properties(content: bytes, path: Path) -> dict[str, str]:
    """The ``__metadata__`` of a safetensors file; ModelError unless its header and all tensors are there."""
    try:
        (length,) = struct.unpack_from("<Q", content)
        end_of_header = _HEADER_LENGTH_BYTES + length
        if end_of_header > len(content):
            raise ValueError("the header is longer than the file")
        header: dict[str, Any] = json.loads(content[_HEADER_LENGTH_BYTES:end_of_header])
        properties = dict(header.pop("__metadata__", {}))
        end = max((entry["data_offsets"][1] for entry in header.values()), default=0)
        if end_of_header + end > len(content):
            raise ValueError("the tensors are cut off")
    except (struct.error, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ModelError(f"{path}: not a readable safetensors file, truncated or damaged ({error})") from error
    return properties


def _onnx_description(content: bytes, path: Path) -> tuple[dict[str, str], list[str], list[str]]:
    """Metadata and the names of inputs and outputs of an ONNX file; ModelError where it is truncated or none."""
    try:
        model = list(_fields(memoryview(content)))
        graphs = [value for number, value in model if number == _MODEL_GRAPH]
        if len(graphs) != 1:
            raise ValueError(f"{len(graphs)} graphs")
        graph = list(_fields(graphs[0]))
        entries = [dict(_fields(value)) for number, value in model if number == _MODEL_METADATA]
        return (
            {_text(entry[_ENTRY_KEY]): _text(entry.get(_ENTRY_VALUE, memoryview(b""))) for entry in entries},
            [_text(dict(_fields(value))[_VALUE_NAME]) for number, value in graph if number == _GRAPH_INPUT],
            [_text(dict(_fields(value))[_VALUE_NAME]) for number, value in graph if number == _GRAPH_OUTPUT],
        )
    except (ValueError, KeyError, IndexError) as error:
        raise ModelError(f"{path}: not a readable ONNX model, truncated or damaged ({error})") from error


def _fields(message: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Number and bytes of each length-delimited field; the others are passed over."""
    position = 0
    while position < len(message):
        tag, position = _varint(message, position)
        number, wire_type = tag >> 3, tag & 7
        if wire_type == _VARINT:
            _, position = _varint(message, position)
            continue
        if wire_type == _BYTES:
            size, position = _varint(message, position)
        elif wire_type in _FIXED_SIZES:
            size = _FIXED_SIZES[wire_type]
        else:
            raise ValueError(f"wire type {wire_type}")
        if position + size > len(message):
            raise ValueError("a field is cut off")
        if wire_type == _BYTES:
            yield number, message[position : position + size]
        position += size


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    """An integer of seven bits a byte, lowest first, and the position behind it."""
    value = shift = 0
    while True:
        byte = message[position]
        position += 1
        value |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            return value, position
        if shift > 63:
            raise ValueError("a number is too long")


def _text(value: memoryview) -> str:
    return bytes(value).decode("utf-8")
