"""Model files and inference backends: one contract, broken files named, PyTorch where ONNX Runtime is missing."""

from __future__ import annotations

import gc
import json
import os
import pickle
import signal
import struct
import subprocess
import sys
import types
import warnings
import weakref
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import METADATA, build_model

import mgca_filter.inference.torch_ as torch_backend
from mgca_filter import BackendError, ModelError, filter_matches
from mgca_filter import inference as backends
from mgca_filter.inference import Backend, OnnxBackend, TorchBackend, open_backend, shared_backend
from mgca_filter.inference import onnxruntime_ as onnxruntime_backend
from mgca_filter.inference.onnxruntime_ import TELEMETRY_VARIABLE


def random_input(count: int, batch: int = 2) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(count)
    return rng.uniform(-1, 1, (batch, count, 4)).astype(np.float32), rng.random((batch, count, 8)).astype(np.float32)


def write_safetensors(path: Path, metadata: dict[str, str], payload: bytes = b"\0" * 4) -> Path:
    """A file of the safetensors format with one float."""
    header = {"__metadata__": metadata, "w": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}}
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + payload)
    return path


@pytest.fixture
def torch_stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """A network with the formula of the test model in place of the package's own."""
    torch = pytest.importorskip("torch")

    class RatioTest(torch.nn.Module):
        def forward(self, correspondences, attributes):  # noqa: ANN001, ANN202
            essential = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]]) / 2**0.5
            return types.SimpleNamespace(
                logits=6.4 - 8 * attributes[..., 0], essential=essential.expand(len(correspondences), 3, 3)
            )

    network = types.ModuleType("mgca_filter.network")
    network.load_network = lambda path: RatioTest()
    monkeypatch.setitem(sys.modules, "mgca_filter.network", network)


class BackendContract:
    """What holds for every backend."""

    @pytest.fixture
    def backend(self, model_file: Path) -> Backend:
        raise NotImplementedError

    @pytest.mark.parametrize("count", [1, 7, 8, 9, 127, 2000])
    def test_shapes_and_values(self, backend: Backend, count: int) -> None:
        correspondences, attributes = random_input(count)
        logits, essential = backend.infer(correspondences, attributes)
        assert logits.shape == (2, count)
        assert essential.shape == (2, 3, 3)
        assert logits.dtype == essential.dtype == np.float32
        np.testing.assert_allclose(logits, 6.4 - 8 * attributes[..., 0], atol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(essential, axis=(1, 2)), 1.0, atol=1e-6)

    def test_metadata_are_read(self, backend: Backend) -> None:
        assert backend.metadata.name == "ratio_test"
        assert backend.metadata.candidate_max_ratio == 0.95
        assert backend.metadata.candidate_min_count == 32
        assert len(backend.metadata.sha256) == 64

    def test_pickle_reopens_the_model(self, backend: Backend) -> None:
        again = pickle.loads(pickle.dumps(backend))
        for one, other in zip(backend.infer(*random_input(9)), again.infer(*random_input(9))):
            np.testing.assert_array_equal(one, other)

    def test_permuting_matches_permutes_logits(self, backend: Backend) -> None:
        correspondences, attributes = random_input(50)
        order = np.random.default_rng(1).permutation(50)
        logits = backend.infer(correspondences, attributes)[0]
        np.testing.assert_allclose(
            backend.infer(correspondences[:, order], attributes[:, order])[0], logits[:, order], atol=1e-5
        )

    @pytest.mark.parametrize(
        ("correspondences", "attributes", "named"),
        [
            (np.zeros((1, 5, 3), np.float32), np.zeros((1, 5, 8), np.float32), "correspondences"),
            (np.zeros((1, 5, 4), np.float32), np.zeros((5, 8), np.float32), "attributes"),
            (np.zeros((1, 5, 4)), np.zeros((1, 5, 8), np.float32), "float64"),
            (np.zeros((1, 5, 4), np.float32), np.zeros((1, 6, 8), np.float32), "differ"),
            (np.zeros((1, 0, 4), np.float32), np.zeros((1, 0, 8), np.float32), "at least one match"),
            (np.full((1, 5, 4), np.nan, np.float32), np.zeros((1, 5, 8), np.float32), "correspondences.*NaN"),
            (np.zeros((1, 5, 4), np.float32), np.full((1, 5, 8), np.inf, np.float32), "attributes.*infinite"),
        ],
    )
    def test_input_that_cannot_be_is_named(
        self, backend: Backend, correspondences: np.ndarray, attributes: np.ndarray, named: str
    ) -> None:
        with pytest.raises(BackendError, match=named):
            backend.infer(correspondences, attributes)


