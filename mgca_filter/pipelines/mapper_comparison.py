"""COLMAP's mapper on its own geometric verification of the matches, and on the filter's: what comes out of each."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from ..geometry.epipolar import pose_error_deg
from .colmap import copy_database, open_database
from .journal import PipelineError

_SEED = 0
# COLMAP's default of 10 would hide what it made of a small scene.
_MIN_MODEL_SIZE = 3
_CORRECT_DEG = 5.0


@dataclass(frozen=True)
class ModelStatistics:
    """The largest model that the mapper made of one verification.

    Attributes:
        name: whose verification.
        verified_pairs: image pairs with enough inlier matches for the mapper.
        registered_images, points, mean_track_length, reprojection_error_px: of the largest model; nan without one.
        models: number of models.
        verification_s, mapper_s: seconds.
        pose_errors_deg: pose error of every pair of images of the ground truth, 180 where one is not registered;
            None without ground truth.
    """

    name: str
    verified_pairs: int
    registered_images: int
    models: int
    points: int
    mean_track_length: float
    reprojection_error_px: float
    verification_s: float
    mapper_s: float
    pose_errors_deg: list[float] | None = None


def compare(database: Path, verification_s: float, truth: Path | None, workers: int) -> list[ModelStatistics]:
    """Run the mapper twice, on copies: after COLMAP's verification of the matches, and on the geometries as they are.

    Args:
        database: with our ``two_view_geometries``. verification_s: what they took, for the table.
        truth: folder of a COLMAP model with the true poses, images matched by name, or None.
        workers: threads of COLMAP.

    Raises:
        PipelineError: ``truth`` is no COLMAP model.
    """
    true_model = None if truth is None else _read_model(truth)
    with tempfile.TemporaryDirectory() as folder:
        theirs, ours = Path(folder) / "colmap.db", Path(folder) / "mgca_filter.db"
        for copy in (theirs, ours):
            copy_database(database, copy)
        started = time.perf_counter()
        _verify(theirs, workers)
        their_s = time.perf_counter() - started
        return [
            _map("COLMAP", theirs, their_s, true_model, workers),
            _map("mgca_filter", ours, verification_s, true_model, workers),
        ]


def _read_model(folder: Path) -> Any:
    try:
        return pycolmap.Reconstruction(str(folder))
    except (RuntimeError, ValueError) as error:
        raise PipelineError(f"{folder}: not a COLMAP model ({' '.join(str(error).split())})") from error


def _verify(path: Path, workers: int) -> None:
    """COLMAP's geometric verification with its default options."""
    with closing(open_database(path)) as database:
        database.clear_two_view_geometries()
    verifier, options = pycolmap.GeometricVerifierOptions(), pycolmap.TwoViewGeometryOptions()
    verifier.num_threads, options.ransac.random_seed = workers, _SEED
    pycolmap.geometric_verification(path, verifier, pycolmap.ExistingMatchedPairingOptions(), options)


def _map(name: str, path: Path, verification_s: float, truth: Any, workers: int) -> ModelStatistics:
    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors, options.min_model_size = False, _MIN_MODEL_SIZE
    options.num_threads, options.random_seed = workers, _SEED
    with closing(open_database(path)) as database:
        _, counts = database.read_two_view_geometry_num_inliers()
        verified = sum(count >= options.min_num_matches for count in counts)
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as output:
        models = list(pycolmap.incremental_mapping(path, path.parent, output, options).values())
    mapper_s = time.perf_counter() - started
    largest = max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)
    return ModelStatistics(
        name,
        verified,
        0 if largest is None else largest.num_reg_images(),
        len(models),
        0 if largest is None else largest.num_points3D(),
        float("nan") if largest is None else largest.compute_mean_track_length(),
        float("nan") if largest is None else largest.compute_mean_reprojection_error(),
        verification_s,
        mapper_s,
        None if truth is None else _pose_errors(largest, truth),
    )


def _pose_errors(model: Any, truth: Any) -> list[float]:
    """Pose error, degrees, of all pairs of images of ``truth``: relative poses need no alignment of the models."""
    found = {} if model is None else {image.name: image.cam_from_world() for image in _registered(model)}
    true = {image.name: image.cam_from_world() for image in _registered(truth)}
    errors = []
    for name1, name2 in combinations(sorted(true), 2):
        if name1 not in found or name2 not in found:
            errors.append(180.0)
            continue
        estimated, exact = (poses[name2] * poses[name1].inverse() for poses in (found, true))
        matrices = (estimated.rotation.matrix(), estimated.translation, exact.rotation.matrix(), exact.translation)
        errors.append(pose_error_deg(*matrices))
    return errors


def _registered(model: Any) -> list[Any]:
    return [model.image(image_id) for image_id in model.reg_image_ids()]


def comparison_table(statistics: Sequence[ModelStatistics]) -> str:
    """The figures side by side, one row each."""
    rows = [("", [s.name for s in statistics])]
    rows.append(("verified pairs", [f"{s.verified_pairs}" for s in statistics]))
    rows.append(("registered images", [f"{s.registered_images}" for s in statistics]))
    rows.append(("models", [f"{s.models}" for s in statistics]))
    rows.append(("3D points", [f"{s.points}" for s in statistics]))
    rows.append(("mean track length", [f"{s.mean_track_length:.2f}" for s in statistics]))
    rows.append(("reprojection error, px", [f"{s.reprojection_error_px:.3f}" for s in statistics]))
    rows.append(("verification, s", [f"{s.verification_s:.1f}" for s in statistics]))
    rows.append(("mapper, s", [f"{s.mapper_s:.1f}" for s in statistics]))
    errors = [np.array(s.pose_errors_deg) for s in statistics if s.pose_errors_deg is not None]
    if errors:
        registered = [e[e < 180.0] for e in errors]
        medians = [f"{np.median(e):.3f}" if len(e) else "-" for e in registered]
        rows.append(("median pose error, deg", medians))
        rows.append(
            (
                f"pairs of images within {_CORRECT_DEG:g} deg, %",
                [f"{100 * np.mean(e < _CORRECT_DEG):.0f}" for e in errors],
            )
        )
    width = max(len(label) for label, _ in rows)
    return "\n".join(f"{label:<{width}}" + "".join(f"{value:>14}" for value in values) for label, values in rows)
