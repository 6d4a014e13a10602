"""The demo that runs in a browser: ``demo/`` of the site, static files that load nothing from elsewhere.

``docs/demo`` holds the page and its worker. Added here are pairs with matches made by the package, the model files with
their metadata, the viewer of the HTML report, and files of two npm packages (``docs/demo/package-lock.json``). Where
npm is missing or cannot reach its registry the page is there and says that it cannot score. By hand::

    python docs/extensions/browser_demo.py FOLDER
"""

from __future__ import annotations

import argparse
import base64
import importlib
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT)]

from mgca_filter.features import create_detector, detect_keypoints, match_descriptors  # noqa: E402
from mgca_filter.geometry.epipolar import (  # noqa: E402
    essential_from_pose,
    fundamental_from_essential,
    sampson_distance,
)
from mgca_filter.html_report.embedded import embed_images, pack_mask  # noqa: E402
from mgca_filter.html_report.page import asset, build_page, plain  # noqa: E402
from mgca_filter.html_report.pair_report import RIGHT_PX  # noqa: E402
from mgca_filter.inference.model_file import ModelFile  # noqa: E402
from mgca_filter.inputs.pair import MatchPair, prepare_pair  # noqa: E402
from mgca_filter.match_filter import PUBLISHED_MODELS, filter_matches, model_path  # noqa: E402
from mgca_filter.result import FilterResult  # noqa: E402
from mgca_filter.verdict_text import describe_verdict  # noqa: E402

if TYPE_CHECKING:
    from sphinx.application import Sphinx

PAGE = ROOT / "docs" / "demo"
PAGE_FILES = ("index.html", "demo.css", "demo.js", "worker.js", "scores.js", "features.js")
METADATA = ("decision_threshold", "calibration", "candidate_rule", "prior")
LIBRARIES = {
    "ort.wasm.min.js": "onnxruntime-web/dist",
    "ort-wasm-simd-threaded.mjs": "onnxruntime-web/dist",
    "ort-wasm-simd-threaded.wasm": "onnxruntime-web/dist",
    "opencv.js": "@techstark/opencv-js/dist",
}
"""Files that the page loads, and where they lie in ``node_modules``."""
IMAGE_BYTES = 400_000


@dataclass(frozen=True)
class Pair:
    """Two BGR images of cameras K1, K2 (3, 3) and, where they show one place, the pose X2 = R X1 + t."""

    title: str
    images: tuple[NDArray[np.uint8], NDArray[np.uint8]]
    K1: ArrayLike
    K2: ArrayLike
    R: ArrayLike | None = None
    t: ArrayLike | None = None

    def describe(self) -> dict[str, Any]:
        """What the page reads: images, matches with all that is known of them, and which of them are right."""
        detector = create_detector("rootsift")
        (kp1, descriptors1), (kp2, descriptors2) = (detect_keypoints(image, detector) for image in self.images)
        matches = match_descriptors(descriptors1, descriptors2)
        prepared = prepare_pair(MatchPair(kp1, kp2, matches, K1=self.K1, K2=self.K2))
        result = filter_matches(kp1, kp2, matches, K1=self.K1, K2=self.K2)
        points = np.hstack([prepared.points1, prepared.points2])  # (M, 4)
        F, right = None, np.zeros(len(points), dtype=bool)
        if self.R is not None and self.t is not None:
            F = fundamental_from_essential(essential_from_pose(self.R, self.t), self.K1, self.K2)
            right = sampson_distance(points, F) < RIGHT_PX
        return {
            "names": ["image 1", "image 2"],
            "sizes": [image.shape[1::-1] for image in self.images],
            "images": embed_images(self.images, IMAGE_BYTES),
            "K1": self.K1,
            "K2": self.K2,
            "points": encode_floats(points),
            "attributes": encode_floats(prepared.attributes),
            "right": pack_mask(right),
            "true_F": F,
            "remark": f"With the robust fit the package keeps {result.num_inliers}: {_sentence(result)}",
        }


def _sentence(result: FilterResult) -> str:
    """The verdict of the package, to stand within a sentence."""
    headline = describe_verdict(str(result.status)).headline
    return headline[0].lower() + headline[1:]


def encode_floats(values: NDArray[Any]) -> str:
    """Numbers as base64 of little-endian float32, row by row."""
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode("ascii")


