// Questions that mend a refusal: for each setting that the error names, the controls that state it.

import { h } from "./dom.js";

const SCALES = [1, 255, 1023, 4095, 16383, 65535];
/** Names of the axis orders. */
const ORDERS = { "frame-row-column": "frame, row, column", "row-column-frame": "row, column, frame", "column-row-frame": "column, row, frame", "frame-column-row": "frame, column, row" };

/** A question with its answers. */
export function ask(name, question, ...answers) {
  return h("div", { class: "askscale", role: "group", "aria-label": name }, h("p", null, h("b", null, question)), h("div", { class: "row" }, answers));
}

export function answer(text, act) {
  return h("button", { type: "button", class: "small", onclick: act }, text);
}

/** Asks for the full scale; `again(scale)` repeats the request with the same file. */
export function askScale(again, question = "Which stored number means 1, the full light of one frame?") {
  const other = h("input", { type: "number", min: 0, step: "any", "aria-label": "Another full scale", placeholder: "other" });
  return ask("Full scale", question, SCALES.map((scale) => answer(`${scale} means 1`, () => again(scale))), other, answer("Use", () => Number(other.value) > 0 && again(Number(other.value))));
}

/** Asks for the axis order. If it is ambiguous, the error names the likely ones, which come first; otherwise it names a wrong one. */
function askAxes(error, again) {
  const ambiguous = error.reason === "axes_ambiguous";
  const [others, inText] = [false, true].map((is) => Object.entries(ORDERS).filter(([name]) => error.message.includes(name) === is));
  const fit = ambiguous ? [...inText, ...others] : others;
  return ask("Axes", ambiguous ? "What is the order of the array’s axes?" : "Or is the order of the array’s axes another one?", fit.map(([name, words]) => answer(words, () => again(name))));
}

/** Asks for the array, among those that the error names. */
function askArray(error, again) {
  const names = [...error.message.replace(/^.*it contains/, "").matchAll(/'([^']+)'/g)].map(([, name]) => name);
  return names.length > 0 && ask("Array", "Which array of the file is it?", names.map((name) => answer(name, () => again(name))));
}

/** Settings that an error names: by a JSON pointer, or in backticks in its text. */
function named(error) {
  const pointers = (error.errors ?? []).map(({ pointer }) => pointer.split("/")[1]);
  return new Set([...pointers, ...[...error.message.matchAll(/`"?(\w+)/g)].map(([, word]) => word)]);
}

/**
 * Asks for the settings that an error names; null if it names none. `again(stated)` repeats the request with those `stated`
 * before and the new one. `more` has questions for further settings: functions by name that receive the error.
 */
export function askAbout(error, stated, again, more = {}) {
  const set = (name) => (value) => again({ ...stated, [name]: value });
  const questions = { array: () => askArray(error, set("array")), full_scale: () => askScale(set("full_scale")), ...more, axes: () => askAxes(error, set("axes")) };
  const names = named(error);
  const asked = Object.entries(questions).filter(([name]) => names.has(name)).map(([, question]) => question(error)).filter(Boolean);
  return asked.length > 0 ? asked : null;
}
