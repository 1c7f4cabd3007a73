// The service under test: the real program on a free port with a fresh folder.

import { execFileSync, spawn } from "node:child_process";
import { mkdtempSync, readFileSync, readdirSync, rmSync, statSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { createInterface } from "node:readline";

export class Service {
  /** Starts the service with these arguments; resolves when it listens. */
  static async start(program, ...options) {
    const service = new Service();
    service.program = program;
    service.folder = mkdtempSync(join(tmpdir(), "sci-recon-e2e-"));
    service.process = spawn(program, ["serve", "--listen", "127.0.0.1:0", "--min-free-bytes", "1000000", "--data", service.folder, ...options], {
      env: { ...process.env, RUST_LOG: process.env.RUST_LOG ?? "error" },
      stdio: ["ignore", "pipe", "inherit"],
    });
    const line = await new Promise((resolve, reject) => {
      createInterface({ input: service.process.stdout }).once("line", resolve);
      service.process.once("exit", (code) => reject(new Error(`the service ended with ${code}`)));
    });
    service.url = JSON.parse(line).url;
    return service;
  }

  async call(method, path, body) {
    const json = body !== undefined && !Buffer.isBuffer(body);
    const response = await fetch(this.url + path, {
      method,
      headers: json ? { "Content-Type": "application/json" } : {},
      body: json ? JSON.stringify(body) : body,
    });
    const text = await response.text();
    if (!response.ok) throw new Error(`${method} ${path}: ${response.status} ${text}`);
    return text ? JSON.parse(text) : null;
  }

  /** Uploads a scene; returns the identifiers of its calibration and measurement. */
  async take(scene) {
    const masks = await this.call("POST", "/v1/blobs", scene.masks);
    const data = await this.call("POST", "/v1/blobs", scene.measurement);
    const calibration = await this.call("POST", "/v1/calibrations", { masks: masks.sha256, name: "bench 3" });
    const measurement = await this.call("POST", "/v1/measurements", { calibration: calibration.id, data: data.sha256 });
    return { calibration: calibration.id, measurement: measurement.id };
  }

  /** Creates a token with this role and returns it. */
  token(role, ...more) {
    const made = execFileSync(this.program, ["token", "--data", this.folder, "create", "--role", role, ...(more.length ? more : ["--lab", "optics"])], { encoding: "utf8" });
    return /sci_[\x21-\x7e]*[\w]/.exec(made)[0];
  }

  /** Flips a bit in every stored file. */
  damage() {
    for (const name of readdirSync(join(this.folder, "blobs"), { recursive: true })) {
      const path = join(this.folder, "blobs", name);
      if (!statSync(path).isFile()) continue;
      const bytes = readFileSync(path);
      bytes[bytes.length >> 1] ^= 0x10;
      writeFileSync(path, bytes);
    }
  }

  submit(body) {
    return this.call("POST", "/v1/jobs", body);
  }

  /** Waits until a job satisfies a condition. */
  async when(id, reached, seconds = 120) {
    for (const start = Date.now(); ;) {
      const job = await this.call("GET", `/v1/jobs/${id}`);
      if (reached(job)) return job;
      if (Date.now() - start > seconds * 1000) throw new Error(`waited too long for job ${id}: ${JSON.stringify(job)}`);
      await new Promise((resolve) => setTimeout(resolve, 100));
    }
  }

  async stop() {
    if (this.process.exitCode !== null) return;
    const ended = new Promise((resolve) => this.process.once("exit", resolve));
    this.process.kill("SIGTERM");
    await ended;
    rmSync(this.folder, { recursive: true, force: true });
  }
}
