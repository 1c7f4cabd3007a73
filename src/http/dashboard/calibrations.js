// Calibrations: what is known of the masks, and how they look.

import { Contrast } from "./contrast.js";
import { Pane } from "./pane.js";
import { View } from "./view.js";
import { announce, facts, h, say } from "./dom.js";
import { ask, tell } from "./actions.js";
import { figure, moment, momentInFull, nameOf } from "./format.js";
import { get, send } from "./api.js";

export async function calibrations(root, _, signal) {
  const body = h("tbody");
  const more = h("button", { type: "button", hidden: true }, "More");
  let cursor = null;
  const load = async () => {
    const page = await get(`/v1/calibrations?limit=100${cursor ? `&cursor=${cursor}` : ""}`, signal);
    body.append(...page.items.map(line));
    cursor = page.next_cursor;
    more.hidden = cursor === null;
    return page.items.length;
  };
  more.addEventListener("click", load);
  const heads = ["Name", "Masks", "Mean", "Dead pixels", "File", "Made"].map((name) => h("th", { scope: "col" }, name));
  const list = h("div", { class: "wide card", tabindex: 0, role: "region", "aria-label": "Calibrations" }, h("table", null, h("thead", null, h("tr", null, heads)), body), more);
  root.append(h("h1", null, "Calibrations"));
  const count = await load();
  root.append(count ? list : h("p", { class: "note" }, "There are none yet. A ", h("a", { href: "#/new" }, "new job"), " begins with one."));
}

function line(item) {
  const name = h("th", { scope: "row" }, h("a", { href: `#/calibrations/${item.id}` }, nameOf(item)));
  if (item.state !== "ready") {
    return h("tr", null, name, h("td", { colspan: 4 }, ...unready(item)),
      h("td", { title: momentInFull(item.created_at) }, moment(item.created_at)));
  }
  return h("tr", null,
    name,
    h("td", null, `${item.frames} × ${item.height} × ${item.width}`),
    h("td", null, figure(item.mask_mean)),
    h("td", null, item.dead_pixels),
    h("td", null, `${item.sample}, ${item.format}`),
    h("td", { title: momentInFull(item.created_at) }, moment(item.created_at)));
}

/** What is to be said of a calibration whose masks are not there. */
function unready(item) {
  if (item.state === "failed") return [h("span", { class: "warn" }, `No masks: ${item.error}`)];
  return [`Masks are being made of ${item.frames} patterns: ${item.percent} %`];
}

export async function calibration(root, [id], signal) {
  const item = await get(`/v1/calibrations/${id}`, signal);
  document.title = `${nameOf(item)} – sci-recon`;
  const remove = h("button", { type: "button", class: "delete" }, "Delete");
  remove.addEventListener("click", () => erase(item));
  if (item.state !== "ready") {
    root.append(h("div", { class: "row head" }, h("h1", null, nameOf(item)), h("span", { class: "grow" }), remove), h("p", null, ...unready(item)));
    return;
  }
  const masks = new Masks(item, signal);
  root.append(
    h("div", { class: "row head" }, h("h1", null, nameOf(item)), h("span", { class: "grow" }),
      h("a", { class: "button", href: `/v1/calibrations/${id}/report.html` }, "Report"),
      h("a", { class: "button", href: `#/new?calibration=${id}` }, "Use for a new job"), remove),
    masks.element, h("div", { class: "cards" }, about(item)));
  await masks.show();
}

async function erase(item) {
  const text = ["The calibration ", h("b", null, nameOf(item)), " will be gone. Only one that no measurement refers to can be deleted."];
  if (!(await ask("Delete this calibration?", text, "Delete"))) return;
  try {
    await send("DELETE", `/v1/calibrations/${item.id}`);
    announce("The calibration is deleted");
    location.hash = "#/calibrations";
  } catch (error) {
    await tell("Not possible", error.message);
  }
}

function about(item) {
  const pixels = item.height * item.width;
  return h("section", { class: "card", "aria-label": "Figures" }, h("h2", null, "Figures"), facts([
    ["Masks (compression ratio)", item.frames],
    ["Size", `${item.height} × ${item.width} (rows × columns)`],
    ["Mean transmission", figure(item.mask_mean)],
    ["Dead pixels", `${item.dead_pixels} (${figure((100 * item.dead_pixels) / pixels, 2)} %)`],
    ["Values below 0, set to 0", item.clipped_negatives],
    ["Full scale", figure(item.full_scale)],
    ["File", `${item.sample} in ${item.format}`],
    ["SHA-256 of the file", h("code", null, item.masks)],
    ["Identifier", h("code", null, item.id)],
    ["Made", momentInFull(item.created_at)],
  ]));
}

/** The masks one by one, their mean, the gram diagonal and the dead pixels. */
class Masks {
  constructor(item, signal) {
    Object.assign(this, { item, signal });
    this.view = new View(item.height, item.width);
    this.pane = new Pane("Masks", this.view, signal);
    this.contrast = new Contrast("masks", () => this.draw());
    const whole = [["mean", "Mean of all masks"], ["gram", "Gram diagonal: sum of squares"], ["dead", "Dead pixels (white)"]];
    this.choice = h("select", { id: "picture", "aria-label": "Picture" }, h("option", { value: "mask" }, "Masks one by one"), whole.map(([value, text]) => h("option", { value }, text)));
    this.slider = h("input", { type: "range", id: "mask", min: 1, max: item.frames, value: 1, "aria-label": "Mask" });
    this.number = h("output", { for: "mask", class: "count" });
    this.row = h("div", { class: "row player" }, h("label", { for: "mask" }, "Mask"), this.slider, this.number);
    this.choice.addEventListener("change", () => {
      this.contrast.touched = false;
      this.show();
    });
    this.slider.addEventListener("input", () => this.show());
    this.pane.tools.append(this.choice);
    this.element = h("section", { class: "card viewer", "aria-label": "Masks" }, this.pane.element, this.contrast.element, this.row,
      h("p", { class: "muted keys" }, "Keys on the picture: + − 0 1 zoom, shift and arrows move. The wheel zooms, dragging moves."));
  }

  name() {
    return this.choice.value === "mask" ? `mask-${this.slider.value}` : this.choice.value;
  }

  async show() {
    this.row.hidden = this.choice.value !== "mask";
    say(this.number, `${this.slider.value} / ${this.item.frames}`);
    const base = `/v1/calibrations/${this.item.id}/pictures/${this.name()}`;
    this.spread = await get(`${base}/spread`, this.signal);
    this.contrast.offer(this.spread);
    this.draw();
  }

  draw() {
    const { levels, tile } = this.spread;
    const base = `/v1/calibrations/${this.item.id}/pictures/${this.name()}`;
    this.pane.show({ base, levels, tile, label: this.choice.selectedOptions[0].textContent }, ...this.contrast.window());
  }
}