def rendered_pairs() -> Iterator[Pair]:
    """The example pair, three of the courtyard's views, and one of images that have nothing in common."""
    sys.path.insert(0, str(ROOT / "examples"))
    views = importlib.import_module("render_views").render_views(7, supersampling=1)
    textures = importlib.import_module("render_pair").TEXTURES
    sys.path.remove(str(ROOT / "examples"))
    folder = ROOT / "examples" / "images"
    truth = json.loads((folder / "pair.json").read_text(encoding="utf-8"))
    left, right = (cv2.imread(str(folder / truth[name])) for name in ("image1", "image2"))
    yield Pair("Courtyard, 5.5 m apart", (left, right), *(truth[name] for name in ("K1", "K2", "R", "t")))
    for title, i, j in (("Other light", 2, 4), ("Few right matches", 0, 2), ("Turned and far apart", 1, 5)):
        one, two = views[i], views[j]
        R = two.R @ one.R.T
        yield Pair(title, (one.image, two.image), one.K, two.K, R, two.t - R @ one.t)
    images = tuple(cv2.imread(str(textures / name)) for name in ("coffee.png", "chelsea.png"))
    cameras = [
        [[1.2 * w, 0, (w - 1) / 2], [0, 1.2 * w, (h - 1) / 2], [0, 0, 1]] for h, w in (i.shape[:2] for i in images)
    ]
    yield Pair("Nothing in common", (images[0], images[1]), *cameras)


def build(folder: Path) -> str:
    """Write the demo into a folder, which is made.

    Returns:
        Why the page cannot score, the reason that npm gave; empty where it can.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in PAGE_FILES:
        shutil.copyfile(PAGE / name, folder / name)
    (folder / "style.css").write_text(asset("style.css"), encoding="utf-8")
    scripts = ("shell.js", "matches.js", "viewer.js", "panels.js", str(PAGE / "answer.js"))
    page = build_page("Answer", str(PAGE / "answer.html"), {}, scripts, {})
    (folder / "answer.html").write_text(page, encoding="utf-8")
    pairs, models = [], {}
    for number, pair in enumerate(rendered_pairs()):
        pairs.append({"title": pair.title, "file": f"pair{number}.json"})
        (folder / pairs[-1]["file"]).write_text(json.dumps(plain(pair.describe())), encoding="utf-8")
    for path in map(model_path, PUBLISHED_MODELS):
        shutil.copyfile(path, folder / path.name)
        properties = ModelFile.read(path).properties
        models[path.stem] = {key: json.loads(properties[key]) for key in METADATA}
    reason = fetch_libraries(folder)
    settings = {"complete": not reason, "pairs": pairs, "models": models}
    (folder / "settings.json").write_text(json.dumps(settings), encoding="utf-8")
    return reason


def fetch_libraries(folder: Path) -> str:
    """Copy :data:`LIBRARIES` out of the npm packages, whose digests the lock file holds; why not, where it fails."""
    npm = shutil.which("npm")
    if npm is None:
        return "npm is not installed"
    with tempfile.TemporaryDirectory() as place:
        for name in ("package.json", "package-lock.json"):
            shutil.copyfile(PAGE / name, Path(place) / name)
        options = ("--ignore-scripts", "--no-audit", "--no-fund", "--prefer-offline", "--fetch-retries=0")
        done = subprocess.run([npm, "ci", *options], cwd=place, capture_output=True, text=True)
        if done.returncode != 0:
            return next(iter(done.stderr.splitlines()), f"npm ended with {done.returncode}")
        for name, package in LIBRARIES.items():
            shutil.copyfile(Path(place) / "node_modules" / package / name, folder / name)
        licence = Path(place) / "node_modules" / "@techstark" / "opencv-js" / "LICENSE"
        shutil.copyfile(licence, folder / "opencv.js.LICENSE")
    return ""


def write_demo(app: Sphinx) -> None:
    """The demo in the folder of what the site has beside its pages."""
    if app.builder.format != "html":
        return
    reason = build(Path(app.config.html_extra_path[0]) / "demo")
    if reason:
        print(f"demo: the page cannot score, {reason}")


def setup(app: Sphinx) -> dict[str, Any]:
    """Called by Sphinx."""
    app.connect("builder-inited", write_demo)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def main() -> int:
    """Build the demo alone."""
    parser = argparse.ArgumentParser(
        description="Build the demo that runs in a browser, to be served by any web server."
    )
    parser.add_argument("folder", type=Path, help="where to, for example site/demo")
    reason = build(parser.parse_args().folder)
    if reason:
        print(f"the page cannot score: {reason}", file=sys.stderr)
    return int(bool(reason))


if __name__ == "__main__":
    sys.exit(main())
