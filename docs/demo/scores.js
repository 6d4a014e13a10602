// Matches to logits and scores: what surrounds the network, as the model contract has it (docs/reference/model-contract.md).
"use strict";

const RATIO = 0, BEST = 1, RATIO_KNOWN = 5, BEST_KNOWN = 6, WIDTH = 8; // columns of the attributes
const MAX_NETWORK_MATCHES = 8000;

// Pixels (N, 4) to the normalised image planes (N, 4), by intrinsics without distortion.
function normalized(points, K1, K2) {
  return points.map((value, i) => {
    const K = i % 4 < 2 ? K1 : K2;
    return (value - K[i % 2][2]) / K[i % 2][i % 2];
  });
}

const taken = (values, width, rows) => Float32Array.from({ length: rows.length * width }, (_, i) => values[rows[Math.floor(i / width)] * width + (i % width)]);

// Rows that enter the network: all but those that are known to be hopeless, or all where too few would remain.
function candidates(attributes, { max_ratio, min_count }) {
  const all = Array.from({ length: attributes.length / WIDTH }, (_, i) => i);
  const at = (row, column) => attributes[row * WIDTH + column];
  const limit = Math.fround(max_ratio);
  const promising = all.filter((row) => !(at(row, RATIO_KNOWN) && at(row, BEST_KNOWN) && (at(row, RATIO) >= limit || !at(row, BEST))));
  const rows = promising.length < min_count ? all : promising;
  if (rows.length <= MAX_NETWORK_MATCHES) return rows;
  return rows.sort((a, b) => at(a, RATIO) - at(b, RATIO)).slice(0, MAX_NETWORK_MATCHES).sort((a, b) => a - b);
}

// Abramowitz and Stegun 7.1.26.
function gelu(x) {
  const z = Math.abs(x) / Math.SQRT2;
  const k = 1 / (1 + 0.3275911 * z);
  const polynomial = [1.061405429, -1.453152027, 1.421413741, -0.284496736, 0.254829592].reduce((sum, c) => (sum + c) * k, 0);
  return 0.5 * x * (1 + Math.sign(x) * (1 - polynomial * Math.exp(-z * z)));
}

// Logits of matches that never enter the network, from their attributes alone: in order, all below the threshold.
function priorLogits(attributes, { prior, decision_threshold }) {
  const ceiling = decision_threshold - 1e-3;
  const [compressed, knee] = [0.25, ceiling - 0.25];
  return Float32Array.from({ length: attributes.length / WIDTH }, (_, row) => {
    let logit = prior.bias2;
    prior.weight1.forEach((weights, h) => {
      const sum = weights.reduce((total, w, c) => total + w * attributes[row * WIDTH + c], prior.bias1[h]);
      logit += prior.weight2[h] * gelu(sum);
    });
    return logit > knee ? ceiling - compressed ** 2 / (compressed + logit - knee) : logit;
  });
}

const probabilities = (logits, { scale, offset }) => logits.map((logit) => 1 / (1 + Math.exp(-(scale * logit + offset))));

// F = K2⁻ᵀ E K1⁻¹ (3, 3) of an essential matrix in nine numbers, intrinsics without skew.
function fundamental(essential, K1, K2) {
  const inverse = (K) => [[1 / K[0][0], 0, -K[0][2] / K[0][0]], [0, 1 / K[1][1], -K[1][2] / K[1][1]], [0, 0, 1]];
  const product = (A, B) => A.map((row) => [0, 1, 2].map((c) => row.reduce((sum, a, k) => sum + a * B[k][c], 0)));
  const transposed = (A) => [0, 1, 2].map((c) => A.map((row) => row[c]));
  const E = [0, 3, 6].map((first) => Array.from(essential.slice(first, first + 3)));
  return product(product(transposed(inverse(K2)), E), inverse(K1));
}
