"""AdaLAM (Cavalli et al., ECCV 2020) as a test of putative matches, by kornia's implementation."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.scene_bundle import ScenePair


def adalam_versions() -> dict[str, str]:
    """Versions of the packages that do it.

    Raises:
        ImportError: kornia or torch is not installed.
    """
    import kornia
    import torch

    return {"kornia": kornia.__version__, "torch": torch.__version__}


def locally_affine_matches(pair: ScenePair) -> NDArray[np.bool_]:
    """Matches (M,) that AdaLAM keeps, at kornia's defaults and on one thread.

    It wants unfiltered nearest neighbours with their ratio. Seeds are mutual matches, scored by the squared ratio as
    in kornia's own matcher. Where a keypoint's size or angle is unknown, that consistency is not asked for.

    Raises:
        ValueError: the pair has no ratios.
    """
    import torch
    from kornia.feature.adalam.adalam import AdalamFilter, get_adalam_default_config

    attributes, count = pair.attributes, len(pair.points1)
    if attributes.ratio is None:
        raise ValueError("AdaLAM needs the distance ratios of the matches")
    if count == 0:
        return np.zeros(0, dtype=bool)

    def tensor(values: Any) -> Any:
        return None if values is None else torch.as_tensor(np.asarray(values, dtype=np.float32))

    config: Any = get_adalam_default_config()
    if attributes.size1 is None or attributes.size2 is None:
        config["scale_rate_threshold"] = None
    if attributes.angle1 is None or attributes.angle2 is None:
        config["orientation_difference_threshold"] = None
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        found = AdalamFilter(config).filter_matches(
            tensor(pair.points1),
            tensor(pair.points2),
            torch.arange(count),
            tensor(np.square(np.where(np.isfinite(attributes.ratio), attributes.ratio, 1.0))),
            torch.as_tensor(pair.mutual),
            pair.image_size1,
            pair.image_size2,
            tensor(attributes.angle1),
            tensor(attributes.angle2),
            tensor(attributes.size1),
            tensor(attributes.size2),
        )
    finally:
        torch.set_num_threads(threads)
    kept = np.zeros(count, dtype=bool)
    kept[np.asarray(found)[:, 0]] = True
    return kept
