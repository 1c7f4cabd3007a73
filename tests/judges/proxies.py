"""Uses the service behind the samples for nginx and Caddy, at the root of a site and below /sci/.

tuspy, tus-js-client and Uppy (from a page of another origin) upload. A job runs, and its result, the dashboard, the cookie
of its session and all references in headers hold below the prefix. The clients that `make clients` has generated do a round
trip below the prefix.
"""

import contextlib
import hashlib
import io
import json
import os
import pathlib
import re
import shutil
import socket
import subprocess
import tempfile
import time
from urllib.parse import urljoin

import numpy as np
import requests
from tusclient.client import TusClient
from tusclient.exceptions import TusCommunicationError

HERE = pathlib.Path(__file__).parent
# One for each proxy and prefix: a file that is stored already would not be sent.
SCENES = iter(range(100))


def run(*command, **options):
    done = subprocess.run(command, capture_output=True, text=True, **options)
    return done.returncode, done.stdout + done.stderr


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]


@contextlib.contextmanager
def served(program, folder, before=(), workers=0, more=()):
    """Starts a service without tokens for the name bench.example; `before` precedes its command. Yields its address."""
    line = [*before, program, "serve", "--data", f"{folder}/data", "--listen", "127.0.0.1:0", "--workers", str(workers),
            "--host", "bench.example", *more]
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        try:
            yield json.loads(server.stdout.readline())["url"]
        finally:
            server.terminate()


def replaced(site, wrong, name, pairs):
    for original, replacement in pairs:
        if original not in site:
            wrong.append(f"{name} does not contain {original}")
        site = site.replace(original, replacement)
    return site


def behind_nginx(root, wrong, folder, service):
    """The command of nginx, and the addresses of the service behind it."""
    server = shutil.which("nginx", path=os.environ.get("PATH", "") + ":/usr/sbin")
    port, name = free_port(), "deploy/nginx/sci-recon.conf"
    site = replaced((root / name).read_text(), wrong, name, [
        ("/etc/ssl/bench.example.pem", f"{folder}/cert.pem"), ("/etc/ssl/private/bench.example.key", f"{folder}/key.pem"),
        ("listen 443 ", f"listen 127.0.0.1:{port} "), ("127.0.0.1:8080;", service + ";")])
    file = pathlib.Path(folder, "nginx.conf")
    file.write_text(f"daemon off; pid {folder}/pid; error_log {folder}/log; events {{}} http {{ access_log off; {site} }}")
    status, output = run(server, "-t", "-q", "-c", str(file))
    if status:
        wrong.append(f"nginx -t: {output}")
    return [server, "-c", str(file)], [f"https://127.0.0.1:{port}/", f"https://127.0.0.1:{port}/sci/"]


def behind_caddy(root, wrong, folder, service):
    """The command of Caddy, and the addresses of the service behind it."""
    name, ports = "deploy/caddy/Caddyfile", [free_port(), free_port()]
    # Caddy orders certificates for names on the public Internet.
    names = [(f"\n{site}.example {{", f"\nhttps://127.0.0.1:{port}, https://bench.example:{port} {{\n\ttls {folder}/cert.pem "
              f"{folder}/key.pem") for site, port in zip(("bench", "site"), ports)]
    site = replaced((root / name).read_text(), wrong, name, [*names, ("127.0.0.1:8080", service)])
    file = pathlib.Path(folder, "Caddyfile")
    file.write_text("{\n\tadmin off\n\tauto_https off\n}\n" + site)
    command = ["caddy", "run", "--adapter", "caddyfile", "--config", str(file)]
    return command, [f"https://127.0.0.1:{ports[0]}/", f"https://127.0.0.1:{ports[1]}/sci/"]


PROXIES = {"nginx": behind_nginx, "caddy": behind_caddy}
CLIENTS = {
    "python": ["{clients}/python/bin/python", "{clients}/generated/round_trip.py"],
    "typescript": ["node", "{clients}/generated/round_trip.mjs"],
}


def proxies(root, wrong, program, tools):
    """Names of programs that are not installed."""
    path = os.environ.get("PATH", "") + ":/usr/sbin"
    absent = [name for name in ("openssl", "node", "npm", *PROXIES) if not shutil.which(name, path=path)]
    if absent:
        return ", ".join(absent)
    install(tools)
    browser = shutil.which(os.environ.get("CHROMIUM", "chromium"))
    for name, behind in PROXIES.items():
        try:
            one_proxy(root, wrong, program, tools, (name, behind), browser)
        except (AssertionError, OSError, subprocess.SubprocessError, TusCommunicationError) as error:
            wrong.append(f"behind {name}: {type(error).__name__}: {error}")
    return None if browser else "chromium"


