// A new job in three steps: calibration, measurement, and reconstruction with an estimate of its cost.

import { announce, calmly, facts, h, put, say } from "./dom.js";
import { askAbout, askExtent, askFrames, askMove, askScale, askWindow } from "./questions.js";
import { dropZone, problem } from "./drop.js";
import { bytes, exact, figure, roughly } from "./format.js";
import { Captures } from "./captures.js";
import { findings, grade } from "./report.js";
import { create, isAborted, get, send } from "./api.js";
import { dispersionFields, furtherFields, given, numberField, partFields, shiftFields, textField } from "./fields.js";
import { glance } from "./calibrations.js";

const HINT = "npy, npz, TIFF, PNG, .mat, HDF5, or a ZIP archive of images";

export async function submit(root, [query], signal) {
  const form = { calibration: null, measurement: null };
  const [known, algorithms, me] = await Promise.all([get("/v1/calibrations?limit=200", signal), get("/v1/algorithms", signal), get("/v1/me", signal)]);
  if (me.role === "read") {
    dispatchEvent(new CustomEvent("forbidden", { detail: "this needs the role submit; the token has read" }));
    return;
  }
  const button = h("button", { type: "submit", class: "primary large", disabled: true }, "Submit the job");
  const result = h("div", { "aria-live": "polite" });
  const job = jobStep(algorithms.items.filter((item) => item.planned_iterations > 0), form, signal);
  const changed = () => {
    button.disabled = !form.measurement;
    job.renew();
    if (form.measurement) job.offer().catch((error) => isAborted(error) || put(result, problem(error)));
  };
  const measurement = measurementStep(form, changed, signal);
  const calibration = calibrationStep(form, known.items.filter((item) => item.state === "ready"), measurement.wake, query.get("calibration"), signal);
  form.vary = calibration.vary;
  const finish = h("section", { class: "card finish", "aria-label": "Submit" }, h("h2", null, "Cost"), job.estimate, h("div", { class: "row" }, button), result);
  const element = h("form", { class: "steps" }, calibration.element, measurement.element, job.element, finish);
  element.addEventListener("submit", async (event) => {
    event.preventDefault();
    button.disabled = true;
    try {
      const made = await send("POST", "/v1/jobs", job.request());
      announce("Job submitted");
      location.hash = `#/jobs/${made.id}`;
    } catch (error) {
      put(result, problem(error));
      button.disabled = false;
    }
  });
  root.append(h("h1", null, "New job"), element);
}

function step(number, title, ...content) {
  return h("section", { class: "card step", "aria-label": title }, h("h2", null, h("span", { class: "stepnumber" }, number), title), content);
}

/** A drop zone for a file that may be absent, in a closed group. `value()` is its hash or null; `changed()` is called after a change. */
function optionalFile(id, title, hint, signal, changed) {
  let held = null;
  const take = (sha256) => {
    held = sha256;
    forget.hidden = held === null;
    changed();
  };
  const zone = dropZone(id, title, hint, signal, async (blob) => take(blob.sha256));
  const forget = h("button", { type: "button", class: "small below", hidden: true, onclick: () => {
    zone.clear();
    take(null);
  } }, `Remove the ${title[0].toLowerCase()}${title.slice(1)}`);
  return { element: h("details", null, h("summary", null, title), zone.element, forget), value: () => held };
}

/** A group of radio buttons. */
function choice(name, label, options, chosen, changed) {
  const input = ([value, text]) => h("label", { class: "radio" }, h("input", { type: "radio", name, value, checked: value === chosen, onchange: () => changed(value) }), text);
  return h("fieldset", { class: "choice" }, h("legend", null, label), options.map(input));
}

const SPECTRAL = "spectral";
const SENSORS = [["", "grey"], ...["rggb", "bggr", "grbg", "gbrg"].map((name) => [name, `in colour, ${name.toUpperCase()}`]), [SPECTRAL, "behind a prism or grating (spectral)"]];

