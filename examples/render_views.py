"""Renders the courtyard of the example pair from many places: images and their exact poses, as a COLMAP model.

    python examples/render_views.py [--out views] [--count 8] [--supersampling 2] [--slow 1]

writes ``images/view00.png`` …, and ``truth/`` with ``cameras.txt``, ``images.txt`` and an empty ``points3D.txt``.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from render_pair import courtyard, expose, look_at, render

SIZE, FOCAL_PX = (640, 480), 512.0


@dataclass(frozen=True)
class View:
    """One image (h, w, 3) uint8; K in OpenCV's pixels, X_camera = R X_world + t."""

    name: str
    image: np.ndarray
    K: np.ndarray
    R: np.ndarray
    t: np.ndarray


def render_views(count: int = 8, supersampling: int = 2, slow: float = 1.0) -> list[View]:
    """Views from an arc, so far apart that four of five nearest-neighbour matches are wrong.

    With ``slow`` above 1 the camera moves and turns by that much less from view to view, as in a video.
    """
    faces, views = courtyard(), []
    for index, a in enumerate(np.linspace(-1.0, 2.0 / slow - 1.0, count)):
        k = index / slow
        position = (5.2 * a, -0.5 + 0.4 * np.sin(3 * k), 1.6 * a * a - 1.2 + 0.8 * np.cos(2.1 * k))
        camera = look_at(position, (0.3 * np.sin(k), -0.3, 7.5), 15 * np.sin(1.7 * k), FOCAL_PX, SIZE)
        gains = 0.9 + 0.15 * np.sin([k, 2 * k, 3 * k])
        image = render(faces, camera, supersampling)
        image = expose(image, gains, 1.0 + 0.25 * np.cos(k), 0.7 + 0.3 * (k % 3), 0.05, seed=index)
        views.append(View(f"view{index:02d}.png", image, camera.K, camera.R, camera.t))
    return views


def write_truth(folder: Path, views: list[View]) -> None:
    """The true poses as a COLMAP model; COLMAP's pixels lie half a pixel from OpenCV's."""
    folder.mkdir(parents=True, exist_ok=True)
    fx, fy, cx, cy = views[0].K[[0, 1, 0, 1], [0, 1, 2, 2]]
    (folder / "cameras.txt").write_text(f"1 PINHOLE {SIZE[0]} {SIZE[1]} {fx} {fy} {cx + 0.5} {cy + 0.5}\n")
    lines = []
    for image_id, view in enumerate(views, 1):
        rotation = quaternion(view.R)
        numbers = " ".join(repr(float(v)) for v in (*rotation, *view.t))
        lines.append(f"{image_id} {numbers} 1 {view.name}\n\n")
    (folder / "images.txt").write_text("".join(lines))
    (folder / "points3D.txt").write_text("")


def quaternion(R: np.ndarray) -> np.ndarray:
    """Unit quaternion (w, x, y, z) of a rotation by less than half a turn."""
    axis, _ = cv2.Rodrigues(R)
    angle = float(np.linalg.norm(axis))
    return np.concatenate([[np.cos(angle / 2)], np.sinc(angle / (2 * np.pi)) / 2 * axis.ravel()])


def main() -> None:
    """Render the views and write images and poses."""
    parser = argparse.ArgumentParser(description="Render many views of the courtyard with their exact poses.")
    parser.add_argument("--out", type=Path, default=Path("views"))
    parser.add_argument("--count", type=int, default=8)
    parser.add_argument("--supersampling", type=int, default=2, help="rays per pixel and direction (default 2)")
    parser.add_argument("--slow", type=float, default=1.0, help="motion is this many times smaller (default 1)")
    options = parser.parse_args()
    views = render_views(options.count, options.supersampling, options.slow)
    (options.out / "images").mkdir(parents=True, exist_ok=True)
    for view in views:
        cv2.imwrite(str(options.out / "images" / view.name), view.image)
    write_truth(options.out / "truth", views)
    print(f"wrote {len(views)} images and their poses to {options.out}")


if __name__ == "__main__":
    main()
