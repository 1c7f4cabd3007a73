"""Runs the containers of docker/ and deploy/kubernetes/ without Docker. It lays out a root like the last stage of
docker/Dockerfile, with its user, environment and entry point. The containers of the samples run in it with their
command lines and files: a server, a NATS server and a worker, which must complete a job.

Usage: unshare --mount --net --pid --fork --kill-child --mount-proc image.py ROOT PROGRAM

ROOT is the repository with runtime/, PROGRAM a build of sci-recon. The namespaces isolate the ports and mounts of the
containers, and end with this script. Ends with 1 and the reason if a sample does not work.
"""

import json
import os
import pathlib
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request

import yaml

# Libraries that debian:bookworm-slim has (libc6, libgcc-s1, libstdc++6).
BASE = {"libc.so.6", "libm.so.6", "libdl.so.2", "librt.so.1", "libpthread.so.0", "libgcc_s.so.1", "libstdc++.so.6",
        "ld-linux-x86-64.so.2"}
PATIENCE = 120


class Wrong(Exception):
    """Reports that a sample does not work."""


def require(holds, reason):
    if not holds:
        raise Wrong(reason)


def instructions(text):
    """The instructions of the last stage: name and rest."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    whole = "\n".join(lines).replace("\\\n", " ").splitlines()
    parts = [line.split(None, 1) for line in whole if line.strip()]
    start = max(n for n, (name, *_) in enumerate(parts) if name == "FROM")
    return [(name, rest[0] if rest else "") for name, *rest in parts[start:]]


class Image:
    def __init__(self, repository, program):
        self.environment = {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"}
        self.users, self.folders, self.copies, self.health = {"root": 0}, [], [], None
        self.packages = []
        built = {"/out/": [repository / "runtime", program]}
        for name, rest in instructions((repository / "docker/Dockerfile").read_text()):
            if name == "FROM":
                require(re.fullmatch(r"debian:12\.\d+-slim", rest), f"this script does not know the base image {rest}")
            elif name == "RUN":
                for command in rest.split("&&"):
                    self.run(shlex.split(command))
            elif name == "COPY":
                stage, source, place = rest.split()
                require(stage == "--from=build" and source in built, f"COPY {rest} is not known here")
                self.copies.append((built[source], place))
            elif name == "ENV":
                self.environment.update(word.split("=", 1) for word in shlex.split(rest))
            elif name == "USER":
                self.user = self.users[rest]
            elif name == "ENTRYPOINT":
                self.entry = json.loads(rest)
            elif name == "HEALTHCHECK":
                self.health = json.loads(rest[rest.index("CMD") + 3:])
            else:
                require(name in ("ARG", "VOLUME", "EXPOSE", "STOPSIGNAL", "CMD", "LABEL"), f"{name} is not known here")

    def run(self, words):
        if words[0] in ("apt-get", "rm"):
            self.packages += words[words.index("--no-install-recommends") + 1 :] if "install" in words else []
        elif words[0] == "useradd":
            self.users[words[-1]] = int(words[words.index("--uid") + 1])
        else:
            require(words[:3] == ["install", "-d", "-o"], f"RUN {words} is not known here")
            self.folders.append((words[4], self.users[words[3]]))

    def lay_out(self, root):
        for folder in ["bin", "dev", "etc", "proc", "tmp"]:
            (root / folder).mkdir(parents=True)
        (root / "tmp").chmod(0o1777)
        users = [f"{name}:x:{uid}:{uid}::/nonexistent:/bin/sh" for name, uid in self.users.items()]
        (root / "etc/passwd").write_text("\n".join(users) + "\n")
        (root / "etc/hosts").write_text("127.0.0.1 localhost nats sci-recon\n")
        programs = [pathlib.Path("/bin/sh")]
        for sources, place in self.copies:
            target = root / place.strip("/")
            target.mkdir(parents=True)
            for source in sources:
                if source.is_dir():
                    shutil.copytree(source, target, symlinks=True, dirs_exist_ok=True)
                else:
                    shutil.copy2(source, target / "sci-recon")
            programs += [path for path in target.iterdir() if os.access(path, os.X_OK) or ".so" in path.name]
        shutil.copy2("/bin/sh", root / "bin/sh")
        for library in {library for program in programs for library in libraries(program)}:
            require(library.name in BASE, f"the base image has no {library.name}")
            place = root / str(library).strip("/")
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(library, place)
        for package in self.packages:
            require(package == "ca-certificates", f"this script does not know the package {package}")
            shutil.copytree("/etc/ssl/certs", root / "etc/ssl/certs", symlinks=False, ignore_dangling_symlinks=True)
        for folder, uid in self.folders:
            place = root / folder.strip("/")
            place.mkdir()
            os.chown(place, uid, 0)
        subprocess.run(["mount", "-t", "proc", "proc", root / "proc"], check=True)
        for name, minor in [("null", 3), ("urandom", 9)]:
            os.mknod(root / "dev" / name, 0o020666, os.makedev(1, minor))
            (root / "dev" / name).chmod(0o666)


def libraries(program):
    """The shared libraries of a program or library."""
    listed = subprocess.run(["ldd", program], capture_output=True, text=True).stdout
    return {pathlib.Path(path) for path in re.findall(r"(/\S+) \(0x", listed) if ".so" in path}


class Container:
    """A container with a separate root, and its processes."""

    def __init__(self, name, folder, image=None, user=None, group=0):
        self.name, self.root, self.log = name, folder / name, folder / f"{name}.log"
        self.environment = dict(image.environment) if image else {}
        self.entry = image.entry if image else []
        self.user = image.user if user is None and image else user or 0
        self.group = group
        if image:
            image.lay_out(self.root)
        else:
            (self.root / "data").mkdir(parents=True)

    def put(self, source, place, mode=None, group=None):
        """Copies a file to the path at which it is mounted."""
        target = self.root / place.strip("/")
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(source, target)
        metadata = source.stat()
        os.chown(target, metadata.st_uid if mode is None else 0, metadata.st_gid if group is None else group)
        if mode is not None:
            target.chmod(mode)

    def folder(self, place, group):
        """Creates an empty volume for a group."""
        target = self.root / place.strip("/")
        target.mkdir(parents=True, exist_ok=True)
        os.chown(target, 0, group)
        target.chmod(0o2777)

    def enter(self):
        os.chroot(self.root)
        os.chdir("/")
        os.setgroups([self.group])
        os.setgid(self.user and self.group)
        os.setuid(self.user)

    def start(self, words, entry=None):
        with self.log.open("ab") as log:
            return subprocess.Popen([*(self.entry if entry is None else entry), *words], env=self.environment,
                                    preexec_fn=self.enter, stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    def run(self, words, entry=None):
        """Runs a command; returns status and standard output."""
        done = subprocess.run([*(self.entry if entry is None else entry), *words], env=self.environment,
                              preexec_fn=self.enter, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True,
                              stderr=subprocess.PIPE)
        with self.log.open("a") as log:
            log.write(done.stderr)
        return done.returncode, done.stdout.strip()


def ask(token, path, body=None, wait=0):
    headers = {"Authorization": f"Bearer {token}", "Prefer": f"wait={wait}"}
    request = urllib.request.Request(f"http://127.0.0.1:8080{path}", headers=headers)
    if body is not None:
        request.data = json.dumps(body).encode()
        request.add_header("Content-Type", "application/json")
    with urllib.request.urlopen(request, timeout=60) as answer:
        return json.load(answer)


def ready(server, process):
    start = time.monotonic()
    while time.monotonic() - start < PATIENCE:
        require(process.poll() is None, f"{server.name} ends with {process.returncode}")
        try:
            with urllib.request.urlopen("http://127.0.0.1:8080/readyz", timeout=5):
                return
        except (urllib.error.URLError, OSError):
            time.sleep(0.2)
    raise Wrong(f"{server.name} is not ready after {PATIENCE} s")


def job(server, running):
    """Runs a job on the worker, because the server leaves all tiles to other machines."""
    status, token = server.run(["token", "--data", "/data", "create", "--lab", "optics", "--role", "admin"])
    require(status == 0 and token, "no token could be created")
    created = ask(token, "/v1/samples", {"algorithm": "gap-tv"}, wait=10)["job"]["id"]
    start = time.monotonic()
    while time.monotonic() - start < PATIENCE:
        for name, process in running.items():
            require(process.poll() is None, f"{name} ends with {process.returncode}")
        state = ask(token, f"/v1/jobs/{created}", wait=5)["state"]
        if state not in ("queued", "running"):
            require(state == "succeeded", f"the job is {state}")
            pools = [worker["pool"] for worker in ask(token, "/v1/system")["workers"] if worker.get("pool")]
            require(pools == ["default"], f"workers of the pools {pools} are known")
            return
    raise Wrong(f"no worker has completed the job after {PATIENCE} s")


def stop(running):
    for name, process in reversed(running.items()):
        process.terminate()
        status = process.wait(timeout=40)
        require(name == "nats" or status == 0, f"{name} ends with {status} on SIGTERM")


def services(repository):
    """The services of docker/compose.yaml, extended by docker/cluster.yaml."""
    merged = {}
    for file in ["compose.yaml", "cluster.yaml"]:
        for name, service in yaml.safe_load((repository / "docker" / file).read_text())["services"].items():
            known = merged.setdefault(name, {"volumes": []})
            volumes = known["volumes"] + service.get("volumes", [])
            known.update(service, volumes=volumes)
    return merged


def keys(repository, program, nats_server, folder):
    """Runs the commands in docker/cluster.yaml before `docker compose`, with this machine's NATS."""
    text = (repository / "docker/cluster.yaml").read_text()
    lines = re.findall(r"^#   (.+)$", text, re.MULTILINE)
    require(lines and lines[-1].startswith("docker compose"), "docker/cluster.yaml begins with its commands")
    (folder / "bin").mkdir()
    (folder / "bin/sci-recon").symlink_to(program)
    path = f"{folder}/bin:/usr/sbin:{os.environ['PATH']}"
    printed = subprocess.run([nats_server, "--version"], capture_output=True, text=True).stdout
    version = re.search(r"v([\d.]+)", printed).group(1)
    for line in lines[:-1]:
        line = re.sub(r"--nats-version \S+", f"--nats-version {version}", line)
        done = subprocess.run(["sh", "-c", line], cwd=folder, env={**os.environ, "PATH": path}, capture_output=True,
                              text=True)
        require(done.returncode == 0, f"{line}: {done.stderr}")


