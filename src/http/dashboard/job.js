// One job: its quality, frames, files and method.

import { actions, rename, saveMasks } from "./actions.js";
import { about, announce, capital, h, marked, put, trouble } from "./dom.js";
import { bytes, nameOf, stageOf, stateWord, timeOf } from "./format.js";
import { isAborted, get, send } from "./api.js";
import { Made } from "./provenance.js";
import { doubtOf, registration } from "./registration.js";
import { movieLink } from "./movie.js";
import { TileMap } from "./tilemap.js";
import { Verdict } from "./verdict.js";
import { Viewer } from "./viewer.js";
import { watch } from "./live.js";

export async function job(root, [id], signal) {
  const found = await get(`/v1/jobs/${id}`, signal);
  const title = h("h1", null, nameOf(found));
  const state = h("span");
  const buttons = h("span", { class: "row writes" });
  const progress = h("div", { class: "progressline" });
  const problem = h("div");
  const snapshot = snapshotChoice(found);
  const files = h("div", { class: "card row downloads", role: "group", "aria-label": "Downloads" });
  const verdict = new Verdict(found, signal);
  const viewer = new Viewer(found, signal);
  viewer.next = () => snapshot.next();
  verdict.changed = (truth) => viewer.setTruth(truth);
  const moved = h("div");
  const made = new Made(found, signal);
  const tiles = new TileMap(found, signal);
  root.append(
    h("div", { class: "row head" }, title, state, snapshot.element, h("span", { class: "grow" }), buttons),
    progress, problem,
    h("div", { class: "stage three" }, verdict.element, viewer.element, h("div", { class: "side" }, viewer.beside, files)),
    h("div", { class: "cards" }, made.element, h("div", { class: "stack" }, moved, tiles.plotCard, tiles.tilesCard)));
  camera(found, viewer, signal);

  let shown = null;
  const leave = () => (location.hash = "#/jobs");
  const call = (name) => {
    put(title, name);
    document.title = `${name} – sci-recon`;
  };
  call(nameOf(found));
  const renaming = h("button", { type: "button", class: "small" }, "Rename");
  renaming.addEventListener("click", () => rename(shown?.label ?? found.label, async (label) => refresh.take(await send("PATCH", `/v1/jobs/${id}`, { label }))));
  const refresh = async (ids) => {
    if (ids && !ids.has(id)) return;
    await refresh.take(await get(`/v1/jobs/${id}`, signal));
  };
  refresh.take = async (now) => {
    if (now === shown) return;
    if (now.state !== shown?.state) {
      put(state, h("span", { class: `badge ${now.state}` }, stateWord(now.state)));
      put(buttons, actions(now, (action) => (action === "delete" ? leave() : refresh(null)), [renaming]));
      put(problem, now.error && failure(now));
      if (shown) announce(`The job is ${stateWord(now.state)}`);
    }
    call(nameOf(now));
    put(progress, line(now));
    viewer.state = now.state;
    viewer.setTruth(now.truth);
    if (now.registered !== shown?.registered || now.state !== shown?.state) {
      const card = registration(now);
      if (now.state === "succeeded" && now.registered?.applied && !doubtOf(now)) card.append(...saveMasks(now));
      put(moved, card);
    }
    await tiles.renew(snapshot.value());
    // The job may have ended between the first answer, for which the viewer was opened, and the next one.
    const drawn = shown ?? found;
    if (extentOf(now) !== extentOf(drawn)) await viewer.renew();
    if (!shown || extentOf(now) !== extentOf(shown)) await results(now);
    shown = now;
  };
  const results = async (now) => {
    const list = await get(`/v1/jobs/${now.id}/snapshots/${snapshot.value()}`, signal);
    viewer.stand(now, list.ready);
    const place = `/v1/jobs/${now.id}/snapshots/${snapshot.value()}/exports/manifest`;
    const manifest = list.ready ? await read(place, signal) : null;
    // Findings that withhold the expected PSNR put its map in doubt, too.
    const withheld = manifest?.content?.assessment?.psnr_db === null;
    viewer.offerMode("error", !withheld && list.files.some(({ name, href }) => href && name === "error.npy"));
    showFiles(files, now, { ...list, files: list.files.filter(({ name }) => !(withheld && name === "error.npy")) }, signal);
    await verdict.show(now, manifest, snapshot.value());
    if (now.state === "succeeded") made.show(now, manifest, place, await read(`/v1/jobs/${now.id}/exports/manifest`, signal));
  };
  const open = async () => {
    await viewer.open(snapshot.value());
    await tiles.renew(snapshot.value());
    await results(shown ?? found);
  };
  snapshot.listen(() => open().catch((error) => isAborted(error) || put(problem, trouble(error))));
  viewer.state = found.state;
  await viewer.open(snapshot.value());
  watch(refresh, signal);
}

/** How much of a job is computed: its pictures and files change with this text. */
const extentOf = ({ state, progress }) => [state, progress.previews_done, progress.tiles_done, progress.snapshots_done].join(" ");

