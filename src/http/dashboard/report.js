// The report on a calibration: grade, findings with remedies, and correlation of the masks.

import { capital, facts, h, marked, put, s } from "./dom.js";
import { figure } from "./format.js";
import { isAborted, get } from "./api.js";

/** List of findings with their remedies; null if there are none. */
export function findings(found) {
  if (!found?.length) return null;
  return h("ul", { class: "findings" }, repeated(found).map((same) => {
    const [item] = same;
    const about = same.length > 1 ? `${same.length} snapshots (${ranges(same.map(({ snapshot }) => snapshot))}); in snapshot ${item.snapshot}: ` : Number.isInteger(item.snapshot) ? `Snapshot ${item.snapshot}: ` : "";
    return h("li", { class: item.severity },
      h("p", null, h("b", null, item.severity === "error" ? "Error: " : "Warning: "), about, marked(item.detail)),
      item.remedy && h("p", null, h("b", null, "What to do: "), marked(item.remedy)));
  }));
}

/** The findings in groups: one code and severity in several snapshots is one group. */
export function repeated(found) {
  const groups = new Map();
  found.forEach((item, index) => {
    const key = Number.isInteger(item.snapshot) ? `${item.code} ${item.severity}` : `alone ${index}`;
    groups.set(key, [...(groups.get(key) ?? []), item]);
  });
  return [...groups.values()];
}

/** [0, 1, 2, 5] -> "0 to 2, 5". */
function ranges(numbers) {
  const sorted = [...numbers].sort((one, other) => one - other);
  const runs = [];
  for (const number of sorted) {
    if (runs.at(-1)?.[1] === number - 1) runs.at(-1)[1] = number;
    else runs.push([number, number]);
  }
  return runs.map(([first, last]) => (first === last ? first : `${first} to ${last}`)).join(", ");
}

/** Milliseconds between requests for a grade that does not exist yet. */
const AGAIN_MS = 1000;

/** Grade of a calibration, loaded when the element becomes visible and the grade exists. */
export function grade(id, signal) {
  const element = h("span", { class: "grade masks" }, " ");
  const ask = async () => {
    try {
      const { grade: found, findings: reasons } = await get(`/v1/calibrations/${id}/report`, signal);
      element.classList.add(found);
      put(element, found, reasons.length > 0 && h("span", { class: "muted" }, ` ${reasons.length} ${reasons.length === 1 ? "finding" : "findings"}`));
    } catch (error) {
      if (isAborted(error)) return;
      const waits = error.code === "not_ready";
      put(element, h("span", { class: "muted" }, waits ? "not graded yet" : "no grade"));
      if (waits && element.isConnected) setTimeout(ask, AGAIN_MS);
    }
  };
  const watch = new IntersectionObserver((entries) => {
    if (!entries.some((entry) => entry.isIntersecting)) return;
    watch.disconnect();
    ask();
  });
  watch.observe(element);
  signal.addEventListener("abort", () => watch.disconnect(), { once: true });
  return element;
}

/** Card with the report, which is loaded when it exists. */
export function report(item, signal) {
  const body = h("div", null, h("p", { class: "muted" }, "…"));
  const element = h("section", { class: "card", "aria-label": "Report" },
    h("h2", { class: "row" }, "Are the masks good?", h("span", { class: "grow" }), h("a", { href: `/view/calibrations/${item.id}/report.html`, target: "_blank", rel: "noopener" }, "Printable version (new tab)")), body);
  load(item, body, signal);
  return element;
}

async function load(item, body, signal) {
  try {
    show(body, await get(`/v1/calibrations/${item.id}/report`, signal));
  } catch (error) {
    if (signal.aborted) return;
    put(body, h("p", { class: "muted" }, error.message));
    // A worker is computing the report.
    if (error.code === "not_ready") setTimeout(() => signal.aborted || load(item, body, signal), 2000);
  }
}

