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

from ..errors import MgcaFilterError
from ..scene_bundle import SceneBundle, load_scene_bundles
from .config import ConfigError, TrainingConfig, load_config
from .datasets import SceneBundleDataset
from .loop import DivergedError, Trainer
from .validation import quick_validation, select_pairs


def split_scenes(bundles: Sequence[SceneBundle], config: TrainingConfig) -> tuple[list[SceneBundle], list[SceneBundle]]:
    """Training and tuning bundles.

    Raises:
        ConfigError: a scene that the config names is not among the bundles, or no scene is left to train on.
    """
    names = {bundle.scene for bundle in bundles}
    for key, wanted in (("scenes", config.scenes), ("tuning_scenes", config.tuning_scenes)):
        missing = [scene for scene in wanted if scene not in names]
        if missing:
            raise ConfigError(f"{key}: not in the data folder: {', '.join(missing)}")
    chosen = names.intersection(config.scenes or names).difference(config.tuning_scenes)
    if not chosen:
        raise ConfigError("scenes: nothing is left to train on besides tuning_scenes")
    tuning = [bundle for bundle in bundles if bundle.scene in config.tuning_scenes]
    return [bundle for bundle in bundles if bundle.scene in chosen], tuning


def parse_arguments(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m mgca_filter.training", description="Train MGCA-Net.")
    parser.add_argument("--config", type=Path, required=True, help="TOML file, such as training/configs/small.toml")
    parser.add_argument("--data", type=Path, required=True, help="folder of scene bundles (.npz)")
    parser.add_argument("--run-dir", type=Path, required=True, help="run directory; a checkpoint in it is resumed")
    parser.add_argument("--init", type=Path, help="weights (.safetensors) to start from")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--workers", type=int, default=1, help="processes that prepare batches (0 = none)")
    parser.add_argument("--stop-after", type=int, help="stop after this many steps; resume by the same command")
    parser.add_argument("--validate-every", type=int, default=500, metavar="STEPS")
    parser.add_argument("--validate-pairs", type=int, default=12, metavar="N", help="pairs of each tuning scene")
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
        training, tuning = split_scenes(load_scene_bundles(options.data), config)
        dataset = SceneBundleDataset(
            training, config.sampling, config.augmentation, config.seed, config.schedule.steps, shard
        )
        validate = partial(quick_validation, pairs=select_pairs(tuning or training, options.validate_pairs))
        trainer = Trainer(
            config,
            dataset,
            options.run_dir,
            validate,
            options.validate_every,
            options.device,
            options.workers,
            options.init,
        )
        trainer.run(options.stop_after)
    except (ConfigError, MgcaFilterError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except DivergedError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
