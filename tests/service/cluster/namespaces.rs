//! The commands of docs/CLUSTER.md, run verbatim with the server in one network namespace, and the
//! worker in another as another user.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use super::nodes;
use super::{job, local};
use crate::app::has_programs;
use crate::samples::Scene;

/// The commands under "Run workers on another PC" for the server's machine and for another one.
fn recipe() -> [String; 2] {
    let text = std::fs::read_to_string("docs/CLUSTER.md").unwrap();
    let (_, text) = text.split_once("## Run workers on another PC").unwrap();
    let mut blocks = text.split("```sh\n").skip(1).map(|rest| rest.split("```").next().unwrap());
    std::array::from_fn(|_| blocks.next().unwrap().to_owned())
}

/// Two network namespaces connected by a cable; they are removed when this is dropped.
struct Machines {
    names: [String; 2],
    folder: tempfile::TempDir,
    started: Vec<Child>,
}

fn ip(line: &str) -> Result<(), String> {
    let ran = Command::new("ip").args(line.split_whitespace()).output();
    let ran = ran.map_err(|error| format!("ip: {error}"))?;
    if ran.status.success() {
        return Ok(());
    }
    Err(format!("ip {line}: {}", String::from_utf8_lossy(&ran.stderr).trim()))
}

impl Machines {
    /// None, after a message, if this machine allows no namespaces.
    fn new() -> Option<Self> {
        if !rustix::process::getuid().is_root() {
            eprintln!("SKIPPED: network namespaces need root");
            return None;
        }
        let id = std::process::id();
        let names = ["server", "worker"].map(|name| format!("sci-recon-{name}-{id}"));
        let machines = Self { names, folder: tempfile::tempdir().unwrap(), started: Vec::new() };
        match machines.connect() {
            Ok(()) => Some(machines),
            Err(reason) => {
                eprintln!("SKIPPED: no network namespaces: {reason}");
                None
            }
        }
    }

    fn connect(&self) -> Result<(), String> {
        let [server, worker] = &self.names;
        for name in &self.names {
            ip(&format!("netns add {name}"))?;
            ip(&format!("-n {name} link set lo up"))?;
            // In the namespace, this file replaces /etc/hosts.
            let folder = Path::new("/etc/netns").join(name);
            std::fs::create_dir_all(&folder).map_err(|error| error.to_string())?;
            let hosts = "127.0.0.1 localhost\n10.213.7.1 server.lab\n";
            std::fs::write(folder.join("hosts"), hosts).map_err(|error| error.to_string())?;
        }
        ip(&format!("link add vs0 netns {server} type veth peer name vw0 netns {worker}"))?;
        for (name, link, address) in [(server, "vs0", 1), (worker, "vw0", 2)] {
            ip(&format!("-n {name} address add 10.213.7.{address}/24 dev {link}"))?;
            ip(&format!("-n {name} link set {link} up"))?;
        }
        Ok(())
    }

    /// A command line on one of the machines, with `bin` first in the path.
    fn shell(&self, machine: usize, text: &str) -> Command {
        let mut command = Command::new("ip");
        let path = format!("{}:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin", self.bin().display());
        command
            .args(["netns", "exec", &self.names[machine], "sh", "-c", text])
            .env_clear()
            .env("PATH", path)
            .stdin(Stdio::null());
        command
    }

    /// The folder of the program.
    fn bin(&self) -> PathBuf {
        nodes::program().parent().unwrap().to_owned()
    }

    fn curl(&self, arguments: &str) -> Output {
        let line = format!("curl -sS --max-time 20 {arguments}");
        self.shell(0, &line).current_dir(self.folder.path()).output().unwrap()
    }

    /// An answer of the API, which only the server's machine can reach.
    fn api(&self, path: &str, body: Option<&Value>) -> Value {
        let url = format!("http://127.0.0.1:8080{path}");
        let ran = match body {
            None => self.curl(&url),
            Some(body) => {
                std::fs::write(self.folder.path().join("body.json"), body.to_string()).unwrap();
                self.curl(&format!("-H 'content-type: application/json' -d @body.json {url}"))
            }
        };
        serde_json::from_slice(&ran.stdout).unwrap_or_else(|_| panic!("{path}: {ran:?}"))
    }

    fn upload(&self, bytes: &[u8]) -> Value {
        std::fs::write(self.folder.path().join("upload"), bytes).unwrap();
        let ran = self.curl("--data-binary @upload http://127.0.0.1:8080/v1/blobs");
        let answer: Value = serde_json::from_slice(&ran.stdout).unwrap();
        answer["sha256"].clone()
    }
}