class TestOnnxBackend(BackendContract):
    @pytest.fixture
    def backend(self, model_file: Path) -> Backend:
        return OnnxBackend(model_file)

    def test_the_number_of_threads_comes_from_the_environment(
        self, model_file: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("MGCA_FILTER_NUM_THREADS", "3")
        assert OnnxBackend(model_file)._session.get_session_options().intra_op_num_threads == 3
        monkeypatch.setenv("MGCA_FILTER_NUM_THREADS", "many")
        with pytest.raises(BackendError, match="MGCA_FILTER_NUM_THREADS.*many"):
            OnnxBackend(model_file)

    def test_refusal_by_the_runtime_is_a_backend_error(self, backend: Backend, monkeypatch: pytest.MonkeyPatch) -> None:
        import onnxruntime

        def refuse(*_: object) -> None:
            raise RuntimeError("no memory")

        monkeypatch.setattr(onnxruntime.InferenceSession, "run", refuse)
        with pytest.raises(BackendError, match="no memory"):
            backend.infer(*random_input(5))


@pytest.mark.usefixtures("torch_stand_in")
class TestTorchBackend(BackendContract):
    @pytest.fixture
    def backend(self, tmp_path: Path) -> Backend:
        return TorchBackend(write_safetensors(tmp_path / "m.safetensors", METADATA))


def test_other_inputs_or_outputs_are_named(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="inputs"):
        OnnxBackend(build_model(tmp_path / "a.onnx", input_names=("points", "attributes")))
    with pytest.raises(ModelError, match="outputs"):
        OnnxBackend(build_model(tmp_path / "b.onnx", output_names=("scores", "essential")))


def without_onnxruntime(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)


@pytest.mark.usefixtures("torch_stand_in")
def test_torch_takes_over_with_one_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = build_model(tmp_path / "m.onnx")
    write_safetensors(tmp_path / "m.safetensors", METADATA)
    expected = open_backend(path).infer(*random_input(40))
    without_onnxruntime(monkeypatch)
    with pytest.warns(RuntimeWarning, match="PyTorch") as caught:
        backend = open_backend(path)
    assert len(caught) == 1
    assert backend.name == "torch"
    for one, other in zip(backend.infer(*random_input(40)), expected):
        np.testing.assert_allclose(one, other, atol=1e-5)


@pytest.mark.usefixtures("torch_stand_in")
@pytest.mark.parametrize("step", ["InferenceSession", "run"])
def test_torch_takes_over_where_onnxruntime_fails(step: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import onnxruntime

    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("out of order")

    path = build_model(tmp_path / "m.onnx")
    write_safetensors(tmp_path / "m.safetensors", METADATA)
    owner = onnxruntime if step == "InferenceSession" else onnxruntime.InferenceSession
    monkeypatch.setattr(owner, step, fail)
    with pytest.warns(RuntimeWarning, match="out of order") as caught:
        results = [filter_matches(np.zeros((9, 2)), np.zeros((9, 2)), None, model=path) for _ in range(3)]
    assert len(caught) == 1
    assert {result.info["backend"] for result in results} == {"torch"}
    with pytest.raises(BackendError, match="out of order"):
        OnnxBackend(path).infer(*random_input(9))


@pytest.mark.usefixtures("torch_stand_in")
def test_torch_on_request_needs_no_warning(tmp_path: Path) -> None:
    path = build_model(tmp_path / "m.onnx")
    write_safetensors(tmp_path / "m.safetensors", METADATA)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert open_backend(path, "torch").name == "torch"
        assert open_backend(path.with_suffix(".safetensors")).name == "torch"
        assert open_backend(path, "onnxruntime").name == "onnxruntime"


def test_no_runtime_at_all_is_a_backend_error(
    model_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_onnxruntime(monkeypatch)
    with pytest.raises(BackendError, match="ONNX Runtime"):
        open_backend(model_file)
    with pytest.raises(BackendError, match="ONNX Runtime"):
        open_backend(model_file, "onnxruntime")
    weights = write_safetensors(tmp_path / "m.safetensors", METADATA)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(BackendError, match="PyTorch"):
        torch_backend.TorchBackend(weights)


def test_torch_without_safetensors_is_a_backend_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch")
    for name in [name for name in sys.modules if name.startswith("mgca_filter.network")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "safetensors", None)
    with pytest.raises(BackendError, match="safetensors"):
        TorchBackend(write_safetensors(tmp_path / "m.safetensors", METADATA))


def test_a_file_that_changes_replaces_its_session(tmp_path: Path) -> None:
    path = build_model(tmp_path / "m.onnx")
    first = shared_backend(path)
    assert shared_backend(path) is first
    build_model(path, {**METADATA, "name": "a longer name than before"})
    second = shared_backend(path)
    assert second.metadata.name == "a longer name than before"
    forgotten = weakref.ref(first)
    del first
    gc.collect()
    assert forgotten() is None


needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
ignores_threads = pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")


def status_of_child(work: Callable[[], object]) -> int:
    """Exit status of a forked child that does some work; a child that waits for ever is ended."""
    child = os.fork()
    if child == 0:
        signal.alarm(60)
        status = 1
        try:
            work()
            status = 0
        finally:
            os._exit(status)
    return os.waitpid(child, 0)[1]


@needs_fork
@ignores_threads
def test_a_child_forked_while_a_model_opens_does_not_wait_for_it(tmp_path: Path) -> None:
    path = build_model(tmp_path / "m.onnx")
    with backends._open_lock:
        assert status_of_child(lambda: shared_backend(path)) == 0


# In a process of its own: the threads of this one are shared with other tests.
FORKED = """
import os, signal, sys
import numpy as np
from mgca_filter import model_path
from mgca_filter.inference import open_backend, shared_backend
if sys.argv[1] == "torch":
    import torch
    torch.set_num_threads(2)
rng = np.random.default_rng(0)
inputs = rng.uniform(-0.5, 0.5, (1, 300, 4)).astype(np.float32), rng.random((1, 300, 8), dtype=np.float32)
backend = shared_backend(model_path(), sys.argv[1])
expected = backend.infer(*inputs)[0]
child = os.fork()
if child == 0:
    signal.alarm(60)
    status = 1
    try:
        for again in (backend, shared_backend(model_path(), sys.argv[1]), open_backend(model_path(), sys.argv[1])):
            difference = np.abs(again.infer(*inputs)[0] - expected)
            assert np.median(difference) < 1e-3 and np.quantile(difference, 0.9) < 0.15, difference.max()
        status = 0
    finally:
        os._exit(status)
assert os.waitpid(child, 0)[1] == 0
assert np.array_equal(backend.infer(*inputs)[0], expected)
if sys.argv[1] == "torch":
    assert torch.get_num_threads() == 2
"""


@needs_fork
@pytest.mark.parametrize("name", ["onnxruntime", pytest.param("torch", marks=pytest.mark.slow)])
def test_a_forked_child_answers_like_its_parent(name: str) -> None:
    pytest.importorskip(name)
    environment = {**os.environ, "MGCA_FILTER_NUM_THREADS": "2", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    subprocess.run([sys.executable, "-W", "ignore", "-c", FORKED, name], env=environment, check=True, timeout=120)


def test_onnx_runtime_does_not_report_home(model_file: Path, tmp_path: Path) -> None:
    program = (
        "import sys, pathlib; from mgca_filter.inference import OnnxBackend; OnnxBackend(pathlib.Path(sys.argv[1]))"
    )
    environment = {key: value for key, value in os.environ.items() if key != TELEMETRY_VARIABLE}
    environment |= {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
    command = [sys.executable, "-c", program, str(model_file)]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    assert list(tmp_path.rglob("*")) == []  # with its telemetry on, newer versions leave the name of the device here
    environment["HOME"] = environment["XDG_CACHE_HOME"] = os.devnull
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    assert done.stderr == ""


@pytest.mark.parametrize(("wish", "told"), [(None, 1), ("1", 1), ("0", 0)])
def test_who_wants_the_telemetry_of_onnx_runtime_keeps_it(
    model_file: Path, monkeypatch: pytest.MonkeyPatch, wish: str | None, told: int
) -> None:
    import onnxruntime

    calls: list[int] = []
    monkeypatch.setattr(onnxruntime, "disable_telemetry_events", lambda: calls.append(1))
    monkeypatch.delenv(TELEMETRY_VARIABLE, raising=False)
    if wish is not None:
        monkeypatch.setenv(TELEMETRY_VARIABLE, wish)
    OnnxBackend(model_file)
    assert len(calls) == told


@pytest.mark.parametrize(
    "providers", [["NoSuchProvider"], ["NoSuchProvider", "CPUExecutionProvider"], [("NoSuchProvider", {"device": 0})]]
)
def test_missing_provider_falls_back_with_one_warning(model_file: Path, providers: list) -> None:
    with pytest.warns(RuntimeWarning, match="NoSuchProvider") as caught:
        backend = OnnxBackend(model_file, providers)
    assert len(caught) == 1
    assert backend.infer(*random_input(5))[0].shape == (2, 5)


def test_the_environment_says_which_providers_run_where_the_caller_does_not(
    model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MGCA_FILTER_PROVIDERS", "NoSuchProvider,CPUExecutionProvider")
    with pytest.warns(RuntimeWarning, match="NoSuchProvider"):
        OnnxBackend(model_file)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        OnnxBackend(model_file, ["CPUExecutionProvider"])


class RuntimeWithProviders:
    """Stands for an ONNX Runtime with providers that are not installed here; notes what sessions are opened with."""

    def __init__(self, knows_precision: bool = True) -> None:
        self.opened: list[list] = []
        self._knows_precision = knows_precision

    def __getattr__(self, name: str) -> object:
        import onnxruntime

        return getattr(onnxruntime, name)

    def get_available_providers(self) -> list[str]:
        return [
            *("OpenVINOExecutionProvider", "CUDAExecutionProvider", "TensorrtExecutionProvider"),
            *("OtherProvider", "CPUExecutionProvider"),
        ]

    def InferenceSession(self, content: bytes, options: object, providers: list, **_: object) -> object:  # noqa: N802
        self.opened.append(providers)
        if not self._knows_precision and any("use_tf32" in given[1] for given in providers if len(given) == 2):
            raise RuntimeError("unknown option")
        names = [given if isinstance(given, str) else given[0] for given in providers]
        return types.SimpleNamespace(get_providers=lambda: names)


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ("TensorrtExecutionProvider", ("TensorrtExecutionProvider", {"trt_fp16_enable": "0"})),
        (
            ("TensorrtExecutionProvider", {"trt_fp16_enable": "1", "device_id": 1}),
            ("TensorrtExecutionProvider", {"trt_fp16_enable": "1", "device_id": 1}),
        ),
        (("CUDAExecutionProvider", {"device_id": 1}), ("CUDAExecutionProvider", {"use_tf32": "0", "device_id": 1})),
        ("OtherProvider", "OtherProvider"),
    ],
)
def test_providers_are_told_to_compute_in_full_precision(model_file: Path, monkeypatch, asked, told) -> None:
    runtime = RuntimeWithProviders()
    monkeypatch.setattr(onnxruntime_backend, "_import_runtime", lambda: runtime)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        OnnxBackend(model_file, [asked, "CPUExecutionProvider"])
    assert runtime.opened == [[told, "CPUExecutionProvider"]]


def test_a_provider_that_does_not_know_the_option_is_used_as_it_is(model_file: Path, monkeypatch) -> None:
    runtime = RuntimeWithProviders(knows_precision=False)
    monkeypatch.setattr(onnxruntime_backend, "_import_runtime", lambda: runtime)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        OnnxBackend(model_file, ["CUDAExecutionProvider"])
    assert runtime.opened == [[("CUDAExecutionProvider", {"use_tf32": "0"})], ["CUDAExecutionProvider"]]


@pytest.mark.parametrize(
    ("asked", "opened"),
    [
        (["OpenVINOExecutionProvider"], ["CPUExecutionProvider"]),
        ([("OpenVINOExecutionProvider", {"device_type": "CPU"}), "CPUExecutionProvider"], ["CPUExecutionProvider"]),
        (["OpenVINOExecutionProvider", "OtherProvider"], ["OtherProvider"]),
    ],
)
def test_a_provider_that_ends_the_process_is_never_started(model_file: Path, monkeypatch, asked, opened) -> None:
    runtime = RuntimeWithProviders()
    monkeypatch.setattr(onnxruntime_backend, "_import_runtime", lambda: runtime)
    with pytest.warns(RuntimeWarning, match="OpenVINOExecutionProvider does not run the network's loops"):
        OnnxBackend(model_file, asked)
    assert runtime.opened == [opened]
