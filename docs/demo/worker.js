// Away from the page, which stays alive: keypoints and matches of photographs, and the network.
"use strict";

importScripts("scores.js", "features.js");

const opened = new Map(); // what was loaded, by address or name; nothing is loaded twice
const once = (name, make) => opened.get(name) || opened.set(name, make().catch((error) => { opened.delete(name); throw error; })).get(name);

async function download(address, step, words) {
  const reply = await fetch(address);
  if (!reply.ok) throw new Error(`${address}: ${reply.status} ${reply.statusText}`);
  const total = Number(reply.headers.get("Content-Length"));
  const parts = [];
  let size = 0;
  for (const reader = reply.body.getReader(); ;) {
    const { done, value } = await reader.read();
    if (done) break;
    parts.push(value);
    size += value.length;
    step(`Loading ${words}: ${(size / 1e6).toFixed(1)}${total >= size ? ` of ${(total / 1e6).toFixed(1)}` : ""} MB`);
  }
  return new Uint8Array(await new Blob(parts).arrayBuffer());
}

const loadRuntime = (step) => once("runtime", async () => {
  importScripts("ort.wasm.min.js");
  ort.env.wasm.numThreads = 1; // more need headers that few web servers send
  ort.env.wasm.wasmPaths = new URL(".", self.location).href;
  ort.env.wasm.wasmBinary = await download("ort-wasm-simd-threaded.wasm", step, "ONNX Runtime");
});

const openModel = (name, step) => once(name, async () => {
  await loadRuntime(step);
  const content = await download(`${name}.onnx`, step, name);
  step(`Opening ${name}`);
  return ort.InferenceSession.create(content, { executionProviders: ["wasm"] });
});

const loadOpenCV = (step) => once("opencv", async () => {
  step("Loading OpenCV (11 MB)");
  importScripts("opencv.js");
  // Never awaited itself: it has a `then` that gives itself back, without end.
  if (!cv.Mat) await new Promise((resolve) => { cv.onRuntimeInitialized = () => resolve(); });
});

const settings = once("settings.json", async () => (await fetch("settings.json")).json());

async function answer({ photographs, matches, K1, K2, model }, step) {
  const metadata = (await settings).models[model];
  if (photographs) {
    await loadOpenCV(step);
    step("Detecting and matching keypoints");
    matches = matchPhotographs(...photographs);
  }
  const { points, attributes } = matches;
  const session = await openModel(model, step);
  const started = performance.now();
  const correspondences = normalized(points, K1, K2);
  const rows = candidates(attributes, metadata.candidate_rule);
  step(`Scoring ${rows.length} of ${points.length / 4} matches`);
  const logits = priorLogits(attributes, metadata);
  let essential = null;
  if (rows.length) {
    const tensor = (values, width) => new ort.Tensor("float32", taken(values, width, rows), [1, rows.length, width]);
    const output = await session.run({ correspondences: tensor(correspondences, 4), attributes: tensor(attributes, 8) });
    rows.forEach((row, i) => { logits[row] = output.logits.data[i]; });
    essential = output.essential.data;
  }
  const accepted = Array.from(logits, (logit) => logit > metadata.decision_threshold);
  const enough = accepted.filter(Boolean).length >= 16; // below, the network's essential matrix is arbitrary
  return {
    points, attributes, logits, accepted,
    scores: probabilities(logits, metadata.calibration),
    F: enough ? fundamental(essential, K1, K2) : null,
    milliseconds: performance.now() - started,
  };
}

self.onmessage = async ({ data: job }) => {
  const step = (words) => self.postMessage({ step: words });
  try {
    self.postMessage({ answer: await answer(job, step) });
  } catch (error) {
    // OpenCV throws the address of its exception.
    const message = typeof error === "number" ? cv.exceptionFromPtr(error).msg : error.message;
    self.postMessage({ error: String(message || error) });
  }
};