def start_nats(nats, command, program):
    programs = [pathlib.Path(program), *libraries(program)]
    for path, place in [(programs[0], "nats-server"), *((path, str(path).strip("/")) for path in programs[1:])]:
        (nats.root / place).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, nats.root / place)
    return nats.start(command, entry=["/nats-server"])


def compose(repository, image, folder, nats_server, host):
    """Runs `docker compose -f docker/compose.yaml -f docker/cluster.yaml up` without Docker."""
    listed, containers, running = services(repository), {}, {}
    for name, service in listed.items():
        container = Container(name, folder, image if name != "nats" else None)
        for volume in service["volumes"]:
            source, place = volume.split(":")[:2]
            if source.startswith("../"):
                container.put(host / source.removeprefix("../"), place)
        containers[name] = container
    running["nats"] = start_nats(containers["nats"], listed["nats"]["command"], nats_server)
    status, token = containers["sci-recon"].run(["token", "create", "--lab", "optics", "--new"])
    require(status == 0 and token, "the first token could not be created")
    running["sci-recon"] = containers["sci-recon"].start(listed["sci-recon"]["command"])
    ready(containers["sci-recon"], running["sci-recon"])
    running["worker"] = containers["worker"].start(listed["worker"]["command"])
    job(containers["sci-recon"], running)
    for name in ["sci-recon", "worker"]:
        disabled = listed[name].get("healthcheck", {}).get("disable", False)
        status, _ = containers[name].run(image.health, entry=[])
        require(disabled or status == 0, f"the image's health check of {name} ends with {status}")
    stop(running)


