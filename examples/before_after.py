"""Draws the README's picture: what OpenCV's RANSAC keeps, and below it what mgca_filter keeps, of the same raw matches.

``python examples/before_after.py [--out docs/before_after.jpg]``

Matches that are right by the exact pose of the rendered pair are blue, wrong ones orange.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np

import mgca_filter
from mgca_filter.drawing import RIGHT_AND_WRONG, MatchPanel, caption, draw_matches
from mgca_filter.geometry.epipolar import (
    essential_from_pose,
    fundamental_from_essential,
    rotation_error_deg,
    sampson_distance,
    translation_error_deg,
)

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "examples" / "images"
RIGHT_PX = 3.0
GOOD_POSE_DEG = 2.0


def panel(name: str, right: np.ndarray, R: np.ndarray | None, t: np.ndarray | None, truth: dict) -> MatchPanel:
    """Header of one row: how many of the kept matches are right (M,), and how far the pose is off."""
    facts = [f"{int(right.sum())} right, {int((~right).sum())} wrong"]
    if R is None or t is None:
        facts.append("no pose")
        good = False
    else:
        turned, moved = rotation_error_deg(R, truth["R"]), translation_error_deg(t, truth["t"])
        facts.append(f"pose: rotation off by {turned:.1f} deg, translation by {moved:.1f} deg")
        good = max(turned, moved) < GOOD_POSE_DEG
    return MatchPanel(right, name, facts, good, ("right", "wrong"), RIGHT_AND_WRONG)


def true_pose(truth: dict) -> str:
    """The pose in words."""
    angle = rotation_error_deg(truth["R"], np.eye(3))
    direction = np.array(truth["t"]) / np.linalg.norm(truth["t"])
    return f"true pose: rotation {angle:.1f} deg, translation ({', '.join(f'{value:+.2f}' for value in direction)})"


def main() -> None:
    """Match, filter both ways, draw."""
    parser = argparse.ArgumentParser(description="Draw what RANSAC and mgca_filter keep of the same matches.")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "before_after.jpg")
    options = parser.parse_args()
    truth = json.loads((FOLDER / "pair.json").read_text())
    K = np.array(truth["K1"])
    image1, image2 = (cv2.imread(str(FOLDER / truth[name])) for name in ("image1", "image2"))

    result = mgca_filter.match_images(image1, image2, K1=K).result
    points1, points2 = result.points1, result.points2
    E, mask = cv2.findEssentialMat(points1, points2, K, cv2.RANSAC, 0.999, 1.0)
    _, R, t, _ = cv2.recoverPose(E, points1, points2, K, mask=mask.copy())

    F = fundamental_from_essential(essential_from_pose(truth["R"], truth["t"]), K, K)
    right = sampson_distance(np.hstack([points1, points2]), F) < RIGHT_PX
    kept = mask.ravel() > 0, result.mask
    before = panel("cv2.findEssentialMat, RANSAC", right[kept[0]], R, t, truth)
    after = panel("mgca_filter", right[kept[1]], result.R, result.t, truth)
    above, below = (
        draw_matches(image1, image2, points1[rows], points2[rows], row) for rows, row in zip(kept, (before, after))
    )
    words = f"{len(right)} raw matches, {int(right.sum())} of them right; {true_pose(truth)}"
    picture = np.vstack([caption(above.shape[1], words), above, below])
    options.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(options.out), picture, [cv2.IMWRITE_JPEG_QUALITY, 85])
    print(words)
    for row in (before, after):
        print(f"{row.title}: {', '.join(row.facts)}")


if __name__ == "__main__":
    main()
