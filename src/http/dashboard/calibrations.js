// Calibrations: the list, and one calibration with its masks, report and figures.

import { Contrast } from "./contrast.js";
import { Pane } from "./pane.js";
import { Player, keysHelp } from "./player.js";
import { View } from "./view.js";
import { announce, explained, facts, h, place, put, trouble } from "./dom.js";
import { ask, rename, showMessage } from "./actions.js";
import { every } from "./live.js";
import { exact, figure, moment, momentInFull, nameOf } from "./format.js";
import { get, send } from "./api.js";
import { grade, report } from "./report.js";
import { menu } from "./menu.js";
import { sampled } from "./values.js";

export async function calibrations(root, _, signal) {
  const list = h("ul", { class: "tiling" });
  const more = h("button", { type: "button", hidden: true }, "More");
  let cursor = null;
  const load = async () => {
    const page = await get(`/v1/calibrations?limit=50${cursor ? `&cursor=${cursor}` : ""}`, signal);
    list.append(...page.items.map((item) => h("li", null, tile(item, signal))));
    cursor = page.next_cursor;
    more.hidden = cursor === null;
    return page.items.length;
  };
  more.addEventListener("click", load);
  const count = await load();
  root.append(h("div", { class: "row head" }, h("h1", null, "Calibrations"), h("span", { class: "grow" }), h("a", { class: "button primary writes", href: "#/new" }, "New calibration")));
  root.append(count ? h("section", { "aria-label": "Calibrations" }, list, more) : h("p", { class: "muted" }, "No calibrations yet. A calibration holds the masks of one setting of the camera. Upload masks, or captures of a white board, with a ", h("a", { href: "#/new" }, "new job"), "."));
}

/** A card with a mask, name and grade. */
function tile(item, signal) {
  return h("a", { class: "card calibration", href: `#/calibrations/${item.id}` }, ...glance(item, signal));
}

/** Image, name, size and grade of a calibration. */
export function glance(item, signal) {
  const ready = item.state === "ready";
  const blank = () => h("span", { class: "blank" });
  const image = ready && h("img", { src: place(`/view/calibrations/${item.id}/pictures/mask-1?size=128`), alt: "", loading: "lazy", width: 72, height: 72 });
  // The stored masks may be damaged.
  if (image) image.addEventListener("error", () => image.replaceWith(blank()));
  return [
    image || blank(),
    h("span", { class: "about" }, h("b", null, nameOf(item)),
      ready ? h("span", { class: "muted" }, `${item.frames} ${item.frames === 1 ? "mask" : "masks"} of ${item.height} × ${item.width}${item.dispersion ? ", spectral" : ""}`) : h("span", { class: item.state === "failed" ? "warn brief" : "muted" }, unready(item)),
      ready && grade(item.id, signal), h("time", { class: "muted", datetime: item.created_at, title: momentInFull(item.created_at) }, moment(item.created_at))),
  ];
}

/** State of a calibration that has no masks yet. */
function unready(item) {
  if (item.state === "failed") return `No masks: ${item.error}`;
  if (item.frames === null) return "The masks are being checked";
  return `Computing masks from ${item.frames} patterns: ${Math.floor(item.percent)} %`;
}

export async function calibration(root, [id], signal) {
  const body = h("div");
  const title = h("h1");
  const buttons = h("span", { class: "row writes" });
  root.append(h("p", { class: "back" }, h("a", { href: "#/calibrations" }, "← All calibrations")), h("div", { class: "row head" }, title, h("span", { class: "grow" }), buttons), body);
  const call = (item) => {
    put(title, nameOf(item));
    document.title = `${nameOf(item)} – sci-recon`;
  };
  const show = async (item) => {
    call(item);
    put(buttons,
      item.state === "ready" && h("a", { class: "button primary", href: `#/new?calibration=${id}` }, "Use for a new job"),
      menu(`More actions for ${nameOf(item)}`, [h("button", { type: "button", class: "small", onclick: () => rename(item.name, async (name) => {
        Object.assign(item, await send("PATCH", `/v1/calibrations/${id}`, { name }));
        call(item);
      }) }, "Rename"), h("button", { type: "button", class: "small delete", onclick: () => erase(item) }, "Delete")]));
    if (item.state !== "ready") {
      const failed = item.state === "failed";
      put(body, failed ? trouble({ message: unready(item), code: item.problem?.code }) : h("p", { class: "note" }, unready(item)), failed && h("p", null, h("a", { href: "#/new" }, "Create another calibration")));
      return;
    }
    const masks = new Masks(item, signal);
    put(body, h("div", { class: "stage" }, h("div", { class: "side" }, report(item, signal)), masks.element), h("div", { class: "cards" }, about(item)));
    await masks.show();
  };
  const first = await get(`/v1/calibrations/${id}`, signal);
  await show(first);
  if (first.state !== "preparing") return;
  // Poll until the masks are ready.
  const done = new AbortController();
  signal.addEventListener("abort", () => done.abort());
  every(1000, async () => {
    const item = await get(`/v1/calibrations/${id}`, signal);
    await show(item);
    if (item.state !== "preparing") done.abort();
  }, done.signal);
}

