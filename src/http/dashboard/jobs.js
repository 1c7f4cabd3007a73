// The list of jobs: newest first, as many as there are, filtered by the service.

import { announce, calmly, h, put, say } from "./dom.js";
import { duration, moment, momentInFull, nameOf, shapeOf, short, stageOf } from "./format.js";
import { actions } from "./actions.js";
import { get } from "./api.js";
import { table, textColumn } from "./rows.js";
import { watch } from "./live.js";

const PAGE = 100;
/** Changed jobs that are asked for one by one; more of them are cheaper as a page. */
const SOME = 8;
/** Time after which places in the queue are looked at again though no waiting job has changed. */
const STALE = 10_000;
const STATES = ["queued", "running", "succeeded", "failed", "cancelling", "cancelled"];

export async function jobs(root, [query], signal) {
  const chosen = new Set();
  const list = new JobList(signal);
  const state = h("select", { id: "state" }, h("option", { value: "" }, "all states"), STATES.map((name) => h("option", { value: name, selected: query.get("state") === name }, name)));
  const search = h("input", { type: "search", id: "search", placeholder: "label or identifier", maxlength: 200, autocomplete: "off", value: query.get("search") ?? "" });
  const count = h("span", { class: "muted", id: "count" });
  const compare = h("a", { class: "button", hidden: true }, "Compare the two");
  const empty = h("p", { class: "note", hidden: true });
  root.className = "fill";
  const scroller = h("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Jobs, newest first" });
  const rows = table("Jobs", columns(chosen, () => choose(), () => look(null)), scroller, rowHeight);
  root.append(
    h("div", { class: "bar" }, h("h1", null, "Jobs"),
      h("label", { for: "state" }, "State"), state,
      h("label", { for: "search" }, "Search"), search, count, h("span", { class: "grow" }), compare,
      h("a", { class: "button primary", href: "#/new" }, "New job")),
    scroller);
  scroller.append(rows.element, empty);

  function choose() {
    compare.hidden = chosen.size !== 2;
    if (chosen.size === 2) compare.href = `#/compare/${[...chosen].sort().join("/")}`;
  }

  function draw() {
    const [, last] = rows.show(list.items, list.complete);
    say(count, list.complete ? `${list.items.length} jobs` : `${list.items.length} loaded, more below`);
    empty.hidden = !list.complete || list.items.length > 0;
    if (!empty.hidden) put(empty, state.value || search.value ? "No job fits." : ["There are no jobs yet. ", h("a", { href: "#/new" }, "Submit the first one.")]);
    if (!list.complete && last + PAGE / 2 > list.items.length) list.more().then((more) => more && draw());
  }

  async function refresh(ids) {
    if (!(ids && (await list.some(ids)))) await list.refresh(rows.range()[0]);
    draw();
  }

  const filter = calmly(200, async () => {
    list.filter(state.value, search.value.trim());
    scroller.scrollTop = 0;
    await list.refresh(0);
    draw();
    announce(list.complete ? `${list.items.length} jobs` : `more than ${list.items.length} jobs`);
  });
  state.addEventListener("change", filter);
  search.addEventListener("input", filter);
  let frame = 0;
  scroller.addEventListener("scroll", () => {
    cancelAnimationFrame(frame);
    frame = requestAnimationFrame(draw);
  }, { passive: true });
  addEventListener("resize", draw, { signal });
  list.filter(state.value, search.value.trim());
  const look = watch(refresh, signal);
}

/** The height of a row as the style sheet has it. */
function rowHeight() {
  return matchMedia("(max-width: 720px)").matches ? 92 : 38;
}

/** The jobs that are loaded: a growing beginning of the filtered list. */
class JobList {
  constructor(signal) {
    this.signal = signal;
    this.filter("", "");
  }

  filter(state, search) {
    this.query = new URLSearchParams({ limit: PAGE });
    if (state) this.query.set("state", state);
    if (search) this.query.set("search", search);
    this.items = [];
    this.complete = false;
    this.loading = null;
  }

  async page(cursor) {
    const query = new URLSearchParams(this.query);
    if (cursor) query.set("cursor", cursor);
    const asked = this.query;
    const page = await get(`/v1/jobs?${query}`, this.signal);
    // The filter may have changed meanwhile.
    return asked === this.query ? page : null;
  }

