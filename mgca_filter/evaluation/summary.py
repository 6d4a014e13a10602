"""What a run of the scoreboard comes to: rows of figures, differences, failures, curves; written to and read from JSON.

``summarize`` makes it from outcomes; ``report``, ``figures`` and ``paper`` show it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from .difficulty import DifficultyTable
from .metrics import POSE_STATISTICS, ReliabilityBin
from .pairs import ALL_PAIRS, ALL_SCENES
from .timing import TimeMatch

INTERVAL_STATISTICS = ("mAP@5", "mAP@20", "AUC@5")

NOTES = (
    "mAP, AUC, P, R and F in per cent, errors in degrees; a pair without a pose counts as 180 degrees.",
    "P, R, F: the decision before the robust fit (baselines: their selection; the filter: logit > 0) over all matches "
    "against the label 1e-4; mask_P, mask_R, mask_F: the final inliers. Every pair counts.",
    "paper_P, paper_R, paper_F: as published evaluations of the family have them, logit > 2 and pairs whose value is "
    "0 or NaN left out of the mean. Not to be compared with the figures beside them.",
    "Times: wall clock of tests, network and estimator on one thread, detection and matching not counted; pair by pair "
    "all rows in turn, so that whatever else the machine does hits them alike.",
    "OpenCV's estimators fix their own seeds and run once; PoseLib, DEGENSAC and the filter are averaged over seeds.",
    "Candidates are the raw matches that the filter's shipped models look at; the baseline angle lies between the "
    "viewing rays of a right match (median of the pair). By difficulty: means over pairs.",
    "PROSAC and PoseLib with progressive sampling get their matches sorted: by ratio, or by the network's scores.",
)


@dataclass(frozen=True)
class Decision:
    """Means of precision, recall and F of a decision about the matches, per cent."""

    P: float
    R: float
    F: float


@dataclass(frozen=True)
class SummaryRow:
    """Figures of one method on one scene, on the mean over scenes, or over the pairs of all of them.

    Attributes:
        method: name of the row on the scoreboard.
        scene: its name, or :data:`pairs.ALL_SCENES`, :data:`pairs.ALL_PAIRS`.
        pairs: how many.
        pose: per cent, by the names of :data:`metrics.POSE_STATISTICS`.
        median_error_deg, median_rotation_deg, median_translation_deg: of the pose error and of its two parts.
        kept, mask: the decision before and after the robust fit.
        failures, unreadable: pairs without a pose and pairs that could not be read, mean over seeds.
        paper: the decision as published evaluations of the family count it; None without logits.
        paper_dropped: pairs that it leaves out.
        median_ms, p95_ms, timed_pairs: wall clock, and on how many pairs; None where it was not taken.
        intervals: 95 % bootstrap intervals of :data:`INTERVAL_STATISTICS`; None where there are none.
    """

    method: str
    scene: str
    pairs: int
    pose: Mapping[str, float]
    median_error_deg: float
    kept: Decision
    mask: Decision
    median_rotation_deg: float
    median_translation_deg: float
    failures: float
    unreadable: float
    paper: Decision | None = None
    paper_dropped: float | None = None
    median_ms: float | None = None
    p95_ms: float | None = None
    timed_pairs: int | None = None
    intervals: Mapping[str, tuple[float, float]] | None = None

    @property
    def figures(self) -> dict[str, float]:
        """All that is known, by the names that tables and JSON use: ``mAP@5``, ``P``, ``mask_P``, ``median_ms`` …"""
        decisions = (("", self.kept), ("mask_", self.mask), ("paper_", self.paper))
        known: dict[str, float | None] = {
            **self.pose,
            "median_error_deg": self.median_error_deg,
            **{prefix + name: v for prefix, one in decisions if one is not None for name, v in asdict(one).items()},
            "median_rotation_deg": self.median_rotation_deg,
            "median_translation_deg": self.median_translation_deg,
            "paper_dropped": self.paper_dropped,
            "failures": self.failures,
            "unreadable": self.unreadable,
            "median_ms": self.median_ms,
            "p95_ms": self.p95_ms,
            "timed_pairs": self.timed_pairs,
        }
        return {name: value for name, value in known.items() if value is not None}

    @classmethod
    def of(cls, method: str, scene: str, pairs: int, figures: Mapping[str, float]) -> SummaryRow:
        """Row from what :attr:`figures` gives; the papers' variant and times may be lacking.

        Raises:
            KeyError: another figure is lacking.
        """
        kept, mask = (Decision(*(figures[prefix + name] for name in "PRF")) for prefix in ("", "mask_"))
        paper = Decision(*(figures[f"paper_{name}"] for name in "PRF")) if "paper_P" in figures else None
        alike = ("median_error_deg", "median_rotation_deg", "median_translation_deg", "failures", "unreadable")
        optional = ("paper_dropped", "median_ms", "p95_ms", "timed_pairs")
        others: dict[str, Any] = {**{name: figures[name] for name in alike}, **{n: figures.get(n) for n in optional}}
        return cls(
            method=method,
            scene=scene,
            pairs=pairs,
            pose={name: figures[name] for name in POSE_STATISTICS},
            kept=kept,
            mask=mask,
            paper=paper,
            **others,
        )

    def to_json(self) -> dict[str, Any]:
        """The row as it is written: all figures side by side."""
        intervals = {} if self.intervals is None else {"intervals": {k: list(v) for k, v in self.intervals.items()}}
        return {"method": self.method, "scene": self.scene, "pairs": self.pairs, **self.figures, **intervals}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> SummaryRow:
        """Row from what :meth:`to_json` gave."""
        row = cls.of(content["method"], content["scene"], content["pairs"], content)
        intervals = content.get("intervals")
        return row if intervals is None else replace(row, intervals={k: (v[0], v[1]) for k, v in intervals.items()})


@dataclass(frozen=True)
class Difference:
    """Reference minus another method: mean over scenes, in percentage points, and its 95 % paired bootstrap interval.

    ``figures`` has (difference, low, high) by the names of :data:`INTERVAL_STATISTICS`.
    """

    method: str
    minus: str
    figures: Mapping[str, tuple[float, float, float]]

    def to_json(self) -> dict[str, Any]:
        """The difference as it is written."""
        return {"method": self.method, "minus": self.minus, **{k: list(v) for k, v in self.figures.items()}}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Difference:
        """Difference from what :meth:`to_json` gave."""
        figures = {key: tuple(content[key]) for key in INTERVAL_STATISTICS}
        return cls(content["method"], content["minus"], figures)


@dataclass(frozen=True)
class UnreadablePair:
    """A pair that no method could have solved, and why."""

    scene: str
    pair: int
    reason: str


@dataclass(frozen=True)
class RecallCurves:
    """Limits from 0 to 20 degrees, and by method the share of pairs below each, mean over scenes."""

    error_deg: list[float]
    methods: dict[str, list[float]]


@dataclass(frozen=True)
class PrecisionRecallCurve:
    """Precision and recall at each threshold; None where no scene has a value."""

    precision: list[float | None]
    recall: list[float | None]


@dataclass(frozen=True)
class PrecisionRecallCurves:
    """Thresholds of the logit, and the curves by method: matches of a scene together, mean over scenes."""

    logit: list[float]
    methods: dict[str, PrecisionRecallCurve]


@dataclass(frozen=True)
class Reliability:
    """Bins of probability over all pairs, and their mean gap, 0 … 1.

    The gap is the expected calibration error (Naeini et al., AAAI 2015).
    """

    bins: list[ReliabilityBin]
    error: float


@dataclass(frozen=True)
class Curves:
    """What pictures show besides rows; methods without logits are in ``recall`` alone."""

    recall: RecallCurves
    precision_recall: PrecisionRecallCurves
    reliability: dict[str, Reliability]

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Curves:
        """Curves from what ``dataclasses.asdict`` gave."""
        scored = content["precision_recall"]
        return cls(
            RecallCurves(**content["recall"]),
            PrecisionRecallCurves(
                scored["logit"], {name: PrecisionRecallCurve(**curve) for name, curve in scored["methods"].items()}
            ),
            {
                name: Reliability([ReliabilityBin(**one) for one in table["bins"]], table["error"])
                for name, table in content["reliability"].items()
            },
        )


@dataclass(frozen=True)
class TimingConditions:
    """The processor that times were taken on, and how many processors other programs used meanwhile."""

    machine: str
    others_load: float


@dataclass(frozen=True)
class NotInstalled:
    """A method whose package is missing, and what the import says."""

    method: str
    reason: str


@dataclass(frozen=True)
class Context:
    """What the figures depend on besides the methods' answers.

    Attributes:
        seed: of the draw of pairs and of the bootstrap.
        versions: of the libraries, by package. commit: of the source; None outside a checkout. machine: what it is.
        settings: of the run: format, caps, seeds, digests of the data, options of every method; JSON values.
        not_installed: methods that could not run. time_matched: rows with the iterations that take as long as ours.
    """

    seed: int | None = None
    versions: Mapping[str, str] = field(default_factory=dict)
    commit: str | None = None
    machine: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    not_installed: tuple[NotInstalled, ...] = ()
    time_matched: tuple[TimeMatch, ...] = ()

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Context:
        """Context from the fields of a summary that are its own; all of them may be lacking."""
        names = ("seed", "versions", "commit", "machine", "settings")
        plain = {name: content[name] for name in names if name in content}
        return cls(
            **plain,
            not_installed=tuple(NotInstalled(**item) for item in content.get("not_installed", ())),
            time_matched=tuple(TimeMatch(**match) for match in content.get("time_matched", ())),
        )


@dataclass(frozen=True)
class Summary:
    """Everything that a report shows.

    Attributes:
        rows: one per method and scene, then that method's mean over scenes and mean over pairs.
        differences: reference minus every other method; empty without a bootstrap.
        failures: by method, how often for which reason, all seeds counted.
        unreadable: pairs that no method could have solved.
        difficulty: figures on easier and harder pairs.
        curves: None in files that have none.
        timing: None where no times were taken.
        notes: how to read the figures.
        context: what the figures depend on besides the answers.
    """

    rows: Sequence[SummaryRow]
    differences: Sequence[Difference]
    failures: Mapping[str, Mapping[str, int]]
    unreadable: Sequence[UnreadablePair]
    difficulty: Sequence[DifficultyTable]
    curves: Curves | None
    timing: TimingConditions | None
    notes: tuple[str, ...] = NOTES
    context: Context = Context()

    def rows_of(self, scene: str) -> list[SummaryRow]:
        """Rows of all methods on one scene, or on one of the means."""
        return [row for row in self.rows if row.scene == scene]

    @property
    def scenes(self) -> list[str]:
        """Names of the scenes, without those of the means."""
        return list(dict.fromkeys(row.scene for row in self.rows if row.scene not in (ALL_SCENES, ALL_PAIRS)))

    @property
    def timed_pairs(self) -> int:
        """Number of pairs that the times were taken on; 0 without times."""
        return max((row.timed_pairs or 0 for row in self.rows_of(ALL_PAIRS)), default=0)

    def to_json(self) -> dict[str, Any]:
        """The summary as ``--json`` writes it; the context's fields stand beside the others."""
        return {
            "rows": [row.to_json() for row in self.rows],
            "differences": [difference.to_json() for difference in self.differences],
            "failures": self.failures,
            "unreadable": [asdict(pair) for pair in self.unreadable],
            "difficulty": [asdict(table) for table in self.difficulty],
            **({} if self.curves is None else {"curves": asdict(self.curves)}),
            "timing": None if self.timing is None else asdict(self.timing),
            "notes": list(self.notes),
            **asdict(self.context),
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Summary:
        """Summary from what :meth:`to_json` gave.

        Raises:
            KeyError, TypeError: something is lacking, or is not what it should be.
        """
        curves, timing = content.get("curves"), content["timing"]
        return cls(
            rows=[SummaryRow.from_json(row) for row in content["rows"]],
            differences=[Difference.from_json(one) for one in content["differences"]],
            failures=content["failures"],
            unreadable=[UnreadablePair(**one) for one in content["unreadable"]],
            difficulty=[DifficultyTable.from_json(table) for table in content["difficulty"]],
            curves=None if curves is None else Curves.from_json(curves),
            timing=None if timing is None else TimingConditions(**timing),
            notes=tuple(content["notes"]),
            context=Context.from_json(content),
        )

    @classmethod
    def read(cls, path: str | Path) -> Summary:
        """Summary from a file.

        Raises:
            ValueError: it is not there, or not what the evaluation writes; the message names it.
        """
        try:
            return cls.from_json(json.loads(Path(path).read_text(encoding="utf-8")))
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            raise ValueError(f"{path}: not what the evaluation writes ({error!r})") from error


def is_ours(method: str) -> bool:
    """Whether a row is the filter's own, by its name."""
    return "product" in method or "network" in method


def best_baseline(rows: Sequence[SummaryRow], reference: str) -> str:
    """The row of the highest mAP@20 beside the reference, not one of ours where there are others; alone, itself."""
    others = [row for row in rows if row.scene == ALL_SCENES and row.method != reference]
    baselines = [row for row in others if not is_ours(row.method)] or others
    return max(baselines, key=lambda row: row.pose["mAP@20"]).method if baselines else reference
