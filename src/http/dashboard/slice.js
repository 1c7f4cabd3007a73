// The x–t slice: one row of the image through all frames, with time downwards, synchronised with the zoom.

import { isAborted, picture } from "./api.js";
import { h } from "./dom.js";

const TILE = 256;

export class Slice {
  /** `base()` is the URL of the slice's image, or null; `window()` is its contrast window. */
  constructor(view, frames, height, base, window, signal) {
    Object.assign(this, { view, frames, base, window, signal, cells: new Map(), frame: 1, changed: () => {} });
    this.input = h("input", { type: "range", id: "slice", min: 0, max: height - 1, value: Math.floor(height / 2), "aria-label": "Row of the x–t slice" });
    this.number = h("output", { for: "slice", class: "count" });
    this.input.addEventListener("input", () => {
      this.renew();
      this.redraw();
      this.changed();
    });
    this.canvas = h("canvas", { role: "img", class: "slice", "aria-label": "x–t slice: columns to the right, time downwards" });
    this.element = h("div", { class: "slicebox" }, h("div", { class: "row" }, h("label", { for: "slice" }, "x–t slice at row"), this.input, this.number), this.canvas);
    view.listen(() => this.redraw(), signal);
    const observer = new ResizeObserver(() => this.redraw());
    observer.observe(this.canvas);
    signal.addEventListener("abort", () => observer.disconnect(), { once: true });
  }

  row() {
    return Number(this.input.value);
  }

  /** Discards the loaded tiles after a change of the row or the frames. */
  renew() {
    this.cells = new Map();
    this.asked = "";
    this.number.textContent = this.input.value;
  }

  show(frame) {
    this.frame = frame;
    this.redraw();
  }

  /** Draws the row as a line on the image. */
  mark(context, target, scale) {
    if (!this.base()) return;
    const [x, y, width] = target(0, this.row() + 0.5, this.view.width, 0);
    context.save();
    context.strokeStyle = "rgb(255 176 0 / .8)";
    context.lineWidth = scale;
    context.setLineDash([6 * scale, 6 * scale]);
    context.beginPath();
    context.moveTo(x, y);
    context.lineTo(x + width, y);
    context.stroke();
    context.restore();
  }

  redraw() {
    if (this.due) return;
    this.due = requestAnimationFrame(() => {
      this.due = 0;
      this.draw();
    });
  }

  /** Loads missing tiles of 256 columns at full resolution. */
  fetch(base, black, white, first, last) {
    const key = `${base} ${black} ${white}`;
    if (this.asked !== key) {
      this.cells = new Map();
      this.asked = key;
    }
    const { cells } = this;
    for (let column = first; column < last; column += 1) {
      for (let row = 0; row < Math.ceil(this.frames / TILE); row += 1) {
        const at = `${row}/${column}`;
        if (cells.has(at)) continue;
        cells.set(at, null);
        picture(`${base}/tiles/0/${at}?black=${black}&white=${white}`, this.signal)
          .then((bitmap) => {
            cells.set(at, bitmap);
            this.redraw();
          })
          .catch((error) => !isAborted(error) && cells.delete(at));
      }
    }
  }

  draw() {
    const scale = devicePixelRatio || 1;
    const { canvas, view } = this;
    const [width, height] = [Math.round(canvas.clientWidth * scale), Math.round(canvas.clientHeight * scale)];
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const context = canvas.getContext("2d");
    context.clearRect(0, 0, width, height);
    const base = this.base();
    if (!base || !width) return;
    const zoom = view.zoom ?? canvas.clientWidth / view.width;
    const left = view.zoom === null ? 0 : view.x - canvas.clientWidth / zoom / 2;
    const [first, last] = [Math.max(0, Math.floor(left / TILE)), Math.ceil(Math.min(view.width, left + canvas.clientWidth / zoom) / TILE)];
    const window = this.window();
    if (!window) return;
    this.fetch(base, ...window, first, last);
    context.imageSmoothingEnabled = false;
    const tall = height / this.frames;
    for (const [at, bitmap] of this.cells) {
      if (!bitmap) continue;
      const [row, column] = at.split("/").map(Number);
      context.drawImage(bitmap, (column * TILE - left) * zoom * scale, row * TILE * tall, bitmap.width * zoom * scale, bitmap.height * tall);
    }
    context.strokeStyle = "rgb(255 176 0 / .9)";
    context.lineWidth = 2 * scale;
    context.strokeRect(scale, (this.frame - 1) * tall, width - 2 * scale, tall);
  }
}