function calibrationStep(form, known, wake, wanted, signal) {
  const verdict = h("div", { class: "verdict", "aria-live": "polite" });
  const use = (calibration) => {
    form.calibration = calibration;
    wake();
  };
  const name = textField("calibration-name", "Name of the calibration", "bench 3, f/8");
  const sensor = h("select", { id: "mosaic" }, SENSORS.map(([value, text]) => h("option", { value }, text)));
  const sensorLabel = h("label", { for: "mosaic" }, "The sensor is", sensor);
  const nameRow = h("div", { class: "fields" }, name.element, sensorLabel);
  const isSpectral = () => sensor.value === SPECTRAL;
  const bad = optionalFile("bad-pixels", "Map of bad pixels", "Optional: an image of the size of the masks that is not 0 at bad pixels. The reconstruction leaves these pixels out.", signal, () => kind === "masks" && made.repeat());
  const settings = () => given({ name: name.value(), mosaic: isSpectral() ? null : sensor.value || null, bad_pixels: bad.value() });
  const made = masks(() => given({ ...settings(), dispersion: isSpectral() ? dispersion.value() : null }), use, verdict, signal);
  const dispersion = dispersionFields(() => made.repeat());
  // A change of the sensor repeats the request with the same file.
  sensor.addEventListener("change", () => {
    arrange();
    made.repeat();
  });
  const parts = { known: stored(known, wanted, use, signal), masks: made, captures: captures(settings, use, verdict, signal) };
  const options = [known.length > 0 && ["known", "A stored calibration"], ["masks", "Masks"], ["captures", "Raw captures"]].filter(Boolean);
  let kind = options[0][0];
  const arrange = () => {
    // Captures are of one mask per frame.
    [...sensor.options].at(-1).disabled = kind === "captures";
    if (kind === "captures" && isSpectral()) sensor.value = "";
    dispersion.element.hidden = !isSpectral() || kind !== "masks";
  };
  const show = (value) => {
    kind = value;
    for (const [key, part] of Object.entries(parts)) part.element.hidden = key !== value;
    nameRow.hidden = bad.element.hidden = value === "known";
    arrange();
    put(verdict);
    use(null);
    parts[value].wake?.();
  };
  const radios = choice("calibration-kind", "What do you have?", options, kind, show);
  const element = step(1, "Calibration", radios, nameRow, dispersion.element, Object.values(parts).map((part) => part.element), bad.element, verdict);
  queueMicrotask(() => show(kind));
  /** Makes another calibration from the masks of the present one, with another window or other masks of a spectral camera. */
  const vary = ({ crop, mask }) => {
    const item = form.calibration;
    if (kind !== "masks") {
      radios.querySelector("[value=masks]").checked = true;
      show("masks");
      name.input.value = item.name ?? "";
      sensor.value = item.dispersion ? SPECTRAL : item.mosaic ?? "";
      made.adopt(item);
    }
    if (item.dispersion) dispersion.set({ ...item.dispersion, ...given({ mask: mask ?? null }) });
    if (crop) made.part.set(crop);
    arrange();
    made.repeat();
  };
  return { element, vary };
}

/** Stored calibrations, each with a mask, name and grade. */
function stored(known, wanted, use, signal) {
  const chosen = () => known.find((item) => item.id === element.querySelector("input:checked")?.value) ?? null;
  const wake = () => use(chosen());
  const option = (item) => h("label", { class: "pickone" }, h("input", { type: "radio", name: "calibration", value: item.id, checked: item.id === wanted, onchange: wake }), ...glance(item, signal));
  const element = h("div", { class: "pickings", role: "radiogroup", "aria-label": "Calibrations" }, known.map(option));
  const missing = wanted && !known.some((item) => item.id === wanted) && h("p", { class: "warn" }, "The calibration of this link does not exist. Select another one.");
  return { element: h("div", null, missing, element), wake };
}

