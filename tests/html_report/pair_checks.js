// What the tests of a pair's page do to it, by name; each returns what it saw.

const at = (side, row) => report.viewer.toScreen(side, report.matches.x[side][row], report.matches.y[side][row]);

// Nobody watches, so that no frame is ever due: the picture is drawn when it is asked for.
const draw = (surface) => surface.resize();

function tidy() {
  const { state, viewer, open } = report;
  byId("keys").close();
  byId("reset").click();
  Object.assign(state, { kept: true, rejected: false, lines: false, colour: "position" });
  Object.assign(state.groups, { both: true, ours: true, theirs: true, neither: false });
  viewer.pinMatch(-1);
  viewer.fit();
  open("matches");
}

const CHECKS = {
  async names() {
    return { title: document.title, names: words(".name"), images: document.images.length };
  },

  async theme() {
    const dark = matchMedia("(prefers-color-scheme: dark)").matches;
    const background = getComputedStyle(document.body).backgroundColor;
    press("d");
    return { dark, background, other: getComputedStyle(document.body).backgroundColor };
  },

  async sliders() {
    set("slider-residual", Math.log10(0.4));
    const near = text("live-count");
    set("slider-score", 0.6);
    const both = text("live-count");
    const said = byId("slider-score").getAttribute("aria-valuetext");
    byId("reset").click();
    const selected = [...report.state.selected];
    return { near, both, said, own: text("live-count"), selected, disabled: byId("reset").disabled };
  },

  async hover(row) {
    const canvas = byId("images");
    point(canvas, "pointermove", at(1, row));
    const values = Object.fromEntries([...document.querySelectorAll(".values div")].map((d) => [...d.children].map((c) => c.textContent)));
    const patches = [...document.querySelectorAll(".patch")].map(countColours);
    point(canvas, "pointerleave", [0, 0]);
    return { values, patches, hover: report.state.hover, left: words(".values div").length };
  },

  async epipolarLine(row) {
    const canvas = byId("images");
    click(canvas, at(0, row));
    draw(report.viewer.surface);
    const [a, b, c] = report.epipolarLine(report.F, 0, report.matches.x[0][row], report.matches.y[0][row]);
    const x = report.matches.x[1][row] + 60;
    const ratio = canvas.width / canvas.getBoundingClientRect().width;
    const place = report.viewer.toScreen(1, x, (-c - a * x) / b).map((v) => Math.round(v * ratio));
    const pixel = [...canvas.getContext("2d").getImageData(...place, 1, 1).data];
    return { pin: report.state.pin, line: [a, b, c], pixel, hint: text("hint"), status: text("status") };
  },

  async looseClick() {
    press("k"); // no match is in the way
    click(byId("images"), report.viewer.toScreen(1, 100, 200));
    const spot = { ...report.state.spot };
    press("Escape");
    return { spot, after: report.state.spot };
  },

  async keys() {
    const { state, viewer } = report;
    const out = {};
    const scale = () => viewer.toScreen(0, 100, 0)[0] - viewer.toScreen(0, 0, 0)[0];
    const background = () => getComputedStyle(document.body).backgroundColor;
    ["r", "l"].forEach((key) => press(key));
    out.flags = [state.kept, state.rejected, state.lines, byId("show-lines").checked];
    press("n");
    out.first = state.pin;
    ["n", "p"].forEach((key) => press(key));
    out.again = state.pin;
    out.fit = scale();
    press("+");
    out.closer = scale();
    ["-", "-"].forEach((key) => press(key));
    out.further = scale();
    press("0");
    out.back = scale();
    const left = viewer.toScreen(0, 0, 0)[0];
    press("ArrowLeft");
    out.moved = viewer.toScreen(0, 0, 0)[0] - left;
    press("z");
    out.zoomed = scale();
    out.tabs = ["2", "3", "4", "1"].map((key) => (press(key), state.tab));
    press("d");
    out.one = background();
    press("d");
    out.two = background();
    press("?");
    return { ...out, dialog: byId("keys").open, listed: words("#keys kbd").length };
  },

  async wheelAndDrag() {
    const { viewer, state } = report;
    const canvas = byId("images");
    const box = canvas.getBoundingClientRect();
    const [start, other] = [0, 1].map((side) => viewer.toScreen(side, 200, 150));
    const place = { clientX: box.left + start[0], clientY: box.top + start[1] };
    canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: -400, cancelable: true, ...place }));
    const wheeled = viewer.toScreen(0, 200, 150);
    const scale = viewer.toScreen(0, 300, 150)[0] - wheeled[0];
    point(canvas, "pointerdown", start);
    point(canvas, "pointermove", [start[0] + 30, start[1] - 20]);
    point(canvas, "pointerup", [start[0] + 30, start[1] - 20]);
    const dragged = viewer.toScreen(0, 200, 150);
    return { start, other, wheeled, dragged, scale, still: viewer.toScreen(1, 200, 150), pin: state.pin };
  },

  async comparison() {
    press("x");
    const row = (name) => words(`.group.${name} b`).map((word) => Number(word.replace(/[^0-9]/g, "")));
    const cells = [...document.querySelectorAll("#side-compare tbody tr")].map((tr) => [...tr.children].map((c) => c.textContent.trim()));
    const tally = Object.fromEntries(["both", "ours", "theirs", "neither"].map((name) => [name, row(name)]));
    return { tally, cells, groups: { ...report.state.groups }, only: byId("differences").checked };
  },

  async scene() {
    press("3");
    const canvas = byId("scene");
    const picture = () => (draw(report.scene.surface), canvas.toDataURL());
    const first = picture();
    const out = { colours: countColours(canvas), hidden: byId("images").hidden };
    press("ArrowLeft");
    const turned = picture();
    byId("look-1").click();
    const through = picture();
    press("0");
    return { ...out, turned: turned !== first, through: through !== turned, again: picture() === first };
  },

  async unnamed() {
    const name = (node) => node.getAttribute("aria-label") || node.textContent.trim() || (node.labels && node.labels[0] && node.labels[0].textContent.trim());
    const controls = [...document.querySelectorAll("button, input, select, canvas:not([aria-hidden])")];
    return { controls: controls.length, unnamed: controls.filter((node) => !name(node)).map((node) => node.outerHTML) };
  },

  async everyTab() {
    for (const tab of ["compare", "geometry", "why", "matches"]) {
      report.open(tab);
      draw(report.viewer.surface);
      if (report.scene.surface) draw(report.scene.surface);
    }
    set("slider-score", 0.3);
    return { headline: text("headline"), live: text("live-count"), residual: byId("slider-residual") !== null };
  },

  async colours() {
    const pictures = ["position", "score", "residual", "truth"].map((colour) => {
      byId("colour").value = colour;
      byId("colour").dispatchEvent(new Event("change"));
      draw(report.viewer.surface);
      return byId("images").toDataURL();
    });
    return new Set(pictures).size;
  },
};
