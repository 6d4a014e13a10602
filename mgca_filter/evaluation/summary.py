"""Outcomes to figures: one summary, written to and read from JSON, from which tables and pictures are made."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from .difficulty import DifficultyTable, PairProperties, figures_by_difficulty
from .methods import UNREADABLE, PairOutcome
from .metrics import (
    FAILURE_DEG,
    LOGIT_EDGES,
    POSE_STATISTICS,
    FloatArray,
    ReliabilityBin,
    SceneErrors,
    ScoreCounts,
    mean_of_the_nonzero,
    mean_over_pairs,
    mean_over_scenes,
    median_error,
    percentile_interval,
    precision_recall_curve,
    reliability,
    resampled_figures,
    share_below,
)
from .pairs import ALL_PAIRS, ALL_SCENES
from .predict import SceneOutcomes
from .timing import TimeMatch, Timing

INTERVAL_STATISTICS = ("mAP@5", "mAP@20", "AUC@5")
COUNTS = ("failures", "unreadable", "paper_dropped", "timed_pairs")
"""Numbers of pairs, which the mean over scenes adds up; ``pairs`` itself among them."""

RECALL_STEP_DEG = 0.5
RECALL_LIMIT_DEG = 20.0
_CURVE_DIGITS = 4

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


# What a summary holds


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


# From outcomes to a summary


def scene_errors(outcomes: SceneOutcomes) -> dict[str, FloatArray]:
    """Pose errors (seeds, pairs) by scene, degrees."""
    return {
        scene: np.array([[outcome.error_deg for outcome in run] for run in runs]) for scene, runs in outcomes.items()
    }


def summarize(
    results: Mapping[str, SceneOutcomes],
    context: Context | None = None,
    timing: Timing | None = None,
    *,
    reference: str | None = None,
    replicates: int = 1000,
    seed: int = 0,
) -> Summary:
    """Everything a report shows.

    Args:
        results: outcomes by method, as :func:`predict.predict` returns them.
        context: written beside the rows as it is.
        timing: times of the same methods, as :func:`timing.time_methods` returns them; without, rows hold none.
        reference: method whose differences from every other are listed; None = the first product row, else the last.
        replicates: of the bootstrap; 0 leaves the intervals and differences out.
        seed: of the bootstrap.
    """
    errors = {name: scene_errors(outcomes) for name, outcomes in results.items()}
    times = {} if timing is None else timing.milliseconds
    rows = [
        row
        for name, outcomes in results.items()
        for row in _method_rows(name, outcomes, errors[name], times.get(name, {}))
    ]
    differences: list[Difference] = []
    if replicates > 0:
        resampled = {name: _resampled(scenes, replicates, seed) for name, scenes in errors.items()}
        rows = [_with_intervals(row, resampled[row.method].get(row.scene)) for row in rows]
        differences = _differences(errors, resampled, choose_reference(list(results), reference))
    return Summary(
        rows=rows,
        differences=differences,
        failures={name: _failures(outcomes) for name, outcomes in results.items()},
        unreadable=_unreadable(results),
        difficulty=figures_by_difficulty(errors, _properties(results)),
        curves=Curves(recall_curves(errors), precision_recall_curves(results), reliability_tables(results)),
        timing=None if timing is None else TimingConditions(timing.machine, timing.others_load),
        context=Context() if context is None else context,
    )


def _method_rows(
    name: str, outcomes: SceneOutcomes, errors: SceneErrors, times: Mapping[str, list[float]]
) -> list[SummaryRow]:
    rows = []
    for scene, runs in outcomes.items():
        pose = {key: 100.0 * float(statistic(errors[scene])) for key, statistic in POSE_STATISTICS.items()}
        pose["median_error_deg"] = float(median_error(errors[scene]))
        figures = {**pose, **_decisions(runs), **_times(times.get(scene, []))}
        rows.append(SummaryRow.of(name, scene, len(runs[0]), figures))
    pairs = sum(row.pairs for row in rows)
    # The papers' variant and times are lacking where not one pair of a scene could be read.
    columns: dict[str, list[float]] = {}
    for row in rows:
        for key, value in row.figures.items():
            columns.setdefault(key, []).append(value)
    mean = {key: sum(v) if key in COUNTS else float(np.mean(v)) for key, v in columns.items()}
    pooled_runs = [[outcome for runs in outcomes.values() for outcome in runs[s]] for s in range(_seeds(outcomes))]
    pooled = {key: 100.0 * mean_over_pairs(statistic, errors) for key, statistic in POSE_STATISTICS.items()}
    pooled["median_error_deg"] = mean_over_pairs(median_error, errors)
    pooled_times = _times([value for scene in times.values() for value in scene])
    return [
        *rows,
        SummaryRow.of(name, ALL_SCENES, pairs, mean),
        SummaryRow.of(name, ALL_PAIRS, pairs, {**pooled, **_decisions(pooled_runs), **pooled_times}),
    ]


def _seeds(outcomes: SceneOutcomes) -> int:
    return len(next(iter(outcomes.values())))


def _decisions(runs: list[list[PairOutcome]]) -> dict[str, float]:
    """Means of P, R and F over pairs and seeds, medians of both parts of the error, numbers of pairs per seed."""
    outcomes = [outcome for run in runs for outcome in run]
    kept = 100.0 * np.mean([outcome.kept for outcome in outcomes], axis=0)
    mask = 100.0 * np.mean([outcome.mask for outcome in outcomes], axis=0)
    figures = dict(zip(("P", "R", "F", "mask_P", "mask_R", "mask_F"), (float(v) for v in (*kept, *mask))))
    for part in ("rotation_deg", "translation_deg"):
        values = [FAILURE_DEG if getattr(o, part) is None else getattr(o, part) for o in outcomes]
        figures[f"median_{part}"] = float(np.median(values))
    paper = [outcome.paper for outcome in outcomes if not outcome.unreadable]
    if paper and all(values is not None for values in paper):
        for key, values in zip(("paper_P", "paper_R", "paper_F"), zip(*paper)):
            mean, dropped = mean_of_the_nonzero(values)
            figures |= {key: 100.0 * mean, "paper_dropped": dropped / len(runs)}
    figures["failures"] = sum(bool(outcome.failure) for outcome in outcomes) / len(runs)
    figures["unreadable"] = sum(outcome.unreadable for outcome in outcomes) / len(runs)
    return figures


def _times(milliseconds: Sequence[float]) -> dict[str, float]:
    """Median and 95th percentile, and on how many pairs; nothing without any."""
    if not milliseconds:
        return {}
    median, p95 = np.percentile(milliseconds, [50, 95])
    return {"median_ms": float(median), "p95_ms": float(p95), "timed_pairs": len(milliseconds)}


def _resampled(errors: SceneErrors, replicates: int, seed: int) -> dict[str, dict[str, FloatArray]]:
    """By scene, and for the mean over scenes, figures (replicates,) in per cent on resampled pairs.

    The draws are the same for all methods, so that they can be paired.
    """
    figures: dict[str, dict[str, FloatArray]] = {scene: {} for scene in (*errors, ALL_SCENES)}
    for key in INTERVAL_STATISTICS:
        values = 100.0 * resampled_figures(errors, POSE_STATISTICS[key], replicates=replicates, seed=seed)
        for scene, scene_values in zip(errors, values):
            figures[scene][key] = scene_values
        figures[ALL_SCENES][key] = values.mean(axis=0)
    return figures


def _with_intervals(row: SummaryRow, resampled: Mapping[str, FloatArray] | None) -> SummaryRow:
    """The row with its intervals; there are none of the mean over pairs."""
    if resampled is None:
        return row
    return replace(row, intervals={key: percentile_interval(values) for key, values in resampled.items()})


def choose_reference(names: Sequence[str], reference: str | None) -> str:
    """The row that others are compared with: the one named, else the first product row, else the last.

    Raises:
        ValueError: the one named is not among the names.
    """
    if reference is not None:
        if reference not in names:
            raise ValueError(f"reference {reference!r} is not among the methods: {', '.join(names)}")
        return reference
    return next((name for name in names if name.endswith("product")), names[-1])


def is_ours(method: str) -> bool:
    """Whether a row is the filter's own, by its name."""
    return "product" in method or "network" in method