def install(tools):
    """Installs the JavaScript clients in a folder that the next run uses again."""
    tools.mkdir(parents=True, exist_ok=True)
    for file in (HERE / "uploads").iterdir():
        shutil.copy2(file, tools)
    subprocess.run(["npm", "install", "--silent", "--no-audit", "--no-fund"], cwd=tools, check=True)


def one_proxy(root, wrong, program, tools, proxy, browser):
    name, behind = proxy
    page = free_port()
    more = ["--cors-origin", f"http://127.0.0.1:{page}", "--trusted-proxies", "127.0.0.1"]
    with tempfile.TemporaryDirectory() as folder, served(program, folder, workers=1, more=more) as url:
        run("openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", f"{folder}/key.pem", "-out",
            f"{folder}/cert.pem", "-days", "1", "-subj", "/CN=bench.example", "-addext",
            "subjectAltName=DNS:bench.example,IP:127.0.0.1")
        command, addresses = behind(root, wrong, folder, url.removeprefix("http://"))
        log = open(f"{folder}/proxy.log", "w")
        server = subprocess.Popen(command, stderr=log, env={**os.environ, "HOME": folder, "XDG_DATA_HOME": folder})
        try:
            os.environ["REQUESTS_CA_BUNDLE"] = os.environ["NODE_EXTRA_CA_CERTS"] = f"{folder}/cert.pem"
            for address in addresses:
                origins(wrong, name, address)
            line = [program, "token", "--data", f"{folder}/data", "create", "--lab", "a", "--role", "admin"]
            token = subprocess.check_output(line, text=True).strip()
            for address in addresses:
                walk(address, token, (folder, tools))
            for client in CLIENTS:
                round_trip(client, tools, addresses[-1], token, folder)
            if browser:
                environment = {**os.environ, "CHROMIUM": browser}
                upload(["node", tools / "uppy.mjs", str(page)], addresses[-1], token, scene(folder)[0], environment)
        finally:
            server.terminate()
            server.wait()
            log.close()


def origins(wrong, name, address):
    """A page of the service may change data, one of another site may not."""
    port = address.split(":")[2].split("/")[0]
    host = f"bench.example:{port}"
    own, other = (refusal(f"{address}v1/jobs", host, origin) for origin in (f"https://{host}", "https://other.example"))
    if own == "foreign_site" or other != "foreign_site":
        wrong.append(f"behind {name} at {address} a page of the service gets {own}, one of another site {other}")


def refusal(url, host, origin):
    """Code of the problem with which the service refuses a change from a page of `origin`."""
    headers = {"Host": host, "Origin": origin}
    start = time.monotonic()
    while True:
        try:
            answer = requests.post(url, json={}, headers=headers, timeout=20)
            if answer.status_code not in (502, 504):
                return answer.json()["code"]
        except requests.ConnectionError:
            pass
        # The proxy is still starting.
        if time.monotonic() - start > 30:
            raise AssertionError(f"no answer from {url}")
        time.sleep(0.1)


def scene(folder):
    """Writes masks and a measurement of a new scene. Returns their paths."""
    rng = np.random.default_rng(next(SCENES))
    masks = rng.integers(0, 2, (4, 48, 64)).astype("f4")
    frames = rng.random((4, 1, 1)) * np.linspace(0.2, 1, 64)
    files = []
    for name, array in (("masks", masks), ("measurement", (masks * frames).sum(0, keepdims=True).astype("f4"))):
        files.append(pathlib.Path(folder, f"{name}.npy"))
        np.save(files[-1], array)
    return files


