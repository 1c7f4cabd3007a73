// Comparison of two to four jobs with synchronised place, frame and contrast: side by side, as a wipe, as a
// difference or alternating. A table lists the differences first.

import { Contrast } from "./contrast.js";
import { Pane } from "./pane.js";
import { Player, keysHelp } from "./player.js";
import { View } from "./view.js";
import { announce, explained, h, put, say } from "./dom.js";
import { bytes, decibels, duration, expectedRange, figure, frameName, iterationsOf, nameOf, shapeOf, stateWord, unitOf, valueIn, wavelengthsOf } from "./format.js";
import { isAborted, get, send, upload } from "./api.js";
import { networks, ran } from "./provenance.js";
import { sampled } from "./values.js";

export async function compare(root, [path], signal) {
  const ids = path.split("/");
  const jobs = await Promise.all(ids.map((id) => get(`/v1/jobs/${id}`, signal)));
  root.append(h("p", { class: "back" }, h("a", { href: "#/jobs" }, "← All jobs")), h("h1", null, `${jobs.length} jobs compared`));
  const same = ["frames", "height", "width"].every((axis) => jobs.every((job) => job.shape[axis] === jobs[0].shape[axis]));
  const manifests = await Promise.all(jobs.map((job) => manifest(job, signal)));
  const all = manifests.every(Boolean);
  if (!same) {
    root.append(h("p", { class: "trouble" }, `These jobs can't be compared frame by frame: their frames are ${jobs.map(shapeOf).join(" and ")}. `, h("a", { href: "#/jobs" }, "Select other jobs")));
  } else if (all) {
    const group = new Group(jobs, signal);
    root.append(group.element);
    await group.open();
  } else {
    root.append(h("p", { class: "muted" }, "The frames can be compared when all jobs have succeeded."));
  }
  const table = h("div");
  root.append(h("section", { class: "card", "aria-label": "Figures" }, h("h2", null, "Figures"), table, all && truth(jobs, manifests, table, signal)));
  put(table, figures(jobs, manifests));
}

/** PSNR and SSIM of all jobs against true frames, which are attached to the jobs here or were earlier. */
function truth(jobs, manifests, table, signal) {
  const input = h("input", { type: "file", id: "truth", class: "unseen" });
  const status = h("span", { class: "muted", "aria-live": "polite" }, "npy, TIFF or .mat, in the scale of the frames");
  const measure = async (truths) => {
    say(status, "Comparing the frames …");
    const found = await Promise.all(jobs.map((job, index) => get(`/v1/jobs/${job.id}/snapshots/${job.snapshots.first}/quality?truth=${truths[index]}`, signal)));
    put(table, figures(jobs, manifests, found));
    say(status, "Measured against the true frames of the jobs.");
  };
  const showError = (error) => isAborted(error) || put(status, h("span", { class: "warn" }, explained(error)));
  input.addEventListener("change", async () => {
    const file = input.files[0];
    if (!file) return;
    try {
      const { sha256 } = await upload(file, (done, total) => say(status, `${bytes(done)} of ${bytes(total)}`), signal);
      await measure(jobs.map(() => sha256));
      await Promise.all(jobs.map((job) => send("PATCH", `/v1/jobs/${job.id}`, { truth: sha256 })));
    } catch (error) {
      showError(error);
    }
  });
  const first = jobs.find((job) => job.truth);
  // True frames of one scene are meaningless for another.
  const truths = jobs.map((job) => job.truth ?? (job.measurement === first?.measurement ? first.truth : null));
  if (truths.every(Boolean)) measure(truths).catch(showError);
  return h("div", { class: "row below" }, h("label", { for: "truth", class: "button small filebutton writes" }, "Attach true frames", input), status);
}

async function manifest(job, signal) {
  if (job.state !== "succeeded") return null;
  return get(`/v1/jobs/${job.id}/snapshots/${job.snapshots.first}/exports/manifest`, signal);
}

/** Largest ratio of the white levels of jobs that share one contrast. */
const MAX_RATIO = 1.5;
const MODES = [["beside", "Side by side"], ["wipe", "Wipe"], ["difference", "Difference"], ["flicker", "Alternate"]];

