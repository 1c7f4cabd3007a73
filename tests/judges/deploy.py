"""Validates the samples under deploy/ and docker/ with the programs that read them.

Usage: deploy.py ROOT PROGRAM TOOLS, a checkout, its build of sci-recon, and a folder for JavaScript clients. Lists checks
that were skipped because a program is not installed. Ends with 1 and the reasons if a sample is invalid.
"""

import json
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import urllib.request

import kubernetes_validate
import rattler_build
import yaml
from docker.utils.build import exclude_paths

from image import services
from proxies import proxies, run, served

VERSION = "1.31"
# Largest exposure that `systemd-analyze security` may report, in tenths.
EXPOSURE = 30
# An image name that no sample has. Kustomize must insert it everywhere.
IMAGE = {"newName": "registry.example/sci-recon", "newTag": "1.2.3"}


def kubernetes(root, wrong):
    folder = root / "deploy/kubernetes"
    documents = []
    for file in sorted(folder.glob("*.yaml")):
        if file.name not in ("kustomization.yaml", "name-references.yaml"):
            documents += [(file.name, each) for each in yaml.safe_load_all(file.read_text())]
    listed = yaml.safe_load((folder / "kustomization.yaml").read_text())["resources"]
    if sorted(listed) != sorted({name for name, _ in documents}):
        wrong.append(f"kustomization.yaml lists {listed}")
    for name, document in documents:
        if document["kind"] == "ScaledJob":
            # The job template of a KEDA ScaledJob is checked against the schema of a job.
            target = dict(document["spec"]["jobTargetRef"])
            document = {"apiVersion": "batch/v1", "kind": "Job", "metadata": {"name": "worker"}, "spec": target}
        try:
            kubernetes_validate.validate(document, VERSION, strict=True)
        except kubernetes_validate.ValidationError as error:
            wrong.append(f"{name}: {document['kind']}: {error.message}")


def conda(root, wrong):
    """The recipe renders, and its source is the archive of `make dist`."""
    try:
        recipe = rattler_build.Stage0Recipe.from_file(str(root / "deploy/conda/recipe.yaml"))
        [rendered] = recipe.render(rattler_build.VariantConfig())
    except rattler_build.RattlerBuildError as error:
        wrong.append(f"deploy/conda: {error}")
        return
    recipe = rendered.recipe.to_dict()
    archive = f"../../dist/sci-recon-{recipe['package']['version']}-x86_64-linux.tar.gz"
    if recipe["source"] != [{"path": archive}]:
        wrong.append(f"deploy/conda: the source is {recipe['source']}, not {archive}")


def make_keys(program, folder, *nodes):
    """Writes the files that docs/CLUSTER.md creates to `cluster` below a folder."""
    options = [word for node in nodes for word in ("--node", node)]
    for line in [
        ["init", "--no-tls", *options, "--store", "/data", "--nats-version", "2.12"],
        ["worker", "create", "--pool", "default", "--out", "cluster/default.creds"],
    ]:
        subprocess.run([program, "cluster", *line], cwd=folder, check=True, capture_output=True)


def kustomize(root, wrong, program):
    if not shutil.which("kubectl"):
        return "kubectl"
    with tempfile.TemporaryDirectory() as copy:
        folder = pathlib.Path(copy) / "kubernetes"
        shutil.copytree(root / "deploy/kubernetes", folder, ignore=shutil.ignore_patterns("cluster"))
        make_keys(program, folder, *(f"nats-{n}.nats" for n in range(3)))
        file = folder / "kustomization.yaml"
        text = yaml.safe_load(file.read_text())
        text["images"] = [{**image, **IMAGE} for image in text["images"]]
        for components in ([], ["gpu"]):
            file.write_text(yaml.safe_dump({**text, "components": components}))
            wrong += [f"kubectl kustomize {components}: {reason}" for reason in rendered(folder, bool(components))]
    return None


# Kinds of volumes in the Pod Security Standard "restricted"
# (kubernetes.io/docs/concepts/security/pod-security-standards).
VOLUMES = {"configMap", "csi", "downwardAPI", "emptyDir", "ephemeral", "persistentVolumeClaim", "projected", "secret"}


