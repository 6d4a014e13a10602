"""Fixtures: two-view scenes with a known pose, and a tiny model that obeys the ONNX contract."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import multi_view
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from mgca_filter import MatchFilter
from mgca_filter.fit.choice import fitted_coefficients
from mgca_filter.geometry.epipolar import essential_from_pose
from mgca_filter.geometry.pose_refinement import rotation_from_vector
from mgca_filter.inputs.attributes import MatchAttributes

# Benchmarks are no part of the package: they come from the checkout, behind whatever package is installed.
sys.path.append(str(Path(__file__).parent.parent))

K = np.array([[800.0, 0.0, 319.5], [0.0, 800.0, 239.5], [0.0, 0.0, 1.0]])
SIZE = (640, 480)


@pytest.fixture(autouse=True)
def package_log() -> Iterator[None]:
    """What a command does to the package's log, such as ``--quiet``, ends with its test."""
    log = logging.getLogger("mgca_filter")
    level, handlers = log.level, log.handlers[:]
    yield
    log.setLevel(level)
    log.handlers[:] = handlers


@dataclass(frozen=True)
class Scene:
    """Synthetic pair: pixels (M, 2) under ``K``, which rows are right, pose, attributes as a matcher gives them."""

    points1: np.ndarray
    points2: np.ndarray
    inlier: np.ndarray
    R: np.ndarray
    t: np.ndarray
    attributes: MatchAttributes

    @property
    def E(self) -> np.ndarray:
        return essential_from_pose(self.R, self.t)

    def keypoints(self) -> tuple[list[cv2.KeyPoint], list[cv2.KeyPoint]]:
        return tuple([cv2.KeyPoint(float(x), float(y), 4.0, 30.0) for x, y in p] for p in (self.points1, self.points2))

    def knn_matches(self) -> list[tuple[cv2.DMatch, cv2.DMatch]]:
        ratio = self.attributes.ratio
        return [
            (cv2.DMatch(i, i, 100.0 * float(ratio[i])), cv2.DMatch(i, (i + 1) % len(ratio), 100.0))
            for i in range(len(ratio))
        ]


def make_scene(kind: str = "general", right: int = 120, wrong: int = 80, noise_px: float = 0.3, seed: int = 0) -> Scene:
    """A scene of ``kind`` general, wide, skew, planar, rotation or collinear, with wrong matches drawn at random.

    In skew the viewing axes pass each other, so that the matches determine the focal length.
    """
    rng = np.random.default_rng(seed)
    R = rotation_from_vector(np.array([0.1, -0.5, 0.1]) if kind == "wide" else np.array([0.05, -0.12, 0.03]))
    move = {"rotation": [0.0, 0.0, 0.0], "wide": [3.0, 0.3, 1.0], "skew": [1.0, 0.6, 0.5]}.get(kind, [1.0, 0.2, 0.1])
    t = np.array(move)
    pixels = rng.uniform([20, 20], [620, 460], (right, 2))
    depth = rng.uniform(4, 11, right)
    if kind == "planar":  # 1 / depth is affine in the pixels on any plane
        depth = 1.0 / (0.2 + 0.05 * (pixels[:, 0] - 320) / 320)
    if kind == "collinear":
        pixels = np.stack([pixels[:, 0], 0.5 * pixels[:, 0] + 60], axis=1)
        depth = np.full(right, 5.0)
    X1 = np.column_stack([(pixels - K[:2, 2]) / K[0, 0], np.ones(right)]) * depth[:, None]
    X2 = X1 @ R.T + t
    pixels2 = X2[:, :2] / X2[:, 2:] * K[0, 0] + K[:2, 2]
    points1 = np.vstack([pixels, rng.uniform([0, 0], SIZE, (wrong, 2))])
    points2 = np.vstack([pixels2, rng.uniform([0, 0], SIZE, (wrong, 2))])
    points1, points2 = (
        points1 + rng.normal(0, noise_px, points1.shape),
        points2 + rng.normal(0, noise_px, points2.shape),
    )
    inlier = np.arange(right + wrong) < right
    ratio = np.where(inlier, rng.uniform(0.3, 0.85, len(inlier)), rng.uniform(0.7, 1.0, len(inlier)))
    rows = rng.permutation(len(inlier))
    unit = t / np.linalg.norm(t) if t.any() else t
    attributes = MatchAttributes(ratio=ratio[rows].astype(np.float32), best=np.ones(len(rows), dtype=bool))
    return Scene(points1[rows], points2[rows], inlier[rows], R, unit, attributes)


