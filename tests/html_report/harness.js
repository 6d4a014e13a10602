// Hands for a page that nobody sits at. CHECKS, an object of async functions, comes before this file.

const byId = (id) => document.getElementById(id);
const text = (id) => byId(id).textContent;
const words = (selector) => [...document.querySelectorAll(selector)].map((node) => node.textContent.trim());
const press = (key, target = document.body) =>
  target.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true }));

function set(id, value) {
  byId(id).value = value;
  byId(id).dispatchEvent(new Event("input", { bubbles: true }));
}

function point(canvas, type, [x, y]) {
  const box = canvas.getBoundingClientRect();
  const place = { clientX: box.left + x, clientY: box.top + y, pointerId: 1, bubbles: true };
  canvas.dispatchEvent(new PointerEvent(type, place));
}

function click(canvas, at) {
  point(canvas, "pointerdown", at);
  point(canvas, "pointerup", at);
}

const pixelsOf = (canvas) => canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
const countColours = (canvas) => new Set(new Uint32Array(pixelsOf(canvas).buffer)).size;

HTMLCanvasElement.prototype.setPointerCapture = () => {}; // refuses pointers that are not there

// One after the other in one page, which `tidy` brings back to how it opened; an error is the outcome of its check.
async function answer(questions) {
  const outcome = {};
  for (const [name, argument] of Object.entries(questions)) {
    try {
      outcome[name] = await CHECKS[name](argument);
    } catch (error) {
      outcome[name] = { error: String(error.stack || error) };
    }
    tidy();
  }
  const node = document.createElement("pre");
  node.id = "outcome";
  node.textContent = JSON.stringify(outcome);
  document.body.append(node);
}
