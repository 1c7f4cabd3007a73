// Selects the frame: slider, playback at any rate, keys.

import { figure } from "./format.js";
import { h, put, say } from "./dom.js";

/** The keys of a picture with a player, and further gestures. */
export const keysHelp = (more) => h("details", { class: "keys" }, h("summary", null, "Keys and gestures"),
  h("p", { class: "muted" }, `Keys on a picture: space plays, ← → step, + − 0 1 zoom, shift and arrows move. ${more}`));

/** Highest playback rate in frames per second, the refresh rate of fast screens. */
const MAX_RATE = 240;

/** Player of `count` frames; calls `show(frame)` with 1 to `count`. `nameOf` returns the name of a band to display. */
export class Player {
  constructor(count, signal, show, nameOf = null) {
    Object.assign(this, { count, show, nameOf, frame: 1, playing: false, ahead: () => true, onward: () => false });
    this.slider = h("input", { type: "range", id: "frame", min: 1, max: count, value: 1, "aria-label": "Frame" });
    this.slider.addEventListener("input", () => this.go(Number(this.slider.value)));
    this.button = h("button", { type: "button", id: "play", "aria-pressed": "false", onclick: () => this.toggle() }, "Play");
    this.rate = h("input", { type: "number", id: "rate", min: 0.1, max: MAX_RATE, step: "any", value: Math.min(12, Math.max(4, count)) });
    this.rate.addEventListener("input", () => this.pace());
    this.text = h("output", { for: "frame", class: "count" });
    this.loop = h("input", { type: "checkbox", id: "loop", checked: true });
    this.slow = h("span", { class: "muted" });
    this.trueButton = h("button", { type: "button", class: "small", hidden: true, onclick: () => this.trueSpeed() }, "True speed");
    this.element = h("div", { class: "player" },
      h("div", { class: "row" }, this.button, this.step(-1, "Previous frame", "‹"), this.slider, this.step(1, "Next frame", "›"), this.text),
      h("div", { class: "row" }, h("label", { for: "rate", class: "row muted" }, this.rate, nameOf ? "bands/s" : "frames/s"), this.trueButton, this.slow,
        h("label", { for: "loop", class: "row muted" }, this.loop, "Loop")));
    signal.addEventListener("abort", () => this.stop(), { once: true });
    this.showPosition();
  }

  /** Sets the true frame rate of the scene; null if the camera's times are unknown. */
  setTrueRate(rate) {
    this.actual = rate;
    this.trueButton.hidden = rate === null || rate > MAX_RATE;
    this.pace();
  }

  trueSpeed() {
    this.rate.value = Number(this.actual.toPrecision(4));
    this.pace();
    this.play();
  }

  /** Shows the playback speed relative to real time. */
  pace() {
    const by = this.actual / Number(this.rate.value);
    const text = by > 1.05 ? `${figure(by, 2)} times slower than real time` : by < 0.95 ? `${figure(1 / by, 2)} times faster than real time` : "in real time";
    say(this.slow, this.actual && Number.isFinite(by) && by > 0 ? text : "");
  }

  step(by, label, sign) {
    return h("button", { type: "button", class: "small", "aria-label": label, onclick: () => this.go(this.frame + by) }, sign);
  }

  go(frame) {
    this.frame = ((frame - 1 + this.count) % this.count) + 1;
    this.showPosition();
    this.show(this.frame);
  }

  showPosition() {
    this.slider.value = this.frame;
    const name = this.nameOf?.(this.frame);
    this.slider.setAttribute("aria-valuetext", `${name ?? `frame ${this.frame}`} of ${this.count}`);
    say(this.text, name ?? `${this.frame} / ${this.count}`);
  }

  toggle() {
    if (this.playing) this.stop();
    else this.play();
  }

  play() {
    if (this.playing) return;
    // At the last frame without a loop, restart from the first.
    if (!this.loop.checked && this.frame === this.count) this.go(1);
    this.playing = true;
    this.mark();
    let before = performance.now();
    let shown = 0;
    this.fps = 0;
    const turn = (now) => {
      if (!this.playing) return;
      const period = 1000 / Math.min(MAX_RATE, Math.max(0.1, Number(this.rate.value) || 1));
      const steps = Math.floor((now - before) / period);
      if (steps >= 1) {
        // Skip frames that the screen is too slow for; wait for frames that are not loaded.
        const next = ((this.frame - 1 + steps) % this.count) + 1;
        if (this.frame - 1 + steps >= this.count && this.onward()) {
          before = now;
        } else if (this.frame - 1 + steps >= this.count && !this.loop.checked) {
          this.go(this.count);
          this.stop();
        } else if (this.ahead(next)) {
          before += steps * period;
          this.go(next);
          shown += 1;
        } else {
          before = now - period;
        }
      }
      this.shown = shown;
      requestAnimationFrame(turn);
    };
    requestAnimationFrame(turn);
  }

  stop() {
    this.playing = false;
    this.mark();
  }

  mark() {
    put(this.button, this.playing ? "Pause" : "Play");
    this.button.setAttribute("aria-pressed", String(this.playing));
  }

  /** Handles keys anywhere in the viewer. */
  keys(element) {
    element.addEventListener("keydown", (event) => {
      if (event.target.matches("input, select, button, a, summary") && event.key !== "k") return;
      if (event.ctrlKey || event.metaKey || event.altKey || event.shiftKey) return;
      const act = { " ": () => this.toggle(), k: () => this.toggle(), ArrowLeft: () => this.go(this.frame - 1), ArrowRight: () => this.go(this.frame + 1), Home: () => this.go(1), End: () => this.go(this.count) }[event.key];
      if (!act || event.target.matches("input[type=number]")) return;
      event.preventDefault();
      act();
    });
  }
}