METADATA = {
    "contract_version": "2",
    "name": "ratio_test",
    "version": "0",
    "git_commit": "none",
    "training_data": "none",
    "detector": "any",
    "config": "{}",
    "normalization": "none",
    "calibration": json.dumps({"scale": 1.0, "offset": 0.0}),
    "decision_threshold": "0.0",
    "candidate_rule": json.dumps({"max_ratio": 0.95, "min_count": 32}),
    "prior": json.dumps({"weight1": [[1.0, 0, 0, 0, 0, 0, 0, 0]], "bias1": [0.0], "weight2": [-8.0], "bias2": 3.0}),
    "choice": json.dumps(fitted_coefficients()),
    "license": "none",
    "minimum_onnxruntime": "1.17",
}


# A move to the right without turning, which no scene of the tests makes.
SIDEWAYS = np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0]]) / np.sqrt(2)


def build_model(
    path: Path,
    metadata: dict[str, str] | None = None,
    input_names: tuple[str, str] = ("correspondences", "attributes"),
    output_names: tuple[str, str] = ("logits", "essential"),
    essential: np.ndarray = SIDEWAYS,
) -> Path:
    """Write a model of the contract: logit = 8 (0.8 − ratio), the same essential matrix (3, 3) for every pair.

    Where the ratio is unknown (zero) every match is accepted.
    """
    constants = {
        "weight": np.array([[-8.0], [0], [0], [0], [0], [0], [0], [0]], dtype=np.float32),
        "bias": np.array([6.4], dtype=np.float32),
        "axis": np.array([-1], dtype=np.int64),
        "essential_of_all": essential.astype(np.float32)[None],
        "zero": np.zeros((1,), dtype=np.float32),
        "both": np.array([1, 2], dtype=np.int64),
    }
    nodes = [
        helper.make_node("MatMul", [input_names[1], "weight"], ["product"]),
        helper.make_node("Add", ["product", "bias"], ["biased"]),
        helper.make_node("Squeeze", ["biased", "axis"], [output_names[0]]),
        helper.make_node("ReduceMean", [input_names[0]], ["mean"], axes=[1, 2], keepdims=1),
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "essential_of_all"], [output_names[1]]),
    ]
    graph = helper.make_graph(
        nodes,
        "ratio_test",
        [
            helper.make_tensor_value_info(input_names[0], TensorProto.FLOAT, ["B", "N", 4]),
            helper.make_tensor_value_info(input_names[1], TensorProto.FLOAT, ["B", "N", 8]),
        ],
        [
            helper.make_tensor_value_info(output_names[0], TensorProto.FLOAT, ["B", "N"]),
            helper.make_tensor_value_info(output_names[1], TensorProto.FLOAT, ["B", 3, 3]),
        ],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, METADATA if metadata is None else metadata)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
    return path


@pytest.fixture(scope="session")
def model_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """ONNX file whose logits are a soft ratio test."""
    return build_model(tmp_path_factory.mktemp("model") / "ratio_test.onnx")


@pytest.fixture
def match_filter(model_file: Path) -> MatchFilter:
    return MatchFilter(model=model_file)


@pytest.fixture
def scene() -> Scene:
    """120 right and 80 wrong matches of a general scene."""
    return make_scene()


@pytest.fixture(scope="session")
def views() -> list[multi_view.View]:
    return multi_view.render_views(4)


@pytest.fixture(scope="session")
def raw_matches(views):
    return multi_view.raw_matches(views)


@pytest.fixture
def image_folder(tmp_path, views) -> Path:
    """The views as files, and one file that is no image."""
    folder = tmp_path / "images"
    folder.mkdir()
    for view in views:
        cv2.imwrite(str(folder / view.name), view.image)
    return folder
