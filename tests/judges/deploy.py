"""Validates the samples under deploy/ and docker/ with the programs that read them.

Usage: deploy.py ROOT. Names the validators that are not installed. Exits with 1 and the reasons if a sample
is invalid.
"""

import json
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile

import kubernetes_validate
import yaml

VERSION = "1.31"


def run(*command, **options):
    done = subprocess.run(command, capture_output=True, text=True, **options)
    return done.returncode, done.stdout + done.stderr


def kubernetes(root, wrong):
    folder = root / "deploy/kubernetes"
    documents = []
    for file in sorted(folder.glob("*.yaml")):
        if file.name != "kustomization.yaml":
            documents += [(file.name, each) for each in yaml.safe_load_all(file.read_text())]
    listed = yaml.safe_load((folder / "kustomization.yaml").read_text())["resources"]
    if sorted(listed) != sorted({name for name, _ in documents}):
        wrong.append(f"kustomization.yaml lists {listed}")
    for name, document in documents:
        if document["kind"] == "ScaledJob":
            # A ScaledJob of KEDA: the template of its jobs is checked against the schema of a job.
            target = dict(document["spec"]["jobTargetRef"])
            document = {"apiVersion": "batch/v1", "kind": "Job", "metadata": {"name": "worker"}, "spec": target}
        try:
            kubernetes_validate.validate(document, VERSION, strict=True)
        except kubernetes_validate.ValidationError as error:
            wrong.append(f"{name}: {document['kind']}: {error.message}")


def kustomize(root, wrong):
    if not shutil.which("kubectl"):
        return "kubectl"
    with tempfile.TemporaryDirectory() as copy:
        folder = pathlib.Path(copy) / "kubernetes"
        shutil.copytree(root / "deploy/kubernetes", folder)
        (folder / "cluster").mkdir(exist_ok=True)
        for name in [*(f"nats-server-{n}.conf" for n in (1, 2, 3)), "hub.creds", "default.creds"]:
            (folder / "cluster" / name).write_text("x")
        status, told = run("kubectl", "kustomize", str(folder))
    if status:
        wrong.append(f"kubectl kustomize: {told}")
        return None
    kinds = [each["kind"] for each in yaml.safe_load_all(told)]
    if sorted(kinds) != ["Namespace", *["ScaledJob"], *["Secret"] * 3, *["Service"] * 2, *["StatefulSet"] * 2]:
        wrong.append(f"kubectl kustomize makes {kinds}")
    return None


def compose(root, wrong):
    if not shutil.which("docker-compose"):
        return "docker-compose"
    files = ["-f", str(root / "docker/compose.yaml"), "-f", str(root / "docker/cluster.yaml")]
    status, told = run("docker-compose", *files, "config")
    if status:
        wrong.append(f"docker-compose config: {told}")
    return None


def systemd(root, wrong):
    if not shutil.which("systemd-analyze"):
        return "systemd-analyze"
    for unit in (root / "deploy/systemd").glob("*.service"):
        _, told = run("systemd-analyze", "verify", str(unit))
        # The program's path does not exist on the machine of the test.
        told = [line for line in told.splitlines() if "/usr/local/bin/sci-recon is not executable" not in line]
        if told:
            wrong.append(f"{unit.name}: {told}")
    return None


def nginx(root, wrong):
    program = shutil.which("nginx", path=os.environ.get("PATH", "") + ":/usr/sbin")
    if not program or not shutil.which("openssl"):
        return "nginx"
    with tempfile.TemporaryDirectory() as folder:
        key, certificate = f"{folder}/key.pem", f"{folder}/cert.pem"
        run("openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", key, "-out", certificate,
            "-days", "1", "-subj", "/CN=bench.example")
        site = (root / "deploy/nginx/sci-recon.conf").read_text()
        site = site.replace("/etc/ssl/bench.example.pem", certificate)
        site = site.replace("/etc/ssl/private/bench.example.key", key)
        whole = pathlib.Path(folder, "nginx.conf")
        whole.write_text(f"pid {folder}/pid; error_log {folder}/log; events {{}} http {{ {site} }}")
        status, told = run(program, "-t", "-q", "-c", str(whole))
        if status:
            wrong.append(f"nginx -t: {told}")
    return None


def caddy(root, wrong):
    if not shutil.which("caddy"):
        return "caddy"
    file = str(root / "deploy/caddy/Caddyfile")
    status, told = run("caddy", "adapt", "--adapter", "caddyfile", "--config", file)
    if status:
        wrong.append(f"caddy adapt: {told}")
    return None


def figures(root, wrong):
    board = json.loads((root / "deploy/grafana/sci-recon.json").read_text())
    known(root, wrong, "sci-recon.json", [target["expr"] for panel in board["panels"]
                                          for target in panel.get("targets", [])])
    groups = yaml.safe_load((root / "deploy/prometheus/alerts.yml").read_text())["groups"]
    known(root, wrong, "alerts.yml", [rule["expr"] for group in groups for rule in group["rules"]])


def promtool(root, wrong):
    if not shutil.which("promtool"):
        return "promtool"
    status, told = run("promtool", "check", "rules", str(root / "deploy/prometheus/alerts.yml"))
    if status:
        wrong.append(f"promtool check rules: {told}")
    return None


def known(root, wrong, file_name, expressions):
    names = {name for expression in expressions for name in words(expression)}
    described = set()
    for file in (root / "src").rglob("*.rs"):
        described |= words(file.read_text())
    missing = {name for name in names if name.removesuffix("_bucket") not in described}
    if missing or not names:
        wrong.append(f"{file_name} uses metrics that the service does not have: {sorted(missing)}")


def words(text):
    clean = "".join(c if c.isalnum() or c == "_" else " " for c in text)
    return {word for word in clean.split() if word.startswith("sci_recon_")}


def main():
    root, wrong = pathlib.Path(sys.argv[1]), []
    kubernetes(root, wrong)
    figures(root, wrong)
    absent = [name for name in (check(root, wrong) for check in (kustomize, compose, systemd, nginx, caddy, promtool)) if name]
    if absent:
        print(f"SKIPPED: {', '.join(absent)} not installed", file=sys.stderr)
    for reason in wrong:
        print(reason, file=sys.stderr)
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
