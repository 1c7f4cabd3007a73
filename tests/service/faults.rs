//! Killing workers and servers at random moments loses no job and changes no result.

use std::collections::BTreeMap;
use std::time::Duration;

use rand::{RngExt, SeedableRng};
use serde_json::{Value, json};

use crate::app::TestApp;
use crate::samples::Scene;

/// A job with eight tiles in each of two snapshots. Each tile takes a large part of a second.
fn job(measurement: &str) -> Value {
    json!({
        "measurement": measurement,
        "algorithm": "gap-tv",
        "tile": {"size": 24, "overlap": 8},
        "schedule": {"stages": [
            {"prior": "tv", "iterations": 4000, "tv_weight": 0.05, "tv_updates": 20},
        ]},
    })
}

/// Hashes of all result files except the manifests, which contain times and attempts.
pub async fn results(app: &TestApp, job: &str) -> BTreeMap<String, String> {
    results_of(app, job, Scene::SMALL.snapshots).await
}

/// Hashes of the result files of a job with `snapshots` snapshots.
pub async fn results_of(app: &TestApp, job: &str, snapshots: usize) -> BTreeMap<String, String> {
    let mut hashes = BTreeMap::new();
    for snapshot in 0..snapshots {
        let listed =
            app.get(&format!("/v1/jobs/{job}/snapshots/{snapshot}")).await.expect(200).json();
        for file in listed["files"].as_array().unwrap() {
            let name = file["name"].as_str().unwrap();
            if name != "manifest.json" {
                let hash = file["sha256"].as_str().unwrap().to_owned();
                hashes.insert(format!("{snapshot}/{name}"), hash);
            }
        }
    }
    hashes
}

impl TestApp {
    /// Process identifiers of the workers, from the kernel.
    pub fn workers(&self) -> Vec<rustix::process::Pid> {
        children(self.pid()).into_iter().filter(|pid| !is_light(*pid)).collect()
    }

    /// The worker that takes short tasks alone, once it runs.
    pub fn light_worker(&self) -> Option<rustix::process::Pid> {
        children(self.pid()).into_iter().find(|pid| is_light(*pid))
    }

    /// Ends the server and its workers at once, so that none of them tidies up.
    pub fn cut_power(&mut self) {
        let workers = children(self.pid());
        let send = |signal| {
            for pid in &workers {
                // The process may have ended already.
                let _ = rustix::process::kill_process(*pid, signal);
            }
        };
        send(rustix::process::Signal::STOP);
        self.kill();
        send(rustix::process::Signal::KILL);
    }

    /// Sends SIGKILL to one worker.
    pub fn kill_worker(&self, choice: usize) {
        let workers = self.workers();
        if let Some(pid) = workers.get(choice % workers.len().max(1)) {
            // The process may have ended already.
            let _ = rustix::process::kill_process(*pid, rustix::process::Signal::KILL);
        }
    }
}

fn is_light(pid: rustix::process::Pid) -> bool {
    let line = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
    line.split(|byte| *byte == 0).any(|word| word == b"light")
}

/// Child processes of a process, from the kernel.
pub fn children(process: u32) -> Vec<rustix::process::Pid> {
    let threads = std::fs::read_dir(format!("/proc/{process}/task"));
    let threads: Vec<_> = threads.map(|entries| entries.flatten().collect()).unwrap_or_default();
    let children = threads
        .iter()
        .filter_map(|thread| std::fs::read_to_string(thread.path().join("children")).ok());
    let children = children.collect::<Vec<String>>().join(" ");
    let pids = children.split_whitespace().filter_map(|pid| pid.parse().ok());
    pids.filter_map(rustix::process::Pid::from_raw).collect()
}

/// Number of kills: `SCI_RECON_KILLS`.
pub fn kills() -> u32 {
    std::env::var("SCI_RECON_KILLS").map_or(10, |text| text.parse().unwrap())
}

