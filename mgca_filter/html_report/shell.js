// What both kinds of report share: the data, elements, colours, light and dark, tabs, the list of keys.

const DATA = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);

function el(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (value === true) node.setAttribute(name, "");
    else if (value !== false && value != null) node.setAttribute(name, value);
  }
  node.append(...children.filter((child) => child != null));
  return node;
}

const clamp = (value, low, high) => Math.min(high, Math.max(low, value));
// Thousands with a thin space that does not break: the report reads the same wherever it is opened.
const count = (n) => String(Math.round(n)).replace(/\B(?=(\d{3})+$)/g, "\u202f");
const fixed = (x, digits) => (x == null || !Number.isFinite(x) ? "–" : x.toFixed(digits));
const pixels = (x) => (x == null || !Number.isFinite(x) ? "–" : x < 10 ? x.toFixed(2) : x < 100 ? x.toFixed(1) : count(x));

const duration = (ms) => (ms == null ? "–" : ms < 1000 ? `${Math.round(ms)} ms` : `${(ms / 1000).toFixed(1)} s`);

function bytes(text) {
  const raw = atob(text);
  const out = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
  return out;
}

// A column of 16 bits a value, as embedded.py packs it.
function unpack({ lo, hi, codes }) {
  const raw = bytes(codes);
  const out = new Float64Array(raw.length / 2);
  for (let i = 0; i < out.length; i++) {
    const code = raw[2 * i] + 256 * raw[2 * i + 1];
    out[i] = code === 65535 ? NaN : lo + ((hi - lo) * code) / 65534;
  }
  return out;
}

function unpackMask(text, length) {
  const raw = bytes(text);
  return Uint8Array.from({ length }, (_, i) => (raw[i >> 3] >> (i & 7)) & 1);
}

// Told apart with any colour vision (Okabe and Ito 2008).
const PALETTE = { ours: "#56b4e9", theirs: "#e69f00", both: "#cfd6da", right: "#56b4e9", wrong: "#ff7a3c", pin: "#f0e442" };

// From dark blue over green to yellow, even in lightness: viridis, in five steps.
const RAMP = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
function ramp(x) {
  const at = clamp(Number.isFinite(x) ? x : 0, 0, 1) * (RAMP.length - 1);
  const i = Math.min(RAMP.length - 2, Math.floor(at));
  const mix = RAMP[i].map((low, c) => Math.round(low + (RAMP[i + 1][c] - low) * (at - i)));
  return `rgb(${mix.join(",")})`;
}

const cssColour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// A canvas drawn at most once a frame, with as many pixels as the screen has.
class Surface {
  constructor(canvas, draw) {
    this.canvas = canvas;
    this.draw = draw;
    this.context = canvas.getContext("2d");
    this.pending = false;
    new ResizeObserver(() => this.resize()).observe(canvas); // which reports the first size too
  }

  resize() {
    const box = this.canvas.getBoundingClientRect();
    if (!box.width || !box.height) return;
    const ratio = window.devicePixelRatio || 1;
    const before = [this.width, this.height];
    [this.width, this.height] = [box.width, box.height];
    this.canvas.width = Math.round(box.width * ratio);
    this.canvas.height = Math.round(box.height * ratio);
    if (this.onresize && (before[0] !== this.width || before[1] !== this.height)) this.onresize();
    this.paint();
  }

  invalidate() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(() => this.paint());
  }

  paint() {
    this.pending = false;
    if (!this.width) return;
    const ratio = this.canvas.width / this.width;
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.context.clearRect(0, 0, this.width, this.height);
    this.draw(this.context, this.width, this.height);
  }
}

// "#tab=geometry&theme=dark" at the end of the address opens the report that way.
const wished = new URLSearchParams(location.hash.slice(1));

function startTheme(repaint) {
  const root = document.documentElement;
  const system = matchMedia("(prefers-color-scheme: dark)");
  const apply = (theme) => {
    if (theme === "dark" || theme === "light") root.dataset.theme = theme;
    repaint();
  };
  const toggle = () => {
    const dark = root.dataset.theme ? root.dataset.theme === "dark" : system.matches;
    apply(dark ? "light" : "dark");
  };
  system.addEventListener("change", repaint);
  byId("theme").addEventListener("click", toggle);
  apply(wished.get("theme"));
  return toggle;
}

// Tabs as the ARIA practices have them: one of them in the tab order, arrows move between them.
function startTabs(names, select) {
  const tabs = names.map((name) => byId(`tab-${name}`));
  const open = (name, focus = false) => {
    if (!names.includes(name)) return;
    tabs.forEach((tab, i) => {
      tab.setAttribute("aria-selected", String(names[i] === name));
      tab.tabIndex = names[i] === name ? 0 : -1;
      if (focus && names[i] === name) tab.focus();
    });
    select(name);
  };
  tabs.forEach((tab, i) => {
    tab.addEventListener("click", () => open(names[i]));
    tab.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!step) return;
      event.preventDefault();
      event.stopPropagation();
      open(names[(i + step + names.length) % names.length], true);
    });
  });
  return open;
}

function startKeys(keys) {
  const dialog = byId("keys");
  const list = dialog.querySelector("dl");
  for (const { key, words } of keys) if (words) list.append(el("dt", {}, el("kbd", {}, key)), el("dd", {}, words));
  byId("keys-close").addEventListener("click", () => dialog.close());
  const help = () => (dialog.open ? dialog.close() : dialog.showModal());
  byId("help").addEventListener("click", help);
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "?") return help();
    if (dialog.open) return;
    const inControl = /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName);
    if (inControl && (event.key.startsWith("Arrow") || /^[0-9+\-]$/.test(event.key))) return;
    const entry = keys.find(({ key, also }) => key.toLowerCase() === event.key.toLowerCase() || (also || []).includes(event.key));
    if (entry && entry.run(event) !== false) event.preventDefault();
  });
}
