// Measures the bytes and the first paint of a visit while the machine is busy, and the scrolling of a long
// list.

const MANY = process.env.SHORT ? 500 : 5000;

/** Loads the dashboard in a fresh browser context; returns the transferred bytes and the first paint. */
export async function visit(browser, checks, url) {
  const context = await browser.newContext({ viewport: { width: 1400, height: 900 } });
  const page = await checks.page(context);
  const wire = await context.newCDPSession(page);
  await wire.send("Network.enable");
  const files = new Set();
  let bytes = 0;
  wire.on("Network.responseReceived", ({ requestId, response }) => {
    const { pathname } = new URL(response.url);
    if (pathname === "/" || pathname.startsWith("/dashboard/")) files.add(requestId);
  });
  wire.on("Network.loadingFinished", ({ requestId, encodedDataLength }) => {
    if (files.has(requestId)) bytes += encodedDataLength;
  });
  await page.goto(url);
  await page.waitForSelector(".list td a");
  const paint = await page.evaluate(() => performance.getEntriesByName("first-contentful-paint")[0]?.startTime);
  // Open every view once, which loads all modules.
  for (const [view, part] of [["#/new", ".steps"], ["#/calibrations", ".calibration"], ["#/system", "section[aria-label=Queue]"]]) {
    await page.goto(`${url}/${view}`);
    await page.waitForSelector(part);
  }
  await page.goto(`${url}/#/jobs`);
  await page.click(".list td a");
  await page.waitForSelector(".viewer");
  await context.close();
  return { bytes, files: files.size, paint: Math.round(paint) };
}

/** Submits thousands of jobs through the API. */
export async function fill(service, measurement) {
  // Submit the oldest job alone, because the order of concurrent submissions is undefined.
  let made = 0;
  const submit = () => service.submit({ measurement, algorithm: "gap-tv", label: `shot ${(made += 1)}` });
  await submit();
  const work = async () => {
    while (made < MANY) {
      await submit();
    }
  };
  await Promise.all(Array.from({ length: 8 }, work));
  return MANY;
}

/** Scrolls through the whole list and measures the frame times. */
export async function scroll(page, checks, url) {
  await page.goto(`${url}/#/jobs`);
  await page.waitForSelector(".list td a");
  const found = await page.evaluate(async (many) => {
    const scroller = document.querySelector(".scroll");
    const times = [];
    let rows = 0;
    let before = performance.now();
    let still = 0;
    while (still < 120) {
      await new Promise(requestAnimationFrame);
      const now = performance.now();
      times.push(now - before);
      before = now;
      const top = scroller.scrollTop;
      scroller.scrollTop = top + 300;
      rows = Math.max(rows, document.querySelectorAll(".list tbody tr:not(.space)").length);
      still = scroller.scrollTop === top ? still + 1 : 0;
    }
    times.splice(-120);
    times.sort((a, b) => a - b);
    const last = [...document.querySelectorAll(".list .name a")].at(-1)?.textContent;
    const count = Number.parseInt(document.querySelector("#count").textContent, 10);
    return { frames: times.length, median: times[Math.floor(times.length / 2)], p95: times[Math.floor(times.length * 0.95)], worst: times.at(-1), rows, last, count, complete: count === many };
  }, MANY);
  checks.that(found.complete && found.last === "shot 1", `the list is complete: ${JSON.stringify(found)}`);
  checks.that(found.rows < 120, `only visible rows are in the page: ${found.rows}`);
  checks.that(found.p95 < 100, `scrolling is smooth: ${JSON.stringify(found)}`);
  // Exactly one label contains this number.
  await page.fill("#search", `shot ${MANY - 79}`);
  await page.waitForFunction(() => document.querySelector("#count").textContent === "1 job", null, { timeout: 10_000 });
  await page.selectOption("#state", "failed");
  await page.waitForSelector("text=No matching jobs.");
  const round = (value) => Math.round(value * 10) / 10;
  return { jobs: found.count, frames: found.frames, median_ms: round(found.median), p95_ms: round(found.p95), worst_ms: round(found.worst), rows_in_page: found.rows };
}
