// A canvas that shows an image of any size, and loads only the visible tiles.

import { capital, h, say } from "./dom.js";
import { isAborted, picture } from "./api.js";
import { figure } from "./format.js";
import { pixel } from "./values.js";
import { steer } from "./view.js";

/** Largest number of tiles in the cache, which drops the least recently used. */
const MAX_TILES = 500;
const HINT = `${matchMedia("(pointer: coarse)").matches ? "Touch" : "Point at"} a pixel to read its value.`;
const tiles = new Map();
let waiting = [];
let busy = 0;

/** Cached bitmap of a tile. If there is none, requests it and calls `ready` when it is loaded. */
function tile(url, generation, ready) {
  const key = `${generation} ${url}`;
  const found = tiles.get(key);
  if (found) {
    tiles.delete(key);
    tiles.set(key, found);
    if (!found.bitmap && ready) found.ready.add(ready);
    return found.bitmap;
  }
  if (!ready) return null;
  const entry = { bitmap: null, ready: new Set([ready]) };
  tiles.set(key, entry);
  waiting.push(() => fetchTile(url, key, entry));
  pump();
  return null;
}

/** Loads six tiles at a time, the latest request first, so that visible tiles precede those scrolled past. */
function pump() {
  while (busy < 6 && waiting.length > 0) {
    busy += 1;
    waiting.pop()().finally(() => {
      busy -= 1;
      pump();
    });
  }
  if (waiting.length > 200) waiting = waiting.slice(-200);
}

async function fetchTile(url, key, entry) {
  try {
    entry.bitmap = await picture(url);
  } catch (error) {
    // The next drawing requests the tile again if it is still visible.
    tiles.delete(key);
    if (!isAborted(error) && error.status !== 404) console.warn(error.message);
    return;
  }
  for (const [oldest, held] of tiles) {
    if (tiles.size <= MAX_TILES) break;
    tiles.delete(oldest);
    held.bitmap?.close();
  }
  entry.ready.forEach((call) => call());
}

function url({ base, black, white }, { level, row, column }) {
  return `${base}/tiles/${level}/${row}/${column}?black=${black}&white=${white}`;
}

export class Pane {
  /** Creates a pane with a title; `view` holds its position and zoom. */
  constructor(title, view, signal) {
    this.view = view;
    this.title = h("span", null, title);
    this.tools = h("span", { class: "row" });
    this.canvas = h("canvas", { tabindex: 0, role: "img", "aria-label": title });
    this.note = h("p", { class: "note", hidden: true });
    this.badge = h("p", { class: "onpicture", hidden: true });
    this.sight = h("div", { class: "sight" }, this.canvas, this.note, this.badge);
    // The frame takes the shape of the picture, so that nothing around it is black.
    const shape = () => this.sight.style.setProperty("--ratio", String(view.width / view.height));
    shape();
    this.readout = h("p", { class: "readout muted" }, HINT);
    this.element = h("figure", { class: "pane" }, h("figcaption", null, this.title, this.tools), this.sight, this.readout);
    /** Words for a value of the picture. */
    this.describe = (value) => value.map((one) => figure(one, 4)).join(", ");
    this.generation = 0;
    this.source = null;
    this.over = null;
    this.marks = [];
    this.redraw = this.redraw.bind(this);
    view.listen(() => {
      shape();
      this.moved = true;
      this.redraw();
    }, signal);
    const observer = new ResizeObserver(() => this.size());
    observer.observe(this.canvas);
    signal.addEventListener("abort", () => observer.disconnect(), { once: true });
    steer(this.canvas, view, this, signal);
  }

  /** Shows the source `{base, levels, tile, label}` with a contrast window. */
  show(source, black, white) {
    this.source = source && { ...source, black, white };
    if (source) this.canvas.setAttribute("aria-label", source.label);
    this.redraw();
  }

  /** Shows row, column and value of the pixel at a position of the pointer; null clears them. */
  async hover(at) {
    const { height, width } = this.view;
    const [row, column] = at ? [Math.floor(at.y), Math.floor(at.x)] : [-1, -1];
    if (!this.source || row < 0 || column < 0 || row >= height || column >= width) {
      this.pointed = null;
      say(this.readout, HINT);
      return;
    }
    const { label } = this.source;
    const bases = this.pictured(at).map(({ base }) => base);
    const key = `${bases} ${row} ${column}`;
    if (this.pointed === key) return;
    this.pointed = key;
    const place = `Row ${row}, column ${column}`;
    try {
      const values = await Promise.all(bases.map((base) => pixel({ base, height, width, version: this.generation }, row, column)));
      const words = values.map((value) => this.describe(value)).join(" and ");
      const difference = values.length > 1 ? `, difference ${this.describe(values[0].map((one, index) => one - values[1][index]))}` : "";
      if (this.pointed === key) say(this.readout, `${place}: ${words}${difference}`);
    } catch {
      if (this.pointed === key) say(this.readout, `${place} of ${label}`);
    }
  }

  /** The sources of the picture at a place: two of a difference, and one at each side of a wipe. */
  pictured({ x }) {
    if (!this.over) return [this.source];
    const { source, at } = this.over;
    if (at === undefined) return [this.source, source];
    const { zoom, left } = this.place();
    return [(x - left) * zoom < at * this.canvas.clientWidth ? this.source : source];
  }

  /** Overlays a second image as a wipe, right of a fraction of the width, or as a difference; null removes it. */
  lay(over) {
    this.over = over;
    this.moved = true;
    this.redraw();
  }