/** Synchronised panes. The first one can also show a pair of jobs. */
class Group {
  constructor(jobs, signal) {
    const { frames, height, width } = jobs[0].shape;
    Object.assign(this, { jobs, signal, turn: 0, mode: "beside" });
    this.view = new View(height, width);
    this.panes = jobs.map((job) => new Pane(nameOf(job), this.view, signal));
    this.contrasts = jobs.map((job) => new Contrast(nameOf(job), (from) => this.adjust(from), nameOf(job)));
    this.match = h("input", { type: "checkbox", id: "match", onchange: () => this.rescale() });
    this.scales = h("span", { class: "muted" });
    // Bands of one number can have different wavelengths in the jobs; each pane names its own.
    this.alike = new Set(jobs.map(({ dispersion }) => JSON.stringify(dispersion && (dispersion.wavelengths ?? [])))).size === 1;
    const spectral = jobs.every((job) => job.dispersion);
    this.player = new Player(frames, signal, () => this.show(), spectral ? (frame) => (this.alike ? frameName(jobs[0], frame) : `band ${frame}`) : undefined);
    this.player.ahead = (frame) => this.panes.every((pane, index) => pane.prepare(this.source(index, frame), ...this.contrasts[index].window()));
    this.modes = MODES.map(([value, text]) => h("button", { type: "button", id: value, "aria-pressed": String(value === this.mode), onclick: () => this.choose(value) }, text));
    const pick = (id, label, chosen) => {
      const select = h("select", { id, "aria-label": label, onchange: () => this.show() }, jobs.map((job, index) => h("option", { value: index, selected: index === chosen }, nameOf(job))));
      return select;
    };
    [this.one, this.other] = [pick("one", "Left or first job", 0), pick("other", "Right or second job", 1)];
    this.wipe = h("input", { type: "range", id: "wipe-at", min: 0, max: 1000, value: 500, "aria-label": "Position of the wipe", oninput: () => this.show() });
    this.gain = h("select", { id: "gain", "aria-label": "Brightness of the difference", onchange: () => this.show() }, [1, 2, 4, 8, 16].map((by) => h("option", { value: by, selected: by === 4 }, `× ${by}`)));
    this.rate = h("input", { type: "number", id: "flicker-rate", min: 0.2, max: 20, step: "any", value: 2 });
    this.rateLabel = h("label", { for: "flicker-rate", class: "row muted" }, this.rate, "changes/s");
    this.pairing = h("span", { class: "row" }, this.one, h("span", { class: "muted" }, "and"), this.other);
    this.panels = h("div", { class: `panes of${jobs.length}` }, this.panes.map((pane) => pane.element));
    this.element = h("section", { class: "card viewer", "aria-label": "Frames of the jobs" },
      h("div", { class: "row", role: "group", "aria-label": "Mode of comparison" }, this.modes, this.pairing, this.wipe, this.gain, this.rateLabel,
        h("span", { class: "grow" }), h("button", { type: "button", class: "small", onclick: () => this.view.fit() }, "Fit")),
      this.panels, this.player.element,
      h("div", { class: "row matching" }, h("label", { for: "match", class: "row" }, this.match, "Own contrast for each job"), this.scales),
      h("div", { class: `panes of${jobs.length} contrasts` }, this.contrasts.map((contrast) => contrast.element)),
      keysHelp("Drag the line of the wipe, or use its slider."));
    this.player.keys(this.element);
    this.drag();
    signal.addEventListener("abort", () => clearTimeout(this.timer), { once: true });
  }

  /** Lets the line of the wipe be dragged. */
  drag() {
    const { sight } = this.panes[0];
    const handle = h("div", { class: "handle", "aria-hidden": "true" });
    sight.append(handle);
    this.handle = handle;
    const move = (event) => {
      const box = sight.getBoundingClientRect();
      this.wipe.value = Math.round(1000 * Math.min(1, Math.max(0, (event.clientX - box.left) / box.width)));
      this.show();
    };
    handle.addEventListener("pointerdown", (event) => {
      handle.setPointerCapture(event.pointerId);
      handle.addEventListener("pointermove", move);
    });
    for (const kind of ["pointerup", "pointercancel"]) handle.addEventListener(kind, () => handle.removeEventListener("pointermove", move));
  }

