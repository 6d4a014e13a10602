"""Clean matches, COLMAP's own: what does the filter cost over them, against COLMAP's verification, and what is left?

COLMAP extracts, matches and verifies a folder of images (rendered by examples/render_views.py unless one is given);
the matches that its verification keeps are then verified once more by COLMAP and by the filter, pair by pair in turn on
one thread, and its mapper runs on what each of them keeps.

    python -m benchmarks.clean_matches [FOLDER] [--views 8] [--repeats 3]

Times are the processor's, sums over the pairs of the least of the repeats; the target is three times COLMAP's own, with
no fewer points. The filter knows what the database holds: intrinsics, keypoint sizes and angles, descriptors.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mgca_filter.evaluation.environment import CpuMeter
from mgca_filter.tables import render_table

from .study import run_study, study_parser

ROOT = Path(__file__).resolve().parent.parent
RENDERED_CAMERA = ("PINHOLE", "512,512,320,240")  # in COLMAP's pixels
TARGET_RATIO = 3.0
MIN_MODEL_SIZE = 3


@dataclass(frozen=True)
class Verification:
    """What one verification of the clean matches took and left.

    Attributes:
        name: whose. pairs: with a geometry. matches: kept, over all pairs. ms: processor time, over all pairs.
        images, points: of the largest model that COLMAP's mapper makes of what it kept.
    """

    name: str
    pairs: int
    matches: int
    ms: float
    images: int
    points: int


def render_views(folder: Path, count: int) -> Path:
    """Rendered views in a folder below ``folder``."""
    render = [sys.executable, str(ROOT / "examples" / "render_views.py"), "--count", str(count)]
    subprocess.run([*render, "--out", str(folder), "--supersampling", "1"], check=True, capture_output=True)
    return folder / "images"


def verified_by_colmap(
    images: Path, database: Path, camera: tuple[str, str] | None, seed: int
) -> dict[tuple[int, int], NDArray[np.uint32]]:
    """Make a database of the images, and return the matches (M, 2) that COLMAP's verification keeps of each pair.

    Args:
        camera: COLMAP's model and parameters of all images; None leaves the focal length to their EXIF data.

    Raises:
        ValueError: no pair has any.
    """
    import pycolmap

    reader = pycolmap.ImageReaderOptions()
    if camera is not None:
        reader.camera_model, reader.camera_params = camera
    one_camera = pycolmap.CameraMode.AUTO if camera is None else pycolmap.CameraMode.SINGLE
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pycolmap.extract_features(database, images, [], one_camera, reader, device=pycolmap.Device.cpu)
    pycolmap.match_exhaustive(database, verification_options=verification, device=pycolmap.Device.cpu)
    with closing(pycolmap.Database.open(database)) as opened:
        ids, geometries = opened.read_two_view_geometries()
    pairs = [pycolmap.pair_id_to_image_pair(pair_id) for pair_id in ids]
    kept = {pair: geometry.inlier_matches for pair, geometry in zip(pairs, geometries) if len(geometry.inlier_matches)}
    if not kept:
        raise ValueError(f"{images}: COLMAP's verification keeps no match of any pair")
    return kept


def compare(
    database: Path, matches: dict[tuple[int, int], NDArray[np.uint32]], repeats: int, seed: int, model: str | None
) -> list[Verification]:
    """COLMAP's verification and the filter's on the same matches (M, 2) of each pair of image ids."""
    import pycolmap

    from mgca_filter.pipelines.colmap import DatabaseSource, open_database, two_view_geometry
    from mgca_filter.pipelines.worker import MAPPING_THRESHOLD_PX, PairWorker

    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    worker = PairWorker({"seed": seed, "model": model, "threshold": MAPPING_THRESHOLD_PX})
    ms = {"COLMAP": 0.0, "mgca_filter": 0.0}
    geometries: dict[str, dict[tuple[int, int], Any]] = {name: {} for name in ms}
    with closing(open_database(database)) as opened:
        source = DatabaseSource(opened, True)
        names = {image_id: name for name, image_id in source.ids.items()}
        features = {image_id: source.image(name) for image_id, name in names.items()}
        cameras = {image_id: opened.read_camera(opened.read_image(image_id).camera_id) for image_id in names}
        points = {image_id: opened.read_keypoints(image_id)[:, :2].astype(np.float64) for image_id in names}
    for (id1, id2), rows in matches.items():
        theirs = (cameras[id1], points[id1], cameras[id2], points[id2], rows, options)
        ours = (names[id1], names[id2], features[id1], features[id2], rows)
        found, taken = in_turn(
            {
                "COLMAP": lambda: pycolmap.estimate_two_view_geometry(*theirs),  # noqa: B023
                "mgca_filter": lambda: two_view_geometry(worker.filter(*ours)),  # noqa: B023
            },
            repeats,
        )
        for name, geometry in found.items():
            geometries[name][id1, id2] = geometry
            ms[name] += taken[name]
    return [Verification(name, *counts(kept), ms[name], *mapped(database, kept)) for name, kept in geometries.items()]


def in_turn(calls: dict[str, Callable[[], Any]], repeats: int) -> tuple[dict[str, Any], dict[str, float]]:
    """Answers and least processor times, ms, of calls that take turns, after one that warms up."""
    answers, best = {}, dict.fromkeys(calls, float("inf"))
    for turn in range(repeats + 1):
        for name, call in calls.items():
            started = time.process_time()
            answers[name] = call()
            if turn:
                best[name] = min(best[name], 1e3 * (time.process_time() - started))
    return answers, best


def counts(geometries: dict[tuple[int, int], Any]) -> tuple[int, int]:
    """Pairs with matches, and their matches."""
    kept = [len(geometry.inlier_matches) for geometry in geometries.values()]
    return sum(count > 0 for count in kept), sum(kept)


def mapped(database: Path, geometries: dict[tuple[int, int], Any]) -> tuple[int, int]:
    """Images and points of the largest model that COLMAP's mapper makes of the geometries; (0, 0) without one."""
    import pycolmap

    from mgca_filter.pipelines.colmap import copy_database

    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors, options.min_model_size = False, MIN_MODEL_SIZE
    options.num_threads, options.random_seed = 1, 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy.db"
        copy_database(database, copy)
        with closing(pycolmap.Database.open(copy)) as opened, pycolmap.DatabaseTransaction(opened):
            opened.clear_two_view_geometries()
            for pair, geometry in geometries.items():
                opened.write_two_view_geometry(*pair, geometry)
        models = pycolmap.incremental_mapping(copy, folder, folder, options).values()
        sizes = [(model.num_reg_images(), model.num_points3D()) for model in models]
    return max(sizes, default=(0, 0))


