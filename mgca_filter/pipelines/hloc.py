"""hloc's files: ``features.h5`` and ``matches.h5`` in, a filtered ``matches.h5`` out; or new ones from features and
rows.

Layout (hloc/utils/io.py and parsers.py): features lie in one group per image name, with ``keypoints`` (N, 2) in
OpenCV's pixels and, as the extractor gives them, ``descriptors`` (D, N), ``scales``, ``oris`` (degrees) and
``image_size``; matches in one group per pair, ``name1/name2`` (or ``name1_name2`` from old versions) with every "/" of
a name turned into "-", with ``matches0`` (N1,), −1 = none, and ``matching_scores0`` (N1,).
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ..features import ImageFeatures
from .journal import Journal, PipelineError, file_stamp, output_file
from .run import Report, Summary, Workers, run_identity, run_pairs, work_folder
from .worker import FAILED, PairRow, Unusable

_SIFT_LENGTH = 128


@dataclass(frozen=True)
class HlocJob:
    """Features and matches in, filtered matches out.

    Attributes:
        features, matches: hloc's files, only read.
        output: gets what ``matches`` holds, with −1 and score 0 where a match is dropped.
        use_descriptors: compute each match's distance ratio where the features are SIFT's.
        report: an HTML report of the run, or None.
    """

    features: Path
    matches: Path
    output: Path
    use_descriptors: bool = True
    report: Report | None = None

    def run(self, workers: Workers, filter_options: dict[str, Any], quiet: bool = False) -> Summary:
        """Filter all pairs, write the output; a killed run goes on where it stopped.

        Raises:
            PipelineError: a file is missing, broken or locked, an image has no features, or the disk is full.
        """
        with opened(self.features) as features, opened(self.matches) as matches:
            source = HlocSource(features, matches, self.use_descriptors)
            work = work_folder(self.output)
            inputs = {str(path.resolve()): file_stamp(path) for path in (self.features, self.matches)}
            journal = Journal(work / "journal.log")
            try:
                journal.begin({"inputs": inputs, "descriptors": self.use_descriptors, **run_identity(filter_options)})
                summary = run_pairs(source, workers, journal, quiet)
                with output_file(self.output) as partial:
                    shutil.copyfile(self.matches, partial)
                    with h5py.File(partial, "r+") as filtered:
                        drop_matches(filtered, source.groups, journal.rows())
                if self.report is not None:
                    self.report.write(journal.rows())
            finally:
                journal.close()
        shutil.rmtree(work)
        return summary


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """``h5py.File`` for reading.

    Raises:
        PipelineError: the file is missing, broken, or locked by a process that writes it.
    """
    try:
        file = h5py.File(path, "r")
    except FileNotFoundError as error:
        raise PipelineError(f"{path}: no such file") from error
    except OSError as error:
        locked = "lock" in str(error)
        words = "locked by another process" if locked else f"not an HDF5 file, or a broken one ({error})"
        raise PipelineError(f"{path}: {words}") from error
    with file:
        yield file


class HlocSource:
    """The pairs of an open matches file.

    Attributes:
        groups: name of the group of each pair (name1, name2), in the file's own order and layout.

    Raises:
        PipelineError: a pair names an image without features, or two images have the same name in pairs.
    """

    def __init__(self, features: Any, matches: Any, use_descriptors: bool) -> None:
        self._features, self._matches = features, matches
        self._use_descriptors = use_descriptors
        names: dict[str, str] = {}
        for name in _parents_of(features, "keypoints"):
            if names.setdefault(name.replace("/", "-"), name) != name:
                raise PipelineError(
                    f"{features.filename}: {name} and {names[name.replace('/', '-')]} cannot be told apart"
                )
        self.groups: dict[tuple[str, str], str] = {}
        # The new layout has a "/" in the group's name and wins, as it does in hloc.
        for group in sorted(_parents_of(matches, "matches0"), key=lambda g: "/" not in g):
            self.groups.setdefault(_image_names(group, names, matches.filename, features.filename), group)

    def pairs(self) -> Sequence[tuple[str, str]]:
        """Names of the images in the order of the pair's group."""
        return sorted(self.groups)

    def image(self, name: str) -> ImageFeatures | Unusable:
        """Features of an image; descriptors where they are SIFT's, which come with scale and orientation."""
        try:
            return self._image(self._features[name])
        except (OSError, ValueError, TypeError) as error:
            return Unusable(f"{self._features.filename}: {name} cannot be read ({' '.join(str(error).split())})")

    def _image(self, group: Any) -> ImageFeatures:
        points = group["keypoints"][()].astype(np.float64)
        scale, angle = (group[key][()] if key in group else None for key in ("scales", "oris"))
        descriptors = None
        if self._use_descriptors and scale is not None and angle is not None and "descriptors" in group:
            is_sift = group["descriptors"].shape == (_SIFT_LENGTH, len(points))
            descriptors = np.ascontiguousarray(group["descriptors"][()].T) if is_sift else None
        size = None if scale is None else 2.0 * scale
        angle = None if angle is None else angle % 360.0
        image_size = tuple(int(side) for side in group["image_size"][()]) if "image_size" in group else None
        return ImageFeatures(points, size, angle, descriptors, None, image_size)  # type: ignore[arg-type]

    def matches(self, name1: str, name2: str) -> NDArray[Any] | Unusable:
        """Matches (M, 2) of a pair."""
        group = self.groups[name1, name2]
        try:
            partner = self._matches[group]["matches0"][()]
        except OSError as error:
            return Unusable(f"{self._matches.filename}: {group} cannot be read ({' '.join(str(error).split())})")
        rows = np.flatnonzero(partner > -1)
        return np.stack([rows, partner[rows].astype(np.intp)], axis=1)


