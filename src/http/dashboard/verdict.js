// Is it good? What is known of a result, at the top of its page: what the checks found, what the
// calibration is worth, and how near the frames come to the truth where that is known.

import { bytes, figure } from "./format.js";
import { facts, h, put, say } from "./dom.js";
import { findings } from "./report.js";
import { gaveUp, get, upload } from "./api.js";
import { keepTruth, truthOf } from "./keeping.js";

/** The card; `show(job, manifest, snapshot)` says what is known now; a snapshot that is not written has no manifest. */
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

  /** The grade of the calibration, which bounds what can be had. */
  async grade() {
    const link = (text) => h("a", { href: `#/calibrations/${this.job.calibration}` }, text);
    try {
      const { grade } = await get(`/v1/calibrations/${this.job.calibration}/report.json`, this.signal);
      this.graded = grade;
      if (this.written && !this.truth) this.unmeasured();
      put(this.calibration, "Its ", link("calibration"), " is ", h("span", { class: `grade ${grade}` }, grade), ".");
    } catch (error) {
      if (!gaveUp(error)) put(this.calibration, "Its ", link("calibration"), " has no grade yet.");
    }
  }

  async show(job, manifest, snapshot) {
    const written = manifest !== null;
    Object.assign(this, { written, snapshot, state: job.state });
    this.attaching.hidden = !written;
    if (!written) {
      const words = { failed: ["It failed", "bad"], cancelled: ["It was cancelled", ""], cancelling: ["It is being cancelled", ""] }[job.state] ?? ["Not known yet", ""];
      this.judge(...words, job.state in { failed: 1, cancelled: 1, cancelling: 1 } ? "The frames are not complete: don’t rely on them." : "The frames are judged when they are written.");
      put(this.measured);
      put(this.expected);
      return;
    }
    this.tell(manifest.content?.assessment);
    if (this.truth) await this.compare();
    else this.unmeasured();
  }

  /** What is expected of the snapshot without a truth, as its manifest has it. */
  tell(assessment) {
    this.told = assessment;
    const { psnr_db: psnr, psnr_low_db: low, psnr_high_db: high, reasons } = this.told ?? {};
    const warned = new Set(this.job.warnings.map((warning) => warning.code));
    const own = reasons?.filter((reason) => !warned.has(reason.code)) ?? [];
    put(this.expected, this.told && [
      h("p", { class: "quality" }, "about ", h("b", null, about(psnr)), " PSNR expected"),
      h("p", { class: "muted" }, `Four times of five the true one lies between ${low.toFixed(0)} and ${about(high)}. Without a truth no more is known; “Expected error” above the frames shows where it is worst.`),
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
    if (errors) this.judge("Not to be trusted", "bad", "The checks found what makes the frames wrong:");
    else if (warned) this.judge("With reservations", "usable", "The checks found what may spoil the frames:");
    else if (this.told) this.judge(...EXPECTED[this.told.grade]);
    else if (poor) this.judge("With reservations", "usable", `The measurement fits its calibration, which is only ${this.graded}: its report says why.`);
    else this.judge("No faults found", "", "Measurement and calibration fit each other. That is no measure of quality: it is not known how near the frames are to the truth. True frames, where there are some, tell it.");
  }

  async attach(file) {
    if (!file) return;
    try {
      const { sha256 } = await upload(file, (done, total) => say(this.status, `${bytes(done)} of ${bytes(total)}`), this.signal);
      this.truth = { sha256, name: file.name };
      say(this.status, "");
      if (await this.compare()) keepTruth(this.job.id, this.truth);
    } catch (error) {
      if (!gaveUp(error)) put(this.status, h("span", { class: "warn" }, error.message));
    }
  }

  /** PSNR and SSIM against the truth; false if that could not be had. */
  async compare() {
    const { sha256, name } = this.truth;
    say(this.status, "The frames are compared with the truth …");
    let found;
    try {
      found = await get(`/v1/jobs/${this.job.id}/snapshots/${this.snapshot}/quality?truth=${sha256}`, this.signal);
    } catch (error) {
      if (gaveUp(error)) throw error;
      put(this.status, h("span", { class: "warn" }, error.message));
      this.truth = null;
      this.unmeasured();
      return false;
    }
    say(this.status, "");
    const [text, kind, meaning] = LEVELS.find(([, , , least]) => (found.psnr ?? Infinity) >= least);
    this.judge(found.psnr === null ? "The same as the truth" : text, kind, meaning);
    put(this.measured, h("p", { class: "quality" }, h("b", null, found.psnr === null ? "∞" : `${figure(found.psnr, 3)} dB`), " PSNR", found.ssim !== null && [", ", h("b", null, figure(found.ssim, 3)), " SSIM"]),
      h("p", { class: "muted" }, `Measured against ${name}, mean of ${found.frames.length} frames.`),
      h("details", null, h("summary", null, "Frame by frame"), facts(found.frames.map((frame) => [`Frame ${frame.frame}`, `${frame.psnr === null ? "∞" : `${figure(frame.psnr, 3)} dB`}${frame.ssim === null ? "" : `, SSIM ${figure(frame.ssim, 3)}`}`]))));
    return true;
  }
}

/** Better than 40 dB is not told apart. */
const about = (psnr) => (psnr >= 40 ? "40 dB or more" : `${psnr.toFixed(0)} dB`);

/** What an expected PSNR means where the checks found nothing. */
const EXPECTED = {
  good: ["Likely good", "good", "Measurement and calibration fit each other, and frames like these are near the truth."],
  usable: ["Likely usable", "usable", "Measurement and calibration fit each other; frames like these have lost texture."],
  bad: ["Likely poor", "bad", "Measurement and calibration fit each other, but in frames like these only coarse shapes are true."],
};

/** What a measured PSNR means for who looks at the frames, from the best down. */
const LEVELS = [
  ["Very near the truth", "good", "35 dB and more: errors are hard to see.", 35],
  ["Near the truth", "good", "28 to 35 dB: expect softened detail.", 28],
  ["Usable", "usable", "22 to 28 dB: expect lost texture.", 22],
  ["Far from the truth", "bad", "Less than 22 dB: expect coarse shapes alone.", -Infinity],
];
