"""Runs every fuzz target for some seconds; each must end without a finding.

Usage: fuzz.py SECONDS [TARGET...]. Needs cargo-fuzz. Prints one JSON line at its end.
"""

import json
import pathlib
import re
import subprocess
import sys


def main():
    seconds = int(sys.argv[1])
    known = sorted(path.stem for path in pathlib.Path("fuzz/fuzz_targets").glob("*.rs"))
    known.remove("file")
    report, good = {}, True
    # Stable Rust has no sanitizer, and safe Rust little need of one.
    subprocess.run(["cargo", "fuzz", "build", "-s", "none"], check=True)
    for target in sys.argv[2:] or known:
        command = ["cargo", "fuzz", "run", "-s", "none", target, "--"]
        # Files in the corpus are for reading: what is found goes to a folder of its own.
        found = pathlib.Path("fuzz/target/corpus", target)
        found.mkdir(parents=True, exist_ok=True)
        command[-1:-1] = [str(found), f"fuzz/corpus/{target}"]
        command += [f"-max_total_time={seconds}", "-max_len=8192", "-rss_limit_mb=1024", "-timeout=10"]
        ended = subprocess.run(command, capture_output=True, text=True, errors="replace")
        runs = re.search(r"Done (\d+) runs in (\d+) second", ended.stderr)
        clean = ended.returncode == 0 and runs is not None
        report[target] = {"runs": int(runs[1]) if runs else 0, "clean": clean}
        if not clean:
            print(ended.stderr[-4000:], file=sys.stderr)
        good = good and clean
    print(json.dumps({"target": "fuzz", "ok": good, "seconds_each": seconds, **report}))
    sys.exit(0 if good else 1)


main()
