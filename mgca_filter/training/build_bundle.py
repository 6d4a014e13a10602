"""``python -m mgca_filter.training.build_bundle RECONSTRUCTION IMAGES OUT.npz``: a scene bundle of one's own scene.

Reads any COLMAP reconstruction (``cameras``, ``images``, ``points3D`` as ``.bin`` or ``.txt``), detects SIFT in the
images anew, removes the cameras' distortion from the keypoints, and matches pairs that share enough points.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ..data.colmap import ColmapSource, observed_points, open_reconstruction
from ..data.scene_bundle import BundleImage, BundlePair, write_bundle
from ..errors import DatasetError
from ..features import ImageFeatures, match_features


def choose_pairs(
    observed: Sequence[NDArray[np.int64]], min_covisible: int, max_pairs: int, seed: int
) -> list[tuple[int, int, int]]:
    """Ordered pairs of images (i, j, shared points), at most ``max_pairs`` drawn at random, in either direction.

    Pairs that share few points are as frequent in an image collection as they are hard; a plain draw keeps both.
    """
    shared = [
        (i, j, len(np.intersect1d(observed[i], observed[j], assume_unique=True)))
        for i in range(len(observed))
        for j in range(i + 1, len(observed))
    ]
    usable = [pair for pair in shared if pair[2] >= min_covisible]
    rng = np.random.default_rng(seed)
    chosen = sorted(rng.choice(len(usable), min(max_pairs, len(usable)), replace=False)) if usable else []
    return [
        (i, j, count) if rng.random() < 0.5 else (j, i, count) for i, j, count in (usable[int(row)] for row in chosen)
    ]


def build_bundle(
    reconstruction: Path, images: Path, out: Path, *, min_covisible: int = 20, max_pairs: int = 2000, seed: int = 0
) -> int:
    """Write the bundle and return its number of pairs.

    Raises:
        DatasetError: the reconstruction or an image cannot be read, or no two images share enough points.
        ImportError: pycolmap is not installed.
    """
    import pycolmap

    (source,) = open_reconstruction(reconstruction, images)
    model = pycolmap.Reconstruction(source.path)
    seen = {image.name: observed_points(image) for image in (model.image(i) for i in model.reg_image_ids())}
    pairs = choose_pairs([seen[photo.name] for photo in source.photos], min_covisible, max_pairs, seed)
    if not pairs:
        raise DatasetError(f"{source.path}: points3D: no two images share {min_covisible} points")
    used = sorted({index for i, j, _ in pairs for index in (i, j)})
    features = {index: _features(source, index) for index in tqdm(used, unit="image")}
    place = {index: number for number, index in enumerate(used)}
    rows = [
        BundlePair(place[i], place[j], match_features(features[i], features[j]), count)
        for i, j, count in tqdm(pairs, unit="pair")
        if min(len(features[i]), len(features[j])) >= 2
    ]
    if not rows:
        raise DatasetError(f"{images}: hardly any keypoints found")
    write_bundle(out, [_bundle_image(source, index, features[index]) for index in used], rows)
    return len(rows)


def _features(source: ColmapSource, index: int) -> ImageFeatures:
    """Keypoints of an image at undistorted pixels; those whose distortion cannot be removed are left out."""
    view = source.view(source.photos[index])
    return view.take(np.flatnonzero(np.isfinite(view.points).all(axis=1)))


def _bundle_image(source: ColmapSource, index: int, features: ImageFeatures) -> BundleImage:
    photo = source.photos[index]
    return BundleImage(photo.name, features, photo.R, photo.t)


def parse_arguments(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m mgca_filter.training.build_bundle", description="Make a scene bundle to train on."
    )
    parser.add_argument("reconstruction", type=Path, help="folder of a COLMAP reconstruction")
    parser.add_argument("images", type=Path, help="folder that its image names start from")
    parser.add_argument("out", type=Path, help="scene bundle to write (.npz); its name names the scene")
    parser.add_argument("--min-covisible", type=int, default=20, help="reconstructed points that a pair must share")
    parser.add_argument("--max-pairs", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0, help="of the draw among more pairs than that")
    options = parser.parse_args(arguments)
    if options.out.suffix != ".npz":
        parser.error(f"out: expected a name that ends in .npz, got {options.out}")
    if options.min_covisible < 1 or options.max_pairs < 1:
        parser.error("--min-covisible, --max-pairs: at least 1")
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = the reconstruction or its images cannot be used."""
    options = parse_arguments(arguments)
    limits = {"min_covisible": options.min_covisible, "max_pairs": options.max_pairs, "seed": options.seed}
    try:
        count = build_bundle(options.reconstruction, options.images, options.out, **limits)
    except (DatasetError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{options.out}: {count} pairs")
    return 0


if __name__ == "__main__":
    sys.exit(main())