function masks(settings, use, verdict, signal) {
  // The file that was dropped last, with the full scale, array and axes stated for it, and the number of the latest attempt.
  let [last, attempt] = [null, 0];
  const repeat = () => last && make(...last).catch((error) => put(verdict, problem(error)));
  const part = partFields("masks-part", true, repeat);
  const make = async (sha256, stated) => {
    attempt += 1;
    const mine = attempt;
    last = [sha256, stated];
    use(null);
    put(verdict);
    try {
      const item = await create("/v1/calibrations", { masks: sha256, ...settings(), ...part.value(), ...stated }, signal);
      // A later attempt has replaced this one.
      if (mine !== attempt) return;
      const again = (full_scale) => make(sha256, { ...stated, full_scale }).catch((later) => put(verdict, problem(later)));
      put(verdict, accepted(item, signal), h("details", null, h("summary", null, `Full scale of the masks: ${exact(item.full_scale)}`), askScale(again, "Which stored number means 1, an open mask?")));
      use(item);
    } catch (error) {
      if (mine !== attempt) return;
      if (isAborted(error)) throw error;
      const again = (next) => make(sha256, next).catch((later) => put(verdict, problem(later)));
      put(verdict, problem(error), askAbout(error, sha256, stated, again, { frames: () => askFrames(error, part, repeat) }));
    }
  };
  const drop = dropZone("masks", "Calibration set", `one mask per frame, or the only mask of a spectral camera: ${HINT}`, signal, (blob) => make(blob.sha256, {}));
  /** Takes the file of a stored calibration, with its settings. */
  const adopt = ({ masks: file, full_scale, axes, reading }) => {
    const { crop, frames, packing } = reading ?? {};
    const [first, last_] = frames ?? [null, null];
    part.set({ ...(crop ?? { row: null, column: null, height: null, width: null }), first, last: last_ });
    part.setPacking(packing);
    last = [file, given({ full_scale, axes })];
  };
  return { element: h("div", null, drop.element, part.element), part, repeat, adopt };
}

function captures(settings, use, verdict, signal) {
  const button = h("button", { type: "button", class: "primary", disabled: true }, "Compute the masks");
  const found = new Captures(signal, () => (button.disabled = found.missing() !== null));
  button.addEventListener("click", async () => {
    button.disabled = true;
    use(null);
    try {
      const words = h("p", { class: "muted" });
      put(verdict, words);
      const during = ({ frames, percent }) => say(words, `Computing masks from ${frames} patterns: ${Math.floor(percent)} %`);
      const item = await create("/v1/calibrations", { captures: found.value(), ...settings() }, signal, during);
      put(verdict, accepted(item, signal));
      use(item);
    } catch (error) {
      if (!isAborted(error)) put(verdict, problem(error));
    }
    button.disabled = found.missing() !== null;
  });
  const element = h("div", null,
    h("p", { class: "muted" }, "Captures of a white board, all with the same exposure: one per pattern with the mask, and white and black without it. A black capture with the mask improves the result."),
    found.element, h("div", { class: "row" }, button));
  return { element };
}

function accepted(item, signal) {
  const dead = item.dead_pixels / (item.height * item.width);
  return [
    h("p", null, "The calibration is accepted."),
    facts([
      [item.dispersion ? "Masks of bands" : "Masks", `${item.frames} of ${item.height} × ${item.width}${item.sample ? `, ${item.sample} in ${item.format}` : ""}`],
      item.mosaic && ["Sensor", `in colour, ${item.mosaic.toUpperCase()}`],
      ["Mean transmission", figure(item.mask_mean)],
      ["Dead pixels", dead > 0 ? `${item.dead_pixels} (${figure(100 * dead, 2)} %): no light reaches them` : "none"],
      item.clipped_negatives > 0 && ["Values below 0", h("span", { class: "warn" }, `${item.clipped_negatives}, set to 0`)],
      ["Grade", [grade(item.id, signal), " ", h("a", { href: `#/calibrations/${item.id}`, target: "_blank" }, "Report (new tab)")]],
    ]),
  ];
}

