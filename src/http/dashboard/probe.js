// Curves of a job's frames: a pixel through time, a profile along a line, and the mean of a region through time. The bands
// of a spectral camera give spectra instead.

import { alongLine, regionMeans, throughTime } from "./values.js";
import { csvLink, plot } from "./plot.js";
import { explained, h, put, say } from "./dom.js";
import { isAborted } from "./api.js";

const KINDS = [["point", "A pixel through time", "Spectrum of a pixel"], ["line", "Profile along a line", "Profile along a line"], ["region", "Mean of a region through time", "Mean spectrum of a region"]];
const HINTS = {
  point: "Click a pixel of the frames, or enter its row and column.",
  line: "Drag a line on the frames, or enter its ends.",
  region: "Drag a rectangle on the frames, or enter its corners.",
};
/** Largest number of pixels in all frames of a region: reading more would take too long. */
const MAX_PIXELS = 4_000_000;
const MARK = "rgb(255 176 0)";

/**
 * `axis` has the name of the frames' axis and their places `xs` on it. `picture()` has the current picture, `stack()` the base
 * of all frames, `called()` the name of the current frame, and `unit()` the words for a value.
 */
export class Probe {
  constructor(pane, { spectral, name: axis, xs }, { picture, stack, called, unit }, name, signal) {
    const { height, width } = pane.view;
    Object.assign(this, { pane, axis, xs, picture, stack, called, unit, name, signal, ends: null, kind: "point" });
    const select = h("select", { id: "curve", "aria-label": "Curve" }, KINDS.map(([value, text, spectrum]) => h("option", { value }, spectral ? spectrum : text)));
    select.addEventListener("change", () => this.choose(select.value));
    const field = (id, label, most) => {
      const input = h("input", { type: "number", id, min: 0, max: most - 1, step: 1 });
      input.addEventListener("change", () => this.enter());
      return { input, element: h("label", { for: id, class: "row muted" }, label, input) };
    };
    this.select = select;
    this.fields = [field("curve-row", "Row", height), field("curve-column", "column", width), field("curve-row-2", "to row", height), field("curve-column-2", "column", width)];
    this.hint = h("p", { class: "muted" });
    this.result = h("div", { "aria-live": "polite" });
    this.element = h("details", { class: "probe" }, h("summary", null, spectral ? "Spectra and profiles" : "Curves and profiles"),
      h("div", { class: "row" }, select, [this.fields.slice(0, 2), this.fields.slice(2)].map((pair) => h("span", { class: "row" }, pair.map((one) => one.element)))), this.hint, this.result);
    this.element.addEventListener("toggle", () => this.redraw());
    pane.tool = this;
    pane.marks.push((context, target, scale) => this.mark(context, target, scale));
    this.choose("point");
  }

  choose(kind) {
    Object.assign(this, { kind, ends: null });
    this.select.value = kind;
    for (const { element, input } of this.fields) input.value = "";
    for (const { element } of this.fields.slice(2)) element.hidden = kind === "point";
    say(this.hint, HINTS[kind]);
    put(this.result);
    this.redraw();
  }

  redraw() {
    this.pane.moved = true;
    this.pane.redraw();
  }

  /** True if a drag on the picture draws instead of moving it. */
  draws() {
    return this.element.open && this.kind !== "point";
  }

  inside({ x, y }) {
    const clamp = (value, most) => Math.min(most - 1, Math.max(0, Math.floor(value)));
    return [clamp(y, this.pane.view.height), clamp(x, this.pane.view.width)];
  }

  click(at) {
    if (this.draws()) return;
    if (at.x < 0 || at.y < 0 || at.x >= this.pane.view.width || at.y >= this.pane.view.height) return;
    this.element.open = true;
    this.set(this.inside(at), this.inside(at)).then(() => this.result.scrollIntoView({ block: "nearest" }));
  }

