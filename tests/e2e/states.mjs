// States caused by faults, missing rights, small screens and slow answers.

import { createServer, request as forward } from "node:http";
import { join } from "node:path";
import { scene } from "./scene.mjs";
import { Service } from "./service.mjs";

const DESKTOP = { viewport: { width: 1400, height: 900 } };

/** A result with warnings, a failed job, a cancelled job, and an unreachable service. */
export async function faults(browser, checks, program, services) {
  const service = await Service.start(program, "--workers", "1");
  services.push(service);
  const [own, foreign] = [scene(8, 96, 128, 1), scene(8, 96, 128, 77)];
  const { calibration } = await service.take(own);
  const data = await service.call("POST", "/v1/blobs", foreign.repeated(3));
  const measurement = await service.call("POST", "/v1/measurements", { calibration, data: data.sha256, exposure_s: 0.1 });
  const bad = await service.submit({ measurement: measurement.id, algorithm: "gap-tv", label: "wrong masks" });
  await service.when(bad.id, (job) => job.state === "succeeded");
  const page = await checks.page(await browser.newContext(DESKTOP));
  await page.goto(`${service.url}/#/jobs/${bad.id}`);
  await page.waitForSelector(".judgement.bad, .judgement.usable");
  await checks.text(page, ".judgement", (verdict) => /Bad|Doubtful/.test(verdict), "the verdict warns");
  await page.waitForSelector(".verdictcard .findings li");
  const found = await page.$$eval(".verdictcard .findings li", (lines) => lines.map((line) => line.textContent));
  checks.that(found.join().includes("What to do:"), "a finding shows its remedy");
  checks.that(found.filter((line) => line.includes("3 snapshots (0 to 2)")).length > 0 && !found.some((line) => /Snapshot [012]:/.test(line)), `a finding of all snapshots is one line: ${found}`);
  await page.waitForSelector("text=10 times slower than real time");
  await page.click("text=True speed");
  await page.waitForSelector("text=in real time");
  await checks.until(() => page.inputValue("#rate"), (rate) => rate === "80", "eight frames in 0.1 s are 80 frames per second");
  await page.click("#play");
  await checks.look(page, "warning");
  await checks.text(page, ".head .badge", (badge) => badge === "finished", "only the verdict judges a job that has ended");
  await checks.text(page, ".verdictcard > p:last-child", (text) => /alone/.test(text), "the check of the calibration alone doesn't contradict the findings");
  await withheld(page, checks);
  await doubted(page, checks, service);
  const stages = [{ prior: "tv", iterations: 10000, tv_weight: 0.05, tv_updates: 40, tolerance: 0 }];
  const long = await service.submit({ measurement: measurement.id, algorithm: "gap-tv", label: "stopped early", schedule: { stages } });
  await service.when(long.id, (job) => job.progress.tiles_running > 0 && job.progress.previews_done > 0);
  await page.goto(`${service.url}/#/jobs/${long.id}`);
  await page.waitForSelector(".onpicture:has-text('Preview')");
  await checks.look(page, "preview");
  await page.click("text=Cancel");
  await page.waitForSelector(".onpicture:has-text('Cancelled:')");
  checks.that((await page.$(".downloads a")) === null, "incomplete files are not offered");
  await checks.look(page, "cancelled");
  service.damage();
  const failed = await service.submit({ measurement: measurement.id, algorithm: "gap-tv", label: "damaged" });
  await service.when(failed.id, (job) => job.state === "failed");
  await page.goto(`${service.url}/#/jobs/${failed.id}`);
  await page.waitForSelector(".onpicture:has-text('Failed')");
  const reason = await page.textContent("#content .trouble");
  checks.that(/^Preparing: the stored /.test(reason) && !/[0-9a-f]{64}/.test(reason) && reason.includes("Do what the detail says"), `the reason and the remedy agree: ${reason}`);
  checks.that((await page.$(".trouble a[href='#/new']")) !== null, "damaged inputs lead to a new job");
  const useless = [".verdictcard > p:last-child", ".verdictcard .findings", "#mode", ".probe", ".slicing"];
  await checks.until(() => Promise.all(useless.map((place) => page.isVisible(place))), (seen) => !seen.some(Boolean), "a job without frames has neither grade nor controls");
  await checks.look(page, "failed");
  await page.goto(`${service.url}/#/jobs`);
  await page.waitForSelector(".badge.failed");
  checks.that((await page.$(".list .mark.error, .list .mark.warning")) !== null, "the list shows the findings");
  await checks.look(page, "jobs-states");
  await page.click("text=damaged");
  await page.waitForSelector("h1:has-text('damaged')");
  await page.click(".head button.more");
  await page.click("text=Rename");
  await page.fill("#new-name", "another name");
  await page.keyboard.press("Enter");
  await page.waitForSelector("h1:has-text('another name')");
  await page.click("#nav >> text=Jobs");
  await page.waitForSelector(".list >> text=another name");
  await service.stop();
  await page.waitForSelector("#offline:not([hidden])", { timeout: 20_000 });
  await checks.look(page, "offline");
  await page.click("#nav >> text=Calibrations");
  await page.waitForSelector("h1:has-text('The service does not answer')");
  await checks.look(page, "offline-view");
}

