//! Kills during calibrations, resumable uploads, jobs, deletions, backups and restored backups. At
//! the end, every acknowledged resource exists with its hash, and every deleted one does not.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use rand::{Rng, RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;
use reqwest::{Method, RequestBuilder, StatusCode};
use serde_json::{Value, json};

use crate::app::{Answer, TestApp};
use crate::calibration::Lab;
use crate::faults::{kills, orphans, results, sha256};
use crate::samples::Scene;

/// Everything that the service has acknowledged.
#[derive(Default)]
struct Ledger {
    /// Hashes and sizes of uploads.
    uploads: BTreeMap<String, usize>,
    calibrations: Vec<String>,
    jobs: BTreeSet<String>,
    deleted: BTreeSet<String>,
    /// Backups without an error.
    copies: Vec<PathBuf>,
    /// Number of started actions, by kind.
    started: BTreeMap<&'static str, u32>,
}

/// Sends a request. Returns `None` after an error of the connection.
async fn answer(request: RequestBuilder) -> Option<Answer> {
    let response = request.timeout(Duration::from_secs(30)).send().await.ok()?;
    let (status, headers) = (response.status(), response.headers().clone());
    Some(Answer { status, headers, bytes: response.bytes().await.ok()?.to_vec() })
}

fn job(measurement: &str) -> Value {
    json!({
        "measurement": measurement,
        "algorithm": "gap-tv",
        "tile": {"size": 32, "overlap": 8},
        "schedule": {"stages": [{"prior": "tv", "iterations": 300, "tv_weight": 0.05}]},
    })
}

fn tus(app: &TestApp, method: Method, path: &str) -> RequestBuilder {
    app.request(method, path).header("tus-resumable", "1.0.0")
}

/// Continues a resumable upload from its offset; true when it is stored.
async fn resume(app: &TestApp, path: &str, bytes: &[u8]) -> bool {
    loop {
        let Some(at) = answer(tus(app, Method::HEAD, path)).await else { return false };
        if at.status != StatusCode::OK {
            return false;
        }
        if !at.header("content-location").is_empty() {
            return true;
        }
        let offset: usize = at.header("upload-offset").parse().unwrap();
        let piece = bytes[offset..bytes.len().min(offset + 70_000)].to_vec();
        let request = tus(app, Method::PATCH, path)
            .header("upload-offset", offset)
            .header("content-type", "application/offset+octet-stream");
        if answer(request.body(piece)).await.is_none() {
            return false;
        }
    }
}

/// Sends SIGKILL to a process after a time.
fn kill_later(pid: u32, after: Duration) -> tokio::task::JoinHandle<()> {
    tokio::spawn(async move {
        tokio::time::sleep(after).await;
        if let Some(pid) = rustix::process::Pid::from_raw(pid.cast_signed()) {
            // The process may have ended already.
            let _ = rustix::process::kill_process(pid, rustix::process::Signal::KILL);
        }
    })
}

fn verify(data: &Path) -> Value {
    let output = Command::new(env!("CARGO_BIN_EXE_sci-recon"))
        .args(["verify", "--data"])
        .arg(data)
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{errors}"))
}

async fn prepared(app: &TestApp, calibration: &str) -> Option<String> {
    let query = "SELECT prepared FROM requests WHERE id = ?";
    let masks = sqlx::query_scalar(query).bind(calibration);
    masks.fetch_optional(&mut app.database().await).await.unwrap()
}

fn copy_of(from: &Path, to: &Path) {
    let status = Command::new("cp").arg("-a").arg(from).arg(to).status().unwrap();
    assert!(status.success());
}

