"""Runs every fuzz target for some seconds of CPU; none may find an error.

Usage: fuzz.py SECONDS [TARGET...]. Needs cargo-fuzz. The last line is JSON.
"""

import json
import math
import pathlib
import re
import resource
import subprocess
import sys


def main():
    seconds = int(sys.argv[1])
    known = sorted(path.stem for path in pathlib.Path("fuzz/fuzz_targets").glob("*.rs"))
    known.remove("file")
    # Stable Rust has no sanitizer, and safe Rust hardly needs one.
    subprocess.run(["cargo", "fuzz", "build", "-s", "none"], check=True)
    report = {target: fuzz(target, seconds) for target in sys.argv[2:] or known}
    good = all(row["clean"] for row in report.values())
    total = round(sum(row["cpu_seconds"] for row in report.values()))
    print(json.dumps({"target": "fuzz", "ok": good, "cpu_seconds": total, **report}))
    sys.exit(0 if good else 1)


def fuzz(target, seconds):
    """Runs a target until it has used its CPU seconds, however busy the machine is."""
    # The corpus in the repository is not changed: new inputs go to another folder.
    found = pathlib.Path("fuzz/target/corpus", target)
    found.mkdir(parents=True, exist_ok=True)
    command = ["cargo", "fuzz", "run", "-s", "none", target, str(found), f"fuzz/corpus/{target}", "--"]
    # The timeout is in wall-clock time, and the machine may be busy.
    command += ["-max_len=8192", "-rss_limit_mb=1024", "-timeout=60"]
    runs, used, clean = 0, 0.0, True
    while clean and used < seconds:
        before = cpu_seconds()
        again = [*command, f"-max_total_time={math.ceil(seconds - used)}"]
        ended = subprocess.run(again, capture_output=True, text=True, errors="replace")
        used += cpu_seconds() - before
        done = re.search(r"Done (\d+) runs in (\d+) second", ended.stderr)
        clean = ended.returncode == 0 and done is not None
        runs += int(done[1]) if done else 0
        if not clean:
            print(ended.stderr[-4000:], file=sys.stderr)
    return {"runs": runs, "cpu_seconds": round(used), "clean": clean}


def cpu_seconds():
    """CPU seconds of all ended children."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


main()
