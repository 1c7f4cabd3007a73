// The measurement beside the frames that came of it, in step.

import { h, say } from "./dom.js";
import { Contrast } from "./contrast.js";
import { Pane } from "./pane.js";
import { Player } from "./player.js";
import { Slice } from "./slice.js";
import { View } from "./view.js";
import { get } from "./api.js";

const MODES = [["frame", "Frames"], ["difference", "Difference to the frame before"], ["residual", "Residual |y − Hx|"]];

export class Viewer {
  constructor(job, signal) {
    const { frames, height, width } = job.shape;
    Object.assign(this, { job, signal, snapshot: job.snapshots.first, spreads: new Map() });
    this.view = new View(height, width);
    this.left = new Pane("Measurement", this.view, signal);
    this.right = new Pane("Frames", this.view, signal);
    this.leftContrast = new Contrast("measurement", () => this.showLeft());
    this.rightContrast = new Contrast("frames", () => this.showRight());
    this.player = new Player(frames, signal, () => this.showRight());
    this.player.ahead = (frame) => this.mode() === "residual" || this.right.prepare(this.source(frame), ...this.rightContrast.window());
    // Of a sequence playing goes on from snapshot to snapshot, if asked to.
    this.through = h("input", { type: "checkbox", id: "through" });
    this.player.onward = () => this.through.checked && this.goOn();
    if (job.snapshots.count > 1) this.player.element.append(h("label", { for: "through", class: "row muted" }, this.through, "through all snapshots"));
    this.choice = h("select", { id: "mode", "aria-label": "What is shown" }, MODES.map(([value, text]) => h("option", { value }, text)));
    this.choice.addEventListener("change", () => {
      this.rightContrast.touched = false;
      this.offerRight();
    });
    this.slice = new Slice(this.view, frames, height, () => this.sliceBase(), () => this.frameWindow, signal);
    this.right.marks.push((context, target, scale) => this.slice.mark(context, target, scale));
    this.right.tools.append(this.choice);
    this.zoom = h("span", { class: "muted" });
    const zoomTools = h("div", { class: "row" },
      h("button", { type: "button", class: "small", onclick: () => this.view.fit() }, "Fit"),
      h("button", { type: "button", class: "small", onclick: () => this.nearer(null) }, "1 : 1"),
      h("button", { type: "button", class: "small", "aria-label": "Zoom in", onclick: () => this.nearer(1.5) }, "+"),
      h("button", { type: "button", class: "small", "aria-label": "Zoom out", onclick: () => this.nearer(1 / 1.5) }, "−"), this.zoom);
    this.left.element.append(this.leftContrast.element);
    this.right.element.append(this.rightContrast.element);
    this.element = h("section", { class: "card viewer", "aria-label": "Frames" },
      h("div", { class: "panes" }, this.left.element, this.right.element),
      h("div", { class: "row controls" }, this.player.element, zoomTools),
      this.slice.element,
      h("p", { class: "muted keys" }, "Keys on a picture: space plays, ← → step, + − 0 1 zoom, shift and arrows move. The wheel zooms, dragging moves."));
    this.player.keys(this.element);
    const tellZoom = () => say(this.zoom, `${Math.round(100 * this.right.place().zoom)} %`);
    this.view.listen(tellZoom, signal);
    this.slice.changed = () => {
      this.right.moved = true;
      this.right.redraw();
    };
  }

  mode() {
    return this.choice.value;
  }

  nearer(factor) {
    const { zoom } = this.right.place();
    this.view.zoomBy(factor ?? 1 / zoom, zoom);
  }

  /** Where the pictures of the snapshot are. */
  base() {
    return `/v1/jobs/${this.job.id}/snapshots/${this.snapshot}/pictures`;
  }

  sliceBase() {
    return this.ready ? `${this.base()}/slice-${this.slice.row()}` : null;
  }

  name(frame) {
    if (this.mode() === "frame") return `frame-${frame}`;
    // The first frame has none before it.
    return this.mode() === "difference" ? `difference-${Math.max(2, frame)}` : "residual";
  }

  source(frame) {
    const name = this.name(frame);
    const label = { frame: `Frame ${frame} of ${this.player.count}`, difference: `Frame ${Math.max(2, frame)} without the one before`, residual: "Residual map" }[this.mode()];
    return { base: `${this.base()}/${name}`, levels: this.levels, tile: this.tile, label };
  }

  /** Has the next snapshot opened, by whoever chooses them; true, as the player then waits for it. */
  goOn() {
    if (!this.waiting) {
      this.waiting = true;
      this.next();
    }
    return true;
  }

  async open(snapshot) {
    this.snapshot = snapshot;
    if (this.waiting) this.player.frame = 1;
    this.waiting = false;
    this.player.tell();
    const base = `/v1/measurements/${this.job.measurement}/pictures/snapshot-${snapshot}`;
    const spread = await get(`${base}/spread`, this.signal);
    Object.assign(this, { levels: spread.levels, tile: spread.tile });
    this.measured = { base, levels: spread.levels, tile: spread.tile, label: `Measurement, snapshot ${snapshot}` };
    this.leftContrast.offer(spread);
    this.showLeft();
    await this.renew();
  }

  /** Looks for frames, or for more of them: tiles appear as they are done. */
  async renew() {
    this.spreads.clear();
    this.right.generation += 1;
    this.slice.renew();
    await this.offerRight();
  }

  async offerRight() {
    if (this.player.count < 2 && this.mode() === "difference") {
      this.right.tell("There is one frame only.");
      return;
    }
    try {
      this.rightContrast.offer(await this.spread());
    } catch (error) {
      if (error.code !== "not_ready") throw error;
      this.ready = false;
      this.right.show(null);
      this.right.tell("Nothing of this snapshot is done yet. A coarse preview comes first, then the frames tile by tile.");
      this.rightContrast.element.hidden = true;
      return;
    }
    this.ready = true;
    this.rightContrast.element.hidden = false;
    this.right.tell("");
    this.showRight();
  }

  /** The spread of what is shown, of the middle frame for all of them: one window for a whole film. */
  async spread() {
    const name = this.name(Math.ceil(this.player.count / 2));
    if (!this.spreads.has(name)) this.spreads.set(name, await get(`${this.base()}/${name}/spread`, this.signal));
    return this.spreads.get(name);
  }

  showLeft() {
    this.left.show(this.measured, ...this.leftContrast.window());
  }

  showRight() {
    if (!this.ready) return;
    // The slice is made of frames, whatever the pane shows.
    if (this.mode() === "frame") this.frameWindow = this.rightContrast.window();
    this.right.show(this.source(this.player.frame), ...this.rightContrast.window());
    this.slice.show(this.player.frame);
  }
}
