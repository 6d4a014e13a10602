"""What a camera does to a picture: light, lens, exposure, noise and compression; and what stands in the way."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .photographs import PhotoFolder
from .visibility import NOTHING, VisibilityMap

PASSER_BY_PROBABILITY = 0.3
LIGHT_SPREAD = 0.2
BLUR_PX = (0.45, 1.7)


def draw_light(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Brightness (count,) of the faces of a world in one view."""
    return np.exp(rng.normal(0.0, rng.uniform(0.0, LIGHT_SPREAD), count))


def add_passers_by(
    rng: np.random.Generator, image: NDArray[np.uint8], visible: VisibilityMap, photos: PhotoFolder
) -> None:
    """Put ellipses cut from photographs before the scene, in this view only; the map shows nothing there."""
    if rng.random() >= PASSER_BY_PROBABILITY:
        return
    height, width = image.shape
    for _ in range(int(rng.integers(1, 4))):
        pyramid = photos.pyramid(int(rng.integers(len(photos))))
        picture = cv2.resize(pyramid[0], (width, height), interpolation=cv2.INTER_AREA)
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        axes = tuple(int(max(image.shape) * a) for a in rng.uniform(0.03, 0.18, 2))
        mask = np.zeros(image.shape, dtype=np.uint8)
        cv2.ellipse(mask, centre, (axes[0], axes[1]), float(rng.uniform(0, 180)), 0, 360, 1, -1)
        np.copyto(image, picture, where=mask > 0)
        visible.face[mask > 0] = NOTHING
        visible.inverse_depth[mask > 0] = np.inf


def photograph(rng: np.random.Generator, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The picture as a camera would have saved it: vignette, exposure, blur, noise, JPEG."""
    height, width = image.shape
    y, x = np.ogrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    vignette = 1.0 - rng.uniform(0.0, 0.3) * (x * x + y * y) / 2.0
    gain, gamma = np.exp(rng.normal(0.0, 0.2)), np.exp(rng.normal(0.0, 0.2))
    levels = (np.arange(256) / 255.0) ** gamma * gain * 255.0
    exposed = np.clip(levels[image] * vignette, 0.0, 255.0).astype(np.float32)
    # Never without blur: a lens softens the steps that faces leave at their borders.
    exposed = np.asarray(cv2.GaussianBlur(exposed, (0, 0), rng.uniform(*BLUR_PX)), dtype=np.float32)
    strength = np.exp(rng.uniform(np.log(0.5), np.log(9.0)))
    exposed += rng.standard_normal(exposed.shape, dtype=np.float32) * np.float32(strength)
    taken = np.clip(np.round(exposed), 0, 255).astype(np.uint8)
    quality = int(rng.integers(60, 96))
    _, encoded = cv2.imencode(".jpg", taken, [cv2.IMWRITE_JPEG_QUALITY, quality])
    decoded = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)
    assert decoded is not None
    return np.asarray(decoded, dtype=np.uint8)
