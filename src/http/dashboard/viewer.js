// The frames in a large player, synchronised with the measurement.

import { capital, h, say } from "./dom.js";
import { Contrast } from "./contrast.js";
import { Pane } from "./pane.js";
import { Player, keysHelp } from "./player.js";
import { Slice } from "./slice.js";
import { View } from "./view.js";
import { axisOf, frameName, unitOf, valueIn } from "./format.js";
import { get, isUnreachable } from "./api.js";
import { Probe } from "./probe.js";
import { sampled } from "./values.js";

/** Pictures of the right pane: value, name, name for bands, and the meaning of dark and bright. */
const MODES = [
  ["frame", "Frames", "Bands", ""],
  ["colours", "False colours", "All bands in false colours", "The shortest wavelength is blue, the middle green, the longest red. Equal bands are grey."],
  ["difference", "Difference from the previous frame", "Difference from the previous band", "Middle grey: no change. Bright: more light than before."],
  ["error", "Expected error", "Expected error", "Bright: a larger error is expected."],
  ["deviation", "True error (frame − truth)", "True error (band − truth)", "Middle grey: equal to the true frame. Bright: too much light. Black: too little."],
  ["residual", "Residual |y − Hx|", "Residual |y − Hx|", "Bright: the frames do not explain the measurement here."],
];
/** Pictures with values on both sides of 0, which is shown in middle grey. */
const SIGNED = ["difference", "deviation"];
/** Pictures that are the same for all frames. */
const STILL = ["colours", "residual"];

export class Viewer {
  constructor(job, signal) {
    const { frames, height, width } = job.shape;
    Object.assign(this, { job, signal, snapshot: job.snapshots.first, spreads: new Map(), turn: 0 });
    this.view = new View(height, width);
    const spectral = job.dispersion !== null;
    this.right = new Pane(spectral ? "Bands" : "Frames", this.view, signal);
    // The measurement of a spectral camera is larger than a band.
    this.left = new Pane("Measurement", spectral ? new View(height, width) : this.view, signal);
    this.leftContrast = new Contrast("measurement", () => this.showLeft());
    this.rightContrast = new Contrast("frames", () => this.showRight());
    this.player = new Player(frames, signal, () => this.showRight(), job.dispersion ? (frame) => frameName(job, frame) : undefined);
    this.player.ahead = (frame) => STILL.includes(this.mode()) || this.right.prepare(this.source(frame), ...this.rightContrast.window());
    // With this box checked, playback of a sequence continues with the next snapshot.
    this.through = h("input", { type: "checkbox", id: "through" });
    this.player.onward = () => this.through.checked && this.goOn();
    if (job.snapshots.count > 1) this.player.element.lastChild.append(h("label", { for: "through", class: "row muted" }, this.through, "Play all snapshots"));
    this.choice = h("select", { id: "mode", "aria-label": "Image" }, MODES.map(([value, text, band]) => h("option", { value }, spectral ? band : text)));
    this.offerMode("colours", Boolean(job.dispersion?.wavelengths));
    this.offerMode("error", false);
    this.setTruth(job.truth);
    this.meaning = h("p", { class: "muted meaning", "aria-live": "polite" });
    this.choice.addEventListener("change", () => {
      this.rightContrast.touched = false;
      if (STILL.includes(this.mode())) this.player.stop();
      this.offerRight();
    });
    this.slice = new Slice(this.view, frames, height, () => this.sliceBase(), () => this.frameWindow, signal);
    this.right.marks.push((context, target, scale) => this.slicing.open && this.slice.mark(context, target, scale));
    this.right.tools.append(this.choice, h("span", { class: "row" }, this.zoomTools()));
    this.left.element.append(this.leftContrast.element);
    this.slicing = h("details", { class: "slicing" }, h("summary", null, spectral ? "x–λ slice" : "x–t slice"), this.slice.element);
    this.slicing.addEventListener("toggle", () => this.showRight());
    this.fullScale = 1;
    const stack = () => ({ base: this.base(), height, width, version: this.right.generation });
    const picture = () => this.ready && { ...stack(), height: this.view.height, width: this.view.width, base: this.source(this.player.frame).base };
    this.probe = new Probe(this.right, axisOf(job), { picture, stack, called: () => capital(frameName(job, this.player.frame)), unit: () => this.unit() }, () => `${job.id.slice(-8)}_${this.snapshot}`, signal);
    for (const pane of [this.left, this.right]) pane.describe = (value) => valueIn(value, this.unit());
    const keys = keysHelp(`The wheel zooms; dragging moves. A click shows ${spectral ? "the spectrum of a pixel" : "a pixel through time"}. On a touch screen, two fingers zoom and move; in full screen, one finger also moves.`);
    this.controls = [this.player.element, this.rightContrast.element, this.right.tools, this.probe.element, this.slicing, keys];
    this.element = h("section", { class: "card viewer", "aria-label": "Frames" }, this.right.element, this.player.element, this.rightContrast.element, this.meaning, this.probe.element, this.slicing, keys);
    this.measured = null;
    this.beside = h("section", { class: "card viewer beside", "aria-label": "Measurement" }, this.left.element);
    this.player.keys(this.element);
    this.slice.changed = () => {
      this.right.moved = true;
      this.right.redraw();
    };
  }

