"""Runs a command, and ends with one JSON line: the figures that it printed, and whether it succeeded.

Usage: figures.py NAME COMMAND... Figures are lines of JSON objects with a field `target`.
"""

import json
import subprocess
import sys


def main():
    name, command = sys.argv[1], sys.argv[2:]
    parts = []
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, errors="replace")
    for line in process.stdout:
        print(line, end="", flush=True)
        # The line may start with output of the test runner.
        at = line.find('{"')
        try:
            figures = json.loads(line[at:]) if at >= 0 else {}
        except ValueError:
            continue
        if isinstance(figures, dict) and "target" in figures:
            parts.append(figures)
    ended = process.wait()
    good = ended == 0 and bool(parts) and all(part.get("ok") for part in parts)
    print(json.dumps({"target": name, "ok": good, "rc": ended, "parts": parts}))
    sys.exit(0 if good else 1)


main()
