// Keypoints of two photographs, and for each of the first its nearest neighbour in the second, by opencv.js.
"use strict";

const MAX_KEYPOINTS = 2000;
const NARROWEST = 6; // pixels; AKAZE fails on narrower strips

// Points and attributes of every match of two photographs (ImageData); a ratio test or cross-check would only take away.
function matchPhotographs(photograph1, photograph2) {
  const [one, two] = [photograph1, photograph2].map(akaze);
  try {
    const pairs = one.keypoints.length && two.keypoints.length > 1 ? nearestTwo(one.descriptors, two.descriptors) : [];
    return encoded(pairs, one.keypoints, two.keypoints);
  } finally {
    for (const { descriptors } of [one, two]) descriptors.delete();
  }
}

// The strongest keypoints of an image, and their descriptors, a Mat of a row each.
function akaze(photograph) {
  if (Math.min(photograph.width, photograph.height) < NARROWEST) return { keypoints: [], descriptors: new cv.Mat() };
  const [image, grey, none, found, all] = [cv.matFromImageData(photograph), new cv.Mat(), new cv.Mat(), new cv.KeyPointVector(), new cv.Mat()];
  const detector = new cv.AKAZE();
  try {
    cv.cvtColor(image, grey, cv.COLOR_RGBA2GRAY);
    detector.detectAndCompute(grey, none, found, all);
    const keypoints = Array.from({ length: found.size() }, (_, row) => ({ row, ...found.get(row) }));
    const strongest = keypoints.sort((a, b) => b.response - a.response).slice(0, MAX_KEYPOINTS);
    const descriptors = new cv.Mat(strongest.length, all.cols, cv.CV_8U);
    strongest.forEach(({ row }, i) => descriptors.data.set(all.ucharPtr(row), i * all.cols));
    return { keypoints: strongest, descriptors };
  } finally {
    for (const object of [image, grey, none, found, all, detector]) object.delete();
  }
}

// For each row of ``descriptors1`` the row of its nearest neighbour, its distance, and that of the second nearest.
function nearestTwo(descriptors1, descriptors2) {
  const [matcher, rows] = [new cv.BFMatcher(cv.NORM_HAMMING, false), new cv.DMatchVectorVector()];
  try {
    matcher.knnMatch(descriptors1, descriptors2, rows, 2);
    return Array.from({ length: rows.size() }, (_, i) => {
      const row = rows.get(i);
      const [nearest, second] = [row.get(0), row.get(1)];
      row.delete();
      return { index1: nearest.queryIdx, index2: nearest.trainIdx, distance: nearest.distance, second: second.distance };
    });
  } finally {
    matcher.delete();
    rows.delete();
  }
}

// Pixels (N, 4) and the network's attributes (N, 8): ratio, best of the list, change of size, turn, and what is known.
function encoded(pairs, keypoints1, keypoints2) {
  const least = new Map();
  for (const { index2, distance } of pairs) least.set(index2, Math.min(distance, least.get(index2) ?? Infinity));
  const [points, attributes] = [new Float32Array(4 * pairs.length), new Float32Array(8 * pairs.length)];
  pairs.forEach(({ index1, index2, distance, second }, i) => {
    const [a, b] = [keypoints1[index1], keypoints2[index2]];
    const turn = ((b.angle - a.angle) * Math.PI) / 180;
    points.set([a.pt.x, a.pt.y, b.pt.x, b.pt.y], 4 * i);
    attributes.set([second > 0 ? distance / second : 1, Number(distance <= least.get(index2)), Math.log2(b.size / a.size),
      Math.cos(turn), Math.sin(turn), 1, 1, 1], 8 * i);
  });
  return { points, attributes };
}