/** No map of the expected error is offered while the findings withhold the expected PSNR. */
async function withheld(page, checks) {
  await page.waitForSelector(".verdictcard:has-text('No expected PSNR')");
  await page.waitForSelector(".downloads a >> text=Manifest");
  checks.that(!/expected error/i.test(await page.textContent(".downloads")), "the map of the expected error is not offered for download");
  checks.that(await page.$eval("#mode option[value=error]", (option) => option.disabled), "the viewer doesn't offer it");
}

/** A measurement in counts without dark frames: the missing dark comes first, and nothing says that the masks have moved. */
async function doubted(page, checks, service) {
  const seen = scene(8, 128, 160, 5);
  const { calibration } = await service.take(seen);
  const data = await service.call("POST", "/v1/blobs", seen.undarkened(1000));
  const measurement = await service.call("POST", "/v1/measurements", { calibration, data: data.sha256, full_scale: 1000 });
  checks.that(measurement.warnings.some(({ code }) => code === "no_dark"), `the dark is missing: ${JSON.stringify(measurement.warnings)}`);
  const job = await service.submit({ measurement: measurement.id, algorithm: "gap-tv3d", label: "no dark" });
  await service.when(job.id, ({ state }) => state === "succeeded");
  await page.goto(`${service.url}/#/jobs/${job.id}`);
  const card = await (await page.waitForSelector("section[aria-label=Registration]:has-text('Not known')")).textContent();
  checks.that(card.includes("While the finding no_dark stands") && !/masks have moved|they fit/.test(card), `an uncertain registration is no statement: ${card}`);
  const made = await (await page.waitForSelector("section[aria-label='How it was made']:has-text('Full scale')")).textContent();
  checks.that(/Full scale1000 counts: /.test(made) && /White level[\d.]+ counts \([\d.]+ × full scale\)/.test(made), `each number has its unit: ${made}`);
  await checks.text(page, ".verdictcard .findings", (text) => /coded aperture/.test(text), "the remedy says how to record the dark");
  await checks.text(page, ".verdictcard .findings", (text) => text.includes("“Dark captures”"), "a remedy has the names of the form");
  await checks.look(page, "no-dark");
}

/** Sign-in, a wrong token, a forbidden view, another lab, and sign-out. */
export async function access(browser, checks, program, services) {
  const service = await Service.start(program, "--workers", "0");
  services.push(service);
  const [submit, admin] = [service.token("submit"), service.token("admin")];
  const page = await checks.page(await browser.newContext(DESKTOP));
  await page.goto(service.url);
  await page.waitForSelector("h1:has-text('Sign in')");
  await checks.look(page, "signed-out");
  await page.fill("#token", `${submit}x`);
  await page.keyboard.press("Enter");
  await page.waitForSelector(".trouble:has-text('does not know this token')");
  await checks.look(page, "wrong-token");
  await page.fill("#token", submit);
  await page.keyboard.press("Enter");
  await page.waitForSelector("text=One image in");
  await page.waitForSelector("#who:has-text('optics · submit')");
  checks.that(!(await page.isVisible("#nav >> text=System")), "the menu omits forbidden views");
  await page.goto(`${service.url}/#/system`);
  await page.waitForSelector("h1:has-text('Your role does not allow this')");
  await checks.look(page, "forbidden");
  await page.goto(`${service.url}/#/nowhere`);
  await page.waitForSelector("h1:has-text('Page not found')");
  await page.click("#who");
  await page.waitForSelector("h1:has-text('Lab optics')");
  await checks.look(page, "account");
  await page.click("#sign-out");
  await page.waitForSelector("h1:has-text('Sign in')");
  checks.that((await page.evaluate(() => document.cookie)) === "", "scripts see no cookie");
  await page.reload();
  await page.fill("#token", service.token("read"));
  await page.keyboard.press("Enter");
  await page.waitForSelector("#who:has-text('optics · read')");
  await page.goto(`${service.url}/#/new`);
  await page.waitForSelector("h1:has-text('Your role does not allow this')");
  await page.click("#who");
  await page.click("#sign-out");
  await page.waitForSelector("h1:has-text('Sign in')");
  await page.fill("#token", admin);
  await page.click("text=Sign in >> nth=1");
  await page.waitForSelector("#nav >> text=System >> visible=true");
  await page.click("#who");
  await page.waitForSelector("h1:has-text('Lab optics')");
  checks.that((await page.locator("[aria-label='All labs']").count()) === 0, "an admin of one lab sees no other labs");
  await page.click("#sign-out");
  await page.fill("#token", service.token("admin", "--lab", "guests", "--all-labs"));
  await page.keyboard.press("Enter");
  await page.waitForSelector("#who:has-text('guests · admin')");
  await page.click("#who");
  await page.waitForSelector("[aria-label='All labs'] table");
  await checks.look(page, "all-labs");
  await page.click("[aria-label='Show optics']");
  await page.waitForSelector("#who:has-text('viewing optics · admin')");
  await page.reload();
  await page.waitForSelector("#who:has-text('viewing optics · admin')");
  await page.click("#who");
  await page.click("text=Back to your own lab");
  await page.waitForSelector("#who:has-text('guests · admin')");
  await page.context().close();
}