def unrestricted(pod):
    """Violations of the standard "restricted", which includes "baseline"."""
    for name in ("hostNetwork", "hostPID", "hostIPC"):
        if pod.get(name):
            yield name
    for volume in pod.get("volumes", []):
        kinds = set(volume) - {"name"}
        if not kinds <= VOLUMES:
            yield f"a volume of the kind {kinds - VOLUMES}"
    pod_context = pod.get("securityContext", {})
    if pod_context.get("sysctls") or pod_context.get("seLinuxOptions"):
        yield "sysctls or seLinuxOptions"
    for container in [*pod.get("initContainers", []), *pod["containers"]]:
        container_context = container.get("securityContext", {})
        effective = {**pod_context, **container_context}
        rules = {
            "privileged": not container_context.get("privileged"),
            "procMount": container_context.get("procMount", "Default") == "Default",
            "hostPort": not any("hostPort" in port for port in container.get("ports", [])),
            "allowPrivilegeEscalation": container_context.get("allowPrivilegeEscalation") is False,
            "capabilities.drop": "ALL" in container_context.get("capabilities", {}).get("drop", []),
            "capabilities.add": set(container_context.get("capabilities", {}).get("add", [])) <= {"NET_BIND_SERVICE"},
            "runAsNonRoot": effective.get("runAsNonRoot") is True,
            "runAsUser": effective.get("runAsUser") != 0,
            "seccompProfile": effective.get("seccompProfile", {}).get("type") in ("RuntimeDefault", "Localhost"),
            "seLinuxOptions": not container_context.get("seLinuxOptions"),
        }
        yield from (f"{container['name']}: {name}" for name, kept in rules.items() if not kept)


def rendered(folder, has_gpu):
    """Faults of the objects of a folder."""
    status, output = run("kubectl", "kustomize", str(folder))
    if status:
        yield output
        return
    documents = list(yaml.safe_load_all(output))
    kinds = [each["kind"] for each in documents]
    if sorted(kinds) != ["Namespace", *["ScaledJob"], *["Secret"] * 3, *["Service"] * 2, *["StatefulSet"] * 2]:
        yield f"it creates {kinds}"
    yield from unresolved(documents)
    for name, document, template in templates(documents):
        yield from (f"{name}: {reason}" for reason in unrestricted(template["spec"]))
        if document["kind"] == "ScaledJob":
            yield from wrong_device(template["spec"], has_gpu)
            spec = document["spec"]["jobTargetRef"]
            job = {"apiVersion": "batch/v1", "kind": "Job", "metadata": {"name": name}, "spec": spec}
            try:
                kubernetes_validate.validate(job, VERSION, strict=True)
            except kubernetes_validate.ValidationError as error:
                yield f"{name}: {error.message}"


def wrong_device(pod, has_gpu):
    """Faults of the device of a worker."""
    [container] = pod["containers"]
    device = {each["name"]: each["value"] for each in container.get("env", [])}.get("SCI_RECON_DEVICE", "cpu")
    count = container["resources"]["limits"].get("nvidia.com/gpu", "0")
    if (device, count) != (("gpu", "1") if has_gpu else ("cpu", "0")):
        yield f"a worker has the device {device} and {count} GPUs"


def templates(documents):
    """Name and template of all pods that these objects create, with the object."""
    for document in documents:
        spec = document.get("spec", {})
        template = spec.get("jobTargetRef", spec).get("template")
        if template:
            yield document["metadata"]["name"], document, template


