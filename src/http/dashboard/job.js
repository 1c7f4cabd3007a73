// One job: how far it is, what went in, what came out.

import { announce, facts, h, put, say, trouble, place } from "./dom.js";
import { bytes, duration, figure, momentInFull, nameOf, shapeOf, stageOf } from "./format.js";
import { actions } from "./actions.js";
import { gaveUp, get } from "./api.js";
import { left } from "./jobs.js";
import { findings } from "./report.js";
import { TileMap } from "./tilemap.js";
import { Viewer } from "./viewer.js";
import { watch } from "./live.js";

export async function job(root, [id], signal) {
  const found = await get(`/v1/jobs/${id}`, signal);
  document.title = `${nameOf(found)} – sci-recon`;
  const state = h("span");
  const buttons = h("span", { class: "row" });
  const progress = h("div", { class: "progressline" });
  const problem = h("div");
  const warned = findings(found.warnings);
  const snapshot = snapshotChoice(found);
  const files = card("Files", h("p", { class: "muted" }, "…"));
  const manifest = card("Manifest");
  const viewer = new Viewer(found, signal);
  viewer.next = () => snapshot.next();
  const tiles = new TileMap(found, signal);
  const cards = h("div", { class: "cards" }, tiles.plotCard, tiles.tilesCard, files, manifest, details(found), repeat(found));
  root.append(h("div", { class: "row head" }, h("h1", null, nameOf(found)), state, snapshot.element, h("span", { class: "grow" }), buttons), progress, problem, warned ?? "", viewer.element, cards);

  let shown = null;
  let ready = null;
  const gone = () => (location.hash = "#/jobs");
  const refresh = async (ids) => {
    if (ids && !ids.has(id)) return;
    const now = await get(`/v1/jobs/${id}`, signal);
    if (now === shown) return;
    if (now.state !== shown?.state) {
      put(state, h("span", { class: `badge ${now.state}` }, now.state));
      put(buttons, actions(now, (action) => (action === "delete" ? gone() : refresh(null))));
      put(problem, now.error && h("p", { class: "trouble", role: "alert" }, now.error));
      if (shown) announce(`The job is ${now.state}`);
    }
    put(progress, line(now));
    await tiles.renew(snapshot.value());
    const done = `${now.progress.previews_done} ${now.progress.tiles_done} ${now.progress.snapshots_done} ${now.state}`;
    if (shown && done !== ready) await viewer.renew();
    if (done !== ready) await results(now);
    ready = done;
    shown = now;
  };
  const results = async (now) => {
    await showFiles(files, id, snapshot.value(), signal);
    await showManifest(manifest, now, snapshot.value(), signal);
  };
  const open = async () => {
    await viewer.open(snapshot.value());
    await tiles.renew(snapshot.value());
    await results(shown ?? found);
  };
  snapshot.listen(() => open().catch((error) => gaveUp(error) || put(problem, trouble(error))));
  await viewer.open(snapshot.value());
  watch(refresh, signal);
}

export function card(title, ...content) {
  return h("section", { class: "card", "aria-label": title }, h("h2", null, title), h("div", { class: "content" }, content));
}

/** Which snapshot is shown, where there are several. */
function snapshotChoice(found) {
  const { first, count } = found.snapshots;
  const input = h("input", { type: "number", id: "snapshot", min: first, max: first + count - 1, value: first });
  const element = count > 1 && h("label", { class: "row", for: "snapshot" }, "Snapshot", input, `of ${first} to ${first + count - 1}`);
  const value = () => Math.min(first + count - 1, Math.max(first, Number(input.value) || first));
  const next = () => {
    input.value = value() < first + count - 1 ? value() + 1 : first;
    input.dispatchEvent(new Event("change"));
  };
  return { element, value, next, listen: (call) => input.addEventListener("change", call) };
}

function line(now) {
  const { percent, tiles_done: done, tiles_total: total } = now.progress;
  const over = ["succeeded", "failed", "cancelled"].includes(now.state);
  const parts = [
    `${percent.toFixed(percent < 10 ? 1 : 0)} %`,
    stageOf(now),
    left(now),
    `${done} of ${total} tiles`,
    now.progress.iterations_done > 0 && !over && `${now.progress.iterations_done} iterations`,
  ];
  return [h("progress", { max: 100, value: percent, "aria-label": "Progress" }), h("span", null, parts.filter(Boolean).join(" · "))];
}

function details(found) {
  return card("Job", facts([
    ["Frames", shapeOf(found)],
    ...(found.snapshots.count > 1 ? [["Snapshots", found.run.length > 1 ? `together in runs of up to ${found.run.length}` : "each alone"]] : []),
    ["Algorithm", found.algorithm],
    ["Schedule", schedule(found.schedule)],
    ["Tiles", `${found.tile.size} pixels, ${found.tile.overlap} shared`],
    ["Priority", found.priority],
    ["Calibration", h("a", { href: `#/calibrations/${found.calibration}` }, h("code", null, found.calibration))],
    ["Measurement", h("code", null, found.measurement)],
    ["Identifier", h("code", null, found.id)],
    ["Created", momentInFull(found.created_at)],
  ]));
}

