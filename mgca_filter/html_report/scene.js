// Both cameras and the triangulated points of the kept matches, to be turned by hand. Unit: the baseline.

function createScene(viewer, onPin) {
  const canvas = byId("scene");
  const side = byId("side-geometry");
  const scene = DATA.scene;
  const home = el("div", {});
  if (!scene) {
    const reason = DATA.why.matrices.R
      ? "The report was not told the intrinsics that the filter had: hand K1 and K2 to it as well."
      : "There is no rotation and no translation that explains this pair.";
    side.append(home, el("div", { class: "card" }, el("h2", {}, "Geometry"), el("p", {}, reason)));
    return { available: false, home, invalidate() {}, move() {}, reset() {}, zoom() {} };
  }
  const { R, t, points } = scene;
  const options = { rays: false, photos: true, truth: Boolean(scene.truth) };
  const median = (values) => (values.length ? values.slice().sort((a, b) => a - b)[values.length >> 1] : 1);
  const depth = clamp(median(points.map((p) => p[2])), 0.5, 1e4);
  const frustum = scene.has_baseline ? clamp(0.16 * depth, 0.3, 4) : 1;

  // X1 = Rᵀ (X2 − t): a point of camera 2 in the frame of camera 1.
  const fromCamera2 = (rotation, translation) => ([x, y, z]) => {
    const d = [x - translation[0], y - translation[1], z - translation[2]];
    return [0, 1, 2].map((c) => rotation[0][c] * d[0] + rotation[1][c] * d[1] + rotation[2][c] * d[2]);
  };
  const identity = (p) => p;
  const second = fromCamera2(R, t);
  const cameras = [
    { place: identity, corners: scene.corners[0], colour: PALETTE.ours, name: "1", picture: 0 },
    { place: second, corners: scene.corners[1], colour: PALETTE.theirs, name: "2", picture: 1 },
  ];
  if (scene.truth) cameras.push({ place: fromCamera2(scene.truth.R, scene.truth.t), corners: scene.corners[1], colour: null, name: "2, true", dashed: true });

  // What a view shall hold: the cameras, and the points but for those that lie far out.
  const held = (() => {
    const limits = [0, 1, 2].map((c) => {
      const sorted = points.map((p) => p[c]).sort((a, b) => a - b);
      return [sorted[Math.floor(0.03 * sorted.length)], sorted[Math.ceil(0.97 * sorted.length) - 1]];
    });
    const near = points.filter((p) => p.every((v, c) => v >= limits[c][0] && v <= limits[c][1]));
    const frames = cameras.flatMap((camera) => [camera.place([0, 0, 0]), ...camera.corners.map(([x, y]) => camera.place([x * frustum, y * frustum, frustum]))]);
    return [...near, ...frames];
  })();
  const centre = [0, 1, 2].map((c) => (Math.min(...held.map((p) => p[c])) + Math.max(...held.map((p) => p[c]))) / 2);
  const start = { yaw: -0.45, pitch: 0.5, distance: 0 };
  let view = { ...start };

  let eye = null; // the camera, 0 or 1, that the view looks through, or none
  const surface = new Surface(canvas, paint);
  surface.onresize = () => { if (view.distance === start.distance) view.distance = 0; };

  // As near as the whole scene allows, seen from where the view looks.
  function distanceThatFits(width, height) {
    const radius = Math.max(...held.map((p) => Math.hypot(...p.map((v, c) => v - centre[c]))), 0.1);
    let [near, far] = [0.3 * radius, 6 * radius];
    for (let i = 0; i < 24; i++) {
      view.distance = (near + far) / 2;
      const project = projector(width, height);
      const fits = held.map(project).every(([x, y, d]) => d > 0.05 * radius && x > 0.07 * width && x < 0.93 * width && y > 0.09 * height && y < 0.91 * height);
      if (fits) far = view.distance;
      else near = view.distance;
    }
    return far;
  }


  function projector(width, height) {
    if (eye !== null) {
      const own = cameras[eye];
      const focal = Math.min(width / (own.corners[1][0] - own.corners[0][0]), height / (own.corners[2][1] - own.corners[1][1])) * 0.94;
      const [mx, my] = [(own.corners[0][0] + own.corners[1][0]) / 2, (own.corners[0][1] + own.corners[2][1]) / 2];
      return (p) => {
        const q = eye === 0 ? p : [0, 1, 2].map((r) => R[r][0] * p[0] + R[r][1] * p[1] + R[r][2] * p[2] + t[r]);
        return [width / 2 + focal * (q[0] / q[2] - mx), height / 2 + focal * (q[1] / q[2] - my), q[2]];
      };
    }
    const [cy, sy, cp, sp] = [Math.cos(view.yaw), Math.sin(view.yaw), Math.cos(view.pitch), Math.sin(view.pitch)];
    const focal = Math.min(width, height);
    return (p) => {
      const [x, y, z] = p.map((v, c) => v - centre[c]);
      const [x1, z1] = [cy * x + sy * z, -sy * x + cy * z];
      const [y2, z2] = [cp * y + sp * z1, -sp * y + cp * z1];
      const d = z2 + view.distance;
      return [width / 2 + (focal * x1) / d, height / 2 + (focal * y2) / d, d];
    };
  }

  function stroke(context, project, path, colour, width, dash = []) {
    const ends = path.map(project);
    if (ends.some((end) => end[2] <= 0.02)) return;
    context.beginPath();
    ends.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
    [context.strokeStyle, context.lineWidth] = [colour, width];
    context.setLineDash(dash);
    context.stroke();
    context.setLineDash([]);
  }

  // A picture in a quadrangle, as two affine halves: close enough for a frustum's face.
  function paintPicture(context, picture, quad) {
    if (!picture.naturalWidth || quad.some((q) => q[2] <= 0.02)) return;
    const [w, h] = [picture.naturalWidth, picture.naturalHeight];
    const base = context.getTransform();
    const face = [[0, 0], [w, 0], [w, h], [0, h]];
    for (const [a, b, c] of [[0, 1, 2], [0, 2, 3]]) {
      const [u0, v0] = face[a], [u1, v1] = face[b], [u2, v2] = face[c];
      const det = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0);
      const solve = (k) => {
        const [p0, p1, p2] = [quad[a][k], quad[b][k], quad[c][k]];
        const du = ((p1 - p0) * (v2 - v0) - (p2 - p0) * (v1 - v0)) / det;
        const dv = ((u1 - u0) * (p2 - p0) - (u2 - u0) * (p1 - p0)) / det;
        return [du, dv, p0 - du * u0 - dv * v0];
      };
      const [xu, xv, x0] = solve(0), [yu, yv, y0] = solve(1);
      context.save();
      context.beginPath();
      const middle = [0, 1].map((k) => (quad[a][k] + quad[b][k] + quad[c][k]) / 3);
      [a, b, c].forEach((i, k) => { // a little larger than the half, or a seam shows
        const [dx, dy] = [quad[i][0] - middle[0], quad[i][1] - middle[1]];
        const grown = 1 + 1.2 / Math.max(Math.hypot(dx, dy), 1);
        const corner = [middle[0] + grown * dx, middle[1] + grown * dy];
        if (k) context.lineTo(...corner);
        else context.moveTo(...corner);
      });
      context.clip();
      context.transform(xu, yu, xv, yv, x0, y0);
      context.drawImage(picture, 0, 0);
      context.restore();
      context.setTransform(base);
    }
  }

  function paint(context, width, height) {
    context.fillStyle = cssColour("--well");
    context.fillRect(0, 0, width, height);
    if (!view.distance) view.distance = start.distance = distanceThatFits(width, height);
    const project = projector(width, height);
    const ink = cssColour("--ink");
    const apices = cameras.map((camera) => camera.place([0, 0, 0]));
    cameras.forEach((camera, k) => {
      if (camera.dashed && !options.truth) return;
      if (k === eye) {
        if (options.photos) paintOwnView(context, viewer.pictures[k], camera.corners.map(([x, y]) => project(camera.place([x, y, 1]))));
        return;
      }
      const corners = camera.corners.map(([x, y]) => camera.place([x * frustum, y * frustum, frustum]));
      if (options.photos && camera.picture != null) {
        paintPicture(context, viewer.pictures[camera.picture], corners.map(project));
      }
      const dash = camera.dashed ? [5, 5] : [];
      corners.forEach((corner, i) => {
        stroke(context, project, [apices[k], corner], camera.colour || ink, 1.4, dash);
        stroke(context, project, [corner, corners[(i + 1) % 4]], camera.colour || ink, 2.2, dash);
      });
    });
    if (scene.has_baseline && eye === null) stroke(context, project, [apices[0], apices[1]], ink, 1.5, [4, 4]);
    const placed = points.map((p, k) => [...project(p), scene.rows[k], p]).filter((p) => p[2] > 0.02);
    placed.sort((a, b) => b[2] - a[2]);
    const drawn = placed.filter((p) => state.selected[p[3]] || p[3] === state.pin);
    if (options.rays) {
      context.globalAlpha = clamp(6 / Math.sqrt(drawn.length || 1), 0.08, 0.8);
      for (const p of drawn) [0, 1].forEach((k) => k !== eye && stroke(context, project, [apices[k], p[4]], positions[p[3]], 0.8));
      context.globalAlpha = 1;
    }
    context.strokeStyle = "rgba(0,0,0,0.6)";
    context.lineWidth = 0.8;
    for (const [x, y, d, row] of drawn) {
      context.beginPath();
      context.arc(x, y, eye === null ? clamp((3.4 * start.distance) / d, 1.6, 7) : 4, 0, 2 * Math.PI);
      context.fillStyle = positions[row];
      context.fill();
      context.stroke();
    }
    cameras.forEach((camera, k) => {
      const [x, y, d] = project(apices[k]);
      const hidden = k === eye || (camera.dashed && !options.truth);
      if (d > 0.02 && !hidden) label(context, x + (camera.dashed ? 40 : k === 0 && !scene.has_baseline ? -26 : 0), y - 14, camera.name, camera.colour || "#ffffff");
    });
    const pinned = placed.find((p) => p[3] === state.pin);
    if (pinned) {
      [0, 1].forEach((k) => k !== eye && stroke(context, project, [apices[k], pinned[4]], PALETTE.pin, 2));
      context.beginPath();
      context.arc(pinned[0], pinned[1], 9, 0, 2 * Math.PI);
      [context.strokeStyle, context.lineWidth] = [PALETTE.pin, 2.5];
      context.stroke();
    }
  }

  // What a camera saw, faded, as the background of the view through it.
  function paintOwnView(context, picture, [[left, top], , [right, bottom]]) {
    if (!picture.naturalWidth) return;
    context.globalAlpha = 0.6;
    context.drawImage(picture, left, top, right - left, bottom - top);
    context.globalAlpha = 1;
  }

  function label(context, x, y, words, colour) {
    context.font = "600 12px system-ui, sans-serif";
    [context.textAlign, context.textBaseline] = ["center", "middle"];
    const width = context.measureText(words).width + 12;
    context.fillStyle = "rgba(0,0,0,0.65)";
    context.beginPath();
    context.roundRect(x - width / 2, y - 9, width, 18, 5);
    context.fill();
    context.fillStyle = colour;
    context.fillText(words, x, y + 0.5);
    context.textAlign = "start";
  }

  let grip = null;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    grip = { x: event.clientX, y: event.clientY, moved: false };
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!grip) return;
    const [dx, dy] = [event.clientX - grip.x, event.clientY - grip.y];
    if (!grip.moved && Math.hypot(dx, dy) < 4) return;
    Object.assign(grip, { x: event.clientX, y: event.clientY, moved: true });
    turn(-dx * 0.008, dy * 0.008);
  });
  canvas.addEventListener("pointerup", (event) => {
    if (grip && !grip.moved) pick(event);
    grip = null;
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY * 0.0012));
  }, { passive: false });

  function pick(event) {
    const box = canvas.getBoundingClientRect();
    const [sx, sy] = [event.clientX - box.left, event.clientY - box.top];
    const project = projector(surface.width, surface.height);
    let best = -1, bestDistance = 12;
    points.forEach((p, k) => {
      const [x, y, d] = project(p);
      const distance = Math.hypot(x - sx, y - sy);
      if (d > 0.02 && distance < bestDistance) [best, bestDistance] = [scene.rows[k], distance];
    });
    onPin(best);
    surface.invalidate();
  }

  function turn(dyaw, dpitch) {
    look(null);
    view.yaw += dyaw;
    view.pitch = clamp(view.pitch + dpitch, -1.55, 1.55);
    surface.invalidate();
  }

  function zoom(factor) {
    if (eye !== null) return;
    view.distance = clamp(view.distance / factor, 0.3, 30 * start.distance);
    surface.invalidate();
  }

  function look(through, id = null) {
    eye = through;
    views.forEach((one) => one.setAttribute("aria-pressed", String(one.id === id)));
    surface.invalidate();
  }

  const button = (id, words, through, set) => el("button", { type: "button", id, "aria-pressed": "false", onclick: () => { if (set) view = { ...start, distance: 0, ...set }; look(through, id); } }, words);
  const views = [
    button("look-free", "Side", null, {}), button("look-above", "Above", null, { yaw: 0, pitch: 1.5 }),
    button("look-1", "Camera 1", 0), button("look-2", "Camera 2", 1),
  ];
  const toggle = (name, words) => {
    const box = el("input", { type: "checkbox", id: `scene-${name}`, onchange: () => { options[name] = box.checked; surface.invalidate(); } });
    box.checked = options[name];
    return el("label", { for: `scene-${name}` }, box, " ", words);
  };
  const error = DATA.methods[0].error_deg;
  const facts = [
    ["rotation", `${fixed(scene.rotation_deg, 1)}°`],
    ["translation", scene.has_baseline ? t.map((v) => (v < 0 ? "−" : "+") + Math.abs(v).toFixed(2)).join("  ") : "none"],
    ["points", scene.has_baseline ? `${count(points.length)} in front of both` : null],
    ["behind one", scene.behind ? count(scene.behind) : null],
    ["median parallax", scene.parallax_deg == null ? null : `${fixed(scene.parallax_deg, 1)}°`],
    ["focal lengths", scene.focal_px.map((f) => count(f)).join(" and ") + ` px, ${scene.guessed ? "guessed" : "given"}`],
    ["pose error", error == null ? null : `${fixed(error, 2)}°`],
  ].filter(([, value]) => value != null);
  side.append(home, el("div", { class: "card" }, el("h2", {}, "Look from"), el("div", { class: "buttons" }, ...views),
    el("div", { class: "checks" }, toggle("photos", "Photos"), scene.has_baseline ? toggle("rays", "Rays") : null, scene.truth ? toggle("truth", "True camera") : null)),
    el("div", { class: "card" }, el("h2", {}, "Relative pose"), el("dl", { class: "table" }, ...facts.flatMap(([name, value]) => [el("dt", {}, name), el("dd", {}, value)])),
      el("p", { class: "quiet" }, scene.has_baseline ? "Lengths are in baselines: two views do not tell metres." : "The camera turned on the spot, so that no point has a depth."),
      scene.guessed ? el("p", { class: "quiet" }, "The focal length is a guess, and the shape of the scene with it.") : null));
  look(null, "look-free");
  return { available: true, home, invalidate: () => surface.invalidate(), move: turn, reset: () => { view = { ...start, distance: 0 }; look(null, "look-free"); }, zoom, surface };
}
