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
