"""What a method of the scoreboard is: a pair of images in, a pose and two decisions per match out."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np

from ..data.scene_bundle import ScenePair
from .difficulty import PairProperties
from .metrics import BoolArray as BoolArray
from .metrics import FloatArray as FloatArray
from .metrics import ScoreCounts

MIN_MATCHES = 5


@dataclass(frozen=True)
class PoseEstimate:
    """Answer of a robust estimator on N matches: ``R`` (3, 3) and unit ``t`` (3,) or None, bool ``inliers`` (N,).

    ``failure`` is empty, or says in a few words why there is no pose.
    """

    R: FloatArray | None
    t: FloatArray | None
    inliers: BoolArray
    failure: str = ""

    @classmethod
    def failed(cls, count: int, reason: str) -> PoseEstimate:
        """No pose and no inlier among ``count`` matches."""
        return cls(None, None, np.zeros(count, dtype=bool), reason)


@dataclass(frozen=True)
class Answer:
    """What a method says about one pair with M putative matches.

    Attributes:
        R, t: (3, 3) and (3,), ``X2 = R X1 + t``, or None where the method has no pose.
        kept: bool (M,), the decision before the robust fit: a baseline's selection, the network's logit > 0.
        mask: bool (M,), the decision after it: what a user gets.
        failure: empty, or why there is no pose.
        logits, scores: (M,) the network's logits and the probabilities made from them, for methods that have any.
        status, confidence: the filter's verdict, and its probability that the pose is within 10 degrees; empty and None
            where a method has none.
    """

    R: FloatArray | None
    t: FloatArray | None
    kept: BoolArray
    mask: BoolArray
    failure: str = ""
    logits: FloatArray | None = None
    scores: FloatArray | None = None
    status: str = ""
    confidence: float | None = None


class Method(Protocol):
    """One row of the scoreboard; picklable, since worker processes run it."""

    @property
    def name(self) -> str:
        """The row's name, from which :func:`registry.parse_method` builds the method again."""

    @property
    def seeded(self) -> bool:
        """Whether the answer depends on ``seed``; the others are run once."""

    def settings(self) -> dict[str, Any]:
        """All that the answers depend on besides the data: options, library versions, hashes. JSON values only."""

    def run(self, pair: ScenePair, seed: int) -> Answer:
        """Answer for one pair; what it raises is counted as a failure of the pair."""


UNREADABLE = "unreadable: "
"""How the failure of a pair begins that could not be read, so that no method had a chance."""


@dataclass(frozen=True)
class PairOutcome:
    """Result of one method on one pair, as it is stored.

    Attributes:
        pair: index of the pair in its scene.
        error_deg: pose error; 180 where there is no pose.
        rotation_deg, translation_deg: its two parts; None where there is no pose.
        kept, mask: (precision, recall, F) of the decision before and after the robust fit, all matches counted.
        failure: empty, or why there is no pose; ``error: …`` where the method raised, ``unreadable: …`` where the pair
            could not be read.
        paper: (precision, recall, F) at logit > 2, for methods that have logits.
        counts: right and wrong matches over the scores, likewise.
        properties: how hard the pair is; None where it could not be read.
        status, confidence: as in :class:`Answer`.
    """

    pair: int
    error_deg: float
    rotation_deg: float | None
    translation_deg: float | None
    kept: tuple[float, float, float]
    mask: tuple[float, float, float]
    failure: str = ""
    paper: tuple[float, float, float] | None = None
    counts: ScoreCounts | None = None
    properties: PairProperties | None = None
    status: str = ""
    confidence: float | None = None

    @property
    def unreadable(self) -> bool:
        """Whether the pair could not be read."""
        return self.failure.startswith(UNREADABLE)

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> PairOutcome:
        """Outcome from what ``dataclasses.asdict`` gave; older ones may hold other fields, and lack the last ones."""
        values = {field.name: content[field.name] for field in fields(cls) if field.name in content}
        for name in ("kept", "mask", "paper"):
            if values.get(name) is not None:
                values[name] = tuple(values[name])
        if values.get("counts") is not None:
            values["counts"] = ScoreCounts.from_json(values["counts"])
        if values.get("properties") is not None:
            values["properties"] = PairProperties(**values["properties"])
        return cls(**values)
