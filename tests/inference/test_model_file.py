"""Model files: read and hashed once, what they say of themselves, and what is wrong with them."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import onnx
import pytest
from conftest import METADATA, build_model
from test_backends import random_input, write_safetensors

import mgca_filter
from mgca_filter import ModelError
from mgca_filter.fit.choice import fitted_coefficients
from mgca_filter.inference import METADATA_KEYS, OnnxBackend, open_backend
from mgca_filter.inference.model_file import ModelFile


@pytest.mark.parametrize("key", METADATA_KEYS)
def test_missing_metadata_is_named(key: str, tmp_path: Path) -> None:
    path = build_model(tmp_path / "m.onnx", {k: v for k, v in METADATA.items() if k != key})
    with pytest.raises(ModelError, match=rf"m\.onnx.*{key}"):
        OnnxBackend(path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("contract_version", "1"),
        ("contract_version", "3"),
        ("calibration", "{}"),
        ("calibration", '{"scale": "nan", "offset": 0}'),
        ("decision_threshold", "high"),
        ("candidate_rule", "[]"),
        ("config", "no json"),
        ("choice", "no json"),
        ("choice", "[]"),
        ("choice", "{}"),
        ("choice", json.dumps({**fitted_coefficients(), "verdict": [0.1]})),
        ("choice", json.dumps({**fitted_coefficients(), "confidence": ["high"] * 24})),
        ("choice", json.dumps({**fitted_coefficients(), "noise_px": 3})),
        ("prior", '{"weight1": [[1]], "bias1": [0], "weight2": [1], "bias2": 0}'),
    ],
)
def test_unreadable_metadata_are_named(key: str, value: str, tmp_path: Path) -> None:
    path = build_model(tmp_path / "m.onnx", {**METADATA, key: value})
    with pytest.raises(ModelError, match=rf"m\.onnx.*{key.replace('_', '.')}"):
        OnnxBackend(path)


@pytest.mark.parametrize("suffix", [".onnx", ".safetensors"])
def test_broken_files_are_named(suffix: str, tmp_path: Path, model_file: Path) -> None:
    good = write_safetensors(tmp_path / "good", METADATA) if suffix == ".safetensors" else model_file
    content = good.read_bytes()
    for name, data in {"empty": b"", "noise": b"no model at all" * 9, "cut": content[: len(content) // 2]}.items():
        path = tmp_path / f"{name}{suffix}"
        path.write_bytes(data)
        with pytest.raises(ModelError, match=f"{name}{suffix}"):
            open_backend(path)
    with pytest.raises(ModelError, match=f"absent{suffix}.*not found"):
        open_backend(tmp_path / f"absent{suffix}")


def test_cut_off_tensors_are_noticed(tmp_path: Path) -> None:
    path = write_safetensors(tmp_path / "m.safetensors", METADATA, payload=b"\0\0")
    with pytest.raises(ModelError, match="cut off"):
        ModelFile.read(path)


def test_the_file_reader_reads_what_onnx_reads(tmp_path: Path) -> None:
    metadata = {"plain": "text", "empty": "", "umlaut": "Größe", "long": "x" * 70_000}
    path = build_model(tmp_path / "m.onnx", metadata)
    file, model = ModelFile.read(path), onnx.load(str(path))
    assert file.properties == metadata == {entry.key: entry.value for entry in model.metadata_props}
    assert file.inputs == [value.name for value in model.graph.input]
    assert file.outputs == [value.name for value in model.graph.output]


def test_the_metadata_of_the_shipped_model_are_read_whole() -> None:
    path = mgca_filter.model_path()
    file = ModelFile.read(path)
    assert file.properties == {entry.key: entry.value for entry in onnx.load(str(path)).metadata_props}


@pytest.mark.parametrize("backend", ["onnxruntime", "torch"])
def test_opening_reads_and_hashes_the_file_once(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if backend == "torch":
        pytest.importorskip("torch")
    read, hashed = [], []
    read_bytes, sha256 = Path.read_bytes, hashlib.sha256
    monkeypatch.setattr(Path, "read_bytes", lambda path: read.append(path) or read_bytes(path))
    monkeypatch.setattr(hashlib, "sha256", lambda data: hashed.append(len(data)) or sha256(data))
    path = mgca_filter.model_path().with_suffix(".safetensors" if backend == "torch" else ".onnx")
    opened = open_backend(path, backend)
    assert (read, hashed) == ([path], [path.stat().st_size])
    assert opened.metadata.sha256 == sha256(read_bytes(path)).hexdigest()


def test_the_session_opens_what_was_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, read = build_model(tmp_path / "m.onnx"), ModelFile.read
    expected = OnnxBackend(path).infer(*random_input(9))

    def read_and_remove(path: Path) -> ModelFile:
        file = read(path)
        path.unlink()
        return file

    monkeypatch.setattr(ModelFile, "read", read_and_remove)
    for one, other in zip(OnnxBackend(path).infer(*random_input(9)), expected):
        np.testing.assert_array_equal(one, other)
