// The card "Have the masks moved?": the displacement that the job found, as an arrow over the sensor, and its gain.

import { figure } from "./format.js";
import { h, s } from "./dom.js";

/** Displacements in pixels that the arrow's scale fits; the largest one is half the sensor's shorter side. */
const SCALES = [0.25, 0.5, 1, 2, 4];

/** The card of a job; null before the registration, and without one. */
export function registration(job) {
  const { registered: found } = job;
  if (!found) return null;
  return h("section", { class: "card", "aria-label": "Registration" }, h("h2", null, "Have the masks moved?"),
    h("p", { class: "judgement" }, answer(found)),
    h("p", { class: "muted" }, reason(found)),
    found.applied && sensor(job));
}

function answer({ applied, reason: doubt, shift, uncertainty }) {
  if (applied) return uncertainty ? `Yes, by ${figure(Math.hypot(...shift), 2)} pixels` : "Moved as stated";
  return doubt ? "Not known" : "No, they fit";
}

/** The errors are squared. */
const percent = (squared) => `${figure(100 * Math.sqrt(squared), 3)} %`;

function reason({ applied, reason: doubt, shift, uncertainty, error_before: before, error_after: after }) {
  if (doubt) return `Nothing was corrected: ${doubt}.`;
  const errors = before !== null && after !== null;
  if (!applied) return errors ? `No displacement lowers the error at hold-out pixels (${percent(before)}) significantly. The frames use the masks as they were calibrated.` : "The frames use the masks as they were calibrated.";
  const way = directions(shift, uncertainty);
  if (!errors) return `The frames use masks that are displaced ${way}.`;
  return `The masks have moved ${way} since the calibration. The frames use the moved masks, which lowers the error at hold-out pixels from ${percent(before)} to ${percent(after)}. Calibrate again as soon as the optics are stable.`;
}

/** [1.59, -1.2] -> "by 1.59 pixels downwards and 1.2 pixels to the left"; with standard errors, their digits are shown. */
function directions(shift, uncertainty) {
  const names = [["downwards", "upwards"], ["to the right", "to the left"]];
  const size = (by, axis) => {
    const error = uncertainty?.[axis];
    if (!error) return figure(by);
    const places = Math.min(6, Math.max(0, Math.ceil(-Math.log10(error))));
    return `${by.toFixed(places)} ± ${error.toFixed(places)}`;
  };
  const one = (by, axis) => `${size(Math.abs(by), axis)} pixels ${names[axis][by < 0 ? 1 : 0]}`;
  return `by ${shift.map(one).join(" and ")}`;
}

/** The measurement with the arrow, whose length is enlarged to be visible. */
function sensor({ measurement, snapshots, shape, registered }) {
  const { height, width } = shape;
  const [down, right] = registered.shift;
  const most = SCALES.find((scale) => Math.hypot(down, right) <= scale) ?? Math.hypot(down, right);
  const unit = Math.min(height, width) / 2 / most;
  const [x0, y0] = [width / 2 - (right * unit) / 2, height / 2 - (down * unit) / 2];
  const [x1, y1] = [x0 + right * unit, y0 + down * unit];
  const line = Math.min(height, width) / 60;
  const angle = Math.atan2(y1 - y0, x1 - x0);
  const wing = (turn) => `${x1 - 5 * line * Math.cos(angle + turn)} ${y1 - 5 * line * Math.sin(angle + turn)}`;
  return h("figure", { class: "shift" },
    s("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `The masks are displaced ${directions(registered.shift, null)}` },
      s("image", { href: `/view/measurements/${measurement}/pictures/snapshot-${snapshots.first}?size=512`, width, height, preserveAspectRatio: "none" }),
      s("path", { d: `M${x0} ${y0}L${x1} ${y1}M${wing(0.5)}L${x1} ${y1}L${wing(-0.5)}`, "stroke-width": line })),
    h("figcaption", { class: "muted" }, `The arrow is ${figure(unit, 2)} times as long as the displacement.`));
}
