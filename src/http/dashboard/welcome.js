// The first screen: what this is, how it goes, and a job of sample data.

import { announce, h, put } from "./dom.js";
import { keepTruth } from "./keeping.js";
import { send } from "./api.js";
import { WHAT } from "./signin.js";

const STEPS = [
  ["Calibrate", "Send the masks, or raw captures of a white board. They are graded, and you are told what to mend."],
  ["Measure", "Send one coded picture or many. Each is checked against its calibration before anything is computed."],
  ["Reconstruct", "Watch the frames come, judge them, and download EXR stacks or arrays with a record of how they were made."],
];

/** What a new user should read first. */
export function welcome() {
  const status = h("div", { "aria-live": "polite" });
  const button = h("button", { type: "button", class: "primary large writes", id: "sample" }, "Try it with sample data");
  const submit = async (request) => {
    button.disabled = true;
    put(status, h("p", { class: "muted" }, "A clip of 8 frames is coded into one picture …"));
    try {
      const made = await send("POST", "/v1/samples", { label: "sample", ...request });
      keepTruth(made.job.id, { sha256: made.truth, name: "the clip itself" });
      announce("The sample is submitted");
      location.hash = `#/jobs/${made.job.id}`;
    } catch (error) {
      // A service without ONNX Runtime refuses networks; total variation needs none.
      put(status, h("p", { class: "trouble", role: "alert" }, error.message),
        !request.algorithm && h("button", { type: "button", onclick: () => submit({ algorithm: "gap-tv" }) }, "Try it without a network"));
      button.disabled = false;
    }
  };
  button.addEventListener("click", () => submit({}));
  return h("section", { class: "welcome", "aria-label": "Welcome" },
    h("h1", null, "One picture in, 6 to 30 frames out"), h("p", { class: "lead" }, WHAT),
    h("ol", { class: "threesteps" }, STEPS.map(([title, text]) => h("li", null, h("h2", null, title), h("p", null, text)))),
    h("div", { class: "row" }, button, h("a", { class: "button large writes", href: "#/new" }, "Use my own files")), status,
    h("p", { class: "muted" }, "The sample is a real clip, coded by a simulated camera. Its true frames are known, so that you see how good the result is."));
}

export async function start(root) {
  root.append(welcome());
}
