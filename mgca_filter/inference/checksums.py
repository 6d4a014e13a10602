"""``SHA256SUMS`` beside the shipped models, in the form that ``sha256sum -c`` reads."""

from __future__ import annotations

import hashlib
from pathlib import Path

from ..errors import ModelError

SUMS_NAME = "SHA256SUMS"
_MODEL_SUFFIXES = (".onnx", ".safetensors")


def sha256_of(path: Path) -> str:
    """Hexadecimal digest of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def read_checksums(folder: Path) -> dict[str, str]:
    """Digests by file name, as ``SHA256SUMS`` in the folder lists them; empty without such a file."""
    path = folder / SUMS_NAME
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return {name: digest for digest, name in (line.split(maxsplit=1) for line in lines if line.strip())}


def check_checksum(path: Path) -> None:
    """Raise ModelError where a model file is another than the ``SHA256SUMS`` beside it says.

    A file that the list does not name, a user's own model, is not checked.
    """
    expected = read_checksums(path.parent).get(path.name)
    if expected is not None and sha256_of(path) != expected:
        raise ModelError(f"{path}: damaged or replaced, its SHA-256 is not the one in {path.parent / SUMS_NAME}")


def record_checksums(folder: Path) -> Path:
    """Write ``SHA256SUMS`` for the model files of a folder."""
    files = sorted(path for path in folder.iterdir() if path.suffix in _MODEL_SUFFIXES)
    sums = folder / SUMS_NAME
    sums.write_text("".join(f"{sha256_of(path)}  {path.name}\n" for path in files), encoding="utf-8")
    return sums
