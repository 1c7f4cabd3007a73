// The card "How it was made": plan, cost and decisions, and the full manifest.

import { announce, explained, facts, h, place, put, say } from "./dom.js";
import { bytes, duration, exact, figure, inUnits, iterationsOf, momentInFull, shapeOf } from "./format.js";

/** The card; `show` adds the data of a snapshot's manifest. */
export class Made {
  constructor(job, signal) {
    Object.assign(this, { job, signal });
    this.body = h("div", null, this.plan());
    this.element = h("section", { class: "card", "aria-label": "How it was made" }, h("h2", null, "How it was made"), this.body, repeat(job));
  }

  plan() {
    const { job } = this;
    return facts([
      ["Frames", shapeOf(job)],
      job.snapshots.count > 1 && ["Snapshots", job.run.length > 1 ? `jointly, in runs of up to ${job.run.length}` : "independently"],
      ["Algorithm", job.algorithm],
      job.schedule.stages.length > 0 && ["Planned", `at most ${iterationsOf(job.schedule)} iterations per tile: ${stages(job.schedule)}`],
      job.shape.mosaic && ["Colour", `sensor ${job.shape.mosaic.toUpperCase()}: four sub-images, then demosaicked (Malvar, He and Cutler)`],
      job.dispersion && ["Dispersion", `${job.dispersion.offsets.length} bands, displaced by up to ${figure(Math.max(...job.dispersion.offsets))} pixels ${job.dispersion.axis === "column" ? "to the right" : "downwards"}`],
      ["Tiles", `${job.tile.size} pixels${job.shape.mosaic ? " of a sub-image" : ""}, overlap ${job.tile.overlap}`],
      job.priority !== 0 && ["Priority", job.priority],
      ["Calibration", h("a", { href: `#/calibrations/${job.calibration}` }, h("code", null, job.calibration))],
      ["Measurement", h("code", null, job.measurement)],
      ["Identifier", h("code", null, job.id)],
      ["Submitted", momentInFull(job.created_at)],
    ]);
  }

  /** Shows a snapshot's manifest, whose URL is `href`, and the costs in the manifest of the job; each may be the error of its request. */
  show(job, manifest, href, whole) {
    const error = manifest.error ?? whole.error;
    if (error) {
      put(this.body, this.plan(), h("p", { class: "warn" }, explained(error)));
      return;
    }
    const { content } = manifest;
    const { measurement_full_scale: fullScale, white_level: white } = content.scale;
    put(this.body, this.plan(), facts([
      ["Done", ran(job, content)],
      ["Networks", networks(content)],
      ...pilot(content),
      ...joints(content),
      ["Full scale", fullScale === 1 ? "1: the values of the file are multiples of it" : `${exact(fullScale)} counts: what one frame adds where mask and scene are 1`],
      ["White level", `${inUnits(white, fullScale)}: white in pictures, and the peak of the PSNR`],
      ...times(job, whole.run),
      ["Memory of the worker", bytes(whole.run.peak_rss_bytes)],
      ["Residual ‖y − Hx‖ / ‖y‖", figure(content.summary.residual)],
    ]), h("p", { class: "muted" }, RESIDUAL),
    h("details", null, h("summary", null, "Full manifest"),
      h("div", { class: "row" }, h("a", { class: "button small", href, download: `${job.id}-manifest.json` }, "Download")),
      h("pre", { tabindex: 0 }, JSON.stringify(manifest, null, 2))));
  }
}

const RESIDUAL = "The residual shows how well the frames explain the measurement, not how good they are: many wrong videos explain it equally well. A large residual indicates wrong masks; a smaller one does not indicate a better video.";

function stages(schedule) {
  return schedule.stages.map((stage) => `${stage.iterations} × ${stage.prior}`).join(", then ");
}

/** Words for the kinds of tasks in the manifest. */
const TASKS = { prepare: "brightness and position of the masks", preview: "preview", pilot: "pilot", tile: "tiles", white: "white level", assemble: "files" };

/** Rows with the time from submission to end, the time of the workers for each kind of task, and the CPU time. */
function times(job, { seconds_by_task: tasks, cpu_seconds: cpu, provider, gpu }) {
  const since = (from, to) => (new Date(to) - new Date(from)) / 1000;
  const took = since(job.started_at, job.finished_at);
  const long = Object.entries(tasks).filter(([, seconds]) => seconds >= 0.5).sort(([, one], [, other]) => other - one);
  const parts = long.map(([kind, seconds]) => `${TASKS[kind] ?? kind} ${duration(seconds)}`);
  return [
    ["Time", `${duration(since(job.created_at, job.started_at))} in the queue, then ${duration(took)} until the end`],
    ["Time of the tasks", `${parts.join(", ") || "< 1 s"}${long.reduce((sum, [, seconds]) => sum + seconds, 0) > took ? ", some at the same time" : ""}`],
    ["CPU time", `${duration(cpu)} for the tiles${[provider, gpu].filter(Boolean).map((device) => `, ${device}`).join("")}`],
  ];
}

