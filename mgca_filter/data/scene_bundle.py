"""Scene bundles: keypoints, one-way matches and true poses of one photographed scene in an ``.npz``."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import BundleError
from ..geometry.cameras import normalize_points
from ..geometry.epipolar import essential_from_pose
from ..inputs.attributes import MatchAttributes

_FIELDS = (
    *("image_name", "image_size", "K", "R", "t"),
    *("keypoint_offset", "keypoint_xy", "keypoint_size", "keypoint_angle"),
    *("pair", "match_offset", "match_index", "match_ratio", "match_mutual", "match_best", "covisible"),
)


@dataclass(frozen=True)
class ScenePair:
    """Two images of a scene, their raw one-way matches and the true relative pose (X2 = R X1 + t).

    ``points1``, ``points2`` are undistorted pixels (M, 2) under ``K1``, ``K2``; ``mutual`` (M,) marks two-way
    nearest neighbours; ``t`` (3,) has the scene's unknown scale.
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

    @property
    def name(self) -> str:
        """``scene/index``, unique in a folder of bundles."""
        return f"{self.scene}/{self.index}"

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
                missing = [field for field in _FIELDS if field not in data.files]
                if missing:
                    raise BundleError(f"{self.path}: not a scene bundle, fields missing: {', '.join(missing)}")
                self._data = {field: data[field] for field in _FIELDS}
        except BundleError:
            raise
        except Exception as error:  # zipfile, zlib, numpy and the system each have their own
            raise BundleError(f"{self.path}: cannot be read as a scene bundle ({error})") from error
        self._check_shapes()
        count = int(self._data["match_offset"][-1])
        for field in ("match_mutual", "match_best"):
            self._data[field] = np.unpackbits(self._data[field], count=count).astype(bool)
        self._check_values()

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
        }
        for field, shape in lengths.items():
            if d[field].shape != shape:
                raise BundleError(f"{self.path}: {field} has the shape {d[field].shape}, its offsets promise {shape}")
        for field in ("match_mutual", "match_best"):
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
        count = rows.stop - rows.start
        start_i, start_j = int(d["keypoint_offset"][i]), int(d["keypoint_offset"][j])
        k1 = start_i + np.arange(count)
        k2 = start_j + d["match_index"][rows].astype(np.int64)
        if count and (k1[-1] >= d["keypoint_offset"][i + 1] or k2.max() >= d["keypoint_offset"][j + 1]):
            raise BundleError(f"{self.path}: match_index of pair {index} names a keypoint that is not there")
        size, angle, degrees = d["keypoint_size"], d["keypoint_angle"], np.float32(360.0 / 256.0)
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
            attributes=MatchAttributes(
                ratio=d["match_ratio"][rows].astype(np.float32) / np.float32(255.0),
                best=d["match_best"][rows],
                size1=size[k1].astype(np.float32),
                size2=size[k2].astype(np.float32),
                angle1=angle[k1] * degrees,
                angle2=angle[k2] * degrees,
            ),
            mutual=d["match_mutual"][rows],
        )


def load_scene_bundles(folder: str | Path) -> list[SceneBundle]:
    """All bundles of a folder in the order of their names (or the one file that ``folder`` names).

    Raises:
        BundleError: the path holds no ``.npz``, or one of them is broken.
    """
    folder = Path(folder)
    paths = [folder] if folder.is_file() else sorted(folder.glob("*.npz"))
    if not paths:
        raise BundleError(f"{folder}: no scene bundle (.npz) found")
    return [SceneBundle(path) for path in paths]
