"""The ONNX file in OpenCV's DNN module."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from conftest import METADATA, Scene, build_model
from test_backends import BackendContract, ignores_threads, needs_fork, random_input, status_of_child

import mgca_filter
from mgca_filter import BackendError, ModelError, filter_matches
from mgca_filter.export import parity
from mgca_filter.inference import Backend, OpenCvBackend, open_backend, shared_backend

opencv5 = pytest.mark.skipif(int(cv2.__version__.split(".")[0]) < 5, reason="the backend needs OpenCV 5")


@opencv5
class TestOpenCvBackend(BackendContract):
    @pytest.fixture
    def backend(self, model_file: Path) -> Backend:
        return OpenCvBackend(model_file)

    def test_a_later_pass_leaves_earlier_results_alone(self, backend: Backend) -> None:
        first = backend.infer(*random_input(20))
        kept = [array.copy() for array in first]
        backend.infer(*random_input(21))
        for array, copy in zip(first, kept):
            np.testing.assert_array_equal(array, copy)


@pytest.fixture(scope="module")
def shipped() -> Backend:
    """The shipped model, which OpenCV takes seconds to open."""
    return shared_backend(mgca_filter.model_path(), "opencv")


@opencv5
@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 127, 512, 2000])
def test_the_shipped_model_says_what_onnx_runtime_says(shipped: Backend, count: int) -> None:
    row = parity.compare(shipped, shared_backend(mgca_filter.model_path(), "onnxruntime"), count)
    assert row.passed, parity.format_parity([row])


@opencv5
def test_opencv_has_nothing_to_warn_of(shipped: Backend, capfd: pytest.CaptureFixture[str]) -> None:
    shipped.infer(*parity.two_view_input(40, seed=0))
    assert capfd.readouterr() == ("", "")


@opencv5
@pytest.mark.parametrize("match", [[0.0, 0.0, 0.0, 0.0], [0.1, 0.2, 0.3, 0.1]])
def test_matches_that_determine_no_pose_have_the_matrix_of_onnx_runtime(shipped: Backend, match: list[float]) -> None:
    pair = np.tile(np.float32(match), (1, 50, 1)), np.zeros((1, 50, 8), dtype=np.float32)
    expected = shared_backend(mgca_filter.model_path(), "onnxruntime").infer(*pair)[1]
    np.testing.assert_allclose(shipped.infer(*pair)[1], expected, atol=1e-4)


@opencv5
def test_a_batch_says_what_its_pairs_say(shipped: Backend) -> None:
    pairs = [parity.two_view_input(40, seed) for seed in range(3)]
    logits, essential = shipped.infer(*(np.concatenate(arrays) for arrays in zip(*pairs)))
    assert essential.shape == (3, 3, 3)
    for index, pair in enumerate(pairs):
        np.testing.assert_allclose(logits[index], shipped.infer(*pair)[0][0], atol=2e-2)


@opencv5
def test_threads_do_not_mix_their_pairs(shipped: Backend) -> None:
    inputs = [parity.two_view_input(count, seed=count) for count in (30, 40, 50, 60)]
    expected = [shipped.infer(*pair)[0] for pair in inputs]
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda pair: shipped.infer(*pair)[0], inputs * 5))
    for result, wanted in zip(results, expected * 5):
        np.testing.assert_array_equal(result, wanted)


@opencv5
@needs_fork
@ignores_threads
def test_a_child_forked_during_a_pass_does_not_wait_for_it(model_file: Path) -> None:
    backend, inputs = OpenCvBackend(model_file), random_input(40)
    expected = backend.infer(*inputs)[0]
    with backend._lock:
        assert status_of_child(lambda: np.testing.assert_array_equal(backend.infer(*inputs)[0], expected)) == 0


@opencv5
def test_filter_matches_runs_on_opencv(scene: Scene) -> None:
    arguments = {"attributes": scene.attributes, "threshold": 2.0}
    results = [
        filter_matches(scene.points1, scene.points2, None, backend=backend, **arguments)
        for backend in ("opencv", "onnxruntime")
    ]
    assert [result.info["backend"] for result in results] == ["opencv", "onnxruntime"]
    np.testing.assert_allclose(results[0].scores, results[1].scores, atol=2e-2)
    assert results[0].status == results[1].status


@opencv5
def test_onnx_runtime_is_not_needed(model_file: Path) -> None:
    program = (
        "import sys; sys.modules['onnxruntime'] = None\n"
        "import numpy as np, mgca_filter\n"
        "rng = np.random.default_rng(0)\n"
        "result = mgca_filter.filter_matches(rng.random((60, 2)) * 500, rng.random((60, 2)) * 500, None, "
        "backend='opencv', model=sys.argv[1])\n"
        "assert result.info['backend'] == 'opencv'\n"
        "assert not {'onnx', 'torch'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", program, str(model_file)], check=True)


def test_older_opencv_is_named_with_what_to_install(model_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "__version__", "4.14.0")
    with pytest.raises(BackendError, match=r"OpenCV 5.*4\.14\.0.*pip install.*onnxruntime"):
        open_backend(model_file, "opencv")


@opencv5
def test_a_graph_that_opencv_refuses_is_a_backend_error(model_file: Path, tmp_path: Path) -> None:
    model = onnx.load(str(model_file))
    model.graph.node[0].op_type = "NoSuchOperator"
    onnx.save(model, str(tmp_path / "m.onnx"))
    with pytest.raises(BackendError, match=r"m\.onnx"):
        OpenCvBackend(tmp_path / "m.onnx").infer(*random_input(9))


def test_broken_files_are_named(model_file: Path, tmp_path: Path) -> None:
    content = model_file.read_bytes()
    cases = {"empty": b"", "noise": b"no model at all" * 9, "cut": content[:-200], "half": content[: len(content) // 2]}
    for name, data in cases.items():
        path = tmp_path / f"{name}.onnx"
        path.write_bytes(data)
        with pytest.raises(ModelError, match=rf"{name}\.onnx"):
            OpenCvBackend(path)
    with pytest.raises(ModelError, match="not found"):
        OpenCvBackend(tmp_path / "absent.onnx")


def test_contract_is_checked_without_a_runtime(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="contract version 1"):
        OpenCvBackend(build_model(tmp_path / "a.onnx", {**METADATA, "contract_version": "1"}))
    with pytest.raises(ModelError, match="inputs"):
        OpenCvBackend(build_model(tmp_path / "b.onnx", input_names=("points", "attributes")))
    with pytest.raises(ModelError, match="outputs"):
        OpenCvBackend(build_model(tmp_path / "c.onnx", output_names=("scores", "essential")))


@opencv5
def test_a_second_pass_over_as_many_matches_is_as_right_as_the_first() -> None:
    path = mgca_filter.model_path("fast")
    ours, reference = OpenCvBackend(path), open_backend(path, "onnxruntime")
    for seed in range(3):  # neighbours are searched in blocks of 256, of which the last is shorter here
        pair = parity.two_view_input(300, seed)
        difference = np.abs(ours.infer(*pair)[0] - reference.infer(*pair)[0])
        assert np.quantile(difference, 0.9) < parity.QUANTILE_TOLERANCE
