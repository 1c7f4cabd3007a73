// Elements from values. Text stays text: nothing here, or anywhere, reads markup from a string.

import { lookedAfter } from "./keeping.js";

const SVG = "http://www.w3.org/2000/svg";

/**
 * An address of the service from where this page is, which may be below a path of a proxy; of the lab that is
 * looked after, where that is another than one's own.
 */
export function place(path) {
  if (!path.startsWith("/")) return path;
  const lab = lookedAfter();
  if (!lab || !path.startsWith("/v1/")) return `.${path}`;
  const [, address, fragment] = /^([^#]*)(.*)$/.exec(path);
  return `.${address}${address.includes("?") ? "&" : "?"}lab=${lab}${fragment}`;
}

/** An HTML element with properties and children; null, undefined and false children are left out. */
export function h(tag, properties, ...children) {
  return fill(document.createElement(tag), properties, children);
}

/** An SVG element. */
export function s(tag, properties, ...children) {
  return fill(document.createElementNS(SVG, tag), properties, children);
}

function fill(element, properties, children) {
  for (const [name, value] of Object.entries(properties ?? {})) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "class") element.setAttribute("class", value);
    else if (name === "value" || name === "checked" || name === "selected") element[name] = value;
    else if (name === "href") element.setAttribute(name, place(value));
    else element.setAttribute(name, value === true ? "" : String(value));
  }
  append(element, children);
  return element;
}

function append(element, children) {
  for (const child of children.flat(Infinity)) {
    if (child === null || child === undefined || child === false) continue;
    element.append(child instanceof Node ? child : String(child));
  }
}

/** Replaces what an element holds. */
export function put(element, ...children) {
  element.replaceChildren();
  append(element, children);
  return element;
}

/** Sets the text of an element if it differs: an untouched node costs no layout. */
export function say(element, text) {
  const next = String(text ?? "");
  if (element.textContent !== next) element.textContent = next;
}

/** Tells a screen reader. */
export function announce(text) {
  say(document.getElementById("announce"), text);
}

/** A list of names and values. */
export function facts(pairs) {
  const rows = pairs.filter((pair) => pair && pair[1] !== null && pair[1] !== undefined);
  return h("dl", { class: "facts" }, rows.map(([name, value]) => [h("dt", null, name), h("dd", null, value)]));
}

/** A message about something that went wrong. */
export function trouble(error) {
  return h("p", { class: "trouble", role: "alert" }, error.message ?? error);
}

/** Calls at most once in `wait` milliseconds, the last time with the last arguments. */
export function calmly(wait, call) {
  let timer = 0;
  return (...values) => {
    clearTimeout(timer);
    timer = setTimeout(() => call(...values), wait);
  };
}