  base(index, frame) {
    const job = this.jobs[index];
    return `/view/jobs/${job.id}/snapshots/${job.snapshots.first}/pictures/frame-${frame}`;
  }

  source(index, frame) {
    const { levels, tile } = this.spreads[index];
    return { base: this.base(index, frame), levels, tile, label: `${frameName(this.jobs[index], frame)} of ${nameOf(this.jobs[index])}` };
  }

  /** The name of a job, with the band that is shown if the jobs have different wavelengths. */
  titleOf(index) {
    const job = this.jobs[index];
    return this.alike ? nameOf(job) : `${nameOf(job)}, ${frameName(job, this.player.frame)}`;
  }

  async open() {
    const middle = Math.ceil(this.player.count / 2);
    const [spreads, unit] = await Promise.all([Promise.all(this.jobs.map((_, index) => get(`${this.base(index, middle)}/spread`, this.signal))), this.unit()]);
    this.spreads = spreads;
    for (const contrast of this.contrasts) contrast.measure(unit);
    for (const pane of this.panes) pane.describe = (value) => valueIn(value, unit);
    // A job with another scale would be black next to the others, or white.
    const whites = spreads.map(({ high }) => Math.max(high, 1e-9));
    this.ratio = Math.max(...whites) / Math.min(...whites);
    this.match.checked = this.ratio > MAX_RATIO;
    spreads.forEach((spread, index) => sampled({ base: this.base(index, middle), ...spread }).then((values) => this.contrasts[index].distribution(values)).catch(() => {}));
    this.rescale();
    this.choose("beside");
  }

  /** The unit of all values: counts, if the measurements have one full scale. */
  async unit() {
    const measurements = await Promise.all(this.jobs.map(({ measurement }) => get(`/v1/measurements/${measurement}`, this.signal)));
    const scales = new Set(measurements.map(({ full_scale: scale }) => scale));
    return unitOf(scales.size === 1 ? [...scales][0] : 1);
  }

  /** Gives each job its own contrast, or all the same one. */
  rescale() {
    const { spreads, ratio } = this;
    say(this.scales, !this.match.checked ? "All jobs share one contrast, so that differences in brightness are visible."
      : ratio > MAX_RATIO ? `The brightest frames are ${figure(ratio, 2)} times as bright as the darkest.` : "Differences in brightness between the jobs are not visible.");
    const least = (name) => Math.min(...spreads.map((spread) => spread[name]));
    const most = (name) => Math.max(...spreads.map((spread) => spread[name]));
    const shared = { low: least("low"), high: most("high") };
    this.contrasts.forEach((contrast, index) => {
      const range = this.match.checked ? {} : { minimum: least("minimum"), maximum: most("maximum") };
      contrast.offer({ ...spreads[index], ...range });
      const { low, high } = this.match.checked ? spreads[index] : shared;
      contrast.set(low, high > low ? high : low + 1);
    });
    if (this.modes) this.show();
  }

  /** Takes a change of one contrast to the others, unless each has its own. */
  adjust(from) {
    if (!this.match.checked) this.contrasts.filter((other) => other !== from).forEach((other) => other.set(from.low, from.high));
    this.show();
  }

  choose(mode) {
    this.mode = mode;
    const alone = mode !== "beside";
    this.modes.forEach((button) => button.setAttribute("aria-pressed", String(button.id === mode)));
    this.panels.classList.toggle("one", alone);
    this.panes.slice(1).forEach((pane) => (pane.element.hidden = alone));
    this.pairing.hidden = !alone;
    this.wipe.hidden = this.handle.hidden = mode !== "wipe";
    this.gain.hidden = mode !== "difference";
    this.rateLabel.hidden = mode !== "flicker";
    announce(MODES.find(([value]) => value === mode)[1]);
    clearTimeout(this.timer);
    this.turn = 0;
    if (mode === "flicker") this.next();
    this.show();
  }

  pair() {
    return [Number(this.one.value), Number(this.other.value)];
  }

