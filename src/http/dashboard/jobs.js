// The list of jobs, newest first. The service filters it; pages are loaded while the user scrolls.

import { announce, h, place, put, say } from "./dom.js";
import { cancelAll, removeAll, actions } from "./actions.js";
import { aboutDecibels, decibels, doubts, expectedRange, measuredVerdict, moment, momentInFull, nameOf, remaining, shapeOf, short, stageOf, stateWord, verdictOf } from "./format.js";
import { filters } from "./filters.js";
import { get } from "./api.js";
import { qualityOf } from "./quality.js";
import { table } from "./rows.js";
import { watch } from "./live.js";
import { welcome } from "./welcome.js";

const PAGE = 100;
/** Largest number of changed jobs that are read one by one; a page is cheaper for more. */
const MAX_SINGLE_READS = 8;
/** Milliseconds after which positions in the queue are read again even if no queued job has changed. */
const STALE_MS = 10_000;
/** Largest number of jobs in a comparison. */
const MAX_COMPARED = 4;

export async function jobs(root, [query], signal) {
  const chosen = new Set();
  const list = new JobList(signal);
  const filter = filters(query, () => refilter());
  const count = h("span", { class: "muted", id: "count" });
  const empty = h("div", { hidden: true });
  const picked = h("div", { class: "bar picked", role: "region", "aria-label": "Selected jobs", hidden: true });
  root.className = "fill";
  const scroller = h("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Jobs, newest first" });
  const whole = h("input", { type: "checkbox", "aria-label": "Select all jobs", title: "Select all jobs", onchange: (event) => (event.target.checked ? all() : none()) });
  const rows = table("Jobs", columns(whole, chosen, () => choose(), () => look(null)), scroller, rowHeight);
  const bar = h("div", { class: "bar" }, h("h1", null, "Jobs"), filter.element, count, h("span", { class: "grow" }), h("a", { class: "button primary writes", href: "#/new" }, "New job"));
  root.append(bar, picked, scroller);
  scroller.append(rows.element, empty);

  /** Shows the actions for the selected jobs. */
  function choose() {
    const found = list.items.filter((job) => chosen.has(job.id));
    const ended = found.filter((job) => ["succeeded", "failed", "cancelled"].includes(job.state));
    const live = found.filter((job) => ["queued", "running"].includes(job.state));
    picked.hidden = found.length === 0;
    whole.checked = found.length > 0 && found.length === list.items.length;
    whole.indeterminate = found.length > 0 && !whole.checked;
    const after = () => {
      none();
      look(null);
    };
    put(picked, h("b", null, `${found.length} selected`),
      found.length >= 2 && found.length <= MAX_COMPARED && h("a", { class: "button small", id: "compare", href: `#/compare/${found.map((job) => job.id).reverse().join("/")}` }, "Compare"),
      found.length === 1 && h("span", { class: "muted" }, `Select up to ${MAX_COMPARED} jobs to compare them.`),
      found.length > MAX_COMPARED && h("span", { class: "muted" }, `(up to ${MAX_COMPARED} can be compared)`),
      live.length > 0 && h("button", { type: "button", class: "small writes", id: "cancel-all", onclick: () => cancelAll(live).then(after) }, `Cancel ${live.length}`),
      ended.length > 0 && h("button", { type: "button", class: "small delete writes", id: "delete-all", onclick: () => removeAll(ended).then((deleted) => deleted && after()) }, `Delete ${ended.length}`),
      h("button", { type: "button", class: "small", onclick: () => all() }, "Select all"),
      h("button", { type: "button", class: "small", onclick: () => none() }, "Clear the selection"));
  }

  /** Selects all jobs of the filter, also those that are not loaded yet. */
  async function all() {
    await list.loading;
    while (!list.complete && (await list.more()));
    list.items.forEach((job) => chosen.add(job.id));
    mark();
  }

  function none() {
    chosen.clear();
    mark();
  }

  function mark() {
    for (const box of scroller.querySelectorAll("td.pick input")) box.checked = chosen.has(box.value);
    choose();
  }

  function draw() {
    const [, last] = rows.show(list.items, list.complete);
    say(count, list.complete ? `${list.items.length} ${list.items.length === 1 ? "job" : "jobs"}` : `${list.items.length} loaded, more below`);
    const nothing = list.complete && list.items.length === 0;
    const first = nothing && !filter.value().state && !filter.value().search;
    rows.element.hidden = nothing;
    bar.hidden = first;
    scroller.classList.toggle("bare", first);
    if (empty.hidden === nothing) {
      empty.hidden = !nothing;
      put(empty, nothing && (first ? welcome() : h("p", { class: "note" }, "No matching jobs. ", h("a", { href: "#/jobs" }, "All jobs"))));
    }
    if (!picked.hidden) choose();
    if (!list.complete && last + PAGE / 2 > list.items.length) list.more().then((more) => more && draw());
  }

  async function refresh(ids) {
    if (!(ids && (await list.some(ids)))) await list.refresh(rows.range()[0]);
    draw();
  }

  async function refilter() {
    list.filter(filter.value());
    empty.hidden = true;
    scroller.scrollTop = 0;
    await list.refresh(0);
    draw();
    announce(list.complete ? `${list.items.length} jobs` : `more than ${list.items.length} jobs`);
  }

  let frame = 0;
  scroller.addEventListener("scroll", () => {
    cancelAnimationFrame(frame);
    frame = requestAnimationFrame(draw);
  }, { passive: true });
  addEventListener("resize", draw, { signal });
  list.filter(filter.value());
  const look = watch(refresh, signal);
}

