// Checks that hold for every view, among them accessibility, and the screenshots.

import { mkdirSync, readFileSync, rmSync } from "node:fs";
import { createRequire } from "node:module";
import { join } from "node:path";

const AXE = readFileSync(createRequire(import.meta.url).resolve("axe-core/axe.min.js"), "utf8");
const SIZES = [[1400, 900], [390, 844]];

export class Checks {
  constructor(folder) {
    rmSync(folder, { recursive: true, force: true });
    mkdirSync(folder, { recursive: true });
    Object.assign(this, { folder, count: 0, screenshots: 0, views: new Set(), errors: [], times: {} });
  }

  /** Counts a check, and throws if it fails. */
  that(condition, text) {
    this.count += 1;
    if (!condition) throw new Error(`check failed: ${text}`);
  }

  /** Repeats `read` until its value satisfies `holds`, for at most ten seconds, and checks it; returns the value. */
  async until(read, holds, text) {
    const start = performance.now();
    let value = await read();
    while (!holds(value) && performance.now() - start < 10_000) {
      await new Promise((resolve) => setTimeout(resolve, 50));
      value = await read();
    }
    this.that(holds(value), `${text}: ${JSON.stringify(value)}`);
    return value;
  }

  /** Waits until the text of an element satisfies `holds`, and returns it; the page draws after the service answers. */
  async text(page, selector, holds, text) {
    return this.until(() => page.textContent(selector), holds, text);
  }

  /** Measures the time of a step. */
  async step(name, run) {
    const start = performance.now();
    const value = await run();
    this.times[name] = Math.round(performance.now() - start);
    return value;
  }

  /** Opens a page that records script errors and dialogs. */
  async page(context) {
    const page = await context.newPage();
    page.on("pageerror", (error) => this.errors.push(`script: ${error.message}`));
    page.on("dialog", (dialog) => {
      this.errors.push(`dialog: ${dialog.message()}`);
      dialog.dismiss();
    });
    page.on("console", (message) => {
      // Some tests provoke answers with a status of 400 and above.
      if (message.type() === "error" && !message.text().startsWith("Failed to load resource")) this.errors.push(`console: ${message.text()}`);
    });
    return page;
  }

  /** Checks a view at both sizes, dark and light, with axe, and takes screenshots. */
  async look(page, name) {
    this.views.add(name);
    for (const [width, height] of SIZES) {
      await page.setViewportSize({ width, height });
      // The short run checks each view once, alternating between large and light, and small and dark.
      const schemes = process.env.SHORT ? [width > 1000 ? "light" : "dark"].filter(() => (width > 1000) === (this.views.size % 2 === 0)) : ["dark", "light"];
      for (const colorScheme of schemes) {
        await page.emulateMedia({ colorScheme });
        await page.waitForTimeout(250);
        await this.accessible(page, `${name} (${width}, ${colorScheme})`);
        await this.picture(page, `${name}-${width}-${colorScheme}`);
      }
      const odd = await page.evaluate(() => {
        const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
        const odd = [];
        while (walker.nextNode()) if (/^(null|undefined|NaN|false|\[object .*)$/.test(walker.currentNode.data.trim())) odd.push(walker.currentNode.data);
        return odd;
      });
      this.that(odd.length === 0, `${name} shows ${odd}`);
      const wider = await page.evaluate(() => Math.max(document.documentElement.scrollWidth - innerWidth, ...[...document.querySelectorAll("main, header")].map((part) => part.scrollWidth - part.clientWidth)));
      this.that(wider <= 0, `${name} is ${wider} pixels wider than a screen of ${width}`);
      const longer = await page.evaluate(() => document.documentElement.scrollHeight - innerHeight);
      this.that(longer <= 0, `only the content of ${name} scrolls, but the document is ${longer} pixels longer than the screen`);
    }
    await page.setViewportSize({ width: SIZES[0][0], height: SIZES[0][1] });
  }

  /** Takes a screenshot, and in the long run one of each screen below it. */
  async picture(page, name) {
    const scrolled = (by) => page.evaluate((by) => {
      const content = document.querySelector("#content");
      if (!content) return false;
      const before = content.scrollTop;
      content.scrollTop += by * content.clientHeight;
      return content.scrollTop > before;
    }, by);
    for (let screen = 1; screen === 1 || (!process.env.SHORT && screen < 8 && (await scrolled(1))); screen += 1) {
      await page.screenshot({ path: join(this.folder, `${name}${screen > 1 ? `-${screen}` : ""}.png`) });
      this.screenshots += 1;
    }
    await scrolled(-100);
  }

  async accessible(page, name) {
    // The page's policy forbids a script element, so axe is evaluated by the debugger.
    await page.evaluate(AXE);
    const { violations } = await page.evaluate(() => globalThis.axe.run());
    this.that(violations.length === 0, `${name}: ${JSON.stringify(violations.map((found) => [found.id, found.nodes.map((node) => node.html).slice(0, 3)]))}`);
  }
}
