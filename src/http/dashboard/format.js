// Formats numbers, times and states for display.

/** An expected PSNR; the model does not distinguish values above 40 dB. */
export const aboutDecibels = (psnr) => (psnr >= 40 ? "40 dB or more" : `${psnr.toFixed(1)} dB`);

/** The interval of an assessment's expected PSNR, or a dash where there is no figure. */
export function expectedRange(assessment) {
  if (!assessment || assessment.psnr_db === null) return "–";
  const { psnr_low_db: low, psnr_high_db: high } = assessment;
  if (low >= 40) return "40 dB or more";
  return high >= 40 ? `${low.toFixed(1)} dB or more` : `${low.toFixed(1)} to ${high.toFixed(1)} dB`;
}

/** An estimated duration without digits that are uncertain: 75 -> "2 min", 8000 -> "3 h". */
export function roughly(seconds) {
  const digit = seconds > 7200 ? 3600 : seconds > 60 ? 60 : 1;
  return duration(digit * Math.max(1, Math.ceil(seconds / digit)));
}

/** 75 -> "1 min 15 s". */
export function duration(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  const whole = Math.max(0, Math.round(seconds));
  if (whole === 0) return "< 1 s";
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

/** "10⁻⁵" for -5. */
export const powerOfTen = (power) => `10${String(power).replace(/./g, (sign) => "⁰¹²³⁴⁵⁶⁷⁸⁹"[sign] ?? "⁻")}`;

/** A number's text as in print: "-3.75e-5" -> "−3.75 × 10⁻⁵". */
const printed = (text) => String(text).replace("-", "−").replace(/e\+?(.*)$/, (_, power) => ` × ${powerOfTen(power.replace("−", "-"))}`);

/** A number with `digits` significant digits. */
export function figure(value, digits = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value !== 0 && (Math.abs(value) < 1e-3 || Math.abs(value) >= 1e5)) return printed(value.toExponential(digits - 1));
  return printed(Number(value.toPrecision(digits)));
}