#[tokio::test]
async fn random_kills_lose_and_change_nothing() {
    let rounds = kills();
    let seed: u64 = rand::random();
    eprintln!("seed of the storm: {seed}");
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let folder = tempfile::tempdir().unwrap();
    let mut app = TestApp::with(&["--workers", "2", "--max-jobs", "10000"]).await;
    // Computes the expected results without kills.
    let lab = Lab::new("");
    let captures = lab.send(&app).await;
    let undisturbed = app.calibrate_captures(&captures).await;
    assert_eq!(undisturbed["state"], "ready", "{undisturbed:#}");
    let masks = prepared(&app, undisturbed["id"].as_str().unwrap()).await.unwrap();
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let first = app.submit(&job(&measurement)).await;
    assert_eq!(app.ended(&first).await["state"], "succeeded");
    let expected = results(&app, &first).await;

    let mut ledger = Ledger { jobs: BTreeSet::from([first]), ..Ledger::default() };
    let (mut unsure, mut restored, mut wrong_copies) = (BTreeSet::new(), 0, 0);
    for round in 0..rounds {
        let pause = Duration::from_millis(random.random_range(1..700));
        let target = match random.random_range(0..3) {
            0 => app.workers().first().map(|pid| pid.as_raw_nonzero().get().cast_unsigned()),
            _ => Some(app.pid()),
        };
        let kind =
            ["calibration", "pieces", "job", "delete", "copy", "restore"][round as usize % 6];
        *ledger.started.entry(kind).or_default() += 1;
        let killing = match kind {
            "copy" | "restore" => None,
            _ => target.map(|pid| kill_later(pid, pause)),
        };
        match kind {
            "calibration" => {
                let body = json!({ "captures": captures });
                let accepted =
                    answer(app.request(Method::POST, "/v1/calibrations").json(&body)).await;
                if let Some(accepted) =
                    accepted.filter(|accepted| accepted.status == StatusCode::ACCEPTED)
                {
                    ledger.calibrations.push(accepted.json()["id"].as_str().unwrap().to_owned());
                }
                tokio::time::sleep(pause).await;
            }
            "pieces" => {
                let mut bytes = vec![0; random.random_range(100_000..400_000)];
                random.fill_bytes(&mut bytes);
                let begin =
                    tus(&app, Method::POST, "/v1/uploads").header("upload-length", bytes.len());
                if let Some(created) = answer(begin).await.filter(|created| created.status == 201) {
                    // Relative to the address of the request.
                    let path = format!("/v1/{}", created.header("location"));
                    while !resume(&app, &path, &bytes).await {
                        if !app.is_running() {
                            app.restart();
                        }
                    }
                    ledger.uploads.insert(sha256(&bytes), bytes.len());
                }
            }
            "job" => {
                let accepted = app.request(Method::POST, "/v1/jobs").json(&job(&measurement));
                if let Some(accepted) =
                    answer(accepted).await.filter(|accepted| accepted.status == 201)
                {
                    ledger.jobs.insert(accepted.json()["id"].as_str().unwrap().to_owned());
                }
                tokio::time::sleep(pause).await;
            }
            "delete" => {
                // Picks the oldest job, which may not have ended yet.
                let Some(victim) = ledger.jobs.first().cloned() else { continue };
                let request = app.request(Method::DELETE, &format!("/v1/jobs/{victim}"));
                match answer(request).await.map(|answer| answer.status.as_u16()) {
                    Some(204 | 404) => {
                        ledger.jobs.remove(&victim);
                        ledger.deleted.insert(victim);
                    }
                    Some(_) => {}
                    None => {
                        ledger.jobs.remove(&victim);
                        unsure.insert(victim);
                    }
                }
            }
            "copy" => {
                let out = folder.path().join(format!("copy-{round}"));
                let mut backup = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
                backup.args(["backup", "--data"]).arg(app.data()).arg("--out").arg(&out);
                let mut child = backup.stdout(Stdio::null()).spawn().unwrap();
                // In some rounds, another process is killed instead.
                let pid = if round % 12 == 4 { child.id() } else { target.unwrap_or(app.pid()) };
                kill_later(pid, pause / 4).await.unwrap();
                let ended = child.wait().unwrap().success();
                assert!(out.exists() || !ended, "a successful backup exists");
                // A backup under its final name is complete, even if the program was killed before
                // its report.
                if out.exists() {
                    ledger.copies.push(out);
                }
            }
            _ => {
                let Some(copy) = ledger.copies.last() else { continue };
                let copy_folder = tempfile::tempdir().unwrap();
                copy_of(copy, &copy_folder.path().join("data"));
                let mut other = TestApp::on(copy_folder, "data", &["--workers", "1"]).await;
                kill_later(other.pid(), pause).await.unwrap();
                other.restart();
                let report = verify(other.data());
                let bad = report["damaged"] != json!([]) || report["missing"] != json!([]);
                wrong_copies += u32::from(bad);
                let list = other.get("/v1/jobs?state=succeeded&limit=200").await.expect(200).json();
                for item in list["items"].as_array().unwrap() {
                    let id = item["id"].as_str().unwrap();
                    wrong_copies += u32::from(results(&other, id).await != expected);
                }
                restored += 1;
            }
        }
        if let Some(killing) = killing {
            killing.await.unwrap();
        }
        // A dying process may still look alive.
        tokio::time::sleep(Duration::from_millis(20)).await;
        while answer(app.request(Method::GET, "/livez")).await.is_none() {
            if !app.is_running() {
                app.restart();
            }
        }
    }

    let (mut lost, mut wrong, mut back) = (0u32, 0u32, 0u32);
    for job in &ledger.jobs {
        let done = app.ended(job).await;
        lost += u32::from(done["state"] != "succeeded");
        wrong += u32::from(results(&app, job).await != expected);
    }
    for calibration in &ledger.calibrations {
        let start = Instant::now();
        while prepared(&app, calibration).await.is_none() && start.elapsed().as_secs() < 120 {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        match prepared(&app, calibration).await {
            None => lost += 1,
            Some(prepared) => wrong += u32::from(prepared != masks),
        }
    }
    for (hash, size) in &ledger.uploads {
        let blob = app.get(&format!("/v1/blobs/{hash}")).await;
        lost += u32::from(blob.status != 200 || blob.json()["size"] != *size);
        let file = std::fs::read(app.data().join("blobs").join(&hash[..2]).join(&hash[2..]));
        wrong += u32::from(file.map_or(true, |bytes| sha256(&bytes) != *hash));
    }
    for job in &ledger.deleted {
        let absent = app.get(&format!("/v1/jobs/{job}")).await.status == 404;
        back += u32::from(!absent || app.data().join("results").join(job).exists());
    }
    // After a deletion without an answer, everything or nothing exists.
    for job in &unsure {
        let exists = app.get(&format!("/v1/jobs/{job}")).await.status == 200;
        let files = app.data().join("results").join(job).exists();
        wrong += u32::from(files && !exists);
    }
    for copy in &ledger.copies {
        let report = verify(copy);
        wrong_copies += u32::from(report["damaged"] != json!([]) || report["missing"] != json!([]));
    }
    let orphan_count = orphans(&mut app).await;
    let report = verify(app.data());
    let quarantined = app.data().join("quarantine");
    let ok = lost + wrong + back + wrong_copies == 0
        && orphan_count == 0
        && report["missing"] == json!([])
        && report["damaged"] == json!([])
        // The running totals, too.
        && report["database"] == "ok";
    println!(
        "{}",
        json!({"target": "storm", "ok": ok, "kills": rounds, "begun": ledger.started,
               "uploads": ledger.uploads.len(), "calibrations": ledger.calibrations.len(),
               "jobs": ledger.jobs.len(), "deleted": ledger.deleted.len(),
               "copies": ledger.copies.len(), "restored": restored, "lost": lost, "wrong": wrong,
               "back": back, "wrong_copies": wrong_copies, "left": orphan_count, "found": report,
               "quarantine": quarantined.exists(), "seed": seed})
    );
    assert!(ok);
}
