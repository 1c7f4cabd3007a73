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

/** A SHA-256, of which the first digits are enough to recognise it. */
const HASH = /\b([0-9a-f]{8})[0-9a-f]{56}\b/g;

/** A text of the service with a capital and short hashes. */
export const capital = (text) => String(text).replace(HASH, "$1…").replace(/^./, (letter) => letter.toUpperCase());

/** A text of the service, with the names in backticks as code. */
export function marked(text) {
  return String(text).replace(HASH, "$1…").split(/`([^`]+)`/).map((part, index) => (index % 2 ? h("code", null, part) : part));
}

/** An error's text, with a link to the page that explains it. */
export function explained(error) {
  const { code } = error;
  const link = code && code !== "unknown" && h("a", { href: `/problems/${code}`, target: "_blank", rel: "noopener" }, "About this error (new tab)");
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
