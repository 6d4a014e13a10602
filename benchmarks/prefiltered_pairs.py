"""Never worse than the baseline? ``python -m benchmarks.prefiltered_pairs BUNDLES RENDERED.npz``.

*Easy pairs*, of which 30 % of the raw matches and more are right: there a ratio test and PROSAC do well, and the filter
must not spoil it. *Prefiltered pairs*: matches that passed a test that users apply, for the filter and the estimator
alike. Every difference is paired: both on the same pairs, and on the same draws of the bootstrap.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mgca_filter.data.scene_bundle import ScenePair
from mgca_filter.evaluation.methods import Answer, Method
from mgca_filter.evaluation.metrics import POSE_STATISTICS, FloatArray, pool_pairs, true_matches
from mgca_filter.evaluation.our_rows import ProductMethod, filter_pair, model_settings
from mgca_filter.evaluation.pairs import SceneSelection, select_pairs
from mgca_filter.evaluation.predict import SceneOutcomes, predict
from mgca_filter.evaluation.registry import parse_method
from mgca_filter.evaluation.selection import Selection
from mgca_filter.evaluation.store import ResultStore
from mgca_filter.evaluation.summarize import scene_errors
from mgca_filter.tables import render_table

from .study import drawn_pairs, paired_cells, run_study, study_parser

EASY_SHARE = 0.3
BASELINE = "mutual + ratio 0.9 + PROSAC 0.5 px"
TESTS = (
    Selection(max_ratio=0.75),
    Selection(max_ratio=0.8),
    Selection(mutual=True),
    Selection(mutual=True, max_ratio=0.8),
)
STATISTIC = POSE_STATISTICS["mAP@5"]


@dataclass(frozen=True)
class ProductWithoutRatio:
    """The filter on matches that lost their second candidates in a test: sizes and angles are known, ratios are not."""

    selection: Selection
    model: str | None = None

    seeded = True

    @property
    def name(self) -> str:
        return " + ".join([*self.selection.parts, "product without ratio"])

    def settings(self) -> dict[str, Any]:
        return {"selection": self.selection.settings(), "ratio": "withheld", **model_settings(self.model, {})}

    def run(self, pair: ScenePair, seed: int) -> Answer:
        kept = self.selection.apply(pair)
        without = replace(pair, attributes=replace(pair.attributes, ratio=None))
        result = filter_pair(without, np.flatnonzero(kept), self.model, {"seed": seed})
        mask = np.zeros(len(kept), dtype=bool)
        mask[kept] = result.mask
        return Answer(result.R, result.t, kept, mask, "" if result.t is not None else result.status.value)


def right_share(pair: ScenePair) -> float:
    """Share of the raw matches that lie near the true epipolar line; 0 without matches."""
    return float(np.mean(true_matches(pair.correspondences, pair.E))) if len(pair.points1) else 0.0


def easy_pairs(selections: Sequence[SceneSelection]) -> list[SceneSelection]:
    """What is left of the selections when hard pairs are taken out; scenes without an easy pair are not listed."""
    chosen = [
        SceneSelection(s.source, tuple(i for i in s.indices if right_share(s.source[i]) >= EASY_SHARE))
        for s in selections
    ]
    return [selection for selection in chosen if len(selection)]


def pair_errors(outcomes: SceneOutcomes) -> FloatArray:
    """Pose errors (S, P) of the pairs of all scenes side by side, each of S runs."""
    return pool_pairs(scene_errors(outcomes))


def easy_table(groups: Mapping[str, Sequence[SceneSelection]], model: str | None, store: ResultStore) -> str:
    """The filter against PROSAC in ratio order, a line for each group of scenes."""
    body = []
    methods = [parse_method("product", model), parse_method(BASELINE)]
    for name, selections in groups.items():
        ours, theirs = (pair_errors(outcomes) for outcomes in predict(methods, selections, store=store).values())
        body.append([name, str(ours.shape[1]), *paired_cells(ours, theirs, STATISTIC)])
    return render_table(["pairs", "number", "filter mAP@5", f"{BASELINE} mAP@5", "difference"], body)


def prefiltered_table(selections: Sequence[SceneSelection], model: str | None, store: ResultStore) -> str:
    """The filter on matches that passed a test, by what is known of them, against estimators on the same matches."""
    body = []
    for test in TESTS:
        filters: dict[str, Method] = {
            "all": ProductMethod("product", test, model),
            "no ratio": ProductWithoutRatio(test, model),
            "points": ProductMethod("product bare", test, model),
        }
        words = " + ".join(test.parts)
        baselines = {name: parse_method(f"{words} + {name}") for name in ("PROSAC 0.5 px", "MAGSAC 0.5 px")}
        results = predict([*filters.values(), *baselines.values()], selections, seeds=1, store=store)
        errors = {name: pair_errors(outcomes) for name, outcomes in results.items()}
        for known, method in filters.items():
            # Whoever holds the ratios can sort by them.
            for baseline in baselines if known == "all" else list(baselines)[1:]:
                ours = errors[method.name]
                cells = paired_cells(ours, errors[baselines[baseline].name], STATISTIC)
                body.append([words, known, baseline, str(ours.shape[1]), *cells])
    header = ["matches that passed", "the filter knows", "estimator", "pairs", "filter mAP@5", "estimator mAP@5"]
    return render_table([*header, "difference"], body, align="lllr")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file or option that cannot be used."""
    parser = study_parser("prefiltered_pairs", __doc__)
    parser.add_argument("bundles", metavar="BUNDLES", type=Path, help="photographed scenes")
    parser.add_argument("rendered", metavar="RENDERED.npz", type=Path, help="what mgca_filter.training.render wrote")
    parser.add_argument("--store", metavar="DIR", help="keep results here, and take from here what is known")
    return run_study(run, parser.parse_args(arguments))


def run(options: argparse.Namespace) -> int:
    """Print two tables: easy pairs, and prefiltered pairs, for which ``--per-scene`` and ``--seed`` draw."""
    photographed, rendered = (select_pairs(path) for path in (options.bundles, options.rendered))
    groups = {"photographs, easy": easy_pairs(photographed), "rendered, easy": easy_pairs(rendered)}
    groups["rendered, all"] = rendered
    groups = {name: selections for name, selections in groups.items() if selections}
    store = ResultStore(options.store)
    print(easy_table(groups, options.model, store), flush=True)
    print("\n" + prefiltered_table(drawn_pairs(options), options.model, store))
    return 0


if __name__ == "__main__":
    sys.exit(main())
