// Router: selects the view for the URL's fragment. A view is a function of its root element, its parameters
// and a signal that is aborted when another view replaces it.

import { forbidden, isAborted, isUnreachable } from "./api.js";
import { capital, h, put, trouble } from "./dom.js";
import { jobs } from "./jobs.js";
import { link } from "./live.js";
import { account, nameplate, signIn } from "./signin.js";

const ID = "([0-9a-f-]{36})";
const RETRY_MS = 3000;
const VIEWS = [
  [/^\/jobs$/, "Jobs", async () => jobs],
  [/^\/start$/, "Start", async () => (await import("./welcome.js")).start],
  [new RegExp(`^/jobs/${ID}$`), "Job", async () => (await import("./job.js")).job],
  [new RegExp(`^/compare/(${ID}(?:/${ID}){1,3})$`), "Compare", async () => (await import("./compare.js")).compare],
  [/^\/calibrations$/, "Calibrations", async () => (await import("./calibrations.js")).calibrations],
  [new RegExp(`^/calibrations/${ID}$`), "Calibration", async () => (await import("./calibrations.js")).calibration],
  [/^\/new$/, "New job", async () => (await import("./submit.js")).submit],
  [/^\/system$/, "System", async () => (await import("./system.js")).system],
  [/^\/account$/, "Account", async () => account],
];

const root = document.getElementById("content");
let current = new AbortController();

/** Ends the current view; returns the signal of the next one. */
function clear() {
  current.abort();
  current = new AbortController();
  root.className = "";
  // The style sheet hides the heading when the view adds content.
  put(root, h("h1", { class: "loading" }, "Loading …"));
  root.scrollTop = 0;
  return current.signal;
}

async function show() {
  const signal = clear();
  const [path, query] = (location.hash.slice(1) || "/jobs").split("?");
  const found = VIEWS.map(([pattern, title, load]) => ({ match: pattern.exec(path), title, load })).find((view) => view.match);
  mark(path);
  if (!found) {
    missing("Page not found", "This address names no page of the dashboard.");
    return;
  }
  document.title = `${found.title} – sci-recon`;
  try {
    const view = await found.load();
    if (signal.aborted) return;
    await view(root, [...found.match.slice(1), new URLSearchParams(query)], signal);
    if (!signal.aborted) link(true);
  } catch (error) {
    if (isAborted(error) || signal.aborted) return;
    if (isUnreachable(error)) silent(signal);
    else if (error.status === 404) missing("Not found", `${capital(error.message)}.`);
    else if (!forbidden(error) && error.status !== 401) root.append(trouble(error));
  }
}

/** Shows that the service is unreachable, and retries. */
function silent(signal) {
  link(false);
  // This view replaces the banner.
  document.getElementById("offline").hidden = true;
  put(root, h("div", { class: "card gate" }, h("h1", null, "The service does not answer"),
    h("p", null, "It may be starting, or the network may be down. Jobs continue in the meantime."),
    h("div", { class: "row" }, h("button", { type: "button", class: "primary", onclick: show }, "Try again"))));
  const timer = setTimeout(show, RETRY_MS);
  signal.addEventListener("abort", () => clearTimeout(timer));
}

function missing(title, reason) {
  clear();
  document.title = `${title} – sci-recon`;
  put(root, h("div", { class: "card gate" }, h("h1", null, title), h("p", null, reason), h("p", null, h("a", { href: "#/jobs" }, "All jobs"))));
}

/** Marks the menu entry of the current view. */
function mark(path) {
  for (const entry of document.querySelectorAll("#nav a")) {
    const here = path.replace(/^\/compare\b/, "/jobs").startsWith(entry.getAttribute("href").slice(1));
    if (here) {
      entry.setAttribute("aria-current", "page");
      // On a phone, the menu may be wider than the screen.
      entry.scrollIntoView({ block: "nearest", inline: "nearest" });
    } else entry.removeAttribute("aria-current");
  }
}

addEventListener("signed-out", () => {
  // Several requests may fail at once. Show the form only once, so that typed text is kept.
  if (document.body.classList.contains("outside")) return;
  clear();
  root.className = "gated";
  document.getElementById("who").hidden = true;
  document.body.classList.add("outside");
  signIn(root, () => {
    document.body.classList.remove("outside");
    enter();
  });
});
addEventListener("forbidden", ({ detail }) => {
  clear();
  document.title = "Not allowed – sci-recon";
  put(root, h("div", { class: "card gate" }, h("h1", null, "Your role does not allow this"), h("p", null, `Reason: ${detail}.`),
    h("p", null, "Ask the administrator for a token with that role, or sign in with another token."),
    h("div", { class: "row" }, h("a", { class: "button", href: "#/jobs" }, "All jobs"), h("a", { class: "button", href: "#/account" }, "My account"))));
});

function enter() {
  nameplate(document.getElementById("who")).then((answered) => answered && link(true));
  show();
}

document.getElementById("skip").addEventListener("click", (event) => {
  // The fragment names the view, so the link must not change it.
  event.preventDefault();
  root.focus();
});
addEventListener("hashchange", () => {
  if (document.body.classList.contains("outside")) return;
  show();
  root.focus({ preventScroll: true });
});
enter();
