// The panels beside the images: the match under the pointer, what is shown, thresholds, comparison; and the page "why".

function createMatchPanel(viewer, changed) {
  const PATCH = 128;
  const patches = [0, 1].map((side) => el("canvas", { class: "patch", width: 2 * PATCH, height: 2 * PATCH, role: "img", "aria-label": `Patch of image ${side + 1}` }));
  const values = el("dl", { class: "values" });
  const empty = el("p", { class: "quiet" }, "Point at a match to see both patches. ", DATA.F ? "Click it, or any place, for the epipolar line." : "Click it to keep it here.");
  const card = el("div", { class: "card inspect" }, el("div", { class: "patches" }, ...patches), values, empty);

  function inspect() {
    const i = state.hover >= 0 ? state.hover : state.pin;
    patches.forEach((canvas, side) => viewer.paintPatch(canvas.getContext("2d"), 2 * PATCH, side, i));
    card.classList.toggle("filled", i >= 0);
    values.replaceChildren();
    if (i < 0) return;
    const rows = [
      ["score", fixed(matches.score[i], 3)],
      ["residual", hasModel ? `${pixels(matches.residual[i])} px` : "no model"],
      ["ratio", Number.isFinite(matches.ratio[i]) ? fixed(matches.ratio[i], 2) : "not known"],
      ["verdict", matches.own[i] ? "kept" : "rejected"],
    ];
    if (matches.right) rows.push(["truth", matches.right[i] ? "right" : "wrong"]);
    for (const [name, value] of rows) values.append(el("div", {}, el("dt", {}, name), el("dd", {}, value)));
    const words = rows.map((row) => row.join(" ")).join(", ");
    if (state.hover < 0) byId("status").textContent = `Match ${DATA.rows[i] + 1}: ${words}`;
  }

  const check = (name, words, key) => {
    const box = el("input", { type: "checkbox", id: `show-${name}`, onchange: () => { state[name] = box.checked; changed(); } });
    box.checked = state[name];
    return { box, row: el("label", { for: `show-${name}`, title: `Key ${key}` }, box, " ", words) };
  };
  const boxes = { kept: check("kept", "Kept", "K"), rejected: check("rejected", "Rejected", "R"), lines: check("lines", "Lines", "L") };
  const colours = [["position", "place in image 1"], ["score", "score"]];
  if (hasModel) colours.push(["residual", "residual"]);
  if (matches.right) colours.push(["truth", "right or wrong"]);
  const colour = el("select", { id: "colour", onchange: () => { state.colour = colour.value; changed(); } },
    ...colours.map(([value, words]) => el("option", { value }, words)));
  const legend = el("div", { class: "legend", "aria-hidden": "true" });
  const show = el("div", { class: "card" }, el("h2", {}, "Show"),
    el("div", { class: "checks" }, ...Object.values(boxes).map(({ row }) => row)),
    el("label", { class: "row", for: "colour" }, "Colour by ", colour), legend);

  function paintLegend() {
    legend.replaceChildren();
    legend.className = `legend ${state.colour}`;
    const ends = { position: ["", ""], score: ["0", "1"], residual: [`${pixels(state.threshold.residual)} px`, "0 px"], truth: null }[state.colour];
    if (ends) legend.append(el("span", {}, ends[0]), el("i", {}), el("span", {}, ends[1]));
    else legend.append(el("span", { class: "right" }, "● right"), el("span", { class: "wrong" }, "× wrong"));
  }

  const summary = el("p", { class: "count", id: "live-count" });
  const reset = el("button", { type: "button", id: "reset", title: "Key S", onclick: () => { Object.assign(state.threshold, OWN); state.moved = false; sliders.forEach((s) => s.read()); select(); } }, "Back to the filter’s own");
  const [LOW, HIGH] = [-2, 2.5]; // decades of a pixel
  const sliders = [createSlider({
    id: "score", name: "Score at least", values: matches.score, low: 0, high: 1,
    get: () => state.threshold.score, set: (v) => { state.threshold.score = v; },
    words: (v) => v.toFixed(2), ticks: [["0", 0], ["0.5", 0.5], ["1", 1]],
  })];
  if (hasModel) sliders.push(createSlider({
    id: "residual", name: "Residual at most", values: matches.residual.map(Math.log10), low: LOW, high: HIGH,
    get: () => Math.log10(state.threshold.residual), set: (v) => { state.threshold.residual = 10 ** v; },
    words: (v) => `${pixels(10 ** v)} px`,
    ticks: [["0.01", -2], ["0.1", -1], ["1", 0], ["10", 1], ["100 px", 2]],
  }));
  const rerun = el("div", { class: "card" }, el("h2", {}, "Other thresholds"), summary,
    ...sliders.map((slider) => slider.node),
    hasModel ? null : el("p", { class: "quiet" }, "No model was fitted, so that matches have no residual."), reset);

  function createSlider({ id, name, values, low, high, get, set, words, ticks }) {
    const BINS = 48;
    const bins = new Array(BINS).fill(0);
    const bin = (v) => clamp(Math.floor(((v - low) / (high - low)) * BINS), 0, BINS - 1);
    for (const v of values) if (Number.isFinite(v)) bins[bin(v)]++;
    const tallest = Math.log1p(Math.max(...bins, 1));
    const chart = el("canvas", { class: "histogram", "aria-hidden": "true" });
    const surface = new Surface(chart, (context, width, height) => {
      const [on, off] = [cssColour("--accent"), cssColour("--faint")];
      const chosen = new Array(BINS).fill(0);
      for (let i = 0; i < matches.n; i++) if (state.selected[i] && Number.isFinite(values[i])) chosen[bin(values[i])]++;
      for (const [heights, colour] of [[bins, off], [chosen, on]]) {
        context.fillStyle = colour;
        heights.forEach((n, i) => {
          const h = Math.max(2, (Math.log1p(n) / tallest) * (height - 2));
          if (n) context.fillRect((i * width) / BINS, height - h, width / BINS - 1, h);
        });
      }
      const x = clamp((get() - low) / (high - low), 0, 1) * width;
      context.fillStyle = cssColour("--ink");
      context.fillRect(clamp(x - 1, 0, width - 2), 0, 2, height);
    });
    const input = el("input", { type: "range", id: `slider-${id}`, min: low, max: high, step: (high - low) / 400,
      oninput: () => { set(Number(input.value)); state.moved = true; label(); select(); } });
    const output = el("output", { for: `slider-${id}` });
    const label = () => {
      output.textContent = words(get());
      input.setAttribute("aria-valuetext", words(get()));
      surface.invalidate();
    };
    const read = () => { input.value = get(); label(); };
    read();
    const scale = el("div", { class: "ticks", "aria-hidden": "true" }, ...ticks.map(([text, v]) => {
      const tick = el("span", {}, text);
      tick.style.left = `${((v - low) / (high - low)) * 100}%`;
      tick.className = v === low ? "first" : v === high ? "last" : "";
      return tick;
    }));
    const node = el("div", { class: "slider" }, el("label", { for: `slider-${id}` }, el("span", {}, name), output), chart, input, scale);
    return { node, read, surface };
  }

  function select() {
    reselect();
    changed();
  }

  function update() {
    for (const [name, { box }] of Object.entries(boxes)) box.checked = state[name];
    colour.value = state.colour;
    let selected = 0, right = 0;
    for (let i = 0; i < matches.n; i++) if (state.selected[i]) { selected++; if (matches.right) right += matches.right[i]; }
    const own = DATA.methods[0].kept;
    const truth = matches.right ? `, ${count(right)} right and ${count(selected - right)} wrong` : "";
    summary.replaceChildren(el("strong", {}, count(state.moved ? selected : own)), ` of ${count(DATA.total)} kept${truth}`,
      state.moved ? el("span", { class: "quiet" }, ` (the filter: ${count(own)})`) : el("span", { class: "quiet" }, ": the filter’s own"));
    reset.disabled = !state.moved;
    paintLegend();
    sliders.forEach((slider) => slider.surface.invalidate());
    inspect();
  }

  byId("side-matches").append(card, show, rerun);
  return { inspect, update, card, reset: () => reset.click() };
}

