"""The training loop on a tiny bundle: bit-for-bit repeatable, resumable, and stopped by NaN."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import make_scene
from networks import TINY, tiny_network
from scene_bundles import write_bundle
from tiny_config import CONFIG_TOML

from mgca_filter.data.scene_bundle import SceneBundle
from mgca_filter.network import MGCANet, load_network, save_network
from mgca_filter.network.weights import read_metadata
from mgca_filter.training import loop, run_directory, schedule
from mgca_filter.training.__main__ import main
from mgca_filter.training.config import ConfigError, ScheduleConfig, TrainingConfig, load_config
from mgca_filter.training.datasets import TrainingDataset
from mgca_filter.training.loop import CHECKPOINT, DivergedError, Trainer
from mgca_filter.training.run_directory import LOG, VALIDATION
from mgca_filter.training.sampling import SamplingConfig
from mgca_filter.training.schedule import LossWatch, learning_rate
from mgca_filter.training.sources import BundleSource
from mgca_filter.training.validation import quick_validation, select_pairs

STEPS = 6
NETWORK = dataclasses.replace(TINY, stages=1)
CONFIG = TrainingConfig(
    name="tiny",
    seed=5,
    network=NETWORK,
    sampling=SamplingConfig(batch_size=2, matches=(32,), matches_weights=(1.0,), holdout_every=0, pool_batches=2),
    schedule=ScheduleConfig(steps=STEPS, warmup_steps=2, geometric_from=0.5, precision="fp32"),
)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> SceneBundle:
    path = tmp_path_factory.mktemp("data") / "hall.npz"
    return SceneBundle(write_bundle(path, [make_scene(seed=seed, right=60, wrong=40) for seed in range(3)]))


@pytest.fixture(autouse=True)
def _log_every_second_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "LOG_EVERY", 2)
    monkeypatch.setattr(loop, "SAVE_EVERY", 2)
    monkeypatch.setattr(run_directory, "draw_curves", lambda *arguments: None)  # slow; whole_run has them


def fingerprint(network: MGCANet) -> dict[str, float]:
    return {"weights": sum(float(parameter.double().abs().sum()) for parameter in network.parameters())}


def trainer(bundle: SceneBundle, folder: Path, config: TrainingConfig = CONFIG, weights: Path | None = None) -> Trainer:
    source = BundleSource([bundle])
    dataset = TrainingDataset(source, config.sampling, config.augmentation, config.seed, config.schedule.steps)
    return Trainer(config, dataset, folder, fingerprint, 3, "cpu", 0, weights)


def rows(path: Path) -> list[dict[str, str]]:
    """Rows of a log without the measured speed."""
    with open(path, newline="") as file:
        return [{k: v for k, v in row.items() if k != "samples_per_s"} for row in csv.DictReader(file)]


def assert_same_run(folder: Path, other: Path) -> None:
    for name in (LOG, VALIDATION):
        assert rows(folder / name) == rows(other / name)
    states = [torch.load(run / CHECKPOINT, weights_only=True) for run in (folder, other)]
    assert states[0]["step"] == states[1]["step"] == STEPS
    for part in ("network", "average"):
        assert list(states[0][part]) == list(states[1][part])
        for name, tensor in states[0][part].items():
            assert torch.equal(tensor, states[1][part][name]), name
    for one, two in zip(*(state["optimizer"]["state"].values() for state in states), strict=True):
        assert all(torch.equal(one[name], two[name]) for name in one)
    assert read_metadata(folder / loop.WEIGHTS) == read_metadata(other / loop.WEIGHTS)


@pytest.fixture(scope="module")
def whole_run(bundle: SceneBundle, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run from beginning to end."""
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "LOG_EVERY", 2)
        patch.setattr(loop, "SAVE_EVERY", 2)
        trainer(bundle, folder).run()
    return folder


def test_the_run_directory_holds_logs_and_weights(whole_run):
    assert [row["step"] for row in rows(whole_run / LOG)] == ["2", "4", "6"]
    assert [row["step"] for row in rows(whole_run / VALIDATION)] == ["3", "6"]
    assert all(np.isfinite(float(value)) for row in rows(whole_run / LOG) for value in row.values())
    network = load_network(whole_run / loop.WEIGHTS)
    assert network.config == NETWORK
    average = torch.load(whole_run / CHECKPOINT, weights_only=True)["average"]
    assert all(torch.equal(tensor, average[name]) for name, tensor in network.state_dict().items())


