"""Training of MGCA-Net on real scenes: ``python -m mgca_filter.training --config FILE``."""
