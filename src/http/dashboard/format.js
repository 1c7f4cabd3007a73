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

/** An estimated duration without digits that are uncertain: 75 -> "2 min". */
export function roughly(seconds) {
  return duration(seconds > 60 ? 60 * Math.ceil(seconds / 60) : Math.max(1, seconds));
}

/** 75 -> "1 min 15 s". */
export function duration(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  const whole = Math.max(0, Math.round(seconds));
  if (whole < 60) return `${whole} s`;
  const pair = (large, one, small, other) => `${large} ${one}${small > 0 ? ` ${small} ${other}` : ""}`;
  if (whole < 3600) return pair(Math.floor(whole / 60), "min", whole % 60, "s");
  if (whole < 86400) return pair(Math.floor(whole / 3600), "h", Math.floor((whole % 3600) / 60), "min");
  return pair(Math.floor(whole / 86400), "d", Math.floor((whole % 86400) / 3600), "h");
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

/** "frame 12", or "band 12 · 540 nm" of a spectral camera. */
export function frameName({ dispersion }, frame) {
  const wavelength = dispersion?.wavelengths?.[frame - 1];
  return `${dispersion ? "band" : "frame"} ${frame}${wavelength === undefined ? "" : ` · ${figure(wavelength, 4)} nm`}`;
}

/** The axis of a job's frames, and their places on it: numbers from 1, or wavelengths. */
export function axisOf({ dispersion, shape }) {
  const numbers = Array.from({ length: shape.frames }, (_, index) => index + 1);
  if (!dispersion) return { spectral: false, name: "frame", xs: numbers };
  return dispersion.wavelengths ? { spectral: true, name: "wavelength in nm", xs: dispersion.wavelengths } : { spectral: true, name: "band", xs: numbers };
}

/** "8 × 256 × 256", and with `all` the number of snapshots if there are several. */
export function shapeOf(job, all = true) {
  const { frames, height, width, mosaic } = job.shape;
  const count = job.snapshots.count;
  return `${frames} × ${height} × ${width}${mosaic ? " in colour" : job.dispersion ? ", bands" : ""}${all && count > 1 ? `, ${count} snapshots` : ""}`;
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
  if (job.state === "queued") return [position && `position ${position} in the queue`, eta === null ? "no worker running" : `done in up to about ${roughly(eta)}`].filter(Boolean).join(", ");
  if (job.state === "running") return eta === null ? "no worker running" : `up to about ${roughly(eta)} left`;
  if (job.state === "cancelling") return "stopping";
  if (!job.started_at || !job.finished_at) return "";
  const seconds = (new Date(job.finished_at) - new Date(job.started_at)) / 1000;
  return `${job.state === "succeeded" ? "took" : "after"} ${seconds < 1 ? "less than 1 s" : duration(seconds)}`;
}

/** Maximum number of iterations of a schedule on one tile. */
export function iterationsOf(schedule) {
  return schedule.stages.reduce((sum, stage) => sum + stage.iterations, 0);
}

/**
 * The verdict on a job's frames, as kind, word, title and reason: its findings limit the grade of its expected PSNR. The
 * list shows the word, the job's page the title and the reason.
 */
export function verdictOf(job, assessment = job.assessment) {
  if (job.warnings.some((item) => item.severity === "error")) return ["bad", "bad", "Bad", "The checks found errors that make the frames wrong:"];
  if (job.warnings.length > 0) return ["usable", "doubtful", "Doubtful", "The checks found problems that may degrade the frames:"];
  if (assessment?.psnr_db === null) return ["usable", "doubtful", "Doubtful", "The quality of these frames can’t be predicted:"];
  if (assessment) return [assessment.grade, assessment.grade, `Likely ${assessment.grade}`, `Measurement and calibration fit each other. ${LIKE[assessment.grade]}`];
  return ["unknown", "not judged", "Not judged", "Measurement and calibration fit each other. No quality can be predicted for this algorithm or sensor. Attach true frames, if you have them, to measure it."];
}

/** Verdicts on a measured PSNR: kind, word, title, reason, and the lower limit in dB, in descending order. */
const LEVELS = [
  ["good", "excellent", "Excellent", "35 dB or more: errors are hard to see.", 35],
  ["good", "good", "Good", "28 to 35 dB: expect softened detail.", 28],
  ["usable", "usable", "Usable", "22 to 28 dB: expect lost texture.", 22],
  ["bad", "bad", "Bad", "Less than 22 dB: expect only coarse shapes.", -Infinity],
];

/** The verdict on a PSNR against true frames, as `verdictOf`; null means that the frames are identical. */
export function measuredVerdict(psnr) {
  if (psnr === null) return ["good", "identical", "Identical to the true frames", LEVELS[0][3]];
  return LEVELS.find(([, , , , least]) => psnr >= least).slice(0, 4);
}

/** A measured PSNR; null means that the frames are identical. */
export const decibels = (psnr) => (psnr === null ? "∞ dB" : `${figure(psnr, 3)} dB`);

/** The look of frames of a grade. */
const LIKE = {
  good: "Frames like these are close to the scene.",
  usable: "Frames like these lack texture.",
  bad: "Frames like these show only coarse shapes correctly.",
};

/** Number and highest severity of a job's findings; null if there are none. */
export function doubts(job) {
  // A finding counts once, even if several snapshots have it.
  const distinct = (severity) => new Set(job.warnings.filter((item) => item.severity === severity).map((item) => item.code)).size;
  const [errors, warnings] = [distinct("error"), distinct("warning")];
  const count = (number, word) => number > 0 && `${number} ${word}${number > 1 ? "s" : ""}`;
  if (job.warnings.length === 0) return null;
  return { severity: errors > 0 ? "error" : "warning", text: [count(errors, "error"), count(warnings, "warning")].filter(Boolean).join(", ") };
}