def comparison_table(verifications: Sequence[Verification]) -> str:
    """A row each; ratios are to the first."""
    first = verifications[0]
    body = [
        [v.name, str(v.pairs), str(v.matches), f"{v.ms:.1f}", f"{v.ms / first.ms:.2f}", str(v.images), str(v.points)]
        for v in verifications
    ]
    header = ["verification", "pairs", "matches kept", "ms", "ratio", "images mapped", "3D points"]
    return render_table(header, body)


def run(options: argparse.Namespace) -> int:
    """Print the table."""
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        images = options.images or render_views(folder, options.views)
        camera = None if options.images else RENDERED_CAMERA
        matches = verified_by_colmap(images, folder / "colmap.db", camera, options.seed)
        meter = CpuMeter()
        verifications = compare(folder / "colmap.db", matches, options.repeats, options.seed, options.model)
        load = meter.others_load()
    total = sum(map(len, matches.values()))
    print(
        f"{len(matches)} pairs with {total} matches that COLMAP's verification keeps, verified again, one thread; "
        f"other programs used {load:.1f} processors meanwhile. Target: ratio {TARGET_RATIO:g}, no fewer points.\n\n"
        f"{comparison_table(verifications)}"
    )
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; exit status as of :func:`benchmarks.study.run_study`."""
    parser = study_parser("clean_matches", __doc__, per_scene=False)
    parser.add_argument("images", type=Path, nargs="?", help="folder of images instead of rendered views")
    parser.add_argument("--views", type=int, default=8, help="how many views to render")
    parser.add_argument("--repeats", type=int, default=3)
    return run_study(run, parser.parse_args(arguments))


if __name__ == "__main__":
    sys.exit(main())
