// State of the service: what an administrator looks for first, in words.

import { capital, facts, h, marked, put } from "./dom.js";
import { bytes, duration, moment, momentInFull, nameOf, short, stateWord } from "./format.js";
import { every } from "./live.js";
import { get } from "./api.js";

/** Number of failed jobs that are listed. */
const MAX_FAILED = 5;

export async function system(root, _, signal) {
  const body = h("div");
  root.append(h("h1", null, "System"), body);
  let before = "";
  every(2000, async () => {
    const [found, failed] = await Promise.all([get("/v1/system", signal), get(`/v1/jobs?state=failed&limit=${MAX_FAILED}`, signal)]);
    const text = JSON.stringify([{ ...found, now: "" }, failed]);
    if (text === before) return;
    before = text;
    put(body, h("p", { class: "lead" }, summary(found)), found.degraded.map((trouble) => h("p", { class: "trouble" }, trouble)),
      h("div", { class: "cards" }, queue(found), disk(found), errors(failed), workers(found), service(found)));
  }, signal);
}

const count = (number, one, many = `${one}s`) => `${number === 0 ? "no" : number} ${number === 1 ? one : many}`;

/** The state in one sentence. */
function summary({ jobs, workers: { length: alive }, disk: { free_bytes: free } }) {
  const [running, queued] = [jobs.running + jobs.cancelling, jobs.queued];
  const work = running + queued === 0 ? "No job is running or queued" : `${count(running, "job")} running, ${queued || "none"} queued`;
  return `${capital(work)}; ${count(alive, "worker")} ready; ${bytes(free)} free.`;
}

function card(title, ...content) {
  return h("section", { class: "card", "aria-label": title }, h("h2", null, title), content);
}

function service(found) {
  return card("Service", facts([
    ["Version", found.version],
    ["Networks run on", `${found.device} (${found.provider})`],
    ["ONNX Runtime", found.onnxruntime ?? "not used yet"],
    ["Running for", duration((new Date(found.now) - new Date(found.started_at)) / 1000)],
    ["Largest upload", bytes(found.limits.upload_bytes)],
    ["Memory of a worker", `at most ${bytes(found.limits.worker_memory_bytes)}`],
    ["Interfaces", [h("a", { href: "openapi.yaml" }, "API description"), ", ", h("a", { href: "metrics" }, "metrics for Prometheus")]],
  ]));
}

const STATES = ["running", "queued", "cancelling", "succeeded", "failed", "cancelled"];

function queue(found) {
  const jobs = (state) => [capital(stateWord(state)), found.jobs[state] === 0 ? "none" : h("a", { href: `#/jobs?state=${state}` }, count(found.jobs[state], "job"))];
  const { running, ready, blocked } = found.queue;
  const open = ["running", "queued", "cancelling"];
  return card("Queue", facts(STATES.filter((state) => state !== "cancelling" || found.jobs[state] > 0).map(jobs)),
    h("p", { class: "muted" }, open.some((state) => found.jobs[state] > 0) || running + ready + blocked > 0
      ? `Tasks: ${running} running, ${ready} ready for a worker, ${blocked} waiting for others.` : "No tasks are open."));
}

function disk(found) {
  const { size_bytes: size, free_bytes: free, reserved_bytes: reserved } = found.disk;
  const low = free < 2 * reserved;
  return card("Disk",
    h("meter", { min: 0, max: size, value: size - free, high: size - 2 * reserved, "aria-label": `${bytes(size - free)} of ${bytes(size)} in use` }),
    facts([
      ["Free", h("span", { class: low ? "warn" : null }, `${bytes(free)} of ${bytes(size)}${low ? ": delete jobs, or give the service a larger disk" : ""}`)],
      ["Kept free", `${bytes(reserved)}; uploads are refused below it`],
      ["Stored", `${bytes(found.disk.file_bytes)} in ${count(found.disk.files, "file")}`],
    ]));
}

/** The jobs that failed last, with their reasons. */
function errors({ items }) {
  if (items.length === 0) return card("Last errors", h("p", { class: "muted" }, "No job of this lab has failed."));
  return card("Last errors", h("ul", { class: "findings" }, items.map((job) => h("li", { class: "error" },
    h("p", null, h("a", { href: `#/jobs/${job.id}` }, nameOf(job)), " ", h("span", { class: "muted" }, moment(job.finished_at))),
    h("p", null, marked(capital(job.error)))))));
}

function workers(found) {
  const title = `Workers: ${found.workers.length} of ${found.workers_wanted} ready`;
  if (found.workers.length === 0) return card(title, h("p", { class: "warn" }, "No worker is running, so jobs wait. Start the service with ", h("code", { class: "together" }, "--workers 1"), " or more, or connect workers of other machines."));
  const row = (worker) => h("tr", null,
    h("th", { scope: "row" }, short(worker.id)), h("td", { class: "minor" }, worker.pid), h("td", { class: "minor" }, worker.version), h("td", null, worker.device ?? ""),
    h("td", null, task(worker.task)),
    h("td", { class: "together", title: momentInFull(worker.started_at) }, moment(worker.started_at)));
  const minor = ["Process", "Version"];
  const heads = ["Worker", ...minor, "Device", "Task", "Running since"].map((name) => h("th", { scope: "col", class: minor.includes(name) && "minor" }, name));
  const element = card(title, h("div", { class: "wide", tabindex: 0, role: "region", "aria-label": "Workers" },
    h("table", null, h("thead", null, h("tr", null, heads)), h("tbody", null, found.workers.map(row)))));
  element.classList.add("whole");
  return element;
}

function task(work) {
  if (!work) return "idle";
  const place = work.tile === null ? "" : ` ${work.tile + 1}`;
  const snapshot = work.snapshot === null ? "" : `, snapshot ${work.snapshot}`;
  if (work.calibration) return h("a", { href: `#/calibrations/${work.calibration}` }, `calibration ${short(work.calibration)}`);
  return [h("a", { href: `#/jobs/${work.job}` }, `job ${short(work.job)}`), `: ${work.kind}${place}${snapshot}${work.stage ? ` (${work.stage})` : ""}`];
}