def kubernetes(repository, image, folder, nats_server, host):
    """Runs the pods of the server and of a worker with one node of NATS."""
    nats = Container("nats", folder)
    nats.put(host / "cluster/nats-server.conf", "/nats.conf")
    running = {"nats": start_nats(nats, ["--config=/nats.conf"], nats_server)}
    documents = [document for file in ["server.yaml", "worker.yaml"]
                 for document in yaml.safe_load_all((repository / "deploy/kubernetes" / file).read_text())]
    server = None
    for document in documents:
        spec = document["spec"]
        template = spec.get("jobTargetRef", spec).get("template")
        if not template:
            continue
        pod, name = template["spec"], document["metadata"]["name"]
        group = pod["securityContext"]["fsGroup"]
        container = Container(name, folder, image, pod["securityContext"]["runAsUser"], group)
        [main] = pod["containers"]
        volumes = {volume["name"]: volume for volume in pod["volumes"]}
        for mount in main["volumeMounts"]:
            secret = volumes.get(mount["name"], {}).get("secret")
            if secret:
                file = {"hub": "hub.creds", "worker": "default.creds"}[secret["secretName"]]
                mode = secret.get("defaultMode", 0o644)
                container.put(host / "cluster" / file, f"{mount['mountPath']}/creds", mode, group)
            else:
                container.folder(mount["mountPath"], group)
        for first in pod.get("initContainers", []):
            status, _ = container.run(first.get("args", []), entry=first.get("command"))
            require(status == 0, f"{first['name']} ends with {status}")
        running[name] = container.start(main["args"])
        if name == "sci-recon":
            ready(container, running[name])
            server = container
    job(server, running)
    stop(running)


def main():
    repository, program = (pathlib.Path(word).resolve() for word in sys.argv[1:])
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    nats_server = shutil.which("nats-server", path=os.environ["PATH"] + ":/usr/sbin")
    image = Image(repository, program)
    for sample in [compose, kubernetes]:
        with tempfile.TemporaryDirectory() as folder:
            folder = pathlib.Path(folder)
            host, roots = folder / "host", folder / "roots"
            host.mkdir()
            roots.mkdir()
            folder.chmod(0o755)
            keys(repository, program, nats_server, host)
            try:
                sample(repository, image, roots, nats_server, host)
            except Exception as error:
                for log in sorted(roots.glob("*.log")):
                    tail = log.read_text(errors="replace").splitlines()[-15:]
                    print(f"{sample.__name__}: {log.stem}:", *tail, sep="\n  ", file=sys.stderr)
                print(f"{sample.__name__}: {error}", file=sys.stderr)
                # All processes of the namespace end with it.
                os._exit(1)
            finally:
                for root in roots.iterdir():
                    subprocess.run(["umount", "-q", "--lazy", root / "proc"])


if __name__ == "__main__":
    main()
