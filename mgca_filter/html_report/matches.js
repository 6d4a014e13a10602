// The matches and what is chosen of them: thresholds, the match that is pointed at, the one that is pinned.

const matches = (() => {
  const columns = Object.fromEntries(Object.entries(DATA.columns).map(([name, column]) => [name, unpack(column)]));
  const n = columns.x1.length;
  const residual = columns.log_residual.map((decades) => 10 ** decades);
  const own = unpackMask(DATA.mask, n);
  const right = DATA.right ? unpackMask(DATA.right, n) : null;
  const [x, y] = [[columns.x1, columns.x2], [columns.y1, columns.y2]];
  const drawable = Uint8Array.from({ length: n }, (_, i) => Number.isFinite(x[0][i]) && Number.isFinite(x[1][i]));
  return { n, x, y, residual, score: columns.score, ratio: columns.ratio, own, right, drawable };
})();

const hasModel = matches.residual.some(Number.isFinite);

// Thresholds that give back the filter's own answer, where any do: by residual alone, else by score alone.
const OWN = (() => {
  let largest = 0, least = 1, keeps = false;
  for (let i = 0; i < matches.n; i++) {
    if (!matches.own[i]) continue;
    keeps = true;
    if (Number.isFinite(matches.residual[i])) largest = Math.max(largest, matches.residual[i]);
    least = Math.min(least, matches.score[i]);
  }
  if (!keeps) return { residual: hasModel ? 1 : Infinity, score: 1 };
  const byResidual = hasModel && matches.own.every((kept, i) => Boolean(kept) === matches.residual[i] <= largest);
  return byResidual ? { residual: largest, score: 0 } : { residual: hasModel ? Math.max(largest, 1) : Infinity, score: least };
})();

const state = {
  tab: "matches",
  kept: true,
  rejected: false,
  lines: false,
  colour: "position",
  hover: -1,
  pin: -1,
  spot: null, // {side, x, y}: where an epipolar line was asked for
  threshold: { ...OWN },
  moved: false,
  selected: Uint8Array.from(matches.own),
  baseline: DATA.methods.length > 1 ? DATA.methods.length - 1 : -1,
  groups: { both: true, ours: true, theirs: true, neither: false },
};

const methodMasks = DATA.methods.map((method) => unpackMask(method.mask, matches.n));

function reselect() {
  const { residual, score } = state.threshold;
  for (let i = 0; i < matches.n; i++) {
    const near = !Number.isFinite(residual) || matches.residual[i] <= residual;
    state.selected[i] = state.moved ? Number(near && matches.score[i] >= score && matches.drawable[i]) : matches.own[i];
  }
}

// In the comparison: who keeps match i.
function group(i) {
  const [ours, theirs] = [matches.own[i], state.baseline < 0 ? 0 : methodMasks[state.baseline][i]];
  return ours ? (theirs ? "both" : "ours") : theirs ? "theirs" : "neither";
}

function visible(i) {
  if (!matches.drawable[i]) return false;
  if (state.tab === "compare") return state.groups[group(i)];
  return state.selected[i] ? state.kept : state.rejected;
}

// Blue to yellow from left to right, light to dark from top to bottom: neighbours in image 1 look alike in image 2.
const CORNERS = [[86, 180, 255], [255, 236, 92], [98, 64, 224], [236, 88, 16]];
function positionColour(i) {
  const u = clamp(matches.x[0][i] / DATA.sizes[0][0], 0, 1);
  const v = clamp(matches.y[0][i] / DATA.sizes[0][1], 0, 1);
  const mix = [0, 1, 2].map((c) =>
    Math.round((1 - v) * ((1 - u) * CORNERS[0][c] + u * CORNERS[1][c]) + v * ((1 - u) * CORNERS[2][c] + u * CORNERS[3][c])));
  return `rgb(${mix.join(",")})`;
}

const positions = Array.from({ length: matches.n }, (_, i) => positionColour(i));

function colourOf(i) {
  if (state.tab === "compare") return { both: PALETTE.both, ours: PALETTE.ours, theirs: PALETTE.theirs, neither: "#8a9298" }[group(i)];
  if (!state.selected[i]) return "#aab2b8";
  if (state.colour === "score") return ramp(matches.score[i]);
  if (state.colour === "residual") return ramp(1 - matches.residual[i] / Math.max(state.threshold.residual, 1e-9));
  if (state.colour === "truth") return matches.right[i] ? PALETTE.right : PALETTE.wrong;
  return positions[i];
}

// Wrong or rejected matches have a shape of their own, so that colour says nothing alone.
function crossed(i) {
  if (matches.right && (state.tab === "compare" || state.colour === "truth")) return !matches.right[i];
  return state.tab !== "compare" && !state.selected[i];
}

// The line (a, b, c), a x + b y + c = 0, on the other image of all places that may show the point of ``side``.
function epipolarLine(F, side, px, py) {
  const p = [px, py, 1];
  return [0, 1, 2].map((r) => [0, 1, 2].reduce((sum, c) => sum + (side === 0 ? F[r][c] : F[c][r]) * p[c], 0));
}

function mapped(H, px, py) {
  const [a, b, w] = H.map((row) => row[0] * px + row[1] * py + row[2]);
  return [a / w, b / w];
}
