"""Scene bundles, read and written: keypoints, one-way matches and true poses of a photographed scene in an ``.npz``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..atomic_file import replaced_when_done
from ..errors import BundleError
from ..features import ImageFeatures, OneWayMatches
from ..geometry.cameras import normalize_points
from ..geometry.epipolar import essential_from_pose
from ..inputs.attributes import MatchAttributes

_FIELDS = (
    *("image_name", "image_size", "K", "R", "t"),
    *("keypoint_offset", "keypoint_xy", "keypoint_size", "keypoint_angle"),
    *("pair", "match_offset", "match_index", "covisible"),
)
_NEIGHBOUR_FIELDS = ("match_ratio", "match_mutual", "match_best")
_LEARNED_FIELDS = ("match_query", "match_score")
"""What a learned matcher tells, in the place of nearest neighbours' fields: it leaves keypoints out and scores its own
matches (LightGlue, Lindenberger et al., ICCV 2023)."""
LABEL_FIELD = "match_label"
"""Optional field: labels (ΣM,) int8 of all matches, for bundles that know them better than poses tell."""
SHAPE_FIELD = "has_size_angle"
"""Optional field: False where the detector gives keypoints neither size nor angle."""
ANGLE_UNITS = 256  # of a full turn, to fit a byte


@dataclass(frozen=True)
class ScenePair:
    """Two images of a scene, their raw one-way matches and the true relative pose (X2 = R X1 + t).

    ``points1``, ``points2`` are undistorted pixels (M, 2) under ``K1``, ``K2``; ``mutual`` (M,) marks two-way
    nearest neighbours; ``t`` (3,) has the scene's unknown scale; ``labels`` (M,) int8 (1 = right, 0 = wrong, −1 = left
    out) where the data know them better than the pose tells, else None; ``match_scores`` (M,) float32, 0 … 1, where the
    matcher scored its matches, else None.
    """

    scene: str
    index: int
    image1: str
    image2: str
    points1: NDArray[np.float64]
    points2: NDArray[np.float64]
    K1: NDArray[np.float64]
    K2: NDArray[np.float64]
    image_size1: tuple[int, int]
    image_size2: tuple[int, int]
    R: NDArray[np.float64]
    t: NDArray[np.float64]
    attributes: MatchAttributes
    mutual: NDArray[np.bool_]
    labels: NDArray[np.int8] | None = None
    match_scores: NDArray[np.float32] | None = None

    @property
    def name(self) -> str:
        """``scene/index``, unique in a folder of bundles."""
        return f"{self.scene}/{self.index}"

    @property
    def order(self) -> NDArray[np.float32] | None:
        """What tells promising matches (M,) from others, ascending: the ratio, else 1 − score, else None."""
        if self.attributes.ratio is not None or self.match_scores is None:
            return self.attributes.ratio
        return np.float32(1.0) - self.match_scores

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> ScenePair:
        """The pair with a selection of its matches, in the order of ``rows``."""
        return replace(
            self,
            points1=self.points1[rows],
            points2=self.points2[rows],
            attributes=self.attributes.take(rows),
            mutual=self.mutual[rows],
            labels=None if self.labels is None else self.labels[rows],
            match_scores=None if self.match_scores is None else self.match_scores[rows],
        )

    @cached_property
    def correspondences(self) -> NDArray[np.float64]:
        """(M, 4) on the normalised image planes."""
        return np.hstack([normalize_points(self.points1, self.K1), normalize_points(self.points2, self.K2)])

    @cached_property
    def E(self) -> NDArray[np.float64]:
        """True essential matrix (3, 3) of unit Frobenius norm."""
        return essential_from_pose(self.R, self.t)


class SceneBundle:
    """One bundle in memory; ``len`` is its number of pairs, indexing gives a :class:`ScenePair`.

    Raises:
        BundleError: the file cannot be read, lacks a field, or holds poses or offsets that cannot be.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.scene = self.path.stem
        try:
            with np.load(self.path, allow_pickle=False) as data:
                self.learned = any(field in data.files for field in _LEARNED_FIELDS)
                needed = (*_FIELDS, *(_LEARNED_FIELDS if self.learned else _NEIGHBOUR_FIELDS))
                missing = [field for field in needed if field not in data.files]
                if missing:
                    raise BundleError(f"{self.path}: not a scene bundle, fields missing: {', '.join(missing)}")
                optional = [field for field in (LABEL_FIELD, SHAPE_FIELD) if field in data.files]
                self._data = {field: data[field] for field in (*needed, *optional)}
        except BundleError:
            raise
        except Exception as error:  # zipfile, zlib, numpy and the system each have their own
            raise BundleError(f"{self.path}: cannot be read as a scene bundle ({error})") from error
        self._check_shapes()
        count = int(self._data["match_offset"][-1])
        for field in self._packed_fields:
            self._data[field] = np.unpackbits(self._data[field], count=count).astype(bool)
        self._check_values()

    @property
    def photographs(self) -> str:
        """The scene without its detector: bundles ``lounge`` and ``lounge.orb2k`` are made of the same photographs."""
        return scene_and_detector(self.scene)[0]

    @property
    def _packed_fields(self) -> tuple[str, ...]:
        return () if self.learned else ("match_mutual", "match_best")

    def _check_shapes(self) -> None:
        d = self._data
        images, pairs = (len(np.atleast_1d(d[field])) for field in ("R", "pair"))
        shapes: dict[str, tuple[int, ...]] = {
            "image_name": (images,),
            "image_size": (images, 2),
            "K": (images, 3, 3),
            "R": (images, 3, 3),
            "t": (images, 3),
            "keypoint_offset": (images + 1,),
            "pair": (pairs, 2),
            "match_offset": (pairs + 1,),
        }
        for field, shape in shapes.items():
            if d[field].shape != shape:
                raise BundleError(f"{self.path}: {field} has the shape {d[field].shape} instead of {shape}")
        for field in ("keypoint_offset", "match_offset"):
            offset = d[field].astype(np.int64)
            if offset[0] != 0 or (np.diff(offset) < 0).any():
                raise BundleError(f"{self.path}: {field} does not rise from 0")
        keypoints, matches = (int(d[field][-1]) for field in ("keypoint_offset", "match_offset"))
        lengths: dict[str, tuple[int, ...]] = {
            "keypoint_xy": (keypoints, 2),
            "keypoint_size": (keypoints,),
            "keypoint_angle": (keypoints,),
            "match_index": (matches,),
            "match_ratio": (matches,),
            "match_mutual": ((matches + 7) // 8,),
            "match_best": ((matches + 7) // 8,),
            "match_query": (matches,),
            "match_score": (matches,),
            LABEL_FIELD: (matches,),
            SHAPE_FIELD: (),
        }
        for field, shape in lengths.items():
            if field in d and d[field].shape != shape:
                raise BundleError(f"{self.path}: {field} has the shape {d[field].shape}, its offsets promise {shape}")
        for field in self._packed_fields:
            if d[field].dtype != np.uint8:
                raise BundleError(f"{self.path}: {field} is not packed into bytes (np.packbits)")

    def _check_values(self) -> None:
        d = self._data
        if len(d["pair"]) and not 0 <= int(d["pair"].min()) <= int(d["pair"].max()) < len(d["R"]):
            raise BundleError(f"{self.path}: pair names an image that is not there")
        for field in ("K", "R", "t", "keypoint_xy"):
            if not np.isfinite(d[field]).all():
                raise BundleError(f"{self.path}: {field} holds NaN or infinite values")
        eye = d["R"] @ np.transpose(d["R"], (0, 2, 1))
        if len(eye) and (np.abs(eye - np.eye(3)).max() > 1e-4 or np.linalg.det(d["R"]).min() < 0):
            raise BundleError(f"{self.path}: R holds a matrix that is not a rotation")

    def check_training_pairs(self) -> None:
        """Refuse pairs that have no epipolar geometry or share nothing: training would learn from them.

        Raises:
            BundleError: two images of a pair have the same centre, or ``covisible`` says that they do not overlap.
        """
        pair, R, t = (self._data[field] for field in ("pair", "R", "t"))
        centres = -np.einsum("nji,nj->ni", R, t)
        baseline = np.linalg.norm(centres[pair[:, 0]] - centres[pair[:, 1]], axis=1)
        one_centre = baseline <= 1e-9 * (1.0 + np.linalg.norm(centres, axis=1).max(initial=0.0))
        for field, wrong, meaning in (
            ("t", one_centre, "both images have one centre"),
            ("covisible", self._data["covisible"] == 0, "the images share nothing"),
        ):
            if wrong.any():
                raise BundleError(f"{self.path}: {field}: pair {int(np.flatnonzero(wrong)[0])}: {meaning}")

    def match_counts(self) -> NDArray[np.int64]:
        """Number of raw matches of each pair (P,)."""
        counts: NDArray[np.int64] = np.diff(self._data["match_offset"].astype(np.int64))
        return counts

    def __len__(self) -> int:
        return len(self._data["pair"])

    def __getitem__(self, index: int) -> ScenePair:
        d = self._data
        if not 0 <= index < len(self):
            raise IndexError(f"{self.path}: pair {index} of {len(self)}")
        i, j = (int(v) for v in d["pair"][index])
        rows = slice(int(d["match_offset"][index]), int(d["match_offset"][index + 1]))
        query = d["match_query"][rows].astype(np.int64) if self.learned else np.arange(rows.stop - rows.start)
        k1 = int(d["keypoint_offset"][i]) + query
        k2 = int(d["keypoint_offset"][j]) + d["match_index"][rows].astype(np.int64)
        for field, reached, image in (("match_query", k1, i), ("match_index", k2, j)):
            if len(reached) and reached.max() >= d["keypoint_offset"][image + 1]:
                named = field if self.learned else "match_index"
                raise BundleError(f"{self.path}: {named} of pair {index} names a keypoint that is not there")
        R = d["R"][j] @ d["R"][i].T
        return ScenePair(
            scene=self.scene,
            index=index,
            image1=str(d["image_name"][i]),
            image2=str(d["image_name"][j]),
            points1=d["keypoint_xy"][k1].astype(np.float64),
            points2=d["keypoint_xy"][k2].astype(np.float64),
            K1=d["K"][i],
            K2=d["K"][j],
            image_size1=(int(d["image_size"][i][0]), int(d["image_size"][i][1])),
            image_size2=(int(d["image_size"][j][0]), int(d["image_size"][j][1])),
            R=R,
            t=d["t"][j] - R @ d["t"][i],
            attributes=self._attributes(rows, k1, k2),
            # A learned matcher gives each keypoint one partner at most.
            mutual=np.ones(len(k1), dtype=bool) if self.learned else d["match_mutual"][rows],
            labels=np.asarray(d[LABEL_FIELD][rows], dtype=np.int8) if LABEL_FIELD in d else None,
            match_scores=d["match_score"][rows].astype(np.float32) / np.float32(255.0) if self.learned else None,
        )

    def _attributes(self, rows: slice, k1: NDArray[np.int64], k2: NDArray[np.int64]) -> MatchAttributes:
        """What is known of the matches ``rows`` from keypoints ``k1`` (M,) to ``k2`` (M,)."""
        d, known = self._data, MatchAttributes()
        if not self.learned:
            ratio = d["match_ratio"][rows].astype(np.float32) / np.float32(255.0)
            known = replace(known, ratio=ratio, best=d["match_best"][rows])
        if not d.get(SHAPE_FIELD, True):
            return known
        size, angle, degrees = d["keypoint_size"], d["keypoint_angle"], np.float32(360.0 / ANGLE_UNITS)
        return replace(
            known,
            size1=size[k1].astype(np.float32),
            size2=size[k2].astype(np.float32),
            angle1=angle[k1] * degrees,
            angle2=angle[k2] * degrees,
        )


def scene_and_detector(stem: str) -> tuple[str, str]:
    """What a bundle's name says, ``scene`` or ``scene.detector``; the detector is ``""`` where it says none."""
    scene, _, detector = stem.partition(".")
    return scene, detector


def load_scene_bundles(folder: str | Path) -> list[SceneBundle]:
    """All bundles of a folder in the order of their names (or the one file that ``folder`` names).

    Raises:
        BundleError: the path holds no ``.npz``, or one of them is broken.
    """
    return [SceneBundle(path) for path in bundle_files(Path(folder))]


def bundle_files(path: Path) -> list[Path]:
    """The bundle that ``path`` names, or those of a folder in the order of their names.

    Raises:
        BundleError: there is none.
    """
    files = [path] if path.is_file() else sorted(path.glob("*.npz"))
    if not files:
        raise BundleError(f"{path}: no scene bundle (.npz) found")
    return files


@dataclass(frozen=True)
class BundleImage:
    """A photograph with its pose, world → camera; its features hold camera, size and keypoints, free of distortion."""

    name: str
    features: ImageFeatures
    R: NDArray[np.float64]
    t: NDArray[np.float64]


@dataclass(frozen=True)
class BundlePair:
    """Matches from image ``first`` to image ``second``; ``covisible`` = shared 3-D points, −1 = not known."""

    first: int
    second: int
    matches: OneWayMatches
    covisible: int
    labels: NDArray[np.int8] | None = None


def write_bundle(path: Path, images: Sequence[BundleImage], pairs: Sequence[BundlePair]) -> None:
    """Write a bundle; a crash in the middle leaves no broken file behind.

    Raises:
        ValueError: there is no pair, an image holds more keypoints than 16 bits count, or lacks its camera, its size or
            what is known of its keypoints, or a match has no ratio.
    """
    if not pairs:
        raise ValueError(f"{path}: no pair to write")
    features = [image.features for image in images]
    if max(map(len, features)) > np.iinfo(np.uint16).max:
        raise ValueError(f"{path}: more than {np.iinfo(np.uint16).max} keypoints in an image")
    for image in images:
        missing = [name for name in ("K", "image_size", "size", "angle") if getattr(image.features, name) is None]
        if missing:
            raise ValueError(f"{path}: {image.name}: not known: {', '.join(missing)}")
    angle = np.concatenate([image.angle for image in features]).astype(np.float64)
    size = np.concatenate([image.size for image in features])
    ratio = np.concatenate([pair.matches.attributes.ratio for pair in pairs])
    if not np.isfinite(ratio).all():
        raise ValueError(f"{path}: a match has no ratio: its second image has fewer than two keypoints")
    fields: dict[str, NDArray[np.generic]] = {
        "image_name": np.array([image.name for image in images]),
        "image_size": np.array([image.image_size for image in features], dtype=np.int32),
        "K": np.array([image.K for image in features], dtype=np.float64),
        "R": np.array([image.R for image in images], dtype=np.float64),
        "t": np.array([image.t for image in images], dtype=np.float64),
        "keypoint_offset": _offsets([len(image) for image in features]),
        "keypoint_xy": np.concatenate([image.points for image in features]).astype(np.float32),
        "keypoint_size": size.astype(np.float16),
        "keypoint_angle": (np.round(angle * (ANGLE_UNITS / 360.0)).astype(np.int64) % ANGLE_UNITS).astype(np.uint8),
        "pair": np.array([(pair.first, pair.second) for pair in pairs], dtype=np.int32),
        "match_offset": _offsets([len(pair.matches.index2) for pair in pairs]),
        "match_index": np.concatenate([pair.matches.index2 for pair in pairs]).astype(np.uint16),
        "match_ratio": np.round(255.0 * ratio).astype(np.uint8),
        "match_mutual": np.packbits(np.concatenate([pair.matches.mutual for pair in pairs])),
        "match_best": np.packbits(np.concatenate([_best(pair.matches) for pair in pairs])),
        "covisible": np.array([pair.covisible for pair in pairs], dtype=np.int32),
    }
    labels = [pair.labels for pair in pairs if pair.labels is not None]
    if len(labels) == len(pairs):
        fields[LABEL_FIELD] = np.concatenate(labels)
    with replaced_when_done(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **fields)  # type: ignore[arg-type]


def _best(matches: OneWayMatches) -> NDArray[np.bool_]:
    """Best-of-list flags (M,); where all distances are equal no match is worse than another."""
    best = matches.attributes.best
    return np.ones(len(matches.index2), dtype=bool) if best is None else best


def _offsets(counts: Sequence[int]) -> NDArray[np.generic]:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
