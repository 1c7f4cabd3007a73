//! Faults at chosen file operations, clock jumps and full disks, caused by a library between the
//! program and the kernel (`shim/faults.c`).

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use serde_json::{Value, json};

use crate::app::{TestApp, id};
use crate::faults::{orphans, results};
use crate::samples::Scene;

pub struct Shim {
    folder: tempfile::TempDir,
    library: PathBuf,
}

impl Shim {
    pub fn build() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let library = folder.path().join("libfaults.so");
        let mut cc = Command::new("cc");
        cc.args(["-shared", "-fPIC", "-O1", "-o"]).arg(&library);
        let status = cc.args(["tests/service/shim/faults.c", "-ldl"]).status().unwrap();
        assert!(status.success());
        Self { folder, library }
    }

    pub fn library(&self) -> &Path {
        &self.library
    }

    pub fn file(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub async fn service(&self, arguments: &[&str], faults: &[(&str, &str)]) -> TestApp {
        let mut environment = vec![("LD_PRELOAD", self.library.to_str().unwrap())];
        environment.extend(faults);
        TestApp::in_environment(arguments, &environment).await
    }
}

fn small(measurement: &str) -> Value {
    json!({
        "measurement": measurement,
        "algorithm": "gap-tv",
        "tile": {"size": 48, "overlap": 8},
        "schedule": {"stages": [{"prior": "tv", "iterations": 20, "tv_weight": 0.05}]},
    })
}

async fn undisturbed() -> std::collections::BTreeMap<String, String> {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let job = app.submit(&small(&measurement)).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    results(&app, &job).await
}

/// Number of fault points: `SCI_RECON_FAULT_POINTS`.
fn points() -> u64 {
    std::env::var("SCI_RECON_FAULT_POINTS").map_or(2, |text| text.parse().unwrap())
}

/// Runs every step from upload to download, repeating it until it succeeds.
async fn complete_run(app: &mut TestApp) -> String {
    for _ in 0..5 {
        let outcome = tokio::time::timeout(Duration::from_secs(60), attempt(app)).await;
        if let Ok(Some(job)) = outcome {
            return job;
        }
        if !app.is_running() {
            app.restart();
        }
    }
    panic!("the service does not restart");
}

/// One attempt, which an error of the service or the network ends.
async fn attempt(app: &TestApp) -> Option<String> {
    let file = |bytes: Vec<u8>| async {
        let request = app.request(reqwest::Method::POST, "/v1/blobs").body(bytes);
        let answer = request.send().await.ok()?;
        let body: Value = answer.error_for_status().ok()?.json().await.ok()?;
        Some(body["sha256"].as_str()?.to_owned())
    };
    let post = |path: &'static str, body: Value| async move {
        let answer = app.request(reqwest::Method::POST, path).json(&body).send().await.ok()?;
        let body: Value = answer.error_for_status().ok()?.json().await.ok()?;
        Some(body["id"].as_str()?.to_owned())
    };
    let masks = file(Scene::SMALL.masks()).await?;
    let data = file(Scene::SMALL.snapshots()).await?;
    let calibration = post("/v1/calibrations", json!({ "masks": masks })).await?;
    let body = json!({ "calibration": calibration, "data": data });
    let measurement = post("/v1/measurements", body).await?;
    let job = post("/v1/jobs", small(&measurement)).await?;
    loop {
        let request = app.request(reqwest::Method::GET, &format!("/v1/jobs/{job}"));
        let shown: Value = request.send().await.ok()?.error_for_status().ok()?.json().await.ok()?;
        match shown["state"].as_str()? {
            "succeeded" => return Some(job),
            "failed" => panic!("{shown:#}"),
            _ => tokio::time::sleep(Duration::from_millis(20)).await,
        }
    }
}

#[tokio::test]
async fn a_fault_at_any_file_operation_is_survived() {
    let shim = Shim::build();
    let expected = undisturbed().await;
    let (mut tried, mut hit, mut wrong, mut orphaned) = (0, 0, 0, 0);
    for program in ["serve", "worker"] {
        for kind in ["kill", "full"] {
            // The distance grows, because the first operations belong to the start.
            for step in 0..points() {
                let at = (3 + step * 17 + step * step / 2).to_string();
                let token = shim.file("token");
                std::fs::write(&token, [0]).unwrap();
                let faults = [
                    ("FAULT_PROGRAM", program),
                    ("FAULT_AT", at.as_str()),
                    ("FAULT_KIND", kind),
                    ("FAULT_TOKEN", token.to_str().unwrap()),
                ];
                let Some(mut app) = started(&shim, &faults).await else { continue };
                let job = complete_run(&mut app).await;
                tried += 1;
                hit += u32::from(std::fs::read(&token).unwrap() != [0]);
                wrong += u32::from(results(&app, &job).await != expected);
                if step == points() - 1 {
                    orphaned += orphans(&mut app).await;
                }
            }
        }
    }
    let ok = wrong == 0 && orphaned == 0 && hit * 2 > tried;
    println!(
        "{}",
        json!({"target": "fault_points", "ok": ok, "tried": tried, "hit": hit,
               "wrong_results": wrong, "orphans": orphaned})
    );
    assert!(ok);
}

