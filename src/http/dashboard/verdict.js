// The card "Is it good?": findings of the checks, grade of the calibration, expected PSNR, and the PSNR and
// SSIM against true frames if they are attached.

import { aboutDecibels, bytes, expectedRange, figure } from "./format.js";
import { facts, h, put, say } from "./dom.js";
import { findings } from "./report.js";
import { isAborted, get, upload } from "./api.js";
import { keepTruth, truthOf } from "./storage.js";

/** The card; `show(job, manifest, snapshot)` updates it. The manifest is null until the snapshot is written. */
export class Verdict {
  constructor(job, signal) {
    Object.assign(this, { job, signal, truth: truthOf(job.id) });
    this.title = h("p", { class: "judgement" });
    this.why = h("p", { class: "muted" });
    this.found = h("div", null, findings(job.warnings));
    this.expected = h("div", { "aria-live": "polite" });
    this.measured = h("div", { "aria-live": "polite" });
    this.calibration = h("p", { class: "muted" });
    const input = h("input", { type: "file", id: "truth", class: "unseen" });
    input.addEventListener("change", () => this.attach(input.files[0]));
    this.attaching = h("label", { for: "truth", class: "button small filebutton" }, "Attach true frames", input);
    this.status = h("span", { class: "muted", "aria-live": "polite" });
    this.element = h("section", { class: "card verdictcard", "aria-label": "Is it good?" }, h("h2", null, "Is it good?"),
      this.title, this.why, this.found, this.measured, this.expected, h("div", { class: "row" }, this.attaching, this.status), this.calibration);
    this.grade();
  }

  /** Shows the grade of the calibration, which limits the quality. */
  async grade() {
    const link = (text) => h("a", { href: `#/calibrations/${this.job.calibration}` }, text);
    try {
      const { grade } = await get(`/v1/calibrations/${this.job.calibration}/report`, this.signal);
      this.graded = grade;
      if (this.written && !this.truth) this.unmeasured();
      put(this.calibration, "The ", link("calibration"), " is ", h("span", { class: `grade ${grade}` }, grade), ".");
    } catch (error) {
      if (!isAborted(error)) put(this.calibration, "The ", link("calibration"), " has no grade yet.");
    }
  }

  async show(job, manifest, snapshot) {
    const written = manifest !== null;
    Object.assign(this, { written, snapshot, state: job.state });
    this.attaching.hidden = !written;
    if (!written) {
      const words = { failed: ["Failed", "bad"], cancelled: ["Cancelled", ""], cancelling: ["Being cancelled", ""] }[job.state] ?? ["Not known yet", ""];
      this.judge(...words, job.state in { failed: 1, cancelled: 1, cancelling: 1 } ? "The frames are incomplete: don’t rely on them." : "The frames are judged when they are written.");
      put(this.measured);
      put(this.expected);
      return;
    }
    this.showExpected(manifest.content?.assessment);
    if (this.truth) await this.compare();
    else this.unmeasured();
  }

  /** Shows the expected PSNR from the manifest, with its interval and reasons. */
  showExpected(assessment) {
    this.assessment = assessment;
    const { psnr_db: psnr, reasons } = this.assessment ?? {};
    const warned = new Set(this.job.warnings.map((warning) => warning.code));
    const own = reasons?.filter((reason) => !warned.has(reason.code)) ?? [];
    put(this.expected, this.assessment && [
      psnr === null
        ? h("p", { class: "muted" }, "No expected PSNR: the findings put the scale, the dark or the masks in doubt.")
        : [h("p", { class: "quality" }, "Expected PSNR: about ", h("b", null, aboutDecibels(psnr))),
          h("p", { class: "muted" }, `In four of five cases the true PSNR, relative to the white level of the frames, is ${expectedRange(this.assessment)}. Select “Expected error” above the frames to see where the error is largest.`)],
      findings(own)]);
  }

  judge(text, kind, why) {
    say(this.title, text);
    this.title.className = `judgement ${kind}`;
    say(this.why, why);
  }

  unmeasured() {
    const poor = this.graded === "usable" || this.graded === "bad";
    const errors = this.job.warnings.some((item) => item.severity === "error");
    const warned = this.job.warnings.length > 0;
    if (errors) this.judge("Bad", "bad", "The checks found errors that make the frames wrong:");
    else if (warned) this.judge("Doubtful", "usable", "The checks found problems that may degrade the frames:");
    else if (this.assessment) this.judge(...EXPECTED[this.assessment.grade]);
    else if (poor) this.judge("Doubtful", "usable", `The measurement fits its calibration, but the grade of the calibration is “${this.graded}”. Its report gives the reasons.`);
    else this.judge("No problems found", "", "Measurement and calibration fit each other. This does not measure the quality of the frames. Attach true frames, if you have them, to measure it.");
  }

  async attach(file) {
    if (!file) return;
    try {
      const { sha256 } = await upload(file, (done, total) => say(this.status, `${bytes(done)} of ${bytes(total)}`), this.signal);
      this.truth = { sha256, name: file.name };
      say(this.status, "");
      if (await this.compare()) keepTruth(this.job.id, this.truth);
    } catch (error) {
      if (!isAborted(error)) put(this.status, h("span", { class: "warn" }, error.message));
    }
  }

  /** Shows PSNR and SSIM against the true frames; false if they could not be computed. */
  async compare() {
    const { sha256, name } = this.truth;
    say(this.status, "Comparing with the true frames …");
    let found;
    try {
      found = await get(`/v1/jobs/${this.job.id}/snapshots/${this.snapshot}/quality?truth=${sha256}`, this.signal);
    } catch (error) {
      if (isAborted(error)) throw error;
      put(this.status, h("span", { class: "warn" }, error.message));
      this.truth = null;
      this.unmeasured();
      return false;
    }
    say(this.status, "");
    const [text, kind, meaning] = LEVELS.find(([, , , least]) => (found.psnr ?? Infinity) >= least);
    this.judge(found.psnr === null ? "Identical to the true frames" : text, kind, meaning);
    put(this.measured, h("p", { class: "quality" }, h("b", null, found.psnr === null ? "∞" : `${figure(found.psnr, 3)} dB`), " PSNR", found.ssim !== null && [", ", h("b", null, figure(found.ssim, 3)), " SSIM"]),
      h("p", { class: "muted" }, `Measured against ${name}; mean of ${found.frames.length} frames, relative to the white level ${figure(found.peak)}.`),
      h("details", null, h("summary", null, "Frame by frame"), facts(found.frames.map((frame) => [`Frame ${frame.frame}`, `${frame.psnr === null ? "∞" : `${figure(frame.psnr, 3)} dB`}${frame.ssim === null ? "" : `, SSIM ${figure(frame.ssim, 3)}`}`]))));
    return true;
  }
}

/** Verdicts on an expected PSNR without findings, by grade. */
const EXPECTED = {
  good: ["Likely good", "good", "Measurement and calibration fit each other. Frames like these are close to the scene."],
  usable: ["Likely usable", "usable", "Measurement and calibration fit each other. Frames like these lack texture."],
  bad: ["Likely poor", "bad", "Measurement and calibration fit each other, but frames like these show only coarse shapes correctly."],
};

/** Verdicts on a measured PSNR, with their lower limits in dB in descending order. */
const LEVELS = [
  ["Excellent", "good", "35 dB or more: errors are hard to see.", 35],
  ["Good", "good", "28 to 35 dB: expect softened detail.", 28],
  ["Usable", "usable", "22 to 28 dB: expect lost texture.", 22],
  ["Poor", "bad", "Less than 22 dB: expect only coarse shapes.", -Infinity],
];
