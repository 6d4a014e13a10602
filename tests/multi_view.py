"""A rendered scene in many views with exact poses, and COLMAP databases of it: raw nearest neighbours, most wrong."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np

from mgca_filter.keypoints import create_detector, detect_keypoints
from mgca_filter.matching import match_descriptors

_SIZE, _FOCAL_PX = (640, 480), 512.0


def _load_renderer():
    path = Path(__file__).parent.parent / "examples" / "render_pair.py"
    spec = importlib.util.spec_from_file_location("render_pair", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@dataclass(frozen=True)
class View:
    """One image with its features; K in OpenCV's pixels, X_camera = R X_world + t."""

    name: str
    image: np.ndarray
    keypoints: list[cv2.KeyPoint]
    descriptors: np.ndarray
    K: np.ndarray
    R: np.ndarray
    t: np.ndarray

    @property
    def points(self) -> np.ndarray:
        return np.array([k.pt for k in self.keypoints])


def render_views(count: int = 8, supersampling: int = 1, max_keypoints: int = 1500) -> list[View]:
    """The courtyard of the example pair from ``count`` places on an arc, far enough apart to be hard."""
    renderer = _load_renderer()
    faces, detector = renderer.courtyard(), create_detector("sift", max_keypoints)
    views = []
    for k, a in enumerate(np.linspace(-1.0, 1.0, count)):
        position = (5.2 * a, -0.5 + 0.4 * np.sin(3 * k), 1.6 * a * a - 1.2 + 0.8 * np.cos(2.1 * k))
        camera = renderer.look_at(position, (0.3 * np.sin(k), -0.3, 7.5), 15 * np.sin(1.7 * k), _FOCAL_PX, _SIZE)
        image = renderer.render(faces, camera, supersampling)
        gains = 0.9 + 0.15 * np.sin([k, 2 * k, 3 * k])
        image = renderer.expose(image, gains, 1.0 + 0.25 * np.cos(k), 0.7 + 0.3 * (k % 3), 0.05, seed=k)
        keypoints, descriptors = detect_keypoints(image, detector)
        views.append(View(f"view{k:02d}.png", image, keypoints, descriptors, camera.K, camera.R, camera.t))
    return views


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
    camera = pycolmap.Camera(model="PINHOLE", width=_SIZE[0], height=_SIZE[1], params=[fx, fy, cx + 0.5, cy + 0.5])
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
    import pycolmap

    folder.mkdir()
    fx, fy, cx, cy = views[0].K[[0, 1, 0, 1], [0, 1, 2, 2]]
    (folder / "cameras.txt").write_text(f"1 PINHOLE {_SIZE[0]} {_SIZE[1]} {fx} {fy} {cx + 0.5} {cy + 0.5}\n")
    lines = []
    for k, view in enumerate(views, 1):
        x, y, z, w = pycolmap.Rotation3d(view.R).quat
        lines.append(f"{k} {w} {x} {y} {z} {view.t[0]} {view.t[1]} {view.t[2]} 1 {view.name}\n\n")
    (folder / "images.txt").write_text("".join(lines))
    (folder / "points3D.txt").write_text("")
    return folder