/// Starts the service, which a fault may prevent the first time.
async fn started(shim: &Shim, faults: &[(&str, &str)]) -> Option<TestApp> {
    for _ in 0..2 {
        let mut environment = vec![("LD_PRELOAD", shim.library.to_str().unwrap())];
        environment.extend(faults);
        let app = TestApp::try_in_environment(&["--workers", "1"], &environment).await;
        if app.is_some() {
            return app;
        }
    }
    None
}

#[tokio::test]
async fn a_full_disk_does_no_permanent_harm() {
    let shim = Shim::build();
    let full = shim.file("full");
    let app = shim.service(&["--workers", "1"], &[("FAULT_FULL", full.to_str().unwrap())]).await;
    let fill = || std::fs::write(&full, "").unwrap();
    let free = || std::fs::remove_file(&full).unwrap();
    let upload = |bytes| app.send(app.request(reqwest::Method::POST, "/v1/blobs").body(bytes));
    // The disk fills during an upload.
    fill();
    upload(Scene::SMALL.masks()).await.problem(507, "insufficient_storage");
    free();
    let masks = upload(Scene::SMALL.masks()).await.expect(201).json()["sha256"].clone();
    // The disk fills during the preparation of masks.
    fill();
    let refused = app.post("/v1/calibrations", &json!({ "masks": masks })).await;
    refused.problem(507, "insufficient_storage");
    free();
    let calibration =
        id(&app.post("/v1/calibrations", &json!({ "masks": masks })).await.expect(201));
    let measurement = id(&app.measure(&calibration, Scene::SMALL.snapshots()).await.expect(201));
    // The disk fills during the submission of a job.
    fill();
    app.post("/v1/jobs", &small(&measurement)).await.problem(507, "insufficient_storage");
    free();
    // The disk fills during a job. A failed job can be retried when there is space.
    let job = app.submit(&small(&measurement)).await;
    fill();
    tokio::time::sleep(Duration::from_millis(1500)).await;
    let state = app.get(&format!("/v1/jobs/{job}")).await.expect(200).json()["state"].clone();
    free();
    let mut done = app.ended(&job).await;
    eprintln!("with a full disk the job was {state}, then {}", done["state"]);
    if done["state"] == "failed" {
        let error = done["error"].as_str().unwrap();
        assert!(
            error.contains("space") && !error.contains(app.data().to_str().unwrap()),
            "{error}"
        );
        app.post(&format!("/v1/jobs/{job}/retry"), &json!({})).await.expect(202);
        done = app.ended(&job).await;
    }
    assert_eq!(done["state"], "succeeded", "{done:#}");
    assert_eq!(results(&app, &job).await, undisturbed().await);
}

#[tokio::test]
async fn a_job_waits_while_the_file_system_is_read_only() {
    let shim = Shim::build();
    let readonly = shim.file("readonly");
    let faults = [("FAULT_READONLY", readonly.to_str().unwrap())];
    let app = shim.service(&["--workers", "1"], &faults).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let mut body = small(&measurement);
    body["schedule"]["stages"][0]["iterations"] = json!(3000);
    let job = app.submit(&body).await;
    app.when(&job, |job| job["state"] != "queued").await;
    std::fs::write(&readonly, "").unwrap();
    let upload = app.request(reqwest::Method::POST, "/v1/blobs").body("abc");
    let detail = app.send(upload).await.problem(503, "unavailable");
    assert!(detail.contains("read-only"), "{detail}");
    app.post("/v1/jobs", &body).await.problem(503, "unavailable");
    // The time is longer than three attempts take.
    tokio::time::sleep(Duration::from_secs(12)).await;
    let state = app.get(&format!("/v1/jobs/{job}")).await.expect(200).json()["state"].clone();
    assert!(state == "running" || state == "queued", "{state}");
    std::fs::remove_file(&readonly).unwrap();
    let done = app.ended(&job).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    app.upload(b"abc".to_vec()).await;
}

/// A small file system in memory.
struct SmallDisk(tempfile::TempDir);

impl SmallDisk {
    /// `None` where file systems can't be mounted.
    fn mount(size: &str) -> Option<Self> {
        let folder = tempfile::tempdir().unwrap();
        let mut mount = Command::new("mount");
        mount.args(["-t", "tmpfs", "-o", size, "tmpfs"]).arg(folder.path());
        mount.output().is_ok_and(|output| output.status.success()).then_some(Self(folder))
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("--lazy").arg(self.0.path()).status();
    }
}

fn fill(file: &Path) {
    use std::io::Write;
    let mut file = std::fs::File::create(file).unwrap();
    while file.write_all(&[1; 4096]).is_ok() {}
}

