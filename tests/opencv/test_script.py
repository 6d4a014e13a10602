"""``python -m mgca_filter run``: scripts as people write them, unchanged, and the table at their end."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "examples" / "images"

READ = """
import sys
import cv2 as cv
import numpy as np
img1, img2 = (cv.imread(path, cv.IMREAD_GRAYSCALE) for path in sys.argv[1:3])
"""

# In the manner of OpenCV's epipolar-geometry tutorial: SIFT, FLANN, ratio test, F, inliers only.
EPIPOLAR = (
    READ
    + """
sift = cv.SIFT_create(800)
kp1, des1 = sift.detectAndCompute(img1, None)
kp2, des2 = sift.detectAndCompute(img2, None)
matcher = cv.FlannBasedMatcher({"algorithm": 1, "trees": 5}, {"checks": 50})
pts1, pts2 = [], []
for m, n in matcher.knnMatch(des1, des2, k=2):
    if m.distance < 0.8 * n.distance:
        pts1.append(kp1[m.queryIdx].pt)
        pts2.append(kp2[m.trainIdx].pt)
pts1, pts2 = np.int32(pts1), np.int32(pts2)
F, mask = cv.findFundamentalMat(pts1, pts2, cv.FM_LMEDS)
pts1, pts2 = pts1[mask.ravel() == 1], pts2[mask.ravel() == 1]
lines = cv.computeCorrespondEpilines(pts2.reshape(-1, 1, 2), 2, F).reshape(-1, 3)
print(F.shape, len(lines) == len(pts1))
"""
)

# Visual odometry with ORB: cross-checked matches, E twice by keywords with focal length and principal point.
ODOMETRY = (
    READ
    + """
orb = cv.ORB_create(3000)
kp1, des1 = orb.detectAndCompute(img1, None)
kp2, des2 = orb.detectAndCompute(img2, None)
matches = sorted(cv.BFMatcher(cv.NORM_HAMMING, crossCheck=True).match(des1, des2), key=lambda m: m.distance)
p0 = np.float32([kp1[m.queryIdx].pt for m in matches])
p1 = np.float32([kp2[m.trainIdx].pt for m in matches])
for _ in range(2):
    E, mask = cv.findEssentialMat(p1, p0, focal=820.0, pp=(511.5, 383.5), method=cv.RANSAC, prob=0.999, threshold=1.0)
    _, R, t, mask = cv.recoverPose(E, p1, p0, focal=820.0, pp=(511.5, 383.5), mask=mask)
print(mask.dtype, mask.shape == (len(p0), 1))
"""
)

# In the manner of OpenCV's tutorial on finding an object: ratio test, homography, outline of the object.
OBJECT = (
    READ
    + """
sift = cv.SIFT_create(800)
kp1, des1 = sift.detectAndCompute(img1, None)
small = cv.warpPerspective(img1, np.array([[0.5, 0.1, 200], [-0.05, 0.6, 90], [1e-5, 2e-4, 1]]), img1.shape[::-1])
kp2, des2 = sift.detectAndCompute(small, None)
good = [m for m, n in cv.BFMatcher().knnMatch(des1, des2, k=2) if m.distance < 0.7 * n.distance]
src_pts = np.float32([kp1[m.queryIdx].pt for m in good]).reshape(-1, 1, 2)
dst_pts = np.float32([kp2[m.trainIdx].pt for m in good]).reshape(-1, 1, 2)
M, mask = cv.findHomography(src_pts, dst_pts, cv.RANSAC, 5.0)
h, w = img1.shape
outline = cv.perspectiveTransform(np.float32([[0, 0], [w, h]]).reshape(-1, 1, 2), M)
print(len(mask.ravel().tolist()) == len(good), np.round(outline.ravel()[:2], -1) == [200, 90])
"""
)

# GMS in the manner of its demo, with names bound before the call.
GMS = (
    READ
    + """
