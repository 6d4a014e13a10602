"""Where pairs with a known pose come from: one interface, four formats, each pair read when it is asked for.

``scene_bundle`` reads and writes scene bundles, ``bundles`` are their pairs; ``oanet_hdf5`` reads HDF5 dumps,
``pair_lists`` text files of image pairs as SuperGlue has them, ``colmap`` reconstructions with their images. The last
two match their images by :mod:`mgca_filter.features`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from ..errors import DatasetError
from .bundles import open_bundles
from .colmap import open_reconstruction
from .oanet_hdf5 import open_dumps
from .pair_lists import open_pair_lists
from .source import PairSource

Opener = Callable[[Path, Path | None], Sequence[PairSource]]
FORMATS: dict[str, Opener] = {
    "bundle": open_bundles,
    "oanet": open_dumps,
    "pairs": open_pair_lists,
    "colmap": open_reconstruction,
}
"""What opens a path of each format, with the folder of the images where one is given."""


def open_sources(
    paths: Sequence[str | Path], data_format: str = "bundle", images: str | Path | None = None
) -> list[PairSource]:
    """One source for each scene that the paths hold, in their order.

    Args:
        paths: files, or folders of files, of the format; a COLMAP reconstruction is a folder itself.
        data_format: a key of :data:`FORMATS`.
        images: folder that image names start from; None = beside the list or reconstruction.

    Raises:
        DatasetError: a path holds no scene, a file is broken or of another layout, a scene holds no pair, or two
            scenes share a name.
        ValueError: the format is unknown.
        ImportError: the package that reads the format is not installed.
    """
    if data_format not in FORMATS:
        raise ValueError(f"format: expected one of {', '.join(FORMATS)}, got {data_format!r}")
    folder = None if images is None else Path(images)
    sources = [source for path in paths for source in FORMATS[data_format](Path(path), folder)]
    for source in sources:
        if len(source) == 0:
            raise DatasetError(f"{source.path}: holds no pair")
    names = [source.scene for source in sources]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise DatasetError(f"scenes of the same name: {', '.join(repeated)}")
    return sources


__all__ = ["FORMATS", "PairSource", "open_sources"]
