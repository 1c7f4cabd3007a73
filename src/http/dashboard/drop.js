// Drop zone for files, which shows the errors of the files below it.

import { bytes } from "./format.js";
import { isAborted, upload } from "./api.js";
import { h, put, say } from "./dom.js";

/**
 * Creates a drop zone. Each file is uploaded and passed to `take(blob, file)` with the record of the blob. With
 * `many`, several files are accepted and processed in the order of their names.
 */
export function dropZone(id, title, hint, signal, take, many = false) {
  const input = h("input", { type: "file", id, class: "unseen", multiple: many });
  const text = h("span", { class: "muted" }, hint);
  const bar = h("progress", { max: 1, value: 0, hidden: true, "aria-label": `Upload of the ${title.toLowerCase()}` });
  const status = h("div", { class: "status", "aria-live": "polite" });
  const zone = h("label", { class: "drop", for: id }, h("b", null, title), h("span", null, many ? "Drop files here, or select them" : "Drop a file here, or select one"), text, bar, input);
  let current = null;
  const start = async (files) => {
    if (files.length === 0) return;
    current?.abort();
    current = new AbortController();
    const mine = current;
    signal.addEventListener("abort", () => mine.abort());
    bar.hidden = false;
    put(status);
    const sorted = [...files].sort((one, other) => one.name.localeCompare(other.name, undefined, { numeric: true })).slice(0, many ? files.length : 1);
    let last = hint;
    for (const [index, file] of sorted.entries()) {
      const which = sorted.length > 1 ? ` (${index + 1} of ${sorted.length})` : "";
      try {
        const blob = await upload(file, (done, total) => {
          bar.value = total ? done / total : 0;
          say(text, `${file.name}${which}: ${bytes(done)} of ${bytes(total)}`);
        }, mine.signal);
        say(text, `${file.name}${which}: checking ${bytes(blob.size)} …`);
        await take(blob, file);
        last = many ? hint : `${file.name}: ${bytes(blob.size)}`;
      } catch (error) {
        if (isAborted(error)) return;
        status.append(problem(error, sorted.length > 1 ? file.name : null));
        if (!many) last = hint;
      }
    }
    if (mine !== current) return;
    say(text, last);
    bar.hidden = true;
    input.value = "";
  };
  input.addEventListener("change", () => start([...input.files]));
  for (const kind of ["dragenter", "dragover"]) {
    zone.addEventListener(kind, (event) => {
      event.preventDefault();
      zone.classList.add("over");
    });
  }
  for (const kind of ["dragleave", "drop"]) zone.addEventListener(kind, () => zone.classList.remove("over"));
  zone.addEventListener("drop", (event) => {
    event.preventDefault();
    start([...event.dataTransfer.files]);
  });
  /** Shows that no file is held. */
  const clear = () => {
    say(text, hint);
    put(status);
  };
  return { element: h("div", null, zone, status), status, clear };
}

/** An error message with all invalid fields. */
export function problem(error, about = null) {
  const errors = error.errors ?? [];
  const list = errors.length > 1 ? h("ul", null, errors.map((item) => h("li", null, `${item.pointer}: ${item.detail}`))) : null;
  return h("div", { class: "trouble", role: "alert" }, h("b", null, about ? `${about}: ` : "Rejected: "), errors.length > 1 ? null : error.message, list,
    error.code && error.code !== "unknown" && h("p", null, h("a", { href: `/problems/${error.code}`, target: "_blank", rel: "noopener" }, "About this error (new tab)")));
}

const SCALES = [1, 255, 1023, 4095, 16383, 65535];

/**
 * Asks for the full scale if the check rejects or questions it. `again(scale)` repeats the request with the same
 * file.
 */
export function askScale(again, question = "Which stored number means 1, the full light of one frame?") {
  const other = h("input", { type: "number", min: 0, step: "any", "aria-label": "Another full scale", placeholder: "other" });
  const use = h("button", { type: "button", class: "small", onclick: () => Number(other.value) > 0 && again(Number(other.value)) }, "Use");
  return h("div", { class: "askscale", role: "group", "aria-label": "Full scale" }, h("p", null, h("b", null, question)),
    h("div", { class: "row" }, SCALES.map((scale) => h("button", { type: "button", class: "small", onclick: () => again(scale) }, `${scale} means 1`)), other, use));
}

/** Names of the axis orders. */
const ORDERS = { "frame-row-column": "frame, row, column", "row-column-frame": "row, column, frame", "column-row-frame": "column, row, frame", "frame-column-row": "frame, column, row" };

/** Asks for the axis order, among those that the error names as possible. */
function askAxes(error, again) {
  const fit = Object.entries(ORDERS).filter(([name]) => error.message.includes(name));
  return h("div", { class: "askscale", role: "group", "aria-label": "Axes" }, h("p", null, h("b", null, "What is the order of the array's axes?")),
    h("div", { class: "row" }, fit.map(([name, words]) => h("button", { type: "button", class: "small", onclick: () => again(name) }, words))));
}

/** Asks for the array, among those that the error names. */
function askArray(error, again) {
  const names = [...error.message.replace(/^.*it contains/, "").matchAll(/'([^']+)'/g)].map(([, name]) => name);
  return h("div", { class: "askscale", role: "group", "aria-label": "Array" }, h("p", null, h("b", null, "Which array of the file is it?")),
    h("div", { class: "row" }, names.map((name) => h("button", { type: "button", class: "small", onclick: () => again(name) }, name))));
}

/** Asks for the setting that an error calls ambiguous; null if there is none. `again` receives it with those stated before. */
export function askAbout(error, stated, again) {
  if (error.reason === "missing_array" && error.message.includes("it contains '")) return askArray(error, (array) => again({ ...stated, array }));
  if (error.reason === "axes_ambiguous") return askAxes(error, (axes) => again({ ...stated, axes }));
  const scale = ["above_full_scale", "invalid_full_scale"].includes(error.reason) || (error.errors ?? []).some((item) => item.pointer === "/full_scale");
  return scale ? askScale((full_scale) => again({ ...stated, full_scale })) : null;
}