def test_training_moves_the_weights(bundle, whole_run, tmp_path):
    start = trainer(bundle, tmp_path).network.state_dict()
    end = torch.load(whole_run / CHECKPOINT, weights_only=True)["network"]
    moved = [name for name, tensor in start.items() if not torch.equal(tensor, end[name])]
    assert len(moved) > 0.9 * len(start)


def test_two_runs_are_equal_bit_for_bit(bundle, whole_run, tmp_path):
    trainer(bundle, tmp_path).run()
    assert_same_run(whole_run, tmp_path)


@pytest.mark.parametrize("pieces", [[4], [1, 2]])
def test_a_resumed_run_equals_the_uninterrupted_one(bundle, whole_run, tmp_path, pieces):
    for steps in pieces:
        trainer(bundle, tmp_path).run(stop_after=steps)
    torch.manual_seed(999)  # whatever else the process did
    last = trainer(bundle, tmp_path)
    assert last.step == sum(pieces)
    last.run()
    assert_same_run(whole_run, tmp_path)


def test_a_killed_run_goes_on_from_its_checkpoint(bundle, whole_run, tmp_path, monkeypatch):
    original = Trainer._train_step

    def killed(self: Trainer, batch: dict[str, torch.Tensor]) -> dict[str, float]:
        if self.step == 3:
            raise KeyboardInterrupt
        return original(self, batch)

    monkeypatch.setattr(Trainer, "_train_step", killed)
    with pytest.raises(KeyboardInterrupt):
        trainer(bundle, tmp_path).run()
    monkeypatch.setattr(Trainer, "_train_step", original)
    with open(tmp_path / LOG, "a") as file:  # logged after the checkpoint, the last row torn
        file.write("4," + ",".join("9" * (len(rows(tmp_path / LOG)[0]))) + "\n5,0.1")
    (tmp_path / "checkpoint.partial").write_bytes(b"torn")
    again = trainer(bundle, tmp_path)
    assert again.step == 2
    again.run()
    assert_same_run(whole_run, tmp_path)


def test_a_finished_run_does_nothing_more(bundle, whole_run, tmp_path):
    again = shutil.copytree(whole_run, tmp_path / "again")
    trainer(bundle, again).run()
    assert_same_run(whole_run, again)


def poisoned(bundle: SceneBundle, field: str) -> TrainingDataset:
    class Poisoned(TrainingDataset):
        def __getitem__(self, step: int) -> dict[str, torch.Tensor]:
            batch = super().__getitem__(step)
            if step == 3:
                batch[field][0, 0, 0] = float("nan")
            return batch

    return Poisoned(BundleSource([bundle]), CONFIG.sampling, CONFIG.augmentation, CONFIG.seed, STEPS)


@pytest.mark.parametrize("field", ["correspondences", "attributes"])
def test_nan_stops_the_run_and_keeps_the_batch(bundle, whole_run, tmp_path, field):
    run = Trainer(CONFIG, poisoned(bundle, field), tmp_path, fingerprint, 3, "cpu", 0)
    with pytest.raises(DivergedError, match="step 3"):
        run.run()
    (saved,) = tmp_path.glob("diverged_3*.pt")
    batch = torch.load(saved, weights_only=True)
    assert torch.isnan(batch[field][0, 0, 0])
    state = torch.load(tmp_path / CHECKPOINT, weights_only=True)
    assert state["step"] == 2
    assert all(torch.isfinite(tensor).all() for tensor in state["network"].values())
    trainer(bundle, tmp_path).run()  # with the data mended, the run goes on as if nothing had been
    assert_same_run(whole_run, tmp_path)


@pytest.mark.parametrize(
    "changed",
    [
        dataclasses.replace(CONFIG, seed=6),
        dataclasses.replace(CONFIG, schedule=dataclasses.replace(CONFIG.schedule, learning_rate=1e-3)),
        dataclasses.replace(CONFIG, network=dataclasses.replace(NETWORK, channels=16)),
    ],
)
def test_checkpoints_of_another_config_are_refused(bundle, tmp_path, changed):
    trainer(bundle, tmp_path).run(stop_after=1)
    with pytest.raises(ConfigError, match=r"checkpoint\.pt"):
        trainer(bundle, tmp_path, changed)


