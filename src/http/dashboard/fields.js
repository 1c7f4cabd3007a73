// Form fields with labels. An empty field has the value null.

import { h } from "./dom.js";

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
 * pixels. `changed()` is called after each edit. `value()` has the stated properties of a request.
 */
export function partFields(id, frames, changed) {
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
  const element = h("details", { class: "part" }, h("summary", null, frames ? "Window, masks and packing" : "Window and packing"),
    h("div", { class: "fields" }, all.map((one) => one.element), h("label", { for: `${id}-packing` }, "Pixels are stored as", packing)));
  const value = () => {
    const crop = Object.fromEntries(Object.entries(window).map(([name, one]) => [name, one.value()]));
    const [first, last] = range.map((one) => one.value());
    const whole = Object.values(crop).some((side) => side === null);
    return given({ crop: whole ? null : crop, frames: range.length && first !== null && last !== null ? [first, last] : null, packing: packing.value || null });
  };
  /** Opens the fields, and proposes a window of this size. */
  const propose = (height, width) => {
    element.open = true;
    for (const [name, side] of Object.entries({ row: 0, column: 0, height, width })) window[name].input.value = side;
    window.row.input.focus();
  };
  return { element, value, propose };
}
