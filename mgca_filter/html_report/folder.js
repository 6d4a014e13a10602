// The report of many pairs: matrix, weakest links, sortable table.

const n = DATA.images.length;
const column = (name) => Array.from(unpack(DATA.columns[name]));
const whole = (name) => column(name).map(Math.round);
const pairs = (() => {
  const [a, b, status, total, kept, confidence] = [whole("a"), whole("b"), whole("status"), whole("num_matches"), whole("kept"), column("confidence")];
  return a.map((_, i) => ({ a: a[i], b: b[i], status: DATA.statuses[status[i]], total: total[i], kept: kept[i], confidence: confidence[i] }));
})();
const cellOf = new Map(pairs.flatMap((pair, i) => [[pair.a * n + pair.b, i], [pair.b * n + pair.a, i]]));
const most = pairs.reduce((largest, pair) => Math.max(largest, pair.kept), 1);
const strength = (kept) => (most > 1 ? Math.log(kept) / Math.log(most) : 1);
const view = { order: [], at: [-1, -1], pinned: [-1, -1], sort: "kept", down: true, shown: 200, words: "" };

function orderBy(kind) {
  const all = DATA.images.map((_, i) => i);
  view.order = kind === "group" ? all.sort((i, j) => DATA.groups[i] - DATA.groups[j] || i - j) : all;
}

// The cells, drawn once: what moves with the pointer is drawn over them.
const cells = document.createElement("canvas");
let stale = true;

function paintCells(width, height, pixels) {
  [cells.width, cells.height] = [Math.round(width * pixels), Math.round(height * pixels)];
  const context = cells.getContext("2d");
  context.setTransform(pixels, 0, 0, pixels, 0, 0);
  const cell = Math.min(width, height) / Math.max(n, 1);
  const gap = cell > 8 ? 1 : 0;
  context.fillStyle = cssColour("--well");
  context.fillRect(0, 0, cell * n, cell * n);
  const place = new Array(n);
  view.order.forEach((image, k) => { place[image] = k; });
  const tried = cssColour("--faint");
  context.font = "600 11px system-ui, sans-serif";
  [context.textAlign, context.textBaseline] = ["center", "middle"];
  for (const { a, b, kept } of pairs) {
    const size = kept > 0 ? cell - gap : Math.max(0.6, cell * 0.24);
    const inset = (cell - gap - size) / 2;
    for (const [r, c] of [[place[a], place[b]], [place[b], place[a]]]) {
      context.fillStyle = kept > 0 ? ramp(strength(kept)) : tried;
      context.fillRect(c * cell + inset, r * cell + inset, size + (gap ? 0 : 0.3), size + (gap ? 0 : 0.3));
      if (kept > 0 && cell >= 30) {
        context.fillStyle = strength(kept) > 0.62 ? "#10202a" : "#ffffff";
        context.fillText(String(kept), (c + 0.5) * cell, (r + 0.5) * cell);
      }
    }
  }
  context.fillStyle = cssColour("--quiet");
  context.font = "11px system-ui, sans-serif";
  for (let r = 0; r < n && cell >= 40; r++) { // names on the diagonal, their ends where they are long
    let name = DATA.images[view.order[r]].replace(/\.[^.]*$/, "");
    while (name.length > 3 && context.measureText(name).width > cell - 6) name = "…" + name.slice(2);
    context.fillText(name, (r + 0.5) * cell, (r + 0.5) * cell);
  }
  context.fillStyle = cssColour("--ink");
  context.globalAlpha = 0.4;
  for (let r = 1; r < n && byId("order").value === "group"; r++) { // between groups
    if (DATA.groups[view.order[r]] === DATA.groups[view.order[r - 1]]) continue;
    context.fillRect(0, r * cell - 0.75, n * cell, 1.5);
    context.fillRect(r * cell - 0.75, 0, 1.5, n * cell);
  }
  stale = false;
}

