// Numbers and moments as people read them.

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

/** The time of a moment of today, with its day before that. */
export function moment(text) {
  if (!text) return "–";
  const when = new Date(text);
  const today = new Date().toDateString() === when.toDateString();
  return today ? clock.format(when) : `${day.format(when)} ${clock.format(when)}`;
}

/** A moment in full. */
export function momentInFull(text) {
  return text ? full.format(new Date(text)) : "–";
}

/** A number with as many digits as it is worth. */
export function figure(value, digits = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value !== 0 && (Math.abs(value) < 1e-3 || Math.abs(value) >= 1e5)) return value.toExponential(digits - 1);
  return String(Number(value.toPrecision(digits)));
}

/** The last part of an identifier, which differs even between things made together. */
export function short(id) {
  return id.slice(-8);
}

/** What a job is called. */
export function nameOf(thing) {
  return thing.label ?? thing.name ?? `unnamed ${short(thing.id)}`;
}

/** "8 × 256 × 256" with the number of snapshots where there are several. */
export function shapeOf(job) {
  const { frames, height, width } = job.shape;
  const count = job.snapshots.count;
  return `${frames} × ${height} × ${width}${count > 1 ? `, ${count} snapshots` : ""}`;
}

/** What a job is doing, in words. */
export function stageOf(job) {
  const words = {
    waiting: "waiting",
    preparing: "measuring the scale",
    tv: "total variation",
    deep: "deep denoiser",
    nonlocal: "nonlocal prior",
    assembling: "writing frames",
    ended: "",
  };
  const stage = job.progress.stage;
  return words[stage] ?? stage;
}
