// Contrast window of a pane: a histogram with the values shown as black and as white.

import { inUnit } from "./format.js";
import { h, put, s, say } from "./dom.js";

const BINS = 96;
let made = 0;

export class Contrast {
  /** `changed()` is called when the window changes; `title` names one of several windows. */
  constructor(name, changed, title = null) {
    made += 1;
    this.changed = changed;
    this.black = this.slider(`black-${made}`, `Black of the ${name}`);
    this.white = this.slider(`white-${made}`, `White of the ${name}`);
    this.auto = h("button", { type: "button", class: "small", onclick: () => this.reset() }, "Auto");
    this.text = h("span", { class: "window" });
    this.histogram = s("svg", { class: "histogram", viewBox: `0 0 ${BINS} 1`, preserveAspectRatio: "none", "aria-hidden": "true" });
    this.ramp = h("div", { class: "ramp" });
    this.ends = h("div", { class: "ends muted", "aria-hidden": "true" }, h("span"), h("span"));
    this.element = h("div", { class: "contrast" },
      h("div", { class: "row" }, h("span", { class: "muted" }, title ?? "Contrast"), this.text, h("span", { class: "grow" }), this.auto),
      h("div", { class: "levels" }, this.histogram, this.ramp, this.black, this.white), this.ends);
    this.factor = 1;
    this.words = "";
  }

  slider(id, label) {
    const input = h("input", { type: "range", id, min: 0, max: 1000, "aria-label": label });
    input.addEventListener("input", () => {
      this.touched = true;
      this.read(input);
      this.changed(this);
    });
    return input;
  }

  /** Sets the range of values; a window that the user has chosen is kept. */
  offer(spread) {
    const same = this.spread && JSON.stringify(this.spread) === JSON.stringify(spread);
    this.spread = spread;
    if (!same && this.values) this.distribution(this.values);
    if (!same && !this.touched) this.reset(false);
  }

  /** Sets the unit: values are shown multiplied by a factor, with words. */
  measure({ factor, words }) {
    Object.assign(this, { factor, words });
    if (this.spread) this.show();
  }

  /** Draws the distribution of values, given as arrays. */
  distribution(values) {
    this.values = values;
    const [from, to] = this.range();
    const counts = Array(BINS).fill(0);
    for (const value of values.flatMap((part) => [...part])) {
      // Pixels that are not computed yet have no value.
      if (value >= from && value <= to) counts[Math.min(BINS - 1, Math.floor((BINS * (value - from)) / (to - from)))] += 1;
    }
    // The square root keeps rare values visible.
    const most = Math.sqrt(Math.max(...counts, 1));
    const path = counts.map((count, bin) => `M${bin} 1V${(1 - Math.sqrt(count) / most).toFixed(3)}H${bin + 1}V1`).join("");
    put(this.histogram, s("path", { d: path }));
  }

  reset(notify = true) {
    this.touched = false;
    const { low, high } = this.spread;
    this.set(low, high > low ? high : low + 1);
    if (notify) this.changed(this);
  }

  /** Sets the window. */
  set(low, high) {
    [this.low, this.high] = [low, high];
    this.black.value = this.at(low);
    this.white.value = this.at(high);
    this.show();
  }

  /** Ends of the scale: the values of the picture and the window that it begins with. */
  range() {
    const { minimum, maximum, low, high } = this.spread;
    const [from, to] = [Math.min(minimum, low), Math.max(maximum, high)];
    return [from, to > from ? to : from + 1];
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
    const shown = (value) => inUnit(value, this);
    const [low, high] = [shown(this.low), shown(this.high)];
    say(this.text, `${low} to ${high}${this.words ? ` ${this.words}` : ""}`);
    this.black.setAttribute("aria-valuetext", low);
    this.white.setAttribute("aria-valuetext", high);
    const [from, to] = this.range();
    const per = (value) => `${Math.min(100, Math.max(0, (100 * (value - from)) / (to - from))).toFixed(1)}%`;
    this.ramp.style.setProperty("--low", per(this.low));
    this.ramp.style.setProperty("--high", per(this.high));
    say(this.ends.firstChild, shown(from));
    say(this.ends.lastChild, shown(to));
  }

  /** The window, rounded to the six digits that the URL carries. */
  window() {
    return [Number(this.low.toPrecision(6)), Number(this.high.toPrecision(6))];
  }
}