function schedule(found) {
  return found.stages.map((stage) => `${stage.iterations} × ${stage.prior}`).join(", then ");
}

async function showFiles(element, id, snapshot, signal) {
  const { ready, files } = await get(`/v1/jobs/${id}/snapshots/${snapshot}`, signal);
  const link = (file) => h("a", { class: "button small", href: file.href, download: true }, `${file.name} `, h("span", { class: "muted" }, bytes(file.size)));
  const whole = files.filter((file) => !file.name.includes("/"));
  const single = files.filter((file) => file.name.includes("/"));
  put(element.querySelector(".content"), ready
    ? [h("div", { class: "row" }, whole.map(link)), h("details", null, h("summary", null, `${single.length} single frames`), h("div", { class: "row" }, single.map(link)))]
    : h("p", { class: "muted" }, "The frames of this snapshot are not written yet."));
}

async function showManifest(element, now, snapshot, signal) {
  const body = element.querySelector(".content");
  if (now.state !== "succeeded") {
    put(body, h("p", { class: "muted" }, "It is written when the job has succeeded."));
    return;
  }
  const manifest = await get(`/v1/jobs/${now.id}/snapshots/${snapshot}/manifest.json`, signal);
  const { content, run } = manifest;
  put(body, warnings(manifest), facts([
    ["Residual ‖y − Hx‖ / ‖y‖", figure(content.summary.residual)],
    ["Ended", content.summary.stop_reason === "converged" ? "converged" : "all planned iterations done"],
    ["Iterations", `${content.summary.tv_iterations} with TV, ${content.summary.denoiser_passes} deep`],
    ["White level", figure(content.scale.white)],
    ["Networks", content.models.map((model) => `${model.name}, ${model.sha256.slice(0, 12)}…`).join("; ") || "none"],
    ...pilot(content),
    ...joints(content),
    ["Provider", run.provider ? `${run.provider}, ONNX Runtime ${run.onnxruntime}` : "none"],
    ["Computing", duration(run.cpu_seconds)],
    ["Memory", bytes(run.peak_rss_bytes)],
  ]), h("details", null, h("summary", null, "All of it"), h("pre", { tabindex: 0 }, JSON.stringify(manifest, null, 2))));
}

/** What the pilot decided of the stages of an adaptive schedule, and why. */
function pilot(content) {
  const why = { "max-iterations": "all that were planned", converged: "later ones raise the error", diverged: "later ones diverge" };
  const row = (stage) => {
    const decided = [
      why[stage.end] && `${stage.iterations} of ${stage.planned} iterations (${why[stage.end]})`,
      stage.planned_temporal_weight > 0 && `total variation along time ${stage.temporal_weight > 0 ? "kept" : "left out"}`,
    ].filter(Boolean);
    const error = `error at held-out pixels ${figure(stage.error_before)} to ${figure(stage.error_after)}`;
    return decided.length > 0 && [`Pilot, ${stage.prior}`, [...decided, error].join(", ")];
  };
  return (content.pilot?.stages ?? []).map(row).filter(Boolean);
}

/** Which snapshots were reconstructed together, and why not others. */
function joints(content) {
  const held = (content.runs ?? []).filter(([first, last]) => last > first && first <= content.snapshot && content.snapshot <= last);
  const near = (content.pilot?.joints ?? []).filter((joint) => joint.after === content.snapshot || joint.after + 1 === content.snapshot);
  const row = (joint) => {
    const error = `error at held-out pixels ${figure(joint.error_alone)} alone, ${figure(joint.error_together)} together`;
    return [`Snapshots ${joint.after}, ${joint.after + 1}`, `${joint.together ? "together" : "apart"}, ${error}`];
  };
  return [...(held.length ? [["Runs", held.map(([first, last]) => `${first} to ${last}`).join("; ")]] : []), ...near.map(row)];
}

function warnings(manifest) {
  const found = manifest.content.warnings ?? manifest.warnings ?? [];
  return found.map((warning) => h("p", { class: "warn" }, typeof warning === "string" ? warning : warning.detail ?? JSON.stringify(warning)));
}

/** The line that asks for the same job again. */
function repeat(found) {
  const last = found.snapshots.first + found.snapshots.count - 1;
  const body = {
    measurement: found.measurement,
    algorithm: found.algorithm,
    snapshots: [found.snapshots.first, last],
    ...(last > found.snapshots.first ? { sequence: found.sequence } : {}),
    ...(found.model ? { model: found.model } : { schedule: found.schedule }),
    tile: found.tile,
    priority: found.priority,
    label: found.label,
  };
  // A label may hold quotes, which the shell would take for its own.
  const json = JSON.stringify(body).replaceAll("'", "'\\''");
  const text = `curl -sS ${new URL(place("/v1/jobs"), document.baseURI)} --json '${json}'`;
  const copy = h("button", { type: "button", class: "small" }, "Copy");
  copy.addEventListener("click", async () => {
    await navigator.clipboard.writeText(text);
    say(copy, "Copied");
    announce("The line is copied");
  });
  if (!navigator.clipboard) copy.hidden = true;
  return card("Again", h("p", { class: "muted" }, "The line that asks for the same job:"), h("pre", { tabindex: 0, class: "line" }, text), copy);
}
