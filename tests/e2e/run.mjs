// Drives the dashboard of a real service in a real Chromium; ends with one line of JSON.
//
//     node run.mjs PROGRAM
//
// CHROMIUM names the browser. Screenshots of every view are written to e2e-output/. SHORT=1 takes a quarter of
// them, and fills the list with 500 jobs instead of 5,000.

import { fileURLToPath } from "node:url";
import { chromium } from "playwright-core";
import { Checks } from "./checks.mjs";
import { HOSTILE, bands, captures, colour, compare, decided, ending, judged, manage, matlab, mended, moved, movie, network, options, refusals, sample, spectrum, stated, submit, view, watch } from "./drive.mjs";
import { Service } from "./service.mjs";
import { fill, scroll, visit } from "./measure.mjs";
import { scene, spectral } from "./scene.mjs";
import { access, faults, loading, phone, reference } from "./states.mjs";

const FRAMES = 8;
const MOST_BYTES = 150_000;
const program = process.argv[2];
const checks = new Checks(fileURLToPath(new URL("../../e2e-output", import.meta.url)));
const browser = await chromium.launch({ executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium" });
const services = [];

/** A job that keeps a worker busy for minutes. */
const long = (measurement, label) => ({
  measurement, algorithm: "gap-tv", label, tile: { size: 128, overlap: 16 },
  schedule: { stages: [{ prior: "tv", iterations: 10000, tv_weight: 0.05, tv_updates: 40, tolerance: 0 }] },
});

async function everything() {
  const service = await Service.start(program, "--workers", "2");
  services.push(service);
  const page = await checks.page(await browser.newContext({ viewport: { width: 1400, height: 900 } }));
  await page.goto(service.url);
  // The sample is computed during the next walks and judged afterwards.
  const tried = await checks.step("sample", () => sample(page, checks));
  const [shown, small] = [scene(FRAMES, 720, 960), scene(4, 64, 64)];
  const id = await checks.step("submit", () => submit(page, checks, shown, small));
  await checks.step("watch", () => watch(page, checks));
  await checks.look(page, "job");
  await service.when(tried, (job) => job.state === "succeeded", 300);
  await checks.step("judged", () => judged(page, checks, service.url, tried));
  await page.goto(`${service.url}/#/jobs/${id}`);
  await checks.step("movie", () => movie(page, checks, [FRAMES, 720, 960]));
  await checks.step("view", () => view(page, checks, FRAMES));
  const { measurement } = await service.call("GET", `/v1/jobs/${id}`);
  const other = await service.submit({ measurement, algorithm: "gap-tv", label: "ten iterations", schedule: { stages: [{ prior: "tv", iterations: 10, tv_weight: 0.05 }] } });
  await service.when(other.id, (job) => job.state === "succeeded");
  await checks.step("compare", () => compare(page, checks, ["ten iterations", HOSTILE], shown.truth));
  const adaptive = await service.submit({ measurement, algorithm: "gap-tv3d", label: "with a pilot" });
  await service.when(adaptive.id, (job) => job.state === "succeeded");
  await page.goto(`${service.url}/#/jobs/${adaptive.id}`);
  const { content } = await service.call("GET", `/v1/jobs/${adaptive.id}/exports/manifest`);
  await checks.step("decided", () => decided(page, checks, content.pilot.stages[0]));
  await checks.look(page, "job-pilot");
  await checks.step("captures", () => captures(page, checks, small));
  await checks.step("matlab", () => matlab(page, checks, service));
  await checks.step("options", () => options(page, checks, service));
  await checks.step("colour", () => colour(page, checks, scene(FRAMES, 192, 256, 1, true)));
  await checks.step("movie in colour", () => movie(page, checks, [FRAMES, 192, 256]));
  await checks.step("mended", () => mended(page, checks, service));
  await checks.step("refusals", () => refusals(page, checks, service, small));
  await checks.step("spectral", () => spectrum(page, checks, spectral(6, 64, 96, 2), 6));
  await checks.step("bands", () => bands(page, checks, service, spectral(6, 64, 96, 2), 6));
  const drifting = scene(FRAMES, 128, 128, 3);
  const { calibration } = await service.take(drifting);
  const shifted = await service.call("POST", "/v1/blobs", drifting.moved(2, -1));
  const drifted = await service.call("POST", "/v1/measurements", { calibration, data: shifted.sha256 });
  const registered = await service.submit({ measurement: drifted.id, algorithm: "gap-tv", label: "moved masks" });
  await service.when(registered.id, (job) => job.state === "succeeded");
  await page.goto(`${service.url}/#/jobs/${registered.id}`);
  await checks.step("moved", () => moved(page, checks));
  await checks.step("ending", () => ending(browser, checks, service, registered.id));
  const known = await checks.step("stated", () => stated(page, checks, drifting, small));
  const { registration } = await service.call("GET", `/v1/jobs/${known}`);
  checks.that(JSON.stringify(registration) === '{"shift":[2,-1],"rotation":0,"scale":1}', `the job has the stated shift: ${JSON.stringify(registration)}`);
  await checks.step("phone", () => phone(browser, checks, service.url, id));
  await checks.step("loading", () => loading(browser, checks, service.url));
  await checks.step("reference", () => reference(browser, checks, service.url));
  await service.submit(long(measurement, "long job"));
  await checks.step("manage", () => manage(page, checks, "long job"));
  checks.that((await page.textContent(`.list a >> text=${HOSTILE}`)) === HOSTILE, "the list shows the name as text");
  await views(page, service);
  await checks.step("network", () => network(page, checks, service.url, tried, id));
  await checks.step("access", () => access(browser, checks, program, services));
  await checks.step("faults", () => faults(browser, checks, program, services));
  const busy = await checks.step("visit", () => loaded(service, measurement));
  const list = await checks.step("list", thousands);
  checks.that(checks.errors.length === 0, `no script error and no dialog: ${checks.errors}`);
  return { ...busy, list };
}

/** Checks the views that need no interaction. */
async function views(page, service) {
  const verdict = ".list tr:has(a:text-is('sample')) .checks";
  await page.waitForSelector(`${verdict}:has-text('dB measured')`);
  checks.that(!(await page.textContent(verdict)).includes("about"), "the list shows the measured PSNR, not the expected one");
  const cut = await page.$$eval(".list .checks", (cells) => cells.filter((cell) => cell.scrollWidth > cell.clientWidth).map((cell) => cell.textContent));
  checks.that(cut.length === 0, `no verdict is cut: ${cut}`);
  await checks.look(page, "jobs");
  await page.goto(`${service.url}/#/system`);
  await page.waitForSelector("table");
  await checks.text(page, ".lead", (lead) => /^(No job is running or queued|(no jobs|\d+ jobs?) running, (none|\d+) queued); 2 workers ready; [\d.]+ [KMGT]iB free\.$/.test(lead), "the state is one sentence");
  await checks.look(page, "system");
  await page.goto(`${service.url}/#/calibrations`);
  await page.click(".calibration >> nth=0");
  await page.waitForSelector(".viewer");
  await page.waitForSelector("text=Each cell shows the correlation");
  await page.click("#play");
  await page.waitForFunction(() => document.querySelector("#frame").value !== "1");
  await page.click("#play");
  await checks.look(page, "calibration");
}

/** Measures a visit while both workers compute. */
async function loaded(service, measurement) {
  const jobs = [await service.submit(long(measurement, "busy"))];
  await service.when(jobs[0].id, (job) => job.progress.tiles_running === 2);
  const found = await visit(browser, checks, service.url);
  const still = await service.call("GET", `/v1/jobs/${jobs[0].id}`);
  checks.that(still.progress.tiles_running === 2, "both workers computed during the visit");
  checks.that(found.paint > 0, "the page was painted");
  checks.that(found.bytes < MOST_BYTES, `the dashboard weighs ${found.bytes} bytes`);
  await service.call("POST", `/v1/jobs/${jobs[0].id}/cancel`);
  return { page_bytes: found.bytes, page_files: found.files, first_paint_ms: found.paint };
}

/** Measures a list of thousands of jobs. */
async function thousands() {
  const service = await Service.start(program, "--workers", "0", "--max-jobs", "6000");
  services.push(service);
  const { measurement } = await service.take(scene(2, 32, 32));
  await checks.step("fill", () => fill(service, measurement));
  const page = await checks.page(await browser.newContext({ viewport: { width: 1400, height: 900 } }));
  return scroll(page, checks, service.url);
}

let result;
let failed = 0;
try {
  result = await everything();
} catch (error) {
  failed = 1;
  console.error(error);
  if (checks.errors.length > 0) console.error(checks.errors);
}
await browser.close();
await Promise.allSettled(services.map((service) => service.stop()));
console.log(JSON.stringify({
  e2e: failed ? "failed" : "passed", checks: checks.count, views: checks.views.size, screenshots: checks.screenshots,
  ms: checks.times, ...result,
}));
process.exitCode = failed;
