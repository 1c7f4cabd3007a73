// PSNR and SSIM of jobs against their true frames, for lists.

import { get } from "./api.js";

/** Answers by job and truth: a result never changes. */
const known = new Map();
let last = Promise.resolve();

/**
 * Quality of the first snapshot of a succeeded job with true frames. The service compares the frames of one job at a time.
 * The request is made if the result is still `wanted()`.
 */
export function qualityOf(job, wanted) {
  const path = `/v1/jobs/${job.id}/snapshots/${job.snapshots.first}/quality?truth=${job.truth}`;
  const key = `${path} ${job.finished_at}`;
  if (!known.has(key)) {
    const asked = last.then(() => (wanted() ? get(path) : Promise.reject(new Error("not wanted"))));
    asked.catch(() => known.delete(key));
    known.set(key, asked);
    last = asked.catch(() => {});
  }
  return known.get(key);
}