def test_a_run_may_start_from_weights(bundle, tmp_path):
    start = tiny_network(NETWORK, seed=8)
    save_network(start, tmp_path / "start.safetensors")
    run = trainer(bundle, tmp_path / "run", weights=tmp_path / "start.safetensors")
    for network in (run.network, run.average):
        for mine, given in zip(network.state_dict().values(), start.state_dict().values(), strict=True):
            assert torch.equal(mine, given)


def test_options_newer_than_a_checkpoint_count_as_defaults(bundle, tmp_path):
    trainer(bundle, tmp_path).run(stop_after=1)
    state = torch.load(tmp_path / CHECKPOINT, weights_only=True)
    values = json.loads(state["config"])
    del values["validation"], values["sources"], values["schedule"]["divergence_factor"]
    torch.save({**state, "config": json.dumps(values)}, tmp_path / CHECKPOINT)
    assert trainer(bundle, tmp_path).step == 1
    values["schedule"]["clip_norm"] = 9.0
    torch.save({**state, "config": json.dumps(values)}, tmp_path / CHECKPOINT)
    with pytest.raises(ConfigError, match=r"schedule\.clip_norm"):
        trainer(bundle, tmp_path)


def test_weights_are_written_whole_or_not_at_all(bundle, tmp_path, monkeypatch):
    trainer(bundle, tmp_path).run(stop_after=2)
    before = (tmp_path / loop.WEIGHTS).read_bytes()

    def torn(network: MGCANet, path: Path, metadata: dict[str, str]) -> None:
        path.write_bytes(b"torn")
        raise OSError("disk full")

    monkeypatch.setattr(loop, "save_network", torn)
    with pytest.raises(OSError, match="disk full"):
        trainer(bundle, tmp_path).run()
    assert (tmp_path / loop.WEIGHTS).read_bytes() == before


def test_the_run_directory_tells_where_the_run_came_from(whole_run):
    (origin,) = json.loads((whole_run / "origin.json").read_text())
    assert origin["from_step"] == 0
    assert origin["packages"]["torch"] == torch.__version__
    assert set(origin) == {"from_step", "commit", "command", "packages", "machine"}
    assert (whole_run / "validation.md").read_text().splitlines()[0] == "| step | weights |"


def test_curves_are_drawn(whole_run):
    cv2 = pytest.importorskip("cv2")
    pytest.importorskip("matplotlib")
    assert cv2.imread(str(whole_run / "curves.png")).shape[1] > 500


def test_tensorboard_gets_the_same_figures(whole_run):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = accumulator.EventAccumulator(str(whole_run / "tensorboard"))
    events.Reload()
    found = [(event.step, event.value) for event in events.Scalars("train/loss")]
    expected = [(int(row["step"]), float(row["loss"])) for row in rows(whole_run / LOG)]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_a_growing_loss_is_seen_and_a_noisy_one_is_not():
    rng = np.random.default_rng(0)
    noisy = 2.0 * np.exp(rng.normal(0.0, 0.4, 2000)) + np.linspace(1, 0, 2000)
    watch = LossWatch()
    assert not any(watch.diverges(float(loss), 3.0) for loss in noisy)
    assert not any(dataclasses.replace(watch).diverges(100.0, 0.0) for _ in range(300))
    assert any(watch.diverges(20.0, 3.0) for _ in range(60))


def test_a_diverging_run_stops_and_keeps_the_batch(bundle, tmp_path, monkeypatch):
    monkeypatch.setattr(schedule, "SETTLED", 1)
    growing = dataclasses.replace(CONFIG, schedule=dataclasses.replace(CONFIG.schedule, divergence_factor=1e-3))
    with pytest.raises(DivergedError, match="step 0.*grown"):
        trainer(bundle, tmp_path, growing).run()
    assert torch.load(tmp_path / "diverged_0_0.pt", weights_only=True)["labels"].shape == (2, 32)


def test_learning_rate_falls_in_steps():
    config = ScheduleConfig(
        kind="steps", steps=100, warmup_steps=10, learning_rate=1.0, milestones=(40, 80), factor=0.4
    )
    rates = [learning_rate(config, step) for step in (0, 9, 10, 39, 40, 79, 80, 99)]
    np.testing.assert_allclose(rates, [0.1, 1.0, 1.0, 1.0, 0.4, 0.4, 0.16, 0.16])


