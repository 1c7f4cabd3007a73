// What this browser remembers: filters of the list, and which true frames belong to a job.

/** What was kept under a name, or else `otherwise`. */
export function recall(name, otherwise) {
  try {
    return JSON.parse(localStorage.getItem(`sci-recon ${name}`)) ?? otherwise;
  } catch {
    // Storage may be shut off; nothing depends on it.
    return otherwise;
  }
}

export function remember(name, value) {
  try {
    localStorage.setItem(`sci-recon ${name}`, JSON.stringify(value));
  } catch {
    // As above.
  }
}

/** The lab whose data are shown in this tab, if it is not one's own. */
export function lookedAfter() {
  try {
    return sessionStorage.getItem("sci-recon lab");
  } catch {
    return null;
  }
}

export function lookAfter(lab) {
  try {
    if (lab) sessionStorage.setItem("sci-recon lab", lab);
    else sessionStorage.removeItem("sci-recon lab");
  } catch {
    // As above.
  }
}

const HELD = 200;

/** The true frames of a job: `{sha256, name, snapshot}`, or null. */
export function truthOf(job) {
  return recall("truths", []).find((entry) => entry.job === job)?.truth ?? null;
}

export function keepTruth(job, truth) {
  const others = recall("truths", []).filter((entry) => entry.job !== job);
  remember("truths", [{ job, truth }, ...others].slice(0, HELD));
}
