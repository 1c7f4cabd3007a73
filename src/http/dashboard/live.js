// What changes on the service: by events where they can be held, else by asking every few seconds.
//
// A tab that nobody looks at holds no connection: browsers have few of them for one server.

import { say } from "./dom.js";
import { moment } from "./format.js";
import { ask, forbidden, gaveUp, unanswered } from "./api.js";

const POLL = 2000;
const RETRY = 5000;

/**
 * Calls `changed(ids)` when jobs change, with their identifiers or null for "look at all", until the
 * signal. `changed` may return a promise; it is not called again before that is settled, so that an
 * old answer never comes after a new one. Returns a function that asks for a call, with identifiers
 * or null.
 */
export function watch(changed, signal) {
  const pending = { all: true, ids: new Set(), busy: false };
  const run = async () => {
    if (pending.busy || signal.aborted || !(pending.all || pending.ids.size)) return;
    const ids = pending.all ? null : pending.ids;
    Object.assign(pending, { all: false, ids: new Set(), busy: true });
    try {
      await changed(ids);
      link(true);
    } catch (error) {
      trouble(error);
      // What was to be read is not known: everything is looked at again, but not at once.
      pending.all = true;
      await pause(POLL, signal);
    }
    pending.busy = false;
    run();
  };
  const tell = (ids) => {
    if (ids) ids.forEach((id) => pending.ids.add(id));
    else pending.all = true;
    run();
  };
  run();
  listen(tell, signal);
  return tell;
}

/** Holds events while the tab is seen; polls while they can't be held. */
async function listen(tell, signal) {
  while (!signal.aborted) {
    if (document.hidden) {
      await seen(signal);
      tell(null);
    }
    const held = new AbortController();
    const leave = () => document.hidden && held.abort();
    const end = () => held.abort();
    document.addEventListener("visibilitychange", leave);
    signal.addEventListener("abort", end);
    try {
      await stream(tell, held.signal);
    } catch {
      // Not to be had now: poll for a while, then try again.
      for (let waited = 0; waited < RETRY && !signal.aborted && !document.hidden; waited += POLL) {
        await pause(POLL, signal);
        tell(null);
      }
    }
    document.removeEventListener("visibilitychange", leave);
    signal.removeEventListener("abort", end);
  }
}

/** Reads server-sent events until they end. */
async function stream(tell, signal) {
  const response = await ask("/v1/events", { signal, headers: { Accept: "text/event-stream" } });
  if (!response.ok) throw new Error("no events");
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { done, value } = await reader.read();
    if (done) throw new Error("the events have ended");
    text += value;
    const blocks = text.split("\n\n");
    text = blocks.pop();
    blocks.forEach((block) => event(block, tell));
  }
}

function event(block, tell) {
  const field = (name) =>
    block.split("\n").filter((line) => line.startsWith(`${name}:`)).map((line) => line.slice(name.length + 1).trim()).join("\n");
  if (field("event") === "hello") tell(null);
  if (field("event") !== "jobs") return;
  const change = JSON.parse(field("data"));
  // A deleted job leaves a gap in lists.
  tell(change.more || change.deleted.length ? null : change.changed);
}

/** Calls `look` now and every `period` ms while the tab is seen, until the signal. */
export async function every(period, look, signal) {
  while (!signal.aborted) {
    if (!document.hidden) {
      try {
        await look();
        link(true);
      } catch (error) {
        trouble(error);
      }
    }
    await pause(period, signal);
  }
}

function pause(time, signal) {
  return new Promise((resolve) => {
    const timer = setTimeout(resolve, time);
    signal.addEventListener("abort", () => {
      clearTimeout(timer);
      resolve();
    }, { once: true });
  });
}

function seen(signal) {
  return new Promise((resolve) => {
    const look = () => {
      if (document.hidden && !signal.aborted) return;
      document.removeEventListener("visibilitychange", look);
      resolve();
    };
    document.addEventListener("visibilitychange", look);
    signal.addEventListener("abort", look, { once: true });
    look();
  });
}

function trouble(error) {
  if (gaveUp(error)) return;
  // A refusal is an answer.
  link(!unanswered(error));
  forbidden(error);
}

let answered = null;

/** Shows whether the service answers, and since when not. */
export function link(good) {
  if (good) answered = new Date();
  document.getElementById("offline").hidden = good;
  const since = answered ? `What you see is as of ${moment(answered)}.` : "";
  if (!good) say(document.getElementById("offline"), `The service does not answer. ${since} It is asked again every few seconds; nothing is lost.`);
  const element = document.getElementById("link");
  say(element, good ? "live" : "offline");
  element.classList.toggle("lost", !good);
}