def test_learning_rate_warms_up_and_falls_to_its_fraction():
    config = ScheduleConfig(steps=110, warmup_steps=10, learning_rate=1e-3, final_fraction=0.1)
    rates = [learning_rate(config, step) for step in range(111)]
    np.testing.assert_allclose(rates[:10], np.arange(1, 11) * 1e-4)
    np.testing.assert_allclose([rates[10], rates[60], rates[110]], [1e-3, 0.55e-3, 1e-4])
    assert (np.diff(rates[10:]) < 0).all()


def test_norms_and_biases_have_no_weight_decay(bundle, tmp_path):
    decayed, free = trainer(bundle, tmp_path).optimizer.param_groups
    assert decayed["weight_decay"] == CONFIG.schedule.weight_decay
    assert free["weight_decay"] == 0.0
    assert all(parameter.dim() > 1 for parameter in decayed["params"])
    assert all(parameter.dim() <= 1 for parameter in free["params"])


def test_the_average_follows_the_weights(bundle, tmp_path):
    run = trainer(bundle, tmp_path)
    before = {name: tensor.clone() for name, tensor in run.average.state_dict().items()}
    run.run(stop_after=1)
    name = "heads.0.logit.weight"
    expected = 0.1 * before[name] + 0.9 * run.network.state_dict()[name]  # the first step's decay is 1 / 10
    torch.testing.assert_close(run.average.state_dict()[name], expected)


def test_bf16_runs_on_the_cpu(bundle, tmp_path):
    config = dataclasses.replace(CONFIG, schedule=dataclasses.replace(CONFIG.schedule, precision="bf16"))
    trainer(bundle, tmp_path, config).run(stop_after=2)
    (row,) = rows(tmp_path / LOG)
    assert np.isfinite(float(row["loss"]))


def test_quick_validation_gives_percentages(bundle):
    pairs = select_pairs([bundle], 2)
    assert [pair.index for pair in pairs] == [0, 2]
    figures = quick_validation(tiny_network(), pairs)
    poses = {f"{name}_{figure}" for name in ("fit", "essential") for figure in ("mAP@5", "mAP@20", "AUC@5")}
    assert set(figures) == {"precision", "recall", "F"} | poses
    assert all(0.0 <= value <= 100.0 for value in figures.values())


TWO_STEPS_TOML = CONFIG_TOML + "steps = 2\nwarmup_steps = 1\n"


def test_the_command_trains_and_resumes(tmp_path, capsys):
    data = tmp_path / "data"
    data.mkdir()
    for seed, name in enumerate(("hall", "yard")):
        write_bundle(data / f"{name}.npz", [make_scene(seed=seed, right=60, wrong=40)])
    (tmp_path / "run.toml").write_text(TWO_STEPS_TOML)
    command = ["--config", str(tmp_path / "run.toml"), "--data", str(data), "--run", str(tmp_path / "run")]
    command += ["--device", "cpu", "--workers", "0", "--validate-pairs", "1"]
    assert main([*command, "--stop-after", "1"]) == 0
    assert not (tmp_path / "run" / VALIDATION).exists()
    assert main(command) == 0
    assert [row["step"] for row in rows(tmp_path / "run" / VALIDATION)] == ["2"]
    assert load_network(tmp_path / "run" / loop.WEIGHTS).config == TINY

    (data / "yard.npz").unlink()
    assert main(command) == 2
    assert "tuning_scenes: not in the data folder: yard" in capsys.readouterr().err
    (data / "yard.npz").write_bytes(b"torn")
    assert main(command) == 2
    assert "yard.npz" in capsys.readouterr().err


def command_line(folder: Path, run: str, steps: int, workers: int = 0) -> list[str]:
    """Arguments of a short run on two scenes, one of them for tuning, written below ``folder``."""
    data = folder / "data"
    if not data.is_dir():
        data.mkdir()
        for seed, name in enumerate(("hall", "yard")):
            write_bundle(data / f"{name}.npz", [make_scene(seed=seed, right=60, wrong=40)])
    (folder / "run.toml").write_text(TWO_STEPS_TOML.replace("steps = 2\n", f"steps = {steps}\n", 1))
    arguments = ["--config", str(folder / "run.toml"), "--data", str(data), "--run-dir", str(folder / run)]
    return [
        *arguments,
        "--device",
        "cpu",
        "--workers",
        str(workers),
        "--validate-every",
        "1000",
        "--validate-pairs",
        "1",
    ]


