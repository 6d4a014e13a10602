"""Renders the example pair: a brick courtyard with pictures on its walls, seen by two cameras whose pose is exact.

The textures are photographs that scikit-image ships inside its wheel (``pip install scikit-image``), so nothing is
downloaded. Writes ``left.jpg``, ``right.jpg`` and ``pair.json`` (K1, K2, R, t with X2 = R X1 + t) to a folder:

    python examples/render_pair.py [--out examples/images] [--supersampling 3]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import skimage

TEXTURES = Path(skimage.__file__).parent / "data"
JPEG_QUALITY = 90


@dataclass(frozen=True)
class Camera:
    """A pinhole: X_camera = R X_world + t, pixels by K; ``size`` is (width, height)."""

    K: np.ndarray
    R: np.ndarray
    t: np.ndarray
    size: tuple[int, int]

    def project(self, points: np.ndarray) -> np.ndarray:
        """World points (N, 3) to pixels (N, 2)."""
        p = (points @ self.R.T + self.t) @ self.K.T
        return p[:, :2] / p[:, 2:]


@dataclass(frozen=True)
class Face:
    """A textured parallelogram: world point = corner + u edge_u + v edge_v, with u, v in 0 … 1."""

    corner: np.ndarray
    edge_u: np.ndarray
    edge_v: np.ndarray
    texture: np.ndarray

    def point(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """World points (N, 3) of face coordinates (N,), (N,)."""
        return self.corner + np.outer(u, self.edge_u) + np.outer(v, self.edge_v)

    def intersect(self, camera: Camera, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Face coordinates u, v and inverse depth where the viewing rays of pixels x, y meet the plane.

        (u, v, 1) maps to depth * (x, y, 1) by the homography K [R | t] [edge_u edge_v corner], hence the third
        coordinate of its inverse is the inverse depth.
        """
        basis = np.stack([self.edge_u, self.edge_v, self.corner], axis=1)
        H = camera.K @ (camera.R @ basis + np.outer(camera.t, [0.0, 0.0, 1.0]))
        a, b, c = (row[0] * x + row[1] * y + row[2] for row in np.linalg.inv(H))
        with np.errstate(divide="ignore", invalid="ignore"):
            return a / c, b / c, c


def look_at(position: Sequence[float], target: Sequence[float], roll_deg: float, focal_px: float, size) -> Camera:
    """Camera at a world position (y points down) that looks at a target, rolled about its axis."""
    forward = np.subtract(target, position).astype(float)
    forward /= np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ R
    K = np.array([[focal_px, 0.0, (size[0] - 1) / 2], [0.0, focal_px, (size[1] - 1) / 2], [0.0, 0.0, 1.0]])
    return Camera(K, R, -R @ np.asarray(position, float), size)


