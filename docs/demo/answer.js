// The report's viewer and its panel of matches, put together for an answer without a fitted model.

const viewer = createViewer(() => panel.inspect(), changed);
const panel = createMatchPanel(viewer, changed);

function changed() {
  panel.update();
  viewer.surface.invalidate();
  const truth = DATA.true_F ? "; dashed: the true one" : "";
  byId("hint").textContent = state.spot && DATA.F
    ? `Epipolar line by the network’s essential matrix, not refined${truth}`
    : `Wheel to zoom, drag to pan, click ${DATA.F ? "for an epipolar line" : "to keep a match in view"}`;
}

const zoomBy = (factor) => viewer.zoomBoth(factor);
const flip = (name) => { state[name] = !state[name]; changed(); };
byId("zoom-in").addEventListener("click", () => zoomBy(1.4));
byId("zoom-out").addEventListener("click", () => zoomBy(1 / 1.4));
byId("zoom-fit").addEventListener("click", viewer.fit);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", changed);
startKeys([
  { key: "K", words: "accepted matches on or off", run: () => flip("kept") },
  { key: "R", words: "rejected matches on or off", run: () => flip("rejected") },
  { key: "L", words: "lines on or off", run: () => flip("lines") },
  { key: "N", words: "next match, best score first", run: () => viewer.step(1) },
  { key: "P", words: "previous match", run: () => viewer.step(-1) },
  { key: "Z", words: "both images to the pinned match", run: () => state.pin >= 0 && viewer.goTo(state.pin) },
  { key: "S", words: "back to the filter’s own threshold", run: () => panel.reset() },
  { key: "+", also: ["="], words: "closer", run: () => zoomBy(1.25) },
  { key: "-", also: ["−"], words: "further", run: () => zoomBy(0.8) },
  { key: "0", words: "all of it", run: () => viewer.fit() },
  { key: "← ↑ → ↓", words: "pan", run: () => false },
  ...[["ArrowLeft", 40, 0], ["ArrowRight", -40, 0], ["ArrowUp", 0, 40], ["ArrowDown", 0, -40]].map(([key, dx, dy]) => ({ key, run: () => viewer.pan(dx, dy) })),
  { key: "Escape", words: "let go of the pinned match", run: () => viewer.pinMatch(-1) },
]);
if (matches.right) state.colour = "truth";
changed();
