"""How the attributes of right and wrong matches are distributed, measured on scene bundles.

``python -m mgca_filter.training.match_statistics BUNDLES OUT.json`` wrote ``match_statistics.json``, which
image-free training draws from.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.scene_bundle import ScenePair, load_scene_bundles
from .labels import NEGATIVE, POSITIVE, clean_labels

FloatArray = NDArray[np.float64]

SHIPPED = Path(__file__).with_name("match_statistics.json")
QUANTILES = 21
DIFFICULTIES = 4  # groups of pairs, by their share of right matches
PAIRS_PER_SCENE = 12
STATES = ("neither", "best", "mutual")  # best of the list implied by mutual


@dataclass(frozen=True)
class ClassStatistics:
    """Right or wrong matches: shares and ratio quantiles of the three states, quantiles of size and angle.

    ``log_size`` = log2 of the ratio of sizes and ``turn_deg`` = difference of angles; of right matches what is
    left when the pair's median is taken away.
    """

    state_share: tuple[float, ...]
    ratio: tuple[tuple[float, ...], ...]
    log_size: tuple[float, ...]
    turn_deg: tuple[float, ...]


@dataclass(frozen=True)
class DrawnMatches:
    """Attributes of matches, (M,) each."""

    ratio: FloatArray
    best: NDArray[np.bool_]
    mutual: NDArray[np.bool_]
    log_size: FloatArray
    turn_deg: FloatArray


@dataclass(frozen=True)
class Difficulty:
    """Pairs with about the same share of right matches."""

    right_share: tuple[float, ...]
    right: ClassStatistics
    wrong: ClassStatistics

    def draw_right_share(self, rng: np.random.Generator) -> float:
        """Share of right matches of a pair."""
        return float(_from_quantiles(rng, self.right_share, 1)[0])

    def draw_matches(self, rng: np.random.Generator, is_right: NDArray[np.bool_]) -> DrawnMatches:
        """Attributes of matches of which ``is_right`` (M,) are right."""
        parts = [
            _draw_class(rng, statistics, int(np.count_nonzero(rows)))
            for statistics, rows in ((self.right, is_right), (self.wrong, ~is_right))
        ]
        merged = np.zeros((4, len(is_right)))
        merged[:, is_right], merged[:, ~is_right] = parts
        ratio, state, log_size, turn_deg = merged
        return DrawnMatches(ratio, state >= STATES.index("best"), state == STATES.index("mutual"), log_size, turn_deg)


@dataclass(frozen=True)
class MatchStatistics:
    """Groups of pairs by difficulty, as frequent as each other."""

    difficulties: tuple[Difficulty, ...]

    def draw(self, rng: np.random.Generator) -> Difficulty:
        """One of the difficulties."""
        return self.difficulties[int(rng.integers(len(self.difficulties)))]

    @classmethod
    def load(cls, path: Path = SHIPPED) -> MatchStatistics:
        """Read a file that the command wrote; the package's own unless told otherwise."""
        groups = json.loads(path.read_text(encoding="utf-8"))["difficulties"]
        return cls(
            tuple(Difficulty(tuple(g["right_share"]), _read_class(g["right"]), _read_class(g["wrong"])) for g in groups)
        )

    def save(self, path: Path) -> None:
        """Write all tables as JSON."""
        path.write_text(json.dumps(asdict(self)) + "\n", encoding="utf-8")


def _read_class(values: dict[str, list[Any]]) -> ClassStatistics:
    ratio = tuple(tuple(quantiles) for quantiles in values["ratio"])
    return ClassStatistics(tuple(values["state_share"]), ratio, tuple(values["log_size"]), tuple(values["turn_deg"]))


def _from_quantiles(rng: np.random.Generator, quantiles: Sequence[float], count: int) -> FloatArray:
    """Numbers (count,) whose distribution has equally spaced ``quantiles``."""
    return np.interp(rng.random(count), np.linspace(0.0, 1.0, len(quantiles)), quantiles)


def _draw_class(rng: np.random.Generator, statistics: ClassStatistics, count: int) -> FloatArray:
    """Ratio, state, log size and turn (4, count)."""
    share = np.array(statistics.state_share)
    state = rng.choice(len(STATES), count, p=share / share.sum())
    ratio = np.zeros(count)
    for number, quantiles in enumerate(statistics.ratio):
        ratio[state == number] = _from_quantiles(rng, quantiles, int(np.count_nonzero(state == number)))
    log_size, turn = (_from_quantiles(rng, q, count) for q in (statistics.log_size, statistics.turn_deg))
    return np.stack([ratio, state, log_size, turn])


def measure(pairs: Sequence[ScenePair]) -> MatchStatistics:
    """Statistics of real pairs."""
    labels = [clean_labels(pair) for pair in pairs]
    share = np.array([np.mean(l == POSITIVE) for l in labels])
    usable = np.flatnonzero([np.count_nonzero(l == POSITIVE) >= 16 for l in labels])
    groups = np.array_split(usable[np.argsort(share[usable])], DIFFICULTIES)
    return MatchStatistics(
        tuple(
            Difficulty(
                _quantiles(share[group]),
                *(
                    _measure_class([(pairs[i], labels[i] == kind) for i in group], kind)
                    for kind in (POSITIVE, NEGATIVE)
                ),
            )
            for group in groups
        )
    )


def _measure_class(members: Sequence[tuple[ScenePair, NDArray[np.bool_]]], kind: int) -> ClassStatistics:
    ratio, state, log_size, turn = (
        np.concatenate(column) for column in zip(*(_attributes(pair, rows, kind) for pair, rows in members))
    )
    return ClassStatistics(
        tuple(float(np.mean(state == number)) for number in range(len(STATES))),
        tuple(_quantiles(ratio[state == number]) for number in range(len(STATES))),
        _quantiles(log_size),
        _quantiles(turn),
    )


def _attributes(pair: ScenePair, rows: NDArray[np.bool_], kind: int) -> tuple[FloatArray, ...]:
    """Ratio, state, log size and turn of some matches of a pair."""
    attributes = pair.attributes.take(rows)
    ratio, best, size1, size2, angle1, angle2 = (
        np.asarray(getattr(attributes, name), dtype=np.float64)
        for name in ("ratio", "best", "size1", "size2", "angle1", "angle2")
    )
    log_size, turn = np.log2(size2 / size1), angle2 - angle1
    if kind == POSITIVE:
        log_size = log_size - np.median(log_size)
        turn = turn - np.degrees(np.angle(np.mean(np.exp(1j * np.radians(turn)))))
    state = np.where(pair.mutual[rows], STATES.index("mutual"), best)
    return ratio, state, log_size, (turn + 180.0) % 360.0 - 180.0


def _quantiles(values: FloatArray) -> tuple[float, ...]:
    if len(values) == 0:  # a state that no match is in: never drawn
        return (0.0,) * QUANTILES
    return tuple(round(float(q), 4) for q in np.quantile(values, np.linspace(0.0, 1.0, QUANTILES)))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all bundles of a folder, a dozen pairs of each."""
    parser = argparse.ArgumentParser(prog="python -m mgca_filter.training.match_statistics", description=__doc__)
    parser.add_argument("bundles", type=Path, help="folder of scene bundles")
    parser.add_argument("out", type=Path, help="JSON file to write")
    options = parser.parse_args(arguments)
    pairs = []
    for bundle in load_scene_bundles(options.bundles):
        chosen = np.unique(np.linspace(0, len(bundle) - 1, PAIRS_PER_SCENE).astype(int))
        pairs += [bundle[int(index)] for index in chosen]
    measure(pairs).save(options.out)


if __name__ == "__main__":
    main()
