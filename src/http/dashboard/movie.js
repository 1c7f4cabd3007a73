// Links to movies, which a worker makes when one is first asked for.

import { announce, h, say } from "./dom.js";
import { ask, refused } from "./api.js";

/** Milliseconds between looks. */
const PAUSE = 1000;

/** Links by view and address: one that waits is not lost when the others are shown anew. */
const links = new WeakMap();

/** A link that asks for a movie, tells how far it is until it is there, and then downloads it. */
export function movieLink(path, text, signal) {
  const ours = links.get(signal) ?? new Map();
  links.set(signal, ours);
  if (!ours.has(path)) ours.set(path, make(path, text, signal));
  return ours.get(path);
}

function make(path, text, signal) {
  const link = h("a", { class: "button small", href: path, download: true }, text);
  let asked = false;
  let there = false;
  link.addEventListener("click", async (event) => {
    if (there) return;
    event.preventDefault();
    if (asked) return;
    asked = true;
    try {
      await made(path, (how) => say(link, `${text}: ${how}`), signal);
      say(link, text);
      // Where another snapshot is shown by now, nobody waits for it.
      there = link.isConnected;
      if (there) link.click();
    } catch (error) {
      if (!signal.aborted) say(link, `${text}: ${error.message}`);
    }
    // It is asked for again the next time: a retried job has lost it.
    asked = there = false;
  });
  return link;
}

/** Asks until the movie is there. */
async function made(path, tell, signal) {
  for (;;) {
    const answer = await ask(path, { headers: { Range: "bytes=0-0" }, signal, cache: "no-store" });
    if (!answer.ok) throw await refused(answer);
    if (answer.status !== 202) break;
    const { state, percent } = await answer.json();
    tell(state === "running" ? `being made, ${Math.round(percent)} %` : "being made");
    await new Promise((resolve) => setTimeout(resolve, PAUSE));
  }
  announce("The movie is ready");
}