def best_baseline(rows: Sequence[SummaryRow], reference: str) -> str:
    """The row of the highest mAP@20 beside the reference, not one of ours where there are others; alone, itself."""
    others = [row for row in rows if row.scene == ALL_SCENES and row.method != reference]
    baselines = [row for row in others if not is_ours(row.method)] or others
    return max(baselines, key=lambda row: row.pose["mAP@20"]).method if baselines else reference


def _differences(
    errors: Mapping[str, SceneErrors], resampled: Mapping[str, Mapping[str, Mapping[str, FloatArray]]], reference: str
) -> list[Difference]:
    differences = []
    for name in errors:
        if name == reference:
            continue
        figures = {}
        for key in INTERVAL_STATISTICS:
            statistic = POSE_STATISTICS[key]
            value = mean_over_scenes(statistic, errors[reference]) - mean_over_scenes(statistic, errors[name])
            apart = resampled[reference][ALL_SCENES][key] - resampled[name][ALL_SCENES][key]
            figures[key] = (100.0 * value, *percentile_interval(apart))
        differences.append(Difference(reference, name, figures))
    return differences


def _failures(outcomes: SceneOutcomes) -> dict[str, int]:
    """Number of failures by reason, all seeds counted."""
    counter = Counter(o.failure for runs in outcomes.values() for run in runs for o in run if o.failure)
    return dict(counter.most_common())


