// The card "Have the masks moved?": the motion that the job found, as arrows over the sensor, and its gain.

import { figure } from "./format.js";
import { h, s } from "./dom.js";

/** Displacements in pixels that the arrow's scale fits; the largest one is half the sensor's shorter side. */
const SCALES = [0.25, 0.5, 1, 2, 4];

/** Findings on the place of the masks, which a registration answers. */
const ON_PLACE = ["moved_masks", "drifted_masks", "shifted_masks", "misplaced_masks"];
/** Warnings on the light of a measurement. A wrong dark or full scale changes the fit of the masks, like a motion. */
const ON_LIGHT = ["no_dark", "wrong_dark", "negative", "negative_offset", "level", "mask_scale", "missing_mask", "saturated"];

/** The first finding that makes the motion that a job has estimated uncertain. */
export function doubtOf({ registered, warnings }) {
  return registered?.uncertainty ? warnings.find(({ code, severity }) => !ON_PLACE.includes(code) && (severity === "error" || ON_LIGHT.includes(code))) : undefined;
}

/** The card of a job; null before the registration, and without one. */
export function registration(job) {
  const { registered: found } = job;
  if (!found) return null;
  const doubt = doubtOf(job);
  return h("section", { class: "card", "aria-label": "Registration" }, h("h2", null, "Have the masks moved?"),
    h("p", { class: "judgement" }, doubt ? "Not known" : answer(found)),
    h("p", { class: "muted" }, doubt ? doubted(found, doubt) : reason(found)),
    found.applied && !doubt && sensor(job));
}

/** Why the result of a registration says nothing while another finding stands. */
function doubted(found, { code }) {
  const used = found.applied ? `masks that are displaced ${directions(found)}` : "the masks as they were calibrated";
  return [`The frames use ${used}. While the finding `, h("code", null, code), " stands, no estimate of a motion is reliable: correct it, then reconstruct again."];
}

function answer({ applied, reason: doubt, shift, rotation, scale, uncertainty }) {
  if (!applied) return doubt ? "Not known" : "No, they fit";
  if (!uncertainty) return "Moved as stated";
  const turned = rotation === 0 && scale === 1 ? "" : ", and turned or grown";
  return `Yes, by ${figure(Math.hypot(...shift), 2)} pixels${turned}`;
}

/** The errors are squared. */
const percent = (squared) => `${figure(100 * Math.sqrt(squared), 3)} %`;

function reason(found) {
  const { applied, reason: doubt, error_before: before, error_after: after } = found;
  if (doubt && !applied) return `Nothing was corrected: ${doubt}.`;
  const errors = before !== null && after !== null;
  if (!applied) return `${errors ? "No displacement lowers the error at hold-out pixels significantly. " : ""}The frames use the masks as they were calibrated.`;
  const way = directions(found);
  if (!errors) return `The frames use masks that are displaced ${way}.`;
  if (!found.uncertainty) return `The frames use masks that are displaced ${way}. The error at hold-out pixels is ${percent(before)} of the brightness without this displacement and ${percent(after)} with it.`;
  return `The masks have moved ${way} since the calibration. The frames use the moved masks, which lowers the error at hold-out pixels from ${percent(before)} to ${percent(after)} of the brightness. Calibrate again as soon as the optics are stable.`;
}

/** With standard errors as many digits as they allow. */
function rounded(value, error) {
  if (!error) return figure(value, 5);
  const places = Math.min(6, Math.max(0, Math.ceil(-Math.log10(error))));
  return `${value.toFixed(places)} ± ${error.toFixed(places)}`;
}

/** { shift: [1.59, -1.2], rotation: 0.1, scale: 1 } -> "by 1.59 pixels downwards and 1.2 pixels to the left, and turned by 0.1° clockwise" */
function directions({ shift, rotation, scale, uncertainty }) {
  const names = [["downwards", "upwards"], ["to the right", "to the left"]];
  const one = (by, axis) => {
    const size = rounded(Math.abs(by), uncertainty?.shift[axis]);
    return `${size} ${size === "1" ? "pixel" : "pixels"} ${names[axis][by < 0 ? 1 : 0]}`;
  };
  const growth = 100 * (scale - 1);
  const more = [
    rotation !== 0 && `turned by ${rounded(Math.abs(rotation), uncertainty?.rotation)}° ${rotation < 0 ? "anticlockwise" : "clockwise"}`,
    scale !== 1 && `${growth < 0 ? "shrunk" : "grown"} by ${rounded(Math.abs(growth), 100 * (uncertainty?.scale ?? 0))} %`,
  ].filter(Boolean);
  return [`by ${shift.map(one).join(" and ")}`, ...more].join(", and ");
}

/** The displacement [down, right] of masks at a place relative to the centre. */
function displacement({ shift, rotation, scale }, [row, column]) {
  const angle = (rotation * Math.PI) / 180;
  const [sine, cosine] = [Math.sin(angle), Math.cos(angle)];
  return [shift[0] + scale * (cosine * row + sine * column) - row, shift[1] + scale * (cosine * column - sine * row) - column];
}

/** The measurement with arrows, which are enlarged to be visible: one in the middle, or 3x3 if the masks have turned or grown. */
function sensor({ measurement, snapshots, shape, registered }) {
  const { height, width } = shape;
  const isShift = registered.rotation === 0 && registered.scale === 1;
  const parts = isShift ? [0] : [-1 / 3, 0, 1 / 3];
  const places = parts.flatMap((row) => parts.map((column) => [row * height, column * width]));
  const moves = places.map((place) => displacement(registered, place));
  const longest = Math.max(...moves.map((move) => Math.hypot(...move)));
  const most = SCALES.find((scale) => longest <= scale) ?? longest;
  const room = Math.min(height, width) / (isShift ? 2 : 3);
  const unit = room / most;
  const line = room / 30;
  const arrow = ([row, column], [down, right]) => {
    const [x0, y0] = [width / 2 + column - (right * unit) / 2, height / 2 + row - (down * unit) / 2];
    const [x1, y1] = [x0 + right * unit, y0 + down * unit];
    const angle = Math.atan2(y1 - y0, x1 - x0);
    const wing = (turn) => `${x1 - 5 * line * Math.cos(angle + turn)} ${y1 - 5 * line * Math.sin(angle + turn)}`;
    return `M${x0} ${y0}L${x1} ${y1}M${wing(0.5)}L${x1} ${y1}L${wing(-0.5)}`;
  };
  const label = `The masks are displaced ${directions({ ...registered, uncertainty: null })}`;
  return h("figure", { class: "shift" },
    s("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label },
      s("image", { href: `/view/measurements/${measurement}/pictures/snapshot-${snapshots.first}?size=512`, width, height, preserveAspectRatio: "none" }),
      s("path", { d: places.map((place, index) => arrow(place, moves[index])).join(""), "stroke-width": line })),
    h("figcaption", { class: "muted" }, isShift ? `The arrow is ${figure(unit, 2)} times as long as the displacement.` : `The arrows are ${figure(unit, 2)} times as long as the displacements.`));
}
