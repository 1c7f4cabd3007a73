// Filter of the job list by state and text, stored in the URL, and saved filters.

import { calmly, capital, h, put } from "./dom.js";
import { recall, remember } from "./storage.js";
import { stateWord } from "./format.js";

const STATES = ["queued", "running", "succeeded", "failed", "cancelling", "cancelled"];
const CHOICES = [["", "All states"], ["queued,running", "Active"], ...STATES.map((state) => [state, capital(stateWord(state))])];

/** The filter's fields; `changed()` is called when the filter changes. */
export function filters(query, changed) {
  const wanted = query.get("state") ?? "";
  // A URL may name a combination of states that is not among the choices.
  const choices = CHOICES.some(([value]) => value === wanted) ? CHOICES : [...CHOICES, [wanted, wanted]];
  const state = h("select", { id: "state" }, choices.map(([value, text]) => h("option", { value, selected: value === wanted }, text)));
  const search = h("input", { type: "search", id: "search", placeholder: "Name or ID", maxlength: 200, autocomplete: "off", value: query.get("search") ?? "" });
  const keep = h("button", { type: "button", class: "small", hidden: true, onclick: () => store([...saved(), value()]) }, "Save this filter");
  const chips = h("span", { class: "row chips" });

  const value = () => ({ state: state.value, search: search.value.trim() });
  const address = (filter) => `#/jobs?${new URLSearchParams(Object.entries(filter).filter(([, text]) => text))}`.replace(/\?$/, "");
  const saved = () => recall("filters", []);
  const same = (one, other) => one.state === other.state && one.search === other.search;
  const title = (filter) => [CHOICES.find(([name]) => name === filter.state)?.[1], filter.search && `“${filter.search}”`].filter((part) => part && part !== "All states").join(", ");

  function store(list) {
    remember("filters", list);
    show();
  }

  function show() {
    const now = value();
    keep.hidden = !(now.state || now.search) || saved().some((filter) => same(filter, now));
    put(chips, saved().map((filter) => h("span", { class: "chip" },
      h("a", { href: address(filter), "aria-current": same(filter, now) ? "true" : null }, title(filter)),
      h("button", { type: "button", "aria-label": `Remove the filter ${title(filter)}`, onclick: () => store(saved().filter((other) => !same(other, filter))) }, "×"))));
  }

  const apply = calmly(200, () => {
    history.replaceState(null, "", address(value()));
    show();
    changed();
  });
  state.addEventListener("change", apply);
  search.addEventListener("input", apply);
  show();
  return {
    value,
    element: [h("label", { for: "state", class: "unseen" }, "State"), state, h("label", { for: "search", class: "unseen" }, "Search"), search, keep, chips],
  };
}
