// The report of one pair: parts put together, keys, and a handle for whoever drives the page by script.

const viewer = createViewer(() => panel.inspect(), () => { changed(); scene.invalidate(); });
const panel = createMatchPanel(viewer, changed);
const comparison = createComparePanel(changed);
const scene = createScene(viewer, (i) => { viewer.pinMatch(i); });
fillWhy();

function changed() {
  panel.update();
  if (state.tab === "compare") comparison.update();
  viewer.surface.invalidate();
  scene.invalidate();
  byId("hint").textContent = hint();
}

function hint() {
  if (state.tab === "geometry") return scene.available ? "Drag to turn, wheel to zoom, click a point to pin its match" : "";
  if (state.spot && DATA.F) return `Epipolar line of the ${state.spot.loose ? "place" : "match"} that you clicked${DATA.true_F ? "; dashed: the true one" : ""}`;
  if (state.tab === "matches" && !state.rejected && !DATA.methods[0].kept && !state.moved) return "Nothing is kept: R shows the rejected matches";
  return `Wheel to zoom, drag to pan, click ${DATA.F ? "for an epipolar line" : "to keep a match in view"}`;
}

const open = startTabs(["matches", "compare", "geometry", "why"], (name) => {
  state.tab = name;
  for (const tab of ["matches", "compare", "geometry"]) byId(`side-${tab}`).hidden = tab !== name;
  byId("why").hidden = name !== "why";
  byId("side").hidden = name === "why";
  byId("stage").hidden = name === "why";
  const inScene = name === "geometry" && scene.available;
  byId("scene").hidden = !inScene;
  byId("images").hidden = inScene;
  // The patches go with the reader to the tab that is open.
  const homes = { compare: comparison.home, geometry: scene.home, matches: byId("side-matches") };
  if (homes[name]) homes[name].prepend(panel.card);
  changed();
});

const inScene = () => state.tab === "geometry" && scene.available;
const zoomBy = (factor) => (inScene() ? scene.zoom(factor) : viewer.zoomBoth(factor));
const move = (dx, dy) => (inScene() ? scene.move(-dx * 0.0025, dy * 0.0025) : viewer.pan(dx, dy));
const reset = () => (inScene() ? scene.reset() : viewer.fit());
const flip = (name) => { state[name] = !state[name]; changed(); };
byId("zoom-in").addEventListener("click", () => zoomBy(1.4));
byId("zoom-out").addEventListener("click", () => zoomBy(1 / 1.4));
byId("zoom-fit").addEventListener("click", reset);

const repaint = () => { viewer.surface.invalidate(); scene.invalidate(); panel.update(); };
const toggleTheme = startTheme(repaint);
startKeys([
  { key: "1", words: "matches", run: () => open("matches") },
  { key: "2", words: "compare", run: () => open("compare") },
  { key: "3", words: "geometry", run: () => open("geometry") },
  { key: "4", words: "why", run: () => open("why") },
  { key: "K", words: "kept matches on or off", run: () => flip("kept") },
  { key: "R", words: "rejected matches on or off", run: () => flip("rejected") },
  { key: "L", words: "lines on or off", run: () => flip("lines") },
  { key: "N", words: "next match, best score first", run: () => viewer.step(1) },
  { key: "P", words: "previous match", run: () => viewer.step(-1) },
  { key: "Z", words: "both images to the pinned match", run: () => state.pin >= 0 && viewer.goTo(state.pin) },
  { key: "X", words: "differences only, in the comparison", run: () => { open("compare"); comparison.differences(); } },
  { key: "S", words: "back to the filter’s own thresholds", run: () => panel.reset() },
  { key: "+", also: ["="], words: "closer", run: () => zoomBy(1.25) },
  { key: "-", also: ["−"], words: "further", run: () => zoomBy(0.8) },
  { key: "0", also: ["f", "F"], words: "all of it", run: reset },
  { key: "← ↑ → ↓", words: "pan, or turn the scene", run: () => false },
  { key: "ArrowLeft", run: () => move(40, 0) },
  { key: "ArrowRight", run: () => move(-40, 0) },
  { key: "ArrowUp", run: () => move(0, 40) },
  { key: "ArrowDown", run: () => move(0, -40) },
  { key: "Escape", words: "let go of the pinned match", run: () => viewer.pinMatch(-1) },
  { key: "D", words: "light or dark", run: toggleTheme },
  { key: "?", words: "this list", run: () => {} },
]);

for (const flag of ["rejected", "lines"]) if (wished.get(flag) === "1") state[flag] = true;
const openWith = wished.get("tab");
open(["matches", "compare", "geometry", "why"].includes(openWith) ? openWith : "matches");
if (wished.has("match")) viewer.pinMatch(clamp(DATA.rows.indexOf(Number(wished.get("match"))), -1, matches.n - 1));
if (wished.has("step")) for (let i = 0; i < Number(wished.get("step")); i++) viewer.step(1);
window.report = { state, matches, viewer, scene, open, epipolarLine, F: DATA.F };
