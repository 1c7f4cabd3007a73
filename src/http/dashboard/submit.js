// A new job: drop the calibration set and the measurement, read what the check says, submit.

import { announce, facts, h, put, say } from "./dom.js";
import { bytes, figure, moment, nameOf } from "./format.js";
import { findings } from "./report.js";
import { gaveUp, get, send, upload } from "./api.js";

const HINT = "npy, TIFF, PNG, .mat or HDF5";

export async function submit(root, [query], signal) {
  const form = { calibration: null, measurement: null };
  const [known, algorithms] = await Promise.all([get("/v1/calibrations?limit=200", signal), get("/v1/algorithms", signal)]);
  const button = h("button", { type: "submit", class: "primary", disabled: true }, "Submit the job");
  const result = h("div", { "aria-live": "polite" });
  const ready = () => (button.disabled = !form.measurement);
  const reset = () => {
    form.measurement = null;
    ready();
  };
  const measurement = measurementStep(form, ready, reset, signal);
  const calibration = calibrationStep(form, known.items.filter((item) => item.state === "ready"), measurement.wake, reset, query.get("calibration"), signal);
  const job = jobStep(algorithms.items.filter((item) => item.planned_iterations > 0));
  const element = h("form", { class: "steps" }, calibration, measurement.element, job.element, h("div", { class: "row" }, button), result);
  element.addEventListener("submit", async (event) => {
    event.preventDefault();
    button.disabled = true;
    try {
      const made = await send("POST", "/v1/jobs", { measurement: form.measurement.id, ...job.values() });
      announce("The job is accepted");
      location.hash = `#/jobs/${made.id}`;
    } catch (error) {
      put(result, problem(error));
      button.disabled = false;
    }
  });
  root.append(h("h1", null, "New job"), element);
}

function step(number, title, ...content) {
  return h("section", { class: "card step", "aria-label": title }, h("h2", null, `${number}. ${title}`), content);
}

function calibrationStep(form, known, chosen, reset, wanted, signal) {
  const verdict = h("div", { class: "verdict", "aria-live": "polite" });
  const select = h("select", { id: "calibration" }, h("option", { value: "" }, "a new one, from a file"),
    known.map((item) => h("option", { value: item.id, selected: item.id === wanted }, `${nameOf(item)} (${item.frames} × ${item.height} × ${item.width}, ${moment(item.created_at)})`)));
  const name = textField("calibration-name", "Its name", "bench 3, f/8");
  const scale = scaleField("calibration-scale");
  const fresh = h("div", null, h("div", { class: "fields" }, name.element, scale.element));
  const use = (calibration) => {
    form.calibration = calibration;
    reset();
    put(verdict, calibration && calibrationVerdict(calibration));
    chosen();
  };
  const drop = dropZone("masks", "Calibration set", `one mask a frame: ${HINT}`, signal, async (sha256) => {
    use(null);
    use(await send("POST", "/v1/calibrations", { masks: sha256, ...given({ name: name.value(), full_scale: scale.value() }) }));
  });
  fresh.append(drop);
  const pick = () => {
    fresh.hidden = select.value !== "";
    use(known.find((item) => item.id === select.value) ?? null);
  };
  select.addEventListener("change", pick);
  const element = step(1, "Calibration", known.length ? h("div", { class: "fields" }, h("label", { for: "calibration" }, "Calibration", select)) : null, fresh, verdict);
  queueMicrotask(pick);
  return element;
}

function measurementStep(form, ready, reset, signal) {
  const verdict = h("div", { class: "verdict", "aria-live": "polite" });
  const wait = h("p", { class: "muted" }, "First choose or drop the calibration.");
  const [name, scale] = [textField("measurement-name", "Its name", "shot 12"), scaleField("measurement-scale")];
  const [fps, exposure] = [numberField("fps", "Snapshots a second"), numberField("exposure", "Exposure in s")];
  const drop = dropZone("data", "Measurement", `one or more snapshots: ${HINT}`, signal, async (sha256) => {
    reset();
    put(verdict);
    const body = { name: name.value(), full_scale: scale.value(), camera_fps: fps.value(), exposure_s: exposure.value() };
    form.measurement = await send("POST", "/v1/measurements", { calibration: form.calibration.id, data: sha256, ...given(body) });
    put(verdict, measurementVerdict(form.measurement));
    ready();
  });
  const inside = h("div", { hidden: true }, h("div", { class: "fields" }, name.element, scale.element, fps.element, exposure.element), drop);
  const wake = () => {
    inside.hidden = !form.calibration;
    wait.hidden = !inside.hidden;
    put(verdict);
  };
  return { element: step(2, "Measurement", wait, inside, verdict), wake };
}