def unresolved(documents):
    """References between these objects without a target."""
    named = {}
    for document in documents:
        named.setdefault(document["kind"], {})[document["metadata"]["name"]] = document
    services, secrets, [namespace] = named["Service"], named["Secret"], named["Namespace"]
    labels = []
    for name, document, template in templates(documents):
        spec, pod = document["spec"], template["spec"]
        containers = [*pod.get("initContainers", []), *pod["containers"]]
        ports = [port for container in containers for port in container.get("ports", [])]
        labels.append((template["metadata"]["labels"], ports))
        if document["metadata"].get("namespace") != namespace:
            yield f"{name} is in the namespace {document['metadata'].get('namespace')}"
        if document["kind"] == "StatefulSet":
            if spec["serviceName"] not in services:
                yield f"{name} names the service {spec['serviceName']}"
            if not spec["selector"]["matchLabels"].items() <= template["metadata"]["labels"].items():
                yield f"{name} does not select the pods of its template"
        claims = {claim["metadata"]["name"]: {} for claim in spec.get("volumeClaimTemplates", [])}
        volumes = {**claims, **{volume["name"]: volume for volume in pod.get("volumes", [])}}
        for volume in volumes.values():
            secret = volume.get("secret", {}).get("secretName")
            if secret and secret not in secrets:
                yield f"{name} names the secret {secret}; there are {sorted(secrets)}"
        for container in containers:
            yield from unresolved_in(container, name, spec, volumes, secrets)
        probes = [container[kind]["httpGet"] for container in containers for kind in container if kind.endswith("Probe")]
        for probe in probes:
            if probe["port"] not in [port["name"] for port in ports]:
                yield f"a probe of {name} asks the port {probe['port']}"
    for name, service in services.items():
        chosen = [ports for label, ports in labels if service["spec"]["selector"].items() <= label.items()]
        if len(chosen) != 1:
            yield f"the service {name} selects {len(chosen)} kinds of pods"
        for port in service["spec"]["ports"] if chosen else []:
            target = port.get("targetPort", port["port"])
            if not any(target in (each["name"], each["containerPort"]) for each in chosen[0]):
                yield f"the service {name} leads to the port {target}"
    for name, job in named["ScaledJob"].items():
        for trigger in job["spec"]["triggers"]:
            host, port = trigger["metadata"]["natsServerMonitoringEndpoint"].split(":")
            service = next((each for each in services if host == f"{each}.{namespace}.svc.cluster.local"), None)
            if not service or int(port) not in [each["port"] for each in services[service]["spec"]["ports"]]:
                yield f"a trigger of {name} asks {host}:{port}"


def unresolved_in(container, name, spec, volumes, secrets):
    image = container["image"]
    if image != f"{IMAGE['newName']}:{IMAGE['newTag']}" and not image.startswith("nats:"):
        yield f"{name} runs the image {image}"
    mounts = {mount["mountPath"]: volumes.get(mount["name"]) for mount in container.get("volumeMounts", [])}
    for place, volume in mounts.items():
        if volume is None:
            yield f"{name} mounts at {place} what it does not declare"
    # The files in the command line, as a shell in each pod expands their names.
    for line in command_lines(container, name, spec.get("replicas", 1)):
        for word in line:
            place, _, file = word.rpartition("/")
            secret = (mounts.get(place) or {}).get("secret", {}).get("secretName")
            if secret in secrets and file not in secrets[secret]["data"]:
                yield f"{name} reads {word}; the secret has {sorted(secrets[secret]['data'])}"
            if word.startswith("/etc/") and secret is None:
                yield f"{name} reads {word}, which no secret brings"


def command_lines(container, name, replicas):
    """The words of a container's command. For `sh -c`, those of the program that replaces the shell."""
    command = [*container.get("command", []), *container.get("args", [])]
    if command[:2] != ["/bin/sh", "-c"]:
        return [command]
    lines = []
    for n in range(replicas):
        with tempfile.TemporaryDirectory() as folder:
            stand_in = pathlib.Path(folder, "nats-server")
            stand_in.write_text("#!/bin/sh\nprintf '%s\\n' \"$@\"\n")
            stand_in.chmod(0o755)
            environment = {"PATH": f"{folder}:/usr/bin:/bin", "HOSTNAME": f"{name}-{n}"}
            lines.append(run(*command, env=environment)[1].splitlines())
    return lines