/** Height of a row in pixels, as in the style sheet. */
function rowHeight() {
  return matchMedia("(max-width: 720px)").matches ? 96 : 60;
}

/** The loaded jobs: the first pages of the filtered list. */
class JobList {
  constructor(signal) {
    this.signal = signal;
    this.filter({});
  }

  filter({ state, search }) {
    this.query = new URLSearchParams({ limit: PAGE });
    if (state) this.query.set("state", state);
    if (search) this.query.set("search", search);
    this.items = [];
    /** The cursor after a job, by its identifier; known for the last job of each page. */
    this.cursors = new Map();
    this.complete = false;
    this.loading = null;
  }

  async page(cursor) {
    const query = new URLSearchParams(this.query);
    if (cursor) query.set("cursor", cursor);
    const asked = this.query;
    const page = await get(`/v1/jobs?${query}`, this.signal);
    // Drop the page if the filter has changed during the request.
    return asked === this.query ? page : null;
  }

  /** Reads a few changed jobs again; false if the whole list must be read instead. */
  async some(ids) {
    const filtered = this.query.has("state") || this.query.has("search");
    const rows = [...ids].map((id) => this.items.findIndex((job) => job.id === id));
    if (filtered || ids.size > MAX_SINGLE_READS || rows.includes(-1) || Date.now() - this.read > STALE_MS) return false;
    const asked = this.query;
    const found = await Promise.all([...ids].map((id) => get(`/v1/jobs/${id}`, this.signal)));
    if (asked === this.query) {
      const fresh = new Map(found.map((job) => [job.id, job]));
      this.items = this.items.map((job) => fresh.get(job.id) ?? job);
    }
    return true;
  }

  /** Reads the first page again, and the page with row `first` if that is another one. */
  async refresh(first) {
    this.read = Date.now();
    this.take(null, await this.page(null));
    if (first >= PAGE) await this.next(first);
  }

  /** Reads the page that follows one of the first `count` jobs, the last one with a known cursor. */
  async next(count) {
    const start = this.items.slice(0, count).findLast((job) => this.cursors.has(job.id))?.id ?? null;
    const page = await this.page(this.cursors.get(start) ?? null);
    this.take(start, page);
    return page !== null;
  }

  /** Loads the next page; true if there was one. */
  async more() {
    if (this.complete || this.loading || this.items.length === 0) return false;
    this.loading = this.next(this.items.length);
    try {
      return await this.loading;
    } finally {
      this.loading = null;
    }
  }

  /** Replaces the range of a page. Identifiers descend from top to bottom. */
  take(after, page) {
    if (!page) return;
    const more = page.next_cursor !== null && page.items.length > 0;
    const last = page.items.at(-1)?.id;
    if (more) this.cursors.set(last, page.next_cursor);
    const before = this.items.filter((job) => after !== null && job.id >= after);
    const behind = more ? this.items.filter((job) => job.id < last) : [];
    if (!more) this.complete = true;
    else if (behind.length === 0) this.complete = false;
    this.items = [...before, ...page.items, ...behind];
  }
}

function columns(whole, chosen, choose, done) {
  return [
    { title: whole, class: "pick", fill: (cell, job) => pick(cell, job, chosen, choose) },
    { title: h("span", { class: "unseen" }, "Picture"), class: "thumb", fill: thumb },
    { title: "Job", class: "name", fill: name },
    { title: "Verdict", class: "checks", fill: verdict },
    { title: "State", class: "state", fill: state },
    { title: "Frames", class: "shape", fill: frames },
    { title: "Submitted", class: "created", fill: created },
    { title: h("span", { class: "unseen" }, "Actions"), class: "actions writes", fill: (cell, job, before) => buttons(cell, job, before, done) },
  ];
}

