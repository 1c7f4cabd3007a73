// The first screen: purpose, three steps, and a job with sample data.

import { announce, h, put, trouble } from "./dom.js";
import { send } from "./api.js";
import { WHAT } from "./signin.js";

const STEPS = [
  ["Calibrate", "Upload the masks, or raw captures of a white board. A report grades them and says what to improve."],
  ["Measure", "Upload one or more coded images. Each is checked against its calibration before the computation starts."],
  ["Reconstruct", "Watch the frames appear, judge them, and download EXR stacks or arrays with a record of how they were made."],
];

/**
 * The sample's coded image, and the frames that the default algorithm reconstructs from it. `sample.webp` has them side by
 * side: pictures of the measurement and of the eight frames, 160 pixels wide.
 */
function example() {
  const clip = h("div", { class: "clip", role: "img", "aria-label": "The eight frames of the result, playing" });
  const again = h("button", { type: "button", class: "small" }, "Play again");
  const box = h("div", null, clip);
  // A new element starts the animation again.
  again.addEventListener("click", () => put(box, clip.cloneNode()));
  return h("div", { class: "example" },
    h("figure", null, h("div", { class: "coded", role: "img", "aria-label": "The coded image of the sample" }), h("figcaption", null, "One coded image")),
    h("span", { class: "arrow", "aria-hidden": "true" }, "→"),
    h("figure", null, box, h("figcaption", null, "8 frames", again)));
}

/** The introduction for new users. */
export function welcome() {
  const status = h("div", { "aria-live": "polite" });
  const button = h("button", { type: "button", class: "primary large writes", id: "sample" }, "Try it with sample data");
  const submit = async (request) => {
    button.disabled = true;
    put(status, h("p", { class: "muted" }, "Coding a clip of 8 frames into one image …"));
    try {
      const made = await send("POST", "/v1/samples", { label: "sample", ...request });
      announce("Sample submitted");
      location.hash = `#/jobs/${made.job.id}`;
    } catch (error) {
      // A service without ONNX Runtime rejects networks; total variation needs none.
      put(status, trouble(error),
        !request.algorithm && h("button", { type: "button", onclick: () => submit({ algorithm: "gap-tv" }) }, "Try it without a network"));
      button.disabled = false;
    }
  };
  button.addEventListener("click", () => submit({}));
  return h("section", { class: "welcome", "aria-label": "Welcome" },
    h("h1", null, "One image in, 6 to 30 frames out"), h("p", { class: "lead" }, WHAT),
    h("div", { class: "intro" }, example(), h("div", null,
      h("div", { class: "row" }, button, h("a", { class: "button large writes", href: "#/new" }, "Use my own files")), status,
      h("p", { class: "muted" }, "The sample is a real clip, coded by a simulated camera. Its true frames are known, so the quality of the result can be measured."))),
    h("ol", { class: "threesteps" }, STEPS.map(([title, text]) => h("li", null, h("h2", null, title), h("p", null, text)))));
}

export async function start(root) {
  root.append(welcome());
}