async function erase(item) {
  const text = ["The calibration ", h("b", null, nameOf(item)), " will be deleted. This is possible only if no measurement refers to it."];
  if (!(await ask("Delete this calibration?", text, "Delete"))) return;
  try {
    await send("DELETE", `/v1/calibrations/${item.id}`);
    announce("Calibration deleted");
    location.hash = "#/calibrations";
  } catch (error) {
    await showMessage("Could not delete the calibration", explained(error));
  }
}

function about(item) {
  const pixels = item.height * item.width;
  return h("section", { class: "card", "aria-label": "Figures" }, h("h2", null, "Figures"), facts([
    ["Masks (compression ratio)", item.frames],
    ["Size", `${item.height} × ${item.width} (rows × columns)`],
    ["Sensor", item.mosaic ? `in colour, ${item.mosaic.toUpperCase()}` : "grey"],
    item.dispersion && ["Dispersion", `one mask for ${item.dispersion.offsets.length} bands, displaced by up to ${figure(Math.max(...item.dispersion.offsets))} pixels ${item.dispersion.axis === "column" ? "to the right" : "downwards"}`],
    ["Mean transmission", figure(item.mask_mean)],
    ["Dead pixels", `${item.dead_pixels} (${figure((100 * item.dead_pixels) / pixels, 2)} %)`],
    ["Values below 0, set to 0", item.clipped_negatives],
    ["Full scale", exact(item.full_scale)],
    ["File", `${item.sample} in ${item.format}`],
    ["SHA-256 of the file", h("code", null, item.masks)],
    item.bad_pixels && ["SHA-256 of the map of bad pixels", h("code", null, item.bad_pixels)],
    item.registration_of && ["Corrected by the job", h("a", { href: `#/jobs/${item.registration_of}` }, item.registration_of)],
    ["Identifier", h("code", null, item.id)],
    ["Created", momentInFull(item.created_at)],
  ]));
}

const WHOLE = [["mean", "Mean of all masks"], ["gram", "Gram diagonal (sum of squares)"], ["dead", "Dead pixels (white)"]];

/** Viewer of the masks, their mean, the Gram diagonal and the dead pixels. */
class Masks {
  constructor(item, signal) {
    Object.assign(this, { item, signal });
    this.view = new View(item.height, item.width);
    this.pane = new Pane("Masks", this.view, signal);
    this.contrast = new Contrast("masks", () => this.draw());
    this.choice = h("select", { id: "picture", "aria-label": "Picture" }, h("option", { value: "mask" }, "Single masks"), WHOLE.map(([value, text]) => h("option", { value }, text)));
    this.player = new Player(item.frames, signal, () => this.draw());
    this.player.ahead = (frame) => this.pane.prepare(this.source(`mask-${frame}`), ...this.contrast.window());
    this.choice.addEventListener("change", () => {
      this.contrast.touched = false;
      this.player.stop();
      this.show();
    });
    this.pane.tools.append(this.choice, h("button", { type: "button", class: "small", onclick: () => this.view.fit() }, "Fit"));
    this.element = h("section", { class: "card viewer", "aria-label": "Masks" }, this.pane.element, this.player.element, this.contrast.element,
      keysHelp("The wheel zooms; dragging moves."));
    this.player.keys(this.element);
  }

  source(name) {
    const { levels, tile } = this.spread;
    return { base: `/view/calibrations/${this.item.id}/pictures/${name}`, levels, tile, label: this.choice.selectedOptions[0].textContent };
  }

  /** Loads the range of values; that of the first mask holds for all masks. */
  async show() {
    const one = this.choice.value === "mask";
    this.player.element.hidden = !one;
    this.spread = await get(`/view/calibrations/${this.item.id}/pictures/${one ? "mask-1" : this.choice.value}/spread`, this.signal);
    this.contrast.offer(this.spread);
    this.draw();
    const { base } = this.source(one ? "mask-1" : this.choice.value);
    sampled({ base, ...this.spread }).then((values) => this.contrast.distribution(values)).catch(() => {});
  }

  draw() {
    const name = this.choice.value === "mask" ? `mask-${this.player.frame}` : this.choice.value;
    this.pane.show(this.source(name), ...this.contrast.window());
  }
}
