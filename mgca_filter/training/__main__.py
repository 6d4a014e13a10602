"""``python -m mgca_filter.training --config FILE --data FOLDER --run-dir FOLDER``

Several GPUs, or a CPU whose cores idle on matrices this small:
``torchrun --nproc-per-node 2 -m mgca_filter.training …`` (one thread each: ``OMP_NUM_THREADS=1``).
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
import torch.distributed as dist

from ..data import open_sources as open_pair_sources
from ..data.scene_bundle import ScenePair
from ..errors import MgcaFilterError
from ..network import MGCANet
from .config import ConfigError, TrainingConfig, load_config
from .datasets import TrainingDataset
from .loop import DivergedError, Trainer
from .sources import OpenedSources, open_sources
from .validation import held_out_pairs, quick_validation, select_pairs

OANET_SUFFIXES = (".hdf5", ".h5")


def validation_pairs(config: TrainingConfig, opened: OpenedSources, data: Path, per_scene: int) -> list[ScenePair]:
    """Pairs of the tuning scenes and of the config's validation files; of training scenes where there are neither."""
    pairs = select_pairs(opened.tuning, per_scene)
    for name in config.validation:
        data_format = "oanet" if Path(name).suffix in OANET_SUFFIXES else "bundle"
        pairs += select_pairs(open_pair_sources([data / name], data_format), per_scene)
    return pairs or select_pairs(opened.training, per_scene)


def validate(network: MGCANet, unknown: Sequence[ScenePair], known: Sequence[ScenePair]) -> dict[str, float]:
    """Figures on scenes that training never saw, and, as ``known_…``, on held-out pairs of those that it did."""
    figures = quick_validation(network, unknown)
    if known:
        figures |= {f"known_{name}": value for name, value in quick_validation(network, known).items()}
    return figures


def parse_arguments(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m mgca_filter.training", description="Train MGCA-Net.")
    parser.add_argument("--config", type=Path, required=True, help="TOML file, such as training/configs/small.toml")
    parser.add_argument(
        "--data",
        type=Path,
        required=True,
        help="folder that the config's sources lie in; scene bundles (.npz) where it names none",
    )
    parser.add_argument("--run-dir", type=Path, required=True, help="run directory; a checkpoint in it is resumed")
    parser.add_argument("--init", type=Path, help="weights (.safetensors) to start from")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--workers", type=int, default=1, help="processes that prepare batches (0 = none)")
    parser.add_argument("--stop-after", type=int, help="stop after this many steps; resume by the same command")
    parser.add_argument("--validate-every", type=int, default=500, metavar="STEPS")
    parser.add_argument("--validate-pairs", type=int, default=12, metavar="N", help="pairs of each tuning scene")
    parser.add_argument("--validate-known", type=int, default=0, metavar="N", help="held-out pairs of training scenes")
    return parser.parse_args(arguments)


def _join_processes(options: argparse.Namespace) -> tuple[int, int]:
    """Rank and number of processes; under torchrun, join them and take this process's GPU."""
    if "WORLD_SIZE" not in os.environ:
        return 0, 1
    if options.device == "cuda":
        options.device = f"cuda:{os.environ['LOCAL_RANK']}"
        torch.cuda.set_device(options.device)
    dist.init_process_group("nccl" if options.device.startswith("cuda") else "gloo")
    return dist.get_rank(), dist.get_world_size()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 1 = diverged, 2 = config or data cannot be used."""
    options = parse_arguments(arguments)
    shard = _join_processes(options)
    try:
        config = load_config(options.config)
        if config.sampling.batch_size % shard[1]:
            raise ConfigError(
                f"{options.config}: sampling.batch_size: {config.sampling.batch_size} pairs do not divide among "
                f"{shard[1]} processes"
            )
        opened = open_sources(config, options.data)
        pairs = validation_pairs(config, opened, options.data, options.validate_pairs)
        known = held_out_pairs(opened.training, config.sampling.holdout_every, options.validate_known)
        dataset = TrainingDataset(
            opened.source, config.sampling, config.augmentation, config.seed, config.schedule.steps, shard
        )
        trainer = Trainer(
            config,
            dataset,
            options.run_dir,
            partial(validate, unknown=pairs, known=known) if pairs else None,
            options.validate_every,
            options.device,
            options.workers,
            options.init,
        )
        trainer.run(options.stop_after)
    except (ConfigError, MgcaFilterError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except DivergedError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