/** Sets the full scale, and the true frame rate if the camera's times are known. */
async function camera(found, viewer, signal) {
  try {
    const { camera_fps: fps, exposure_s: exposure, full_scale: scale } = await get(`/v1/measurements/${found.measurement}`, signal);
    viewer.setFullScale(scale);
    viewer.player.setTrueRate(exposure ? found.shape.frames / exposure : fps ? found.shape.frames * fps : null);
  } catch {
    // Without the camera's times the player shows no true speed.
  }
}

/** The failure of a job: its reason, the remedy, and the page that explains it. */
function failure({ error, problem }) {
  const needsNew = error.includes("create a new calibration");
  return h("div", { class: "trouble", role: "alert" }, h("p", null, marked(capital(error)), needsNew && [". ", h("a", { href: "#/new", class: "writes" }, "Upload the files for a new job")]),
    problem?.remedy && h("p", null, h("b", null, "What to do: "), marked(problem.remedy)),
    problem && h("p", null, about(problem)));
}

/** Field that selects the snapshot of a job with several. */
function snapshotChoice(found) {
  const { first, count } = found.snapshots;
  const input = h("input", { type: "number", id: "snapshot", min: first, max: first + count - 1, value: first });
  const element = count > 1 && h("label", { class: "row", for: "snapshot" }, "Snapshot", input, `of ${first} to ${first + count - 1}`);
  const value = () => Math.min(first + count - 1, Math.max(first, Number(input.value) || first));
  const next = () => {
    input.value = value() < first + count - 1 ? value() + 1 : first;
    input.dispatchEvent(new Event("change"));
  };
  return { element, value, next, listen: (call) => input.addEventListener("change", call) };
}

/** Progress in per cent of the planned cost, stage, time and tiles. */
function line(now) {
  const { percent, tiles_done: done, tiles_total: total } = now.progress;
  const parts = [
    now.state !== "succeeded" && `${percent.toFixed(percent > 0 && percent < 10 ? 1 : 0)} %`,
    stageOf(now),
    timeOf(now),
    total > 1 && `${done} of ${total} tiles`,
  ];
  const text = h("span", null, parts.filter(Boolean).join(" · "));
  return now.finished_at ? text : [h("progress", { max: 100, value: percent, "aria-label": "Progress" }), text];
}

const NAMES = { "stack.exr": "EXR stack", "frames.npy": "Array (npy)", "mosaic.npy": "Mosaic (npy)", "error.npy": "Expected error (npy)", "manifest.json": "Manifest" };

const ORDER = Object.keys(NAMES);
/** Smallest side in pixels of frames that can be encoded as a movie. */
const MIN_MOVIE_SIDE = 16;

/** Shows the downloads of a snapshot, and those of the whole job once it has succeeded. */
function showFiles(element, { id, state, shape, dispersion, snapshots: { count } }, { snapshot, ready, files }, signal) {
  const base = `/v1/jobs/${id}`;
  // The files' own references are relative to the address of the list.
  const link = (file, main) => h("a", { class: `button small${main ? " primary" : ""}`, href: file.href && `${base}/snapshots/${file.href}`, download: true, title: file.name }, NAMES[file.name] ?? file.name.replace(/^.*\//, ""), h("span", { class: "size" }, bytes(file.size)));
  const whole = files.filter((file) => !file.name.includes("/")).sort((one, other) => ORDER.indexOf(one.name) - ORDER.indexOf(other.name));
  const single = files.filter((file) => file.name.includes("/"));
  element.hidden = !ready;
  // These files are generated during the download, so their sizes are unknown.
  const made = (href, text) => h("a", { class: "button small", href, download: true }, text);
  const moves = Math.min(shape.height, shape.width) >= MIN_MOVIE_SIDE;
  const has = (name) => whole.some((file) => file.name === name);
  const own = `${base}/snapshots/${snapshot}/exports`;
  put(element, h("b", null, "Download"), whole.map((file) => link(file, file.name === "stack.exr")),
    ready && has("error.npy") && made(`${own}/exr?layers=sigma`, "EXR stack with expected error"),
    ready && made(`${own}/tiff`, "TIFF stack"),
    ready && moves && movieLink(base, snapshot, "mp4", "Movie", signal),
    ready && movieLink(base, snapshot, "gif", "GIF for presentations", signal),
    ready && moves && count > 1 && state === "succeeded" && movieLink(base, null, "mp4", "Movie of all snapshots", signal),
    ready && state === "succeeded" && made(`${base}/exports/zip`, "All files as ZIP"),
    h("details", null, h("summary", null, `${shape.frames} single ${dispersion ? "bands" : "frames"} as EXR and PNG`), h("div", { class: "row" }, single.map((file) => link(file, false)))));
}

/** Reads a manifest; an object with the error if the service refuses it. */
const read = (path, signal) => get(path, signal).catch((error) => (isAborted(error) ? Promise.reject(error) : { error }));
