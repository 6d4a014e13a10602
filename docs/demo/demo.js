// The page: what is scored, what the worker says meanwhile, and the report's viewer for the answer.
"use strict";

const byId = (id) => document.getElementById(id);
const MAX_SIDE = 1200; // pixels of the longer side, as in the Python package
const worker = new Worker("worker.js");

// What the worker makes of a job {photographs or matches, K1, K2, model}; one at a time.
function ask(job) {
  return new Promise((resolve, reject) => {
    worker.onmessage = ({ data: { step, error, answer } }) => {
      if (step) say(step);
      else if (error) reject(new Error(error));
      else resolve(answer);
    };
    worker.onerror = (event) => reject(new Error(event.message || "the worker did not start"));
    worker.postMessage(job);
  });
}

function say(words, failed = false) {
  byId("progress").textContent = words;
  byId("progress").classList.toggle("failed", failed);
}

async function read(address) {
  const reply = await fetch(address);
  if (!reply.ok) throw new Error(`${address}: ${reply.status} ${reply.statusText}`);
  return reply;
}

const json = async (address) => (await read(address)).json();
const floats = (text) => new Float32Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);

// A pair whose matches Python found when the site was built, as browser_demo.py wrote it.
async function renderedPair(file) {
  const pair = await json(file);
  return { ...pair, matches: { points: floats(pair.points), attributes: floats(pair.attributes) } };
}

// Two photographs of the reader, of cameras of which nothing is known.
async function ownPair(files) {
  const photographs = await Promise.all(files.map(pixelsOf));
  const sizes = photographs.map(({ width, height }) => [width, height]);
  const [K1, K2] = sizes.map(guessedIntrinsics);
  const remark = "Keypoints: AKAZE; the focal length is guessed, 1.2 times the longer side.";
  return { photographs, sizes, K1, K2, remark, names: files.map((file) => file.name), images: photographs.map(addressOf) };
}

async function pixelsOf(file) {
  const bitmap = await createImageBitmap(file).catch(() => { throw new Error(`${file.name}: not an image that this browser reads`); });
  const scale = Math.min(1, MAX_SIDE / Math.max(bitmap.width, bitmap.height));
  const [width, height] = [bitmap.width, bitmap.height].map((side) => Math.max(1, Math.round(side * scale)));
  const context = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
  context.imageSmoothingQuality = "high";
  context.drawImage(bitmap, 0, 0, width, height);
  return context.getImageData(0, 0, width, height);
}

function addressOf(pixels) {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [pixels.width, pixels.height];
  canvas.getContext("2d").putImageData(pixels, 0, 0);
  return canvas.toDataURL("image/jpeg", 0.9);
}

// The package's guess: a focal length of 1.2 times the longer side, the principal point at the centre.
function guessedIntrinsics([width, height]) {
  const focal = 1.2 * Math.max(width, height);
  return [[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]];
}

// A column of 16 bits a value, and a mask, as the report's shell.js unpacks them.
const base64 = (raw) => btoa(Array.from(raw, (byte) => String.fromCharCode(byte)).join(""));
function pack(values) {
  const finite = values.filter(Number.isFinite);
  const [lo, hi] = finite.reduce(([low, high], v) => [Math.min(low, v), Math.max(high, v)], finite.length ? [finite[0], finite[0]] : [0, 0]);
  const raw = new Uint8Array(2 * values.length);
  values.forEach((v, i) => {
    const code = Number.isFinite(v) ? Math.round(((v - lo) / Math.max(hi - lo, 1e-300)) * 65534) : 65535;
    [raw[2 * i], raw[2 * i + 1]] = [code & 255, code >> 8];
  });
  return { lo, hi, codes: base64(raw) };
}

function packMask(mask) {
  const raw = new Uint8Array(Math.ceil(mask.length / 8));
  mask.forEach((set, i) => { raw[i >> 3] |= Number(set) << (i & 7); });
  return base64(raw);
}

// What the viewer draws, under the names that pair_report.py gives it.
function viewerData(pair, answer) {
  const { points, attributes, scores, accepted, F } = answer;
  const rows = Array.from(scores, (_, i) => i);
  const column = (values, width, at) => rows.map((i) => values[width * i + at]);
  const columns = Object.fromEntries(["x1", "y1", "x2", "y2"].map((name, at) => [name, pack(column(points, 4, at))]));
  columns.score = pack(Array.from(scores));
  columns.ratio = pack(rows.map((i) => (attributes[8 * i + 5] ? attributes[8 * i] : NaN)));
  columns.log_residual = pack(rows.map(() => NaN)); // no model is fitted here
  const mask = packMask(accepted);
  const kept = accepted.filter(Boolean).length;
  const { names, sizes, images, right = null, true_F = null } = pair;
  return { names, sizes, images, rows, total: rows.length, columns, mask, methods: [{ kept, mask }], right, F, true_F };
}

async function show(data) {
  // No text in the data ends the element or starts another.
  const text = JSON.stringify(data).replace(/</g, "\\u003c");
  const page = await (await read("answer.html")).text();
  byId("answer").srcdoc = page.replace('id="data">{}<', () => `id="data">${text}<`);
  byId("answer").hidden = false;
}

// Score a pair and show it; the answer holds logits, scores, accepted, points and attributes of every match.
async function run(pair, model) {
  const { photographs, matches, K1, K2 } = pair;
  const answer = await ask({ photographs, matches, K1, K2, model });
  await show(viewerData(pair, answer));
  const [kept, all] = [answer.accepted.filter(Boolean).length, answer.scores.length];
  say(`${kept} of ${all} matches accepted by ${model} in ${(answer.milliseconds / 1000).toFixed(1)} s. ${pair.remark}`);
  return answer;
}

async function start() {
  const settings = await json("settings.json");
  byId("missing").hidden = settings.complete;
  byId("choice").hidden = byId("progress").hidden = !settings.complete;
  if (!settings.complete) return;
  byId("pair").append(...settings.pairs.map(({ title, file }) => new Option(title, file)), new Option("your own photographs", ""));
  byId("model").append(...Object.keys(settings.models).map((name) => new Option(name, name)));
  const photos = [byId("photo1"), byId("photo2")];

  async function update() {
    const files = photos.map((input) => input.files[0]);
    const own = byId("pair").value === "";
    if (own && !files.every(Boolean)) {
      say("Choose two photographs of one place.");
      return;
    }
    document.body.setAttribute("aria-busy", "true");
    try {
      await run(await (own ? ownPair(files) : renderedPair(byId("pair").value)), byId("model").value);
    } catch (error) {
      say(error.message, true);
    }
    document.body.removeAttribute("aria-busy");
  }

  // What is chosen while a pair is scored comes after it.
  let last = update();
  const next = () => { last = last.then(update); };
  for (const control of [byId("pair"), byId("model")]) control.addEventListener("change", next);
  for (const input of photos) input.addEventListener("change", () => { byId("pair").value = ""; next(); });
  await last;
}

const started = start().catch((error) => say(`${error.message}. This page has to come from a web server, not from a file.`, true));
