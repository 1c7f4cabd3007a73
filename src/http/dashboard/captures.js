// Raw captures of a white board: the role of each file, and the order of the patterns.

import { announce, h, put, say } from "./dom.js";
import { dropZone } from "./drop.js";
import { shade, thumb } from "./thumb.js";

const ROLES = [
  ["pattern", "Next pattern"],
  ["repeat", "Repeat of the previous pattern"],
  ["white", "White without mask"],
  ["black", "Black without mask"],
  ["black_with_mask", "Black with mask"],
  ["unused", "Not used"],
];

/** Role guessed from a file's name. The user sees it and can correct it. */
function proposed(name) {
  const low = name.toLowerCase();
  if (/(black|dark).*mask|mask.*(black|dark)/.test(low)) return "black_with_mask";
  if (/black|dark/.test(low)) return "black";
  if (/white|flat/.test(low)) return "white";
  return "pattern";
}

/** List of captures with their roles; `changed()` is called after each edit. */
export class Captures {
  constructor(signal, changed) {
    Object.assign(this, { items: [], changed });
    this.list = h("ol", { class: "captures", "aria-label": "Captures, in order" });
    this.summary = h("p", { class: "muted below", "aria-live": "polite" });
    this.drop = dropZone("captures", "Raw captures", "Drop all files together: one per pattern, plus white and black. A file may hold several repeats.", signal, async (blob, file) => {
      const item = { sha256: blob.sha256, name: file.name, role: proposed(file.name), picture: await thumb(file) };
      // Patterns come first, because the user has to check their order.
      const others = this.items.findIndex((other) => !["pattern", "repeat"].includes(other.role));
      this.items.splice(item.role === "pattern" && others >= 0 ? others : this.items.length, 0, item);
      this.show();
    }, true);
    this.element = h("div", null, this.drop.element, this.summary, this.list);
  }

  of(role) {
    return this.items.filter((item) => item.role === role).map((item) => item.sha256);
  }

  /** Each pattern with its repeats. */
  patterns() {
    const found = [];
    for (const { role, sha256 } of this.items) {
      if (role === "pattern") found.push([sha256]);
      else if (role === "repeat") found.at(-1)?.push(sha256);
    }
    return found;
  }

  /** Names of the missing captures; null if the set is complete. */
  missing() {
    const lacks = [this.patterns().length === 0 && "at least one pattern", this.of("white").length === 0 && "a white capture", this.of("black").length === 0 && "a black capture"].filter(Boolean);
    return lacks.length ? lacks.join(", ") : null;
  }

  value() {
    const [black, masked] = [this.of("black"), this.of("black_with_mask")];
    return { masks: this.patterns(), white: this.of("white"), black, ...(masked.length ? { black_with_mask: masked } : {}) };
  }

  show() {
    shade(this.items.map((item) => item.picture).filter(Boolean));
    let number = 0;
    put(this.list, this.items.map((item, index) => {
      if (item.role === "pattern") number += 1;
      return this.line(item, index, item.role === "pattern" ? number : null);
    }));
    const missing = this.missing();
    say(this.summary, this.items.length === 0 ? "" : missing ? `Still missing: ${missing}.` : `${number} patterns. Check their order: the first is frame 1.`);
    this.changed();
  }

  line(item, index, number) {
    const role = h("select", { "aria-label": `Role of ${item.name}`, onchange: () => {
      item.role = role.value;
      this.show();
    } }, ROLES.map(([value, text]) => h("option", { value, selected: value === item.role }, text)));
    const move = (by, label, sign) => h("button", { type: "button", class: "small", "aria-label": `${label}: ${item.name}`, disabled: !this.items[index + by], onclick: () => this.move(index, index + by) }, sign);
    const element = h("li", { draggable: "true", class: `capture ${item.role}` },
      h("span", { class: "number" }, number ?? ""), item.picture?.canvas ?? h("span", { class: "blank" }), h("span", { class: "filename" }, item.name), role,
      h("span", { class: "row" }, move(-1, "Up", "↑"), move(1, "Down", "↓"), h("button", { type: "button", class: "small", "aria-label": `Remove ${item.name}`, onclick: () => {
        this.items.splice(index, 1);
        this.show();
      } }, "×")));
    element.addEventListener("dragstart", (event) => {
      event.dataTransfer.setData("text/plain", String(index));
      event.dataTransfer.effectAllowed = "move";
    });
    element.addEventListener("dragover", (event) => event.preventDefault());
    element.addEventListener("drop", (event) => {
      event.preventDefault();
      // Only entries of the list are moved here; files are dropped above.
      const from = event.dataTransfer.getData("text/plain");
      if (from !== "") this.move(Number(from), index);
    });
    return element;
  }

  move(from, to) {
    const [item] = this.items.splice(from, 1);
    this.items.splice(to, 0, item);
    announce(`${item.name} is now number ${to + 1}`);
    this.show();
    this.list.children[to]?.querySelector("button:not(:disabled)")?.focus();
  }
}
