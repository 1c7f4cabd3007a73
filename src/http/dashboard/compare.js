// Two jobs side by side: the same place, the same frame, the same contrast; or in turn in one pane.

import { Contrast } from "./contrast.js";
import { Pane } from "./pane.js";
import { Player } from "./player.js";
import { View } from "./view.js";
import { announce, h, say } from "./dom.js";
import { duration, figure, nameOf, shapeOf } from "./format.js";
import { get } from "./api.js";

export async function compare(root, [first, second], signal) {
  const jobs = await Promise.all([first, second].map((id) => get(`/v1/jobs/${id}`, signal)));
  root.append(h("h1", null, "Two jobs"));
  const same = ["frames", "height", "width"].every((axis) => jobs[0].shape[axis] === jobs[1].shape[axis]);
  const manifests = await Promise.all(jobs.map((job) => manifest(job, signal)));
  if (!same) {
    root.append(h("p", { class: "trouble" }, `They can't be laid side by side: their frames are ${jobs.map(shapeOf).join(" and ")}.`));
  } else if (manifests.every(Boolean)) {
    const pair = new Pair(jobs, signal);
    root.append(pair.element);
    await pair.open();
  } else {
    root.append(h("p", { class: "note" }, "Both jobs must have succeeded before their frames can be compared."));
  }
  root.append(figures(jobs, manifests));
}

async function manifest(job, signal) {
  if (job.state !== "succeeded") return null;
  return get(`/v1/jobs/${job.id}/snapshots/${job.snapshots.first}/manifest.json`, signal);
}

/** Two panes in step, and one in which the two take turns. */
class Pair {
  constructor(jobs, signal) {
    const { frames, height, width } = jobs[0].shape;
    Object.assign(this, { jobs, signal, turn: 0, flickering: false });
    this.view = new View(height, width);
    this.panes = jobs.map((job) => new Pane(nameOf(job), this.view, signal));
    this.contrast = new Contrast("frames", () => this.show());
    this.player = new Player(frames, signal, () => this.show());
    this.player.ahead = (frame) => this.panes.every((pane, index) => pane.prepare(this.source(index, frame), ...this.contrast.window()));
    this.rate = h("input", { type: "number", id: "flicker-rate", min: 0.2, max: 20, step: "any", value: 2 });
    this.button = h("button", { type: "button", id: "flicker", "aria-pressed": "false", onclick: () => this.flicker() }, "Flicker");
    this.panels = h("div", { class: "panes" }, this.panes.map((pane) => pane.element));
    this.element = h("section", { class: "card viewer", "aria-label": "Frames of both jobs" }, this.panels, this.contrast.element,
      h("div", { class: "row controls" }, this.player.element,
        h("div", { class: "row" }, this.button, h("label", { for: "flicker-rate", class: "row muted" }, this.rate, "changes/s"),
          h("button", { type: "button", class: "small", onclick: () => this.view.fit() }, "Fit"))),
      h("p", { class: "muted keys" }, "Keys on a picture: space plays, ← → step, + − 0 1 zoom, shift and arrows move."));
    this.player.keys(this.element);
    signal.addEventListener("abort", () => clearTimeout(this.timer), { once: true });
  }

  base(index, frame) {
    const job = this.jobs[index];
    return `/v1/jobs/${job.id}/snapshots/${job.snapshots.first}/pictures/frame-${frame}`;
  }

  source(index, frame) {
    const { levels, tile } = this.spread;
    return { base: this.base(index, frame), levels, tile, label: `Frame ${frame} of ${nameOf(this.jobs[index])}` };
  }

  async open() {
    const middle = Math.ceil(this.player.count / 2);
    const [one, other] = await Promise.all([0, 1].map((index) => get(`${this.base(index, middle)}/spread`, this.signal)));
    // One window for both: a difference of brightness should show.
    this.spread = {
      ...one,
      minimum: Math.min(one.minimum, other.minimum), maximum: Math.max(one.maximum, other.maximum),
      low: Math.min(one.low, other.low), high: Math.max(one.high, other.high),
    };
    this.contrast.offer(this.spread);
    this.show();
  }

  show() {
    const { frame } = this.player;
    this.panes.forEach((pane, index) => {
      const which = this.flickering ? this.turn : index;
      if (this.flickering && index === 1) return;
      pane.show(this.source(which, frame), ...this.contrast.window());
      say(pane.title, nameOf(this.jobs[which]));
    });
  }

  flicker() {
    this.flickering = !this.flickering;
    this.turn = 0;
    this.button.setAttribute("aria-pressed", String(this.flickering));
    this.panels.classList.toggle("one", this.flickering);
    this.panes[1].element.hidden = this.flickering;
    announce(this.flickering ? "The two take turns in one pane" : "Side by side");
    clearTimeout(this.timer);
    if (this.flickering) this.next();
    this.show();
  }

  next() {
    this.timer = setTimeout(() => {
      const other = 1 - this.turn;
      // The other one is shown when it is here, so that nothing but the pictures changes.
      if (this.panes[0].prepare(this.source(other, this.player.frame), ...this.contrast.window())) {
        this.turn = other;
        this.show();
      }
      this.next();
    }, 1000 / Math.min(20, Math.max(0.2, Number(this.rate.value) || 2)));
  }
}

/** What the two jobs were and what came of them. */
function figures(jobs, manifests) {
  const row = (name, value) => h("tr", null, h("th", { scope: "row" }, name), jobs.map((job, index) => h("td", null, value(job, manifests[index]) ?? "–")));
  const names = new Set(manifests.flatMap((found) => Object.entries(found?.content.quality ?? {}).filter(([, value]) => typeof value === "number").map(([name]) => name)));
  const quality = [...names].map((name) => row(name.toUpperCase(), (_, found) => figure(found?.content.quality?.[name], 4)));
  const body = h("tbody", null,
    row("State", (job) => h("span", { class: `badge ${job.state}` }, job.state)),
    row("Algorithm", (job) => job.algorithm),
    row("Schedule", (job) => job.schedule.stages.map((stage) => `${stage.iterations} × ${stage.prior}`).join(", then ")),
    row("Tiles", (job) => `${job.tile.size} pixels, ${job.tile.overlap} shared`),
    row("Residual ‖y − Hx‖ / ‖y‖", (_, found) => found && figure(found.content.summary.residual)),
    row("Iterations", (_, found) => found && `${found.content.summary.tv_iterations} with TV, ${found.content.summary.denoiser_passes} deep`),
    row("Ended", (_, found) => found && (found.content.summary.stop_reason === "converged" ? "converged" : "all planned iterations done")),
    row("Computing", (_, found) => found && duration(found.run.cpu_seconds)),
    row("Network", (_, found) => found?.content.model?.name),
    quality);
  const head = h("thead", null, h("tr", null, h("td"), jobs.map((job) => h("th", { scope: "col" }, h("a", { href: `#/jobs/${job.id}` }, nameOf(job))))));
  const note = quality.length === 0 && h("p", { class: "muted" }, "PSNR and SSIM are shown for jobs whose manifest has them, which needs the true frames.");
  return h("section", { class: "card", "aria-label": "Figures" }, h("h2", null, "Figures"), h("div", { class: "wide", tabindex: 0, role: "region", "aria-label": "Figures of both jobs" }, h("table", { class: "figures" }, head, body)), note);
}
