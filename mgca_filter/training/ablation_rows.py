"""The rows of the ablation: each is a training config changed in one thing, or a stage of the paper's build-up."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from .config import SourceConfig, TrainingConfig

RENDERED_SHARE = 0.25
PRETRAINING_SHARE = 0.25

_ONE_STAGE: Mapping[str, Any] = {"stages": 1, "csmgc": False, "final_consensus": False}
_PLAIN_STAGES: Mapping[str, Any] = {"csmgc": False, "final_consensus": False}


@dataclass(frozen=True)
class Row:
    """One row.

    Attributes:
        name: as the table has it.
        network: changes to the full network.
        rendered: a quarter of the pairs are rendered worlds.
        pretrained: a quarter of the steps are spent on image-free pairs first; the budget stays the same.
    """

    name: str
    network: Mapping[str, Any] = field(default_factory=dict)
    rendered: bool = False
    pretrained: bool = False

    @property
    def slug(self) -> str:
        """The name as a folder's name."""
        return "".join(c if c.isalnum() else "_" for c in self.name)


ROWS = (
    # The paper's table, from the bottom up.
    Row("baseline", {**_ONE_STAGE, "cga": False}),
    Row("CGA", _ONE_STAGE),
    Row("iterations", {**_PLAIN_STAGES, "cga": False}),
    Row("iterations + CGA", _PLAIN_STAGES),
    Row("iterations + CSMGC", {"cga": False}),
    Row("full"),
    # The full network with one thing changed.
    Row("point attention", {"attention": "point"}),
    Row("no positional term", {"positional": False}),
    Row("no pooled branches", {"pooled_branches": False}),
    Row("no squeeze-excitation", {"squeeze_excitation": False}),
    Row("no final consensus", {"final_consensus": False}),
    Row("k = 3", {"neighbours": 3}),
    Row("k = 9", {"neighbours": 9}),
    Row("no side information", {"attributes": False}),
    # Other data.
    Row("rendered worlds", rendered=True),
    Row("synthetic pre-training", pretrained=True),
)


def row_phases(row: Row, base: TrainingConfig, steps: int, seed: int, rendered: str) -> list[TrainingConfig]:
    """The runs of a row, one after the other, each started from the last one's weights.

    Args:
        base: the full network, its data and schedule. steps: budget of the row.
        rendered: path of rendered worlds, from the data folder.
    """
    config = replace(base, name=row.name, seed=seed, network=replace(base.network, **row.network))
    if row.rendered:
        total = sum(source.weight for source in base.sources)
        share = total * RENDERED_SHARE / (1.0 - RENDERED_SHARE)
        config = replace(config, sources=(*base.sources, SourceConfig("bundles", rendered, share)))
    if not row.pretrained:
        return [_with_steps(config, steps)]
    first = max(1, round(PRETRAINING_SHARE * steps))
    synthetic = replace(config, sources=(SourceConfig("synthetic"),), scenes=(), tuning_scenes=(), validation=())
    return [_with_steps(synthetic, first), _with_steps(config, max(1, steps - first))]


def _with_steps(config: TrainingConfig, steps: int) -> TrainingConfig:
    """The same schedule over fewer steps: a short run must not be all warm-up."""
    warmup = min(config.schedule.warmup_steps, steps // 10)
    return replace(config, schedule=replace(config.schedule, steps=steps, warmup_steps=warmup))
