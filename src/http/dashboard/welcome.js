// The first screen: purpose, three steps, and a job with sample data.

import { announce, h, put } from "./dom.js";
import { keepTruth } from "./storage.js";
import { send } from "./api.js";
import { WHAT } from "./signin.js";

const STEPS = [
  ["Calibrate", "Upload the masks, or raw captures of a white board. A report grades them and says what to improve."],
  ["Measure", "Upload one or more coded images. Each is checked against its calibration before the computation starts."],
  ["Reconstruct", "Watch the frames appear, judge them, and download EXR stacks or arrays with a record of how they were made."],
];

/** The introduction for new users. */
export function welcome() {
  const status = h("div", { "aria-live": "polite" });
  const button = h("button", { type: "button", class: "primary large writes", id: "sample" }, "Try it with sample data");
  const submit = async (request) => {
    button.disabled = true;
    put(status, h("p", { class: "muted" }, "Coding a clip of 8 frames into one image …"));
    try {
      const made = await send("POST", "/v1/samples", { label: "sample", ...request });
      keepTruth(made.job.id, { sha256: made.truth, name: "the original clip" });
      announce("Sample submitted");
      location.hash = `#/jobs/${made.job.id}`;
    } catch (error) {
      // A service without ONNX Runtime rejects networks; total variation needs none.
      put(status, h("p", { class: "trouble", role: "alert" }, error.message),
        !request.algorithm && h("button", { type: "button", onclick: () => submit({ algorithm: "gap-tv" }) }, "Try it without a network"));
      button.disabled = false;
    }
  };
  button.addEventListener("click", () => submit({}));
  return h("section", { class: "welcome", "aria-label": "Welcome" },
    h("h1", null, "One image in, 6 to 30 frames out"), h("p", { class: "lead" }, WHAT),
    h("ol", { class: "threesteps" }, STEPS.map(([title, text]) => h("li", null, h("h2", null, title), h("p", null, text)))),
    h("div", { class: "row" }, button, h("a", { class: "button large writes", href: "#/new" }, "Use my own files")), status,
    h("p", { class: "muted" }, "The sample is a real clip, coded by a simulated camera. Its true frames are known, so the quality of the result can be measured."));
}

export async function start(root) {
  root.append(welcome());
}