PROGRAM = """
import sys
from mgca_filter.training import loop, run_directory
from mgca_filter.training.__main__ import main
loop.LOG_EVERY, loop.SAVE_EVERY = 1, 3
run_directory.draw_curves = lambda *arguments: None
if __name__ == "__main__":
    sys.exit(main())
"""


def program(folder: Path) -> str:
    """A file that runs the training command with rows and checkpoints every few steps."""
    (folder / "train.py").write_text(PROGRAM)
    return str(folder / "train.py")


def environment() -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}


def weights_of(run: Path) -> dict[str, torch.Tensor]:
    """Weights and averaged weights of a run's checkpoint."""
    state = torch.load(run / CHECKPOINT, weights_only=True)
    return {f"{part}.{name}": tensor for part in ("network", "average") for name, tensor in state[part].items()}


def assert_same_weights(run: Path, other: Path) -> None:
    one, two = weights_of(run), weights_of(other)
    assert list(one) == list(two)
    assert all(torch.equal(tensor, two[name]) for name, tensor in one.items())


@pytest.mark.slow
def test_a_process_killed_at_any_step_resumes_to_the_same_weights(tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "LOG_EVERY", 1)
    arguments = command_line(tmp_path, "killed", 12, workers=1)
    command = [sys.executable, program(tmp_path), *arguments]
    log = tmp_path / "killed" / LOG
    last_row = int(np.random.default_rng().integers(1, 9))
    with subprocess.Popen(command, env=environment(), stderr=subprocess.DEVNULL) as process:
        while process.poll() is None and (not log.is_file() or len(log.read_text().splitlines()) <= last_row):
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    assert len(rows(log)) < 12
    assert main(arguments) == 0
    assert main(command_line(tmp_path, "whole", 12)) == 0
    assert_same_weights(tmp_path / "killed", tmp_path / "whole")
    assert rows(log) == rows(tmp_path / "whole" / LOG)


@pytest.mark.slow
def test_two_processes_share_a_run_and_resume_it(tmp_path):
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node"]

    def train(processes: int, run: str, *more: str) -> subprocess.CompletedProcess[str]:
        command = [*launch, str(processes), program(tmp_path), *command_line(tmp_path, run, 6), *more]
        return subprocess.run(command, env=environment(), capture_output=True, text=True)

    assert train(2, "whole").returncode == 0
    assert train(2, "cut", "--stop-after", "3").returncode == 0
    assert train(2, "cut").returncode == 0
    assert_same_weights(tmp_path / "whole", tmp_path / "cut")
    assert [row["step"] for row in rows(tmp_path / "whole" / LOG)] == list("123456")  # one process writes
    start = trainer_start(tmp_path)
    assert not torch.equal(
        weights_of(tmp_path / "whole")["network.heads.0.logit.weight"], start["heads.0.logit.weight"]
    )
    odd = train(3, "odd")
    assert odd.returncode != 0
    assert "sampling.batch_size: 2 pairs do not divide among 3 processes" in odd.stderr


def trainer_start(folder: Path) -> dict[str, torch.Tensor]:
    """Weights that the runs of :func:`command_line` start from."""
    torch.manual_seed(TrainingConfig("x").seed)
    return MGCANet(load_config(folder / "run.toml").network).state_dict()


def test_known_scenes_are_validated_beside_unknown_ones(tmp_path):
    write_bundle(tmp_path / "x.npz", [make_scene(seed=0)])
    arguments = command_line(tmp_path, "run", 2)
    write_bundle(tmp_path / "data" / "hall.npz", [make_scene(seed=seed, right=60, wrong=40) for seed in range(3)])
    text = (tmp_path / "run.toml").read_text().replace("[sampling]", "[sampling]\nholdout_every = 3")
    (tmp_path / "run.toml").write_text(text)
    assert main([*arguments, "--validate-known", "2"]) == 0
    (row,) = rows(tmp_path / "run" / VALIDATION)
    assert {"recall", "known_recall", "fit_AUC@5", "known_fit_AUC@5"} <= set(row)
