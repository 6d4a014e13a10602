// Both images with zoom and pan, matches over them, the epipolar line of what was clicked.

function createViewer(onHover, onPin) {
  const canvas = byId("images");
  const pictures = DATA.images.map((address) => Object.assign(new Image(), { src: address, alt: "" }));
  const views = [{}, {}];
  let panes = [];
  let whole = true; // both images are shown whole, and stay so when the window changes
  const GAP = 8;

  const surface = new Surface(canvas, paint);
  surface.onresize = () => (whole ? fit() : keepCentres());
  pictures.forEach((picture) => picture.addEventListener("load", () => { surface.invalidate(); onHover(); }));
  fit();

  function layout() {
    const { width, height } = surface;
    if (!width) return;
    const [a, b] = DATA.sizes.map(([w, h]) => w / h);
    const beside = Math.min((width - GAP) / (a + b), height);
    const stacked = Math.min(width / Math.max(a, b), (height - GAP) / 2);
    if (beside * Math.min(a, b) >= stacked * Math.min(a, b)) {
      const first = ((width - GAP) * a) / (a + b);
      panes = [{ x: 0, y: 0, w: first, h: height }, { x: first + GAP, y: 0, w: width - GAP - first, h: height }];
    } else {
      const half = (height - GAP) / 2;
      panes = [{ x: 0, y: 0, w: width, h: half }, { x: 0, y: half + GAP, w: width, h: half }];
    }
  }

  function fitScale(side) {
    return Math.min(panes[side].w / DATA.sizes[side][0], panes[side].h / DATA.sizes[side][1]);
  }

  function keepCentres() {
    const before = panes;
    layout();
    panes.forEach((pane, side) => {
      views[side].x += pane.x + pane.w / 2 - before[side].x - before[side].w / 2;
      views[side].y += pane.y + pane.h / 2 - before[side].y - before[side].h / 2;
    });
  }

  function fit() {
    layout();
    if (!panes.length) return;
    whole = true;
    panes.forEach((pane, side) => {
      const s = fitScale(side);
      views[side] = { s, x: pane.x + (pane.w - DATA.sizes[side][0] * s) / 2, y: pane.y + (pane.h - DATA.sizes[side][1] * s) / 2 };
    });
    surface.invalidate();
  }

  // The centre of the top-left pixel is (0, 0).
  const toScreen = (side, px, py) => [views[side].x + (px + 0.5) * views[side].s, views[side].y + (py + 0.5) * views[side].s];
  const toImage = (side, sx, sy) => [(sx - views[side].x) / views[side].s - 0.5, (sy - views[side].y) / views[side].s - 0.5];
  const inside = (side, sx, sy) => {
    const p = panes[side];
    return sx >= p.x && sx <= p.x + p.w && sy >= p.y && sy <= p.y + p.h;
  };
  const sideAt = (sx, sy) => (panes.length && inside(0, sx, sy) ? 0 : panes.length && inside(1, sx, sy) ? 1 : -1);

  function zoom(side, factor, sx, sy) {
    const view = views[side];
    const s = clamp(view.s * factor, fitScale(side) * 0.5, 40);
    view.x = sx - ((sx - view.x) * s) / view.s;
    view.y = sy - ((sy - view.y) * s) / view.s;
    view.s = s;
    whole = false;
    surface.invalidate();
  }

  function zoomBoth(factor) {
    panes.forEach((pane, side) => zoom(side, factor, pane.x + pane.w / 2, pane.y + pane.h / 2));
  }

  function pan(dx, dy, side = -1) {
    views.forEach((view, i) => {
      if (side >= 0 && i !== side) return;
      view.x += dx;
      view.y += dy;
    });
    whole = false;
    surface.invalidate();
  }

  // Both images at a match, at a scale where a keypoint can be judged.
  function goTo(i) {
    whole = false;
    panes.forEach((pane, side) => {
      const s = Math.max(views[side].s, fitScale(side) * 4);
      views[side] = { s, x: pane.x + pane.w / 2 - (matches.x[side][i] + 0.5) * s, y: pane.y + pane.h / 2 - (matches.y[side][i] + 0.5) * s };
    });
    surface.invalidate();
  }

  function nearest(sx, sy) {
    const side = sideAt(sx, sy);
    if (side < 0) return -1;
    let best = -1, bestDistance = 14 * 14;
    for (let i = 0; i < matches.n; i++) {
      if (!visible(i)) continue;
      const [x, y] = toScreen(side, matches.x[side][i], matches.y[side][i]);
      const distance = (x - sx) ** 2 + (y - sy) ** 2;
      if (distance < bestDistance) [best, bestDistance] = [i, distance];
    }
    return best;
  }

  function clipTo(context, pane, draw) {
    context.save();
    context.beginPath();
    context.rect(pane.x, pane.y, pane.w, pane.h);
    context.clip();
    draw();
    context.restore();
  }

  function dot(context, x, y, colour, radius) {
    context.beginPath();
    context.arc(x, y, radius, 0, 2 * Math.PI);
    context.fillStyle = colour;
    context.fill();
    context.stroke();
  }

  function cross(context, x, y, colour, radius) {
    for (const [style, width] of [["rgba(0,0,0,0.6)", 3.2], [colour, 1.5]]) {
      context.beginPath();
      context.moveTo(x - radius, y - radius);
      context.lineTo(x + radius, y + radius);
      context.moveTo(x + radius, y - radius);
      context.lineTo(x - radius, y + radius);
      context.save();
      [context.strokeStyle, context.lineWidth] = [style, width];
      context.stroke();
      context.restore();
    }
  }

  function paintLine(context, i, colour, width) {
    const [a, b] = [0, 1].map((side) => toScreen(side, matches.x[side][i], matches.y[side][i]));
    if (!inside(0, ...a) || !inside(1, ...b)) return;
    context.beginPath();
    context.moveTo(...a);
    context.lineTo(...b);
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.stroke();
  }

  function paintEpipolar(context, F, side, px, py, colour, dashed) {
    const other = 1 - side;
    const [a, b, c] = epipolarLine(F, side, px, py);
    const [w, h] = DATA.sizes[other];
    const far = 4 * (w + h);
    const ends = Math.abs(b) > Math.abs(a)
      ? [[-far, (-c + a * far) / b], [far, (-c - a * far) / b]]
      : [[(-c + b * far) / a, -far], [(-c - b * far) / a, far]];
    clipTo(context, panes[other], () => {
      for (const [style, width] of [["rgba(0,0,0,0.55)", 4.5], [colour, 2]]) {
        context.beginPath();
        context.setLineDash(dashed ? [8, 7] : []);
        context.moveTo(...toScreen(other, ...ends[0]));
        context.lineTo(...toScreen(other, ...ends[1]));
        [context.strokeStyle, context.lineWidth] = [style, width];
        context.stroke();
      }
      context.setLineDash([]);
    });
  }

  function paint(context, width, height) {
    if (panes.length !== 2) return layout();
    context.fillStyle = cssColour("--well");
    context.fillRect(0, 0, width, height);
    panes.forEach((pane, side) => clipTo(context, pane, () => {
      const { s, x, y } = views[side];
      context.imageSmoothingEnabled = s < 6;
      context.imageSmoothingQuality = "high";
      const [w, h] = [DATA.sizes[side][0] * s, DATA.sizes[side][1] * s];
      if (pictures[side].complete && pictures[side].naturalWidth) context.drawImage(pictures[side], x, y, w, h);
      context.fillStyle = `rgba(0,0,0,${state.lines ? 0.45 : 0.12})`; // matches must stand out against a photograph
      context.fillRect(x, y, w, h);
    }));
    const shown = [];
    for (const wanted of [0, 1]) {
      for (let i = 0; i < matches.n; i++) if (Number(!crossed(i)) === wanted && visible(i)) shown.push(i);
    }
    if (state.lines) {
      context.globalAlpha = clamp(9 / Math.sqrt(shown.length || 1), 0.16, 0.9);
      shown.forEach((i) => paintLine(context, i, colourOf(i), crossed(i) ? 0.8 : 1.4));
      context.globalAlpha = 1;
    }
    context.strokeStyle = "rgba(0,0,0,0.75)";
    context.lineWidth = 1;
    const radius = shown.length > 1500 ? 3 : 4;
    panes.forEach((pane, side) => clipTo(context, pane, () => shown.forEach((i) => {
      const [x, y] = toScreen(side, matches.x[side][i], matches.y[side][i]);
      if (!inside(side, x, y)) return;
      if (crossed(i)) cross(context, x, y, colourOf(i), radius - 1);
      else dot(context, x, y, colourOf(i), radius);
    })));
    paintSpot(context);
    for (const [i, colour] of [[state.pin, PALETTE.pin], [state.hover, "#ffffff"]]) {
      if (i < 0 || !matches.drawable[i]) continue;
      paintLine(context, i, colour, 1.5);
      panes.forEach((pane, side) => clipTo(context, pane, () => {
        const [x, y] = toScreen(side, matches.x[side][i], matches.y[side][i]);
        for (const [style, lineWidth] of [["rgba(0,0,0,0.8)", 5], [colour, 2.5]]) {
          context.beginPath();
          context.arc(x, y, 9, 0, 2 * Math.PI);
          [context.strokeStyle, context.lineWidth] = [style, lineWidth];
          context.stroke();
        }
      }));
    }
    paintNames(context);
  }

  function paintSpot(context) {
    if (!state.spot) return;
    const { side, x, y } = state.spot;
    if (DATA.F) paintEpipolar(context, DATA.F, side, x, y, PALETTE.pin, false);
    if (DATA.true_F) paintEpipolar(context, DATA.true_F, side, x, y, "#ffffff", true);
    const marks = [[side, x, y]];
    if (DATA.by_homography && side === 0) marks.push([1, ...mapped(DATA.homography, x, y)]);
    marks.forEach(([where, px, py]) => clipTo(context, panes[where], () => {
      const [sx, sy] = toScreen(where, px, py);
      for (const [style, width] of [["rgba(0,0,0,0.8)", 4], [PALETTE.pin, 2]]) {
        context.beginPath();
        context.moveTo(sx - 11, sy);
        context.lineTo(sx + 11, sy);
        context.moveTo(sx, sy - 11);
        context.lineTo(sx, sy + 11);
        [context.strokeStyle, context.lineWidth] = [style, width];
        context.stroke();
      }
    }));
  }

  function paintNames(context) {
    context.font = "600 12px system-ui, sans-serif";
    context.textBaseline = "middle";
    panes.forEach((pane, side) => clipTo(context, pane, () => {
      let name = DATA.names[side];
      while (name.length > 8 && context.measureText(name).width > pane.w - 120) name = "…" + name.slice(2);
      const width = context.measureText(name).width + 18;
      context.fillStyle = "rgba(0,0,0,0.62)";
      context.beginPath();
      context.roundRect(pane.x + 8, pane.y + 8, width, 24, 6);
      context.fill();
      context.fillStyle = "#fff";
      context.fillText(name, pane.x + 17, pane.y + 20.5);
    }));
  }

  // Two patches of the same size around a match, magnified.
  function paintPatch(context, size, side, i) {
    context.clearRect(0, 0, size, size);
    if (i < 0 || !pictures[side].naturalWidth) return;
    const scale = pictures[side].naturalWidth / DATA.sizes[side][0];
    const radius = 24 / Math.max(Math.min(scale, 1), 0.35); // pixels of the image as it came
    const [cx, cy] = [(matches.x[side][i] + 0.5) * scale, (matches.y[side][i] + 0.5) * scale];
    context.imageSmoothingEnabled = true;
    context.imageSmoothingQuality = "high";
    const r = radius * scale;
    context.drawImage(pictures[side], cx - r, cy - r, 2 * r, 2 * r, 0, 0, size, size);
    const half = size / 2;
    for (const [style, width] of [["rgba(0,0,0,0.75)", 7], [PALETTE.pin, 3]]) {
      context.beginPath();
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        context.moveTo(half + 7 * dx, half + 7 * dy);
        context.lineTo(half + 17 * dx, half + 17 * dy);
      }
      [context.strokeStyle, context.lineWidth] = [style, width];
      context.stroke();
    }
  }

  const fingers = new Map();
  let dragged = false;
  const local = (event) => {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { at: local(event), from: local(event), side: sideAt(...local(event)) });
    dragged = fingers.size > 1;
  });
  canvas.addEventListener("pointermove", (event) => {
    const at = local(event);
    const finger = fingers.get(event.pointerId);
    if (!finger) {
      const hover = nearest(...at);
      if (hover !== state.hover) {
        state.hover = hover;
        canvas.style.cursor = hover >= 0 ? "pointer" : "crosshair";
        surface.invalidate();
        onHover();
      }
      return;
    }
    const others = [...fingers.entries()].filter(([id]) => id !== event.pointerId);
    if (others.length) {
      const anchor = others[0][1].at;
      const span = (p) => Math.hypot(p[0] - anchor[0], p[1] - anchor[1]);
      if (finger.side >= 0 && span(finger.at) > 0) zoom(finger.side, span(at) / span(finger.at), ...anchor);
    } else if (dragged || Math.hypot(at[0] - finger.from[0], at[1] - finger.from[1]) > 4) {
      dragged = true;
      pan(at[0] - finger.at[0], at[1] - finger.at[1], event.shiftKey ? -1 : finger.side);
    }
    finger.at = at;
  });
  canvas.addEventListener("pointerup", (event) => {
    const finger = fingers.get(event.pointerId);
    fingers.delete(event.pointerId);
    if (finger && !dragged && finger.side >= 0) click(finger.side, ...local(event));
  });
  canvas.addEventListener("pointercancel", (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("pointerleave", () => {
    if (state.hover < 0) return;
    state.hover = -1;
    surface.invalidate();
    onHover();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const [x, y] = local(event);
    const side = sideAt(x, y);
    if (side >= 0) zoom(side, Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0016)), x, y);
  }, { passive: false });
  canvas.addEventListener("dblclick", () => state.pin >= 0 && goTo(state.pin));

  function click(side, sx, sy) {
    const i = nearest(sx, sy);
    if (i >= 0) return pinMatch(i, side);
    const [x, y] = toImage(side, sx, sy);
    const [w, h] = DATA.sizes[side];
    const onImage = x >= -0.5 && y >= -0.5 && x < w && y < h;
    state.pin = -1;
    state.spot = onImage && !(state.spot && state.spot.loose) ? { side, x, y, loose: true } : null;
    surface.invalidate();
    onPin();
  }

  function pinMatch(i, side = 0) {
    state.pin = i;
    state.spot = i < 0 ? null : { side, x: matches.x[side][i], y: matches.y[side][i], loose: false };
    surface.invalidate();
    onPin();
  }

  // The next shown match, in the order of the scores: a way through all of them without a mouse.
  function step(direction) {
    const order = Array.from({ length: matches.n }, (_, i) => i).filter(visible).sort((a, b) => matches.score[b] - matches.score[a]);
    if (!order.length) return;
    const at = order.indexOf(state.pin);
    pinMatch(order[at < 0 ? (direction > 0 ? 0 : order.length - 1) : (at + direction + order.length) % order.length]);
  }

  return { surface, fit, zoomBoth, pan, goTo, step, pinMatch, paintPatch, toScreen, pictures };
}