function pick(cell, job, chosen, choose) {
  if (cell.firstChild) return;
  const toggle = (event) => {
    if (event.target.checked) chosen.add(job.id);
    else chosen.delete(job.id);
    choose();
  };
  cell.append(h("input", { type: "checkbox", "aria-label": `Select ${nameOf(job)}`, value: job.id, checked: chosen.has(job.id), onchange: toggle }));
}

/** Thumbnail of the middle frame: a preview, then tiles, then the result. */
function thumb(cell, job, before) {
  const { previews_done: previews, tiles_done: tiles, snapshots_done: snapshots } = job.progress;
  const version = snapshots > 0 ? "done" : tiles > 0 ? "tiles" : previews > 0 ? "preview" : "";
  if (before && cell.dataset.version === version) return;
  cell.dataset.version = version;
  if (!version) {
    put(cell, h("span", { class: "blank" }));
    return;
  }
  const path = `/view/jobs/${job.id}/snapshots/${job.snapshots.first}/pictures/${job.dispersion?.wavelengths ? "colours" : `frame-${Math.ceil(job.shape.frames / 2)}`}?size=128`;
  const image = h("img", { src: place(`${path}#${version}`), alt: "", loading: "lazy", decoding: "async", width: 64, height: 46 });
  image.addEventListener("error", () => image.replaceWith(h("span", { class: "blank" })));
  put(cell, image);
}

function name(cell, job, before) {
  if (before && nameOf(before) === nameOf(job)) return;
  put(cell, h("a", { href: `#/jobs/${job.id}`, title: `${nameOf(job)} (${job.id})` }, nameOf(job)),
    h("span", { class: "sub" }, job.label ? `${job.algorithm} · ${short(job.id)}` : job.algorithm));
}

function state(cell, job, before) {
  if (before?.state !== job.state) {
    const running = job.state === "running" || job.state === "cancelling";
    put(cell, h("span", { class: "line" }, h("span", { class: `badge ${job.state}`, title: job.error }, stateWord(job.state)), running && h("progress", { max: 100, "aria-label": `Progress of ${nameOf(job)}` }), h("span", { class: "muted" })), h("span", { class: "sub" }));
  }
  const bar = cell.querySelector("progress");
  if (bar) bar.value = job.progress.percent;
  const { queue_position: position, percent } = job.progress;
  say(cell.querySelector(".muted"), bar ? `${Math.floor(percent)} %` : job.state === "queued" && position ? `position ${position}` : "");
  say(cell.lastChild, remaining(job));
  cell.title = bar ? stageOf(job) : "";
}

/**
 * The verdict in a word, the number of findings, and the PSNR: measured if the job has true frames, else expected. A job that
 * has not succeeded has only findings.
 */
function verdict(cell, job, before) {
  const same = before && before.state === job.state && before.truth === job.truth && before.warnings.length === job.warnings.length && before.verdict === job.verdict && !before.assessment === !job.assessment;
  if (same) return;
  const found = doubts(job);
  const mark = found && h("span", { class: `mark ${found.severity}`, title: found.details.join("\n") }, found.text);
  const show = (kind, word, psnr) => put(cell, word && h("span", { class: `grade ${kind}` }, word), h("span", { class: "sub" }, mark, psnr && h("span", { class: "psnr" }, mark && " · ", psnr)));
  const expected = () => {
    const [kind, word] = job.state === "succeeded" ? verdictOf(job) : ["", ""];
    const psnr = job.assessment?.psnr_db ?? null;
    show(kind, word, psnr === null ? job.assessment && !found && "no expected PSNR" : h("span", { title: `Expected PSNR ${expectedRange(job.assessment)}` }, `about ${aboutDecibels(psnr)}`));
  };
  const asked = (cell.dataset.truth = `${job.id} ${job.truth}`);
  if (job.state !== "succeeded" || !job.truth) {
    expected();
    return;
  }
  show("unknown", "", "measuring …");
  const current = () => cell.isConnected && cell.dataset.truth === asked;
  qualityOf(job, current).then(({ psnr }) => {
    const [kind, word] = measuredVerdict(psnr);
    if (current()) show(kind, word, h("span", { title: "PSNR against the true frames of this job" }, `${decibels(psnr)} measured`));
  }).catch(() => current() && expected());
}

function frames(cell, job) {
  if (cell.firstChild) return;
  const { count } = job.snapshots;
  put(cell, shapeOf(job, false), count > 1 && h("span", { class: "sub" }, `${count} snapshots`));
}

function created(cell, job) {
  if (cell.firstChild) return;
  cell.append(h("time", { datetime: job.created_at, title: momentInFull(job.created_at) }, moment(job.created_at)));
}

function buttons(cell, job, before, done) {
  if (before?.state !== job.state) put(cell, actions(job, done));
}