/** Touch: a swipe scrolls the page, two fingers zoom the image. */
export async function phone(browser, checks, url, job) {
  const context = await browser.newContext({ viewport: { width: 390, height: 844 }, hasTouch: true, isMobile: true });
  const page = await checks.page(context);
  await page.goto(`${url}/#/jobs/${job}`);
  await page.waitForSelector(".downloads a");
  // The measured PSNR comes last, and moves the frames down.
  await page.waitForSelector(".quality:has-text('measured')");
  await page.$eval("[aria-label=Frames] .sight", (sight) => sight.scrollIntoView({ block: "center" }));
  await page.waitForTimeout(600);
  const wire = await context.newCDPSession(page);
  const touch = (type, points) => wire.send("Input.dispatchTouchEvent", { type, touchPoints: points.map(([x, y], id) => ({ x, y, id })) });
  const box = await (await page.$("[aria-label=Frames] .sight")).boundingBox();
  const [x, y] = [box.x + box.width / 2, box.y + box.height / 2];
  const top = () => page.$eval("#content", (main) => main.scrollTop);
  const zoom = () => page.textContent("#zoom");
  const before = await top();
  await touch("touchStart", [[x, y]]);
  for (let step = 1; step <= 8; step += 1) await touch("touchMove", [[x, y - 15 * step]]);
  await touch("touchEnd", []);
  await checks.until(top, (now) => now > before + 40, `a swipe over the image scrolls the page from ${before}`);
  checks.that((await zoom()) === "fit", "a swipe does not zoom the image");
  const held = await top();
  await page.$eval("[aria-label=Frames] .sight", (sight) => sight.scrollIntoView({ block: "center" }));
  await page.waitForTimeout(300);
  const still = await top();
  await touch("touchStart", [[x - 30, y], [x + 30, y]]);
  for (let step = 1; step <= 8; step += 1) await touch("touchMove", [[x - 30 - 8 * step, y], [x + 30 + 8 * step, y]]);
  await touch("touchEnd", []);
  await checks.until(zoom, (text) => Number.parseInt(text, 10) > 80, "two fingers zoom the image");
  checks.that(Math.abs((await top()) - still) < 5, `zooming does not scroll the page: ${still} (${held})`);
  await context.close();
}

/** The view while its data is loading. */
export async function loading(browser, checks, url) {
  const page = await checks.page(await browser.newContext(DESKTOP));
  let go;
  const gate = new Promise((resolve) => (go = resolve));
  await page.route("**/v1/calibrations?*", async (route) => {
    await gate;
    await route.continue();
  });
  await page.goto(`${url}/#/calibrations`);
  await page.waitForSelector(".loading >> visible=true");
  await checks.look(page, "loading");
  go();
  await page.waitForSelector(".calibration");
  await page.waitForSelector(".calibration .grade.good");
  await checks.look(page, "calibrations");
  await page.context().close();
}

/** The API reference, directly and below the path prefix of a proxy. */
export async function reference(browser, checks, url) {
  const proxy = createServer((request, response) => {
    const { pathname, search } = new URL(request.url, url);
    if (!pathname.startsWith("/optics/")) return response.writeHead(404).end();
    forward(`${url}${pathname.slice("/optics".length)}${search}`, { headers: request.headers }, (answer) => {
      response.writeHead(answer.statusCode, answer.headers);
      answer.pipe(response);
    }).end();
  });
  await new Promise((resolve) => proxy.listen(0, "127.0.0.1", resolve));
  for (const base of [url, `http://127.0.0.1:${proxy.address().port}/optics`]) {
    const page = await checks.page(await browser.newContext(DESKTOP));
    const strangers = [];
    page.on("request", (request) => {
      if (!request.url().startsWith(`${base}/`) && !/^(data|blob):/.test(request.url())) strangers.push(request.url());
    });
    await page.goto(`${base}/`);
    await page.click("#nav >> text=API");
    await page.waitForSelector("h1:has-text('sci-recon')");
    await page.waitForSelector("h2:has-text('Submit a reconstruction')");
    const text = await page.textContent("body");
    checks.that(!text.includes("/view/") && !text.includes("/dashboard/"), "the reference shows public operations only");
    checks.that(text.includes("tile"), "the reference shows the fields of requests");
    await page.fill("[role=search] input", "cancel");
    await page.waitForSelector("[data-role='search:results'] >> text=/cancel/i");
    checks.that((await page.getAttribute("a[download]", "href")) === "openapi.yaml", "the reference links the contract");
    checks.that(strangers.length === 0, `the reference loads files of this service alone: ${strangers}`);
    await page.screenshot({ path: join(checks.folder, "reference.png") });
    await page.context().close();
  }
  await new Promise((resolve) => proxy.close(resolve));
}
