// Drop zone for files, which shows the errors of the files below it.

import { bytes } from "./format.js";
import { isAborted, upload } from "./api.js";
import { about, h, marked, put, say } from "./dom.js";

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
export function problem(error, file = null) {
  const errors = error.errors ?? [];
  const list = errors.length > 1 ? h("ul", null, errors.map((item) => h("li", null, `${item.pointer}: `, marked(item.detail)))) : null;
  return h("div", { class: "trouble", role: "alert" }, h("b", null, file ? `${file}: ` : "Rejected: "), errors.length > 1 ? null : marked(error.message), list,
    h("p", null, about(error)));
}
