// What the tests of a folder's page do to it, by name; each returns what it saw.

function tidy() {
  set("filter", "");
  report.goToPair(...report.links[0]);
}

const CHECKS = {
  async table() {
    const kept = () => words("#pairs tbody td:nth-child(5)").map(Number);
    const out = { first: kept() };
    byId("sort-kept").click();
    out.up = kept();
    byId("sort-total").click();
    out.byTotal = kept();
    out.marked = words("#pairs th[aria-sort=descending]");
    byId("sort-a").click();
    out.byName = words("#pairs tbody th");
    set("filter", "PLANAR");
    out.planar = kept();
    set("filter", "b.jpg");
    return { ...out, filtered: kept().length, words: text("pairs-words") };
  },

  async matrix() {
    const canvas = byId("matrix");
    const box = canvas.getBoundingClientRect();
    const { view, pairs } = report;
    report.matrix.resize(); // draws now: a browser without a screen may show no frame
    const cell = Math.min(box.width, box.height) / view.order.length;
    const cellOf = (a, b) => [(view.order.indexOf(b) + 0.5) * cell, (view.order.indexOf(a) + 0.5) * cell];
    const hover = (a, b) => (point(canvas, "pointermove", cellOf(a, b)), text("cell-words"));
    const out = { start: text("cell-words"), colours: countColours(canvas), links: words("#links .pair-name") };
    out.bridges = words("#links .pill").length;
    out.cells = pairs.map(({ a, b }) => [hover(a, b), hover(b, a)]);
    out.self = hover(pairs[0].a, pairs[0].a);
    hover(pairs[0].a, pairs[0].b);
    out.pictures = document.querySelectorAll("#cell-card img").length;
    point(canvas, "pointerleave", [0, 0]);
    view.pinned = [0, 0];
    press("ArrowRight", canvas);
    out.moved = view.pinned;
    press("Enter", canvas);
    out.filter = byId("filter").value;
    document.querySelectorAll("#links button")[0].click();
    return { ...out, said: text("status") };
  },
};