  zoomTools() {
    const small = (label, text, act) => h("button", { type: "button", class: "small", "aria-label": label, title: label, onclick: act }, text);
    const zoom = h("span", { class: "muted count", id: "zoom" }, "fit");
    this.view.listen(() => say(zoom, this.view.zoom === null ? "fit" : `${Math.round(100 * this.right.place().zoom)} %`), this.signal);
    const full = small("Full screen", "Full screen", () => (document.fullscreenElement ? document.exitFullscreen() : this.element.requestFullscreen()));
    full.id = "full";
    if (!document.fullscreenEnabled) full.hidden = true;
    return [small("Zoom out", "−", () => this.nearer(1 / 1.5)), zoom, small("Zoom in", "+", () => this.nearer(1.5)),
      small("Fit the whole picture", "Fit", () => this.view.fit()), small("1 : 1, one screen pixel per image pixel", "1 : 1", () => this.nearer(null)), full];
  }

  /** Factor and words of the unit of values. */
  unit() {
    return unitOf(this.fullScale);
  }

  /** Sets the stored number that means 1. */
  setFullScale(scale) {
    this.fullScale = scale;
    for (const contrast of [this.leftContrast, this.rightContrast]) contrast.measure(this.unit());
    this.probe.renew();
  }

  mode() {
    return this.choice.value;
  }

  offerMode(mode, offered) {
    const option = [...this.choice.options].find(({ value }) => value === mode);
    option.hidden = option.disabled = !offered;
    if (offered || this.mode() !== mode) return;
    this.choice.value = "frame";
    this.choice.dispatchEvent(new Event("change"));
  }

  /** Offers the true error if the job has true frames. */
  setTruth(truth) {
    if (this.truth === truth) return;
    // The picture has the same URL for other true frames.
    this.right.generation += 1;
    this.spreads.clear();
    this.truth = truth;
    this.offerMode("deviation", truth !== null);
  }

  nearer(factor) {
    const { zoom } = this.right.place();
    this.view.zoomBy(factor ?? 1 / zoom, zoom);
  }

  /** URL of the snapshot's images. */
  base() {
    return `/view/jobs/${this.job.id}/snapshots/${this.snapshot}/pictures`;
  }

  sliceBase() {
    return this.ready && this.slicing.open ? `${this.base()}/slice-${this.slice.row()}` : null;
  }

  name(frame) {
    if (STILL.includes(this.mode())) return this.mode();
    // The first frame has no previous one.
    return `${this.mode()}-${this.mode() === "difference" ? Math.max(2, frame) : frame}`;
  }

  source(frame) {
    const name = this.name(frame);
    const called = (number) => frameName(this.job, number);
    const label = {
      frame: `${capital(called(frame))} of ${this.player.count}`,
      colours: "All bands in false colours",
      difference: `Difference of ${called(Math.max(2, frame))} from the previous one`,
      error: `Expected error of ${called(frame)}`,
      deviation: `True error of ${called(frame)}`,
      residual: "Residual map",
    }[this.mode()];
    return { base: `${this.base()}/${name}`, levels: this.levels, tile: this.tile, label };
  }

