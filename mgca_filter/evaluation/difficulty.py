"""What makes a pair hard, and the figures of every method on easier and on harder pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.scene_bundle import ScenePair
from ..geometry.epipolar import homogeneous
from ..inputs.attributes import candidate_mask
from .metrics import POSE_STATISTICS, SceneErrors, pool_pairs

STATISTICS = ("mAP@5", "mAP@20")
UNKNOWN = "unknown"
"""The group of pairs that could not be read, or have not one right match to measure an angle on."""


@dataclass(frozen=True)
class PairProperties:
    """What is known of a pair beforehand or from the truth, whatever a method makes of it.

    Attributes:
        inlier_share: of the raw matches, how many lie near the true epipolar line, 0 … 1.
        candidates: number of raw matches that keep to the shipped models' candidate rule.
        baseline_deg: angle between the two viewing rays of a right match, degrees, median over the right candidates
            (over all right matches where no candidate is right; None where no match is).
    """

    inlier_share: float
    candidates: int
    baseline_deg: float | None

    @classmethod
    def of(cls, pair: ScenePair, truth: NDArray[np.bool_]) -> PairProperties:
        """Measured on a pair with M raw matches, of which ``truth`` (M,) are right."""
        candidates = candidate_mask(pair.attributes.encode(len(truth)))
        right = truth & candidates if (truth & candidates).any() else truth
        angles = ray_angles_deg(pair.correspondences[right], pair.R)
        baseline = float(np.median(angles)) if len(angles) else None
        return cls(float(truth.mean()) if len(truth) else 0.0, int(np.count_nonzero(candidates)), baseline)


@dataclass(frozen=True)
class Grouping:
    """Pairs sorted by one property: group i holds values from ``edges[i - 1]`` to below ``edges[i]``.

    ``scale`` and ``unit`` turn values into what the groups' names say.
    """

    title: str
    field: str
    edges: tuple[float, ...]
    scale: float = 1.0
    unit: str = ""

    @property
    def names(self) -> list[str]:
        """Names of the groups, from the lowest values on."""
        shown = [f"{self.scale * edge:g}" for edge in self.edges]
        between = [f"{low} – {high}{self.unit}" for low, high in zip(shown, shown[1:])]
        return [f"below {shown[0]}{self.unit}", *between, f"from {shown[-1]}{self.unit}"]

    def name_of(self, properties: PairProperties | None) -> str:
        """The group that a pair belongs to."""
        value = None if properties is None else getattr(properties, self.field)
        return UNKNOWN if value is None else self.names[int(np.searchsorted(self.edges, value, side="right"))]


GROUPINGS = (
    Grouping("share of right matches among the raw ones", "inlier_share", (0.05, 0.1, 0.2), 100.0, " %"),
    Grouping("number of candidates", "candidates", (400, 500, 700)),
    Grouping("baseline angle", "baseline_deg", (5.0, 15.0, 30.0), unit="°"),
)


def ray_angles_deg(correspondences: NDArray[np.float64], R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles (N,) between the viewing rays of matches (N, 4) on the normalised image planes, degrees.

    ``R`` (3, 3) turns directions of the first camera into the second's.
    """
    rays1, rays2 = homogeneous(correspondences[:, :2]) @ R.T, homogeneous(correspondences[:, 2:])
    across = np.linalg.norm(np.cross(rays1, rays2), axis=1)
    return np.asarray(np.degrees(np.arctan2(across, np.sum(rays1 * rays2, axis=1))), dtype=np.float64)


@dataclass(frozen=True)
class DifficultyGroup:
    """Figures on the pairs of one group: by method those of :data:`STATISTICS`, per cent, mean over pairs."""

    group: str
    pairs: int
    methods: dict[str, dict[str, float]]


@dataclass(frozen=True)
class DifficultyTable:
    """The groups of one property of the pairs, from the lowest values on."""

    property: str
    groups: list[DifficultyGroup]

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> DifficultyTable:
        """Table from what ``dataclasses.asdict`` gave."""
        return cls(content["property"], [DifficultyGroup(**group) for group in content["groups"]])


def figures_by_difficulty(
    errors: Mapping[str, SceneErrors], properties: Sequence[PairProperties | None]
) -> list[DifficultyTable]:
    """For each property its groups, and of every method the figures on each group, per cent, mean over pairs.

    Args:
        errors: pose errors (seeds, pairs) by method and scene, degrees.
        properties: of the scenes' pairs one after the other; None where a pair could not be read.

    Returns:
        One table a property; groups without a pair are left out.
    """
    pooled = {name: pool_pairs(scenes) for name, scenes in errors.items()}
    tables = []
    for grouping in GROUPINGS:
        belongs = np.array([grouping.name_of(one) for one in properties])
        groups = []
        for name in (*grouping.names, UNKNOWN):
            chosen = belongs == name
            if chosen.any():
                methods = {
                    method: {key: 100.0 * float(POSE_STATISTICS[key](values[:, chosen])) for key in STATISTICS}
                    for method, values in pooled.items()
                }
                groups.append(DifficultyGroup(name, int(np.count_nonzero(chosen)), methods))
        tables.append(DifficultyTable(grouping.title, groups))
    return tables