/** Iterations run on each tile, compared with the plan. */
export function ran(job, content) {
  const { summary, schedule } = content;
  const [planned, decided] = [iterationsOf(job.schedule), iterationsOf(schedule)];
  if (decided === 0) return "one pass of the model per tile";
  const why = summary.stop_reason === "converged" ? "; converged" : decided < planned ? "; the pilot predicted no gain from the others" : "";
  return `${summary.iterations} of ${planned} planned iterations per tile${why}`;
}

/** Names and hashes of the networks, or "none". */
export function networks(content) {
  return content.models.map((model) => `${model.name}, ${model.sha256.slice(0, 12)}…`).join("; ") || "none";
}

/** The pilot's decisions on the stages of an adaptive schedule, with their reasons. */
function pilot(content) {
  const why = { "max-iterations": "as planned", converged: "more would raise the error", diverged: "more would diverge" };
  const row = ({ planned, stage, end, error_before: before, error_after: after }) => {
    const decided = [why[end] && `${stage.iterations} of ${planned.iterations} iterations (${why[end]})`, ...changes(planned, stage)].filter(Boolean);
    const error = `hold-out error ${figure(before)} before, ${figure(after)} after`;
    return [`Pilot, ${stage.prior}`, `${decided.join(", ") || "as planned"}, ${error}`];
  };
  return [...(content.pilot?.stages ?? []).map(row), ...check(content.pilot?.evidence?.prediction)];
}

/**
 * Ratio of hold-out errors up to which most right masks stay, and from which the service reports an error. On the clip of
 * `demo/` at Cr 8 and 16, with noise of 0 and 10, right masks have 0.30 to 0.46, flipped ones 0.63 to 1.3.
 */
const [RIGHT, WRONG] = [0.5, 1];

/** A row with the hold-out error of the pilot's frames relative to that of a guess without masks; none without a pilot. */
function check(prediction) {
  if (!prediction?.by_neighbours) return [];
  const ratio = Math.sqrt(prediction.by_frames / prediction.by_neighbours);
  return [["Hidden pixels", `${figure(ratio, 2)} times the error of a guess from their neighbours; right masks usually have up to ${RIGHT}, and from ${WRONG} on the masks explain nothing`]];
}

/** The settings of a stage that the pilot changed, by their names in the schedule. */
export function changes(planned, stage) {
  const own = ["iterations", "sigma"];
  const changed = Object.keys(stage).filter((name) => !own.includes(name) && stage[name] !== planned[name]);
  const value = (setting) => (typeof setting === "number" ? figure(setting) : setting);
  return changed.map((name) => `${name.replaceAll("_", " ")} ${stage[name] ? value(stage[name]) : "omitted"}`);
}

/** Snapshots that were reconstructed jointly, and the hold-out errors behind the decision. */
function joints(content) {
  const containing = (content.runs ?? []).filter(([first, last]) => last > first && first <= content.snapshot && content.snapshot <= last);
  const adjacent = (content.pilot?.joints ?? []).filter((joint) => joint.after === content.snapshot || joint.after + 1 === content.snapshot);
  const row = (joint) => {
    const error = `hold-out error ${figure(joint.error_alone)} separately, ${figure(joint.error_together)} jointly`;
    return [`Snapshots ${joint.after}, ${joint.after + 1}`, `${joint.together ? "joint" : "separate"}, ${error}`];
  };
  return [...(containing.length ? [["Runs", containing.map(([first, last]) => `${first} to ${last}`).join("; ")]] : []), ...adjacent.map(row)];
}

/** The commands that submit the same job again. */
function repeat(found) {
  const last = found.snapshots.first + found.snapshots.count - 1;
  const body = {
    measurement: found.measurement,
    algorithm: found.algorithm,
    snapshots: [found.snapshots.first, last],
    ...(last > found.snapshots.first ? { sequence: found.sequence } : {}),
    ...(found.model ? { model: found.model } : { schedule: found.schedule }),
    tile: found.tile,
    registration: found.registration,
    priority: found.priority,
    label: found.label,
  };
  // Escape single quotes in labels for the shell.
  const json = JSON.stringify(body).replaceAll("'", "'\\''");
  const text = `curl -sS ${new URL(place("/v1/jobs"), document.baseURI)} --json '${json}'`;
  const copy = h("button", { type: "button", class: "small" }, "Copy");
  copy.addEventListener("click", async () => {
    await navigator.clipboard.writeText(text);
    say(copy, "Copied");
    announce("Command copied");
  });
  if (!navigator.clipboard) copy.hidden = true;
  const anywhere = found.state === "succeeded" && h("p", { class: "muted below" }, "On a service without the measurement: download the ",
    h("a", { href: `/v1/jobs/${found.id}/exports/manifest`, download: "manifest.json" }, "manifest of the job"), ", and run ", h("code", null, "sci-recon submit --manifest manifest.json"), " with the files that it asks for.");
  return h("details", null, h("summary", null, "Repeat this job"), h("pre", { tabindex: 0, class: "line" }, text), copy, anywhere);
}