  /** Shows a badge on the image, such as "Preview"; an empty text hides it. */
  brand(text, kind = "") {
    this.badge.hidden = !text;
    this.badge.className = `onpicture ${kind}`;
    say(this.badge, text);
  }

  /** Shows a note in place of the image; an empty text hides it. */
  setNote(text) {
    this.note.hidden = !text;
    say(this.note, capital(text));
  }

  /** Discards the cached tiles, because the image has changed on the service. */
  renew() {
    this.generation += 1;
    this.redraw();
  }

  size() {
    const scale = devicePixelRatio || 1;
    const [width, height] = [Math.round(this.canvas.clientWidth * scale), Math.round(this.canvas.clientHeight * scale)];
    if (this.canvas.width === width && this.canvas.height === height) return;
    this.canvas.width = width;
    this.canvas.height = height;
    this.moved = true;
    this.redraw();
  }

  /** Zoom, and image coordinates of the left and upper border. */
  place() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const { view } = this;
    const zoom = view.zoom ?? Math.min(width / view.width, height / view.height);
    return { zoom: zoom || 1, left: view.x - width / zoom / 2, top: view.y - height / zoom / 2 };
  }

  redraw() {
    if (this.due) return;
    this.due = requestAnimationFrame(() => {
      this.due = 0;
      this.draw();
    });
  }

  draw() {
    const context = this.canvas.getContext("2d");
    const scale = this.canvas.width / (this.canvas.clientWidth || 1);
    if (this.moved || !this.source || this.over) context.clearRect(0, 0, this.canvas.width, this.canvas.height);
    this.moved = false;
    if (!this.source || this.canvas.width === 0) return;
    const { zoom, left, top } = this.place();
    const by = zoom * scale;
    context.imageSmoothingEnabled = by < 2;
    const target = (x, y, width, height) => {
      // Round to whole pixels, so that adjacent tiles have no gap.
      const [x0, y0] = [Math.round((x - left) * by), Math.round((y - top) * by)];
      return [x0, y0, Math.round((x + width - left) * by) - x0, Math.round((y + height - top) * by) - y0];
    };
    this.paint(context, this.source, target);
    if (this.over) this.layered(context, target);
    this.marks.forEach((mark) => mark(context, target, scale));
  }

  layered(context, target) {
    const { source, at, gain } = this.over;
    const { width, height } = this.canvas;
    context.save();
    if (at !== undefined) {
      context.beginPath();
      context.rect(at * width, 0, width, height);
      context.clip();
      context.clearRect(0, 0, width, height);
      this.paint(context, source, target);
      context.fillStyle = "rgb(255 176 0)";
      context.fillRect(Math.round(at * width) - 1, 0, 2, height);
    } else {
      context.globalCompositeOperation = "difference";
      this.paint(context, source, target);
      // Each addition of the canvas to itself doubles the brightness.
      context.globalCompositeOperation = "lighter";
      for (let bright = 1; bright < gain; bright *= 2) context.drawImage(this.canvas, 0, 0);
    }
    context.restore();
  }

  paint(context, source, target) {
    for (const at of this.inSight()) {
      const bitmap = tile(url(source, at), this.generation, this.redraw);
      const span = this.source.tile * 2 ** at.level;
      const [x, y] = [at.column * span, at.row * span];
      if (bitmap) {
        const unit = 2 ** at.level;
        const [width, height] = [Math.min(bitmap.width * unit, this.view.width - x), Math.min(bitmap.height * unit, this.view.height - y)];
        context.drawImage(bitmap, ...target(x, y, width, height));
      } else {
        this.coarser(context, source, at, target);
      }
    }
  }

  /** Draws a missing tile from a coarser level. */
  coarser(context, source, at, target) {
    const size = this.source.tile;
    for (let up = 1; at.level + up <= this.source.levels; up += 1) {
      const above = { level: at.level + up, row: at.row >> up, column: at.column >> up };
      const bitmap = tile(url(source, above), this.generation, null);
      if (!bitmap) continue;
      const part = size / 2 ** up;
      const [sx, sy] = [(at.column % 2 ** up) * part, (at.row % 2 ** up) * part];
      const [width, height] = [Math.min(part, bitmap.width - sx), Math.min(part, bitmap.height - sy)];
      if (width <= 0 || height <= 0) return;
      const unit = 2 ** above.level;
      const [x, y] = [at.column * size * 2 ** at.level, at.row * size * 2 ** at.level];
      context.drawImage(bitmap, sx, sy, width, height, ...target(x, y, width * unit, height * unit));
      return;
    }
  }

  /** Visible tiles at the current zoom. */
  inSight() {
    const { zoom, left, top } = this.place();
    const scale = this.canvas.width / (this.canvas.clientWidth || 1);
    const level = Math.max(0, Math.min(this.source.levels, Math.floor(-Math.log2(zoom * scale) + 0.01)));
    const span = this.source.tile * 2 ** level;
    const range = (from, length, end) => [Math.max(0, Math.floor(from / span)), Math.min(Math.ceil(end / span), Math.ceil((from + length) / span))];
    const [row0, row1] = range(top, this.canvas.clientHeight / zoom, this.view.height);
    const [column0, column1] = range(left, this.canvas.clientWidth / zoom, this.view.width);
    const found = [];
    for (let row = row0; row < row1; row += 1) {
      for (let column = column0; column < column1; column += 1) found.push({ level, row, column });
    }
    return found;
  }

  /** Requests the visible tiles of an image before it is shown; true if all are loaded. */
  prepare(source, black, white) {
    if (!this.source) return true;
    const wanted = { ...source, black, white };
    return this.inSight().filter((at) => !tile(url(wanted, at), this.generation, () => {})).length === 0;
  }
}
