"""Draws the README's picture: RANSAC alone above, mgca_filter below, on the same raw matches of the example pair.

``python examples/before_after.py [--out docs/before_after.jpg]``
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import cv2
import numpy as np

import mgca_filter
from mgca_filter.drawing import MatchPanel, draw_before_after
from mgca_filter.geometry.epipolar import pose_error_deg

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "examples" / "images"
GOOD_POSE_DEG = 5.0


def panel(name: str, mask: np.ndarray, pose: tuple, truth: dict, elapsed_ms: float) -> MatchPanel:
    """Header and mask of one row, with the pose error against the exact pose."""
    facts = [f"{len(mask)} matches in", f"{int(mask.sum())} kept"]
    if any(part is None for part in pose):
        return MatchPanel(mask, name, [*facts, "no pose"], success=False)
    error_deg = pose_error_deg(*pose, truth["R"], truth["t"])
    facts += [f"pose error {error_deg:.1f} deg", f"{elapsed_ms:.0f} ms"]
    return MatchPanel(mask, name, facts, success=error_deg < GOOD_POSE_DEG)


def main() -> None:
    """Match, filter both ways, draw."""
    parser = argparse.ArgumentParser(description="Draw RANSAC alone and mgca_filter on the example pair.")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "before_after.jpg")
    options = parser.parse_args()
    truth = json.loads((FOLDER / "pair.json").read_text())
    K = np.array(truth["K1"])
    image1, image2 = (cv2.imread(str(FOLDER / truth[name])) for name in ("image1", "image2"))

    mgca_filter.match_images(image1, image2, K1=K)  # the first run loads the model
    matched = mgca_filter.match_images(image1, image2, K1=K)
    points1 = np.float64([matched.keypoints1[row[0].queryIdx].pt for row in matched.matches])
    points2 = np.float64([matched.keypoints2[row[0].trainIdx].pt for row in matched.matches])
    start = time.perf_counter()
    E, mask = cv2.findEssentialMat(points1, points2, K, cv2.RANSAC, 0.999, 1.0)
    ransac_ms = 1e3 * (time.perf_counter() - start)
    _, R, t, _ = cv2.recoverPose(E, points1, points2, K, mask=mask.copy())

    result = matched.result
    ours_ms = result.info["timings_ms"]["total"]
    before = panel("RANSAC alone", mask.ravel() > 0, (R, t), truth, ransac_ms)
    after = panel("mgca_filter", result.mask, (result.R, result.t), truth, ours_ms)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(options.out), draw_before_after(image1, image2, points1, points2, before, after))
    print(f"wrote {options.out}: {before.title}, {', '.join(before.facts)}; {after.title}, {', '.join(after.facts)}")


if __name__ == "__main__":
    main()
