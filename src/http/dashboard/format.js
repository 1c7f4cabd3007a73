// Formats numbers, times and states for display.

/** An expected PSNR; the model does not distinguish values above 40 dB. */
export const aboutDecibels = (psnr) => (psnr >= 40 ? "40 dB or more" : `${psnr.toFixed(0)} dB`);

/** The interval of an assessment's expected PSNR, or a dash where there is no figure. */
export function expectedRange(assessment) {
  if (!assessment || assessment.psnr_db === null) return "–";
  const { psnr_low_db: low, psnr_high_db: high } = assessment;
  if (low >= 40) return "40 dB or more";
  return high >= 40 ? `${low} dB or more` : `${low} to ${high} dB`;
}

/** 75 -> "1 min 15 s". */
export function duration(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  const whole = Math.max(0, Math.round(seconds));
  if (whole < 60) return `${whole} s`;
  if (whole < 3600) return `${Math.floor(whole / 60)} min ${whole % 60} s`;
  if (whole < 86400) return `${Math.floor(whole / 3600)} h ${Math.floor((whole % 3600) / 60)} min`;
  return `${Math.floor(whole / 86400)} d ${Math.floor((whole % 86400) / 3600)} h`;
}

/** 1536 -> "1.5 KiB". */
export function bytes(count) {
  const units = ["B", "KiB", "MiB", "GiB", "TiB"];
  let unit = 0;
  while (count >= 1024 && unit < units.length - 1) {
    count /= 1024;
    unit += 1;
  }
  return `${unit === 0 || count >= 100 ? Math.round(count) : count.toFixed(1)} ${units[unit]}`;
}

const clock = new Intl.DateTimeFormat(undefined, { hour: "2-digit", minute: "2-digit" });
const day = new Intl.DateTimeFormat(undefined, { day: "numeric", month: "short" });
const full = new Intl.DateTimeFormat(undefined, { dateStyle: "medium", timeStyle: "medium" });

/** Date and time of day. */
export function moment(text) {
  if (!text) return "–";
  const when = new Date(text);
  return `${day.format(when)} ${clock.format(when)}`;
}

/** Full date and time. */
export function momentInFull(text) {
  return text ? full.format(new Date(text)) : "–";
}

/** A number with `digits` significant digits. */
export function figure(value, digits = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value !== 0 && (Math.abs(value) < 1e-3 || Math.abs(value) >= 1e5)) return value.toExponential(digits - 1);
  return String(Number(value.toPrecision(digits)));
}

/** A number that somebody stated, with all digits of its single precision. */
export function exact(value) {
  return value === null || value === undefined ? "–" : String(Number(value.toPrecision(7)));
}

/** Last 8 characters of an identifier; they differ even between resources created at the same time. */
export function short(id) {
  return id.slice(-8);
}

/** Label or name; if there is none, a text with the short identifier. */
export function nameOf(thing) {
  return thing.label ?? thing.name ?? `unnamed ${short(thing.id)}`;
}

/** "8 × 256 × 256", and the number of snapshots if there are several. */
export function shapeOf(job) {
  const { frames, height, width, mosaic } = job.shape;
  const count = job.snapshots.count;
  return `${frames} × ${height} × ${width}${mosaic ? " in colour" : ""}${count > 1 ? `, ${count} snapshots` : ""}`;
}

/** Current stage of a job. */
export function stageOf(job) {
  const words = {
    waiting: "waiting",
    preparing: "estimating the brightness",
    tv: "total variation",
    deep: "deep denoiser",
    nonlocal: "nonlocal prior",
    assembling: "writing frames",
    ended: "",
  };
  const stage = job.progress.stage;
  return words[stage] ?? stage;
}

/** Remaining time of an active job, or duration of a job that has ended. */
export function timeOf(job) {
  const { eta_seconds: eta, queue_position: position } = job.progress;
  if (job.state === "queued") return [position && `position ${position} in the queue`, eta === null ? "no worker running" : `done in up to about ${duration(eta)}`].filter(Boolean).join(", ");
  if (job.state === "running") return eta === null ? "no worker running" : `up to about ${duration(eta)} left`;
  if (job.state === "cancelling") return "stopping";
  if (!job.started_at || !job.finished_at) return "";
  const seconds = (new Date(job.finished_at) - new Date(job.started_at)) / 1000;
  return `${job.state === "succeeded" ? "took" : "after"} ${seconds < 1 ? "less than 1 s" : duration(seconds)}`;
}

/** Maximum number of iterations of a schedule on one tile. */
export function iterationsOf(schedule) {
  return schedule.stages.reduce((sum, stage) => sum + stage.iterations, 0);
}

/** A succeeded job in one word, as kind and text: its findings limit the grade of its expected PSNR. */
export function verdictOf(job) {
  if (job.warnings.some((item) => item.severity === "error")) return ["bad", "bad"];
  if (job.warnings.length > 0 || job.assessment?.psnr_db === null) return ["usable", "doubtful"];
  return job.assessment ? [job.assessment.grade, job.assessment.grade] : ["unknown", "not judged"];
}

/** Number and highest severity of a job's findings; null if there are none. */
export function doubts(job) {
  const errors = job.warnings.filter((item) => item.severity === "error").length;
  const warnings = job.warnings.length - errors;
  const count = (number, word) => number > 0 && `${number} ${word}${number > 1 ? "s" : ""}`;
  if (job.warnings.length === 0) return null;
  return { severity: errors > 0 ? "error" : "warning", text: [count(errors, "error"), count(warnings, "warning")].filter(Boolean).join(", ") };
}
