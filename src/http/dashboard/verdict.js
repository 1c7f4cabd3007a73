// The card "Is it good?": findings of the checks, grade of the calibration, and the expected PSNR, or PSNR and SSIM
// against true frames if they are attached.

import { ask } from "./actions.js";
import { aboutDecibels, axisOf, bytes, decibels, expectedRange, figure, findingsOf, inUnits, measuredVerdict, verdictOf } from "./format.js";
import { explained, h, put, say } from "./dom.js";
import { findings } from "./report.js";
import { isAborted, get, send, upload } from "./api.js";
import { csvLink, plot } from "./plot.js";

/** The card; `show(job, manifest, snapshot)` updates it. The manifest is null until the snapshot is written. */
export class Verdict {
  constructor(job, signal) {
    Object.assign(this, { job, signal, truth: job.truth, changed: () => {} });
    this.title = h("p", { class: "judgement" });
    this.why = h("p", { class: "muted" });
    this.found = h("div", null, findings(job.warnings));
    this.expected = h("div", { "aria-live": "polite" });
    this.measured = h("div", { "aria-live": "polite" });
    this.calibration = h("p", { class: "muted" });
    const input = h("input", { type: "file", id: "truth", class: "unseen" });
    input.addEventListener("change", () => this.attach(input.files[0]));
    this.attaching = h("label", { for: "truth", class: "button small filebutton writes" }, "Attach true frames", input);
    this.removing = h("button", { type: "button", class: "small writes", hidden: true, onclick: () => this.remove() }, "Remove the true frames");
    this.status = h("span", { class: "muted", "aria-live": "polite" });
    this.element = h("section", { class: "card verdictcard", "aria-label": "Is it good?" }, h("h2", null, "Is it good?"),
      this.title, this.why, this.found, this.measured, this.expected, h("div", { class: "row" }, this.attaching, this.removing, this.status), this.calibration);
    this.grade();
  }

  /** Shows what the check of the calibration alone has found, which says nothing about its fit to the measurement. */
  async grade() {
    const link = (text) => h("a", { href: `#/calibrations/${this.job.calibration}` }, text);
    try {
      const { grade } = await get(`/v1/calibrations/${this.job.calibration}/report`, this.signal);
      put(this.calibration, grade === "good" ? "No fault found in the " : "Faults found in the ", link("calibration"), " alone", grade !== "good" && [": ", h("span", { class: `grade ${grade}` }, grade)], ".");
    } catch (error) {
      if (!isAborted(error)) put(this.calibration, "The ", link("calibration"), " is not checked yet.");
    }
  }

  async show(job, manifest, snapshot) {
    const written = manifest !== null;
    Object.assign(this, { job, snapshot, truth: job.truth });
    this.attaching.hidden = !written || this.truth !== null;
    this.removing.hidden = !written || this.truth === null;
    if (!written) {
      const words = { failed: ["Failed", "bad"], cancelled: ["Cancelled", ""], cancelling: ["Being cancelled", ""] }[job.state] ?? ["Not known yet", ""];
      const { previews_done: previews, tiles_done: tiles } = job.progress;
      const isEmpty = previews + tiles === 0;
      // Findings on the inputs do not explain why a job has no frames.
      this.found.hidden = this.calibration.hidden = job.state === "failed" && isEmpty;
      const ended = !isEmpty ? "The frames are incomplete: don’t rely on them." : "There are no frames.";
      this.judge(...words, job.state in { failed: 1, cancelled: 1, cancelling: 1 } ? ended : "The frames are judged when they are written.");
      put(this.measured);
      put(this.expected);
      return;
    }
    this.found.hidden = this.calibration.hidden = false;
    const { content } = manifest;
    this.assessment = content?.assessment ?? null;
    put(this.found, findings(findingsOf(job, this.assessment)));
    // Manifests of earlier versions have no verdict.
    this.verdict = content?.verdict === undefined ? job.verdict : content.verdict;
    this.fullScale = manifest.content?.scale.measurement_full_scale ?? 1;
    if (this.truth) await this.compare(this.truth);
    else this.unmeasured();
  }

