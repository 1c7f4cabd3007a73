//! Issue 2: killing worker and server at ten random moments of a job changes nothing in the result.

use std::collections::BTreeMap;
use std::time::Duration;

use rand::{Rng, SeedableRng};
use serde_json::{Value, json};

use crate::app::TestApp;
use crate::samples::Scene;

/// Eight tiles in each of two snapshots, a good part of a second each.
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

/// The hashes of all result files but the manifests, which tell times and attempts.
async fn results(app: &TestApp, job: &str) -> BTreeMap<String, String> {
    let mut hashes = BTreeMap::new();
    for snapshot in 0..Scene::SMALL.snapshots {
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
    /// The processes of the workers, as the kernel has them.
    pub fn workers(&self) -> Vec<rustix::process::Pid> {
        let path = format!("/proc/{0}/task", self.pid());
        let threads = std::fs::read_dir(path).map(|entries| entries.flatten().collect());
        let threads: Vec<std::fs::DirEntry> = threads.unwrap_or_default();
        let children = threads
            .iter()
            .filter_map(|thread| std::fs::read_to_string(thread.path().join("children")).ok());
        let children = children.collect::<Vec<String>>().join(" ");
        let pids = children.split_whitespace().filter_map(|pid| pid.parse().ok());
        pids.filter_map(rustix::process::Pid::from_raw).collect()
    }

    /// SIGKILL for one worker.
    fn kill_worker(&self, choice: usize) {
        let workers = self.workers();
        if let Some(pid) = workers.get(choice % workers.len().max(1)) {
            // It may have ended meanwhile.
            let _ = rustix::process::kill_process(*pid, rustix::process::Signal::KILL);
        }
    }
}

#[tokio::test]
async fn kills_at_ten_random_moments_change_nothing_in_the_result() {
    const KILLS: u32 = 10;
    let mut app = TestApp::with(&["--workers", "2"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let undisturbed = app.submit(&job(&measurement)).await;
    assert_eq!(app.ended(&undisturbed).await["state"], "succeeded");
    let expected = results(&app, &undisturbed).await;
    assert_eq!(expected.len(), 2 * (4 + 4 + 2));

    let seed: u64 = rand::random();
    eprintln!("seed of the kills: {seed}");
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let disturbed = app.submit(&job(&measurement)).await;
    let mut while_running = 0;
    for kill in 0..KILLS {
        tokio::time::sleep(Duration::from_millis(random.random_range(50..900))).await;
        let state = app.get(&format!("/v1/jobs/{disturbed}")).await.json()["state"].clone();
        while_running += u32::from(state == "running" || state == "queued");
        if kill % 2 == 0 {
            app.kill_worker(random.random_range(0..2));
        } else {
            app.restart();
        }
    }
    let done = app.ended(&disturbed).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    eprintln!("{while_running} of {KILLS} kills fell into the job");
    assert!(while_running >= 5, "{while_running} kills fell into the job; it is too short");
    assert_eq!(results(&app, &disturbed).await, expected);
    for snapshot in 0..2 {
        let path = format!("/v1/jobs/{disturbed}/snapshots/{snapshot}/frames.npy");
        let bytes = app.get(&path).await.expect(200).bytes;
        let hash = sha256(&bytes);
        assert_eq!(
            hash,
            expected[&format!("{snapshot}/frames.npy")],
            "the bytes are those on record"
        );
    }
}

#[tokio::test]
async fn workers_end_with_a_server_that_was_killed() {
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
    assert!(start.elapsed().as_secs() < 15, "the lease need not run out first");
    assert_ne!(app.workers(), before);
    assert_eq!(app.ended(&job).await["state"], "succeeded");
}

fn sha256(bytes: &[u8]) -> String {
    use sha2::Digest;
    sha2::Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}
