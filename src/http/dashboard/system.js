// State of the service: workers, device, queue, disk, versions.

import { facts, h, put } from "./dom.js";
import { bytes, duration, moment, momentInFull, short } from "./format.js";
import { every } from "./live.js";
import { get } from "./api.js";

export async function system(root, _, signal) {
  const body = h("div", { class: "cards" });
  root.append(h("h1", null, "System"), body);
  let before = "";
  every(2000, async () => {
    const found = await get("/v1/system", signal);
    const text = JSON.stringify({ ...found, now: "" });
    if (text === before) return;
    before = text;
    put(body, service(found), queue(found), disk(found), workers(found));
  }, signal);
}

function card(title, ...content) {
  return h("section", { class: "card", "aria-label": title }, h("h2", null, title), content);
}

function service(found) {
  return card("Service", facts([
    ["Version", found.version],
    ["Device", found.device],
    ["Provider", found.provider],
    ["ONNX Runtime", found.onnxruntime ?? "not used yet"],
    ["Uptime", duration((new Date(found.now) - new Date(found.started_at)) / 1000)],
    ["Largest upload", bytes(found.limits.upload_bytes)],
    ["Memory of a worker", bytes(found.limits.worker_memory_bytes)],
    ["API description", h("a", { href: "openapi.yaml" }, "openapi.yaml")],
    ["Metrics", h("a", { href: "metrics" }, "metrics for Prometheus")],
  ]));
}

function queue(found) {
  const states = Object.entries(found.jobs).map(([state, count]) => [h("span", { class: `badge ${state}` }, state), h("a", { href: `#/jobs?state=${state}` }, String(count))]);
  return card("Queue", facts([
    ["Running tasks", found.queue.running],
    ["Ready tasks", found.queue.ready],
    ["Blocked tasks", found.queue.blocked],
    ...states,
  ]));
}

function disk(found) {
  const { size_bytes: size, free_bytes: free, reserved_bytes: reserved } = found.disk;
  const low = free < 2 * reserved;
  return card("Disk",
    h("meter", { min: 0, max: size, value: size - free, high: size - 2 * reserved, "aria-label": `${bytes(size - free)} of ${bytes(size)} in use` }),
    facts([
      ["Free", h("span", { class: low ? "warn" : null }, `${bytes(free)} of ${bytes(size)}`)],
      ["Reserved", bytes(reserved)],
      ["Stored files", `${found.disk.files}, ${bytes(found.disk.file_bytes)}`],
    ]));
}

function workers(found) {
  const title = `Workers: ${found.workers.length} of ${found.workers_wanted}`;
  if (found.workers.length === 0) return card(title, h("p", { class: "warn" }, "No worker is running, so jobs wait."));
  const row = (worker) => h("tr", null,
    h("th", { scope: "row" }, short(worker.id)), h("td", null, worker.pid), h("td", null, worker.version), h("td", null, worker.device ?? ""),
    h("td", null, task(worker.task)),
    h("td", { title: momentInFull(worker.started_at) }, moment(worker.started_at)));
  const heads = ["Worker", "Process", "Version", "Device", "Task", "Running since"].map((name) => h("th", { scope: "col" }, name));
  return card(title, h("div", { class: "wide", tabindex: 0, role: "region", "aria-label": "Workers" },
    h("table", null, h("thead", null, h("tr", null, heads)), h("tbody", null, found.workers.map(row)))));
}

function task(work) {
  if (!work) return "idle";
  const place = work.tile === null ? "" : ` ${work.tile + 1}`;
  const snapshot = work.snapshot === null ? "" : `, snapshot ${work.snapshot}`;
  if (work.calibration) return h("a", { href: `#/calibrations/${work.calibration}` }, `calibration ${short(work.calibration)}`);
  return [h("a", { href: `#/jobs/${work.job}` }, `job ${short(work.job)}`), `: ${work.kind}${place}${snapshot}${work.stage ? ` (${work.stage})` : ""}`];
}