from cv2.xfeatures2d import matchGMS
orb = cv.ORB_create(2000)
orb.setFastThreshold(0)
kp1, des1 = orb.detectAndCompute(img1, None)
kp2, des2 = orb.detectAndCompute(img2, None)
matches = cv.BFMatcher(cv.NORM_HAMMING).match(des1, des2)
good = matchGMS(img1.shape[:2][::-1], img2.shape[:2][::-1], kp1, kp2, matches, withScale=False, withRotation=False)
print(len(good) <= len(matches), [type(m).__name__ for m in good[:1]])
"""
)


def run(tmp_path: Path, code: str, *arguments: str) -> subprocess.CompletedProcess:
    (tmp_path / "neighbour.py").write_text("VALUE = 3\n")
    script = tmp_path / "script.py"
    script.write_text(code)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "mgca_filter", "run", str(script), *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path)


def table_rows(stderr: str) -> list[list[str]]:
    lines = stderr[stderr.index("mgca_filter in place of OpenCV") :].splitlines()
    return [line.split() for line in lines[2:]]


SCRIPTS = {  # function: script, calls, what it prints
    "findFundamentalMat": (EPIPOLAR, "1", "(3, 3) True"),
    "findEssentialMat": (ODOMETRY, "2", "uint8 True"),
    "xfeatures2d.matchGMS": (GMS, "1", "True ['DMatch']"),
    "findHomography": (OBJECT, "1", "True [ True  True]"),
}


def test_unchanged_scripts_run_with_the_filter(tmp_path: Path) -> None:
    """One after the other in one process, whose start takes longer than they do."""
    code = "".join(script for script, _, _ in SCRIPTS.values())
    done = run(tmp_path, code, str(IMAGES / "left.jpg"), str(IMAGES / "right.jpg"))
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [output for _, _, output in SCRIPTS.values()]
    rows = {row[1]: row for row in table_rows(done.stderr)}
    assert set(rows) == set(SCRIPTS)
    for function, (_, calls, _) in SCRIPTS.items():
        row = rows[function]
        assert row[0].startswith("script.py:")
        assert row[2] == calls
        matches, opencv_kept, ours_kept = int(row[3]), int(row[4]), int(row[7])
        assert 0 < opencv_kept <= matches
        assert 0 < ours_kept <= matches
        assert row[8] == "0"


def test_script_sees_its_own_world(tmp_path: Path) -> None:
    code = """
import sys, neighbour, cv2, numpy as np
print(__name__, sys.argv[1:], neighbour.VALUE)
E, mask = cv2.findEssentialMat(np.zeros((0, 2)), np.zeros((0, 2)), np.eye(3))
print(E, mask.shape)
sys.exit(5)
"""
    done = run(tmp_path, code, "--flag", "value")
    assert done.returncode == 5
    assert done.stdout.splitlines() == ["__main__ ['--flag', 'value'] 3", "None (0, 1)"]
    (row,) = table_rows(done.stderr)
    assert row[2:7] == ["1", "0", "0", "1", row[6]]


def test_table_comes_after_a_crash_and_without_calls(tmp_path: Path) -> None:
    done = run(tmp_path, "raise RuntimeError('mine')")
    assert done.returncode == 1
    assert "RuntimeError: mine" in done.stderr
    assert "no call that the filter takes over" in done.stderr


def test_what_the_filter_did_not_see_is_told(tmp_path: Path) -> None:
    code = """
import subprocess, sys
import cv2
import numpy as np
p = np.random.default_rng(0).uniform(0, 500, (40, 2))
K, D = np.eye(3), np.zeros(4)
for _ in range(3):
    cv2.recoverPose(p, p + 1, K, D, K, D)
cv2.recoverPose(np.eye(3), p, p)
if len(sys.argv) > 1:
    subprocess.run([sys.executable, "-c", "sum(range(10**6))"])
"""
    for arguments, expected in (((), False), (("child",), True)):
        done = run(tmp_path, code, *arguments)
        assert done.returncode == 0, done.stderr
        told = done.stderr[done.stderr.index("in place of OpenCV") :]
        assert "not taken over: script.py:8 recoverPose, 3 calls" in told
        assert told.count("recoverPose") == 1
        assert ("other processes" in told) == expected


def test_a_standing_camera_does_not_stop_a_script(tmp_path: Path) -> None:
    code = """
import cv2
import numpy as np
rng = np.random.default_rng(0)
K = np.array([[400, 0, 320], [0, 400, 240], [0, 0, 1.0]])
p = rng.uniform((0, 0), (640, 480), (500, 2)).astype(np.float32)
q = p + rng.normal(0, 0.02, p.shape).astype(np.float32)
E, mask = cv2.findEssentialMat(q, p, K, cv2.RANSAC, 0.999, 1.0)
print(cv2.recoverPose(E, q, p, K, mask=mask)[1].shape)
"""
    done = run(tmp_path, code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "(3, 3)"


def test_missing_script_and_the_other_commands() -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    for arguments, status, words in (
        (["run", "no/such.py"], 2, "no/such.py"),
        (["--version"], 0, ""),
        (["a.png", "b.png"], 2, "a.png"),
    ):
        command = [sys.executable, "-m", "mgca_filter", *arguments]
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        assert done.returncode == status
        assert words in done.stderr