  show() {
    const { frame } = this.player;
    const window = (index) => this.contrasts[index].window();
    const first = this.panes[0];
    if (this.mode === "beside") {
      this.contrasts.forEach(({ element }) => (element.hidden = false));
      this.panes.forEach((pane, index) => {
        pane.lay(null);
        pane.show(this.source(index, frame), ...window(index));
        say(pane.title, this.titleOf(index));
      });
      return;
    }
    const [one, other] = this.pair();
    this.contrasts.forEach(({ element }, index) => (element.hidden = ![one, other].includes(index)));
    const [black, white] = window(other);
    const shown = this.mode === "flicker" && this.turn === 1 ? other : one;
    const over = { ...this.source(other, frame), black, white };
    first.show(this.source(shown, frame), ...window(shown));
    if (this.mode === "wipe") {
      const at = Number(this.wipe.value) / 1000;
      this.handle.style.left = `${100 * at}%`;
      first.lay({ source: over, at });
      say(first.title, `${this.titleOf(one)} | ${this.titleOf(other)}`);
    } else if (this.mode === "difference") {
      first.lay({ source: over, gain: Number(this.gain.value) });
      say(first.title, `${this.gain.value} × |${this.titleOf(one)} − ${this.titleOf(other)}|`);
    } else {
      first.lay(null);
      say(first.title, this.titleOf(shown));
    }
  }

  next() {
    this.timer = setTimeout(() => {
      const index = this.pair()[1 - this.turn];
      // Switch only when the other frame is loaded, so that no blank frame appears.
      if (this.panes[0].prepare(this.source(index, this.player.frame), ...this.contrasts[index].window())) {
        this.turn = 1 - this.turn;
        this.show();
      }
      this.next();
    }, 1000 / Math.min(20, Math.max(0.2, Number(this.rate.value) || 2)));
  }
}

/** Table of the jobs' settings and results, with the rows that differ first. */
function figures(jobs, manifests, measured) {
  const rows = [
    measured ? ["PSNR", (_, index) => decibels(measured[index].psnr), "quality"] : ["Expected PSNR", (job) => expectedRange(job.assessment)],
    measured && ["SSIM", (_, index) => figure(measured[index].ssim, 4), "quality"],
    ["State", (job) => stateWord(job.state)],
    jobs.some((job) => job.dispersion) && ["Bands", wavelengthsOf],
    ["Algorithm", (job) => job.algorithm],
    ["Planned iterations per tile", (job) => (job.schedule.stages.length ? `at most ${iterationsOf(job.schedule)}` : "–")],
    ["Schedule", (job) => job.schedule.stages.map((stage) => `${stage.iterations} × ${stage.prior}`).join(", then ") || "–"],
    ["Done", (job, index) => (manifests[index] ? ran(job, manifests[index].content) : "–")],
    ["Network", (_, index) => (manifests[index] ? networks(manifests[index].content) : "–")],
    ["CPU time of the tiles", (_, index) => (manifests[index] ? duration(manifests[index].run.cpu_seconds) : "–")],
    ["Tiles", (job) => `${job.tile.size} pixels, ${job.tile.overlap} shared`],
    ["Measurement", (job) => job.measurement],
    ["Calibration", (job) => job.calibration],
    ["Residual (no measure of quality)", (_, index) => (manifests[index] ? figure(manifests[index].content.summary.residual) : "–")],
  ].filter(Boolean).map(([name, value, kind]) => ({ name, kind, cells: jobs.map(value) }));
  const differs = ({ cells }) => cells.some((cell) => cell !== cells[0]);
  const line = (row) => h("tr", { class: row.kind }, h("th", { scope: "row" }, row.name), row.cells.map((cell) => h("td", null, cell)));
  const [different, equal] = [rows.filter(differs), rows.filter((row) => !differs(row))];
  const head = h("thead", null, h("tr", null, h("td"), jobs.map((job) => h("th", { scope: "col" }, h("a", { href: `#/jobs/${job.id}` }, nameOf(job))))));
  const group = (title, found, kind) => found.length > 0 && h("tbody", { class: kind }, h("tr", null, h("th", { scope: "rowgroup", colspan: jobs.length + 1, class: "grouphead" }, title)), found.map(line));
  return h("div", { class: "wide", tabindex: 0, role: "region", "aria-label": "Figures of the jobs" }, h("table", { class: "figures" }, head, group("Differences", different, "differs"), group("Identical", equal, "same")));
}
