// The API, as the dashboard uses it. Errors are problem+json and become exceptions with its detail.

import { place } from "./dom.js";
import { lookAfter } from "./keeping.js";

// A session is a cookie that no script can read. What changes something by it shows this header, which no
// page of another site can send.
const OWN = { "X-Requested-With": "sci-recon" };
let session = 0;

/** As `fetch`. Who is not let in is told by the event `signed-out`. */
export async function ask(path, options = {}) {
  const during = session;
  const response = await fetch(place(path), { ...options, headers: { ...OWN, ...options.headers } });
  if (response.status === 401) signedOut(during);
  return response;
}

/** An answer to a session that has ended meanwhile says nothing. */
function signedOut(during) {
  if (during === session) dispatchEvent(new Event("signed-out"));
}

/** Shows a token once, for a session; throws `Refused` for one that is not taken. */
export async function signIn(token) {
  const headers = { ...OWN, Authorization: `Bearer ${token}` };
  const response = await fetch(place("/v1/session"), { method: "POST", headers });
  if (!response.ok) throw await refused(response);
  renew();
}

/** Ends the session. */
export async function signOut() {
  const response = await fetch(place("/v1/session"), { method: "DELETE", headers: OWN });
  // One that is not known any more has ended.
  if (!response.ok && response.status !== 401) throw await refused(response);
  renew();
}

function renew() {
  session += 1;
  lookAfter(null);
  known.clear();
}

/** A refused or failed request. */
export class Refused extends Error {
  constructor(status, problem) {
    super(problem.detail ?? problem.title ?? `the service answered ${status}`);
    this.status = status;
    this.code = problem.code ?? "unknown";
    this.reason = problem.reason ?? null;
    this.errors = problem.errors ?? [];
  }
}

/** Makes something of files and waits until they are checked; `during` is told how far that is. */
export async function create(path, body, signal, during = () => {}) {
  let made = await send("POST", path, body);
  while (made.state === "preparing") {
    during(made);
    made = await get(`${path}/${made.id}?wait=0.7`, signal);
  }
  if (made.state !== "failed") return made;
  throw made.problem ? new Refused(made.problem.status, made.problem) : new Error(made.error);
}

/** Answers that may still hold, by path. */
export const known = new Map();
const KNOWN = 60;

/** Asks with `If-None-Match`; gives the very object of last time if nothing has changed. */
export async function get(path, signal) {
  const before = known.get(path);
  const headers = before ? { "If-None-Match": before.etag } : {};
  const response = await ask(path, { headers, signal, cache: "no-store" });
  if (response.status === 304 && before) return before.data;
  if (!response.ok) throw await refused(response);
  const data = await response.json();
  const etag = response.headers.get("ETag");
  if (etag) remember(path, { etag, data });
  return data;
}

function remember(path, answer) {
  known.delete(path);
  known.set(path, answer);
  if (known.size > KNOWN) known.delete(known.keys().next().value);
}

/** The error of an answer that is no success. */
export async function refused(response) {
  let problem = {};
  try {
    problem = await response.json();
  } catch {
    // Not from the service itself: the status must do.
  }
  return new Refused(response.status, problem);
}

/** Sends JSON, gives JSON (or null where there is no body). */
export async function send(method, path, body) {
  const headers = body === undefined ? {} : { "Content-Type": "application/json" };
  const response = await ask(path, { method, headers, body: body === undefined ? null : JSON.stringify(body) });
  if (!response.ok) throw await refused(response);
  return response.status === 204 ? null : response.json();
}

/** Uploads a file and tells how much of it has gone; gives the blob's record. */
export function upload(file, progress, signal) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open("POST", place("/v1/blobs"));
    request.setRequestHeader("Content-Type", "application/octet-stream");
    for (const [name, value] of Object.entries(OWN)) request.setRequestHeader(name, value);
    const during = session;
    request.upload.onprogress = (event) => progress(event.loaded, event.total || file.size);
    request.onload = () => {
      let body = {};
      try {
        body = JSON.parse(request.responseText);
      } catch {
        // As above.
      }
      if (request.status === 401) signedOut(during);
      if (request.status >= 200 && request.status < 300) resolve(body);
      else reject(new Refused(request.status, body));
    };
    request.onerror = () => reject(new Error("the connection was lost; send the file again"));
    request.onabort = () => reject(new DOMException("stopped", "AbortError"));
    signal?.addEventListener("abort", () => request.abort());
    request.send(file);
  });
}

/** Fetches a picture. */
export async function picture(path, signal) {
  const response = await ask(path, { signal });
  if (!response.ok) throw await refused(response);
  return createImageBitmap(await response.blob());
}

/** What one may not do by one's role becomes a page, wherever it is noticed. */
export function forbidden(error) {
  if (error.status !== 403) return false;
  dispatchEvent(new CustomEvent("forbidden", { detail: error.message }));
  return true;
}

/** True where no answer came at all. */
export function unanswered(error) {
  return error instanceof TypeError || error.status === 502 || error.status === 503 || error.status === 504;
}

/** True for the end of a request that a view gave up on. */
export function gaveUp(error) {
  return error?.name === "AbortError";
}
