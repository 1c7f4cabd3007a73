// Creates elements from values. Strings become text nodes, never markup.

import { selectedLab } from "./storage.js";

const SVG = "http://www.w3.org/2000/svg";

/**
 * URL of a path of the service, relative to this page, which may be served below a proxy's path prefix. If
 * another lab is selected, the URL names it.
 */
export function place(path) {
  if (!path.startsWith("/")) return path;
  const lab = selectedLab();
  if (!lab || !/^\/(v1|view)\//.test(path)) return `.${path}`;
  const [, address, fragment] = /^([^#]*)(.*)$/.exec(path);
  return `.${address}${address.includes("?") ? "&" : "?"}lab=${lab}${fragment}`;
}

/** Creates an HTML element; children that are null, undefined or false are omitted. */
export function h(tag, properties, ...children) {
  return fill(document.createElement(tag), properties, children);
}

/** Creates an SVG element. */
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

/** Replaces the children of an element. */
export function put(element, ...children) {
  element.replaceChildren();
  append(element, children);
  return element;
}

/** Sets the text of an element if it differs, which avoids a layout. */
export function say(element, text) {
  const next = String(text ?? "");
  if (element.textContent !== next) element.textContent = next;
}

/** Announces a text to screen readers. */
export function announce(text) {
  say(document.getElementById("announce"), text);
}

/** A list of names and values. */
export function facts(pairs) {
  const rows = pairs.filter((pair) => pair && pair[1] !== null && pair[1] !== undefined);
  return h("dl", { class: "facts" }, rows.map(([name, value]) => [h("dt", null, name), h("dd", null, value)]));
}

/** The names of settings in the texts of the service, as the form for a new job calls them. */
const SETTINGS = {
  dark: "Dark captures", saturation: "Saturated from", crop: "Window", array: "Array", frames: "First mask, Last mask", axes: "Order of the axes",
  full_scale: "Full scale", registration: "Masks that have moved are", "registration auto": "Masks that have moved are corrected if it helps",
};

/** A text of the service with the first digits of each SHA-256, sizes such as 64 × 64 × 4, and numbers such as −2. */
const brief = (text) => String(text).replace(/\b([0-9a-f]{8})[0-9a-f]{56}\b/g, "$1…")
  .replace(/\b[1-9]\d*(x\d+)+\b/g, (size) => size.replaceAll("x", " × ")).replaceAll(" x ", " × ").replace(/(^|[ (])-(?=\d)/g, "$1−");

/** A text of the service with a capital. */
export const capital = (text) => brief(text).replace(/^./, (letter) => letter.toUpperCase());

/** A text of the service. Names in backticks become those of the form, or code. */
export function marked(text) {
  const word = (name) => (SETTINGS[name] ? `“${SETTINGS[name]}”` : h("code", null, name));
  return brief(text).replace("`registration` auto", "`registration auto`").split(/`([^`]+)`/).map((part, index) => (index % 2 ? word(part) : part));
}

/** Link to the page that explains an error; false for unknown errors. */
export const about = ({ code }) => code && code !== "unknown" && h("a", { href: `/problems/${code}`, target: "_blank", rel: "noopener" }, "About this error (new tab)");

/** An error's text, with a link to the page that explains it. */
export function explained(error) {
  const link = about(error);
  return [marked(error.message ?? error), link && [" ", link]];
}

/** An error message. */
export function trouble(error) {
  return h("p", { class: "trouble", role: "alert" }, explained(error));
}

/** Debounces: calls `call` with the latest arguments after `wait` milliseconds without another call. */
export function calmly(wait, call) {
  let timer = 0;
  return (...values) => {
    clearTimeout(timer);
    timer = setTimeout(() => call(...values), wait);
  };
}