const matrix = new Surface(byId("matrix"), (context, width, height) => {
  const pixels = matrix.canvas.width / width;
  if (stale || cells.width !== matrix.canvas.width) paintCells(width, height, pixels);
  context.drawImage(cells, 0, 0, width, height);
  const [r, c] = view.at[0] >= 0 ? view.at : view.pinned;
  if (r < 0) return;
  const cell = Math.min(width, height) / Math.max(n, 1);
  for (const [style, lineWidth] of [["#000", 4], [PALETTE.pin, 2]]) {
    [context.strokeStyle, context.lineWidth] = [style, lineWidth];
    context.strokeRect(c * cell + 1, r * cell + 1, cell - 2, cell - 2);
  }
});
const repaint = () => { stale = true; matrix.invalidate(); };

const picture = (i) => {
  const address = DATA.thumbnails[DATA.images[i]];
  return address ? el("img", { src: address, alt: "" }) : el("span", { class: "no-picture" }, "no picture");
};

function showCell(aloud = false) {
  const card = byId("cell-card");
  const [r, c] = view.at[0] >= 0 ? view.at : view.pinned;
  matrix.invalidate();
  if (r < 0 || r >= n || c >= n) {
    card.replaceChildren(el("h2", {}, "Pair"), el("p", { class: "quiet" }, "Point at a cell of the matrix. Yellow: most kept matches; small grey: matched, and nothing kept; empty: not matched."));
    return;
  }
  const [a, b] = [view.order[r], view.order[c]];
  const i = cellOf.get(a * n + b);
  const words = a === b ? "one image" : i === undefined ? "not matched" : `${pairs[i].status.replaceAll("_", " ")}, ${count(pairs[i].kept)} of ${count(pairs[i].total)} kept` +
    (Number.isFinite(pairs[i].confidence) ? `, confidence ${fixed(100 * pairs[i].confidence, 0)} %` : "");
  const sides = a === b ? [a] : [a, b];
  const pictures = Object.keys(DATA.thumbnails).length ? el("div", { class: "thumbs" }, ...sides.map((s) => el("figure", {}, picture(s), el("figcaption", {}, DATA.images[s]))))
    : el("p", {}, sides.map((s) => DATA.images[s]).join(" ↔ "));
  card.replaceChildren(el("h2", {}, "Pair"), pictures, el("p", { id: "cell-words" }, words));
  if (aloud) byId("status").textContent = `${sides.map((s) => DATA.images[s]).join(" and ")}: ${words}`;
}

function cellAt(event) {
  const box = byId("matrix").getBoundingClientRect();
  const cell = Math.min(box.width, box.height) / Math.max(n, 1);
  const at = [Math.floor((event.clientY - box.top) / cell), Math.floor((event.clientX - box.left) / cell)];
  return at.every((k) => k >= 0 && k < n) ? at : [-1, -1];
}

byId("matrix").addEventListener("pointermove", (event) => { view.at = cellAt(event); showCell(); });
byId("matrix").addEventListener("pointerleave", () => { view.at = [-1, -1]; showCell(); });
byId("matrix").addEventListener("click", (event) => { view.pinned = cellAt(event); showCell(true); });
byId("matrix").addEventListener("keydown", (event) => {
  const step = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] }[event.key];
  if (step) {
    event.preventDefault();
    view.pinned = view.pinned[0] < 0 ? [0, 0] : view.pinned.map((k, axis) => clamp(k + step[axis], 0, n - 1));
    view.at = [-1, -1];
    showCell(true);
  } else if (event.key === "Enter" && view.pinned[0] >= 0) {
    byId("filter").value = DATA.images[view.order[view.pinned[0]]];
    fillTable();
  }
});

function goToPair(a, b) {
  view.pinned = [view.order.indexOf(a), view.order.indexOf(b)];
  view.at = [-1, -1];
  showCell(true);
}

function fillLinks() {
  byId("links-words").textContent = DATA.links.length
    ? "The strongest chain of pairs that joins each group, weakest first. “Only way”: without it the group falls apart."
    : "No pair keeps a match.";
  byId("links").append(...DATA.links.map(([a, b, kept, bridge]) => {
    const fill = el("span", { class: "bar-fill" });
    fill.style.width = `${(100 * kept) / most}%`;
    return el("li", {}, el("button", { type: "button", onclick: () => goToPair(a, b) }, el("span", { class: "pair-name" }, `${DATA.images[a]} – ${DATA.images[b]}`),
      bridge ? el("span", { class: "pill", "data-tone": "caution" }, "only way") : null, el("span", { class: "bar-track" }, fill), el("b", {}, count(kept))));
  }));
}