#[tokio::test]
async fn random_kills_change_no_result() {
    let kills = kills();
    let mut app = TestApp::with(&["--workers", "2"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let undisturbed = app.submit(&job(&measurement)).await;
    assert_eq!(app.ended(&undisturbed).await["state"], "succeeded");
    let expected = results(&app, &undisturbed).await;
    assert_eq!(expected.len(), 2 * (4 + 4 + 3));

    let seed: u64 = rand::random();
    eprintln!("seed of the kills: {seed}");
    let mut random = rand::rngs::ChaCha8Rng::seed_from_u64(seed);
    let mut jobs = vec![app.submit(&job(&measurement)).await];
    let (mut servers, mut while_running) = (0, 0);
    for kill in 0..kills {
        tokio::time::sleep(Duration::from_millis(random.random_range(20..900))).await;
        let last = jobs.last().unwrap();
        let state = app.get(&format!("/v1/jobs/{last}")).await.json()["state"].clone();
        if state == "running" || state == "queued" {
            while_running += 1;
        } else {
            jobs.push(app.submit(&job(&measurement)).await);
        }
        if kill % 2 == 0 {
            app.kill_worker(random.random_range(0..2));
        } else {
            servers += 1;
            app.restart();
        }
    }
    let (mut lost, mut wrong) = (0, 0);
    for job in &jobs {
        let done = app.ended(job).await;
        if done["state"] != "succeeded" {
            eprintln!("{done:#}");
            lost += 1;
        } else if results(&app, job).await != expected || !downloads(&app, job, &expected).await {
            wrong += 1;
        }
    }
    let orphans = orphans(&mut app).await;
    let jobs = jobs.len();
    let ok = lost + wrong + orphans == 0 && while_running >= kills / 2;
    println!(
        "{}",
        json!({"target": "faults", "ok": ok, "kills": kills, "of_servers": servers,
               "while_a_job_ran": while_running, "jobs": jobs, "lost_jobs": lost,
               "wrong_results": wrong, "orphans": orphans, "seed": seed})
    );
    assert!(ok);
}

/// True if all downloads have the expected bytes.
async fn downloads(app: &TestApp, job: &str, expected: &BTreeMap<String, String>) -> bool {
    for snapshot in 0..Scene::SMALL.snapshots {
        let path = format!("/v1/jobs/{job}/snapshots/{snapshot}/exports/npy");
        let bytes = app.get(&path).await.expect(200).bytes;
        if sha256(&bytes) != expected[&format!("{snapshot}/frames.npy")] {
            return false;
        }
    }
    true
}

/// Number of unknown files after the cleanup at a server's start: temporary files, surplus blobs,
/// and results without a job.
pub async fn orphans(app: &mut TestApp) -> usize {
    // The cleanup spares files younger than ten seconds, which may be in use.
    tokio::time::sleep(Duration::from_secs(11)).await;
    app.restart();
    let app = &*app;
    let count = |folder: &str| {
        let mut folders = vec![app.data().join(folder)];
        let mut files = 0usize;
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                if path.is_dir() { folders.push(path) } else { files += 1 }
            }
        }
        files
    };
    let start = std::time::Instant::now();
    loop {
        let text = String::from_utf8(app.get("/metrics").await.expect(200).bytes).unwrap();
        let line = text.lines().find_map(|line| line.strip_prefix("sci_recon_blobs ")).unwrap();
        let known: usize = line.parse().unwrap();
        let jobs = app.get("/v1/jobs?limit=200").await.json()["items"].as_array().unwrap().len();
        let results = std::fs::read_dir(app.data().join("results")).unwrap().count();
        let results = results.saturating_sub(jobs);
        // A creation that was killed before its answer may leave an upload, which stays resumable.
        let uploads =
            app.get("/v1/uploads?limit=200").await.json()["items"].as_array().unwrap().clone();
        let unfinished = uploads.iter().filter(|upload| upload["sha256"].is_null()).count();
        let partial = count("partial").abs_diff(unfinished);
        let surplus = count("blobs").abs_diff(known) + results + partial + count("tmp");
        if surplus > 0 && start.elapsed().as_secs() > 10 {
            let found = ["results", "partial", "tmp"].map(|folder| {
                let entries = std::fs::read_dir(app.data().join(folder)).unwrap();
                entries.map(|entry| entry.unwrap().path()).collect::<Vec<_>>()
            });
            eprintln!("{known} blobs are known, {} exist; {jobs} jobs; {found:#?}", count("blobs"));
            return surplus;
        }
        if surplus == 0 {
            return 0;
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

#[tokio::test]
async fn workers_end_with_a_killed_server() {
    let mut app = TestApp::with(&["--workers", "2"]).await;
    let start = std::time::Instant::now();
    while app.workers().len() < 2 {
        assert!(start.elapsed().as_secs() < 60, "two workers should run");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    let workers = app.workers();
    app.kill();
    let lives = |pid: &rustix::process::Pid| {
        std::fs::read_to_string(format!("/proc/{pid}/stat"))
            .is_ok_and(|stat| !stat.contains(") Z "))
    };
    let start = std::time::Instant::now();
    while workers.iter().any(lives) {
        assert!(start.elapsed().as_secs() < 60, "a worker outlives its server");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

#[tokio::test]
async fn a_killed_worker_is_replaced_and_its_task_taken_up_at_once() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let job = app.submit(&job(&measurement)).await;
    app.when(&job, |job| job["progress"]["tiles_running"] == 1).await;
    let before = app.workers();
    app.kill_worker(0);
    app.when(&job, |job| job["progress"]["tiles_running"] == 0).await;
    let start = std::time::Instant::now();
    app.when(&job, |job| job["progress"]["tiles_running"] == 1).await;
    assert!(start.elapsed().as_secs() < 15, "the task is taken up before its lease expires");
    assert_ne!(app.workers(), before);
    assert_eq!(app.ended(&job).await["state"], "succeeded");
}

pub fn sha256(bytes: &[u8]) -> String {
    use sha2::Digest;
    sha2::Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}