def _properties(results: Mapping[str, SceneOutcomes]) -> list[PairProperties | None]:
    """How hard each pair is, scene by scene: from any outcome that says so, since older ones may not."""
    found = {
        (scene, outcome.pair): outcome.properties
        for outcomes in results.values()
        for scene, runs in outcomes.items()
        for run in runs
        for outcome in run
        if outcome.properties is not None
    }
    first = next(iter(results.values()))
    return [found.get((scene, outcome.pair)) for scene, runs in first.items() for outcome in runs[0]]


def _unreadable(results: Mapping[str, SceneOutcomes]) -> list[UnreadablePair]:
    """The pairs that could not be read; every method fails on them alike."""
    found = {
        (scene, outcome.pair): outcome.failure.removeprefix(UNREADABLE)
        for outcomes in results.values()
        for scene, runs in outcomes.items()
        for outcome in runs[0]
        if outcome.unreadable
    }
    return [UnreadablePair(scene, pair, reason) for (scene, pair), reason in found.items()]


def recall_curves(errors: Mapping[str, SceneErrors]) -> RecallCurves:
    """Share of pairs below each limit of the pose error, by method."""
    limits = np.arange(0.0, RECALL_LIMIT_DEG + RECALL_STEP_DEG, RECALL_STEP_DEG)
    methods = {
        name: [
            round(mean_over_scenes(partial(share_below, limit_deg=limit), scenes), _CURVE_DIGITS) for limit in limits
        ]
        for name, scenes in errors.items()
    }
    return RecallCurves([float(limit) for limit in limits], methods)


def precision_recall_curves(results: Mapping[str, SceneOutcomes]) -> PrecisionRecallCurves:
    """Precision and recall as the threshold on the logit moves; methods without logits are left out."""
    methods = {}
    for name, outcomes in results.items():
        scenes = [counts for runs in outcomes.values() if (counts := _counts(runs[0]))]
        if not scenes:
            continue
        curves = [precision_recall_curve(counts) for counts in scenes]
        precision, recall = (_mean_of_known([curve[side] for curve in curves]) for side in (0, 1))
        methods[name] = PrecisionRecallCurve(precision, recall)
    return PrecisionRecallCurves(list(LOGIT_EDGES), methods)


def reliability_tables(results: Mapping[str, SceneOutcomes]) -> dict[str, Reliability]:
    """By method what its probabilities are worth; methods without any are left out."""
    tables = {}
    for name, outcomes in results.items():
        counts = [one for runs in outcomes.values() for one in _counts(runs[0])]
        if not counts:
            continue
        bins = reliability(counts)
        matches = sum(one.matches for one in bins)
        gap = sum(one.matches * abs(one.probability - one.share_right) for one in bins)
        tables[name] = Reliability(bins, gap / matches if matches else 0.0)
    return tables


def _counts(outcomes: list[PairOutcome]) -> list[ScoreCounts]:
    return [outcome.counts for outcome in outcomes if outcome.counts is not None]


def _mean_of_known(curves: list[FloatArray]) -> list[float | None]:
    stacked = np.array(curves)
    known = np.isfinite(stacked)
    total, count = np.where(known, stacked, 0.0).sum(axis=0), known.sum(axis=0)
    return [round(float(t / c), _CURVE_DIGITS) if c else None for t, c in zip(total, count)]