function createComparePanel(changed) {
  const side = byId("side-compare");
  const home = el("div", {});
  if (state.baseline < 0) {
    side.append(home, el("div", { class: "card" }, el("h2", {}, "Compare"), el("p", {}, "No other method ran on these matches. On the command line ",
      el("code", {}, "--compare"), " adds RANSAC and MAGSAC; in Python it is the argument ", el("code", {}, "baselines"), ".")));
    return { update() {}, differences() {}, home };
  }
  const truth = DATA.methods[0].right != null;
  const errors = DATA.methods.some((m) => m.error_deg != null);
  const head = ["method", "kept", ...(truth ? ["right", "wrong"] : []), ...(errors ? ["pose"] : []), "time"];
  const radios = [];
  const table = el("table", {}, el("caption", { class: "unseen" }, "Methods on the same matches"),
    el("thead", {}, el("tr", {}, ...head.map((word) => el("th", { scope: "col", title: word === "pose" ? "Larger of the errors of rotation and translation direction" : null }, word)))),
    el("tbody", {}, ...DATA.methods.map((method, m) => {
      const radio = m === 0 ? null : el("input", { type: "radio", name: "baseline", id: `baseline-${m}`, onchange: () => { state.baseline = m; changed(); } });
      if (radio) radios.push([radio, m]);
      const name = radio ? el("label", { for: `baseline-${m}` }, radio, " ", method.name) : el("strong", {}, method.name);
      const cells = [count(method.kept), ...(truth ? [count(method.right), count(method.wrong)] : []),
        ...(errors ? [method.error_deg == null ? "–" : `${fixed(method.error_deg, 1)}°`] : []), duration(method.ms)];
      return el("tr", {}, el("th", { scope: "row" }, name), ...cells.map((cell) => el("td", {}, cell)));
    })));
  const groups = el("div", { class: "groups" });
  const only = el("input", { type: "checkbox", id: "differences", onchange: () => differences(only.checked) });
  side.append(home, el("div", { class: "card" }, el("h2", {}, "The same matches, other methods"), table,
    el("p", { class: "quiet" }, truth ? `Right: within ${DATA.right_px} px of the true epipolar geometry. Wrong ones are drawn as crosses (×), right ones as dots (●).`
      : "Many kept matches are no proof: a wrong model gathers matches as well.")),
    el("div", { class: "card" }, el("h2", {}, "Who keeps what"),
      el("label", { class: "row", for: "differences", title: "Key X" }, only, " Differences only"), groups));

  function differences(on = !only.checked) {
    Object.assign(state.groups, { both: !on, ours: true, theirs: true, neither: false });
    changed();
  }

  function update() {
    const tally = { both: [0, 0], ours: [0, 0], theirs: [0, 0], neither: [0, 0] };
    for (let i = 0; i < matches.n; i++) tally[group(i)][matches.right && !matches.right[i] ? 1 : 0]++;
    const baseline = DATA.methods[state.baseline].name;
    const words = { both: "both", ours: "mgca_filter only", theirs: `${baseline} only`, neither: "neither" };
    groups.replaceChildren(...Object.keys(words).map((name) => {
      const box = el("input", { type: "checkbox", id: `group-${name}`, onchange: () => { state.groups[name] = box.checked; changed(); } });
      box.checked = state.groups[name];
      const [a, b] = tally[name];
      const numbers = matches.right ? [el("b", {}, `● ${count(a)}`), el("b", {}, `× ${count(b)}`)] : [el("b", {}, count(a))];
      const spoken = matches.right ? `${words[name]}: ${count(a)} right, ${count(b)} wrong` : null;
      if (spoken) box.setAttribute("aria-label", spoken);
      return el("label", { for: `group-${name}`, class: `group ${name}` }, box, el("i", { "aria-hidden": "true" }), el("span", {}, words[name]), ...numbers);
    }));
    radios.forEach(([radio, m]) => { radio.checked = m === state.baseline; });
    only.checked = !state.groups.both && state.groups.ours && state.groups.theirs && !state.groups.neither;
  }
  return { update, differences, home };
}

