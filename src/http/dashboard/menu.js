// A button that opens a short list of further actions.

import { h, put } from "./dom.js";

/** A button "⋯" with a list of `items`, which are buttons. The list is above all other content, so that no cell clips it. */
export function menu(label, items) {
  const list = h("div", { class: "menu", popover: "auto" }, items);
  const button = h("button", { type: "button", class: "small more", "aria-label": label, title: label, "aria-expanded": "false" }, "⋯");
  button.popoverTargetElement = list;
  list.addEventListener("beforetoggle", (event) => {
    button.setAttribute("aria-expanded", String(event.newState === "open"));
  });
  list.addEventListener("toggle", (event) => {
    if (event.newState !== "open") return;
    const box = button.getBoundingClientRect();
    const below = box.bottom + list.offsetHeight + 4 < innerHeight;
    list.style.top = `${below ? box.bottom + 4 : box.top - list.offsetHeight - 4}px`;
    list.style.left = `${Math.max(4, box.right - list.offsetWidth)}px`;
    list.querySelector("button")?.focus();
  });
  list.addEventListener("click", () => list.hidePopover());
  return put(h("span", { class: "menubox" }), button, list);
}