const COLUMNS = [
  ["a", "image 1", (p) => DATA.images[p.a]], ["b", "image 2", (p) => DATA.images[p.b]], ["status", "status", (p) => p.status],
  ["total", "matches", (p) => p.total], ["kept", "kept", (p) => p.kept], ["share", "share", (p) => (p.total ? p.kept / p.total : 0)],
];
if (pairs.some((p) => Number.isFinite(p.confidence))) COLUMNS.push(["confidence", "confidence", (p) => (Number.isFinite(p.confidence) ? p.confidence : -1)]);

function tone(status) {
  if (status === "ok" || status === "planar") return "good";
  return status === "pure_rotation" || status === "suspicious_intrinsics" ? "caution" : "bad";
}

function fillTable() {
  const wanted = byId("filter").value.trim().toLowerCase();
  const value = COLUMNS.find(([name]) => name === view.sort)[2];
  const sign = view.down ? -1 : 1;
  const rows = pairs.filter((p) => !wanted || [DATA.images[p.a], DATA.images[p.b], p.status, p.status.replaceAll("_", " ")].some((word) => word.toLowerCase().includes(wanted)))
    .sort((p, q) => {
      const [x, y] = [value(p), value(q)];
      return sign * (typeof x === "string" ? x.localeCompare(y, undefined, { numeric: true }) : x - y) || p.a - q.a || p.b - q.b;
    });
  byId("pairs").tHead.replaceChildren(el("tr", {}, ...COLUMNS.map(([name, words]) => el("th", { scope: "col", "aria-sort": name === view.sort ? (view.down ? "descending" : "ascending") : "none" },
    el("button", { type: "button", id: `sort-${name}`, onclick: () => { view.down = view.sort === name ? !view.down : !["a", "b", "status"].includes(name); view.sort = name; fillTable(); byId(`sort-${name}`).focus(); } },
      words, el("span", { "aria-hidden": "true" }, name === view.sort ? (view.down ? " ↓" : " ↑") : ""))))));
  byId("pairs").tBodies[0].replaceChildren(...rows.slice(0, view.shown).map((p) => {
    const cells = [p.total, p.kept].map((v) => el("td", {}, count(v)));
    cells.push(el("td", {}, p.total ? `${fixed((100 * p.kept) / p.total, 1)} %` : "–"));
    if (COLUMNS.length > 6) cells.push(el("td", {}, Number.isFinite(p.confidence) ? `${fixed(100 * p.confidence, 0)} %` : "–"));
    return el("tr", { onclick: () => goToPair(p.a, p.b) }, el("th", { scope: "row" }, DATA.images[p.a]), el("td", {}, DATA.images[p.b]),
      el("td", {}, el("span", { class: "pill", "data-tone": tone(p.status) }, p.status.replaceAll("_", " "))), ...cells);
  }));
  const beyond = DATA.left_out ? `; ${count(DATA.left_out)} with the fewest kept matches are not in this file` : "";
  byId("pairs-words").textContent = `${count(Math.min(view.shown, rows.length))} of ${count(rows.length)} pairs shown${beyond}.`;
  byId("more").hidden = rows.length <= view.shown;
}

byId("order").addEventListener("change", () => { orderBy(byId("order").value); view.pinned = [-1, -1]; repaint(); showCell(); });
byId("filter").addEventListener("input", fillTable);
byId("more").addEventListener("click", () => { view.shown += 500; fillTable(); });
byId("most").textContent = count(most);
byId("facts").append(...DATA.facts.flatMap(([name, value]) => [el("dt", {}, name), el("dd", {}, value)]));

const toggleTheme = startTheme(repaint);
startKeys([
  { key: "F", words: "to the filter", run: () => byId("filter").focus() },
  { key: "M", words: "to the matrix; arrows move in it", run: () => byId("matrix").focus() },
  { key: "D", words: "light or dark", run: () => toggleTheme() },
  { key: "?", words: "this list", run: () => {} },
]);
orderBy("group");
fillLinks();
fillTable();
showCell();
if (DATA.links.length) goToPair(DATA.links[0][0], DATA.links[0][1]);
window.report = { view, pairs, links: DATA.links, goToPair, matrix };
