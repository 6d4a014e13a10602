"""The lists that users make of raw matches before they hand them over, as sources of pairs for the evaluation.

A bundle holds raw nearest neighbours, or a learned matcher's own list; a kind of list says which of its matches a user
keeps and what is still known of them. Whatever runs on a :class:`ListSource` runs on exactly the same list.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mgca_filter.data import PairSource, open_sources
from mgca_filter.data.scene_bundle import ScenePair, scene_and_detector
from mgca_filter.data.source import Image
from mgca_filter.errors import DatasetError
from mgca_filter.evaluation.pairs import SceneSelection, draw_indices
from mgca_filter.evaluation.selection import Selection

PLAIN_DETECTOR = "SIFT-2000"
"""The detector of bundles whose name gives none."""

RAW, CROSS, RATIO_TESTED, CLEAN, LEARNED = "raw", "cross-check", "ratio-tested", "clean", "learned"
"""Families of lists, over which figures are averaged."""

VERIFIED_PX = 4.0  # COLMAP's default for the epipolar error of its geometric verification
MIN_VERIFIED = 8


@dataclass(frozen=True)
class ListKind:
    """What a user keeps of the matches.

    Attributes:
        name: of the rows of tables.
        family: one of the names above.
        selection: the test that the matches pass.
        verified: keep those of them within 4 px of a fundamental matrix (PoseLib, seed 0), and forget their ratios:
            what COLMAP's verification leaves, or another program that hands over clean matches. Fewer than eight are
            no list at all.
        baseline_selection: of a raw list, what baselines are given: without any test they are no baselines.
    """

    name: str
    family: str
    selection: Selection = Selection()
    verified: bool = False
    baseline_selection: Selection = Selection()

    def of(self, pair: ScenePair) -> ScenePair:
        """The pair with the list of this kind in the place of its matches."""
        kept = pair.take(np.flatnonzero(self.selection.apply(pair)))
        if not self.verified:
            return kept
        clean = kept.take(_near_one_geometry(kept))
        return replace(clean, attributes=replace(clean.attributes, ratio=None))

    def settings(self) -> str:
        """All that a list depends on besides the pair."""
        version = ""
        if self.verified:
            import poselib

            version = f", PoseLib {poselib.__version__}"
        return f"{self!r}{version}"


KINDS = {
    "raw": ListKind("raw", RAW, baseline_selection=Selection(mutual=True, max_ratio=0.9)),
    "cross": ListKind("cross-check", CROSS, Selection(mutual=True)),
    "ratio": ListKind("ratio 0.75", RATIO_TESTED, Selection(max_ratio=0.75)),
    "cross-ratio": ListKind("cross-check + ratio 0.8", RATIO_TESTED, Selection(mutual=True, max_ratio=0.8)),
    "clean": ListKind("clean", CLEAN, Selection(mutual=True, max_ratio=0.8), verified=True),
    "learned": ListKind("the matcher's own", LEARNED),
}
"""Kinds of lists by the words of the command line."""


def _near_one_geometry(pair: ScenePair) -> NDArray[np.intp]:
    """Rows of the matches within 4 px of PoseLib's fundamental matrix; none where there are fewer than eight."""
    import poselib

    if len(pair.points1) < MIN_VERIFIED:
        return np.zeros(0, dtype=np.intp)
    options = {"max_epipolar_error": VERIFIED_PX, "seed": 0}
    _, info = poselib.estimate_fundamental(pair.points1, pair.points2, options, {})
    rows = np.flatnonzero(np.asarray(info["inliers"], dtype=bool))
    return rows if len(rows) >= MIN_VERIFIED else rows[:0]


@dataclass(frozen=True)
class ListSource:
    """The pairs of a source with their matches reduced to one kind of list."""

    source: PairSource
    scene: str
    kind: ListKind

    @property
    def path(self) -> Path:
        return self.source.path

    @property
    def sha256(self) -> str:
        return hashlib.sha256(f"{self.source.sha256} {self.kind.settings()}".encode()).hexdigest()

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, index: int) -> ScenePair:
        return self.kind.of(self.source[index])

    def images(self, pair: ScenePair) -> tuple[Image, Image] | None:
        return self.source.images(pair)


@dataclass(frozen=True)
class DetectorScene:
    """Chosen pairs of the bundle ``scene.detector.npz``: ascending ``indices`` into its source."""

    source: PairSource
    scene: str
    detector: str
    indices: tuple[int, ...]

    @property
    def learned(self) -> bool:
        """Whether the matcher scored its matches: there is one kind of list then, its own."""
        for index in self.indices:
            with suppress(DatasetError):  # a pair that cannot be read fails every method later
                return self.source[index].match_scores is not None
        return False

    def lists(self, kind: ListKind) -> SceneSelection | None:
        """The pairs as lists of a kind; None where the matcher does not leave lists of that kind."""
        if self.learned != (kind.family == LEARNED):
            return None
        return SceneSelection(ListSource(self.source, self.scene, kind), self.indices)


def open_detector_scenes(
    paths: Sequence[str | Path],
    detectors: Collection[str] | None = None,
    scenes: Collection[str] | None = None,
    per_scene: int | None = None,
    seed: int = 0,
    gaps: Collection[int] | None = None,
) -> list[DetectorScene]:
    """The bundles of folders or files, by what their names say: ``scene.detector.npz``, or ``scene.npz`` of SIFT.

    Args:
        paths: folders of bundles, or bundles.
        detectors, scenes: keep these alone; None keeps all.
        per_scene, seed: as in :func:`mgca_filter.evaluation.pairs.draw_indices`; bundles of one scene that hold equally
            many pairs keep the same ones.
        gaps: keep pairs whose images are so many frames apart (:func:`frame_gap`); None keeps all.

    Raises:
        DatasetError: a path holds no bundle, one is broken, a name that is wanted is not there, or nothing is left.
    """
    found = []
    for source in open_sources(paths):
        scene, detector = scene_and_detector(source.scene)
        indices: Sequence[int] = range(len(source))
        if gaps is not None:
            indices = [i for i in indices if (one := source[i]) and frame_gap(one.image1, one.image2) in gaps]
        drawn = tuple(indices[i] for i in draw_indices(len(indices), scene, per_scene, seed))
        found.append(DetectorScene(source, scene, detector or PLAIN_DETECTOR, drawn))
    for what, wanted in (("detector", detectors), ("scene", scenes)):
        absent = sorted(set(wanted or ()) - {getattr(one, what) for one in found})
        if absent:
            raise DatasetError(f"{', '.join(map(str, paths))}: no {what} named {', '.join(absent)}")
    kept = [
        one
        for one in found
        if one.indices and (detectors is None or one.detector in detectors) and (scenes is None or one.scene in scenes)
    ]
    if not kept:
        raise DatasetError(f"{', '.join(map(str, paths))}: no pair left")
    return kept


def frame_gap(image1: str, image2: str) -> int | None:
    """How many frames two images of a sequence are apart, by the last number in names that are equal otherwise."""
    parts = [re.fullmatch(r"(.*?)(\d+)(\D*)", Path(name).name) for name in (image1, image2)]
    if parts[0] is None or parts[1] is None or parts[0][1] != parts[1][1] or parts[0][3] != parts[1][3]:
        return None
    return abs(int(parts[1][2]) - int(parts[0][2]))
