"""The installed package does its work: ``python .ci/smoke.py`` in any environment, prints versions and what was done.

Only what the package needs is imported: numpy, OpenCV, ONNX Runtime. An assertion that fails ends it with a traceback.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import onnxruntime

import mgca_filter

IMAGES = Path(__file__).resolve().parent.parent / "examples" / "images"
LEFT, RIGHT = IMAGES / "left.jpg", IMAGES / "right.jpg"
LIMIT_DEG = 2.0


def pose_error_deg(R: np.ndarray, t: np.ndarray, truth: dict) -> float:
    """The larger angle, of rotation and of translation."""
    cosine = (np.trace(np.asarray(R) @ np.transpose(truth["R"])) - 1) / 2
    direction = np.dot(np.ravel(t), truth["t"]) / np.linalg.norm(t) / np.linalg.norm(truth["t"])
    return float(np.degrees(np.arccos(np.clip([cosine, direction], -1, 1))).max())


def main() -> None:
    """Library, twins, command."""
    truth = json.loads((IMAGES / "pair.json").read_text())
    K = np.array(truth["K1"])
    image1, image2 = cv2.imread(str(LEFT)), cv2.imread(str(RIGHT))

    result = mgca_filter.match_images(image1, image2, K1=K, effort="full").result
    assert result.ok, result
    assert pose_error_deg(result.R, result.t, truth) < LIMIT_DEG

    sift = cv2.SIFT.create(nfeatures=2000, contrastThreshold=1e-5)
    (kp1, d1), (kp2, d2) = (sift.detectAndCompute(image, None) for image in (image1, image2))
    matches = cv2.BFMatcher().knnMatch(d1, d2, k=2)
    for options in (
        {},
        {"method": "magsac"},
        {"method": "prosac"},
        {"geometry": "fundamental"},
        {"keep_precision": 0.6},
    ):
        result = mgca_filter.filter_matches(kp1, kp2, matches, K1=K, **options)
        assert result.ok, (options, result)
        assert result.num_inliers > 100, (options, result)
    assert mgca_filter.filter_matches(kp1, kp2, matches).F is not None

    points1 = np.float64([kp1[row[0].queryIdx].pt for row in matches])
    points2 = np.float64([kp2[row[0].trainIdx].pt for row in matches])
    with mgca_filter.patch_cv2():
        E, mask = cv2.findEssentialMat(points1, points2, K, cv2.RANSAC, 0.999, 1.0)
        _, R, t, _ = cv2.recoverPose(E, points1, points2, K, mask=mask)
        cv2.findHomography(points1, points2, cv2.RANSAC, 3.0)
    assert pose_error_deg(R, t, truth) < LIMIT_DEG

    with tempfile.TemporaryDirectory() as folder:
        files = ["-o", "m.png", "--json", "m.json", "--npz", "m.npz", "--html", "m.html", "--compare"]
        command = [sys.executable, "-m", "mgca_filter", str(LEFT), str(RIGHT), "--K", "820,820,511.5,383.5", *files]
        done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
        assert (done.returncode, done.stderr) == (0, ""), done
        found = json.loads(Path(folder, "m.json").read_text())
        assert pose_error_deg(found["R"], found["t"], truth) < LIMIT_DEG
        orb = subprocess.run(
            [*command[: -len(files)], "--detector", "orb", "-q"], capture_output=True, text=True, cwd=folder
        )
        assert (orb.returncode, orb.stdout, orb.stderr) == (0, "", ""), orb
    versions = f"numpy {np.__version__}, OpenCV {cv2.__version__}, ONNX Runtime {onnxruntime.__version__}"
    print(f"ok: Python {sys.version.split()[0]}, {versions}, mgca_filter {mgca_filter.__version__}")


if __name__ == "__main__":
    main()
