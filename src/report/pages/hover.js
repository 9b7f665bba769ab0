"use strict";
/* Values of charts under the pointer, or at the place that the arrow keys choose. What a drawing shows where stands in its
   attributes: data-x and data-y are "low high from-pixel to-pixel is-logarithmic". */
const tip = document.createElement("div");
tip.id = "tip";
tip.setAttribute("role", "status");
tip.hidden = true;
document.body.append(tip);
const axis = text => {
  const [low, high, from, to, log] = text.split(" ").map(Number);
  return px => {
    const share = (px - from) / (to - from);
    return log ? low * Math.pow(high / low, share) : low + share * (high - low);
  };
};
const short = value => {
  const size = Math.abs(value);
  if (size === 0) return "0";
  if (size >= 1e5 || size < 1e-4) return value.toExponential(2);
  return String(Number(value.toPrecision(size >= 1000 ? 4 : 3)));
};
const points = path => [...path.getAttribute("d").matchAll(/[ML](-?[\d.]+) (-?[\d.]+)/g)].map(m => [Number(m[1]), Number(m[2])]);
for (const svg of document.querySelectorAll("svg[data-x]")) {
  const [x, y] = [axis(svg.dataset.x), axis(svg.dataset.y)];
  const [, , left, right] = svg.dataset.x.split(" ").map(Number), [, , bottom, top] = svg.dataset.y.split(" ").map(Number);
  let marks = null, chosen = null;
  const guide = document.createElementNS("http://www.w3.org/2000/svg", "g");
  guide.setAttribute("class", "guide");
  svg.append(guide);
  svg.setAttribute("tabindex", "0");
  const read = () => {
    if (marks) return;
    marks = [...svg.querySelectorAll(".curve, .dots, .bar")].map(mark => {
      const colour = mark.getAttribute("stroke") || mark.getAttribute("fill"), name = mark.dataset.name;
      if (!mark.matches(".bar")) return { name, colour, dots: mark.matches(".dots"), at: points(mark), values: null };
      const box = mark.getBBox();
      return { name, colour, at: [[box.x + box.width / 2, box.y]], values: mark.dataset.at.split(" ").map(Number) };
    });
  };
  const show = (px, py) => {
    read();
    const near = [];
    for (const mark of marks) {
      let best = null, distance = mark.dots ? 14 : mark.values ? 8 : 24;
      for (const at of mark.at) {
        const apart = mark.dots ? Math.hypot(at[0] - px, at[1] - py) : Math.abs(at[0] - px);
        if (apart < distance) [best, distance] = [at, apart];
      }
      if (best) near.push({ mark, at: best });
    }
    if (!near.length) return hide();
    const place = near[0].at[0], lines = [svg.dataset.xLabel + ": " + short(near[0].mark.values ? near[0].mark.values[0] : x(place))];
    for (const { mark, at } of near) lines.push((mark.name || svg.dataset.yLabel) + ": " + short(mark.values ? mark.values[1] : y(at[1])));
    tip.textContent = lines.join("\n");
    guide.replaceChildren();
    const add = (name, attributes) => {
      const element = document.createElementNS("http://www.w3.org/2000/svg", name);
      for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
      guide.append(element);
    };
    add("line", { x1: place, x2: place, y1: top, y2: bottom, stroke: "#5a5a5a", "stroke-dasharray": "3 3" });
    for (const { mark, at } of near) add("circle", { cx: at[0], cy: at[1], r: 4, fill: mark.colour, stroke: "#ffffff" });
    tip.hidden = false;
    const box = svg.getBoundingClientRect(), scale = box.width / svg.viewBox.baseVal.width;
    const at = box.left + place * scale, wide = tip.offsetWidth;
    tip.style.left = Math.max(4, Math.min(innerWidth - wide - 4, at + 12 + wide > innerWidth ? at - wide - 12 : at + 12)) + "px";
    tip.style.top = Math.max(4, box.top + top * scale) + "px";
    chosen = place;
  };
  const hide = () => { tip.hidden = true; guide.replaceChildren(); };
  const follow = event => {
    const box = svg.getBoundingClientRect(), scale = svg.viewBox.baseVal.width / box.width;
    show((event.clientX - box.left) * scale, (event.clientY - box.top) * scale);
  };
  svg.addEventListener("pointermove", follow);
  svg.addEventListener("pointerdown", follow);
  svg.addEventListener("pointerleave", hide);
  svg.addEventListener("blur", hide);
  svg.addEventListener("keydown", event => {
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (event.key === "Escape") hide();
    if (!by) return;
    event.preventDefault();
    read();
    const places = [...new Set(marks.flatMap(mark => mark.at.map(at => at[0])))].sort((a, b) => a - b);
    const from = chosen === null ? (by > 0 ? left - 1 : right + 1) : chosen;
    const next = by > 0 ? places.find(place => place > from + 1e-6) : places.findLast(place => from - 1e-6 > place);
    if (next !== undefined) show(next, (top + bottom) / 2);
  });
}
