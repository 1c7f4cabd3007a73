// The walks of a user through the dashboard.

import { readFileSync } from "node:fs";
import { scene as drawn } from "./scene.mjs";

export const HOSTILE = "<img src=x onerror=alert(1)>";

const state = (page, name) => page.waitForSelector(`.head .badge.${name}`, { timeout: 120_000 });

/** Drops a file on an element, like a mouse. */
async function drop(page, selector, name, bytes) {
  const transfer = await page.evaluateHandle(([name, text]) => {
    const transfer = new DataTransfer();
    transfer.items.add(new File([Uint8Array.from(atob(text), (c) => c.charCodeAt(0))], name));
    return transfer;
  }, [name, bytes.toString("base64")]);
  await page.dispatchEvent(selector, "dragover", { dataTransfer: transfer });
  await page.dispatchEvent(selector, "drop", { dataTransfer: transfer });
}

/** Drops the files of a scene, reads the verdicts and submits; returns the job's identifier. */
export async function submit(page, checks, scene, small) {
  // Checks of large files outlast their requests. Here no answer waits for its check.
  const hurried = ["**/v1/calibrations", "**/v1/measurements"];
  let accepted = 0;
  page.on("response", (response) => (accepted += response.status() === 202));
  for (const place of hurried) {
    await page.route(place, (route) => route.continue({ headers: { ...route.request().headers(), prefer: "respond-async" } }));
  }
  await page.click("#nav >> text=New job");
  await page.check("input[value=masks]");
  const [masks, data] = ["label.drop:has(#masks)", "label.drop:has(#data)"];
  await drop(page, masks, "notes.txt", Buffer.from("these are no masks"));
  checks.that((await page.waitForSelector(".trouble")) !== null, "an unreadable file is rejected with the reason");
  await drop(page, masks, "loud.npy", small.loud());
  await page.click(".askscale >> text=255 means 1");
  await page.waitForSelector("text=The calibration is accepted.");
  checks.that(await page.isHidden(".askscale"), "the question for the full scale disappears without another upload");
  await drop(page, masks, "cube.npy", drawn(40, 48, 56).masks);
  await page.click(".askscale >> text=frame, row, column");
  await page.waitForSelector(".step:nth-child(1) .verdict:has-text('40 of 48 × 56')");
  // Arrays of a MATLAB file are picked by their names, without typing.
  await drop(page, masks, "bench.mat", small.matlab());
  await page.waitForSelector(".arraychoice:has-text('64 × 64 × 4') >> text=patterns");
  const pictures = () => page.$$eval(".arraychoice img", (images) => images.filter((image) => image.naturalWidth > 0).length);
  await checks.until(pictures, (count) => count === 2, "each array has a picture");
  await checks.look(page, "submit-arrays");
  await page.click(".askscale >> text=patterns");
  await page.waitForSelector("text=The calibration is accepted.");
  await drop(page, data, "bench.mat", small.matlab());
  await page.click(".askscale >> text=shots");
  await page.waitForSelector("text=The measurement fits the calibration.");
  await page.fill("#calibration-name", "bench 3");
  await drop(page, masks, "masks.npy", scene.masks);
  await page.waitForSelector(".step:nth-child(1) .verdict:has-text('960')");
  await page.waitForSelector("text=The calibration is accepted.");
  await drop(page, data, "masks.npy", scene.masks.subarray(0, 200));
  await page.waitForSelector(".step:nth-child(2) .trouble");
  checks.that(await page.isDisabled("button[type=submit]"), "nothing is submitted without a measurement");
  // A larger picture is mended by a window.
  await drop(page, data, "larger.npy", scene.framed(16));
  await page.click("text=Use the middle 720 × 960 of the measurement");
  await page.waitForSelector("text=The measurement fits the calibration.");
  checks.that((await page.inputValue("#data-part-row")) === "16", "the window is in the middle");
  await checks.look(page, "submit-window");
  for (const name of ["row", "column", "height", "width"]) await page.fill(`#data-part-${name}`, "");
  await drop(page, data, "measurement.npy", scene.measurement);
  await page.waitForSelector(".step:nth-child(2) .drop:has-text('measurement.npy: ')");
  await page.waitForSelector("text=The measurement fits the calibration.");
  for (const place of hurried) await page.unroute(place);
  checks.that(accepted > 0, "the form waits for checks that outlast their requests");
  // This algorithm takes some seconds, so that the progress can be watched.
  await page.selectOption("#algorithm", "admm-tv");
  await page.fill("#label", HOSTILE);
  await page.waitForSelector(".estimate dd");
  const estimate = await page.textContent(".estimate");
  checks.that(["Done", "Memory", "Disk"].every((word) => estimate.includes(word)), `time, memory and disk are estimated: ${estimate}`);
  checks.that((await page.$("#sequence option[value=separate]")) !== null, "snapshots can be declared independent");
  // Settings that most jobs leave out; a text that can't be read is refused at once.
  await page.click("summary >> text=Snapshots, tiles, schedule");
  for (const [field, wrong, refusal, right] of [["#snapshots", "first", "names no snapshots", "0"], ["#schedule", "{", "is no JSON", ""]]) {
    await page.fill(field, wrong);
    await page.press(field, "Tab");
    await page.waitForSelector(`.estimate .trouble:has-text('${refusal}')`);
    await page.fill(field, right);
    await page.press(field, "Tab");
    await page.waitForSelector(".estimate dd");
  }
  await page.setViewportSize({ width: 390, height: 844 });
  const finish = await page.$$eval(".finish dd, .finish button", (parts) => parts.map((part) => part.getBoundingClientRect().bottom));
  checks.that(finish.length === 5 && Math.max(...finish) < 844, `a phone shows cost and button: ${finish}`);
  await checks.look(page, "submit");
  await page.click("button[type=submit]");
  await page.waitForURL(/#\/jobs\/[0-9a-f-]{36}$/);
  return page.url().slice(-36);
}

/** Reconstructs a MATLAB 7.3 file with names of somebody's own: arrays are clicked, and nothing is typed. */
export async function matlab(page, checks, service) {
  const bytes = readFileSync(new URL("../data/formats/bench73.mat", import.meta.url));
  await page.click("#nav >> text=New job");
  await page.check("input[value=masks]");
  await drop(page, "label.drop:has(#masks)", "bench73.mat", bytes);
  await page.waitForSelector(".arraychoice:has-text('64 × 64 × 8') >> text=patterns");
  await page.click(".askscale >> text=patterns");
  await page.waitForSelector("text=The calibration is accepted.");
  await drop(page, "label.drop:has(#data)", "bench73.mat", bytes);
  await page.click(".askscale >> text=shots");
  await page.waitForSelector("text=The measurement fits the calibration.");
  await page.selectOption("#algorithm", "gap-tv");
  await page.click("button[type=submit]");
  await page.waitForURL(/#\/jobs\/[0-9a-f-]{36}$/);
  await state(page, "succeeded");
  const id = page.url().slice(-36);
  const answer = await fetch(`${service.url}/v1/jobs/${id}/exports/npy`);
  const file = Buffer.from(await answer.arrayBuffer());
  const frames = new Float32Array(file.buffer.slice(file.byteOffset + 10 + file.readUInt16LE(8), file.byteOffset + file.length));
  const truth = frames.map((_, at) => {
    const [frame, row, column] = [at >> 12, (at >> 6) & 63, at & 63];
    const inside = row >= 20 && row < 36 && column >= 4 + 5 * frame && column < 20 + 5 * frame;
    return inside ? 0.95 : 0.35 + 0.2 * Math.sin(column / 9) * Math.cos(row / 13);
  });
  const sum = (value) => truth.reduce((total, _, at) => total + value(at), 0);
  const scale = sum((at) => frames[at] * truth[at]) / sum((at) => truth[at] ** 2);
  const psnr = -10 * Math.log10(sum((at) => (frames[at] / scale - truth[at]) ** 2) / truth.length);
  checks.that(frames.length === 8 * 64 * 64 && psnr > 20, `the frames of a MATLAB file are right: ${psnr} dB`);
  const { verdict } = await service.call("GET", `/v1/jobs/${id}`);
  checks.that(["good", "usable"].includes(verdict), `the verdict is ${verdict}`);
  await checks.text(page, ".judgement", (shown) => shown.toLowerCase().includes(verdict), `the page shows the verdict ${verdict}`);
  const ends = await checks.until(() => page.$$eval(".contrast .ends", (all) => all.map((one) => one.textContent)), (all) => all.some((one) => one.includes("61234")), "the largest count has all its digits");
  checks.that(!ends.some((one) => one.includes("61200")), `no count is rounded: ${ends}`);
  await checks.look(page, "matlab");
}

const bench = (name) => readFileSync(new URL(`../data/ways/${name}`, import.meta.url));

/** Facts, findings, verdict and frames of a job. */
async function effect(service, id) {
  const job = await service.call("GET", `/v1/jobs/${id}`);
  const measurement = await service.call("GET", `/v1/measurements/${job.measurement}`);
  const calibration = await service.call("GET", `/v1/calibrations/${measurement.calibration}`);
  const facts = ({ axes, reading, format, full_scale, height, width }) => ({ axes, reading, format, full_scale, height, width });
  const codes = [measurement, job].map(({ warnings }) => warnings.map(({ code }) => code));
  const frames = await fetch(`${service.url}/v1/jobs/${id}/exports/npy`);
  return JSON.stringify({
    calibration: [facts(calibration), calibration.frames, calibration.mask_mean], measurement: [facts(measurement), measurement.dark], codes,
    job: [job.registration, job.verdict, job.verdict_text], frames: Buffer.from(await frames.arrayBuffer()).toString("base64"),
  });
}

/** The effect of the requests of tests/data/ways without the form; `input` names that of the measurement. */
async function requested(service, input, data, dark) {
  const requests = JSON.parse(bench("requests.json"));
  const hash = async (name) => (await service.call("POST", "/v1/blobs", bench(name))).sha256;
  const calibration = await service.call("POST", "/v1/calibrations", { ...requests.calibration, masks: await hash("bench.h5"), bad_pixels: await hash("bad.npy") });
  const measurement = await service.call("POST", "/v1/measurements", { ...requests[input], calibration: calibration.id, data: await hash(data), dark: [await hash(dark)] });
  const { id } = await service.submit({ ...requests.job, measurement: measurement.id });
  await service.when(id, (job) => job.state === "succeeded");
  return effect(service, id);
}

/** States every option in the form. The job is that of the same requests without the form. */
export async function options(page, checks, service) {
  const [masks, data] = ["label.drop:has(#masks)", "label.drop:has(#data)"];
  const [first, second] = [1, 2].map((number) => `.step:nth-child(${number})`);
  const window = async (part) => {
    for (const [side, value] of Object.entries({ row: 8, column: 8, height: 64, width: 64 })) await page.fill(`#${part}-${side}`, `${value}`);
  };
  const scale = async (step, value) => {
    await page.waitForSelector(`${step} .verdict >> text=is accepted`);
    await page.click(`${step} summary:has-text('Full scale')`).catch(() => null);
    await page.fill(`${step} [aria-label='Another full scale']`, value);
    await page.click(`${step} .askscale >> text=Use`);
    await page.waitForSelector(`${step} summary:has-text(': ${value}')`);
  };
  for (const [input, file, dark] of [["measurement", "bench.h5", "dark.npy"], ["packed", "shots.raw", "dark.raw"]]) {
    await page.click("#nav >> text=New job");
    await page.check("input[value=masks]");
    await page.click(`${first} summary:has-text('Window, masks and packing')`);
    await window("masks-part");
    await page.fill("#masks-part-first", "1");
    await page.fill("#masks-part-last", "8");
    await page.click("summary:has-text('Map of bad pixels')");
    await page.setInputFiles("#bad-pixels", { name: "bad.npy", mimeType: "application/octet-stream", buffer: bench("bad.npy") });
    await drop(page, masks, "bench.h5", bench("bench.h5"));
    await page.click(".askscale >> text=optics/patterns");
    await page.click(".askscale >> text=row, column, frame");
    await scale(first, "1000");
    await page.click(`${second} summary:has-text('Window, packing and saturation')`);
    if (input === "measurement") await window("data-part");
    else await page.selectOption("#data-part-packing", "mono12p");
    await page.fill("#saturation", "3500");
    await page.press("#saturation", "Tab");
    await page.setInputFiles("#darks", { name: dark, mimeType: "application/octet-stream", buffer: bench(dark) });
    await page.waitForSelector(`text=The mean of ${dark} is subtracted.`);
    await drop(page, data, file, bench(file));
    if (input === "measurement") {
      await page.click(`${second} .askscale >> text=camera/shots`);
      await page.click(`${second} .askscale >> text=column, row, frame`);
    }
    await scale(second, "900");
    await page.selectOption("#registration", "stated");
    await page.fill("#shift-rows", "2");
    await page.fill("#shift-columns", "-1");
    await page.selectOption("#algorithm", "gap-tv");
    await page.waitForSelector(".estimate dd");
    await checks.look(page, `submit-options-${input}`);
    await page.click("button[type=submit]");
    await page.waitForURL(/#\/jobs\/[0-9a-f-]{36}$/);
    await state(page, "succeeded");
    const [shown, expected] = [await effect(service, page.url().slice(-36)), await requested(service, input, file, dark)];
    checks.that(shown === expected, `the form states every option of ${input}: ${shown.slice(0, 2000)} instead of ${expected.slice(0, 2000)}`);
  }
}

/** Reconstructs a measurement of a colour sensor, from the form to frames in colour. */
export async function colour(page, checks, scene) {
  await page.click("#nav >> text=New job");
  await page.check("input[value=masks]");
  await drop(page, "label.drop:has(#masks)", "masks.npy", scene.masks);
  await page.waitForSelector("text=The calibration is accepted.");
  // A change of the sensor repeats the request with the same file.
  await page.selectOption("#mosaic", "rggb");
  await page.waitForSelector(".step:nth-child(1) .verdict:has-text('in colour, RGGB')");
  await drop(page, "label.drop:has(#data)", "measurement.npy", scene.measurement);
  await page.waitForSelector("text=The measurement fits the calibration.");
  await page.selectOption("#algorithm", "gap-tv");
  await page.click("button[type=submit]");
  await page.waitForURL(/#\/jobs\/[0-9a-f-]{36}$/);
  await state(page, "succeeded");
  await page.waitForSelector(".downloads a >> text=Mosaic (npy)");
  checks.that((await page.$$(".tile")).length === 4, "each of the four sub-images is a tile");
  await checks.text(page, ".tile title", (title) => /red/.test(title), "a tile names its colour");
  const share = () => page.evaluate(() => {
    const canvas = document.querySelector("[aria-label=Frames] .sight canvas");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let red = 0;
    for (let at = 0; at < data.length; at += 4) {
      if (data[at] > 1.5 * data[at + 1] && data[at + 1] > data[at + 2]) red += 1;
    }
    return red / (data.length / 4);
  });
  await checks.until(share, (share) => share > 0.01 && share < 0.1, "only the square is red");
  await checks.look(page, "colour");
}

/** Drops files that are refused, and follows the proposals to a right result. */
export async function mended(page, checks, service) {
  await page.click("#nav >> text=New job");
  await page.check("input[value=masks]");
  const [masks, data] = ["label.drop:has(#masks)", "label.drop:has(#data)"];
  // More masks than a calibration can have.
  await drop(page, masks, "many.npy", drawn(70, 72, 80).masks);
  await page.waitForSelector(".askscale:has-text('belong to one exposure')");
  await checks.look(page, "submit-refused");
  await page.fill("[aria-label='Last mask']", "7");
  await page.click("text=Use these masks");
  await page.waitForSelector(".step:nth-child(1) .verdict:has-text('8 of 72 × 80')");
  // Masks that are larger than the measurement: those of a stored calibration, too.
  const [large, small] = [drawn(4, 96, 128), drawn(4, 64, 96, 3)];
  const { calibration } = await service.take(large);
  await page.goto(`${service.url}/#/new?calibration=${calibration}`);
  await page.waitForSelector(".pickone input:checked");
  await drop(page, data, "small.npy", small.measurement);
  await page.click("text=Use the middle 64 × 96 of the masks");
  await page.waitForSelector(".step:nth-child(1) .verdict:has-text('4 of 64 × 96')");
  await page.waitForSelector(".step:nth-child(2) .verdict:has-text('The measurement')");
  checks.that((await page.$(".step:nth-child(2) .trouble")) === null, "the window of the masks is accepted with the measurement");
  // A window at a wrong place, which the check corrects.
  const { calibration: exact } = await service.take(large);
  await page.goto(`${service.url}/#/new?calibration=${exact}`);
  await page.waitForSelector(".pickone input:checked");
  await drop(page, data, "framed.npy", large.framed(16));
  await page.click("text=Use the middle 96 × 128 of the measurement");
  await page.waitForSelector("text=The measurement fits the calibration.");
  await page.fill("#data-part-row", "10");
  await page.press("#data-part-row", "Enter");
  await page.click("text=Begin at row 16, column 16");
  await page.waitForSelector("text=The measurement fits the calibration.");
}

/** Every refusal of the service links the page that says what to do. */
export async function refusals(page, checks, service, scene) {
  const { components } = await service.call("GET", "/openapi.json");
  const codes = components.schemas.Problem.properties.code["x-extensible-enum"];
  await page.click("#nav >> text=New job");
  await page.check("input[value=masks]");
  for (const code of codes) {
    const json = { status: 422, code, title: "Refused", detail: "the file is refused" };
    await page.route("**/v1/calibrations", (route) => route.fulfill({ status: 422, contentType: "application/problem+json", json }));
    await drop(page, "label.drop:has(#masks)", `${code}.npy`, scene.masks);
    const link = await page.waitForSelector(`.step:nth-child(1) .trouble a[href$='problems/${code}']`);
    const { status } = await fetch(await link.evaluate((element) => element.href));
    checks.that(status === 200, `the link explains ${code}: ${status}`);
    await page.unroute("**/v1/calibrations");
  }
  checks.that(codes.length > 20, `there are ${codes.length} codes`);
}

/** Reconstructs a snapshot of a spectral camera, from its only mask to a spectrum. */
export async function spectrum(page, checks, scene, bands) {
  await page.click("#nav >> text=New job");
  await page.check("input[value=masks]");
  await drop(page, "label.drop:has(#masks)", "mask.npy", scene.mask);
  await page.selectOption("#mosaic", "spectral");
  await page.waitForSelector(".trouble:has-text('State the displacement of each band')");
  await page.fill("#dispersion-offsets", `0:2:${bands}`);
  await page.fill("#dispersion-wavelengths", `450:40:${bands}`);
  await page.press("#dispersion-wavelengths", "Enter");
  await page.waitForSelector(`text=${bands} bands, displaced by 0 to ${2 * (bands - 1)} pixels; 450 to ${450 + 40 * (bands - 1)} nm.`);
  await page.waitForSelector("text=The calibration is accepted.");
  await drop(page, "label.drop:has(#data)", "measurement.npy", scene.measurement);
  await page.waitForSelector(".step:nth-child(2) .verdict:has-text('The measurement')");
  await page.selectOption("#algorithm", "gap-tv");
  await page.fill("#label", "two squares");
  await page.click("summary:has-text('True frames')");
  await page.setInputFiles("#truth", { name: "truth.npy", mimeType: "application/octet-stream", buffer: scene.truth });
  await page.waitForSelector(".drop:has-text('truth.npy: ')");
  await checks.look(page, "submit-spectral");
  await page.click("button[type=submit]");
  await page.waitForURL(/#\/jobs\/[0-9a-f-]{36}$/);
  await state(page, "succeeded");
  await page.waitForSelector(".quality:has-text('PSNR measured')");
  checks.that((await page.$(".quality:has-text('Expected PSNR')")) === null, "a measured PSNR replaces the expected one");
  await page.waitForSelector(".player output:has-text('450 nm')");
  await page.click("text=Spectra and profiles");
  await page.fill("#curve-row", "32");
  await page.fill("#curve-column", "24");
  await page.press("#curve-column", "Enter");
  const link = ".probe a[download$='.csv']";
  await page.waitForSelector(link);
  const lines = decodeURIComponent(await page.getAttribute(link, "href")).split("\r\n").slice(1, -1).map((line) => line.split(",").map(Number));
  checks.that(lines.length === bands && lines.every(([nm], band) => nm === 450 + 40 * band), `the spectrum is over wavelengths: ${lines}`);
  checks.that(lines[0][1] > 2 * lines.at(-1)[1], `the left square is bright in the first bands: ${lines}`);
  await page.selectOption("#mode", "colours");
  const sides = () => page.evaluate(() => {
    const canvas = document.querySelector("[aria-label=Frames] .sight canvas");
    const at = (x) => [...canvas.getContext("2d").getImageData(Math.round(x * canvas.width), Math.round(canvas.height / 2), 1, 1).data];
    return { left: at(0.3), right: at(0.7) };
  });
  await checks.until(sides, ({ left, right }) => left[2] > left[0] && right[0] > right[2], "short wavelengths are blue, long ones red");
  await checks.look(page, "spectral");
  const readout = async (mode) => {
    await shows(page, checks, 0, () => page.selectOption("#mode", mode), `the ${mode} is shown`);
    const box = await (await page.$(PICTURE)).boundingBox();
    await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
    return checks.until(() => page.textContent("[aria-label=Frames] .readout"), (text) => /^Row/.test(text), "the pixel has a value");
  };
  await readout("residual");
  await checks.look(page, "spectral-residual");
  checks.that(/counts|full scale/.test(await readout("deviation")), "the true error has a unit");
  await checks.look(page, "true-error");
  await page.selectOption("#mode", "frame");
}

/** States a map of bad pixels and a known shift of the masks, and reconstructs with both; returns the job's identifier. */
export async function stated(page, checks, scene, other) {
  await page.click("#nav >> text=New job");
  await page.check("input[value=masks]");
  await page.click("summary:has-text('Map of bad pixels')");
  const file = (name, buffer) => ({ name, mimeType: "application/octet-stream", buffer });
  await page.setInputFiles("#bad-pixels", file("other.npy", other.dead()));
  await drop(page, "label.drop:has(#masks)", "masks.npy", scene.masks);
  await page.waitForSelector(".step:nth-child(1) .verdict .trouble:has-text('map of bad pixels')");
  await page.setInputFiles("#bad-pixels", file("dead.npy", scene.dead()));
  await page.waitForSelector("text=The calibration is accepted.");
  await drop(page, "label.drop:has(#data)", "measurement.npy", scene.moved(2, -1));
  await page.waitForSelector(".step:nth-child(2) .verdict:has-text('The measurement is accepted')");
  checks.that(await page.isHidden("#shift-rows"), "the form asks for a shift only where one is known");
  await page.selectOption("#registration", "stated");
  await page.fill("#shift-rows", "2");
  await page.fill("#shift-columns", "-1");
  await page.selectOption("#algorithm", "gap-tv");
  await page.waitForSelector(".estimate dd");
  await checks.look(page, "submit-stated");
  await page.click("button[type=submit]");
  await page.waitForURL(/#\/jobs\/[0-9a-f-]{36}$/);
  await state(page, "succeeded");
  const text = await (await page.waitForSelector("section[aria-label=Registration]:has-text('Moved as stated')")).textContent();
  checks.that(text.includes("by 2 pixels downwards and 1 pixel to the left"), `the stated shift is in words: ${text}`);
  return page.url().slice(-36);
}

/** Compares jobs of a spectral camera: with equal wavelengths the player names the band, with others each pane. */
export async function bands(page, checks, service, scene, count) {
  const reconstruct = async (first) => {
    const [masks, data] = await Promise.all([scene.mask, scene.measurement].map((bytes) => service.call("POST", "/v1/blobs", bytes)));
    const numbers = (start, step) => Array.from({ length: count }, (_, index) => start + step * index);
    const dispersion = { axis: "column", mask: "scene", offsets: numbers(0, 2), wavelengths: numbers(first, 40) };
    const calibration = await service.call("POST", "/v1/calibrations", { masks: masks.sha256, dispersion });
    const measurement = await service.call("POST", "/v1/measurements", { calibration: calibration.id, data: data.sha256 });
    const { id } = await service.submit({ measurement: measurement.id, algorithm: "gap-tv", label: `from ${first} nm` });
    await service.when(id, (job) => job.state === "succeeded");
    return id;
  };
  const [one, same, other] = [await reconstruct(450), await reconstruct(450), await reconstruct(500)];
  const titles = () => page.$$eval(".pane figcaption span:first-child", (all) => all.map((title) => title.textContent));
  await page.goto(`${service.url}/#/compare/${one}/${same}`);
  await page.waitForSelector(".player output:has-text('band 1 · 450 nm')");
  await page.click("[aria-label='Next frame']");
  await page.waitForSelector(".player output:has-text('band 2 · 490 nm')");
  checks.that((await titles()).every((title) => title === "from 450 nm"), `the panes have the jobs' names: ${await titles()}`);
  await page.goto(`${service.url}/#/compare/${one}/${other}`);
  await page.waitForSelector(".player output:text-is('band 1')");
  await checks.until(titles, ([left, right]) => left === "from 450 nm, band 1 · 450 nm" && right === "from 500 nm, band 1 · 500 nm", "each pane names its band");
  await checks.text(page, ".differs tr:has-text('Bands')", (row) => row.includes("500 to 700 nm"), "the table has the wavelengths");
  await checks.look(page, "compare-bands");
}

/** Opens the page of a job that ends between the first answer of the service and the next: its frames appear. */
export async function ending(browser, checks, service, id) {
  const page = await checks.page(await browser.newContext({ viewport: { width: 1400, height: 900 } }));
  const ended = await service.call("GET", `/v1/jobs/${id}`);
  const progress = { ...ended.progress, percent: 0, stage: "waiting", previews_done: 0, tiles_done: 0, snapshots_done: 0 };
  const running = { ...ended, state: "running", finished_at: null, assessment: null, progress };
  const missing = { status: 404, contentType: "application/problem+json", json: { status: 404, code: "not_ready", title: "Not ready yet" } };
  await page.route(`**/v1/jobs/${id}`, (route) => route.fulfill({ json: running }), { times: 1 });
  await page.route(`**/view/jobs/${id}/snapshots/*/pictures/*/spread`, (route) => route.fulfill(missing), { times: 1 });
  await page.goto(`${service.url}/#/jobs/${id}`);
  await state(page, "succeeded");
  await page.waitForSelector("[aria-label=Frames] .player output");
  checks.that(await page.isHidden("[aria-label=Frames] .sight .note"), "no note says that there are no frames yet");
  await page.context().close();
}

/** Shows the displacement that a job has found. */
export async function moved(page, checks) {
  await page.waitForSelector(".quality:has-text('Expected PSNR: about')");
  await page.waitForSelector("section[aria-label=Registration] .shift path");
  await page.click("text=Save the moved masks as a calibration");
  await page.waitForSelector("section[aria-label=Registration] a[href^='#/calibrations/']");
  const text = await checks.text(page, "section[aria-label=Registration]", (card) => /by \S+ ± .* downwards and .* to the left/.test(card) && /from \S+ % to/.test(card), "the card describes the displacement");
  const [, down, left] = text.match(/by (\S+) ± 0\.\d+ pixels downwards and (\S+) ± 0\.\d+ pixels to the left/) ?? [];
  checks.that(Math.abs(down - 2) < 0.05 && Math.abs(left - 1) < 0.05, `the displacement is in words: ${text}`);
  checks.that(/from \S+ % to \S+ %/.test(text), `the gain is in words: ${text}`);
  await page.$eval("section[aria-label=Registration]", (card) => card.scrollIntoView());
  await checks.look(page, "moved");
}

/** Watches a job until it has succeeded; its tiles must appear before that. */
export async function watch(page, checks) {
  const bar = await page.waitForSelector(".progressline progress");
  const before = await bar.evaluate((bar) => bar.value);
  await page.waitForSelector(".tile.done", { timeout: 120_000 });
  await checks.text(page, ".head h1", (name) => name === HOSTILE, "the name is shown as text");
  checks.that((await page.$$("main img")).length === 0, "the name creates no element");
  // The bar is removed when the job ends.
  await page.waitForFunction((before) => (document.querySelector(".progressline progress")?.value ?? 100) > before, before, { timeout: 120_000 });
  const line = await page.textContent(".progressline");
  checks.that(!/iterations/.test(line) && !/≤/.test(line), `the progress shows no iterations, which belong to one tile: ${line}`);
  // Unfinished frames are marked.
  await page.waitForSelector(".onpicture:has-text('Preview')");
  await checks.look(page, "running");
  const early = await brightness(page);
  await state(page, "succeeded");
  await page.waitForSelector(".onpicture", { state: "hidden" });
  await page.waitForSelector(".downloads a[download]");
  await page.waitForSelector("section[aria-label='How it was made']:has-text('Done')");
  await checks.text(page, "section[aria-label='How it was made']", (made) => /at most (\d+) iterations per tile/.test(made), "iterations are counted as on the form");
  await page.waitForSelector(".plot .line.residual");
  return early;
}

/** Mean brightness of the left and right half of a pane. */
export function brightness(page, pane = 0) {
  return page.evaluate((pane) => {
    const canvas = document.querySelectorAll(".viewer .sight canvas")[pane];
    const { width, height } = canvas;
    const { data } = canvas.getContext("2d").getImageData(0, 0, width, height);
    const sums = [0, 0];
    for (let at = 0; at < data.length; at += 4) sums[(at / 4) % width < width / 2 ? 0 : 1] += data[at];
    return { left: sums[0] / (data.length / 8), right: sums[1] / (data.length / 8) };
  }, pane);
}

/** Acts, and waits until a pane shows another image, which must not be black. */
async function shows(page, checks, pane, act, text) {
  const picture = () => page.$$eval(".viewer .sight canvas", (panes, pane) => panes[pane].toDataURL(), pane);
  const before = await picture();
  await act();
  const read = async () => ({ ...(await brightness(page, pane)), changed: (await picture()) !== before });
  await checks.until(read, ({ left, right, changed }) => changed && left + right > 1, text);
}

const PICTURE = "[aria-label=Frames] .sight canvas";

const frame = (page) => page.$eval("#frame", (slider) => Number(slider.value));

/** Uses the viewer: frames, playback, keys, zoom and maps. */
export async function view(page, checks, frames) {
  await checks.until(() => brightness(page), ({ left, right }) => left > right, "the bright square starts on the left");
  await page.$eval("#frame", (slider, last) => {
    slider.value = last;
    slider.dispatchEvent(new Event("input"));
  }, frames);
  await checks.until(() => brightness(page), ({ left, right }) => right > left, "the bright square moves to the right");
  const downloads = await page.textContent(".downloads");
  checks.that(downloads.includes(`${frames} single frames`), `each frame is counted once: ${downloads}`);

  // Load all frames before the rate is measured.
  await page.fill("#rate", "20");
  await page.focus(PICTURE);
  await page.keyboard.press("Home");
  await page.click("#play");
  await page.waitForFunction((last) => document.querySelector("#frame").value === String(last), frames, { timeout: 60_000 });
  await page.waitForFunction(() => document.querySelector("#frame").value !== document.querySelector("#frame").max, null, { timeout: 60_000 });
  await page.click("#play");
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
  checks.that(seen.length >= 20, `in 2.5 s at 20 frames per second, ${seen.length} frames are shown`);
  const paused = await frame(page);
  await page.focus(PICTURE);
  await page.keyboard.press("ArrowRight");
  checks.that((await frame(page)) === (paused % frames) + 1, "an arrow key steps");

  const pictures = () => page.$$eval(".sight canvas", (panes) => panes.map((pane) => pane.toDataURL()));
  const whole = await pictures();
  const box = await (await page.$(PICTURE)).boundingBox();
  await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
  for (let turn = 0; turn < 6; turn += 1) await page.mouse.wheel(0, -200);
  const zoom = async () => Number.parseInt(await page.textContent("#zoom"), 10);
  await checks.until(zoom, (percent) => percent > 300, "the wheel zooms, in per cent");
  const zoomed = async () => (await pictures()).map((picture, pane) => picture !== whole[pane]);
  await checks.until(zoomed, (changes) => changes.every(Boolean), "both panes zoom together");
  await checks.look(page, "job-zoomed");
  await page.mouse.down();
  await page.mouse.move(box.x + box.width / 2 + 80, box.y + box.height / 2 + 20, { steps: 4 });
  await page.mouse.up();
  await page.keyboard.press("0");
  await page.waitForSelector("#zoom:text-is('fit')");
  for (const mode of ["difference", "residual"]) {
    await shows(page, checks, 0, () => page.selectOption("#mode", mode), `the ${mode} map shows something`);
    await checks.look(page, `job-${mode}`);
  }
  await page.selectOption("#mode", "frame");
  await curves(page, checks, frames);
  // Each frame is an EXR and a PNG. Add stack, array, manifest, TIFF, movie and ZIP.
  const status = (links) => Promise.all(links.map((link) => fetch(link.href, { method: "HEAD" }).then((answer) => answer.status)));
  const answers = await page.$$eval(".downloads a[download]:not([href$=gif])", status);
  checks.that(answers.length === 2 * frames + 6 && answers.every((code) => code === 200), "all files can be downloaded");
  const [saved] = await Promise.all([page.waitForEvent("download"), page.click("text=GIF for presentations")]);
  checks.that(saved.suggestedFilename().endsWith("_0000_movie.gif"), "a GIF is written and downloaded");
  const line = await page.textContent("pre.line");
  checks.that(line.startsWith("curl -sS http") && line.includes("admm-tv"), "the command repeats the job");
  await page.uncheck("#loop");
  await page.fill("#rate", "60");
  await page.click("#play");
  await page.waitForFunction(() => document.querySelector("#play").textContent === "Play");
  checks.that((await frame(page)) === frames, "without a loop, playback stops at the last frame");
  await page.click("#full");
  await page.waitForFunction(() => document.fullscreenElement?.classList.contains("viewer"));
  await page.click("#full");
  await page.waitForFunction(() => !document.fullscreenElement);
}

/** Reads pixels, the histogram and curves of the frames. */
async function curves(page, checks, frames) {
  const box = await (await page.$(PICTURE)).boundingBox();
  const [x, y] = [box.x + box.width / 2, box.y + box.height / 2];
  const [id, row, column] = [page.url().slice(-36), 360, 480];
  const exact = await page.evaluate(async ([id, row, column]) => {
    const answer = await fetch(`v1/jobs/${id}/snapshots/0/exports/npy`);
    const bytes = await answer.arrayBuffer();
    const start = 10 + new DataView(bytes).getUint16(8, true);
    const values = new Float32Array(bytes.slice(start));
    return Array.from({ length: 8 }, (_, frame) => values[(frame * 720 + row) * 960 + column]);
  }, [id, row, column]);
  const at = await frame(page);
  await page.mouse.move(x + 1, y + 1);
  const text = await checks.until(() => page.textContent("[aria-label=Frames] .readout"), (text) => /^Row 36\d, column 48\d: /.test(text), "the pointer shows row, column and value");
  checks.that(/× full scale|counts/.test(text), `the value has a unit: ${text}`);
  checks.that((await page.getAttribute("[aria-label=Frames] .histogram path", "d")).length > 100, "the contrast has a histogram");
  await page.click("text=Curves and profiles");
  await page.fill("#curve-row", String(row));
  await page.fill("#curve-column", String(column));
  await page.press("#curve-column", "Enter");
  const link = ".probe a[download$='.csv']";
  await page.waitForSelector(link);
  const csv = async () => decodeURIComponent(await page.getAttribute(link, "href")).split("\r\n").slice(1, -1).map((line) => line.split(",").map(Number));
  const curve = await csv();
  checks.that(curve.length === frames && curve.every(([number, value], index) => number === index + 1 && Math.abs(value - exact[index]) < 1e-6), `the curve has the exact values, now at frame ${at}: ${JSON.stringify([curve, exact])}`);
  for (const [kind, count] of [["region", frames], ["line", 101]]) {
    await page.selectOption("#curve", kind);
    for (const [id, value] of [["row", 300], ["column", 400], ["row-2", 300], ["column-2", 500]]) await page.fill(`#curve-${id}`, String(value));
    await page.press("#curve-column-2", "Enter");
    await checks.until(async () => ((await page.$(link)) ? (await csv()).length : 0), (length) => length === count, `the ${kind} has its values`);
  }
  // A drag draws the line on the picture.
  await page.mouse.move(x - 50, y);
  await page.mouse.down();
  await page.mouse.move(x + 50, y + 20, { steps: 4 });
  await page.mouse.up();
  await checks.until(() => page.inputValue("#curve-row-2"), (text) => text !== "300", "a drag draws a line");
  await checks.look(page, "job-curves");
  await page.click("text=Curves and profiles");
}

/** Downloads a movie: the link shows the progress, and the browser plays the file. */
export async function movie(page, checks, [frames, height, width]) {
  const link = ".downloads a:has-text('Movie')";
  const download = page.waitForEvent("download", { timeout: 120_000 });
  await page.click(link);
  await page.waitForSelector(`${link}:has-text('encoding')`);
  await checks.look(page, `movie-${width}`);
  const name = (await download).suggestedFilename();
  checks.that(name.endsWith("_0000_movie.mp4"), `the movie is downloaded as ${name}`);
  checks.that((await page.textContent(link)) === "Movie", "the link has its original text again");
  const player = await page.context().newPage();
  await player.goto(await page.$eval(link, (link) => link.href));
  const shown = await player.$eval("video", (video) => new Promise((resolve) => {
    const report = () => resolve([video.videoHeight, video.videoWidth, video.duration, video.ended, video.error?.message ?? null]);
    video.muted = true;
    video.onended = report;
    video.onerror = report;
    video.play().catch(report);
  }));
  checks.that(JSON.stringify(shown) === JSON.stringify([height, width, frames / 10, true, null]), `the browser plays it to its end: ${JSON.stringify(shown)}`);
  await player.close();
}

/** Selects jobs and compares them in every mode. */
export async function compare(page, checks, labels, truth) {
  await page.click("#nav >> text=Jobs");
  for (const label of labels) await page.check(`tr:has-text("${label}") input[type=checkbox]`);
  await checks.look(page, "chosen");
  await page.click("#compare");
  await page.waitForSelector(".figures");
  for (const pane of [0, 1]) await checks.until(() => brightness(page, pane), ({ left }) => left > 1, `pane ${pane} shows frames`);
  await page.setInputFiles("#truth", { name: "truth.npy", mimeType: "application/octet-stream", buffer: truth });
  await page.waitForSelector(".quality");
  const psnr = await page.$$eval(".quality:has-text('PSNR') td", (cells) => cells.map((cell) => Number.parseFloat(cell.textContent)));
  checks.that(psnr.every((value) => value > 10 && value < 80) && Math.max(...psnr) > 25, `PSNR is shown: ${psnr} dB`);
  const groups = await page.$$eval(".figures tbody", (bodies) => bodies.map((body) => body.className));
  checks.that(groups[0] === "differs" && groups[1] === "same", `rows that differ come first: ${groups}`);
  await checks.look(page, "compare");
  await page.setViewportSize({ width: 390, height: 844 });
  const ends = await page.$$eval(".figures td", (cells) => cells.map((cell) => cell.getBoundingClientRect().right));
  checks.that(Math.max(...ends) < 390, `a phone shows the figures of both jobs: ${Math.max(...ends)}`);
  await page.setViewportSize({ width: 1400, height: 900 });
  const picture = () => page.$eval(".sight canvas", (canvas) => canvas.toDataURL());
  const windows = () => page.$$eval(".contrasts .window", (all) => all.map((one) => one.textContent));
  checks.that(new Set(await windows()).size === 1, `jobs of one scale share a contrast: ${await windows()}`);
  await page.check("#match");
  await page.$eval(".contrasts input", (slider) => {
    slider.value = 200;
    slider.dispatchEvent(new Event("input"));
  });
  checks.that(new Set(await windows()).size === 2, "each job can have its own contrast");
  await page.uncheck("#match");
  const whole = await picture();
  await page.click("#wipe");
  await checks.until(async () => (await picture()) !== whole, Boolean, "the wipe overlays the other job");
  const middle = await picture();
  const handle = await (await page.$(".handle")).boundingBox();
  await page.mouse.move(handle.x + 16, handle.y + 40);
  await page.mouse.down();
  await page.mouse.move(handle.x - 150, handle.y + 40, { steps: 3 });
  await page.mouse.up();
  await checks.until(async () => (await picture()) !== middle && (await page.inputValue("#wipe-at")) < 450, Boolean, "the wipe follows the pointer");
  await checks.look(page, "compare-wipe");
  const values = async (x) => {
    const { y } = await (await page.$(".sight canvas")).boundingBox();
    const before = await page.textContent(".readout");
    await page.mouse.move(x, y + 40);
    const text = await checks.until(() => page.textContent(".readout"), (text) => text !== before && /^Row \d+, column \d+: .* × full scale$/.test(text), "the value of a pixel has a unit");
    // Powers of ten follow values below 0.001.
    return text.replaceAll(/ × 10[⁰¹²³⁴-⁹⁻]+/g, "e-4").match(/: .*/)[0].match(/−?\d[\de.-]*/g).map((value) => Number(value.replace("−", "-")));
  };
  const line = await (await page.$(".handle")).boundingBox();
  const [left, right] = [await values(line.x - 8), await values(line.x + 40)];
  checks.that(left.length === 1 && right.length === 1, `each side of the wipe has one value: ${left}, ${right}`);
  await shows(page, checks, 0, () => page.click("#difference"), "the difference shows something");
  const [first, second, difference] = await values(line.x + 40);
  checks.that(second === right[0] && Math.abs(first - second - difference) < 2e-3, `right of the wipe is the second job's value, and a difference has both: ${[right, first, second, difference]}`);
  await checks.text(page, ".pane figcaption span", (title) => title.startsWith("4 × |"), "the title of a difference has its factor");
  await checks.look(page, "compare-difference");
  await page.click("#flicker");
  await page.fill("#flicker-rate", "10");
  const titles = await page.evaluate(() => new Promise((resolve) => {
    const titles = new Set();
    const timer = setInterval(() => titles.add(document.querySelector(".pane figcaption span").textContent), 20);
    setTimeout(() => {
      clearInterval(timer);
      resolve([...titles]);
    }, 1500);
  }));
  checks.that(titles.length === 2, `the two jobs alternate: ${titles}`);
}

/** Compares a job that used a network with one that used none. */
export async function network(page, checks, url, deep, plain) {
  await page.goto(`${url}/#/compare/${deep}/${plain}`);
  const row = await page.waitForSelector(".figures tr:has-text('Network')");
  const cells = await row.$$eval("td", (cells) => cells.map((cell) => cell.textContent));
  checks.that(cells[0].includes("fastdvdnet") && cells[1] === "none", `the table names the networks: ${cells}`);
}

/** Reads the decisions of a job's pilot; `decision` is its record of a stage in the manifest. */
export async function decided(page, checks, decision) {
  const card = await page.waitForSelector("section[aria-label='How it was made']:has-text('Pilot, tv')", { timeout: 30_000 });
  const text = await card.textContent();
  const change = decision.stage.temporal_weight === 0 ? "temporal weight omitted" : "as planned";
  const expected = `${change}, hold-out error 1 before, ${Number(decision.error_after.toPrecision(3))} after`;
  checks.that(decision.planned.temporal_weight > 0 && text.includes(expected), `the card shows the pilot's decisions: ${text}`);
  const [, ratio] = text.match(/Hidden pixels(\S+) times the error of a guess from their neighbours; right masks usually have up to 0\.5/) ?? [];
  checks.that(ratio > 0 && ratio < 0.5, `the hold-out error has a reference: ${text}`);
  checks.that(/Time.* in the queue, then .* until the end/.test(text) && /CPU time.* for the tiles/.test(text), `queue, run and CPU time have one row each: ${text}`);
  checks.that(/White level\S+ × full scale/.test(text) && !text.includes("solver"), `the white level has a unit: ${text}`);
}

/** Submits the sample on an empty service, without typing. */
export async function sample(page, checks) {
  await page.waitForSelector("text=One image in");
  const loaded = await page.$eval(".coded", (box) => getComputedStyle(box).backgroundImage.includes("sample.webp"));
  checks.that(loaded && (await page.$(".clip")) !== null, "the first screen shows a coded image and its frames");
  await checks.look(page, "empty");
  await page.click("#sample");
  await page.waitForURL(/#\/jobs\/[0-9a-f-]{36}$/);
  return page.url().slice(-36);
}

/** Checks the verdict on the sample's result, and plays it. */
export async function judged(page, checks, url, id) {
  await page.goto(`${url}/#/jobs/${id}`);
  await page.waitForSelector(".quality:has-text('SSIM')");
  const psnr = Number.parseFloat(await page.textContent(".quality:has-text('SSIM') b"));
  checks.that(psnr > 15 && psnr < 40, `the verdict shows the true PSNR: ${psnr}`);
  await checks.text(page, ".judgement", (verdict) => verdict.length >= 3, "the verdict has words, too");
  checks.that((await page.$(".quality:has-text('Expected PSNR')")) === null, "the measured PSNR replaces the expected one");
  await shows(page, checks, 0, () => page.selectOption("#mode", "error"), "the map of the expected error shows something");
  await checks.look(page, "job-error");
  await checks.text(page, "[aria-label=Frames] .window", (window) => /× full scale/.test(window), "the bar under the error map has a unit");
  await page.selectOption("#mode", "frame");
  const picture = await (await page.$(PICTURE)).boundingBox();
  checks.that(Math.abs(picture.width / picture.height - 1) < 0.02, `the frame has the shape of the square picture: ${JSON.stringify(picture)}`);
  const coded = await (await page.$("[aria-label=Measurement] .sight canvas")).boundingBox();
  checks.that(coded.y + coded.height < 900 && picture.y + picture.height < 900, "frames and measurement are visible without scrolling");
  checks.that(!(await page.isVisible(".tile")), "a single tile is not drawn");
  // Every viewer sees the true frames that belong to the job.
  const other = await checks.page(await page.context().browser().newContext());
  await other.goto(page.url());
  await other.waitForSelector(".quality:has-text('PSNR measured')");
  checks.that((await other.$(".verdictcard .plot .line")) !== null, "another browser sees the measured PSNR and its curve");
  await other.context().close();
  const before = await frame(page);
  await page.click("#play");
  await page.waitForFunction((before) => document.querySelector("#frame").value !== String(before), before);
  await page.click("#play");
  await checks.look(page, "good");
}

/** Computes masks from raw captures and submits a job with them. */
export async function captures(page, checks, scene) {
  await page.click("#nav >> text=New job");
  await page.check("input[value=captures]");
  const { patterns, white, black } = scene.captures();
  const file = (name, buffer) => ({ name, mimeType: "application/octet-stream", buffer });
  // The names of the first two files are swapped, so their order must be corrected by hand.
  const names = patterns.map((_, index) => `pattern-${[2, 1][index] ?? index + 1}.npy`);
  await page.setInputFiles("#captures", [...patterns.map((bytes, index) => file(names[index], bytes)), file("white.npy", white)]);
  await page.waitForSelector("text=Still missing: a black capture.");
  await page.setInputFiles("#captures", [file("black.npy", black)]);
  await page.waitForSelector(`text=${patterns.length} patterns. Check their order`);
  checks.that((await page.$$(".capture canvas")).length === patterns.length + 2, "each capture has a thumbnail");
  const shades = await page.$$eval(".capture canvas", (all) => all.slice(-2).map((canvas) => canvas.getContext("2d").getImageData(0, 0, 1, 1).data[0]));
  checks.that(Math.min(...shades) < 20 && Math.max(...shades) > 200, `white and black captures look white and black: ${shades}`);
  const order = () => page.$$eval(".capture .filename", (lines) => lines.slice(0, 2).map((line) => line.textContent));
  checks.that((await order()).join() === "pattern-1.npy,pattern-2.npy", `captures are sorted by name: ${await order()}`);
  await page.dragAndDrop(".capture:nth-child(1) .filename", ".capture:nth-child(2) .filename");
  checks.that((await order()).join() === "pattern-2.npy,pattern-1.npy", `captures can be dragged: ${await order()}`);
  await page.focus(".capture:nth-child(2) button");
  await page.keyboard.press("Enter");
  checks.that((await order()).join() === "pattern-1.npy,pattern-2.npy", `captures can be moved by keys: ${await order()}`);
  await page.focus(".capture:nth-child(2) button");
  await page.keyboard.press("Enter");
  await checks.look(page, "captures");
  await page.click("text=Compute the masks");
  await page.waitForSelector("text=The calibration is accepted.", { timeout: 60_000 });
  await drop(page, "label.drop:has(#data)", "measurement.npy", scene.measurement);
  await page.waitForSelector("text=The measurement fits the calibration.");
  await page.selectOption("#algorithm", "gap-tv");
  await page.fill("#label", "from captures");
  await page.click("summary:has-text('True frames')");
  await page.setInputFiles("#truth", file("truth.npy", scene.truth));
  await page.waitForSelector(".drop:has-text('truth.npy: ')");
  await page.click("button[type=submit]");
  await page.waitForURL(/#\/jobs\/[0-9a-f-]{36}$/);
  await state(page, "succeeded");
  await page.waitForSelector(".quality:has-text('PSNR measured')");
  await page.click("text=Remove the true frames");
  await page.click("dialog button.danger");
  await page.waitForSelector(".verdictcard label:has-text('Attach true frames')");
  checks.that((await page.$(".quality:has-text('PSNR measured')")) === null, "true frames can be removed from the job");
  const { pathname } = new URL(await page.$eval("a[href^='#/calibrations/']", (link) => `http://x/${link.getAttribute("href").slice(1)}`));
  return pathname;
}

/** Cancels, retries and deletes a long job. */
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
  await page.click(`${row} button.more`);
  await page.click(`${row} button.delete`);
  await page.waitForSelector("dialog[open]");
  checks.that((await page.textContent("dialog")).includes(label), "the confirmation names the job");
  await checks.look(page, "delete");
  await page.click("dialog >> text=Keep");
  checks.that((await page.$(row)) !== null, "declining keeps the job");
  await page.check("[aria-label='Select all jobs']");
  await checks.text(page, "#delete-all", (button) => !button.endsWith(" 1"), "all jobs are selected");
  await page.uncheck("[aria-label='Select all jobs']");
  await page.check(`${row} input[type=checkbox]`);
  await page.click("#delete-all");
  await page.click("dialog button.danger");
  await page.waitForSelector(row, { state: "detached", timeout: 15_000 });
  await page.selectOption("#state", "succeeded");
  await page.click("text=Save this filter");
  await page.selectOption("#state", "failed");
  await page.waitForSelector("text=No matching jobs.");
  await page.click(".chip a");
  await page.waitForSelector(`tr:has-text("${HOSTILE}")`);
  await page.click(".chip button");
  checks.that((await page.$(".chip")) === null, "a saved filter can be removed");
  await page.goto(page.url().replace(/\?.*/, ""));
  await page.waitForSelector(".list tr:has(.badge.succeeded)");
  checks.that((await page.$(row)) === null, "deleted jobs are not listed");
  const cut = await page.$$eval(".list td.shape, .list td.created, .list td.checks, .list th", (cells) => cells.filter((cell) => cell.scrollWidth > cell.clientWidth).map((cell) => cell.textContent));
  checks.that(cut.length === 0, `no cell is clipped: ${cut}`);
  const states = await page.$$eval(".list tr:has(.badge.succeeded) td.state", (cells) => cells.map((cell) => cell.textContent));
  checks.that(states.length > 0 && states.every((text) => /took/.test(text)), `an ended job shows its duration: ${states}`);
}