  draw(from, to, done) {
    this.ends = [this.inside(from), this.inside(to)];
    this.redraw();
    if (done) this.set(...this.ends);
  }

  set(from, to) {
    this.ends = [from, to];
    [...from, ...to].forEach((value, index) => (this.fields[index].input.value = value));
    this.redraw();
    return this.renew();
  }

  /** Takes the ends that the user has typed. */
  enter() {
    const numbers = this.fields.slice(0, this.kind === "point" ? 2 : 4).map(({ input }) => input.value);
    if (numbers.includes("")) return;
    const [row, column, row2 = row, column2 = column] = numbers.map(Number);
    this.set(this.inside({ x: column, y: row }), this.inside({ x: column2, y: row2 }));
  }

  /** Draws the point, line or rectangle on the picture. */
  mark(context, target, scale) {
    if (!this.ends || !this.element.open) return;
    const [[row0, column0], [row1, column1]] = this.ends;
    context.save();
    context.strokeStyle = MARK;
    context.lineWidth = 2 * scale;
    context.beginPath();
    if (this.kind === "line") {
      context.moveTo(...target(column0 + 0.5, row0 + 0.5, 0, 0));
      context.lineTo(...target(column1 + 0.5, row1 + 0.5, 0, 0));
    } else if (this.kind === "region") {
      const [top, left, bottom, right] = this.corners();
      context.rect(...target(left, top, right - left + 1, bottom - top + 1));
    } else {
      const [x, y] = target(column0 + 0.5, row0 + 0.5, 0, 0);
      context.arc(x, y, 6 * scale, 0, 2 * Math.PI);
    }
    context.stroke();
    context.restore();
  }

  corners() {
    const [[row0, column0], [row1, column1]] = this.ends;
    return [Math.min(row0, row1), Math.min(column0, column1), Math.max(row0, row1), Math.max(column0, column1)];
  }

  /** Computes the curve again; a profile follows the frame that is shown. */
  async renew() {
    if (!this.ends || !this.element.open || !this.picture()) return;
    const asked = (this.asked = {});
    const { factor, words } = this.unit();
    try {
      const { values, xName, xs, place } = await this.read();
      if (asked !== this.asked || this.signal.aborted) return;
      const inUnit = `value in ${words.replace("× ", "")}`;
      const shown = values.map((value) => value * factor);
      const file = `${this.name()}_${place.replaceAll(/[^0-9a-z]+/gi, "_")}.csv`;
      put(this.result, plot(shown, { xName, yName: inUnit, xs, width: Math.min(560, this.result.clientWidth || 560) }), h("div", { class: "row" }, h("span", { class: "muted" }, `${place}: ${inUnit}`), csvLink(file, [xName, "value"], shown.map((value, index) => [xs[index], value]))));
    } catch (error) {
      if (asked === this.asked && !isAborted(error)) put(this.result, h("p", { class: "warn" }, explained(error)));
    }
  }

  async read() {
    const [from, to] = this.ends;
    const frames = this.xs.length;
    const along = { xName: this.axis, xs: this.xs };
    if (this.kind === "point") {
      return { ...along, values: await throughTime(this.stack(), frames, ...from), place: `Row ${from[0]}, column ${from[1]}` };
    }
    if (this.kind === "line") {
      const values = await alongLine(this.picture(), from, to);
      return { values, xName: "pixel along the line", xs: values.map((_, index) => index), place: `${this.called()}, row ${from[0]}, column ${from[1]} to row ${to[0]}, column ${to[1]}` };
    }
    const [top, left, bottom, right] = this.corners();
    if ((bottom - top + 1) * (right - left + 1) * frames > MAX_PIXELS) throw new Error("This region is too large to read. Drag a smaller one, or use the Python client.");
    return { ...along, values: await regionMeans(this.stack(), frames, this.corners()), place: `Rows ${top} to ${bottom}, columns ${left} to ${right}` };
  }
}