  /** Reads a few changed jobs again; false if the list may have other rows now, or is old. */
  async some(ids) {
    const filtered = this.query.has("state") || this.query.has("search");
    const rows = [...ids].map((id) => this.items.findIndex((job) => job.id === id));
    if (filtered || ids.size > SOME || rows.includes(-1) || Date.now() - this.read > STALE) return false;
    const asked = this.query;
    const found = await Promise.all([...ids].map((id) => get(`/v1/jobs/${id}`, this.signal)));
    if (asked === this.query) {
      const fresh = new Map(found.map((job) => [job.id, job]));
      this.items = this.items.map((job) => fresh.get(job.id) ?? job);
    }
    return true;
  }

  /** Reads the first page again, and the one with the row `first` if that is another one. */
  async refresh(first) {
    this.read = Date.now();
    this.take(null, await this.page(null));
    if (first >= PAGE) {
      const cursor = this.items[first - 1]?.id;
      if (cursor) this.take(cursor, await this.page(cursor));
    }
  }

  /** Reads on at the end; true if there was more. */
  async more() {
    if (this.complete || this.loading || this.items.length === 0) return false;
    const cursor = this.items.at(-1).id;
    this.loading = this.page(cursor);
    try {
      const page = await this.loading;
      if (page) this.take(cursor, page);
      return page !== null;
    } finally {
      this.loading = null;
    }
  }

  /** Puts a page in the place of what is known of its range: identifiers fall from top to bottom. */
  take(after, page) {
    if (!page) return;
    const last = page.next_cursor;
    const before = this.items.filter((job) => after !== null && job.id >= after);
    const behind = last === null ? [] : this.items.filter((job) => job.id < last);
    if (last === null) this.complete = true;
    else if (behind.length === 0) this.complete = false;
    this.items = [...before, ...page.items, ...behind];
  }
}

function columns(chosen, choose, done) {
  return [
    { title: h("span", { class: "unseen" }, "Choose"), class: "pick", fill: (cell, job) => pick(cell, job, chosen, choose) },
    { title: "Job", class: "name", fill: name },
    { title: "State", class: "state", fill: state },
    { title: "Progress", class: "progress", fill: progress },
    textColumn("Stage", "stage", stageOf),
    textColumn("Time", "left", left),
    textColumn("Frames", "shape", shapeOf),
    textColumn("Algorithm", "algorithm", (job) => job.algorithm),
    { title: "Created", class: "created", fill: created },
    { title: h("span", { class: "unseen" }, "Actions"), class: "actions", fill: (cell, job, before) => buttons(cell, job, before, done) },
  ];
}

function pick(cell, job, chosen, choose) {
  if (cell.firstChild) return;
  const toggle = (event) => {
    if (event.target.checked) chosen.add(job.id);
    else chosen.delete(job.id);
    choose();
  };
  cell.append(h("input", { type: "checkbox", "aria-label": `Choose ${nameOf(job)} to compare`, checked: chosen.has(job.id), onchange: toggle }));
}

function name(cell, job) {
  if (cell.firstChild) return;
  cell.append(h("a", { href: `#/jobs/${job.id}`, title: `${nameOf(job)} (${job.id})` }, nameOf(job)));
  if (job.label) cell.append(h("span", { class: "muted id" }, short(job.id)));
}

function state(cell, job, before) {
  if (before?.state === job.state) return;
  put(cell, h("span", { class: `badge ${job.state}`, title: job.error }, job.state));
}

function progress(cell, job) {
  const percent = job.progress.percent;
  if (!cell.firstChild) cell.append(h("progress", { max: 100, "aria-label": `Progress of ${nameOf(job)}` }), h("span", { class: "percent" }));
  const [bar, text] = cell.children;
  if (bar.value !== percent) bar.value = percent;
  say(text, `${percent < 10 && percent > 0 ? percent.toFixed(1) : Math.floor(percent)} %`);
}

/** What is ahead of a job that is not done, and how long one that is took. */
export function left(job) {
  const { eta_seconds: eta, queue_position: position } = job.progress;
  const place = position ? `no. ${position}` : "";
  if (job.state === "queued") return [place, eta === null ? "no worker" : `≤ ${duration(eta)}`].filter(Boolean).join(", ");
  if (job.state === "running") return eta === null ? "no worker" : `≤ ${duration(eta)}`;
  if (job.state === "succeeded") return `took ${duration((new Date(job.finished_at) - new Date(job.started_at)) / 1000)}`;
  return "";
}

function created(cell, job) {
  if (cell.firstChild) return;
  cell.append(h("time", { datetime: job.created_at, title: momentInFull(job.created_at) }, moment(job.created_at)));
}

function buttons(cell, job, before, done) {
  if (before?.state !== job.state) put(cell, actions(job, done));
}
