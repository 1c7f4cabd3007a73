// Data stored in the browser: saved filters and the selected lab.

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
