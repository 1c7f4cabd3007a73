// Convergence plot: residual, change and sigma by iteration, on a logarithmic scale.

import { figure, powerOfTen } from "./format.js";
import { h, put, s } from "./dom.js";

const [HEIGHT, LEFT, RIGHT, TOP, BOTTOM] = [220, 46, 12, 10, 26];
/** Widths of the plot in pixels; its text keeps its size on a phone. */
const [LEAST_WIDTH, MOST_WIDTH] = [280, 560];
const LINES = [["residual", 1, "residual ‖y − Hw‖ / ‖y‖ before the projection"], ["change", 2, "change ‖v − v₋‖ / ‖v‖"], ["sigma", 3, "sigma of the denoiser"]];

/** Why the residual of a tile in the plot differs from that of its frames. */
const INSIDE = "This residual is that of w, the extrapolated frames from which an iteration starts. It is usually larger than that of the result x under “How it was made”, which is not extrapolated.";

/** Draws `points` ([iteration, residual, change, sigma], ...) into an element. */
export function convergence(element, points) {
  if (points.length === 0) {
    put(element, h("p", { class: "muted" }, "No iterations."));
    return;
  }
  const width = Math.min(MOST_WIDTH, Math.max(LEAST_WIDTH, element.clientWidth));
  const values = points.flatMap((point) => point.slice(1)).filter((value) => value > 0);
  const from = Math.floor(Math.log10(Math.max(1e-8, Math.min(...values, 1))));
  const to = Math.max(from + 1, Math.ceil(Math.log10(Math.max(...values, 1e-8))));
  const first = points[0][0];
  const span = Math.max(1, points.at(-1)[0] - first);
  const x = (iteration) => LEFT + ((width - LEFT - RIGHT) * (iteration - first)) / span;
  const y = (value) => TOP + ((HEIGHT - TOP - BOTTOM) * (to - Math.log10(Math.max(value, 10 ** from)))) / (to - from);
  const last = points.at(-1);
  const summary = `In iteration ${last[0]} the residual before the projection is ${figure(last[1])}, the change ${figure(last[2])}${last[3] === null ? "" : `, sigma ${figure(last[3])}`}.`;
  put(element,
    s("svg", { viewBox: `0 0 ${width} ${HEIGHT}`, class: "plot", role: "img", "aria-label": summary },
      grid(from, to, y, width), ticks(first, span, x),
      LINES.map(([name, index]) => line(name, points.filter((point) => point[index] !== null), (point) => [x(point[0]), y(point[index])]))),
    h("p", { class: "legend" }, LINES.filter(([, index]) => points.some((point) => point[index] !== null)).map(([name, , title]) => h("span", null, h("span", { class: `key ${name}` }), title))),
    h("p", { class: "muted" }, `${summary} ${INSIDE}`));
}

function grid(from, to, y, width) {
  const lines = [];
  const step = Math.ceil((to - from) / 6);
  for (let power = from; power <= to; power += step) {
    const at = y(10 ** power);
    lines.push(s("line", { x1: LEFT, x2: width - RIGHT, y1: at, y2: at, class: "grid" }));
    lines.push(s("text", { x: LEFT - 6, y: at + 4, "text-anchor": "end" }, powerOfTen(power)));
  }
  return lines;
}

function ticks(first, span, x) {
  const step = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000].find((size) => span / size <= 8) ?? 10000;
  const marks = [];
  for (let at = Math.ceil(first / step) * step; at <= first + span; at += step) {
    marks.push(s("text", { x: x(at), y: HEIGHT - 8, "text-anchor": "middle" }, at));
  }
  return marks;
}

function line(name, points, place) {
  const path = points.map((point, index) => `${index ? "L" : "M"}${place(point).map((value) => value.toFixed(1)).join(" ")}`).join("");
  return path && s("path", { d: path, class: `line ${name}` });
}
