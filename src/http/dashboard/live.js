// Changes on the service, by server-sent events or, if these fail, by polling.
//
// A hidden tab holds no connection, because browsers allow only a few per server.

import { say } from "./dom.js";
import { moment } from "./format.js";
import { ask, forbidden, isAborted, isUnreachable } from "./api.js";

const POLL_MS = 2000;
const RETRY_MS = 5000;

/**
 * Calls `changed(ids)` with the identifiers of changed jobs, or with null for "all", until the signal.
 * If `changed` returns a promise, the next call waits for it, so that an old answer never arrives after
 * a new one. Returns a function that requests a call with identifiers or null.
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
      // The failed identifiers are lost, so read everything again after a pause.
      pending.all = true;
      await pause(POLL_MS, signal);
    }
    pending.busy = false;
    run();
  };
  const notify = (ids) => {
    if (ids) ids.forEach((id) => pending.ids.add(id));
    else pending.all = true;
    run();
  };
  run();
  listen(notify, signal);
  return notify;
}

/** Listens to events while the tab is visible; polls after a failure. */
async function listen(notify, signal) {
  while (!signal.aborted) {
    if (document.hidden) {
      await seen(signal);
      notify(null);
    }
    const held = new AbortController();
    const leave = () => document.hidden && held.abort();
    const end = () => held.abort();
    document.addEventListener("visibilitychange", leave);
    signal.addEventListener("abort", end);
    try {
      await stream(notify, held.signal);
    } catch {
      // Events are unavailable: poll for a while, then try again.
      for (let waited = 0; waited < RETRY_MS && !signal.aborted && !document.hidden; waited += POLL_MS) {
        await pause(POLL_MS, signal);
        notify(null);
      }
    }
    document.removeEventListener("visibilitychange", leave);
    signal.removeEventListener("abort", end);
  }
}

/** Reads server-sent events; throws when they end. */
async function stream(notify, signal) {
  const response = await ask("/v1/events", { signal, headers: { Accept: "text/event-stream" } });
  if (!response.ok) throw new Error("the service sends no events");
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { done, value } = await reader.read();
    if (done) throw new Error("the events have ended");
    text += value;
    const blocks = text.split("\n\n");
    text = blocks.pop();
    blocks.forEach((block) => event(block, notify));
  }
}

function event(block, notify) {
  const field = (name) =>
    block.split("\n").filter((line) => line.startsWith(`${name}:`)).map((line) => line.slice(name.length + 1).trim()).join("\n");
  if (field("event") === "hello") notify(null);
  if (field("event") !== "jobs") return;
  const change = JSON.parse(field("data"));
  // A deleted job leaves a gap in lists.
  notify(change.more || change.deleted.length ? null : change.changed);
}

/** Calls `look` now and every `period` ms while the tab is visible, until the signal. */
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
  if (isAborted(error)) return;
  // An error from the service shows that it is reachable.
  link(!isUnreachable(error));
  forbidden(error);
}

let answered = null;

/** Shows whether the service is reachable, and the time of the last answer. */
export function link(good) {
  if (good) answered = new Date();
  document.getElementById("offline").hidden = good;
  const since = answered ? `This page shows the state at ${moment(answered)}.` : "";
  if (!good) say(document.getElementById("offline"), `The service does not answer. ${since} Jobs are kept, and continue when it runs. Retrying every few seconds.`);
  const element = document.getElementById("link");
  say(element, good ? "live" : "offline");
  element.classList.toggle("lost", !good);
}
