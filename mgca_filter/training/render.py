"""``python -m mgca_filter.training.render PHOTOS OUT.npz --pairs N``: rendered worlds as a scene bundle.

What is drawn depends on the photographs and the seed alone, not on the number of workers.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from ..data.scene_bundle import BundleImage, BundlePair, write_bundle
from .worlds.photographs import PhotoError, PhotoFolder
from .worlds.view_pairs import bundle_image, bundle_pairs
from .worlds.views import draw_views

World = tuple[list[BundleImage], list[BundlePair]]


def render_world(photos: PhotoFolder, seed: int, views: int, number: int) -> World:
    """Images and pairs of world ``number`` of a seed."""
    rng = np.random.default_rng([seed, number])
    taken = draw_views(rng, photos, views)
    images = [bundle_image(view, f"{number:06d}_{i}") for i, view in enumerate(taken)]
    return images, bundle_pairs(rng, taken)


@contextmanager
def _worlds(photos: PhotoFolder, seed: int, views: int, limit: int, workers: int) -> Iterator[Iterator[World]]:
    """Worlds 0, 1, 2 … in order, rendered by ``workers`` processes (0 = in this one)."""
    render = partial(render_world, photos, seed, views)
    if workers == 0:
        yield map(render, range(limit))
        return
    with multiprocessing.get_context("spawn").Pool(workers, initializer=cv2.setNumThreads, initargs=(1,)) as pool:
        yield pool.imap(render, range(limit))


def render_bundle(photos: PhotoFolder, out: Path, pairs: int, seed: int, views: int, workers: int) -> None:
    """Render worlds until ``pairs`` pairs are there, and write them.

    Raises:
        PhotoError: a photograph cannot be read, or hardly any pair of the worlds has matches.
    """
    images: list[BundleImage] = []
    kept: list[BundlePair] = []
    limit = 20 * pairs + 20
    with _worlds(photos, seed, views, limit, workers) as worlds, tqdm(total=pairs, unit="pair") as progress:
        for world_images, world_pairs in worlds:
            world_pairs = world_pairs[: pairs - len(kept)]
            kept += [
                BundlePair(len(images) + p.first, len(images) + p.second, p.matches, p.covisible, p.labels)
                for p in world_pairs
            ]
            images += world_images
            progress.update(len(world_pairs))
            if len(kept) >= pairs:
                break
        else:
            raise PhotoError(f"{photos.folder}: {limit} worlds gave {len(kept)} pairs with matches only")
    write_bundle(out, images, kept)


def parse_arguments(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m mgca_filter.training.render",
        description="Put photographs on random 3-D scenes, photograph them, and write the pairs as a scene bundle.",
    )
    parser.add_argument("photos", type=Path, help="folder of photographs, searched with its subfolders")
    parser.add_argument("out", type=Path, help="scene bundle to write (.npz)")
    parser.add_argument("--pairs", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--views", type=int, default=4, help="photographs of each world; all their pairs are matched")
    parser.add_argument("--workers", type=int, default=1, help="processes (0 = none besides this one)")
    options = parser.parse_args(arguments)
    if options.out.suffix != ".npz":
        parser.error(f"out: expected a name that ends in .npz, got {options.out}")
    if options.pairs < 1 or options.views < 2 or options.workers < 0:
        parser.error("--pairs: at least 1; --views: at least 2; --workers: at least 0")
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = the photographs cannot be used."""
    options = parse_arguments(arguments)
    try:
        photos = PhotoFolder.open(options.photos)
        render_bundle(photos, options.out, options.pairs, options.seed, options.views, options.workers)
    except PhotoError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