  /** Opens the next snapshot by `next`; always true, which makes the player wait for it. */
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
    this.player.showPosition();
    const base = `/view/measurements/${this.job.measurement}/pictures/snapshot-${snapshot}`;
    try {
      const spread = await get(`${base}/spread`, this.signal);
      this.left.view.resize(spread.height, spread.width);
      this.measured = { base, levels: spread.levels, tile: spread.tile, label: `Measurement, snapshot ${snapshot}` };
      this.left.setNote("");
      this.leftContrast.offer(spread);
      this.distribute(this.leftContrast, base, spread, 0);
      this.showLeft();
    } catch (error) {
      // Show the job even if its measurement is damaged.
      if (!error.errors || isUnreachable(error)) throw error;
      this.measured = null;
      this.left.show(null);
      this.left.setNote(error.message);
    }
    this.leftContrast.element.hidden = !this.measured;
    await this.renew();
  }

  /** Reloads the frames, in which tiles appear when they are done. */
  async renew() {
    this.spreads.clear();
    this.right.generation += 1;
    this.slice.renew();
    await this.offerRight();
  }

  /** Shows the state of an unfinished job on the image. */
  stand(job, written) {
    const { tiles_done: done, tiles_total: total } = job.progress;
    const whole = `${done} of ${total} tiles are done`;
    const words = {
      failed: [`Failed: ${this.ready ? "the frames are incomplete" : "there are no frames"}`, "bad"],
      cancelled: [`Cancelled: ${this.ready ? "the frames are incomplete" : "there are no frames"}`, "ended"],
      cancelling: ["Being cancelled", "ended"],
    }[job.state];
    if (words) this.right.brand(...words);
    else this.right.brand(written || !this.ready ? "" : done > 0 ? `Preview: ${whole}` : "Preview: coarse frames", "preview");
  }

  async offerRight() {
    if (this.player.count < 2 && this.mode() === "difference") {
      this.right.setNote("There is only one frame.");
      return;
    }
    // A late answer must not undo a newer one.
    const turn = (this.turn += 1);
    try {
      const spread = await this.spread();
      if (turn !== this.turn) return;
      Object.assign(this, { levels: spread.levels, tile: spread.tile });
      this.view.resize(spread.height, spread.width);
      say(this.meaning, MODES.find(([value]) => value === this.mode())[3]);
      this.rightContrast.offer(spread);
      this.distribute(this.rightContrast, `${this.base()}/${this.name(Math.ceil(this.player.count / 2))}`, spread, this.right.generation);
    } catch (error) {
      if (turn !== this.turn) return;
      if (!error.errors || isUnreachable(error)) throw error;
      this.ready = false;
      this.right.show(null);
      this.right.setNote(error.code !== "not_ready" ? error.message : ["failed", "cancelled"].includes(this.state) ? "The job ended before any frame was computed." : "No frames yet. A coarse preview comes first, then the frames tile by tile.");
      // Other pictures of a job may be missing, but without frames there are none.
      const unusable = this.mode() === "frame" ? this.controls : this.controls.slice(0, 2);
      unusable.forEach((element) => (element.hidden = true));
      return;
    }
    this.ready = true;
    this.controls.forEach((element) => (element.hidden = false));
    this.player.element.hidden = STILL.includes(this.mode());
    this.right.setNote("");
    this.showRight();
  }

  /** Loads the range of values; that of the middle frame holds for all frames. */
  async spread() {
    const name = this.name(Math.ceil(this.player.count / 2));
    if (!this.spreads.has(name)) this.spreads.set(name, await get(`${this.base()}/${name}/spread`, this.signal));
    const spread = this.spreads.get(name);
    const most = Math.max(-spread.low, spread.high);
    return SIGNED.includes(this.mode()) ? { ...spread, low: -most, high: most } : spread;
  }

  /** Draws the histogram of a picture. */
  async distribute(contrast, base, { height, width }, version) {
    try {
      contrast.distribution(await sampled({ base, height, width, version }));
    } catch {
      // The contrast works without its histogram.
    }
  }

  showLeft() {
    this.left.show(this.measured, ...this.leftContrast.window());
  }

  showRight() {
    if (!this.ready) return;
    // The slice always shows frames, in any mode of the pane.
    if (this.mode() === "frame") this.frameWindow = this.rightContrast.window();
    this.right.show(this.source(this.player.frame), ...this.rightContrast.window());
    this.slice.show(this.player.frame);
    if (this.probe.kind === "line") this.probe.renew();
  }
}