  /** Shows the expected PSNR from the manifest, with its interval and reasons. */
  showExpected() {
    const { psnr_db: psnr } = this.assessment ?? {};
    const { order_reason: order } = this.assessment ?? {};
    put(this.expected, this.assessment && (psnr === null
      ? h("p", { class: "muted" }, "No expected PSNR and no map of the expected error: the findings put the scale, the dark or the masks in doubt.")
      : [h("p", { class: "quality" }, "Expected PSNR: about ", h("b", null, aboutDecibels(psnr))),
          h("p", { class: "muted" }, `In four of five cases the true PSNR is ${expectedRange(this.assessment)}, relative to the white level of the frames. Their absolute brightness is not judged. Select “Expected error” above the frames to see where the error is largest.`)]),
    order && h("p", { class: "muted" }, `Order of masks not verifiable: ${order}.`));
  }

  judge(text, kind, why) {
    say(this.title, text);
    this.title.className = `judgement ${kind}`;
    say(this.why, why);
  }

  unmeasured() {
    const [kind, , title, why] = verdictOf(this.job, this);
    this.judge(title, kind, why);
    put(this.measured);
    this.showExpected();
  }

  /** Uploads true frames, compares them, and attaches them to the job for all its readers. */
  async attach(file) {
    if (!file) return;
    try {
      const { sha256 } = await upload(file, (done, total) => say(this.status, `${bytes(done)} of ${bytes(total)}`), this.signal);
      if (await this.compare(sha256)) await this.change(sha256);
    } catch (error) {
      if (!isAborted(error)) put(this.status, h("span", { class: "warn" }, explained(error)));
    }
  }

  async remove() {
    if (!(await ask("Remove the true frames?", "Nobody will see the measured PSNR of this job. The uploaded file is kept.", "Remove"))) return;
    try {
      await this.change(null);
      this.unmeasured();
    } catch (error) {
      put(this.status, h("span", { class: "warn" }, explained(error)));
    }
  }

  async change(truth) {
    this.job = await send("PATCH", `/v1/jobs/${this.job.id}`, { truth });
    this.truth = truth;
    this.attaching.hidden = truth !== null;
    this.removing.hidden = truth === null;
    this.changed(truth);
  }

  /** Shows PSNR and SSIM against true frames; false if they could not be computed. */
  async compare(truth) {
    say(this.status, "Comparing with the true frames …");
    let found;
    try {
      found = await get(`/v1/jobs/${this.job.id}/snapshots/${this.snapshot}/quality?truth=${truth}`, this.signal);
    } catch (error) {
      if (isAborted(error)) throw error;
      put(this.status, h("span", { class: "warn" }, explained(error)));
      this.unmeasured();
      return false;
    }
    say(this.status, "");
    const [kind, , title, why] = measuredVerdict(found.psnr);
    this.judge(title, kind, why);
    put(this.expected);
    const { spectral, name: xName, xs } = axisOf(this.job);
    const curve = found.frames.map((frame) => frame.psnr ?? Infinity);
    const rows = found.frames.map((frame) => [frame.frame, frame.psnr ?? "inf", frame.ssim ?? ""]);
    put(this.measured, h("p", { class: "quality" }, h("b", null, decibels(found.psnr)), " PSNR measured", found.ssim !== null && [", ", h("span", { class: "together" }, h("b", null, figure(found.ssim, 3)), " SSIM")]),
      h("p", { class: "muted" }, `Against the true frames of this job; mean of ${found.frames.length} ${spectral ? "bands" : "frames"}, relative to the white level, ${inUnits(found.peak, this.fullScale)}.`),
      h("details", { open: true }, h("summary", null, `PSNR in dB, ${spectral ? "band by band" : "frame by frame"}`),
        curve.length > 1 && curve.every(Number.isFinite) && plot(curve, { xName, xs, yName: "PSNR in dB", width: 270 }),
        h("div", { class: "row" }, csvLink(`${this.job.id.slice(-8)}_${this.snapshot}_quality.csv`, [spectral ? "band" : "frame", "psnr_db", "ssim"], rows))));
    return true;
  }
}