def upload(command, address, token, file, environment=None):
    """Uploads with a JavaScript client. The address of the upload lies below that of the service."""
    line = [*command, f"{address}v1/uploads", token, file]
    done = subprocess.run(line, capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 0, f"{command[1].name} at {address}: {done.stdout} {done.stderr}"
    assert done.stdout.startswith(f"{address}v1/uploads/"), f"{command[1].name} at {address}: {done.stdout}"
    stored(address, token, file)


def round_trip(client, tools, address, token, folder):
    """Reconstructs a new scene with a generated client."""
    clients = tools.parent / "clients"
    environment = {**os.environ, "PYTHONPATH": str(clients / "generated/client"), "CERTIFICATE": f"{folder}/cert.pem"}
    line = [part.format(clients=clients) for part in CLIENTS[client]]
    line += [address if client == "python" else address.rstrip("/"), token, *map(str, scene(folder))]
    done = subprocess.run(line, capture_output=True, timeout=180, env=environment)
    assert done.returncode == 0, f"the {client} client at {address}: {done.stderr.decode()}"
    assert np.load(io.BytesIO(done.stdout)).shape == (4, 48, 64), f"the {client} client at {address}"


def stored(address, token, file):
    sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
    headers = {"Authorization": f"Bearer {token}"}
    blob = requests.get(f"{address}v1/blobs/{sha256}", headers=headers, timeout=20)
    assert blob.status_code == 200, f"{address}: the upload is not stored: {blob.text}"
    return sha256


def walk(address, token, places):
    """Uses the service as a lab does."""
    folder, tools = places
    session = requests.Session()
    session.headers["Authorization"] = f"Bearer {token}"
    masks, measurement = scene(folder)
    tus = TusClient(f"{address}v1/uploads", headers=dict(session.headers))
    uploader = tus.uploader(str(masks), chunk_size=16384)
    uploader.upload()
    assert uploader.url.startswith(f"{address}v1/uploads/"), uploader.url
    upload(["node", tools / "tus.mjs"], address, token, measurement)

    def create(kind, body):
        answer = session.post(f"{address}v1/{kind}", json=body, headers={"Prefer": "wait=20"}, timeout=60)
        assert answer.status_code in (201, 202), f"{answer.url}: {answer.text}"
        place = urljoin(answer.url, answer.headers["Location"])
        assert place == f"{address}v1/{kind}/{answer.json()['id']}", place
        return place

    calibration = create("calibrations", {"masks": stored(address, token, masks)})
    body = {"calibration": calibration.rsplit("/", 1)[1], "data": stored(address, token, measurement)}
    body = {"measurement": create("measurements", body).rsplit("/", 1)[1], "algorithm": "gap-tv"}
    with session.get(f"{address}v1/events", stream=True, timeout=60) as events:
        job = create("jobs", body)
        # Events arrive while the stream is open, so no proxy buffers them.
        line = next(line for line in events.iter_lines() if line.startswith(b"data:"))
        assert b"{" in line, line
    for _ in range(6):
        state = session.get(job, headers={"Prefer": "wait=20"}, timeout=60).json()["state"]
        if state not in ("queued", "running"):
            break
    assert state == "succeeded", state
    result = session.get(f"{job}/snapshots/0/exports/npy", timeout=60)
    assert np.load(io.BytesIO(result.content)).shape == (4, 48, 64), result.headers
    missing = session.get(f"{address}v1/jobs/{'0' * 8}-0000-7000-8000-{'0' * 12}", timeout=20)
    assert missing.status_code == 404, missing.text
    page = re.match("<([^>]*)>", missing.headers["Link"])[1]
    assert requests.get(urljoin(missing.url, page), timeout=20).status_code == 200, page
    dashboard(address)
    cookie(address, token)


def dashboard(address):
    """Loads the page, and all files to which it and its modules refer."""
    seen, waiting = set(), [address]
    while waiting:
        place = waiting.pop()
        answer = requests.get(place, timeout=20)
        assert answer.status_code == 200, f"{place}: {answer.status_code}"
        seen.add(place)
        kind = answer.headers["Content-Type"]
        pattern = r'from "(\.[^"]+)"' if "javascript" in kind else r'(?:src|href)="([^"#:]+)"' if "html" in kind else "(?!)"
        waiting += {urljoin(place, name) for name in re.findall(pattern, answer.text)} - seen - set(waiting)
    assert any(place.endswith(".js") for place in seen) and any(place.endswith(".css") for place in seen), seen
    assert all(place.startswith(address) for place in seen), seen


def cookie(address, token):
    """The cookie of a session holds below the prefix and nowhere else."""
    path = "/" + address.split("/", 3)[3]
    browser = requests.Session()
    begun = browser.post(f"{address}view/session", params={"path": path}, headers={"Authorization": f"Bearer {token}"}, timeout=20)
    assert begun.status_code == 201, begun.text
    [made] = browser.cookies
    prefix = "__Host-" if path == "/" else "__Secure-"
    assert (made.path, made.secure) == (path, True) and made.name.startswith(prefix), made
    assert browser.get(f"{address}v1/jobs", timeout=20).status_code == 200
    assert requests.get(f"{address}v1/jobs", timeout=20).status_code == 401
