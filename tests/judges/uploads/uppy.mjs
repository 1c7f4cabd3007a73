// Uploads a file with Uppy from a page of another origin, in a real browser. Prints the address of the upload.
//
// Usage: CHROMIUM=program node uppy.mjs PORT ENDPOINT TOKEN FILE. The page is at http://127.0.0.1:PORT/.

import { readFileSync } from "node:fs";
import { createServer } from "node:http";
import { build } from "esbuild";
import { chromium } from "playwright-core";

const [port, endpoint, token, file] = process.argv.slice(2);
const source = 'export { default as Uppy } from "@uppy/core"; export { default as Tus } from "@uppy/tus";';
const bundle = await build({
  stdin: { contents: source, resolveDir: import.meta.dirname },
  bundle: true,
  format: "iife",
  globalName: "parts",
  write: false,
});
const page = `<!doctype html><title>Another origin</title><script>${bundle.outputFiles[0].text}</script>`;
const server = createServer((_, response) => response.setHeader("Content-Type", "text/html").end(page));
await new Promise((resolve) => server.listen(Number(port), "127.0.0.1", resolve));

// The proxy has a certificate that no browser knows. Chromium runs as root without a sandbox only.
const browser = await chromium.launch({ executablePath: process.env.CHROMIUM, args: ["--no-sandbox"] });
try {
  const tab = await browser.newPage({ ignoreHTTPSErrors: true });
  await tab.goto(`http://127.0.0.1:${port}/`);
  const result = await tab.evaluate(
    async ([endpoint, token, values]) => {
      const { Uppy, Tus } = window.parts;
      const uppy = new Uppy().use(Tus, {
        endpoint,
        headers: { Authorization: `Bearer ${token}` },
        chunkSize: 16384,
        retryDelays: [1000],
      });
      uppy.addFile({ name: "masks.npy", data: new Blob([new Uint8Array(values)]) });
      const { successful, failed } = await uppy.upload();
      return { url: successful[0]?.uploadURL, error: failed[0]?.error };
    },
    [endpoint, token, [...readFileSync(file)]],
  );
  if (!result.url) throw new Error(result.error);
  console.log(result.url);
} finally {
  await browser.close();
  server.close();
}