def context(root, wrong, program):
    """Checks that a build of the image gets all files of the repository, and no build products of the checkout."""
    files = subprocess.run(["git", "-C", root, "ls-files", "-z"], capture_output=True, text=True, check=True).stdout
    files = {name for name in files.split("\0") if (root / name).is_file()}
    with tempfile.TemporaryDirectory() as copy:
        for name in files:
            place = pathlib.Path(copy, name)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(root / name, place)
        for folder in [".", "docker", "deploy/kubernetes"]:
            make_keys(program, pathlib.Path(copy, folder), "nats-0.nats", "nats-1.nats")
            shutil.copy2(pathlib.Path(copy, folder, "cluster/default.creds"), pathlib.Path(copy, folder))
        keys = pathlib.Path(copy, "elsewhere")
        subprocess.run([program, "cluster", "init", "--keys", keys], check=True, capture_output=True)
        for name in ["target/x", "runtime/x", "data/sci-recon.db", "tests/e2e/node_modules/x", ".git/x", "dist/x",
                     ".venv/x", "clients/python/.venv/x", "tests/__pycache__/x.pyc"]:
            pathlib.Path(copy, name).parent.mkdir(parents=True, exist_ok=True)
            pathlib.Path(copy, name).write_text("x")
        patterns = [line.strip() for line in (root / ".dockerignore").read_text().splitlines()]
        patterns = [pattern for pattern in patterns if pattern and not pattern.startswith("#")]
        seen = {name for name in exclude_paths(copy, patterns) if pathlib.Path(copy, name).is_file()}
    if seen - files:
        wrong.append(f".dockerignore leaves in the context: {sorted(seen - files)}")
    if files - seen:
        wrong.append(f".dockerignore takes out of the context: {sorted(files - seen)}")


def compose(root, wrong):
    listed = services(root)
    built = [service.get("image") for service in listed.values() if "build" in service]
    if len(built) != 1 or built[0] is None:
        wrong.append(f"docker/cluster.yaml builds {built}: server and worker must run one image, built once")
    for name, service in listed.items():
        made_here = service.get("image") in built
        if made_here != ("build" in service or service.get("pull_policy") == "never"):
            wrong.append(f"docker/cluster.yaml: {name} has {service.get('image')}, which is {'' if made_here else 'not '}built")
    if not {"sci-recon", "nats"} <= set(listed["worker"]["depends_on"]):
        wrong.append("docker/cluster.yaml: another service makes the worker's image")
    if not shutil.which("docker-compose"):
        return "docker-compose"
    files = ["-f", str(root / "docker/compose.yaml"), "-f", str(root / "docker/cluster.yaml")]
    status, output = run("docker-compose", *files, "config")
    if status:
        wrong.append(f"docker-compose config: {output}")
    return None


def image(root, wrong, program):
    """Starts the containers of the samples without Docker."""
    nats_server = shutil.which("nats-server", path=os.environ["PATH"] + ":/usr/sbin")
    namespaces = ["unshare", "--mount", "--net", "--pid", "--fork", "--kill-child", "--mount-proc"]
    if not nats_server or run(*namespaces, "true")[0]:
        return "containers (nats-server, and root with namespaces)"
    script = root / "tests/judges/image.py"
    status, output = run(*namespaces, sys.executable, script, root, program)
    if status:
        wrong.append(f"docker/Dockerfile: {output}")
    return None


def systemd(root, wrong):
    if not shutil.which("systemd-analyze"):
        return "systemd-analyze"
    units = (root / "deploy/systemd").iterdir()
    for unit in sorted(unit for unit in units if unit.suffix in (".service", ".timer")):
        # The unit includes its drop-ins.
        _, output = run("systemd-analyze", "verify", str(unit))
        if unit.suffix == ".timer":
            continue
        status, exposure = run("systemd-analyze", "security", "--offline=true", f"--threshold={EXPOSURE}", str(unit))
        if status:
            wrong.append(f"{unit.name}: {exposure.splitlines()[-1]}")
        # The program is not installed on this machine.
        output = [line for line in output.splitlines() if "/usr/local/bin/sci-recon is not executable" not in line]
        if output:
            wrong.append(f"{unit.name}: {output}")
        texts = [file.read_text() for file in [unit, *unit.parent.glob(f"{unit.name}.d/*.conf")]]
        wrong += [f"{unit.name}: {reason}" for reason in unreadable("\n".join(texts))]
    return None


