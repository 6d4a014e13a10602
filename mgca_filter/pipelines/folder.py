"""A folder of images in; a COLMAP database, hloc's files or JSON lines out."""

from __future__ import annotations

import json
import shutil
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..features import DEFAULT_DETECTOR, DEFAULT_FEATURE_COUNT, ImageFeatures
from ..images import intrinsics_as_shown, principal_point_doubt, size_of_intrinsics
from ..input_file import read_text
from .feature_cache import FeatureCache
from .journal import Journal, PipelineError, output_file
from .run import Report, Summary, Workers, run_identity, run_pairs, work_folder
from .stored_pixels import stored_features, stored_row
from .worker import PairRow, Unusable

ReadFeatures = Callable[[str], ImageFeatures | None]
SUFFIXES = frozenset((".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".ppm", ".pgm", ".jp2"))
# Kinds of output, and the module that writing one needs.
OUTPUTS = {".db": "pycolmap", ".h5": "h5py", ".jsonl": "json"}


def list_images(folder: Path) -> list[str]:
    """Paths of the images below ``folder``, relative to it, with "/", sorted.

    Raises:
        PipelineError: no such folder, or no images in it.
    """
    if not folder.is_dir():
        raise PipelineError(f"{folder}: no such folder")
    files = (path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
    names = sorted(path.relative_to(folder).as_posix() for path in files)
    if not names:
        raise PipelineError(f"{folder}: no images ({', '.join(sorted(SUFFIXES))})")
    return names


def exhaustive_pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    """Every image with every other."""
    return list(combinations(names, 2))


def sequential_pairs(names: Sequence[str], overlap: int) -> list[tuple[str, str]]:
    """Every image with the ``overlap`` next ones."""
    return [(name, later) for k, name in enumerate(names) for later in names[k + 1 : k + 1 + overlap]]


def read_pairs(path: Path, names: Sequence[str], folder: Path) -> list[tuple[str, str]]:
    """Pairs of a text file, one a line: two names, separated by a tab (for names with spaces) or by blanks.

    Empty lines and lines that begin with # are skipped, pairs that are there before in either order too.

    Raises:
        PipelineError: the file cannot be read, a line has not two names, or names an image that ``names`` lacks.
    """
    try:
        lines = read_text(path, may_be_empty=True).splitlines()
    except (OSError, ValueError) as error:
        raise PipelineError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    # A name as another system writes it: with its separators, from "./" on, or its accents apart.
    known = {_plain(name): name for name in names} | {name: name for name in names}
    pairs = dict[frozenset[str], tuple[str, str]]()
    for number, line in enumerate(lines, 1):
        words = [word.strip() for word in line.split("\t")] if "\t" in line else line.split()
        if not words or words[0].startswith("#"):
            continue
        found = [known.get(word) or known.get(_plain(word)) for word in words]
        if len(words) != 2 or words[0] == words[1] or (found[0] == found[1] and None not in found):
            raise PipelineError(f"{path}:{number}: expected two names of images, got {line.strip()!r}")
        for word, name in zip(words, found):
            if name is None:
                raise PipelineError(f"{path}:{number}: {word} is not in {folder}")
        words = [name for name in found if name is not None]
        pairs.setdefault(frozenset(words), (words[0], words[1]))
    return list(pairs.values())


def _plain(name: str) -> str:
    return unicodedata.normalize("NFC", name.replace("\\", "/").removeprefix("./"))


@dataclass(frozen=True)
class FolderSource:
    """Pairs of images whose features lie in a cache; everything is in pixels of the images as they are shown.

    Attributes:
        K: (3, 3) intrinsics of the images of ``K_size`` (width, height), as they are shown or as they are stored; all
            others are matched without; or None.
        exif: without ``K``, take the intrinsics that the EXIF of each image gives.
    """

    cache: FeatureCache
    pair_names: Sequence[tuple[str, str]]
    K: NDArray[np.float64] | None = None
    K_size: tuple[int, int] | None = None
    exif: bool = True

    def pairs(self) -> Sequence[tuple[str, str]]:
        """Names of the images, relative to their folder."""
        return self.pair_names

    def features(self, name: str) -> ImageFeatures | None:
        """Features from the cache, with the intrinsics that the image is matched with."""
        features, shape = self.cache.read(name), self.cache.shape(name)
        if features is None or shape is None:
            return None
        if self.K is None:
            return features if self.exif else replace(features, K=None)
        return replace(features, K=None if self.K_size is None else intrinsics_as_shown(self.K, self.K_size, *shape))

    def stored(self, name: str) -> ImageFeatures | None:
        """The same in the pixels of the file."""
        features, shape = self.features(name), self.cache.shape(name)
        return None if features is None or shape is None else stored_features(features, shape[1])

    def stored_rows(self, rows: Iterable[PairRow]) -> Iterator[PairRow]:
        """Rows of pairs between the pixels of the files."""
        return (stored_row(row, self.cache.shape(row.name1), self.cache.shape(row.name2)) for row in rows)

    def image(self, name: str) -> ImageFeatures | Unusable:
        """The features, or why there are none."""
        features = self.features(name)
        return Unusable(f"{name}: no features, the image cannot be read") if features is None else features

    def matches(self, name1: str, name2: str) -> None:
        """None: nearest neighbours of the descriptors."""


def camera_size(
    K: NDArray[np.float64], shapes: Mapping[str, tuple[tuple[int, int], int]]
) -> tuple[tuple[int, int] | None, list[str]]:
    """The size (width, height) that one K (3, 3) is taken to belong to, the commonest of the images', and what is odd.

    Args:
        shapes: (width, height) as it is shown, and EXIF orientation, of each image by name.

    Returns:
        The size, None without images; and lines that name the images of other sizes, and say where the principal point
        is far from the middle.
    """
    size = size_of_intrinsics(K, shapes.values())
    if size is None:
        return None, []
    doubts = []
    others = sorted(name for name, shape in shapes.items() if intrinsics_as_shown(K, size, *shape) is None)
    if others:
        few = ", ".join(f"{name} ({shapes[name][0][0]} x {shapes[name][0][1]})" for name in others[:3])
        more = f" and {len(others) - 3} more" if len(others) > 3 else ""
        doubts.append(f"one K is that of one size, here {size[0]} x {size[1]}: matched without it: {few}{more}")
    far = principal_point_doubt(K, size)
    return size, doubts if far is None else [*doubts, far]


@dataclass(frozen=True)
class FolderJob:
    """Images in, matches out: COLMAP's and hloc's in pixels of the files, JSON lines in pixels as EXIF has them shown.

    Attributes:
        images: the folder. pairs: names of images, relative to it.
        output: ``.db`` (COLMAP), ``.h5`` (hloc's matches; its features lie beside it as ``NAME.features.h5``) or
            ``.jsonl`` (one object per pair).
        K: (3, 3) intrinsics of the images, in pixels, as they are shown or as they are stored, or None: they are those
            of ``exif``, or guessed. Images of another size than most are matched without.
        detector, max_keypoints: as in :func:`mgca_filter.match_images`.
        cache: folder that keeps the features for other runs, or None: beside the output until the run is done.
        report: an HTML report of the run, or None.
        exif: without ``K``, take the focal length that the EXIF of each image gives.
    """

    images: Path
    pairs: Sequence[tuple[str, str]]
    output: Path
    K: NDArray[np.float64] | None = None
    detector: str = DEFAULT_DETECTOR
    max_keypoints: int = DEFAULT_FEATURE_COUNT
    cache: Path | None = None
    report: Report | None = None
    exif: bool = True

    def run(self, workers: Workers, filter_options: dict[str, Any], quiet: bool = False) -> Summary:
        """Extract what the cache lacks, filter all pairs, write the output; a killed run goes on where it stopped.

        Raises:
            PipelineError: the output cannot be written.
        """
        work = work_folder(self.output)
        journal = Journal(work / "journal.log")
        features = {"detector": self.detector, "max_keypoints": self.max_keypoints}
        camera = {"K": None if self.K is None else self.K.tolist(), "exif": self.exif}
        try:
            folder = {"images": str(self.images.resolve())}
            journal.begin({**folder, **features, **camera, **run_identity(filter_options)})
            cache = FeatureCache(self.cache or work / "features", self.images, self.detector, self.max_keypoints)
            names = sorted({name for pair in self.pairs for name in pair})
            cache.fill(names, workers, quiet)
            source, doubts = self._source(cache, names)
            summary = run_pairs(source, workers, journal, quiet)
            self._write(names, source, self._rows(journal))
            if self.report is not None:
                self.report.write(self._rows(journal))
        finally:
            journal.close()
        shutil.rmtree(work)
        return replace(summary, doubts=doubts)

    def _source(self, cache: FeatureCache, names: Sequence[str]) -> tuple[FolderSource, list[str]]:
        """The pairs with their intrinsics, and what is odd about these."""
        if self.K is None:
            return FolderSource(cache, self.pairs, exif=self.exif), []
        shapes = {name: shape for name in names if (shape := cache.shape(name)) is not None}
        size, doubts = camera_size(self.K, shapes)
        return FolderSource(cache, self.pairs, self.K, size), doubts

    def _rows(self, journal: Journal) -> Iterator[PairRow]:
        """Rows of the pairs that are asked for; a run that was killed may have been asked for others."""
        wanted = set(self.pairs)
        return (row for row in journal.rows() if (row.name1, row.name2) in wanted)

    def _write(self, names: Sequence[str], source: FolderSource, rows: Iterable[PairRow]) -> None:
        with output_file(self.output) as partial:
            if self.output.suffix == ".db":
                from .colmap import write_database

                camera_model = "SIMPLE_RADIAL" if self.K is None else "PINHOLE"
                write_database(partial, names, source.stored, source.stored_rows(rows), camera_model)
            elif self.output.suffix == ".h5":
                from .hloc import write_features, write_matches

                with output_file(self.output.with_suffix(".features.h5")) as partial_features:
                    write_features(partial_features, names, source.stored)
                write_matches(partial, source.stored, rows)
            else:
                write_json_lines(partial, source.features, rows)


def write_json_lines(path: Path, read: ReadFeatures, rows: Iterable[PairRow]) -> None:
    """One JSON object per pair, in the order of the names.

    Keys: ``image1``, ``image2``, ``status``, ``num_matches``, ``num_inliers``, ``calibrated``, ``confidence``,
    ``verified`` (the kept matches may be used, whatever the pose is worth), ``E``, ``F``, ``H``, ``R``, ``t`` (null
    where there is none; X2 = R X1 + t), ``points1``, ``points2`` (K, 2) pixels and ``scores`` (K,) of the kept matches,
    ``message`` for a pair that failed. Pixels, and the geometry between them, are those of the photographs as their
    EXIF says that they are to be shown.
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
            "confidence": row.confidence,
            "verified": row.verified,
            **{name: None if matrix is None else matrix.tolist() for name, matrix in matrices.items()},
            "points1": [] if image1 is None else image1.points[row.kept[:, 0]].tolist(),
            "points2": [] if image2 is None else image2.points[row.kept[:, 1]].tolist(),
            "scores": row.scores.tolist(),
            "message": row.message,
        }