def visible_surface(
    faces: Sequence[Face], camera: Camera, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Index of the nearest face under each pixel (−1: sky) and the face coordinates u, v there; shape of ``x``."""
    nearest = np.full(x.shape, -1)
    best, u, v = np.zeros(x.shape), np.zeros(x.shape), np.zeros(x.shape)
    for index, face in enumerate(faces):
        face_u, face_v, inverse_depth = face.intersect(camera, x, y)
        hit = (inverse_depth > best) & (face_u >= 0) & (face_u <= 1) & (face_v >= 0) & (face_v <= 1)
        nearest[hit], best[hit], u[hit], v[hit] = index, inverse_depth[hit], face_u[hit], face_v[hit]
    return nearest, u, v


def render(faces: Sequence[Face], camera: Camera, supersampling: int = 3) -> np.ndarray:
    """Image (h, w, 3) uint8, each pixel the mean of supersampling² rays; the sky is a gradient."""
    width, height = camera.size
    n, strip_height = supersampling, 32  # in strips, to bound the memory
    image = np.empty((height, width, 3), np.uint8)
    for top in range(0, height, strip_height):
        rows = min(strip_height, height - top)
        x, y = np.meshgrid((np.arange(width * n) + 0.5) / n - 0.5, top + (np.arange(rows * n) + 0.5) / n - 0.5)
        nearest, u, v = visible_surface(faces, camera, x, y)
        blue = np.clip(y / height, 0, 1)[..., None]
        strip = ((1 - blue) * (226, 186, 148) + blue * (244, 236, 226)).astype(np.uint8)
        for index in np.unique(nearest[nearest >= 0]):
            texture, hit = faces[index].texture, nearest == index
            map_u = (u * texture.shape[1] - 0.5).astype(np.float32)
            map_v = (v * texture.shape[0] - 0.5).astype(np.float32)
            strip[hit] = cv2.remap(texture, map_u, map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[hit]
        image[top : top + rows] = cv2.resize(strip, (width, rows), interpolation=cv2.INTER_AREA)
    return image


def load_texture(name: str) -> np.ndarray:
    """BGR texture that scikit-image ships."""
    image = cv2.imread(str(TEXTURES / name), cv2.IMREAD_COLOR)
    if image is None:
        raise SystemExit(f"{TEXTURES / name}: cannot be read; is scikit-image installed completely?")
    return image


def surface_texture(name: str, tiles: tuple[int, int], tint: Sequence[float], rng: np.random.Generator) -> np.ndarray:
    """A texture repeated (columns, rows) times, tinted, and weathered so that the copies differ a little."""
    tiled = np.tile(np.rot90(load_texture(name)), (tiles[1], tiles[0], 1)).astype(np.float32)
    h, w = tiled.shape[:2]
    weather = np.ones((h, w), np.float32)
    for cells, depth in ((1, 0.10), (4, 0.10), (24, 0.08)):
        grid = rng.uniform(-depth, depth, (tiles[1] * cells + 1, tiles[0] * cells + 1)).astype(np.float32)
        weather += cv2.resize(grid, (w, h), interpolation=cv2.INTER_CUBIC)
    return np.clip(tiled * weather[..., None] * np.float32(tint), 0, 255).astype(np.uint8)


def framed(name: str, frame_bgr: Sequence[int]) -> np.ndarray:
    """A picture with a white mat and a frame of the given colour."""
    image = load_texture(name)
    mat = max(image.shape[:2]) // 24
    image = cv2.copyMakeBorder(image, mat, mat, mat, mat, cv2.BORDER_CONSTANT, value=(235, 240, 242))
    return cv2.copyMakeBorder(image, mat, mat, mat, mat, cv2.BORDER_CONSTANT, value=tuple(frame_bgr))


def wall(start: Sequence[float], end: Sequence[float], top: float, bottom: float, texture: np.ndarray) -> Face:
    """Upright face between two points of the ground plan (x, z), from height ``top`` to ``bottom`` (y is down)."""
    corner = np.array([start[0], top, start[1]])
    edge = np.array([end[0] - start[0], 0.0, end[1] - start[1]])
    return Face(corner, edge, np.array([0.0, bottom - top, 0.0]), texture)


def courtyard(seed: int = 4) -> list[Face]:
    """The scene, in metres: three brick walls, the ground, pictures on the walls and panels in front of them."""
    rng = np.random.default_rng(seed)
    brick = surface_texture("brick.png", (7, 3), (0.62, 0.78, 1.10), rng)
    side = surface_texture("brick.png", (4, 3), (0.55, 0.68, 0.95), rng)
    gravel = surface_texture("gravel.png", (5, 4), (0.86, 0.94, 1.0), rng)
    plinth = surface_texture("gravel.png", (2, 1), (1.05, 1.08, 1.1), rng)
    black, wood, white = (34, 30, 30), (60, 96, 140), (228, 232, 234)
    faces = [
        wall((-5.6, 9), (5.6, 9), -3.0, 1.6, brick),
        wall((-5.6, 2), (-5.6, 9), -3.0, 1.6, side),
        wall((5.6, 9), (5.6, 2), -3.0, 1.6, side[:, ::-1].copy()),
        Face(np.array([-6.0, 1.6, 9.0]), np.array([12.0, 0, 0]), np.array([0, 0, -9.0]), gravel),
        wall((-4.9, 8.94), (-2.9, 8.94), -1.9, 0.3, framed("ihc.png", wood)),
        wall((-2.2, 8.94), (0.2, 8.94), -2.3, -0.6, framed("coffee.png", black)),
        wall((1.0, 8.94), (3.0, 8.94), -2.2, -0.1, framed("moon.png", black)),
        wall((3.5, 8.94), (5.3, 8.94), -1.8, -0.6, framed("chelsea.png", wood)),
        wall((-5.54, 4.6), (-5.54, 7.0), -1.8, 0.2, framed("hubble_deep_field.jpg", black)),
        wall((5.54, 7.4), (5.54, 5.0), -1.7, 0.1, framed("coffee.png", wood)),
        wall((-2.6, 6.2), (-0.9, 6.9), -0.5, 1.5, framed("astronaut.png", white)),
        wall((1.6, 7.2), (3.2, 6.5), -0.2, 1.5, framed("camera.png", black)),
    ]
    # A kiosk: three visible sides and no lid, for nobody looks down on it.
    front, left = framed("rocket.jpg", black), framed("chelsea.png", white)
    right = framed("hubble_deep_field.jpg", wood)
    faces += [
        wall((-0.35, 5.2), (1.05, 5.1), 0.15, 1.2, front),
        wall((-0.25, 6.2), (-0.35, 5.2), 0.15, 1.2, left),
        wall((1.05, 5.1), (1.15, 6.1), 0.15, 1.2, right),
        wall((-0.45, 5.1), (1.15, 5.0), 1.2, 1.6, plinth),
        wall((-0.35, 6.2), (-0.45, 5.1), 1.2, 1.6, plinth),
        wall((1.15, 5.0), (1.25, 6.1), 1.2, 1.6, plinth),
    ]
    return faces


def cameras() -> tuple[Camera, Camera]:
    """The two views: 5.5 m apart at 5 … 10 m from the scene, the second one rolled."""
    size, focal_px = (1024, 768), 820.0
    return (
        look_at((-2.5, -0.1, -0.6), (-0.2, -0.3, 8.0), 0.0, focal_px, size),
        look_at((2.8, -0.7, 0.6), (0.1, -0.3, 8.0), 12.0, focal_px, size),
    )


def expose(
    image: np.ndarray, gain: Sequence[float], gamma: float, blur_px: float, noise: float, seed: int
) -> np.ndarray:
    """What a real camera adds: white balance, tone curve, vignetting, defocus and noise of the sensor."""
    h, w = image.shape[:2]
    y, x = np.mgrid[:h, :w]
    radius = np.hypot(x - w / 2, y - h / 2) / np.hypot(w / 2, h / 2)
    light = (image / 255.0) ** gamma * np.asarray(gain) * (1 - 0.35 * radius[..., None] ** 2)
    light = cv2.GaussianBlur(light, (0, 0), blur_px)
    light += np.random.default_rng(seed).normal(0, noise, light.shape) * np.sqrt(np.maximum(light, 0.02))
    return np.clip(255 * light + 0.5, 0, 255).astype(np.uint8)


def main() -> None:
    """Render both views and write images and poses."""
    parser = argparse.ArgumentParser(description="Render the example pair with its exact pose.")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "images")
    parser.add_argument("--supersampling", type=int, default=3, help="rays per pixel and direction (default 3)")
    options = parser.parse_args()
    faces, (camera1, camera2) = courtyard(), cameras()
    options.out.mkdir(parents=True, exist_ok=True)
    left = expose(render(faces, camera1, options.supersampling), (1.06, 1.05, 1.05), 0.95, 0.5, 0.02, seed=1)
    right = expose(render(faces, camera2, options.supersampling), (0.72, 0.84, 0.98), 1.35, 1.3, 0.08, seed=2)
    for name, image in (("left.jpg", left), ("right.jpg", right)):
        cv2.imwrite(str(options.out / name), image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    R = camera2.R @ camera1.R.T
    pose = {"K1": camera1.K, "K2": camera2.K, "R": R, "t": camera2.t - R @ camera1.t}
    pair = {"image1": "left.jpg", "image2": "right.jpg", **{name: value.tolist() for name, value in pose.items()}}
    (options.out / "pair.json").write_text(json.dumps(pair, indent=1) + "\n")
    T = np.vstack([np.column_stack([pose["R"], pose["t"]]), [0.0, 0.0, 0.0, 1.0]])
    numbers = np.concatenate([matrix.ravel() for matrix in (pose["K1"], pose["K2"], T)]).tolist()
    (options.out / "courtyard.txt").write_text(f"left.jpg right.jpg 0 0 {' '.join(map(str, numbers))}\n")
    print(f"wrote left.jpg, right.jpg, pair.json and courtyard.txt to {options.out}")


if __name__ == "__main__":
    main()
