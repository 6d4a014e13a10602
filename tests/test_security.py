"""Model files and images are data from outside: checked before use, and never code."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import METADATA, build_model
from image_files import promising

import mgca_filter
from mgca_filter import ModelError, model_path
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


def run_measured(path: Path, limit_s: float) -> tuple[int, str, int]:
    """``mgca-match`` on an image file and itself: exit status, stderr, and the most memory it held, in megabytes.

    Not ``ru_maxrss``, which a child inherits from whoever started it.
    """
    program = (
        "import re, sys; from mgca_filter import cli; status = cli.main([sys.argv[1], sys.argv[1]]);"
        "print(int(re.search(r'VmHWM:\\s*(\\d+)', open('/proc/self/status').read())[1]) // 1024); sys.exit(status)"
    )
    environment = {**os.environ, "PYTHONPATH": str(PACKAGE.parent)}
    command = [sys.executable, "-c", program, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=limit_s)
    return done.returncode, done.stderr, int(done.stdout.split()[-1])


# 2^28 pixels are the limit; no side of a WebP is longer than 16383. A JPEG between that and OpenCV's own limit of 2^30
# took 5 GB.
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tiff", ".ppm", ".gif"])
def test_an_image_that_promises_too_much_is_not_decoded(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"bomb{suffix}"
    path.write_bytes(promising(suffix, 30_000, 30_000))
    status, error, megabytes = run_measured(path, limit_s=60.0)
    assert status == 2
    assert error.count("\n") == 1, error
    assert path.name in error
    assert "promises 30000 x 30000 pixels" in error
    assert megabytes < 500
    assert PairWorker({}).extract(path.name, path.read_bytes(), "sift", 10) == (path.name, None, 1)


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tiff", ".ppm"])
def test_a_file_without_the_pixels_it_promises_takes_no_memory(tmp_path: Path, suffix: str) -> None:
    """Within the limit, and 0.8 GB in colour, were the pixels there."""
    path = tmp_path / f"short{suffix}"
    path.write_bytes(promising(suffix, 16_000, 16_000))
    status, error, megabytes = run_measured(path, limit_s=60.0)
    assert status == 2
    assert "short" in error.splitlines()[-1]
    assert "Traceback" not in error
    assert megabytes < 500


@pytest.mark.slow
@pytest.mark.parametrize(("suffix", "size"), [(".webp", 16_383), (".jpg", 16_000)])
def test_the_largest_images_that_a_small_file_can_hold_are_only_large(tmp_path: Path, suffix: str, size: int) -> None:
    """JPEG fills up what is missing, and few bytes of WebP are a whole image where libwebp takes them: no geometry."""
    path = tmp_path / f"flat{suffix}"
    path.write_bytes(promising(suffix, size, size))
    status, error, megabytes = run_measured(path, limit_s=250.0)
    assert status == 1 or (suffix == ".webp" and status == 2)
    assert (path.name in error) == (status == 2)
    assert "Traceback" not in error
    assert megabytes < 5000