function fillWhy() {
  const { funnel, times_ms, assumptions, facts, matrices, left_out } = DATA.why;
  const widest = Math.max(...funnel.map(([, n]) => n), 1);
  const steps = el("ol", { class: "funnel" }, ...funnel.map(([name, n, words]) => {
    const bar = el("span", { class: "bar-fill" });
    bar.style.width = `${(100 * n) / widest}%`;
    return el("li", { class: name }, el("span", { class: "step" }, name), el("span", { class: "bar-track" }, bar), el("b", {}, count(n)), el("span", { class: "quiet" }, words));
  }));
  const total = Object.values(times_ms).reduce((a, b) => a + b, 0);
  const times = el("div", { class: "times" }, ...Object.entries(times_ms).map(([name, ms], i) => {
    const part = el("div", { class: `t${i % 5}`, title: `${name}: ${fixed(ms, 1)} ms` }, el("span", {}, name), el("b", {}, `${fixed(ms, 0)} ms`));
    part.style.flexGrow = Math.max(ms, total * 0.04);
    return part;
  }));
  const matrix = (value) => (Array.isArray(value[0]) ? value : [value]).map((row) => row.map((x) => x.toFixed(4).padStart(9)).join(" ")).join("\n");
  byId("why").append(
    el("div", { class: "card wide" }, el("h2", {}, "From raw matches to kept ones"), steps,
      left_out ? el("p", { class: "quiet" }, `${count(left_out)} matches are counted and not in this file, to keep it small.`) : null),
    total ? el("div", { class: "card wide" }, el("h2", {}, `Time in the filter: ${fixed(total, 0)} ms`), times) : null,
    el("div", { class: "card" }, el("h2", {}, "What was assumed"),
      assumptions.length ? el("ul", {}, ...assumptions.map((sentence) => el("li", {}, sentence))) : el("p", { class: "quiet" }, "Nothing: all that the filter asks for was given.")),
    el("div", { class: "card" }, el("h2", {}, "What ran"), el("dl", { class: "table" }, ...facts.flatMap(([name, value]) => [el("dt", {}, name), el("dd", {}, String(value))]))),
    Object.keys(matrices).length ? el("div", { class: "card wide" }, el("h2", {}, "Matrices"), el("p", { class: "quiet" }, "X2 = R X1 + t, x2ᵀ E x1 = 0 on the normalised planes, p2ᵀ F p1 = 0 in pixels."),
      el("div", { class: "matrices" }, ...Object.entries(matrices).map(([name, value]) => el("div", {}, el("h3", {}, name), el("pre", {}, name === "F" ? value.map((row) => row.map((x) => x.toExponential(3).padStart(11)).join(" ")).join("\n") : matrix(value)))))) : null,
  );
}
