"""A config that trains a tiny network in seconds; [schedule] is last, so that a test may add to it."""

CONFIG_TOML = """
name = "tiny"
tuning_scenes = ["yard"]
[network]
channels = 8
stages = 2
clusters = 8
[sampling]
batch_size = 2
matches = [32]
matches_weights = [1.0]
pool_batches = 1
[schedule]
precision = "fp32"
"""
