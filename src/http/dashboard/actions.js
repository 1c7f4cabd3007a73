// What can be done with a job: cancel, retry, delete (after a question).

import { announce, h, put } from "./dom.js";
import { nameOf } from "./format.js";
import { send } from "./api.js";

const ACTIONS = {
  cancel: { word: "Cancel", states: ["queued", "running"], run: (job) => send("POST", `/v1/jobs/${job.id}/cancel`) },
  retry: { word: "Retry", states: ["failed", "cancelled"], run: (job) => send("POST", `/v1/jobs/${job.id}/retry`) },
  delete: { word: "Delete", states: ["succeeded", "failed", "cancelled"], run: remove },
};

/** Buttons for what can be done with a job now; `done(action, job)` is told what the service answered. */
export function actions(job, done) {
  return Object.entries(ACTIONS)
    .filter(([, action]) => action.states.includes(job.state))
    .map(([name, action]) => {
      const label = `${action.word} ${nameOf(job)}`;
      const press = async (event) => {
        const button = event.currentTarget;
        button.disabled = true;
        try {
          const after = await action.run(job);
          if (after !== false) {
            announce(`${label}: done`);
            done(name, after);
          }
        } catch (error) {
          await tell(`${label}: not possible`, error.message);
        }
        button.disabled = false;
      };
      return h("button", { type: "button", class: `small ${name}`, "aria-label": label, title: label, onclick: press }, action.word);
    });
}

async function remove(job) {
  const text = ["The job ", h("b", null, nameOf(job)), " and its frames will be gone. The measurement and the calibration stay."];
  if (!(await ask("Delete this job?", text, "Delete"))) return false;
  return send("DELETE", `/v1/jobs/${job.id}`);
}

/** Asks; gives true if the answer is yes. */
export function ask(title, text, yes) {
  return new Promise((resolve) => {
    const buttons = [
      h("button", { type: "submit", value: "no", autofocus: true }, "Keep"),
      h("button", { type: "submit", value: "yes", class: "danger" }, yes),
    ];
    dialog(title, text, buttons, (answer) => resolve(answer === "yes"));
  });
}

/** Says something that needs to be read. */
export function tell(title, text) {
  return new Promise((resolve) => {
    dialog(title, text, [h("button", { type: "submit", value: "ok", autofocus: true }, "Close")], resolve);
  });
}

function dialog(title, text, buttons, closed) {
  const heading = h("h2", { id: "question" }, title);
  const form = h("form", { method: "dialog" }, heading, h("p", null, text), h("div", { class: "row end" }, buttons));
  const element = h("dialog", { "aria-labelledby": "question" }, form);
  element.addEventListener("close", () => {
    element.remove();
    closed(element.returnValue);
  });
  document.body.append(element);
  element.showModal();
  put(document.getElementById("announce"));
}
