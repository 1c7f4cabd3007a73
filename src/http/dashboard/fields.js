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
