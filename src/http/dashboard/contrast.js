// Contrast window of a pane: the values shown as black and as white.

import { h, say } from "./dom.js";
import { figure } from "./format.js";

let made = 0;

export class Contrast {
  /** `changed()` is called when the window changes. */
  constructor(name, changed) {
    made += 1;
    this.changed = changed;
    this.black = this.slider(`black-${made}`, `Black of the ${name}`);
    this.white = this.slider(`white-${made}`, `White of the ${name}`);
    this.auto = h("button", { type: "button", class: "small", onclick: () => this.reset() }, "Auto");
    this.text = h("span", { class: "muted window" });
    this.element = h("div", { class: "contrast row" }, h("span", { class: "muted" }, "Contrast"), this.black, this.white, this.text, this.auto);
  }

  slider(id, label) {
    const input = h("input", { type: "range", id, min: 0, max: 1000, "aria-label": label });
    input.addEventListener("input", () => {
      this.touched = true;
      this.read(input);
      this.changed();
    });
    return input;
  }

  /** Sets the range of values; a window that the user has chosen is kept. */
  offer(spread) {
    const same = this.spread && JSON.stringify(this.spread) === JSON.stringify(spread);
    this.spread = spread;
    if (!same && !this.touched) this.reset(false);
  }

  reset(notify = true) {
    this.touched = false;
    const { low, high } = this.spread;
    [this.low, this.high] = [low, high > low ? high : low + 1];
    this.black.value = this.at(this.low);
    this.white.value = this.at(this.high);
    this.show();
    if (notify) this.changed();
  }

  range() {
    const { minimum, maximum } = this.spread;
    return [minimum, maximum > minimum ? maximum : minimum + 1];
  }

  at(value) {
    const [from, to] = this.range();
    return Math.round(1000 * (value - from) / (to - from));
  }

  read(input) {
    const [from, to] = this.range();
    // One slider pushes the other, so that black stays below white.
    if (Number(this.black.value) >= Number(this.white.value)) {
      if (input === this.black) this.white.value = Number(this.black.value) + 1;
      else this.black.value = Number(this.white.value) - 1;
    }
    const value = (slider) => from + (to - from) * Number(slider.value) / 1000;
    [this.low, this.high] = [value(this.black), value(this.white)];
    if (this.high <= this.low) this.high = this.low + (to - from) / 1000;
    this.show();
  }

  show() {
    const [low, high] = [figure(this.low), figure(this.high)];
    say(this.text, `${low} to ${high}`);
    this.black.setAttribute("aria-valuetext", low);
    this.white.setAttribute("aria-valuetext", high);
  }

  /** The window, rounded to the six digits that the URL carries. */
  window() {
    return [Number(this.low.toPrecision(6)), Number(this.high.toPrecision(6))];
  }
}
