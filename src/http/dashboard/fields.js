// Form fields with labels. An empty field has the value null.

import { figure } from "./format.js";
import { h, say } from "./dom.js";

function field(id, label, properties) {
  const input = h("input", { id, ...properties });
  return { input, element: h("label", { for: id }, label, input) };
}

export function textField(id, label, placeholder) {
  const { input, element } = field(id, label, { type: "text", maxlength: 200, placeholder, autocomplete: "off" });
  return { element, input, value: () => input.value.trim() || null };
}

export function numberField(id, label, step = "any") {
  const { input, element } = field(id, label, { type: "number", step });
  return { element, input, value: () => (input.value === "" ? null : Number(input.value)) };
}

/** The values without those that are null; the service applies its defaults to these. */
export function given(values) {
  return Object.fromEntries(Object.entries(values).filter(([, value]) => value !== null));
}

const PACKINGS = [["", "one number per pixel"], ["mono12p", "12 bits, mono12p"], ["mono12packed", "12 bits, mono12packed"]];

/**
 * Fields for a part of a file: a window of each image, with `frames` the first and last image, and the packing of the
 * pixels. `changed()` is called after each edit. `value()` has the stated properties of a request. `more` fields are shown
 * with these.
 */
export function partFields(id, frames, changed, more = []) {
  const number = (name, label) => {
    const made = numberField(`${id}-${name}`, label, 1);
    made.input.min = 0;
    made.input.addEventListener("change", changed);
    return made;
  };
  const window = { row: number("row", "First row"), column: number("column", "First column"), height: number("height", "Rows"), width: number("width", "Columns") };
  const range = frames ? [number("first", "First mask, from 0"), number("last", "Last mask")] : [];
  const packing = h("select", { id: `${id}-packing`, onchange: changed }, PACKINGS.map(([value, text]) => h("option", { value }, text)));
  const all = [...Object.values(window), ...range];
  const element = h("details", { class: "part" }, h("summary", null, frames ? "Window, masks and packing" : "Window, packing and saturation"),
    h("div", { class: "fields" }, all.map((one) => one.element), h("label", { for: `${id}-packing` }, "Pixels are stored as", packing), more.map((one) => one.element)));
  const inputs = { ...window, ...(frames ? { first: range[0], last: range[1] } : {}) };
  const value = () => {
    const crop = Object.fromEntries(Object.entries(window).map(([name, one]) => [name, one.value()]));
    const [first, last] = range.map((one) => one.value());
    const whole = Object.values(crop).some((side) => side === null);
    return given({ crop: whole ? null : crop, frames: range.length && first !== null && last !== null ? [first, last] : null, packing: packing.value || null });
  };
  /** Shows these settings: `row`, `column`, `height`, `width`, `first` and `last`. */
  const set = (settings) => {
    element.open = true;
    for (const [name, side] of Object.entries(settings)) inputs[name].input.value = side ?? "";
  };
  const setPacking = (name) => (packing.value = name ?? "");
  return { element, value, set, setPacking };
}

/** The snapshots that a text names, as in a request; null for all. Throws for other texts. */
function snapshotsOf(text) {
  if (!text || text === "all") return null;
  const [, first, last] = /^(\d+)(?:\s*[-–]\s*(\d+))?$/.exec(text) ?? [];
  if (first === undefined) throw new Error(`“${text}” names no snapshots. State all, an index from 0 such as 3, or a range such as 0-5.`);
  return last === undefined ? Number(first) : [Number(first), Number(last)];
}

/**
 * Fields of a job that most jobs leave at their defaults. `value()` has the stated ones as in a request, and throws for texts
 * that can't be read; `changed()` is called after each edit.
 */
export function furtherFields(changed) {
  const snapshots = textField("snapshots", "Snapshots, counted from 0", "all, 3 or 0-5");
  const [size, overlap] = [numberField("tile-size", "Largest side of a tile in pixels", 1), numberField("tile-overlap", "Overlap of tiles in pixels", 1)];
  const webhook = textField("webhook", "Address to notify at the end", "https://lab.example/hook");
  const model = h("select", { id: "model" }, h("option", { value: "" }, "none"));
  const modelLabel = h("label", { for: "model", hidden: true }, "Network of your own, instead of the algorithm", model);
  const schedule = h("textarea", { id: "schedule", rows: 3, spellcheck: "false", placeholder: '{"stages": [{"prior": "tv", "iterations": 60, "tv_weight": 0.1}]}' });
  for (const input of [snapshots.input, size.input, overlap.input, webhook.input, model, schedule]) input.addEventListener("change", changed);
  const scheduleOf = (text) => {
    try {
      return text === "" ? null : JSON.parse(text);
    } catch (error) {
      throw new Error(`The schedule is no JSON: ${error.message}. “sci-recon schedule” prints one.`);
    }
  };
  const value = () => {
    const tile = { size: size.value(), overlap: overlap.value() };
    const network = model.value ? { algorithm: "learned", model: model.value } : {};
    return { ...given({ snapshots: snapshotsOf(snapshots.value()), tile: tile.size === null && tile.overlap === null ? null : given(tile), schedule: scheduleOf(schedule.value.trim()), webhook: webhook.value() }), ...network };
  };
  /** Offers the networks of a calibration. */
  const offer = (models) => {
    model.replaceChildren(h("option", { value: "" }, "none"), ...models.map((item) => h("option", { value: item.id }, item.name ?? item.id)));
    modelLabel.hidden = models.length === 0;
  };
  const element = h("details", null, h("summary", null, "Snapshots, tiles, schedule and notification"),
    h("div", { class: "fields" }, [snapshots, size, overlap, webhook].map((one) => one.element), modelLabel), h("label", { for: "schedule", class: "below" }, "Schedule as JSON, instead of the algorithm’s", schedule));
  return { element, value, offer };
}

