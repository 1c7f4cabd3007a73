// Links to movies, which a worker encodes on request.

import { announce, h, say } from "./dom.js";
import { ask, refused, send } from "./api.js";

/** Milliseconds between requests for the state. */
const POLL_MS = 1000;

/** Links by view and URL, so that a pending link survives when the downloads are redrawn. */
const links = new WeakMap();

/**
 * A link that creates the movie of a snapshot of the job at `job`, or of all snapshots, as `mp4` or `gif`. It shows the
 * progress, and then downloads the movie.
 */
export function movieLink(job, snapshot, format, text, signal) {
  const path = `${job}${snapshot === null ? "" : `/snapshots/${snapshot}`}/exports/${format}`;
  const create = () => send("POST", `${job}/exports`, { format, snapshot });
  const own = links.get(signal) ?? new Map();
  links.set(signal, own);
  if (!own.has(path)) own.set(path, make(path, text, create, signal));
  return own.get(path);
}

function make(path, text, create, signal) {
  const link = h("a", { class: "button small", href: path, download: true }, text);
  let asked = false;
  let ready = false;
  link.addEventListener("click", async (event) => {
    if (ready) return;
    event.preventDefault();
    if (asked) return;
    asked = true;
    try {
      await create();
      await wait(path, (progress) => say(link, `${text}: ${progress}`), signal);
      say(link, text);
      // Don't download if the user has moved on to another snapshot.
      ready = link.isConnected;
      if (ready) link.click();
    } catch (error) {
      if (!signal.aborted) say(link, `${text}: ${error.message}`);
    }
    // The next click creates the movie again, because a retried job has lost it.
    asked = ready = false;
  });
  return link;
}

/** Polls until the movie is ready. */
async function wait(path, report, signal) {
  for (;;) {
    const answer = await ask(path, { headers: { Range: "bytes=0-0" }, signal, cache: "no-store" });
    if (!answer.ok) throw await refused(answer);
    if (answer.status !== 202) break;
    const { state, percent } = await answer.json();
    report(state === "running" ? `encoding, ${Math.round(percent)} %` : "encoding");
    await new Promise((resolve) => setTimeout(resolve, POLL_MS));
  }
  announce("The movie is ready");
}
