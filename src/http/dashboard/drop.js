// A place to drop files on, or to choose them by; what is wrong with them is told there.

import { bytes } from "./format.js";
import { gaveUp, upload } from "./api.js";
import { h, put, say } from "./dom.js";

/**
 * A drop zone. Each file is uploaded, and `take(blob, file)` gets what the service keeps of it. With `many`,
 * several files can come at once, and are taken in the order of their names.
 */
export function dropZone(id, title, hint, signal, take, many = false) {
  const input = h("input", { type: "file", id, class: "unseen", multiple: many });
  const text = h("span", { class: "muted" }, hint);
  const bar = h("progress", { max: 1, value: 0, hidden: true, "aria-label": `Upload of the ${title.toLowerCase()}` });
  const status = h("div", { class: "status", "aria-live": "polite" });
  const zone = h("label", { class: "drop", for: id }, h("b", null, title), h("span", null, many ? "Drop files here, or choose them" : "Drop a file here, or choose one"), text, bar, input);
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
        say(text, `${file.name}${which}: ${bytes(blob.size)}, is being checked …`);
        await take(blob, file);
        last = many ? hint : `${file.name}: ${bytes(blob.size)}`;
      } catch (error) {
        if (gaveUp(error)) return;
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
  return { element: h("div", null, zone, status), status };
}

/** A refusal with each field that is wrong. */
export function problem(error, about = null) {
  const errors = error.errors ?? [];
  const list = errors.length > 1 ? h("ul", null, errors.map((item) => h("li", null, `${item.pointer}: ${item.detail}`))) : null;
  return h("div", { class: "trouble", role: "alert" }, h("b", null, about ? `${about}: ` : "Refused: "), errors.length > 1 ? null : error.message, list);
}

const SCALES = [1, 255, 1023, 4095, 16383, 65535];

/**
 * Asks for the full scale with buttons, where the check refuses it or has doubts; the file stays where it is.
 * `again(scale)` makes the thing anew.
 */
export function askScale(again) {
  const other = h("input", { type: "number", min: 0, step: "any", "aria-label": "Another full scale", placeholder: "another" });
  const use = h("button", { type: "button", class: "small", onclick: () => Number(other.value) > 0 && again(Number(other.value)) }, "Use it");
  return h("div", { class: "askscale", role: "group", "aria-label": "Full scale" }, h("p", null, h("b", null, "Which stored number means 1, all light of one frame?")),
    h("div", { class: "row" }, SCALES.map((scale) => h("button", { type: "button", class: "small", onclick: () => again(scale) }, `${scale} means 1`)), other, use));
}

/** The orders of an array's axes, in words. */
const ORDERS = { "frame-row-column": "frame, row, column", "row-column-frame": "row, column, frame", "column-row-frame": "column, row, frame", "frame-column-row": "frame, column, row" };

/** Asks for the order of the axes, of those that a refusal says fit. */
function askAxes(error, again) {
  const fit = Object.entries(ORDERS).filter(([name]) => error.message.includes(name));
  return h("div", { class: "askscale", role: "group", "aria-label": "Axes" }, h("p", null, h("b", null, "In which order are the axes of the array?")),
    h("div", { class: "row" }, fit.map(([name, words]) => h("button", { type: "button", class: "small", onclick: () => again(name) }, words))));
}

/** Asks for what a refusal leaves in doubt, beside what was stated; null where nothing can be stated. `again` gets all of it. */
export function askAbout(error, stated, again) {
  if (error.reason === "axes_ambiguous") return askAxes(error, (axes) => again({ ...stated, axes }));
  const scale = ["above_full_scale", "invalid_full_scale"].includes(error.reason) || (error.errors ?? []).some((item) => item.pointer === "/full_scale");
  return scale ? askScale((full_scale) => again({ ...stated, full_scale })) : null;
}
