// Client of the API. Errors are problem+json; they become exceptions with its `detail` as message.

import { place } from "./dom.js";
import { selectLab } from "./storage.js";

// The session is a cookie that scripts can't read. Requests that change something must send this header,
// which pages of other sites can't set.
const CSRF_HEADERS = { "X-Requested-With": "sci-recon" };
let session = 0;

/** Like `fetch`. Dispatches the event `signed-out` if the request is not authenticated. */
export async function ask(path, options = {}) {
  const during = session;
  const response = await fetch(place(path), { ...options, headers: { ...CSRF_HEADERS, ...options.headers } });
  if (response.status === 401) signedOut(during);
  return response;
}

/** Ignores answers to requests of an earlier session. */
function signedOut(during) {
  if (during === session) dispatchEvent(new Event("signed-out"));
}

/** URL of the session, whose cookie belongs to the path of this page. */
function sessionPlace() {
  return place(`/view/session?path=${new URL(".", document.baseURI).pathname}`);
}

/** Exchanges a token for a session; throws `Refused` if the token is rejected. */
export async function signIn(token) {
  const headers = { ...CSRF_HEADERS, Authorization: `Bearer ${token}` };
  const response = await fetch(sessionPlace(), { method: "POST", headers });
  if (!response.ok) throw await refused(response);
  renew();
}

/** Ends the session. */
export async function signOut() {
  const response = await fetch(sessionPlace(), { method: "DELETE", headers: CSRF_HEADERS });
  // 401 means that the session has already ended.
  if (!response.ok && response.status !== 401) throw await refused(response);
  renew();
}

function renew() {
  session += 1;
  selectLab(null);
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

/** Creates a resource and waits until its files are checked; `during(resource)` receives the progress. */
export async function create(path, body, signal, during = () => {}) {
  let made = await send("POST", path, body);
  while (made.state === "preparing") {
    during(made);
    made = await get(`${path}/${made.id}`, signal, { Prefer: "wait=0.7" });
  }
  if (made.state !== "failed") return made;
  throw made.problem ? new Refused(made.problem.status, made.problem) : new Error(made.error);
}

/** Cached answers by path, revalidated with their ETag. */
export const known = new Map();
const MAX_KNOWN = 60;

/** Gets JSON with `If-None-Match`; returns the same object as before if nothing has changed. */
export async function get(path, signal, more = {}) {
  const before = known.get(path);
  const headers = before ? { ...more, "If-None-Match": before.etag } : more;
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
  if (known.size > MAX_KNOWN) known.delete(known.keys().next().value);
}

/** The exception for an answer without success. */
export async function refused(response) {
  let problem = {};
  try {
    problem = await response.json();
  } catch {
    // The answer is not from the service, so there is only a status.
  }
  return new Refused(response.status, problem);
}

/** Sends JSON and returns JSON, or null if the answer has no body. */
export async function send(method, path, body) {
  const headers = body === undefined ? {} : { "Content-Type": "application/json" };
  const response = await ask(path, { method, headers, body: body === undefined ? null : JSON.stringify(body) });
  if (!response.ok) throw await refused(response);
  return response.status === 204 ? null : response.json();
}

/** Uploads a file, reports the progress in bytes, and returns the blob's record. */
export function upload(file, progress, signal) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open("POST", place("/v1/blobs"));
    request.setRequestHeader("Content-Type", "application/octet-stream");
    for (const [name, value] of Object.entries(CSRF_HEADERS)) request.setRequestHeader(name, value);
    const during = session;
    request.upload.onprogress = (event) => progress(event.loaded, event.total || file.size);
    request.onload = () => {
      let body = {};
      try {
        body = JSON.parse(request.responseText);
      } catch {
        // The answer is not from the service, so there is only a status.
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

/** Shows the "forbidden" view for a 403; returns true if the error is one. */
export function forbidden(error) {
  if (error.status !== 403) return false;
  dispatchEvent(new CustomEvent("forbidden", { detail: error.message }));
  return true;
}

/** True if the service could not be reached. */
export function isUnreachable(error) {
  return error instanceof TypeError || error.status === 502 || error.status === 503 || error.status === 504;
}

/** True if a view has cancelled the request. */
export function isAborted(error) {
  return error?.name === "AbortError";
}