/// The reserve file, once it is made.
async fn reserve(app: &TestApp) -> PathBuf {
    let reserve = app.data().join("reserve");
    let start = std::time::Instant::now();
    while !reserve.exists() {
        assert!(start.elapsed().as_secs() < 30, "no reserve is made");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    reserve
}

#[tokio::test]
async fn a_full_disk_permits_deletions_and_cuts_no_audit_line() {
    let Some(disk) = SmallDisk::mount("size=160m") else {
        return crate::app::skip("a file system can't be mounted: run the test as root");
    };
    let folder = tempfile::tempdir_in(disk.0.path()).unwrap();
    let [filling, audit] = ["filling", "audit.jsonl"].map(|name| disk.0.path().join(name));
    let arguments = ["--workers", "1", "--audit-log", audit.to_str().unwrap()];
    let app = TestApp::on(folder, "data", &arguments).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let job = app.submit(&small(&measurement)).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    let (reserve, path) = (reserve(&app).await, format!("/v1/jobs/{job}"));
    fill(&filling);
    // The lines of more than a page.
    for _ in 0..40 {
        let rename = app.request(reqwest::Method::PATCH, &path);
        rename.json(&json!({"label": "x"})).send().await.unwrap();
    }
    app.delete(&path).await.expect(204);
    assert!(!reserve.exists());
    app.get(&path).await.problem(404, "not_found");
    std::fs::remove_file(&filling).unwrap();
    app.upload(b"abc".to_vec()).await;
    let lines = std::fs::read_to_string(&audit).unwrap();
    let lines = lines.lines().map(|line| serde_json::from_str(line).expect(line));
    let lines: Vec<Value> = lines.collect();
    assert_eq!(lines.last().unwrap()["action"], "POST /v1/blobs");
}

#[tokio::test]
async fn a_service_starts_on_a_full_disk_and_deletes() {
    let Some(disk) = SmallDisk::mount("size=160m") else {
        return crate::app::skip("a file system can't be mounted: run the test as root");
    };
    let folder = tempfile::tempdir_in(disk.0.path()).unwrap();
    let filling = disk.0.path().join("filling");
    let mut app = TestApp::on(folder, "data", &["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let job = app.submit(&small(&measurement)).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    let reserve = reserve(&app).await;
    app.kill();
    fill(&filling);
    assert!(app.try_restart(), "the service starts");
    assert!(!reserve.exists());
    app.delete(&format!("/v1/jobs/{job}")).await.expect(204);
    app.get(&format!("/v1/jobs/{job}")).await.problem(404, "not_found");
    std::fs::remove_file(&filling).unwrap();
    app.upload(b"abc".to_vec()).await;
    app.kill();
    app.restart();
    let reserve = self::reserve(&app).await;
    // Commands give up the reserve, too, so that a token can always be revoked.
    let token = |arguments: &[&str]| {
        let mut token = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        token.args(["token", "--data"]).arg(app.data()).args(arguments).output().unwrap()
    };
    let note = "n".repeat(200);
    let created = token(&["create", "--lab", "a", "--role", "submit", "--note", &note]);
    app.sign_in(String::from_utf8(created.stdout).unwrap().trim());
    let id = app.get("/v1/me").await.expect(200).json()["token"].as_str().unwrap().to_owned();
    fill(&filling);
    // The write-ahead log grows after a few changes.
    let mut created = true;
    for _ in 0..100 {
        created = token(&["create", "--lab", "a", "--note", &note]).status.success();
        if !reserve.exists() {
            break;
        }
    }
    assert!(created && !reserve.exists(), "the reserve is given up");
    assert!(token(&["revoke", &id]).status.success());
    app.get("/v1/jobs").await.problem(401, "unauthorized");
}

#[tokio::test]
async fn clock_jumps_are_harmless() {
    let shim = Shim::build();
    let clock = shim.file("clock");
    let set = |seconds: i64| write_in_place(&clock, &seconds.to_le_bytes());
    std::fs::write(&clock, 0i64.to_le_bytes()).unwrap();
    let app = shim.service(&["--workers", "2"], &[("FAULT_CLOCK", clock.to_str().unwrap())]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let mut body = small(&measurement);
    body["schedule"]["stages"][0]["iterations"] = json!(3000);
    for jump in [86_400, -86_400, 30] {
        let job = app.submit(&body).await;
        app.when(&job, |job| job["state"] != "queued").await;
        set(jump);
        let done = app.ended(&job).await;
        assert_eq!(done["state"], "succeeded", "after {jump} seconds: {done:#}");
        set(0);
    }
}

/// Writes to the existing file, because other processes have mapped it.
fn write_in_place(path: &Path, bytes: &[u8]) {
    use std::os::unix::fs::FileExt;
    std::fs::File::options().write(true).open(path).unwrap().write_all_at(bytes, 0).unwrap();
}