def filtered(root, wrong, program):
    """Runs a job with a server and a worker under the unit's system call filter, with all confinement."""
    if not shutil.which("systemd-analyze"):
        return "a service under its system call filter (systemd-analyze)"
    with tempfile.TemporaryDirectory() as folder:
        # An unprivileged user can read and run files in this folder.
        pathlib.Path(folder).chmod(0o777)
        copy = shutil.copy2(program, folder)
        for library in (root / "runtime").glob("*.so"):
            shutil.copy2(library, folder)
        unit = root / "deploy/systemd/sci-recon.service"
        before = [sys.executable, root / "tests/judges/filtered.py", unit]
        with served(copy, folder, before, workers=1) as url:
            state, confinement = sample_job(url), ask(f"{url}/readyz")["confinement"]
        if (state, confinement) != ("succeeded", "ok"):
            wrong.append(f"{unit.name}: under SystemCallFilter= a job is {state}, confinement says {confinement}")
    return None


def ask(url, body=None, wait=0):
    headers = {"Content-Type": "application/json", "Prefer": f"wait={wait}"}
    request = urllib.request.Request(url, body and json.dumps(body).encode(), headers)
    with urllib.request.urlopen(request, timeout=60) as answer:
        return json.load(answer)


def sample_job(url):
    """Final state of a short job."""
    job = ask(f"{url}/v1/samples", {"algorithm": "gap-tv"})["job"]["id"]
    for _ in range(6):
        state = ask(f"{url}/v1/jobs/{job}", wait=20)["state"]
        if state not in ("queued", "running"):
            break
    return state


def unreadable(text):
    """Credentials that a unit's user can't read, because systemd does not pass them."""
    lines = [line for line in text.splitlines() if "=" in line]
    loaded = [line.removeprefix("LoadCredential=").split(":")[0] for line in lines if line.startswith("LoadCredential=")]
    for name in re.findall(r"%d/([\w.-]+)", text):
        if name not in loaded:
            yield f"no LoadCredential= is named {name}"
    for line in lines:
        path = re.search(r"/\S*\.creds", line)
        if path and not line.startswith("LoadCredential="):
            yield f"DynamicUser= can't read {path.group()}: {line}"


def figures(root, wrong):
    board = json.loads((root / "deploy/grafana/sci-recon.json").read_text())
    known(root, wrong, "sci-recon.json", [target["expr"] for panel in board["panels"]
                                          for target in panel.get("targets", [])])
    groups = yaml.safe_load((root / "deploy/prometheus/alerts.yml").read_text())["groups"]
    known(root, wrong, "alerts.yml", [rule["expr"] for group in groups for rule in group["rules"]])


def promtool(root, wrong):
    if not shutil.which("promtool"):
        return "promtool"
    status, output = run("promtool", "check", "rules", str(root / "deploy/prometheus/alerts.yml"))
    if status:
        wrong.append(f"promtool check rules: {output}")
    status, output = run("promtool", "check", "config", "--syntax-only", str(root / "deploy/prometheus/prometheus.yml"))
    if status:
        wrong.append(f"promtool check config: {output}")
    return None


def known(root, wrong, file_name, expressions):
    names = {name for expression in expressions for name in words(expression)}
    described = set()
    for file in [*(root / "src").rglob("*.rs"), *(root / "crates").rglob("*.rs")]:
        described |= words(file.read_text())
    missing = {name for name in names if name.removesuffix("_bucket") not in described}
    if missing or not names:
        wrong.append(f"{file_name} uses metrics that the service lacks: {sorted(missing)}")


def words(text):
    clean = "".join(c if c.isalnum() or c == "_" else " " for c in text)
    return {word for word in clean.split() if word.startswith("sci_recon_")}


def main():
    root, program, wrong = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]).resolve(), []
    kubernetes(root, wrong)
    conda(root, wrong)
    figures(root, wrong)
    context(root, wrong, program)
    absent = [check(root, wrong, program) for check in (kustomize, image, filtered)]
    absent += [check(root, wrong) for check in (compose, systemd, promtool)]
    absent.append(proxies(root, wrong, program, pathlib.Path(sys.argv[3]).resolve()))
    absent = [name for name in absent if name]
    if absent:
        print(f"SKIPPED: {', '.join(absent)} not installed", file=sys.stderr)
        if os.environ.get("CI") == "true":
            wrong.append("no check may be skipped with CI=true")
    for reason in wrong:
        print(reason, file=sys.stderr)
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
