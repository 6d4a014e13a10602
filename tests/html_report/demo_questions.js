// Put behind the demo's page by test_demo.py: uses it as a reader would, and posts what it saw.

const wait = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));
const lists = (answer) => Object.fromEntries(Object.entries(answer).map(([name, value]) => [name, ArrayBuffer.isView(value) ? [...value] : value]));
const answerWindow = () => byId("answer").contentWindow;

async function until(holds) {
  for (let i = 0; i < 2400 && !holds(); i++) await wait(50);
  if (!holds()) throw new Error(`waited in vain, the page says: ${byId("progress").textContent}`);
}

function choose(files) {
  files.forEach((file, i) => {
    const list = new DataTransfer();
    list.items.add(file);
    byId(`photo${i + 1}`).files = list.files;
  });
  byId("photo2").dispatchEvent(new Event("change"));
}

const QUESTIONS = {
  async scores() {
    const seen = {};
    for (const { value: model } of byId("model").options) {
      seen[model] = [];
      for (const { value: file } of [...byId("pair").options].slice(0, -1)) {
        const pair = await renderedPair(file);
        const bits = Uint8Array.from(atob(pair.right), (c) => c.charCodeAt(0));
        const answer = await run(pair, model);
        const right = answer.accepted.map((_, i) => (bits[i >> 3] >> (i & 7)) & 1);
        seen[model].push({ ...lists(answer), right });
      }
    }
    return seen;
  },

  async viewer() {
    const complaints = [];
    byId("model").value = "mgca_small";
    byId("pair").value = "pair1.json";
    byId("progress").textContent = "";
    byId("pair").dispatchEvent(new Event("change"));
    await until(() => /accepted/.test(byId("progress").textContent));
    await until(() => answerWindow().document.getElementById("live-count"));
    await wait(1000);
    answerWindow().addEventListener("error", (event) => complaints.push(event.message));
    const page = answerWindow().document;
    const kept = () => Number(page.querySelector("#live-count strong").textContent.replace(/[^0-9]/g, ""));
    const canvas = page.getElementById("images");
    const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
    const seen = { colours: new Set(new Uint32Array(pixels.buffer)).size, kept: kept() };
    const slider = page.getElementById("slider-score");
    slider.value = 0.5;
    slider.dispatchEvent(new Event("input"));
    return { ...seen, fewer: kept(), complaints };
  },

  async own() {
    const { images } = await json("pair1.json");
    const files = images.map(async (address, i) => new File([await (await fetch(address)).blob()], `${i}<b>.jpg`, { type: "image/jpeg" }));
    const steps = [];
    const watch = new MutationObserver(() => steps.push(byId("progress").textContent));
    watch.observe(byId("progress"), { childList: true });
    const before = ask;
    let answer;
    ask = async (job) => (answer = await before(job)); // what the page itself gets
    choose(await Promise.all(files));
    await until(() => /AKAZE/.test(byId("progress").textContent));
    watch.disconnect();
    ask = before;
    return { ...lists(answer), steps, said: byId("progress").textContent };
  },

  async blank() {
    const sides = [200, 4];
    const canvases = sides.map((side) => new OffscreenCanvas(side, side));
    canvases.forEach((canvas) => canvas.getContext("2d").fillRect(0, 0, 1, 1));
    choose(await Promise.all(canvases.map(async (canvas) => new File([await canvas.convertToBlob()], "blank.png"))));
    await until(() => /^0 of /.test(byId("progress").textContent));
    return { said: byId("progress").textContent };
  },

  async noImage() {
    choose([1, 2].map(() => new File(["no image"], "notes.txt")));
    await until(() => byId("progress").classList.contains("failed"));
    return { failed: true, said: byId("progress").textContent };
  },
};

(async () => {
  await started;
  const outcome = {};
  for (const [name, question] of Object.entries(QUESTIONS)) {
    outcome[name] = await question().catch((error) => ({ error: String(error.stack || error) }));
  }
  await fetch("outcome", { method: "POST", body: JSON.stringify(outcome) });
})();
