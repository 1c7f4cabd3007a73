// Line plot with linear axes, and its values as a CSV file.

import { figure } from "./format.js";
import { h, s } from "./dom.js";

const [HEIGHT, LEFT, RIGHT, TOP, BOTTOM] = [170, 46, 14, 8, 34];

/** Round numbers between two values, at most `most`. */
function ticks(from, to, most) {
  const raw = (to - from) / most || 1;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((size) => size >= raw);
  const marks = [];
  for (let at = Math.ceil(from / step) * step; at <= to + step * 1e-6; at += step) marks.push(Number(at.toPrecision(12)));
  return marks;
}

/**
 * Draws `values` over `xs`, by default over `first`, `first` + 1, ..., in `width` units; `xName` and `yName` are the names of
 * the axes.
 */
export function plot(values, { xName, yName, first = 0, xs = values.map((_, index) => first + index), width = 560 }) {
  const points = values.map((value, index) => [xs[index], value]).sort(([one], [other]) => one - other);
  const [least, most] = [points[0][0], points.at(-1)[0]];
  const finite = values.filter(Number.isFinite);
  const low = Math.min(...finite);
  const high = Math.max(...finite);
  const [from, to] = high > low ? [low, high] : [low - 0.5, high + 0.5];
  const x = (place) => LEFT + ((width - LEFT - RIGHT) * (place - least)) / (most - least || 1);
  const y = (value) => TOP + ((HEIGHT - TOP - BOTTOM) * (to - value)) / (to - from);
  const whole = ticks(least, most, 8).filter(Number.isInteger);
  const path = points.map(([place, value], index) => `${index ? "L" : "M"}${x(place).toFixed(1)} ${y(value).toFixed(1)}`).join("");
  return s("svg", { viewBox: `0 0 ${width} ${HEIGHT}`, class: "plot", role: "img", "aria-label": `${yName} over ${xName}: ${figure(low)} to ${figure(high)}` },
    ticks(from, to, 6).map((mark) => [s("line", { x1: LEFT, x2: width - RIGHT, y1: y(mark), y2: y(mark), class: "grid" }), s("text", { x: LEFT - 6, y: y(mark) + 4, "text-anchor": "end" }, figure(mark))]),
    whole.map((mark) => s("text", { x: x(mark), y: HEIGHT - BOTTOM + 15, "text-anchor": "middle" }, mark)),
    s("text", { x: (LEFT + width - RIGHT) / 2, y: HEIGHT - 4, "text-anchor": "middle" }, xName),
    s("path", { d: path, class: "line residual" }),
    points.length <= 40 && points.map(([place, value]) => s("circle", { cx: x(place), cy: y(value), r: 3, class: "dot" }, s("title", null, `${figure(place, 4)}: ${figure(value, 4)}`))));
}

/** A link that saves rows of numbers, with these heads, as CSV. */
export function csvLink(name, heads, rows) {
  const text = [heads, ...rows].map((row) => row.join(",")).join("\r\n");
  const link = h("a", { class: "button small", download: name }, "Save as CSV");
  link.setAttribute("href", `data:text/csv;charset=utf-8,${encodeURIComponent(`${text}\r\n`)}`);
  return link;
}
