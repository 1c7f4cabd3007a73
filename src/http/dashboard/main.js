// Which view an address shows. A view is a function of its root, its parameters and a signal that
// ends when another view takes its place.

import { h, put, trouble } from "./dom.js";
import { gaveUp } from "./api.js";
import { jobs } from "./jobs.js";
import { link } from "./live.js";

const ID = "([0-9a-f-]{36})";
const VIEWS = [
  [/^\/jobs$/, "Jobs", async () => jobs],
  [new RegExp(`^/jobs/${ID}$`), "Job", async () => (await import("./job.js")).job],
  [new RegExp(`^/compare/${ID}/${ID}$`), "Two jobs", async () => (await import("./compare.js")).compare],
  [/^\/calibrations$/, "Calibrations", async () => (await import("./calibrations.js")).calibrations],
  [new RegExp(`^/calibrations/${ID}$`), "Calibration", async () => (await import("./calibrations.js")).calibration],
  [/^\/new$/, "New job", async () => (await import("./submit.js")).submit],
  [/^\/system$/, "System", async () => (await import("./system.js")).system],
];

let current = new AbortController();

async function show() {
  current.abort();
  current = new AbortController();
  const { signal } = current;
  const [path, query] = (location.hash.slice(1) || "/jobs").split("?");
  const root = document.getElementById("content");
  const found = VIEWS.map(([pattern, title, load]) => ({ match: pattern.exec(path), title, load })).find((view) => view.match);
  mark(path);
  if (!found) {
    put(root, h("h1", null, "There is no such page"), h("p", null, h("a", { href: "#/jobs" }, "All jobs")));
    return;
  }
  document.title = `${found.title} – sci-recon`;
  root.scrollTop = 0;
  try {
    const view = await found.load();
    if (signal.aborted) return;
    root.className = "";
    put(root);
    await view(root, [...found.match.slice(1), new URLSearchParams(query)], signal);
    link(true);
  } catch (error) {
    if (!gaveUp(error) && !signal.aborted) root.append(trouble(error));
  }
}

/** Marks the entry of the menu that the view belongs to. */
function mark(path) {
  for (const entry of document.querySelectorAll("#nav a")) {
    const here = path.startsWith(entry.getAttribute("href").slice(1));
    if (here) entry.setAttribute("aria-current", "page");
    else entry.removeAttribute("aria-current");
  }
}

document.getElementById("skip").addEventListener("click", (event) => {
  // The address after # names the view.
  event.preventDefault();
  document.getElementById("content").focus();
});
addEventListener("hashchange", () => {
  show();
  document.getElementById("content").focus({ preventScroll: true });
});
show();