impl Drop for Machines {
    fn drop(&mut self) {
        for name in &self.names {
            // Ends all processes of these namespaces, by their identifiers.
            let listed = Command::new("ip").args(["netns", "pids", name]).output();
            let listed = listed.map(|ran| String::from_utf8_lossy(&ran.stdout).into_owned());
            for pid in listed.unwrap_or_default().split_whitespace() {
                if let Some(pid) = pid.parse().ok().and_then(rustix::process::Pid::from_raw) {
                    let _ = rustix::process::kill_process(pid, rustix::process::Signal::KILL);
                }
            }
            let _ = ip(&format!("netns delete {name}"));
            let _ = std::fs::remove_dir_all(Path::new("/etc/netns").join(name));
        }
        for child in &mut self.started {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

#[tokio::test]
async fn the_documented_commands_work_between_two_machines() {
    if nodes::server().is_none() {
        return;
    }
    if !has_programs(&["curl", "setpriv"], "curl util-linux") {
        return;
    }
    let expected = local().await;
    let Some(mut machines) = Machines::new() else { return };
    let [server, worker] = recipe();

    // The server's machine computes no tiles here, so they must come from the other machine.
    let home = machines.folder.path().join("home");
    std::fs::create_dir(&home).unwrap();
    let server = server.replace("sci-recon serve ", "sci-recon serve --workers 0 ");
    assert!(server.contains("--workers 0"), "{server}");
    let log = std::fs::File::create(machines.folder.path().join("server.log")).unwrap();
    let mut shell = machines.shell(0, &format!("set -e\n{server}\nwait"));
    shell.current_dir(&home).env("HOME", &home).stderr(log.try_clone().unwrap()).stdout(log);
    machines.started.push(shell.spawn().unwrap());
    let server_log = || std::fs::read_to_string(machines.folder.path().join("server.log")).unwrap();
    let credential = home.join("default.creds");
    wait("the credential exists", || credential.exists(), &server_log);
    wait(
        "the server answers",
        || machines.curl("-f http://127.0.0.1:8080/livez").status.success(),
        &server_log,
    );
    let ready = || machines.api("/readyz", None);
    wait("the server has connected to NATS", || ready()["ready"] == true, &server_log);

    // The other machine has a copy of the program and the credential, another user's rights, and
    // other folders.
    let other = tempfile::tempdir().unwrap();
    std::fs::copy(&credential, other.path().join("default.creds")).unwrap();
    for path in [other.path().to_owned(), other.path().join("default.creds")] {
        std::os::unix::fs::chown(
            path,
            Some(nodes::UNPRIVILEGED_UID),
            Some(nodes::UNPRIVILEGED_UID),
        )
        .unwrap();
    }
    let script = other.path().join("recipe.sh");
    std::fs::write(&script, format!("set -e\n{worker}")).unwrap();
    let line = format!(
        "mount -t tmpfs -o mode=1777 tmpfs /var/tmp && \
         exec setpriv --reuid {0} --regid {0} --clear-groups sh {1}",
        nodes::UNPRIVILEGED_UID,
        script.display()
    );
    let log = std::fs::File::create(other.path().join("log")).unwrap();
    let mut shell = machines.shell(1, &line);
    shell.current_dir(other.path()).stderr(log.try_clone().unwrap()).stdout(log);
    machines.started.push(shell.spawn().unwrap());
    let heard = || std::fs::read_to_string(other.path().join("log")).unwrap() + &server_log();
    let has_joined = || {
        let system = machines.api("/v1/system", None);
        system["workers"].as_array().unwrap().iter().any(|worker| worker["pool"] == "default")
    };
    wait("the worker is connected", has_joined, &heard);

    // The job must give the same frames as on one machine.
    let masks = machines.upload(&Scene::SMALL.masks());
    let calibration = machines.api("/v1/calibrations", Some(&json!({"masks": masks})));
    let data = machines.upload(&Scene::SMALL.snapshots());
    let body = json!({"calibration": calibration["id"], "data": data});
    let measurement = machines.api("/v1/measurements", Some(&body));
    let created = machines.api("/v1/jobs", Some(&job(measurement["id"].as_str().unwrap())));
    let path = format!("/v1/jobs/{}", created["id"].as_str().unwrap());
    wait("the job ends", || machines.api(&path, None)["finished_at"].is_string(), &heard);
    let done = machines.api(&path, None);
    assert_eq!(done["state"], "succeeded", "{done:#}\n{}", heard());
    let mut hashes = std::collections::BTreeMap::new();
    for snapshot in 0..Scene::SMALL.snapshots {
        let listed = machines.api(&format!("{path}/snapshots/{snapshot}"), None);
        for file in listed["files"].as_array().unwrap() {
            let text = |field: &str| file[field].as_str().unwrap().to_owned();
            if text("name") != "manifest.json" {
                hashes.insert(format!("{snapshot}/{}", text("name")), text("sha256"));
            }
        }
    }
    assert_eq!(hashes, *expected);
}

fn wait(what: &str, mut holds: impl FnMut() -> bool, log: &impl Fn() -> String) {
    let start = Instant::now();
    while !holds() {
        assert!(
            start.elapsed() < Duration::from_secs(60),
            "not within a minute: {what}\n{}",
            log()
        );
        std::thread::sleep(Duration::from_millis(100));
    }
}