const SEQUENCES = [["", "From the camera’s times"], ["contiguous", "Consecutive, without gaps"], ["separate", "Independent"]];

function measurementStep(form, changed, signal) {
  const verdict = h("div", { class: "verdict", "aria-live": "polite" });
  const wait = h("p", { class: "muted" }, "Select or create the calibration first.");
  const name = textField("measurement-name", "Name of the measurement", "shot 12");
  const [fps, exposure] = [numberField("fps", "Snapshots per second"), numberField("exposure", "Exposure in s")];
  const saturation = numberField("saturation", "Saturated from", 1);
  const sequence = h("select", { id: "sequence" }, SEQUENCES.map(([value, text]) => h("option", { value }, text)));
  const darks = [];
  const darkList = h("p", { class: "muted" });
  const held = h("div", { class: "row below", hidden: true }, darkList, h("button", { type: "button", class: "small", onclick: () => setDarks([]) }, "Remove the dark captures"));
  const setDarks = (next) => {
    darks.splice(0, darks.length, ...next);
    say(darkList, darks.length ? `The mean of ${darks.map((dark) => dark.name).join(", ")} is subtracted.` : "");
    held.hidden = darks.length === 0;
    if (last) make(last, known).catch((error) => put(verdict, problem(error)));
  };
  const part = partFields("data-part", false, () => last && make(last, known).catch((error) => put(verdict, problem(error))), [saturation]);
  // The file that was dropped last, the full scale and axes stated for it, and the number of the latest attempt.
  let [last, known, attempt] = [null, {}, 0];
  const make = async (sha256, stated = {}) => {
    attempt += 1;
    const mine = attempt;
    form.measurement = null;
    changed();
    put(verdict);
    const body = { name: name.value(), ...part.value(), ...stated, camera_fps: fps.value(), exposure_s: exposure.value(), saturation: saturation.value(), sequence: sequence.value || null };
    const again = (next) => make(sha256, next).catch((error) => put(verdict, problem(error)));
    [last, known] = [sha256, stated];
    try {
      const asked = { calibration: form.calibration.id, data: sha256, ...given(body), ...(darks.length ? { dark: darks.map((dark) => dark.sha256) } : {}) };
      const item = await create("/v1/measurements", asked, signal);
      // A later attempt has replaced this one.
      if (mine !== attempt) return;
      form.measurement = item;
    } catch (error) {
      if (mine !== attempt) return;
      if (isAborted(error)) throw error;
      const repeat = () => again(known);
      put(verdict, problem(error), askAbout(error, sha256, stated, again, {
        crop: () => askWindow(error, form, part, repeat),
        mask: () => askExtent(form),
      }));
      return;
    }
    const scale = askScale((full_scale) => again({ ...stated, full_scale }));
    const isDoubtful = form.measurement.warnings.some((item) => item.code === "level");
    const doubt = isDoubtful ? scale : h("details", null, h("summary", null, `Full scale of the measurement: ${exact(form.measurement.full_scale)}`), scale);
    put(verdict, fits(form.measurement), doubt, askMove(form, part, () => again(known)));
    changed();
  };
  // A change of these fields repeats the request with the same file.
  for (const input of [fps.input, exposure.input, saturation.input, sequence]) {
    input.addEventListener("change", () => last && make(last, known).catch((error) => put(verdict, problem(error))));
  }
  const drop = dropZone("data", "Measurement", `one or more snapshots: ${HINT}`, signal, (blob) => make(blob.sha256));
  const dark = dropZone("darks", "Dark captures", "Optional: every pixel of the coded aperture closed (LCoS all black), at the same exposure", signal, async (blob, file) => {
    setDarks([...darks, { sha256: blob.sha256, name: file.name }]);
  }, true);
  const inside = h("div", { hidden: true },
    h("div", { class: "fields" }, name.element, fps.element, exposure.element, h("label", { for: "sequence" }, "Sequence of snapshots", sequence)),
    h("div", { class: "two" }, drop.element, h("div", null, dark.element, held)), part.element);
  const wake = () => {
    attempt += 1;
    inside.hidden = !form.calibration;
    wait.hidden = !inside.hidden;
    form.measurement = null;
    put(verdict);
    // Try the file that was dropped for another calibration with this one.
    if (form.calibration && last) make(last, known).catch((error) => put(verdict, problem(error)));
    changed();
  };
  return { element: step(2, "Measurement", wait, inside, verdict), wake };
}

