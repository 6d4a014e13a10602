"""One call replaced: cv2.findEssentialMat + recoverPose, and mgca_filter.filter_matches on the same matches.

    python examples/replace_find_essential_mat.py

The pair is rendered, so its pose is exact; the errors printed are in degrees, the larger of rotation and translation.
"""

import json
from pathlib import Path

import cv2
import numpy as np

import mgca_filter
from mgca_filter.geometry.epipolar import pose_error_deg

FOLDER = Path(__file__).parent / "images"


def main() -> None:
    """Match the example pair and estimate its pose both ways."""
    truth = json.loads((FOLDER / "pair.json").read_text())
    K = np.array(truth["K1"])
    image1 = cv2.imread(str(FOLDER / truth["image1"]), cv2.IMREAD_GRAYSCALE)
    image2 = cv2.imread(str(FOLDER / truth["image2"]), cv2.IMREAD_GRAYSCALE)

    sift = cv2.SIFT_create(nfeatures=2000, contrastThreshold=1e-5)
    kp1, descriptors1 = sift.detectAndCompute(image1, None)
    kp2, descriptors2 = sift.detectAndCompute(image2, None)
    matches = cv2.BFMatcher().knnMatch(descriptors1, descriptors2, k=2)

    # Before
    points1 = np.float64([kp1[m.queryIdx].pt for m, _ in matches])
    points2 = np.float64([kp2[m.trainIdx].pt for m, _ in matches])
    E, mask = cv2.findEssentialMat(points1, points2, K, cv2.RANSAC, 0.999, 1.0)
    _, R, t, _ = cv2.recoverPose(E, points1, points2, K, mask=mask.copy())
    report("cv2.findEssentialMat", int(mask.sum()), R, t, truth)

    # After
    result = mgca_filter.filter_matches(kp1, kp2, matches, K1=K)
    report("mgca_filter", result.num_inliers, result.R, result.t, truth)


def report(name: str, kept: int, R: np.ndarray | None, t: np.ndarray | None, truth: dict) -> None:
    """Print one line: matches kept and pose error."""
    if R is None or t is None:
        print(f"{name:<22} {kept:>5} kept, no pose")
        return
    print(f"{name:<22} {kept:>5} kept, pose error {pose_error_deg(R, t, truth['R'], truth['t']):6.2f} deg")


if __name__ == "__main__":
    main()