def _parents_of(file: Any, dataset: str) -> list[str]:
    """Names of the groups that hold a dataset of that name, sorted."""
    found: list[str] = []

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and name.rpartition("/")[2] == dataset:
            found.append(name.rpartition("/")[0])

    file.visititems(visit)
    return sorted(found)


def _image_names(group: str, names: dict[str, str], matches_file: str, features_file: str) -> tuple[str, str]:
    """The two images of a group of matches, in either layout."""
    separator = "/" if "/" in group else "_"
    cuts = [k for k, letter in enumerate(group) if letter == separator]
    found = [(group[:k], group[k + 1 :]) for k in cuts if group[:k] in names and group[k + 1 :] in names]
    if len(found) != 1:
        reason = "names an image that is not in" if not found else "can be read as several pairs of"
        raise PipelineError(f"{matches_file}: {group} {reason} {features_file}")
    return names[found[0][0]], names[found[0][1]]


def drop_matches(matches: Any, groups: dict[tuple[str, str], str], rows: Iterable[PairRow]) -> None:
    """Set the matches of an open file that a row does not keep to −1 and their scores to 0; the others stay."""
    for row in rows:
        group = matches[groups[row.name1, row.name2]]
        partner = group["matches0"][()]
        dropped = np.ones(len(partner), dtype=bool)
        dropped[row.kept[:, 0]] = False
        group["matches0"][...] = np.where(dropped, -1, partner).astype(partner.dtype)
        if "matching_scores0" in group:
            scores = group["matching_scores0"][()]
            group["matching_scores0"][...] = np.where(dropped, 0, scores).astype(scores.dtype)


def write_features(path: Path, names: Sequence[str], read: Callable[[str], ImageFeatures | None]) -> None:
    """Keypoints, scales, orientations (degrees), descriptors and image size of each image that has features."""
    with h5py.File(path, "w") as file:
        for name in names:
            image = read(name)
            if image is None or image.size is None or image.angle is None or image.descriptors is None:
                continue
            group = file.create_group(name)
            group["keypoints"] = image.points.astype(np.float32)
            group["scales"], group["oris"] = image.size / 2, image.angle
            group["descriptors"] = np.ascontiguousarray(image.descriptors.T)
            group["image_size"] = np.array(image.image_size)


def write_matches(path: Path, read: Callable[[str], ImageFeatures | None], rows: Iterable[PairRow]) -> None:
    """Kept matches and their scores of each pair, in the new layout; failed pairs are left out."""
    with h5py.File(path, "w") as file:
        for row in rows:
            image = None if row.status == FAILED else read(row.name1)
            if image is None:
                continue
            count = len(image.points)
            partner, scores = np.full(count, -1, np.int32), np.zeros(count, np.float16)
            partner[row.kept[:, 0]] = row.kept[:, 1]
            scores[row.kept[:, 0]] = row.scores
            group = file.create_group("/".join(name.replace("/", "-") for name in (row.name1, row.name2)))
            group["matches0"], group["matching_scores0"] = partner, scores
