"""MGCA-Net in torch: tensors in, tensors out. The runtime reaches it only through the torch backend."""

from .config import PRESETS, NetworkConfig
from .mgca_net import HeadOutput, MGCANet, NetworkOutput
from .weights import load_network, save_network, transfer_weights

__all__ = [
    "PRESETS",
    "HeadOutput",
    "MGCANet",
    "NetworkConfig",
    "NetworkOutput",
    "load_network",
    "save_network",
    "transfer_weights",
]
