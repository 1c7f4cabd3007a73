"""Fuzzes the API against its contract with schemathesis, three times: a service without tokens, one
with a token, and one where a lab's token is used against another lab's data.

Usage: schemathesis_runs.py SCHEMATHESIS PROGRAM [EXAMPLES]. Prints one JSON line; fails if an
answer is a server error, undocumented, or violates its schema, if another lab's data are found, or if
too few examples were tried.
"""

import atexit
import json
import os
import pathlib
import signal
import struct
import subprocess
import sys
import tempfile
import urllib.request

CHECKS = (
    "not_a_server_error,status_code_conformance,content_type_conformance,"
    "response_headers_conformance,response_schema_conformance,unsupported_method"
)
LEAST = 2000
MARK = "known-to-lab-a-alone"


class Service:
    """A service with one worker in a fresh folder."""

    def __init__(self, program):
        self.folder = tempfile.TemporaryDirectory()
        self.program = program
        self.process = subprocess.Popen(
            [program, "serve", "--listen", "127.0.0.1:0", "--workers", "1", "--data", self.folder.name],
            stdout=subprocess.PIPE,
            env=dict(os.environ, RUST_LOG="error"),
        )
        # A run that fails must not leave a service behind.
        atexit.register(self.process.kill)
        self.url = json.loads(self.process.stdout.readline())["url"]

    def token(self, lab):
        command = [self.program, "token", "--data", self.folder.name, "create", "--lab", lab]
        return subprocess.check_output([*command, "--role", "admin"], text=True).strip()

    def post(self, path, body, token, kind="application/json"):
        data = body if isinstance(body, bytes) else json.dumps(body).encode()
        headers = {"Content-Type": kind}
        if token:
            headers["Authorization"] = f"Bearer {token}"
        request = urllib.request.Request(self.url + path, data, headers)
        with urllib.request.urlopen(request) as answer:
            return json.load(answer)

    def scene(self, token):
        """Creates masks, a measurement and a job; returns their identifiers."""
        file = lambda data: self.post("/v1/blobs", data, token, "application/octet-stream")["sha256"]
        masks = file(npy((2, 32, 32), lambda at: float(at % 3 != 0)))
        data = file(npy((1, 32, 32), lambda at: 0.5 + at % 7 / 10))
        calibration = self.post("/v1/calibrations", {"masks": masks, "name": MARK}, token)["id"]
        body = {"calibration": calibration, "data": data, "name": MARK}
        measurement = self.post("/v1/measurements", body, token)["id"]
        body = {"measurement": measurement, "algorithm": "gap-tv", "label": MARK}
        job = self.post("/v1/jobs", body, token)["id"]
        return {"Sha256": masks, "Calibration": calibration, "Measurement": measurement, "Job": job}

    def stop(self):
        self.process.send_signal(signal.SIGTERM)
        self.process.wait()
        self.folder.cleanup()


def npy(shape, value):
    count = shape[0] * shape[1] * shape[2]
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}"
    header = header.ljust(117) + "\n"
    values = struct.pack(f"<{count}f", *(value(at) for at in range(count)))
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + values


def contract(folder, ids):
    """The contract with these identifiers as examples, so that requests use them."""
    text = pathlib.Path("openapi.yaml").read_text()
    for name, value in ids.items():
        head, rest = text.split(f"\n    {name}:\n      name:", 1)
        text = f"{head}\n    {name}:\n      example: {value}\n      name:{rest}"
    path = pathlib.Path(folder, "contract.yaml")
    path.write_text(text)
    return path


def run(schemathesis, service, examples, token, ids, seed):
    """Runs schemathesis once; returns the figures and the exchanges."""
    with tempfile.TemporaryDirectory() as folder:
        har = pathlib.Path(folder, "run.har")
        command = [schemathesis, "run", contract(folder, ids), "--url", service.url]
        # The stream of events does not end, so its answer cannot be checked.
        command += ["--exclude-path", "/v1/events", "--max-examples", str(examples)]
        checks = CHECKS + (",ignored_auth" if token else "")
        command += ["--checks", checks, "--seed", str(seed), "--continue-on-failure"]
        command += ["--report", "har", "--report-har-path", har, "--output-sanitize", "false"]
        command += ["--request-timeout", "30", "--suppress-health-check", "all", "--no-color"]
        if token:
            command += ["--header", f"Authorization: Bearer {token}"]
        hooks = {"PYTHONPATH": "tests/judges", "SCHEMATHESIS_HOOKS": "schemathesis_hooks"}
        environment = {**os.environ, **hooks}
        ended = subprocess.run(command, capture_output=True, text=True, env=environment)
        if ended.returncode:
            print(ended.stdout[-12000:], ended.stderr[-2000:], file=sys.stderr)
        entries = json.loads(har.read_text())["log"]["entries"]
    errors = sum(entry["response"]["status"] >= 500 for entry in entries)
    figures = {"examples": len(entries), "server_errors": errors, "rc": ended.returncode}
    return figures, entries


def found(entries, ids):
    """Exchanges that exposed the other lab's data."""
    shown = []
    for entry in entries:
        request, response = entry["request"], entry["response"]
        text = response["content"].get("text") or ""
        # The answer may repeat a label that the client has sent.
        sent = (request.get("postData") or {}).get("text") or ""
        theirs = MARK in text and MARK not in sent and MARK not in request["url"]
        named = any(value in request["url"] for value in ids.values())
        if theirs or (named and response["status"] < 400):
            shown.append(f"{request['method']} {request['url']} {response['status']}")
    return shown


def main():
    schemathesis, program = sys.argv[1:3]
    examples = int(sys.argv[3]) if len(sys.argv) > 3 else 60
    report = {}
    service = Service(program)
    ids = service.scene(None)
    report["open"], _ = run(schemathesis, service, examples, None, ids, 1)
    service.stop()

    service = Service(program)
    token = service.token("a")
    ids = service.scene(token)
    report["token"], _ = run(schemathesis, service, examples, token, ids, 2)
    service.stop()

    service = Service(program)
    a, b = service.token("a"), service.token("b")
    ids = service.scene(a)
    report["hostile"], entries = run(schemathesis, service, examples, b, ids, 3)
    shown = found(entries, ids)
    asked = sum(any(value in entry["request"]["url"] for value in ids.values()) for entry in entries)
    report["hostile"] |= {"asked_for_theirs": asked, "found": len(shown)}
    for line in shown:
        print(f"another lab's data: {line}", file=sys.stderr)
    service.stop()

    good = all(figures["rc"] == 0 and figures["server_errors"] == 0 for figures in report.values())
    good = good and all(figures["examples"] >= LEAST for figures in report.values())
    good = good and not shown and asked > 0
    print(json.dumps({"target": "schemathesis", "ok": good, **report}))
    sys.exit(0 if good else 1)


main()