function fits(item) {
  const wrong = findings(item.warnings);
  const severe = item.warnings.some(({ severity }) => severity === "error");
  return [
    h("p", { class: severe ? "bad" : wrong ? "warn" : "good" }, severe ? "The measurement is accepted, but the checks found errors:" : wrong ? "The measurement is accepted with warnings:" : "The measurement fits the calibration."),
    wrong,
    facts([
      ["Snapshots", `${item.snapshots} of ${item.height} × ${item.width}, ${item.sample} in ${item.format}`],
      item.snapshots > 1 && ["Sequence", item.sequence === "contiguous" ? "consecutive, reconstructed jointly where that reduces the error" : "independent snapshots"],
    ]),
  ];
}

function jobStep(algorithms, form, signal) {
  const select = h("select", { id: "algorithm" }, algorithms.map((item) => h("option", { value: item.name, selected: item.name === "pnp-tv-fastdvdnet" }, item.name)));
  const label = textField("label", "Name of the job", "drop of milk, first try");
  const registration = shiftFields(() => renew());
  const priority = numberField("priority", "Priority, −100 to 0", 1);
  const plan = h("p", { class: "muted" });
  const estimate = h("div", { class: "estimate", "aria-live": "polite" });
  const request = () => ({ measurement: form.measurement?.id, algorithm: select.value, ...given({ label: label.value(), priority: priority.value(), truth: truth.value(), registration: registration.value() }), ...further.value() });
  const ask = calmly(250, async () => {
    if (!form.measurement || signal.aborted) return;
    try {
      const asked = JSON.stringify(request());
      const found = await send("POST", "/v1/jobs/estimate", request());
      if (form.measurement && JSON.stringify(request()) === asked) put(estimate, costs(found));
    } catch (error) {
      if (form.measurement) put(estimate, problem(error));
    }
  });
  const renew = () => {
    const item = algorithms.find((found) => found.name === select.value);
    say(plan, `${item.summary} At most ${item.planned_iterations} iterations per tile.`);
    if (!form.measurement) put(estimate, h("p", { class: "muted" }, "Time, memory and disk are estimated when the measurement is accepted."));
    ask();
  };
  const further = furtherFields(() => renew());
  const offer = async () => {
    const { items } = await get(`/v1/models?calibration=${form.calibration.id}`, signal);
    further.offer(items);
  };
  const truth = optionalFile("truth", "True frames", "Optional: the scene’s frames, if they are known. They measure the quality of the result.", signal, () => ask());
  select.addEventListener("change", renew);
  priority.input.addEventListener("change", renew);
  const element = step(3, "Reconstruction", h("div", { class: "fields" }, h("label", { for: "algorithm" }, "Algorithm", select), label.element, registration.elements, priority.element), plan, further.element, truth.element);
  queueMicrotask(renew);
  return { element, estimate, renew, request, offer };
}

/** Estimated time, computation, memory and disk space of a job. */
function costs(found) {
  const when = found.eta_seconds === null ? "not before a worker is running" : `in up to about ${roughly(found.eta_seconds)}`;
  return facts([
    ["Done", `${when}${found.queue_position > 1 ? `, position ${found.queue_position} in the queue` : ""}`],
    ["CPU time", `up to about ${roughly(found.cpu_seconds)}, ${found.tiles} ${found.tiles === 1 ? "tile" : "tiles"}`],
    ["Memory", `${bytes(found.worker_memory_bytes)} without the program`],
    ["Disk", `at most ${bytes(found.disk_bytes)}`],
  ]);
}
