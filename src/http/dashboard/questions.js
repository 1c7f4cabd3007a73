// Questions that mend a refusal or a finding: for each setting that it names, the controls that state it.

import { h, place } from "./dom.js";

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

/** Asks for the array of an uploaded file, among those that the error names; each has its size and first picture. */
function askArray(error, file, again) {
  const arrays = [...error.message.replace(/^.*it contains/, "").matchAll(/'([^']+)'(?: \(([\dx]+)\))?/g)];
  const choice = ([, name, size]) => {
    const picture = h("img", { src: place(`/view/blobs/${file}/pictures/array-${encodeURIComponent(name)}?size=96`), alt: "", width: 72, height: 72 });
    // Some arrays, such as lists of numbers, have no picture.
    picture.addEventListener("error", () => picture.replaceWith(h("span", { class: "blank" })));
    return h("button", { type: "button", class: "arraychoice", onclick: () => again(name) }, picture, h("b", null, name), " ", h("span", { class: "muted" }, size?.replaceAll("x", " × ")));
  };
  return arrays.length > 0 && ask("Array", "Which array of the file?", arrays.map(choice));
}

/** Settings that an error names: by a JSON pointer, or in backticks in its text. */
function named(error) {
  const pointers = (error.errors ?? []).map(({ pointer }) => pointer.split("/")[1]);
  return new Set([...pointers, ...[...error.message.matchAll(/`"?(\w+)/g)].map(([, word]) => word)]);
}

/**
 * Asks for the settings that an error of an uploaded `file` names; null if it names none. `again(stated)` repeats the request
 * with those `stated` before and the new one. `more` has questions for further settings: functions by name that receive the error.
 */
export function askAbout(error, file, stated, again, more = {}) {
  const set = (name) => (value) => again({ ...stated, [name]: value });
  const questions = { array: () => askArray(error, file, set("array")), full_scale: () => askScale(set("full_scale")), ...more, axes: () => askAxes(error, set("axes")) };
  const names = named(error);
  const asked = Object.entries(questions).filter(([name]) => names.has(name)).map(([, question]) => question(error)).filter(Boolean);
  return asked.length > 0 ? asked : null;
}

/** Largest number of masks of a calibration. */
const MAX_MASKS = 64;

/** Offers a range of the masks in a file: one for a spectral camera, otherwise those of one exposure. */
export function askFrames(error, part, repeat) {
  const one = error.message.includes("dispersion");
  const count = Number(/has (\d+) masks/.exec(error.message)?.[1] ?? /has (\d+) frames/.exec(error.message)?.[1] ?? MAX_MASKS);
  const number = (label, value) => h("input", { type: "number", min: 0, max: count - 1, value, "aria-label": label });
  const [first, last] = [number("First mask", 0), number("Last mask", one ? 0 : Math.min(count, MAX_MASKS) - 1)];
  const apply = () => {
    part.set({ first: first.value, last: one ? first.value : last.value });
    repeat();
  };
  return ask("Masks", one ? "Which mask of the file is it, counted from 0?" : "Which masks of the file belong to one exposure, counted from 0?", first, !one && ["to", last], answer(one ? "Use this mask" : "Use these masks", apply));
}

/** Offers the window in the middle of the measurement, the masks or both that both can have in common. */
export function askWindow(error, { calibration, vary }, part, repeat) {
  const sizes = /measurement is (\d+)x(\d+).* are (\d+)x(\d+)/.exec(error.message)?.slice(1).map(Number);
  if (!sizes) return null;
  const [data, masks] = [{ height: sizes[0], width: sizes[1] }, { height: sizes[2], width: sizes[3] }];
  const [height, width] = ["height", "width"].map((side) => Math.min(data[side], masks[side]));
  // A window of a mosaic begins with an even row and column.
  const middle = (length, whole) => Math.floor((whole - length) / 2) & (calibration.mosaic ? ~1 : ~0);
  const window = (whole, before) => (whole.height > height || whole.width > width) && { row: (before?.row ?? 0) + middle(height, whole.height), column: (before?.column ?? 0) + middle(width, whole.width), height, width };
  const [ofData, ofMasks] = [window(data, part.value().crop), window(masks, calibration.reading?.crop)];
  const of = [ofData && "the measurement", ofMasks && "the masks"].filter(Boolean).join(" and of ");
  const apply = () => {
    if (ofData) part.set(ofData);
    if (ofMasks) vary({ crop: ofMasks });
    else repeat();
  };
  return ask("Window", "Was only a part of the sensor recorded?",
    answer(`Use the middle ${height} × ${width} of ${of}`, apply),
    h("span", { class: "muted" }, "If it is not in the middle, correct its first row and column in the window of the file afterwards. Otherwise select the calibration of this camera setting above."));
}

/** Offers the other area of a spectral camera's mask. */
export function askExtent({ calibration, vary }) {
  const { dispersion } = calibration;
  if (!dispersion) return null;
  const [mask, words] = dispersion.mask === "scene" ? ["measurement", "the measurement"] : ["scene", "the scene"];
  return ask("Area of the mask", "Which area does the mask cover?", answer(`The mask covers ${words}`, () => vary({ mask })));
}

/** Offers the window at which the check has found the masks in the measurement. */
export function askMove({ calibration, measurement, vary }, part, repeat) {
  const finding = measurement.warnings.find(({ code }) => code === "shifted_masks");
  const by = /shifted by (-?\d+) rows and (-?\d+) columns/.exec(finding?.detail)?.slice(1).map(Number);
  // A mosaic keeps its colours only if it moves by even numbers.
  if (!by || (calibration.mosaic && by.some((one) => one % 2 !== 0))) return null;
  const [rows, columns] = by;
  const { crop } = part.value();
  if (crop && crop.row + rows >= 0 && crop.column + columns >= 0) {
    const [row, column] = [crop.row + rows, crop.column + columns];
    return ask("Place of the window", "Does the window begin at another place?", answer(`Begin at row ${row}, column ${column}`, () => {
      part.set({ row, column });
      repeat();
    }));
  }
  const [height, width] = [measurement.height - Math.abs(rows), measurement.width - Math.abs(columns)];
  const window = (before, sign) => ({ row: (before?.row ?? 0) + Math.max(0, sign * rows), column: (before?.column ?? 0) + Math.max(0, sign * columns), height, width });
  if (calibration.dispersion || height < 1 || width < 1) return null;
  return ask("Place of the window", "Do masks and measurement begin at different places?", answer(`Use the ${height} × ${width} pixels that both have`, () => {
    part.set(window(crop, 1));
    vary({ crop: window(calibration.reading?.crop, -1) });
  }));
}
