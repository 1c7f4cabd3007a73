// The page on which one signs in, what one may do, and signing out.

import { announce, facts, h, put, say } from "./dom.js";
import { bytes } from "./format.js";
import { lookAfter, lookedAfter } from "./keeping.js";
import { get, known, unanswered, signIn as beginSession, signOut as endSession } from "./api.js";

export const WHAT = "sci-recon turns the coded pictures of a snapshot compressive camera back into video.";

/** Shows the form; `done()` is called when a token is accepted. */
export function signIn(root, done) {
  const input = h("input", { type: "password", id: "token", autocomplete: "current-password", required: true, spellcheck: "false" });
  const status = h("div", { "aria-live": "polite" });
  const button = h("button", { type: "submit", class: "primary" }, "Sign in");
  const form = h("form", { class: "card gate" }, h("h1", null, "Sign in"), h("p", null, WHAT),
    h("label", { for: "token", class: "field" }, "Token", input), status, h("div", { class: "row" }, button),
    h("p", { class: "muted" }, "A token begins with sci_. Who runs the service makes one with ", h("code", null, "sci-recon token create"), "."));
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
      announce("You are signed in");
      done();
    }
    button.disabled = false;
  });
  put(root, form);
  document.title = "Sign in – sci-recon";
  input.focus();
}

/** Signs in; says what is wrong with the token, or null for one that the service takes. */
async function refusal(token) {
  if (!/^[\x21-\x7e]+$/.test(token)) return "A token has no spaces and no special characters. Copy all of it.";
  try {
    await beginSession(token);
    return null;
  } catch (error) {
    if (unanswered(error)) return "The service does not answer. Try again in a moment.";
    if (error.status === 401) return "The service does not know this token. It may have been revoked, or a part of it is missing.";
    return error.message;
  }
}

/** What a role may do, in words. */
const ROLES = {
  read: "You may look at everything of your lab and change nothing.",
  submit: "You may upload, submit, cancel and delete in your lab.",
  admin: "You may do everything in your lab and look after the service.",
};

/** Who is signed in, what is allowed and what is taken up. */
export async function account(root, _, signal) {
  const me = await get("/v1/me", signal);
  const { limits, use } = me;
  const labs = me.all_labs ? await get("/v1/labs", signal) : null;
  const quota = limits.token_bytes === null ? null : h("meter", { min: 0, max: limits.token_bytes, value: use.token_bytes, high: 0.9 * limits.token_bytes, "aria-label": "Quota used" });
  put(root, h("div", { class: "row head" }, h("h1", null, `Lab ${me.lab}`), h("span", { class: "badge" }, me.role), h("span", { class: "grow" }), me.token && signOut()),
    h("p", null, me.token ? ROLES[me.role] : "This service asks nobody to sign in: no token was made for it."),
    h("div", { class: "cards" },
      h("section", { class: "card", "aria-label": "Quota" }, h("h2", null, "Quota"), quota, facts([
        ["Uploads of this token", use.token_bytes === null ? null : `${bytes(use.token_bytes)}${limits.token_bytes === null ? ", no limit" : ` of ${bytes(limits.token_bytes)}`}`],
        ["Largest upload", bytes(limits.upload_bytes)],
        ["Memory of a job", `${bytes(limits.worker_memory_bytes)} at most`],
      ])),
      h("section", { class: "card", "aria-label": "The lab" }, h("h2", null, "The lab"), facts([
        ["Files", `${use.uploads}, ${bytes(use.upload_bytes)}`],
        ["Results", bytes(use.result_bytes)],
        ["Jobs that wait or run", h("a", { href: "#/jobs?state=queued,running" }, String(use.jobs))],
        me.token && ["Token", h("code", null, me.token)],
      ]))),
    labs && h("div", { class: "cards" }, allLabs(labs.items, me.lab)));
}

/** The labs, for those who look after all of them: one of them is looked at as if it were one's own. */
function allLabs(labs, here) {
  const look = (lab) => h("button", { type: "button", class: "small", "aria-label": `Look after ${lab}`, onclick: () => change(lab) }, "Look after");
  const row = ({ lab, share, use }) => h("tr", null, h("th", { scope: "row" }, lab), h("td", null, share), h("td", null, use.jobs), h("td", null, bytes(use.bytes)),
    h("td", null, lab === here ? "now" : look(lab)));
  return h("section", { class: "card", "aria-label": "All labs" }, h("h2", null, "All labs"),
    h("p", { class: "muted" }, "You may look after every lab: jobs, files and calibrations of the one that you choose are shown in this tab as if it were yours."),
    lookedAfter() && h("div", { class: "row" }, h("button", { type: "button", onclick: () => change(null) }, "Back to your own lab")),
    h("div", { class: "wide", tabindex: 0, role: "region", "aria-label": "Labs" }, h("table", null, h("thead", null, h("tr", null, ["Lab", "Share", "Jobs that wait or run", "Kept here", "Shown"].map((text) => h("th", { scope: "col" }, text)))), h("tbody", null, labs.map(row)))));
}

function change(lab) {
  lookAfter(lab);
  known.clear();
  announce(lab ? `The lab ${lab} is shown` : "Your own lab is shown");
  nameplate(document.getElementById("who"));
  location.hash = "#/jobs";
}

function signOut() {
  const leave = async () => {
    try {
      await endSession();
      announce("You are signed out");
      dispatchEvent(new Event("signed-out"));
    } catch {
      announce("The service does not answer: you are still signed in");
    }
  };
  return h("button", { type: "button", id: "sign-out", onclick: leave }, "Sign out");
}

/** Says who is signed in, in the head of every page. */
export async function nameplate(element) {
  try {
    const me = await get("/v1/me");
    say(element, me.token ? `${lookedAfter() ? "looking after " : ""}${me.lab} · ${me.role}` : me.lab);
    document.body.dataset.role = me.role;
    element.hidden = false;
  } catch {
    element.hidden = true;
  }
}
