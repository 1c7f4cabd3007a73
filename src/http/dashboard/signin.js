// Sign-in form, account view and sign-out.

import { announce, facts, h, put } from "./dom.js";
import { bytes } from "./format.js";
import { selectLab, selectedLab } from "./storage.js";
import { get, known, isUnreachable, signIn as beginSession, signOut as endSession } from "./api.js";

export const WHAT = "sci-recon reconstructs video from the coded images of a snapshot compressive camera.";

/** Shows the form; calls `done()` when a token is accepted. */
export function signIn(root, done) {
  const input = h("input", { type: "password", id: "token", autocomplete: "current-password", required: true, spellcheck: "false" });
  const status = h("div", { "aria-live": "polite" });
  const button = h("button", { type: "submit", class: "primary" }, "Sign in");
  const form = h("form", { class: "card gate" }, h("h1", null, "Sign in"), h("p", null, WHAT),
    h("label", { for: "token", class: "field" }, "Token", input), status, h("div", { class: "row" }, button),
    h("p", { class: "muted" }, "A token begins with sci_. The administrator creates one with ", h("code", null, "sci-recon token create"), "."));
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const token = input.value.trim();
    button.disabled = true;
    put(status);
    const wrong = await refusal(token);
    if (wrong) {
      put(status, h("p", { class: "trouble", role: "alert" }, wrong));
      input.setAttribute("aria-invalid", "true");
      input.select();
    } else {
      announce("Signed in");
      done();
    }
    button.disabled = false;
  });
  put(root, form);
  document.title = "Sign in – sci-recon";
  input.focus();
}

/** Signs in; returns an error message, or null on success. */
async function refusal(token) {
  if (!/^[\x21-\x7e]+$/.test(token)) return "A token has no spaces or special characters. Copy all of it.";
  try {
    await beginSession(token);
    return null;
  } catch (error) {
    if (isUnreachable(error)) return "The service does not answer. Try again in a moment.";
    if (error.status === 401) return "The service does not know this token. It may be revoked or incomplete.";
    return error.message;
  }
}

/** Permissions of each role in the lab of its token, or in all labs. */
const ROLES = {
  read: "You may view everything in your lab, but change nothing.",
  submit: "You may upload, submit, cancel and delete in your lab.",
  admin: "You may do everything in your lab, and view the state of the service.",
};

/** The account: lab, role, limits and usage. */
export async function account(root, _, signal) {
  const me = await get("/v1/me", signal);
  const { limits, use } = me;
  const labs = me.all_labs ? await get("/v1/labs", signal) : null;
  const quota = limits.token_bytes === null ? null : h("meter", { min: 0, max: limits.token_bytes, value: use.token_bytes, high: 0.9 * limits.token_bytes, "aria-label": "Quota used" });
  put(root, h("div", { class: "row head" }, h("h1", null, `Lab ${me.lab}`), h("span", { class: "badge" }, me.role), h("span", { class: "grow" }), me.token && signOut()),
    h("p", null, me.token ? ROLES[me.role].replace("your lab", me.all_labs ? "every lab" : "your lab") : "Sign-in is off, because this service has no tokens."),
    h("div", { class: "cards" },
      h("section", { class: "card", "aria-label": "Quota" }, h("h2", null, "Quota"), quota, facts([
        ["Uploads of this token", use.token_bytes === null ? null : `${bytes(use.token_bytes)}${limits.token_bytes === null ? ", no limit" : ` of ${bytes(limits.token_bytes)}`}`],
        ["Largest upload", bytes(limits.upload_bytes)],
        ["Memory of a job", `at most ${bytes(limits.worker_memory_bytes)}`],
      ])),
      h("section", { class: "card", "aria-label": "Lab" }, h("h2", null, "Lab"), facts([
        ["Files", use.uploads === 0 ? "no files" : `${use.uploads}, ${bytes(use.upload_bytes)}`],
        ["Results", bytes(use.result_bytes)],
        ["Queued and running jobs", h("a", { href: "#/jobs?state=queued,running" }, String(use.jobs))],
        me.token && ["Token", h("code", null, me.token)],
      ]))),
    labs && h("div", { class: "cards" }, allLabs(labs.items, me.lab)));
}

/** All labs, for tokens that may see them. Selecting one shows its data in this tab. */
function allLabs(labs, here) {
  const look = (lab) => h("button", { type: "button", class: "small", "aria-label": `Show ${lab}`, onclick: () => change(lab) }, "Show");
  const row = ({ lab, share, use }) => h("tr", null, h("th", { scope: "row" }, lab), h("td", null, share), h("td", null, use.jobs), h("td", null, bytes(use.bytes)),
    h("td", null, lab === here ? "shown" : look(lab)));
  return h("section", { class: "card", "aria-label": "All labs" }, h("h2", null, "All labs"),
    h("p", { class: "muted" }, "This tab shows the jobs, files and calibrations of the lab that you select."),
    selectedLab() && h("div", { class: "row" }, h("button", { type: "button", onclick: () => change(null) }, "Back to your own lab")),
    h("div", { class: "wide", tabindex: 0, role: "region", "aria-label": "Labs" }, h("table", null, h("thead", null, h("tr", null, ["Lab", "Share", "Queued and running jobs", "Stored", "In this tab"].map((text) => h("th", { scope: "col" }, text)))), h("tbody", null, labs.map(row)))));
}

function change(lab) {
  selectLab(lab);
  known.clear();
  announce(lab ? `Showing lab ${lab}` : "Showing your own lab");
  nameplate(document.getElementById("who"));
  location.hash = "#/jobs";
}

function signOut() {
  const leave = async () => {
    try {
      await endSession();
      announce("Signed out");
      dispatchEvent(new Event("signed-out"));
    } catch {
      announce("The service does not answer. You are still signed in");
    }
  };
  return h("button", { type: "button", id: "sign-out", onclick: leave }, "Sign out");
}

/** Shows the lab and role in the header; true if the service has answered. */
export async function nameplate(element) {
  try {
    const me = await get("/v1/me");
    put(element, me.token ? [`${selectedLab() ? "viewing " : ""}${me.lab}`, h("span", null, ` · ${me.role}`)] : me.lab);
    document.body.dataset.role = me.role;
    element.hidden = false;
    return true;
  } catch {
    element.hidden = true;
    return false;
  }
}
