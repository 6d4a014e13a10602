"""The training loop: one step is one batch; what happens beside it happens on a schedule of steps."""

from __future__ import annotations

import time
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader
from tqdm import tqdm

from ..atomic_file import replaced_when_done
from ..network import MGCANet, load_network, save_network, transfer_weights
from .checkpoint import restore_checkpoint, save_checkpoint
from .config import ScheduleConfig, TrainingConfig
from .datasets import TrainingDataset
from .loss import balanced_cross_entropy, network_loss, precision_recall
from .run_directory import RunDirectory
from .schedule import LossWatch, learning_rate

LOG_EVERY = 20
SAVE_EVERY = 200
CHECKPOINT, WEIGHTS = "checkpoint.pt", "weights.safetensors"

Validation = Callable[[MGCANet], dict[str, float]]


class DivergedError(RuntimeError):
    """The loss is no longer a number, or grows; the batch that did it was saved."""


class Trainer:
    """One run in one directory: ``checkpoint.pt``, ``weights.safetensors`` (the averaged weights after the last save),
    and what :class:`RunDirectory` writes.

    Args:
        config: the run.
        dataset: batches by step.
        folder: run directory; a checkpoint in it is resumed.
        validate: figures of a network in per cent, every ``validate_every`` steps and at the end; None = never.
        device: torch device.
        workers: processes that prepare batches; 0 prepares them in this one.
        initial_weights: weights to start from, of a network of equal width.
    """

    def __init__(
        self,
        config: TrainingConfig,
        dataset: TrainingDataset,
        folder: Path,
        validate: Validation | None,
        validate_every: int = 500,
        device: str = "cpu",
        workers: int = 1,
        initial_weights: Path | None = None,
    ) -> None:
        self.config, self.dataset, self.folder = config, dataset, folder
        self.validate, self.validate_every = validate, validate_every
        self.device, self.workers = torch.device(device), workers
        torch.manual_seed(config.seed)
        self.network = MGCANet(config.network)
        if initial_weights is not None:
            transfer_weights(load_network(initial_weights), self.network)
        self.network.to(self.device)
        # Started by torchrun, each process holds a share of the batch and gradients are averaged.
        self.model = DistributedDataParallel(self.network) if dist.is_initialized() else self.network
        self.is_main = not dist.is_initialized() or dist.get_rank() == 0
        self.average = deepcopy(self.network).requires_grad_(False)
        self.optimizer = _optimizer(self.network, config.schedule)
        folder.mkdir(parents=True, exist_ok=True)
        self.step = 0
        self.watch = LossWatch()
        if (folder / CHECKPOINT).is_file():
            self.step = restore_checkpoint(
                folder / CHECKPOINT, config, self.network, self.average, self.optimizer, self.watch
            )
        self.directory = RunDirectory(folder, config, self.step) if self.is_main else None

    def run(self, stop_after: int | None = None) -> None:
        """Train to the end of the schedule, or for ``stop_after`` steps."""
        last = self.config.schedule.steps
        if stop_after is not None:
            last = min(last, self.step + stop_after)
        loader = DataLoader(
            self.dataset,
            batch_sampler=self.dataset.pools(self.step, last),
            collate_fn=list,
            num_workers=self.workers,
            prefetch_factor=2 if self.workers else None,
        )
        total = self.config.schedule.steps
        with tqdm(total=total, initial=self.step, unit="step", smoothing=0.05, disable=not self.is_main) as progress:
            clock = time.perf_counter()
            for pool in loader:
                for batch in pool:
                    figures = self._train_step({name: tensor.to(self.device) for name, tensor in batch.items()})
                    self.step += 1
                    progress.update()
                    if self.step % LOG_EVERY == 0:
                        seconds, clock = time.perf_counter() - clock, time.perf_counter()
                        self._log(figures, seconds, progress)
                    if self.step % self.validate_every == 0 or self.step == total:
                        self._validate()
                    if self.step % SAVE_EVERY == 0 or self.step == last:
                        self.save()
        if self.directory is not None:
            self.directory.close()

    def save(self) -> None:
        """Write checkpoint and averaged weights; a crash in the middle leaves the previous files whole."""
        if not self.is_main:
            return
        save_checkpoint(
            self.folder / CHECKPOINT, self.config, self.step, self.network, self.average, self.optimizer, self.watch
        )
        with replaced_when_done(self.folder / WEIGHTS) as temporary:
            save_network(self.average, temporary, {"name": self.config.name, "steps": str(self.step)})

    def _log(self, figures: dict[str, float], seconds: float, progress: tqdm[None]) -> None:
        """Write a row, and say beside the bar how the run goes."""
        if self.directory is None:
            return
        speed = LOG_EVERY * self.config.sampling.batch_size / seconds
        self.directory.log(self.step, {**figures, "samples_per_s": speed})
        progress.set_postfix_str(f"loss {figures['loss']:.3f}, recall {figures['recall']:.2f}, {speed:.0f} samples/s")

    def _validate(self) -> None:
        if self.directory is not None and self.validate is not None:
            self.directory.add_validation(self.step, self.validate(self.average))

    def _train_step(self, batch: dict[str, Tensor]) -> dict[str, float]:
        schedule = self.config.schedule
        rate = learning_rate(schedule, self.step)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        if not torch.isfinite(batch["correspondences"]).all():  # one NaN would poison the running statistics
            self._stop(batch, "the input holds NaN")
        begun = self.step >= schedule.geometric_from * schedule.steps
        weights = (schedule.geometric_weight, schedule.refined_weight) if begun else (0.0, 0.0)
        self.network.train()
        with torch.autocast(self.device.type, torch.bfloat16, enabled=schedule.precision == "bf16"):
            output = self.model(batch["correspondences"], batch["attributes"])
        loss, parts = network_loss(output, batch, *weights)
        if self.network.prior is not None:
            prior = self.network.prior(batch["prior_attributes"])
            loss = loss + schedule.prior_weight * balanced_cross_entropy(prior, batch["prior_labels"])
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), schedule.clip_norm)
        if not (torch.isfinite(loss) and torch.isfinite(norm)):
            self._stop(batch, "loss or gradient is not finite")
        if self.watch.diverges(float(loss.detach()), schedule.divergence_factor):
            self._stop(batch, f"the loss has grown to {self.watch.average:.3f} from {self.watch.lowest:.3f}")
        self.optimizer.step()
        self._update_average()
        if (self.step + 1) % LOG_EVERY:
            return {}
        precision, recall = precision_recall(output.logits, batch["labels"])
        figures = {"loss": loss.detach(), **parts, "precision": precision, "recall": recall, "gradient_norm": norm}
        return {name: float(value) for name, value in figures.items()} | {"learning_rate": rate}

    @torch.no_grad()
    def _update_average(self) -> None:
        decay = min(self.config.schedule.ema_decay, (1.0 + self.step) / (10.0 + self.step))
        for mine, new in zip(self.average.state_dict().values(), self.network.state_dict().values(), strict=True):
            if mine.dtype.is_floating_point:
                mine.lerp_(new, 1.0 - decay)
            else:
                mine.copy_(new)

    def _stop(self, batch: dict[str, Tensor], reason: str) -> None:
        rank = dist.get_rank() if dist.is_initialized() else 0
        path = self.folder / f"diverged_{self.step}_{rank}.pt"
        torch.save({name: tensor.cpu() for name, tensor in batch.items()}, path)
        raise DivergedError(f"step {self.step}: {reason}; the batch lies in {path}")


def _optimizer(network: nn.Module, schedule: ScheduleConfig) -> torch.optim.Optimizer:
    matrices = [p for p in network.parameters() if p.dim() > 1]
    vectors = [p for p in network.parameters() if p.dim() <= 1]
    groups = [{"params": matrices, "weight_decay": schedule.weight_decay}, {"params": vectors, "weight_decay": 0.0}]
    return torch.optim.AdamW(groups, lr=schedule.learning_rate)
