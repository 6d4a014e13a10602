"""What an ONNX file says of itself, read from its bytes: neither onnx nor a runtime is needed.

An ONNX file is a protobuf message: a sequence of fields, each a tag (number and wire type) and a value, messages
inside messages as length-delimited values (https://protobuf.dev/programming-guides/encoding/).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ..errors import ModelError

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_FIXED_SIZES = {_FIXED64: 8, _FIXED32: 4}
# Field numbers of onnx.proto
_MODEL_GRAPH, _MODEL_METADATA = 7, 14
_GRAPH_INPUT, _GRAPH_OUTPUT = 11, 12
_VALUE_NAME = 1
_ENTRY_KEY, _ENTRY_VALUE = 1, 2


@dataclass(frozen=True)
class OnnxFile:
    """Metadata and the names of inputs and outputs, as they stand in the file."""

    properties: dict[str, str]
    inputs: list[str]
    outputs: list[str]


def read_onnx_file(path: Path) -> OnnxFile:
    """Read metadata and names of an ONNX file.

    Raises:
        ModelError: the file is truncated or no ONNX file.
    """
    try:
        model = list(_fields(memoryview(path.read_bytes())))
        graphs = [value for number, value in model if number == _MODEL_GRAPH]
        if len(graphs) != 1:
            raise ValueError(f"{len(graphs)} graphs")
        graph = list(_fields(graphs[0]))
        entries = [dict(_fields(value)) for number, value in model if number == _MODEL_METADATA]
        return OnnxFile(
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
