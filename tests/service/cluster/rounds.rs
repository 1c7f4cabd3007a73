//! `make cluster`: jobs while workers, servers, message servers, network and files fail at random
//! moments. A short version runs with all tests.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::{Duration, Instant};

use rand::rngs::ChaCha8Rng;
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rustix::process::Signal;
use serde_json::{Value, json};

use super::nodes::{Nats, RemoteWorker};
use super::proxy::Proxy;
use super::{figure, workers};
use crate::app::{TestApp, has_onnxruntime};
use crate::samples::Scene;

/// Limits in bytes of a worker's cache and of its resident memory.
const CACHE: u64 = 24 << 20;
const MEMORY: u64 = 1 << 30;

/// The job and its faults. In `make cluster` a tile takes about five seconds, in all tests one
/// second.
#[derive(Debug, Clone, Copy)]
struct Plan {
    scene: Scene,
    tile: u32,
    /// Iterations of gap-tv; none for the default algorithm and schedule.
    iterations: Option<u32>,
    /// Seconds of silence after which a tile is redelivered.
    ack_wait: u64,
    /// Duration of a worker's suspension or isolation, of a lost quorum, and of the leader's
    /// failure.
    silence: Duration,
    no_quorum: Duration,
    leaderless: Duration,
    /// Longest pause before a fault in milliseconds.
    pause: u64,
    /// Longest duration of a round.
    limit: Duration,
}

impl Plan {
    const LONG: Self = Self {
        scene: Scene { frames: 8, height: 1280, width: 1280, snapshots: 1 },
        tile: 288,
        iterations: Some(60),
        ack_wait: 5,
        silence: Duration::from_secs(9),
        no_quorum: Duration::from_secs(12),
        leaderless: Duration::from_secs(2),
        pause: 2500,
        limit: Duration::from_secs(900),
    };
    const SHORT: Self = Self {
        scene: Scene { frames: 8, height: 320, width: 320, snapshots: 1 },
        tile: 96,
        iterations: Some(100),
        ack_wait: 2,
        silence: Duration::from_secs(4),
        no_quorum: Duration::from_secs(7),
        leaderless: Duration::from_secs(1),
        pause: 800,
        limit: Duration::from_secs(300),
    };

    /// The default algorithm.
    const DEEP: Self = Self {
        scene: Scene { frames: 8, height: 512, width: 512, snapshots: 1 },
        tile: 144,
        iterations: None,
        ..Self::LONG
    };

