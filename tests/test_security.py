"""Model files and images are data from outside: checked before use, and never code."""

from __future__ import annotations

import ast
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import METADATA, build_model

import mgca_filter
from mgca_filter import ModelError, cli, model_path
from mgca_filter.evaluation.hostile_files import png_that_promises
from mgca_filter.image_header import MAX_PIXELS, promised_size
from mgca_filter.inference import model_file, open_backend
from mgca_filter.inference.model_file import SUMS_NAME, ModelFile, read_checksums, record_checksums
from mgca_filter.pipelines.worker import PairWorker

PACKAGE = Path(mgca_filter.__file__).parent
# Calls that run what a file says: pickles in any wrapping, and code.
FORBIDDEN = {"pickle.load", "pickle.loads", "pickle.Unpickler", "marshal.loads", "joblib.load", "eval", "exec"}


def called_names(path: Path) -> list[tuple[str, ast.Call]]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return [(ast.unparse(node.func), node) for node in ast.walk(tree) if isinstance(node, ast.Call)]


def test_nothing_in_the_package_loads_pickles() -> None:
    files = sorted(PACKAGE.rglob("*.py"))
    assert len(files) > 50
    for path in files:
        for name, call in called_names(path):
            keywords = {k.arg: ast.unparse(k.value) for k in call.keywords}
            assert name not in FORBIDDEN, path
            if name == "np.load":
                assert keywords.get("allow_pickle", "False") == "False", path
            if name == "torch.load":
                assert keywords.get("weights_only") == "True", path


def test_checksums_of_the_shipped_models_are_right() -> None:
    listed = read_checksums(model_path().parent)
    shipped = [p for p in model_path().parent.iterdir() if p.suffix in (".onnx", ".safetensors")]
    assert set(listed) == {path.name for path in shipped}
    for path in shipped:
        assert ModelFile.read(path).sha256 == listed[path.name]


@pytest.mark.parametrize("backend", ["onnxruntime", "opencv", "torch"])
def test_a_listed_model_that_changed_is_refused(tmp_path: Path, backend: str) -> None:
    for suffix in (".onnx", ".safetensors"):
        (tmp_path / f"m{suffix}").write_bytes(model_path().with_suffix(suffix).read_bytes())
    record_checksums(tmp_path)
    target = tmp_path / ("m.safetensors" if backend == "torch" else "m.onnx")
    damaged = bytearray(target.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    target.write_bytes(damaged)
    with pytest.raises(ModelError, match=f"{target.name}.*SHA-256.*{SUMS_NAME}"):
        open_backend(tmp_path / "m.onnx", backend)


def test_models_that_nobody_listed_are_not_checked(tmp_path: Path) -> None:
    assert open_backend(build_model(tmp_path / "own.onnx")).metadata.name == "ratio_test"


def test_a_file_too_large_for_a_model_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = build_model(tmp_path / "m.onnx")
    monkeypatch.setattr(model_file, "MAX_MODEL_BYTES", path.stat().st_size - 1)
    with pytest.raises(ModelError, match=r"m\.onnx.*bytes"):
        open_backend(path)


def test_the_contract_is_checked_before_a_runtime_sees_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")

    def opened(*arguments: object, **options: object) -> None:
        raise AssertionError("opened")

    monkeypatch.setattr(onnxruntime, "InferenceSession", opened)
    path = build_model(tmp_path / "m.onnx", {**METADATA, "contract_version": "99"})
    with pytest.raises(ModelError, match="contract version 99"):
        open_backend(path)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_size_is_read_from_the_header(suffix: str) -> None:
    image = np.random.default_rng(0).integers(0, 256, (37, 53, 3), dtype=np.uint8)
    data = cv2.imencode(suffix, image)[1].tobytes()
    assert promised_size(data) == (53, 37)
    for count in range(0, 30):
        assert promised_size(data[:count]) in (None, (53, 37))
    assert promised_size(b"GIF89a") is None


def test_an_image_that_promises_too_much_is_not_decoded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *arguments: pytest.fail("decoded"))
    path = tmp_path / "bomb.png"
    path.write_bytes(png_that_promises(20_000, 20_000))
    assert MAX_PIXELS < 20_000**2
    assert cli.main([str(path), str(path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "bomb.png" in error
    assert "20000 x 20000" in error
    assert PairWorker({}).extract("bomb.png", path.read_bytes(), "sift", 10) == ("bomb.png", None)
