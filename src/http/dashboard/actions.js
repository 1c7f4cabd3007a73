// Actions on one or several jobs: cancel, retry, rename, delete (with a confirmation).

import { announce, explained, h, put, trouble } from "./dom.js";
import { menu } from "./menu.js";
import { nameOf } from "./format.js";
import { create, send } from "./api.js";

const ACTIONS = {
  cancel: { word: "Cancel", states: ["queued", "running"], run: (job) => send("POST", `/v1/jobs/${job.id}/cancel`) },
  retry: { word: "Retry", states: ["failed", "cancelled"], run: (job) => send("POST", `/v1/jobs/${job.id}/retry`) },
  delete: { word: "Delete", states: ["succeeded", "failed", "cancelled"], run: remove },
};

/**
 * Buttons for the actions that a job's state allows; `done(action, job)` receives the service's answer. Delete is in a menu,
 * together with `more` buttons.
 */
export function actions(job, done, more = []) {
  const allowed = Object.entries(ACTIONS)
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
          await showMessage(`Could not ${action.word.toLowerCase()} ${nameOf(job)}`, explained(error));
        }
        button.disabled = false;
      };
      return h("button", { type: "button", class: `small ${name}`, "aria-label": label, title: label, onclick: press }, action.word);
    });
  const [hidden, shown] = [true, false].map((inside) => allowed.filter((button) => button.classList.contains("delete") === inside));
  const items = [...more, ...hidden];
  return [...shown, ...(items.length ? [menu(`More actions for ${nameOf(job)}`, items)] : [])];
}

async function remove(job) {
  const text = ["The job ", h("b", null, nameOf(job)), " and its frames will be deleted. The measurement and the calibration are kept."];
  if (!(await ask("Delete this job?", text, "Delete"))) return false;
  return send("DELETE", `/v1/jobs/${job.id}`);
}

/** A button that makes a calibration of the masks as the job has moved them. */
export function saveMasks(job) {
  const result = h("p", { "aria-live": "polite" });
  const button = h("button", { type: "button", class: "small writes" }, "Save the moved masks as a calibration");
  button.addEventListener("click", async () => {
    button.disabled = true;
    try {
      const made = await create("/v1/calibrations", { registration_of: job.id, name: `moved masks of ${nameOf(job)}`.slice(0, 200) });
      put(result, "Saved as ", h("a", { href: `#/calibrations/${made.id}` }, "a calibration"), " for further measurements.");
    } catch (error) {
      button.disabled = false;
      put(result, trouble(error));
    }
  });
  return [h("div", { class: "row below" }, button), result];
}

/** Cancels jobs. A job that has already ended is not changed. */
export async function cancelAll(jobs) {
  await each(jobs, "cancelled", (job) => send("POST", `/v1/jobs/${job.id}/cancel`));
}

/** Deletes jobs after a confirmation; returns false if the user declined. */
export async function removeAll(jobs) {
  const text = [`${jobs.length} ${jobs.length === 1 ? "job" : "jobs"} and their frames will be deleted: `, h("b", null, jobs.slice(0, 3).map(nameOf).join(", ")), jobs.length > 3 ? ` and ${jobs.length - 3} more. ` : ". ", "Measurements and calibrations are kept."];
  if (!(await ask(`Delete ${jobs.length} ${jobs.length === 1 ? "job" : "jobs"}?`, text, "Delete"))) return false;
  await each(jobs, "deleted", (job) => send("DELETE", `/v1/jobs/${job.id}`));
  return true;
}

/** Applies an action to all jobs, four at a time, and lists the failures. */
async function each(jobs, word, act) {
  const remaining = [...jobs];
  const refused = [];
  const work = async () => {
    for (let job = remaining.shift(); job; job = remaining.shift()) {
      await act(job).catch((error) => refused.push([job, error]));
    }
  };
  await Promise.all(Array.from({ length: 4 }, work));
  announce(`${jobs.length - refused.length} jobs ${word}`);
  if (refused.length === 0) return;
  await showMessage(`${refused.length} of ${jobs.length} could not be ${word}`, h("span", null, refused.slice(0, 5).map(([job, error]) => [`${nameOf(job)}: `, explained(error), h("br")])));
}

/** Asks for a new name; `change(name)` sends it (null removes the name). */
export function rename(before, change) {
  const input = h("input", { type: "text", id: "new-name", maxlength: 200, value: before ?? "", autocomplete: "off" });
  const status = h("div", { "aria-live": "polite" });
  const element = h("dialog", { "aria-labelledby": "question" });
  const form = h("form", null, h("h2", { id: "question" }, "Rename"), h("label", { class: "field", for: "new-name" }, "Name", input), status,
    h("div", { class: "row end" }, h("button", { type: "button", onclick: () => element.close() }, "Cancel"), h("button", { type: "submit", class: "primary" }, "Rename")));
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    try {
      await change(input.value.trim() || null);
      announce("Renamed");
      element.close();
    } catch (error) {
      put(status, trouble(error));
    }
  });
  open(element, form);
  input.select();
}

function open(element, form) {
  element.append(form);
  element.addEventListener("close", () => element.remove());
  document.body.append(element);
  element.showModal();
}

/** Asks for a confirmation; resolves to true if the user confirms. */
export function ask(title, text, yes) {
  return new Promise((resolve) => {
    const buttons = [
      h("button", { type: "submit", value: "no", autofocus: true }, "Keep"),
      h("button", { type: "submit", value: "yes", class: "danger" }, yes),
    ];
    dialog(title, text, buttons, (answer) => resolve(answer === "yes"));
  });
}

/** Shows a message that the user has to close. */
export function showMessage(title, text) {
  return new Promise((resolve) => {
    dialog(title, text, [h("button", { type: "submit", value: "ok", autofocus: true }, "Close")], resolve);
  });
}

function dialog(title, text, buttons, closed) {
  const heading = h("h2", { id: "question" }, title);
  const form = h("form", { method: "dialog" }, heading, h("p", null, text), h("div", { class: "row end" }, buttons));
  const element = h("dialog", { "aria-labelledby": "question" });
  element.addEventListener("close", () => closed(element.returnValue));
  open(element, form);
  put(document.getElementById("announce"));
}
