// What a person does with the dashboard, step by step.

export const HOSTILE = "<img src=x onerror=alert(1)>";

const state = (page, name) => page.waitForSelector(`.head .badge.${name}`, { timeout: 120_000 });

/** Drops a file on a place, as a mouse does. */
async function drop(page, selector, name, bytes) {
  const transfer = await page.evaluateHandle(([name, text]) => {
    const transfer = new DataTransfer();
    transfer.items.add(new File([Uint8Array.from(atob(text), (c) => c.charCodeAt(0))], name));
    return transfer;
  }, [name, bytes.toString("base64")]);
  await page.dispatchEvent(selector, "dragover", { dataTransfer: transfer });
  await page.dispatchEvent(selector, "drop", { dataTransfer: transfer });
}

/** Drops the files of a scene, reads the verdicts, submits; gives the job's identifier. */
export async function submit(page, checks, scene) {
  await page.click("#nav >> text=New job");
  await page.waitForSelector("label.drop");
  const [masks, data] = ["label.drop:has(#masks)", "label.drop:has(#data)"];
  await drop(page, masks, "notes.txt", Buffer.from("these are no masks"));
  checks.that((await page.waitForSelector(".trouble")) !== null, "a file that can't be read is refused with the reason");
  await drop(page, masks, "masks.npy", scene.masks);
  await page.waitForSelector("text=The calibration is taken.");
  await drop(page, data, "masks.npy", scene.masks.subarray(0, 200));
  await page.waitForSelector(".step:nth-child(2) .trouble");
  checks.that(await page.isDisabled("button[type=submit]"), "nothing is submitted without a measurement");
  await drop(page, data, "measurement.npy", scene.measurement);
  await page.waitForSelector("text=The measurement fits the calibration.");
  // One that takes some seconds, so that its progress can be watched.
  await page.selectOption("#algorithm", "admm-tv");
  await page.fill("#label", HOSTILE);
  await checks.look(page, "submit");
  await page.click("button[type=submit]");
  await page.waitForURL(/#\/jobs\/[0-9a-f-]{36}$/);
  return page.url().slice(-36);
}

/** Watches a job until it has succeeded; its tiles must show before that. */
export async function watch(page, checks) {
  await page.waitForSelector(".tile.done", { timeout: 120_000 });
  checks.that((await page.textContent(".head h1")) === HOSTILE, "the name is shown as text");
  checks.that((await page.$$("img")).length === 0, "and makes no element");
  const bar = () => page.$eval(".progressline progress", (bar) => bar.value);
  const before = await bar();
  await page.waitForFunction((before) => document.querySelector(".progressline progress").value > Math.min(before, 99), before, { timeout: 120_000 });
  const early = await brightness(page);
  await state(page, "succeeded");
  checks.that((await bar()) === 100, "the bar is full");
  await page.waitForSelector(".plot .line.residual");
  return early;
}

/** The mean of what a pane shows, and of its left and right half. */
export function brightness(page, pane = 1) {
  return page.evaluate((pane) => {
    const canvas = document.querySelectorAll(".sight canvas")[pane];
    const { width, height } = canvas;
    const { data } = canvas.getContext("2d").getImageData(0, 0, width, height);
    const sums = [0, 0];
    for (let at = 0; at < data.length; at += 4) sums[(at / 4) % width < width / 2 ? 0 : 1] += data[at];
    return { left: sums[0] / (data.length / 8), right: sums[1] / (data.length / 8) };
  }, pane);
}

const frame = (page) => page.$eval("#frame", (slider) => Number(slider.value));

/** Frames, play, keys, zoom, other maps. */
export async function view(page, checks, frames) {
  await page.waitForTimeout(1200);
  const first = await brightness(page);
  await page.$eval("#frame", (slider, last) => {
    slider.value = last;
    slider.dispatchEvent(new Event("input"));
  }, frames);
  await page.waitForTimeout(1200);
  const last = await brightness(page);
  checks.that(first.left > first.right && last.right > last.left, `the bright square moves from left to right: ${JSON.stringify([first, last])}`);

  await page.fill("#rate", "20");
  const seen = await page.evaluate(() => new Promise((resolve) => {
    const seen = [];
    const slider = document.querySelector("#frame");
    document.querySelector("#play").click();
    const look = () => {
      if (seen.at(-1) !== slider.value) seen.push(slider.value);
    };
    const timer = setInterval(look, 5);
    setTimeout(() => {
      clearInterval(timer);
      resolve(seen);
    }, 2500);
  }));
  await page.click("#play");
  checks.that(seen.length >= 20, `in 2.5 s at 20 frames a second, ${seen.length} are seen`);
  const paused = await frame(page);
  await page.focus(".sight canvas >> nth=1");
  await page.keyboard.press("ArrowRight");
  checks.that((await frame(page)) === (paused % frames) + 1, "an arrow key steps");

  const pictures = () => page.$$eval(".sight canvas", (panes) => panes.map((pane) => pane.toDataURL()));
  const whole = await pictures();
  const box = await (await page.$(".sight canvas >> nth=1")).boundingBox();
  await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
  for (let turn = 0; turn < 6; turn += 1) await page.mouse.wheel(0, -200);
  await page.waitForTimeout(1500);
  const zoom = Number.parseInt(await page.textContent(".controls .row:last-child .muted"), 10);
  checks.that(zoom > 300, `the wheel zooms: ${zoom} %`);
  const near = await pictures();
  checks.that(near.every((picture, pane) => picture !== whole[pane]), "both panes zoom in step");
  await checks.look(page, "job-zoomed");
  await page.mouse.down();
  await page.mouse.move(box.x + box.width / 2 + 80, box.y + box.height / 2 + 20, { steps: 4 });
  await page.mouse.up();
  await page.keyboard.press("0");
  await page.waitForTimeout(400);
  for (const mode of ["difference", "residual"]) {
    await page.selectOption("#mode", mode);
    await page.waitForTimeout(800);
    const shown = await brightness(page);
    checks.that(shown.left + shown.right > 1, `the ${mode} map shows something`);
    await checks.look(page, `job-${mode}`);
  }
  await page.selectOption("#mode", "frame");
  checks.that((await page.$$eval(".card a[download]", (links) => links.length)) === 2 * frames + 3, "all files can be downloaded");
  const line = await page.textContent("pre.line");
  checks.that(line.startsWith("curl -sS http") && line.includes("admm-tv"), "the line repeats the job");
}

/** Chooses two jobs and compares them. */
export async function compare(page, checks, labels, truth) {
  await page.click("#nav >> text=Jobs");
  for (const label of labels) await page.check(`tr:has-text("${label}") input[type=checkbox]`);
  await page.click("text=Compare the two");
  await page.waitForSelector(".figures");
  await page.waitForTimeout(1200);
  const [one, other] = [await brightness(page, 0), await brightness(page, 1)];
  checks.that(one.left > 1 && other.left > 1, "both panes show frames");
  await page.setInputFiles("#truth", { name: "truth.npy", mimeType: "application/octet-stream", buffer: truth });
  await page.waitForSelector(".quality");
  const psnr = await page.$$eval(".quality:nth-last-child(2) td", (cells) => cells.map((cell) => Number.parseFloat(cell.textContent)));
  checks.that(psnr.every((value) => value > 10 && value < 80) && Math.max(...psnr) > 25, `PSNR is told: ${psnr} dB`);
  await checks.look(page, "compare");
  await page.fill("#flicker-rate", "10");
  const titles = await page.evaluate(() => new Promise((resolve) => {
    const titles = new Set();
    document.querySelector("#flicker").click();
    const timer = setInterval(() => titles.add(document.querySelector(".pane figcaption span").textContent), 20);
    setTimeout(() => {
      clearInterval(timer);
      resolve([...titles]);
    }, 1500);
  }));
  checks.that(titles.length === 2, `the two take turns: ${titles}`);
  await checks.look(page, "compare-flicker");
}

/** Reads what the pilot of a job has decided; stage is its record in the manifest. */
export async function decided(page, checks, stage) {
  const card = await page.waitForSelector("section[aria-label=Manifest]:has-text('Pilot, tv')", { timeout: 30_000 });
  const text = await card.textContent();
  const expected = `total variation along time ${stage.temporal_weight === 0 ? "left out" : "kept"}, error at held-out pixels 1 to ${Number(stage.error_after.toPrecision(3))}`;
  checks.that(stage.planned_temporal_weight > 0 && text.includes(expected), `what the pilot decided is told: ${text}`);
}

/** Cancels, retries and deletes a job that would run for long. */
export async function manage(page, checks, label) {
  await page.click("#nav >> text=Jobs");
  const row = `tr:has-text("${label}")`;
  await page.waitForSelector(`${row} .badge.running`, { timeout: 60_000 });
  await page.click(`${row} button.cancel`);
  await page.waitForSelector(`${row} .badge.cancelled`, { timeout: 30_000 });
  await page.click(`${row} button.retry`);
  await page.waitForSelector(`${row} .badge.running`, { timeout: 60_000 });
  await page.click(`${row} button.cancel`);
  await page.waitForSelector(`${row} .badge.cancelled`, { timeout: 30_000 });
  await page.click(`${row} button.delete`);
  await page.waitForSelector("dialog[open]");
  checks.that((await page.textContent("dialog")).includes(label), "the question names the job");
  await checks.look(page, "delete");
  await page.click("dialog >> text=Keep");
  checks.that((await page.$(row)) !== null, "a job that is kept stays");
  await page.click(`${row} button.delete`);
  await page.click("dialog button.danger");
  await page.waitForSelector(row, { state: "detached", timeout: 15_000 });
}
