"""The rendered views of ``examples/render_views.py`` with features, raw matches, and COLMAP databases of them."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np

from mgca_filter.features import create_detector, detect_keypoints, match_descriptors


def _load_example():
    path = Path(__file__).parent.parent / "examples" / "render_views.py"
    spec = importlib.util.spec_from_file_location("render_views", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


example = _load_example()


@dataclass(frozen=True)
class View(example.View):
    """One image with its camera and its features."""

    keypoints: list[cv2.KeyPoint]
    descriptors: np.ndarray

    @property
    def points(self) -> np.ndarray:
        return np.array([k.pt for k in self.keypoints])


def render_views(count: int, supersampling: int = 1, max_keypoints: int = 1500) -> list[View]:
    """Views with SIFT features."""
    detector = create_detector("sift", max_keypoints)
    rendered = example.render_views(count, supersampling)
    return [
        View(**vars(v), **dict(zip(("keypoints", "descriptors"), detect_keypoints(v.image, detector))))
        for v in rendered
    ]


def raw_matches(views: list[View]) -> dict[tuple[int, int], np.ndarray]:
    """Nearest neighbours (M, 2) of every pair of views, unfiltered."""
    return {
        (i, j): np.array([(m[0].queryIdx, m[0].trainIdx) for m in match_descriptors(a.descriptors, b.descriptors)])
        for (i, a), (j, b) in combinations(enumerate(views), 2)
    }


def write_database(path: Path, views: list[View], matches: dict[tuple[int, int], np.ndarray]) -> Path:
    """A COLMAP database of the views, one pinhole camera with known focal length."""
    import pycolmap

    database = pycolmap.Database.open(path)
    fx, fy, cx, cy = views[0].K[[0, 1, 0, 1], [0, 1, 2, 2]]
    height, width = views[0].image.shape[:2]
    camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=[fx, fy, cx + 0.5, cy + 0.5])
    camera.has_prior_focal_length = True
    camera_id = database.write_camera(camera)
    ids = []
    for view in views:
        ids.append(database.write_image(pycolmap.Image(name=view.name, camera_id=camera_id)))
        rows = [(k.pt[0] + 0.5, k.pt[1] + 0.5, k.size / 2, np.radians(k.angle)) for k in view.keypoints]
        database.write_keypoints(ids[-1], np.array(rows, np.float32))
        sift = pycolmap.FeatureExtractorType.SIFT
        data = view.descriptors.astype(np.uint8)
        database.write_descriptors(ids[-1], pycolmap.FeatureDescriptors(type=sift, data=data))
    for (i, j), pairs in matches.items():
        database.write_matches(ids[i], ids[j], pairs.astype(np.uint32))
    database.close()
    return path


def write_truth(folder: Path, views: list[View]) -> Path:
    """The true poses as a COLMAP model in ``folder``."""
    example.write_truth(folder, views)
    return folder