function show(body, found) {
  const { masks, captures } = found;
  put(body,
    h("p", { class: `judgement masks ${found.grade}` }, capital(found.grade)),
    findings(found.findings) ?? h("p", { class: "muted" }, "No fault found in the masks alone. Each measurement is checked for whether it belongs to them."),
    h("div", { class: "figurepair" }, matrix(masks), bars(masks.frame_means)),
    h("details", null, h("summary", null, "All figures"), facts([
      ["Standard deviation over the frames", figure(masks.deviation)],
      ["1st to 99th percentile", `${figure(masks.percentile_1)} to ${figure(masks.percentile_99)}`],
      ["Gram diagonal", `${figure(masks.gram[0])} to ${figure(masks.gram[2])}, mean ${figure(masks.gram[1])}`],
      ["Pixels open in all masks", masks.stuck_pixels],
      ["Values at 0", masks.values_at_zero],
      masks.correlation_mean !== null && ["Correlation of two masks", `mean ${figure(masks.correlation_mean)}, maximum ${figure(masks.correlation_largest)}`],
      captures && ["Light throughput", figure(captures.light_throughput)],
      captures && ["Noise of a mask value", figure(captures.noise)],
      captures && ["Dynamic range", captures.dynamic_range_db === null ? "–" : `${figure(captures.dynamic_range_db)} dB`],
      captures && ["Evenness of the illumination", figure(captures.illumination_flatness)],
    ])));
}

/** Explanation of the matrix for newcomers. */
function meaning({ correlation_mean: mean, correlation_largest: largest }) {
  return mean !== null && `Each cell shows the correlation of two masks, from 0 (empty) to 1 (full). The diagonal is each mask with itself; all other cells should be pale. The largest correlation is ${figure(largest)}.`;
}

/** Correlation matrix of the masks: blue above 0, orange below. */
function matrix(masks) {
  const { correlation: values } = masks;
  const count = values.length;
  const cell = (value, row, column) => s("rect", {
    x: column, y: row, width: 1.02, height: 1.02, class: value < 0 ? "less" : "more", "fill-opacity": Math.min(1, Math.abs(value)).toFixed(3),
  }, s("title", null, `masks ${row + 1} and ${column + 1}: ${figure(value)}`));
  // Sample long series, so that the matrix has at most 64 x 64 elements.
  const step = Math.max(1, Math.ceil(count / 64));
  const kept = values.filter((_, row) => row % step === 0).map((line) => line.filter((_, column) => column % step === 0));
  return h("figure", null, h("figcaption", { class: "muted" }, step > 1 ? `Correlation of every ${step}th mask` : "Correlation of the masks"),
    s("svg", { viewBox: `0 0 ${kept.length} ${kept.length}`, class: "matrix", role: "img", "aria-label": `Correlation matrix of ${count} masks` },
      kept.map((line, row) => line.map((value, column) => cell(value, row, column)))),
    h("p", { class: "muted below" }, meaning(masks)));
}

/** Bar chart of the mean of each mask. */
function bars(values) {
  const most = Math.max(...values, 1e-9);
  const [width, height] = [300, 120];
  const each = width / values.length;
  const bar = (value, index) => s("rect", {
    x: (index * each + each * 0.1).toFixed(2), width: (each * 0.8).toFixed(2), y: (height - (height * Math.max(0, value)) / most).toFixed(2), height: ((height * Math.max(0, value)) / most).toFixed(2), class: "more",
  }, s("title", null, `mask ${index + 1}: ${figure(value)}`));
  return h("figure", null, h("figcaption", { class: "muted" }, `Mean of each mask, from 0 to ${figure(most)}`),
    s("svg", { viewBox: `0 0 ${width} ${height}`, class: "bars", role: "img", "aria-label": `Means of ${values.length} masks, ${figure(Math.min(...values))} to ${figure(most)}` }, values.map(bar)));
}
