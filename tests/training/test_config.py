"""Training configs: what a file says is what runs; what does not fit is named with file and key."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mgca_filter.network import PRESETS, NetworkConfig
from mgca_filter.training.augmentation import AugmentationConfig
from mgca_filter.training.config import (
    ConfigError,
    ScheduleConfig,
    SourceConfig,
    TrainingConfig,
    config_from_dict,
    load_config,
)
from mgca_filter.training.sampling import SamplingConfig

CONFIGS = Path(__file__).parents[2] / "mgca_filter" / "training" / "configs"


def write(folder: Path, text: str) -> Path:
    path = folder / "run.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_defaults_need_a_name_only(tmp_path):
    assert load_config(write(tmp_path, 'name = "x"')) == TrainingConfig(name="x")


def test_every_table_is_read(tmp_path):
    text = """
        name = "x"
        seed = 3
        tuning_scenes = ["hall"]
        validation = ["val.hdf5"]
        [[sources]]
        weight = 3
        [[sources]]
        kind = "rendered"
        path = "photos"
        labels = "epipolar"
        [network]
        preset = "paper"
        stages = 2
        [sampling]
        matches = [100, 200]
        matches_weights = [1, 0.5]
        [augmentation]
        tilt_deg = 5
        [schedule]
        steps = 10
        precision = "fp32"
    """
    config = load_config(write(tmp_path, text))
    assert config.seed == 3
    assert config.validation == ("val.hdf5",)
    assert config.sources == (SourceConfig(weight=3.0), SourceConfig("rendered", "photos", 1.0, "epipolar"))
    assert config_from_dict(json.loads(json.dumps(config.to_dict())), "again") == config
    assert config.tuning_scenes == ("hall",)
    assert config.network == NetworkConfig(**{**vars(PRESETS["paper"]), "stages": 2})
    assert config.sampling == SamplingConfig(matches=(100, 200), matches_weights=(1.0, 0.5))
    assert config.augmentation == AugmentationConfig(tilt_deg=5.0)
    assert config.schedule == ScheduleConfig(steps=10, precision="fp32")


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("seed = 1", "name"),
        ("name = 3", "name"),
        ('name = "x"\nsped = 1', "sped"),
        ('name = "x"\nseed = "1"', "seed"),
        ('name = "x"\nseed = true', "seed"),
        ('name = "x"\ntuning_scenes = "hall"', "tuning_scenes"),
        ('name = "x"\ntuning_scenes = [1]', "tuning_scenes"),
        ('name = "x"\nsampling = 3', "sampling"),
        ('name = "x"\nsources = 3', "sources"),
        ('name = "x"\nsources = []', "sources"),
        ('name = "x"\n[[sources]]\nkind = "foto"', r"sources\[0\].kind"),
        ('name = "x"\n[[sources]]\n[[sources]]\npaht = "a"', r"sources\[1\].paht: unknown key"),
        ('name = "x"\n[[sources]]\nweight = 0', r"sources\[0\]: weight"),
        ('name = "x"\n[[sources]]\nkind = "synthetic"\npath = "a"', r"sources\[0\]: path"),
        ('name = "x"\n[schedule]\nmilestones = [1]', "schedule: milestones"),
        ('name = "x"\n[schedule]\nsteps = 0', "schedule: steps"),
        ('name = "x"\nnetwork = 3', "network"),
        ('name = "x"\n[network]\nchanels = 8', "network.*chanels"),
        ('name = "x"\n[network]\nchannels = "8"', "network.*channels"),
        ('name = "x"\n[network]\nchannels = 8.0', "network.*channels"),
        ('name = "x"\n[network]\ncga = 1', "network.*cga"),
        ('name = "x"\n[network]\nchannels = 7', "network.*channels"),
        ('name = "x"\n[network]\npreset = "huge"', "network.*huge"),
        ('name = "x"\n[network]\nattention = "both"', "network.*attention"),
        ('name = "x"\n[sampling]\nbatch = 8', "sampling.batch"),
        ('name = "x"\n[sampling]\nbatch_size = 1.5', "sampling.batch_size"),
        ('name = "x"\n[sampling]\nbatch_size = 0', "sampling.*batch_size"),
        ('name = "x"\n[sampling]\nmatches = [1, "2"]', "sampling.matches"),
        ('name = "x"\n[sampling]\nmatches = [100]', "sampling.*matches_weights"),
        ('name = "x"\n[sampling]\nbare = -1', "sampling.*bare"),
        ('name = "x"\n[augmentation]\ntilt = 1', "augmentation.tilt"),
        ('name = "x"\n[augmentation]\nturn = "often"', "augmentation.turn"),
        ('name = "x"\n[schedule]\nsteps = 1.5', "schedule.steps"),
        ('name = "x"\n[schedule]\nprecision = "fp16"', "schedule.precision"),
        ("name = ", "[Ii]nvalid"),
        # What is asked for is named as well, in the file's own words.
        ('name = "x"\nseed = 1.0', "seed: expected int, got 1.0$"),
        ('name = "x"\n[sampling]\nbatch_size = true', "sampling.batch_size: expected int, got True$"),
        ('name = "x"\n[augmentation]\nturn = true', "augmentation.turn: expected float, got True$"),
        ('name = "x"\n[sampling]\nmatches = [1, true]', "sampling.matches.*: expected int, got True$"),
        ('name = "x"\n[sampling]\nmatches = 3', r"sampling.matches: expected a list of int, got 3$"),
        ('name = "x"\nscenes = "hall"', r"scenes: expected a list of str, got 'hall'$"),
        ('name = "x"\n[schedule]\nkind = "line"', "schedule.kind: expected one of cosine, steps, got 'line'$"),
        ('name = "x"\n[sampling]\nb = 1\na = 2', "sampling.a: unknown key$"),
        ('name = "x"\nsources = ["a"]', r"sources\[0\]: expected a table, got 'a'$"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, text, key):
    with pytest.raises(ConfigError, match=rf"run\.toml: .*{key}"):
        load_config(write(tmp_path, text))


def test_missing_and_binary_files_are_named(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.toml"):
        load_config(tmp_path / "none.toml")
    path = tmp_path / "picture.toml"
    path.write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(ConfigError, match=r"picture\.toml"):
        load_config(path)


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_configs_are_valid(path):
    config = load_config(path)
    assert config.scenes or config.tuning_scenes or config.validation
    assert not set(config.scenes) & set(config.tuning_scenes)
    assert config.schedule.steps > config.schedule.warmup_steps