const CORRECTIONS = [["", "corrected if it helps"], ["stated", "moved by a known motion"], ["off", "used as calibrated"]];

/** Fields for masks that have moved since the calibration. `value()` has the setting as in a request; `changed()` is called after each edit. */
export function shiftFields(changed) {
  const select = h("select", { id: "registration" }, CORRECTIONS.map(([value, text]) => h("option", { value }, text)));
  const shift = [numberField("shift-rows", "Masks moved down, in pixels"), numberField("shift-columns", "Masks moved right, in pixels")];
  const rotation = numberField("rotation", "Masks turned clockwise, in degrees");
  const scale = numberField("mask-scale", "Masks grown by the factor");
  const stated = [...shift, rotation, scale];
  const arrange = () => stated.forEach(({ element }) => (element.hidden = select.value !== "stated"));
  for (const input of [select, ...stated.map((one) => one.input)]) {
    input.addEventListener("change", () => {
      arrange();
      changed();
    });
  }
  arrange();
  const motion = () => ({ shift: shift.map((one) => one.value() ?? 0), ...given({ rotation: rotation.value(), scale: scale.value() }) });
  const value = () => (select.value === "stated" ? motion() : select.value || null);
  return { elements: [h("label", { for: "registration" }, "Masks that have moved are", select), stated.map((one) => one.element)], value };
}

const AXES = [["column", "to the right, along a row"], ["row", "downwards, along a column"]];
const EXTENTS = [["scene", "the scene, like one band"], ["measurement", "the whole measurement"]];

/** The numbers of a text, START:STEP:COUNT or a list; null if it is empty. Throws for other texts. */
export function numbersOf(text) {
  const clean = text.replaceAll(/[[\]]/g, " ").trim();
  if (clean === "") return null;
  const number = (word) => {
    if (word === "" || !Number.isFinite(Number(word))) throw new Error(`“${word}” is no number. State START:STEP:COUNT or a list.`);
    return Number(word);
  };
  if (!clean.includes(":")) return clean.split(/[\s,;]+/).filter(Boolean).map(number);
  const [start, step, count, ...rest] = clean.split(":").map((word) => number(word.trim()));
  if (!(count >= 1 && count <= 1000) || !Number.isInteger(count) || rest.length > 0) throw new Error("State START:STEP:COUNT, with a whole number of bands as COUNT.");
  return Array.from({ length: count }, (_, index) => Number((start + step * index).toPrecision(12)));
}

/**
 * Fields for the dispersion of a spectral camera. `value()` has it as in a request, and throws if it is incomplete;
 * `changed()` is called after each edit.
 */
export function dispersionFields(changed) {
  const edit = () => {
    try {
      const { offsets, wavelengths } = value();
      const range = (numbers, unit) => `${figure(Math.min(...numbers), 4)} to ${figure(Math.max(...numbers), 4)} ${unit}`;
      say(summary, `${offsets.length} bands, displaced by ${range(offsets, "pixels")}${wavelengths ? `; ${range(wavelengths, "nm")}` : ""}.`);
    } catch (error) {
      say(summary, error.message);
    }
    changed();
  };
  const select = (id, label, options) => {
    const input = h("select", { id, onchange: edit }, options.map(([name, text]) => h("option", { value: name }, text)));
    return { input, element: h("label", { for: id }, label, input) };
  };
  const [axis, mask] = [select("dispersion-axis", "Bands are displaced", AXES), select("dispersion-mask", "The mask covers", EXTENTS)];
  const [offsets, wavelengths] = [field("dispersion-offsets", "Displacement of each band in pixels", { type: "text", placeholder: "0:2:28", autocomplete: "off" }), field("dispersion-wavelengths", "Wavelength of each band in nm (optional)", { type: "text", placeholder: "450:7.4:28", autocomplete: "off" })];
  for (const { input } of [offsets, wavelengths]) input.addEventListener("change", edit);
  const summary = h("p", { class: "muted", "aria-live": "polite" });
  const element = h("div", { hidden: true },
    h("p", { class: "muted" }, "One mask codes all bands, and a prism or grating displaces them. State START:STEP:COUNT, such as 0:2:28 for 28 bands at 2 pixels per band, or a list, such as 0, 1.8, 3.9."),
    h("div", { class: "fields pairs" }, [offsets, wavelengths, axis, mask].map((one) => one.element)), summary);
  const value = () => {
    const found = { axis: axis.input.value, mask: mask.input.value, offsets: numbersOf(offsets.input.value), wavelengths: numbersOf(wavelengths.input.value) };
    if (!found.offsets) throw new Error("State the displacement of each band.");
    if (found.wavelengths && found.wavelengths.length !== found.offsets.length) throw new Error(`There are ${found.offsets.length} displacements, but ${found.wavelengths.length} wavelengths. State one of each for every band.`);
    return given(found);
  };
  /** Shows a dispersion. */
  const set = (found) => {
    [axis.input.value, mask.input.value] = [found.axis, found.mask];
    offsets.input.value = found.offsets.join(", ");
    wavelengths.input.value = found.wavelengths?.join(", ") ?? "";
  };
  return { element, value, set };
}