function jobStep(algorithms) {
  const choice = h("select", { id: "algorithm" }, algorithms.map((item) => h("option", { value: item.name, selected: item.planned_passes > 0 }, item.name)));
  const label = textField("label", "Label", "drop of milk, first try");
  const priority = numberField("priority", "Priority (−100 to 100)", "any");
  const plan = h("p", { class: "muted" });
  const tell = () => {
    const item = algorithms.find((found) => found.name === choice.value);
    const passes = item.planned_passes ? `, ${item.planned_passes} of them with the deep denoiser` : "";
    say(plan, `At most ${item.planned_iterations} iterations${passes}; tiles of ${item.tile.size} × ${item.tile.size} pixels.`);
  };
  choice.addEventListener("change", tell);
  tell();
  const element = step(3, "Reconstruction", h("div", { class: "fields" }, h("label", { for: "algorithm" }, "Algorithm", choice), label.element, priority.element), plan);
  return { element, values: () => ({ algorithm: choice.value, ...given({ label: label.value(), priority: priority.value() }) }) };
}

/** Only what was given: nothing is guessed here, and the service has its own defaults. */
function given(values) {
  return Object.fromEntries(Object.entries(values).filter(([, value]) => value !== null));
}

function field(id, label, properties) {
  const input = h("input", { id, ...properties });
  return { input, element: h("label", { for: id }, label, input) };
}

function textField(id, label, placeholder) {
  const { input, element } = field(id, label, { type: "text", maxlength: 200, placeholder, autocomplete: "off" });
  return { element, value: () => input.value.trim() || null };
}

function numberField(id, label, stepBy) {
  const { input, element } = field(id, label, { type: "number", step: stepBy === "any" ? 1 : "any" });
  return { element, value: () => (input.value === "" ? null : Number(input.value)) };
}

function scaleField(id) {
  return numberField(id, "Full scale (empty: the type’s)");
}

/** A place to drop a file on, or to choose one by; `take(sha256)` gets the uploaded file. */
function dropZone(id, title, hint, signal, take) {
  const input = h("input", { type: "file", id, class: "unseen" });
  const text = h("span", { class: "muted" }, hint);
  const bar = h("progress", { max: 1, value: 0, hidden: true, "aria-label": `Upload of the ${title.toLowerCase()}` });
  const status = h("div", { class: "status", "aria-live": "polite" });
  const zone = h("label", { class: "drop", for: id }, h("b", null, title), h("span", null, "drop a file here, or choose one"), text, bar, input);
  let current = null;
  const start = async (file) => {
    if (!file) return;
    current?.abort();
    current = new AbortController();
    const mine = current;
    signal.addEventListener("abort", () => mine.abort());
    bar.hidden = false;
    put(status);
    try {
      const blob = await upload(file, (done, total) => {
        bar.value = total ? done / total : 0;
        say(text, `${file.name}: ${bytes(done)} of ${bytes(total)}`);
      }, mine.signal);
      say(text, `${file.name}: ${bytes(blob.size)}, is being checked …`);
      await take(blob.sha256);
      say(text, `${file.name}: ${bytes(blob.size)}`);
    } catch (error) {
      if (!gaveUp(error)) put(status, problem(error));
      if (mine === current) say(text, hint);
    }
    if (mine === current) bar.hidden = true;
    input.value = "";
  };
  input.addEventListener("change", () => start(input.files[0]));
  for (const kind of ["dragenter", "dragover"]) {
    zone.addEventListener(kind, (event) => {
      event.preventDefault();
      zone.classList.add("over");
    });
  }
  for (const kind of ["dragleave", "drop"]) zone.addEventListener(kind, () => zone.classList.remove("over"));
  zone.addEventListener("drop", (event) => {
    event.preventDefault();
    start(event.dataTransfer.files[0]);
  });
  return h("div", null, zone, status);
}

/** A refusal with each field that is wrong. */
function problem(error) {
  const errors = error.errors ?? [];
  const list = errors.length > 1 ? h("ul", null, errors.map((item) => h("li", null, `${item.pointer}: ${item.detail}`))) : null;
  return h("div", { class: "trouble", role: "alert" }, h("b", null, "Refused: "), errors.length > 1 ? null : error.message, list);
}

function calibrationVerdict(item) {
  const dead = item.dead_pixels / (item.height * item.width);
  return [
    h("p", { class: "good" }, "The calibration is taken."),
    facts([
      ["Masks", `${item.frames} of ${item.height} × ${item.width}, ${item.sample} in ${item.format}`],
      ["Mean transmission", figure(item.mask_mean)],
      ["Dead pixels", dead > 0 ? h("span", { class: "warn" }, `${item.dead_pixels} (${figure(100 * dead, 2)} %): nothing is known there`) : "none"],
      item.clipped_negatives > 0 && ["Values below 0", h("span", { class: "warn" }, `${item.clipped_negatives}, set to 0`)],
      ["Report", h("a", { href: `/v1/calibrations/${item.id}/report.html` }, "what is known of the masks")],
    ]),
  ];
}

function measurementVerdict(item) {
  const wrong = findings(item.warnings);
  return [
    h("p", { class: wrong ? "warn" : "good" }, wrong ? "The measurement is taken, but:" : "The measurement fits the calibration."),
    wrong,
    facts([
      ["Snapshots", `${item.snapshots} of ${item.height} × ${item.width}, ${item.sample} in ${item.format}`],
      ["Full scale", figure(item.full_scale)],
    ]),
  ];
}
