// Data stored in the browser: saved filters, the true frames of jobs, and the selected lab.

/** Value stored under a name, or `otherwise`. */
export function recall(name, otherwise) {
  try {
    return JSON.parse(localStorage.getItem(`sci-recon ${name}`)) ?? otherwise;
  } catch {
    // Storage may be disabled; nothing depends on it.
    return otherwise;
  }
}

export function remember(name, value) {
  try {
    localStorage.setItem(`sci-recon ${name}`, JSON.stringify(value));
  } catch {
    // Storage may be disabled; nothing depends on it.
  }
}

/** The lab that this tab shows, or null for the token's lab. */
export function selectedLab() {
  try {
    return sessionStorage.getItem("sci-recon lab");
  } catch {
    return null;
  }
}

export function selectLab(lab) {
  try {
    if (lab) sessionStorage.setItem("sci-recon lab", lab);
    else sessionStorage.removeItem("sci-recon lab");
  } catch {
    // Storage may be disabled; nothing depends on it.
  }
}

/** Jobs for which true frames are remembered. */
const MAX_TRUTHS = 200;

/** The true frames of a job: `{sha256, name, snapshot}`, or null. */
export function truthOf(job) {
  return recall("truths", []).find((entry) => entry.job === job)?.truth ?? null;
}

export function keepTruth(job, truth) {
  const others = recall("truths", []).filter((entry) => entry.job !== job);
  remember("truths", [{ job, truth }, ...others].slice(0, MAX_TRUTHS));
}
