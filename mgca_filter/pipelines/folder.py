"""A folder of images in; a COLMAP database, hloc's files or JSON lines out."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .engines import Engine
from .feature_cache import FeatureCache
from .journal import Journal, output_file
from .run import Summary, run_identity, run_pairs, work_folder
from .worker import ImageFeatures, PairRow

ReadFeatures = Callable[[str], ImageFeatures | None]
# Kinds of output, and the module that writing one needs.
OUTPUTS = {".db": "pycolmap", ".h5": "h5py", ".jsonl": "json"}


@dataclass(frozen=True)
class FolderSource:
    """Pairs of images whose features lie in a cache; one camera for all images, or none."""

    cache: FeatureCache
    pair_names: Sequence[tuple[str, str]]
    K: NDArray[np.float64] | None

    def pairs(self) -> Sequence[tuple[str, str]]:
        """Names of the images, relative to their folder."""
        return self.pair_names

    def image(self, name: str) -> ImageFeatures | None:
        """Features from the cache; None for an image that could not be read."""
        features = self.cache.read(name)
        return None if features is None else replace(features, K=self.K)

    def matches(self, name1: str, name2: str) -> None:
        """None: nearest neighbours of the descriptors."""


@dataclass(frozen=True)
class FolderJob:
    """Images in, matches out.

    Attributes:
        images: the folder. pairs: names of images, relative to it.
        output: ``.db`` (COLMAP), ``.h5`` (hloc's matches; its features lie beside it as ``NAME.features.h5``) or
            ``.jsonl`` (one object per pair).
        K: (3, 3) intrinsics that all images share, in pixels, or None: the focal length is guessed.
        detector, max_keypoints: as in :func:`mgca_filter.match_images`.
        cache: folder that keeps the features for other runs, or None: beside the output until the run is done.
    """

    images: Path
    pairs: Sequence[tuple[str, str]]
    output: Path
    K: NDArray[np.float64] | None = None
    detector: str = "sift"
    max_keypoints: int = 2000
    cache: Path | None = None

    def run(self, engine: Engine, filter_options: dict[str, Any], quiet: bool = False) -> Summary:
        """Extract what the cache lacks, filter all pairs, write the output; a killed run goes on where it stopped.

        Raises:
            PipelineError: the output cannot be written.
        """
        work = work_folder(self.output)
        journal = Journal(work / "journal.db")
        features = {"detector": self.detector, "max_keypoints": self.max_keypoints}
        camera = {"K": None if self.K is None else self.K.tolist()}
        try:
            folder = {"images": str(self.images.resolve())}
            journal.begin({**folder, **features, **camera, **run_identity(filter_options)})
            cache = FeatureCache(self.cache or work / "features", self.images, self.detector, self.max_keypoints)
            names = sorted({name for pair in self.pairs for name in pair})
            cache.fill(names, engine, quiet)
            summary = run_pairs(FolderSource(cache, self.pairs, self.K), engine, journal, quiet)
            self._write(names, cache.read, journal)
        finally:
            journal.close()
        shutil.rmtree(work)
        return summary

    def _write(self, names: Sequence[str], read: ReadFeatures, journal: Journal) -> None:
        wanted = set(self.pairs)
        rows = (row for row in journal.rows() if (row.name1, row.name2) in wanted)
        with output_file(self.output) as partial:
            if self.output.suffix == ".db":
                from .colmap_writer import write_database

                write_database(partial, names, read, rows, self.K)
            elif self.output.suffix == ".h5":
                from .hloc_writer import write_features, write_matches

                with output_file(self.output.with_suffix(".features.h5")) as partial_features:
                    write_features(partial_features, names, read)
                write_matches(partial, read, rows)
            else:
                write_json_lines(partial, read, rows)


def write_json_lines(path: Path, read: ReadFeatures, rows: Iterable[PairRow]) -> None:
    """One JSON object per pair, in the order of the names.

    Keys: ``image1``, ``image2``, ``status``, ``num_matches``, ``num_inliers``, ``calibrated``, ``E``, ``F``, ``H``,
    ``R``, ``t`` (null where there is none; X2 = R X1 + t), ``points1``, ``points2`` (K, 2) pixels and ``scores`` (K,)
    of the kept matches, ``message`` for a pair that failed.
    """
    with path.open("w", encoding="utf-8") as file:
        file.writelines(json.dumps(document, allow_nan=False) + "\n" for document in _documents(read, rows))


def _documents(read: ReadFeatures, rows: Iterable[PairRow]) -> Iterator[dict[str, Any]]:
    for row in rows:
        image1, image2 = (read(row.name1), read(row.name2)) if len(row.kept) else (None, None)
        matrices = {name: getattr(row, name) for name in ("E", "F", "H", "R", "t")}
        yield {
            "image1": row.name1,
            "image2": row.name2,
            "status": row.status,
            "num_matches": row.num_matches,
            "num_inliers": len(row.kept),
            "calibrated": row.calibrated,
            **{name: None if matrix is None else matrix.tolist() for name, matrix in matrices.items()},
            "points1": [] if image1 is None else image1.points[row.kept[:, 0]].tolist(),
            "points2": [] if image2 is None else image2.points[row.kept[:, 1]].tolist(),
            "scores": row.scores.tolist(),
            "message": row.message,
        }