/** A number that somebody stated, with all digits of its single precision. */
export function exact(value) {
  return value === null || value === undefined ? "–" : printed(Number(value.toPrecision(7)));
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

/** "28, 450 to 650 nm"; the number of bands, or "none", where no wavelengths are known. */
export function wavelengthsOf({ dispersion, shape }) {
  const nm = dispersion?.wavelengths;
  return nm ? `${nm.length}, ${figure(nm[0], 4)} to ${figure(nm.at(-1), 4)} nm` : dispersion ? String(shape.frames) : "none";
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

/** A job's state in a word. Only the verdict says whether the frames are good, so `succeeded` reads "finished". */
export const stateWord = (state) => (state === "succeeded" ? "finished" : state);

/** Factor and words of the unit of pixel values: the camera's counts, or multiples of a full scale of 1. */
export const unitOf = (fullScale) => ({ factor: fullScale, words: fullScale === 1 ? "× full scale" : "counts" });

/** A pixel value times the factor of its unit. Counts keep all their digits; shares have `digits` significant ones. */
export function inUnit(value, { factor }, digits = 3) {
  const counts = value * factor;
  if (factor === 1 || !Number.isFinite(counts)) return figure(value, digits);
  return Math.abs(counts) >= 1000 ? printed(Math.round(counts)) : figure(counts, Math.max(digits, 4));
}

/** The numbers of a pixel with their unit. */
export const valueIn = (value, unit) => `${value.map((one) => inUnit(one, unit, 4)).join(", ")} ${unit.words}`;

/** A pixel value in the camera's counts, and as a multiple of the full scale. */
export function inUnits(value, fullScale) {
  const share = `${figure(value)} × full scale`;
  return fullScale === 1 ? share : `${inUnit(value, unitOf(fullScale))} counts (${share})`;
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
  const { queue_position: position } = job.progress;
  return [job.state === "queued" && position && `position ${position} in the queue`, remaining(job)].filter(Boolean).join(", ");
}

/** Remaining time or duration of a job, without its position in the queue. */
export function remaining(job) {
  const { eta_seconds: eta } = job.progress;
  if (job.state === "queued") return eta === null ? "no worker running" : `done in up to about ${roughly(eta)}`;
  if (job.state === "running") return eta === null ? "no worker running" : `up to about ${roughly(eta)} left`;
  if (job.state === "cancelling") return "stopping";
  if (!job.started_at || !job.finished_at) return "";
  const seconds = (new Date(job.finished_at) - new Date(job.started_at)) / 1000;
  return `${job.state === "succeeded" ? "took" : "ended after"} ${duration(seconds)}`;
}

/** Maximum number of iterations of a schedule on one tile. */
export function iterationsOf(schedule) {
  return schedule.stages.reduce((sum, stage) => sum + stage.iterations, 0);
}

/** The findings of the checks of a job, and those reasons of its assessment that have other codes. */
export function findingsOf({ warnings }, assessment) {
  const codes = new Set(warnings.map(({ code }) => code));
  return [...warnings, ...(assessment?.reasons ?? []).filter(({ code }) => !codes.has(code))];
}

/**
 * The service's verdict on frames, as kind, word, title and reason. The list shows the word, the job's page the title and the
 * reason. `verdict` and `assessment` are those of the job or of one of its snapshots.
 */
export function verdictOf(job, { verdict, assessment } = job) {
  if (verdict === null) return ["unknown", "not judged", "Not judged", "Measurement and calibration fit each other. No quality can be predicted for this algorithm or sensor. Attach true frames, if you have them, to measure it."];
  const isWrong = findingsOf(job, assessment).some(({ severity }) => severity === "error");
  if (verdict === "bad" && isWrong) return [verdict, verdict, "Bad", "The checks found errors that make the frames wrong:"];
  if (verdict === "doubtful") return [verdict, verdict, "Doubtful", "The checks put the scale, the dark or the masks in doubt, and with them the frames:"];
  return [verdict, verdict, `Likely ${verdict}`, `${limitOf(verdict, assessment)} ${LOOK[verdict === "bad" || assessment.psnr_db < GOOD_DB ? verdict : measuredVerdict(assessment.psnr_db)[1]]}`];
}

/** Expected PSNR in dB from which frames are good, and the upper end of the interval below which they are bad, as in the service. */
const [GOOD_DB, BAD_DB] = [28, 22];

/** What decided a verdict without doubts: a figure and its threshold, a finding, or one of several snapshots. */
function limitOf(verdict, { psnr_db: psnr, psnr_high_db: high, reasons }) {
  if (verdict === "good") return `The expected PSNR has reached ${GOOD_DB} dB, the threshold for “good”.`;
  if (verdict === "bad" && high < BAD_DB) return `The whole interval of the expected PSNR is below ${BAD_DB} dB, the threshold for “usable”.`;
  if (verdict === "usable" && psnr < GOOD_DB) return `The expected PSNR is below ${GOOD_DB} dB, the threshold for “good”.`;
  return reasons.some(({ code }) => code !== "uneven_error") ? "The finding below limits the verdict." : "The verdict is that of the worst snapshot.";
}

/** The look of frames of a range of the PSNR. */
const LOOK = { excellent: "Errors are hard to see.", good: "Detail is softened.", usable: "Texture is lost.", bad: "Only coarse shapes are correct." };

/** Verdicts on a measured PSNR: kind, word, title, reason, and the lower limit in dB, in descending order. */
const LEVELS = [
  ["good", "excellent", "Excellent", `35 dB or more. ${LOOK.excellent}`, 35],
  ["good", "good", "Good", `28 to 35 dB. ${LOOK.good}`, GOOD_DB],
  ["usable", "usable", "Usable", `22 to 28 dB. ${LOOK.usable}`, BAD_DB],
  ["bad", "bad", "Bad", `Less than 22 dB. ${LOOK.bad}`, -Infinity],
];

/** The verdict on a PSNR against true frames, as `verdictOf`; null means that the frames are identical. */
export function measuredVerdict(psnr) {
  if (psnr === null) return ["good", "identical", "Identical to the true frames", LEVELS[0][3]];
  return LEVELS.find(([, , , , least]) => psnr >= least).slice(0, 4);
}

/** A measured PSNR; null means that the frames are identical. */
export const decibels = (psnr) => (psnr === null ? "∞ dB" : `${figure(psnr, 3)} dB`);

/** Number and highest severity of a job's findings; null if there are none. */
export function doubts(job) {
  const found = findingsOf(job, job.assessment);
  // A finding counts once, even if several snapshots have it.
  const distinct = (severity) => new Set(found.filter((item) => item.severity === severity).map((item) => item.code)).size;
  const [errors, warnings] = [distinct("error"), distinct("warning")];
  const count = (number, word) => number > 0 && `${number} ${word}${number > 1 ? "s" : ""}`;
  if (found.length === 0) return null;
  return { severity: errors > 0 ? "error" : "warning", details: found.map((item) => item.detail), text: [count(errors, "error"), count(warnings, "warning")].filter(Boolean).join(", ") };
}
