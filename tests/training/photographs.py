"""Pictures for rendered worlds that the tests draw themselves: blots of every size."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np


def write_photographs(folder: Path, count: int = 4, size: tuple[int, int] = (320, 240)) -> Path:
    """``count`` grey PNG files of ``size`` = width, height."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        rng = np.random.default_rng(number)
        image = np.zeros((size[1], size[0]))
        for sigma in (1.0, 3.0, 9.0):
            layer = cv2.GaussianBlur(rng.normal(size=image.shape), (0, 0), sigma)
            image += layer / layer.std()
        cv2.imwrite(str(folder / f"{number}.png"), np.clip(128 + 35 * image, 0, 255).astype(np.uint8))
    return folder