    fn job(&self, measurement: &str) -> Value {
        let mut job = json!({
            "measurement": measurement,
            "algorithm": "pnp-tv-fastdvdnet",
            "tile": {"size": self.tile, "overlap": 16},
        });
        if let Some(iterations) = self.iterations {
            job["algorithm"] = json!("gap-tv");
            job["schedule"] = json!({"stages": [
                {"prior": "tv", "iterations": iterations, "tv_weight": 0.05, "tv_updates": 40},
            ]});
        }
        job
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Fault {
    WorkerKilled,
    LeaderKilled,
    ServerKilled,
    WorkerSuspended,
    QuorumLost,
    ConnectionFrozen,
    DiskWiped,
    InputCorrupted,
    OutputCorrupted,
}

impl Fault {
    const ALL: [Self; 9] = [
        Self::WorkerKilled,
        Self::LeaderKilled,
        Self::ServerKilled,
        Self::WorkerSuspended,
        Self::QuorumLost,
        Self::ConnectionFrozen,
        Self::DiskWiped,
        Self::InputCorrupted,
        Self::OutputCorrupted,
    ];
}

/// A running cluster, and its counters and random numbers.
struct Ground {
    plan: Plan,
    app: TestApp,
    nats: Nats,
    workers: Vec<RemoteWorker>,
    /// Stands between the first worker and the message server.
    proxy: Proxy,
    credential: std::path::PathBuf,
    random: ChaCha8Rng,
    counts: BTreeMap<&'static str, f64>,
    peak: u64,
}

impl Ground {
    async fn start(plan: Plan, nodes: usize, delay: Duration, seed: u64) -> Option<Self> {
        let nats = Nats::secured(nodes, &["--no-tls"])?;
        let app = TestApp::with(&[
            "--workers",
            "0",
            "--nats-creds",
            nats.hub().to_str().unwrap(),
            "--nats",
            &nats.url(),
            "--ack-wait",
            &plan.ack_wait.to_string(),
            "--verify-fraction",
            "0.1",
        ])
        .await;
        let credential = nats.credential("test");
        let proxy = Proxy::start(nats.ports[0], delay);
        let random = ChaCha8Rng::seed_from_u64(seed);
        let (workers, counts, peak) = (Vec::new(), BTreeMap::new(), 0);
        let mut ground = Self { plan, app, nats, workers, proxy, credential, random, counts, peak };
        let slow = !delay.is_zero();
        for n in 0..4 {
            let worker = ground.worker(n == 0 || slow);
            ground.workers.push(worker);
        }
        Some(ground)
    }

    fn worker(&self, by_proxy: bool) -> RemoteWorker {
        let url = match by_proxy {
            true => format!("nats://127.0.0.1:{}", self.proxy.port),
            false => self.nats.url(),
        };
        let cache = CACHE.to_string();
        RemoteWorker::with_credential(&self.credential, &["--nats", &url, "--cache-bytes", &cache])
    }

    /// Compares the workers' cache and memory with their limits.
    fn check_limits(&mut self) {
        for worker in &self.workers {
            let cached = worker.cached();
            assert!(cached <= CACHE, "a cache holds {cached} bytes");
            let memory = worker.peak_memory();
            assert!(memory < MEMORY, "a worker has {memory} bytes resident");
            self.peak = self.peak.max(memory);
        }
    }

    /// Reads the metrics of a server before its end.
    async fn record_metrics(&mut self) {
        for name in ["redelivered", "refused", "repaired"] {
            let value = figure(&self.app, &format!("sci_recon_cluster_{name}_total")).await;
            *self.counts.entry(name).or_default() += value;
        }
    }

    async fn inject(&mut self, fault: Fault) {
        let pick = self.random.random_range(0..self.workers.len());
        let nodes = self.nats.nodes.len();
        match fault {
            Fault::WorkerKilled => {
                self.workers[pick].kill();
                self.workers[pick] = self.worker(false);
            }
            Fault::LeaderKilled => {
                let leader = self.nats.leader().await;
                self.nats.end(leader);
                tokio::time::sleep(self.plan.leaderless).await;
                self.nats.begin(leader);
            }
            Fault::ServerKilled => {
                self.record_metrics().await;
                self.app.restart();
            }
            Fault::WorkerSuspended => {
                self.workers[pick].signal(Signal::STOP);
                tokio::time::sleep(self.plan.silence).await;
                self.workers[pick].signal(Signal::CONT);
            }
            Fault::QuorumLost => {
                let first = self.random.random_range(0..nodes);
                let lost: Vec<usize> = (0..nodes.min(2)).map(|n| (first + n) % nodes).collect();
                lost.iter().for_each(|n| self.nats.signal(*n, Signal::STOP));
                tokio::time::sleep(self.plan.no_quorum).await;
                lost.iter().for_each(|n| self.nats.signal(*n, Signal::CONT));
            }
            Fault::ConnectionFrozen => {
                self.proxy.freeze(true);
                tokio::time::sleep(self.plan.silence).await;
                self.proxy.freeze(false);
            }
            Fault::DiskWiped => {
                let node = self.random.random_range(0..nodes);
                self.nats.end(node);
                self.nats.wipe(node);
                self.nats.begin(node);
                // The cluster must be complete again before the next fault.
                tokio::time::sleep(Duration::from_secs(if nodes > 1 { 5 } else { 0 })).await;
            }
            Fault::InputCorrupted => self.nats.corrupt("SCI_IN").await,
            Fault::OutputCorrupted => self.nats.corrupt("SCI_OUT").await,
        }
    }

    /// Runs one job with all faults at random moments.
    async fn round(&mut self, measurement: &str, faults: &[Fault]) -> String {
        let start = Instant::now();
        let id = self.app.submit(&self.plan.job(measurement)).await;
        let mut order = faults.to_vec();
        order.shuffle(&mut self.random);
        for fault in order {
            let pause = self.random.random_range(200..self.plan.pause);
            tokio::time::sleep(Duration::from_millis(pause)).await;
            let state = self.app.get(&format!("/v1/jobs/{id}")).await.expect(200).json();
            if state["state"] == "succeeded" {
                break;
            }
            eprintln!("{:6.1} s: {fault:?}", start.elapsed().as_secs_f64());
            self.inject(fault).await;
            *self.counts.entry("faults").or_default() += 1.0;
            self.check_limits();
        }
        loop {
            let job = self.app.get(&format!("/v1/jobs/{id}")).await.expect(200).json();
            match job["state"].as_str().unwrap() {
                "succeeded" => break,
                "failed" | "cancelled" => panic!("{job:#}"),
                _ => assert!(
                    start.elapsed() < self.plan.limit,
                    "{job:#}\n{:#?}\n{}",
                    workers(&self.app).await,
                    self.nats.state().await
                ),
            }
            self.check_limits();
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
        id
    }
}

/// Number of rounds from `SCI_RECON_CLUSTER_ROUNDS`; none in the short version.
pub fn rounds() -> Option<u32> {
    std::env::var("SCI_RECON_CLUSTER_ROUNDS").ok().map(|text| text.parse().unwrap())
}

/// The hashes of all frames.
async fn frames(app: &TestApp, job: &str) -> BTreeMap<String, String> {
    let listed = app.get(&format!("/v1/jobs/{job}/snapshots/0")).await.expect(200).json();
    let files = listed["files"].as_array().unwrap().iter();
    let text = |value: &Value| value.as_str().unwrap().to_owned();
    let hashes = files.map(|file| (text(&file["name"]), text(&file["sha256"])));
    hashes.filter(|(name, _)| name != "manifest.json").collect()
}

async fn local(plan: &Plan) -> BTreeMap<String, String> {
    let app = TestApp::with(&["--workers", "2"]).await;
    let (_, measurement) = app.scene(&plan.scene).await;
    let job = app.submit(&plan.job(&measurement)).await;
    let start = Instant::now();
    while app.get(&format!("/v1/jobs/{job}")).await.json()["state"] != "succeeded" {
        assert!(start.elapsed() < plan.limit, "the local job takes too long");
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    frames(&app, &job).await
}

/// Opens the service's database for reading.
pub async fn database(data: &Path) -> sqlx::SqliteConnection {
    use sqlx::Connection;
    let path = data.join("sci-recon.db");
    let options = sqlx::sqlite::SqliteConnectOptions::new().filename(path).read_only(true);
    sqlx::SqliteConnection::connect_with(&options).await.unwrap()
}

/// Number of tiles that were accepted so far, and number of tiles of a job.
async fn accepted_tiles(data: &Path, job: &str) -> (i64, i64) {
    use sqlx::Row;
    let mut connection = database(data).await;
    let row = sqlx::query(
        "SELECT coalesce((SELECT tasks FROM totals WHERE kind = 'tile'), 0) AS accepted,
             (SELECT count(*) FROM tasks WHERE job = ? AND kind = 'tile') AS planned",
    )
    .bind(job)
    .fetch_one(&mut connection)
    .await
    .unwrap();
    (row.get("accepted"), row.get("planned"))
}

async fn rounds_of(name: &str, nodes: usize, delay: Duration, count: u32, faults: &[Fault]) {
    let plan = if rounds().is_some() { Plan::LONG } else { Plan::SHORT };
    rounds_by(plan, name, (nodes, delay), count, faults).await;
}

async fn rounds_by(
    plan: Plan,
    name: &str,
    (nodes, delay): (usize, Duration),
    count: u32,
    faults: &[Fault],
) {
    let seed: u64 = rand::random();
    eprintln!("{name}: seed {seed}");
    let Some(mut ground) = Ground::start(plan, nodes, delay, seed).await else { return };
    let expected = local(&plan).await;
    let (_, measurement) = ground.app.scene(&plan.scene).await;
    let (start, mut wrong, mut twice) = (Instant::now(), 0, 0);
    for round in 1..=count {
        let (before, _) = accepted_tiles(ground.app.data(), "").await;
        let job = ground.round(&measurement, faults).await;
        wrong += u32::from(frames(&ground.app, &job).await != expected);
        let (after, planned) = accepted_tiles(ground.app.data(), &job).await;
        twice += (after - before - planned).abs();
        ground.nats.emptied().await;
        eprintln!("{name}: round {round} of {count} after {:?}", start.elapsed());
    }
    ground.record_metrics().await;
    let ok = wrong == 0 && twice == 0;
    let line = json!({
        "target": name, "ok": ok, "rounds": count, "nodes": nodes, "delay_ms": delay.as_millis() as u64,
        "wrong_results": wrong, "tiles_not_accepted_once": twice,
        "faults": ground.counts.get("faults"), "redelivered": ground.counts["redelivered"],
        "refused": ground.counts["refused"], "repaired": ground.counts["repaired"],
        "peak_worker_mib": ground.peak >> 20, "seconds": start.elapsed().as_secs(), "seed": seed,
    });
    println!("{line}");
    assert!(ok, "{line}");
}

#[tokio::test]
async fn faults_of_all_kinds_change_nothing_with_three_nodes() {
    rounds_of("cluster", 3, Duration::ZERO, rounds().unwrap_or(1), &Fault::ALL).await;
}

#[tokio::test]
#[ignore = "part of `make cluster`"]
async fn faults_of_all_kinds_change_nothing_in_the_default_schedule() {
    if !has_onnxruntime() {
        return;
    }
    rounds_by(Plan::DEEP, "cluster_deep", (3, Duration::ZERO), 1, &Fault::ALL).await;
}

#[tokio::test]
#[ignore = "part of `make cluster`"]
async fn faults_of_all_kinds_change_nothing_with_one_node() {
    let count = rounds().map_or(1, |count| count.div_ceil(4));
    rounds_of("cluster_one_node", 1, Duration::ZERO, count, &Fault::ALL).await;
}

#[tokio::test]
#[ignore = "part of `make cluster`"]
async fn faults_of_all_kinds_change_nothing_over_a_slow_network() {
    let count = rounds().map_or(1, |count| count.div_ceil(4));
    rounds_of("cluster_delay", 1, Duration::from_millis(25), count, &Fault::ALL).await;
}
