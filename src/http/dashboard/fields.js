// Fields of a form, each with its label; what is left empty is null, and nothing is guessed.

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

/** Only what was given: the service has its own defaults. */
export function given(values) {
  return Object.fromEntries(Object.entries(values).filter(([, value]) => value !== null));
}
