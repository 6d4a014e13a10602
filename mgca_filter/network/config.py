"""The one description of a network: what is built, trained, exported and written into model files."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from typing import Literal

ATTRIBUTE_CHANNELS = 8


@dataclass(frozen=True)
class NetworkConfig:
    """Size and switches of an MGCA-Net; frozen, because weights fit one config only.

    Attributes:
        channels: width C of every feature map; a multiple of 4.
        clusters: nodes of the order-aware block.
        stages: iterations of the network, each with its own weights (the paper's "Iter" switch).
        neighbours: k of the graph block, a multiple of 3 (annular convolution eats three at a time).
        graph_expansion: width of the graph block's branches in multiples of C; 2 in the published code.
        attention: CPA as in the published code ("channel", C x C, linear in N) or the text ("point", N x N).
        positional: the positional term of CPA.
        cga: context graph attention; replaced by the identity when False (the paper's ablation).
        csmgc: cross-stage multi-graph consensus between stages (the paper's ablation).
        final_consensus: consensus over the outputs of all stages, whose heads give the answer.
        pooled_branches: the average- and max-pooled branches of MB-FFN.
        squeeze_excitation: channel gates of the consensus blocks.
        refined_feedback: the third stage sees the residuals of the second stage's essential matrix refined on its
            manifold, and sees them finer; the paper has the eight-point algorithm's.
        attributes: side information of the matches as input and as a prior on the logits.
    """

    channels: int = 64
    clusters: int = 128
    stages: int = 3
    neighbours: int = 6
    graph_expansion: int = 1
    attention: Literal["channel", "point"] = "channel"
    positional: bool = True
    cga: bool = True
    csmgc: bool = True
    final_consensus: bool = True
    pooled_branches: bool = True
    squeeze_excitation: bool = True
    refined_feedback: bool = False
    attributes: bool = True

    def __post_init__(self) -> None:
        if self.channels < 4 or self.channels % 4:
            raise ValueError(f"channels must be a positive multiple of 4, not {self.channels}")
        if self.neighbours < 3 or self.neighbours % 3:
            raise ValueError(f"neighbours must be a positive multiple of 3, not {self.neighbours}")
        if self.stages not in (1, 2, 3):
            raise ValueError(f"stages must be 1, 2 or 3, not {self.stages}")
        if self.clusters < 1 or self.graph_expansion < 1:
            raise ValueError("clusters and graph_expansion must be positive")
        if self.attention not in ("channel", "point"):
            raise ValueError(f"attention must be 'channel' or 'point', not {self.attention!r}")

    @property
    def windows(self) -> bool:
        """Of many matches each is compared with those around it alone (:mod:`mgca_filter.network.graph`).

        The order that this takes is some twenty nodes for each search in the exported graph: the six of three stages
        are too many for a file that must open fast.
        """
        return self.stages == 1

    def to_json(self) -> str:
        """All fields as a JSON object."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> NetworkConfig:
        """Inverse of :meth:`to_json`.

        Raises:
            ValueError: the text is no JSON object, or a field is not there or of another type.
        """
        values = json.loads(text)
        if not isinstance(values, dict):
            raise ValueError(f"expected a JSON object, got {text!r}")
        return cls.from_dict(values)

    @classmethod
    def from_dict(cls, values: dict[str, object]) -> NetworkConfig:
        """A config from field names and values; ``preset`` names what the others are changes to.

        Raises:
            ValueError: a field or preset is not there, or a value has another type.
        """
        values = dict(values)
        preset = values.pop("preset", None)
        if preset is not None and preset not in PRESETS:
            raise ValueError(f"preset: expected one of {', '.join(PRESETS)}, got {preset!r}")
        base = cls() if preset is None else PRESETS[str(preset)]
        unknown = set(values) - {field.name for field in fields(cls)}
        if unknown:
            raise ValueError(f"unknown network option: {', '.join(sorted(unknown))}")
        for name, value in values.items():
            kind = type(getattr(base, name))
            if type(value) is not kind:
                raise ValueError(f"{name}: expected {kind.__name__}, got {value!r}")
        return cls(**{**asdict(base), **values})


PRESETS = {
    "small": NetworkConfig(refined_feedback=True),
    "paper": NetworkConfig(channels=128, clusters=500, stages=3, graph_expansion=2),
}
