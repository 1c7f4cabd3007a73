//! The cost of handing tiles over, and its limits. Simulated workers speak the whole protocol, each
//! over one connection. They sleep in place of computing and send a tile's masks as its frames, so
//! that only hub, store and message server are measured.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use async_nats::Client;
use async_nats::jetstream::{AckKind, Context, Message};
use futures_util::StreamExt;
use serde_json::{Value, json};
use sqlx::Row;

use super::nodes::{Nats, RemoteWorker};
use super::rounds::{database, rounds};
use super::{served, until, with_iterations, worker};
use crate::app::{TestApp, has_onnxruntime};
use crate::samples::Scene;

/// Time for which a simulated worker waits for an answer.
const ANSWER: Duration = Duration::from_secs(5);

/// CPU seconds of a process and its ended children.
fn cpu(pid: u32) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    let (_, fields) = stat.rsplit_once(')').unwrap_or_default();
    // utime, stime, cutime, cstime: proc(5).
    let ticks = fields.split_whitespace().skip(11).take(4);
    let ticks: f64 = ticks.map(|field| field.parse::<f64>().unwrap_or(0.0)).sum();
    ticks / rustix::param::clock_ticks_per_second() as f64
}

/// CPU seconds of the server and the message server, which hand tiles over.
fn handing_over(app: &TestApp, nats: &Nats) -> (f64, f64) {
    (cpu(app.pid()), nats.nodes.iter().flatten().map(|node| cpu(node.id())).sum())
}

/// State that all simulated workers share.
#[derive(Default)]
struct Crowd {
    url: String,
    /// The greeting of a real worker, and its report of a tile.
    program: Value,
    end: Value,
    /// Duration of a tile.
    length: Mutex<Duration>,
    stop: AtomicBool,
    /// Requests without an answer in time.
    late: AtomicU64,
    done: AtomicU64,
    /// Times between the end of a tile and the start of the next.
    pauses: Mutex<Vec<Duration>>,
}

struct Simulated {
    crowd: Arc<Crowd>,
    client: Client,
    context: Context,
    id: String,
}

impl Crowd {
    /// Records the messages of a real worker.
    async fn learn(nats: &Nats, app: &TestApp) -> Self {
        let client = nats.client().await;
        let mut hellos = client.subscribe("sci.v1.hello.test").await.unwrap();
        let mut events = client.subscribe("sci.v1.event.test").await.unwrap();
        client.flush().await.unwrap();
        let mut model = worker(nats, &[]);
        let (_, measurement) = app.scene(&scene(4)).await;
        let job = app.submit(&with_iterations(&measurement, 1)).await;
        let read = |message: async_nats::Message| -> Value {
            serde_json::from_slice(&message.payload).unwrap()
        };
        let program = read(hellos.next().await.unwrap())["program"].clone();
        let end = read(events.next().await.unwrap())["end"]["done"].clone();
        assert_eq!(app.ended(&job).await["state"], "succeeded");
        model.process.signal(rustix::process::Signal::TERM);
        model.process.ended(Duration::from_secs(10));
        Self { url: nats.url(), program, end, ..Self::default() }
    }

    async fn enter(self: Arc<Self>) {
        let client = async_nats::connect(&self.url).await.unwrap();
        let context = async_nats::jetstream::new(client.clone());
        let id = uuid::Uuid::now_v7().to_string();
        let worker = Simulated { crowd: self, client, context, id };
        worker.work().await;
    }
}

impl Simulated {
    fn stopped(&self) -> bool {
        self.crowd.stop.load(Ordering::Relaxed)
    }

    async fn say(&self, what: &str, message: Value) {
        self.client
            .publish(format!("sci.v1.{what}.test"), message.to_string().into())
            .await
            .unwrap();
    }

    /// Repeats a request until it is answered in time, and counts the failures.
    async fn in_time<T, E, F>(&self, mut what: impl FnMut() -> F) -> T
    where
        F: Future<Output = Result<T, E>>,
    {
        loop {
            if let Ok(Ok(answer)) = tokio::time::timeout(ANSWER, what()).await {
                return answer;
            }
            self.crowd.late.fetch_add(1, Ordering::Relaxed);
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
    }

    async fn ask(&self, what: &str, message: &Value) -> Value {
        let subject = format!("sci.v1.{what}.test");
        let answer =
            self.in_time(|| self.client.request(subject.clone(), message.to_string().into())).await;
        serde_json::from_slice(&answer.payload).unwrap()
    }

    async fn work(self) {
        let _subscription =
            self.client.subscribe(format!("sci.v1.tell.test.{}", self.id)).await.unwrap();
        let hello = json!({"worker": self.id, "host": "simulated", "pid": 1, "device": "none",
            "program": self.crowd.program});
        let welcome = self.ask("hello", &hello).await;
        let ack_wait = Duration::from_millis(welcome["welcome"]["ack_wait_ms"].as_u64().unwrap());
        let idle = json!({"worker": self.id, "tile": null, "leaves": false});
        let (mut signed, mut free) = (Instant::now(), None);
        while !self.stopped() {
            // Like a worker, request one tile at a time in rounds of five seconds.
            let consumer = self
                .in_time(|| {
                    self.context.get_consumer_from_stream::<
                        async_nats::jetstream::consumer::pull::Config, _, _>("test", "SCI_TASKS")
                })
                .await;
            let pulled = async {
                let batch = consumer.batch().max_messages(1).expires(Duration::from_secs(5));
                batch.messages().await.ok()?.next().await?.ok()
            };
            let pulled_message =
                tokio::time::timeout(Duration::from_secs(6), pulled).await.ok().flatten();
            if signed.elapsed() > Duration::from_secs(5) {
                self.say("beat", idle.clone()).await;
                signed = Instant::now();
            }
            let Some(message) = pulled_message else { continue };
            if self.tile(&message, ack_wait, free).await {
                free = Some(Instant::now());
                self.crowd.done.fetch_add(1, Ordering::Relaxed);
            }
        }
        self.say("beat", json!({"worker": self.id, "tile": null, "leaves": true})).await;
        self.client.flush().await.unwrap();
    }

    /// Computes a tile; false if the message was not usable.
    async fn tile(&self, message: &Message, ack_wait: Duration, free: Option<Instant>) -> bool {
        let task: Value = serde_json::from_slice(&message.payload).unwrap();
        let (seq, delivery) = {
            let info = message.info().unwrap();
            (info.stream_sequence, info.delivered)
        };
        let begin = json!({"task": task["task"], "attempt": task["attempt"], "seq": seq,
            "delivery": delivery, "worker": self.id});
        let answer = self.ask("begin", &begin).await;
        let Some(attempt) = answer["go"].as_u64() else {
            if answer == "over" {
                let _ = message.double_ack().await;
            }
            return false;
        };
        if let Some(free) = free {
            self.crowd.pauses.lock().unwrap().push(free.elapsed());
        }
        let masks = self.input(&task["masks"]).await;
        let snapshots = self.input(&task["snapshots"]).await;
        let start = Instant::now();
        let (mut reported, mut kept) = (start, start);
        let length = *self.crowd.length.lock().unwrap();
        while start.elapsed() < length {
            let remaining = length.saturating_sub(start.elapsed());
            tokio::time::sleep(remaining.min(Duration::from_millis(500))).await;
            if reported.elapsed() > Duration::from_secs(1) {
                let tile = json!({"task": task["task"], "attempt": attempt,
                    "progress": self.crowd.end["progress"], "history": null});
                self.say("beat", json!({"worker": self.id, "tile": tile, "leaves": false})).await;
                reported = Instant::now();
            }
            if kept.elapsed() > ack_wait / 6 {
                self.in_time(|| message.double_ack_with(AckKind::Progress)).await;
                kept = Instant::now();
            }
        }
        let (id, worker) = (task["task"].as_str().unwrap(), &self.id);
        let subject = format!("sci.v1.out.test.{id}.{attempt}.{worker}.0");
        let mut end = self.crowd.end.clone();
        end["record"]["residual"] = json!(residual(&masks, &masks, &snapshots));
        self.stored(subject, masks).await;
        end["frames"] = task["masks"].clone();
        end["history"] = Value::Null;
        let event = json!({"task": id, "attempt": attempt, "worker": worker, "end": {"done": end}});
        self.stored("sci.v1.event.test".into(), event.to_string().into()).await;
        self.in_time(|| message.double_ack()).await;
        true
    }

    /// Publishes to a stream.
    async fn stored(&self, subject: String, bytes: bytes::Bytes) {
        self.in_time(|| async {
            let sent = self.context.publish(subject.clone(), bytes.clone()).await;
            sent.map_err(|_| ())?.await.map_err(|_| ())
        })
        .await;
    }

    /// A small input that fits in one chunk.
    async fn input(&self, input: &Value) -> bytes::Bytes {
        let subject = format!("sci.v1.in.test.{}.0", input["sha256"].as_str().unwrap());
        let stream = self.context.get_stream_no_info("SCI_IN").await.unwrap();
        self.in_time(|| stream.direct_get_last_for_subject(subject.clone())).await.payload
    }
}

/// Relative residual of frames against the snapshot of a tile; all are prepared arrays.
pub fn residual(masks: &[u8], frames: &[u8], snapshot: &[u8]) -> f32 {
    let values = |array: &[u8]| -> Vec<f64> {
        let samples = array[32..].chunks_exact(4);
        samples.map(|four| f64::from(f32::from_le_bytes(four.try_into().unwrap()))).collect()
    };
    let (masks, frames, y) = (values(masks), values(frames), values(snapshot));
    let mut rest = y.clone();
    for (k, (c, x)) in masks.iter().zip(&frames).enumerate() {
        rest[k % y.len()] -= c * x;
    }
    let norm = |values: &[f64]| values.iter().map(|value| value * value).sum::<f64>().sqrt();
    (norm(&rest) / norm(&y)) as f32
}

/// A scene with at least `tiles` tiles of 24 pixels.
fn scene(tiles: usize) -> Scene {
    let side = (1..).find(|side| side * side >= tiles).unwrap();
    Scene { frames: 2, height: 16 * side + 8, width: 16 * side + 8, snapshots: 1 }
}

fn percentile(times: &[Duration], of_hundred: usize) -> f64 {
    let at = (times.len() * of_hundred).div_ceil(100).clamp(1, times.len());
    times.get(at - 1).map_or(0.0, Duration::as_secs_f64) * 1e3
}

/// Runs a job of simulated tiles, and measures the hand-over.
async fn simulate(
    app: &TestApp,
    nats: &Nats,
    crowd: &Crowd,
    workers: usize,
    (tiles, length): (usize, Duration),
) -> Value {
    *crowd.length.lock().unwrap() = length;
    crowd.pauses.lock().unwrap().clear();
    let (done, late) = (crowd.done.load(Ordering::Relaxed), crowd.late.load(Ordering::Relaxed));
    let (_, measurement) = app.scene(&scene(tiles)).await;
    let before = handing_over(app, nats);
    let job = app.submit(&with_iterations(&measurement, 1)).await;
    let state = || async { app.get(&format!("/v1/jobs/{job}")).await.expect(200).json() };
    while state().await["progress"]["tiles_done"] == 0 {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    let start = Instant::now();
    let total = loop {
        let job = state().await;
        let (done, total) = (&job["progress"]["tiles_done"], &job["progress"]["tiles_total"]);
        if done == total {
            break total.as_u64().unwrap();
        }
        assert!(job["state"] != "failed" && start.elapsed() < Duration::from_secs(600), "{job:#}");
        tokio::time::sleep(Duration::from_millis(100)).await;
    };
    let seconds = start.elapsed().as_secs_f64();
    let after = handing_over(app, nats);
    let mut pauses = crowd.pauses.lock().unwrap().clone();
    pauses.sort();
    let per_tile = |spent: f64| (spent / total as f64 * 1e6).round() / 1e3;
    let round = |value: f64| (value * 10.0).round() / 10.0;
    // Tiles per second if the hand-over took no time.
    let wanted = workers as f64 / length.as_secs_f64();
    app.ended(&job).await;
    json!({
        "workers": workers, "tiles": total, "tile_seconds": length.as_secs_f64(),
        "tiles_per_second": round(total as f64 / seconds),
        "wanted_per_second": if wanted.is_finite() { json!(round(wanted)) } else { Value::Null },
        "pause_ms": {"median": round(percentile(&pauses, 50)), "p99": round(percentile(&pauses, 99))},
        "hub_cpu_ms_per_tile": per_tile(after.0 - before.0),
        "nats_cpu_ms_per_tile": per_tile(after.1 - before.1),
        "late": crowd.late.load(Ordering::Relaxed) - late,
        "twice": crowd.done.load(Ordering::Relaxed) - done - total,
    })
}

async fn crowd_of(
    app: &TestApp,
    crowd: &Arc<Crowd>,
    (from, to): (usize, usize),
) -> Vec<tokio::task::JoinHandle<()>> {
    let mut handles = Vec::new();
    for n in from..to {
        handles.push(tokio::spawn(crowd.clone().enter()));
        if n % 50 == 49 {
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
    }
    until("all workers are connected", || async { super::workers(app).await.len() >= to }).await;
    handles
}

/// Raises the soft limit on open files, because each simulated worker has a connection.
fn open_many_files() {
    use rustix::process::{Resource, getrlimit, setrlimit};
    let mut limit = getrlimit(Resource::Nofile);
    limit.current = limit.maximum;
    setrlimit(Resource::Nofile, limit).unwrap();
}

/// The short version in all tests has fewer workers.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn many_idle_workers_take_small_tiles_in_time() {
    let Some(nats) = Nats::start(1) else { return };
    open_many_files();
    let (workers, tiles) = if rounds().is_some() { (500, 2000) } else { (60, 200) };
    let app = served(&nats, "30").await;
    let crowd = Arc::new(Crowd::learn(&nats, &app).await);
    let handles = crowd_of(&app, &crowd, (0, workers)).await;
    let idle = if rounds().is_some() { 30 } else { 1 };
    let before = handing_over(&app, &nats);
    tokio::time::sleep(Duration::from_secs(idle)).await;
    let after = handing_over(&app, &nats);
    let share = |spent: f64| (spent / idle as f64 * 1e4).round() / 1e4;
    let mut line = simulate(&app, &nats, &crowd, workers, (tiles, Duration::ZERO)).await;
    let ok = line["late"] == 0 && line["twice"] == 0;
    line["target"] = json!("cluster_idle_workers");
    line["ok"] = json!(ok);
    line["idle_hub_cores"] = json!(share(after.0 - before.0));
    line["idle_nats_cores"] = json!(share(after.1 - before.1));
    println!("{line}");
    assert!(ok, "{line}");
    crowd.stop.store(true, Ordering::Relaxed);
    futures_util::future::join_all(handles).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "part of `make cluster`"]
async fn a_thousand_simulated_workers_show_the_limit() {
    let Some(nats) = Nats::start(1) else { return };
    open_many_files();
    let app = served(&nats, "30").await;
    let crowd = Arc::new(Crowd::learn(&nats, &app).await);
    let (mut handles, mut lines, mut connected) = (Vec::new(), Vec::new(), 0);
    for workers in [10, 100, 300, 1000] {
        handles.extend(crowd_of(&app, &crowd, (connected, workers)).await);
        connected = workers;
        // Each worker gets four tiles of this duration.
        for length in [10, 2] {
            let plan = (4 * workers, Duration::from_secs(length));
            let line = simulate(&app, &nats, &crowd, workers, plan).await;
            eprintln!("{line}");
            lines.push(line);
        }
    }
    println!("{}", json!({"target": "cluster_simulation", "ok": true, "simulated": lines}));
    crowd.stop.store(true, Ordering::Relaxed);
    futures_util::future::join_all(handles).await;
}

/// CPU seconds of a worker's computing process and its supervisor.
fn cpu_of_worker(worker: &RemoteWorker) -> f64 {
    let inner = worker.inner().map_or(0, |pid| pid.as_raw_nonzero().get().unsigned_abs());
    cpu(worker.process.id()) + cpu(inner)
}

/// True if the server's local process computes a job's pilot or preview, which belong to the
/// solver.
async fn solves_locally(records: &mut sqlx::SqliteConnection, job: &str) -> bool {
    let row = sqlx::query(
        "SELECT count(*) AS n FROM tasks
         WHERE job = ? AND kind IN ('pilot', 'preview') AND state = 'running'",
    );
    row.bind(job).fetch_one(records).await.unwrap().get::<i64, _>("n") > 0
}

/// CPU seconds of a job: server with its local process, message server, workers, their tiles, and
/// the solver's part of the first.
async fn cost(app: &TestApp, nats: &Nats, workers: &[RemoteWorker], body: &Value) -> [f64; 5] {
    let local = |app: &TestApp| -> f64 {
        app.workers().iter().map(|pid| cpu(pid.as_raw_nonzero().get().unsigned_abs())).sum()
    };
    let spent = || {
        let (server, nats) = handing_over(app, nats);
        let workers: f64 = workers.iter().map(cpu_of_worker).sum();
        (server + local(app), nats, workers)
    };
    let before = spent();
    let job = app.submit(body).await;
    let mut records = database(app.data()).await;
    let (start, mut home) = (Instant::now(), 0.0);
    for poll in 0.. {
        let before = local(app);
        tokio::time::sleep(Duration::from_millis(50)).await;
        if solves_locally(&mut records, &job).await {
            home += local(app) - before;
        }
        if poll % 10 == 0 {
            let job = app.get(&format!("/v1/jobs/{job}")).await.expect(200).json();
            if job["state"] == "succeeded" {
                break;
            }
            assert!(job["state"] != "failed" && start.elapsed().as_secs() < 7200, "{job:#}");
        }
    }
    let after = spent();
    let manifest = app.get(&format!("/v1/jobs/{job}/snapshots/0/manifest.json")).await.json();
    let tiles = manifest["run"]["cpu_seconds"].as_f64().unwrap_or_else(|| panic!("{manifest:#}"));
    [after.0 - before.0, after.1 - before.1, after.2 - before.2, tiles, home]
}

/// A deep job on remote workers, and the share that is not spent in the solver. A job with almost
/// no computation shows the cost of a tile's inputs.
#[tokio::test]
#[ignore = "part of `make cluster`"]
async fn little_time_of_a_deep_job_is_spent_outside_the_solver() {
    if !has_onnxruntime() {
        return;
    }
    let Some(nats) = Nats::start(1) else { return };
    let app = served(&nats, "30").await;
    let workers = [worker(&nats, &[]), worker(&nats, &[])];
    until("both workers are connected", || async { super::workers(&app).await.len() == 2 }).await;
    // Measure the idle cost.
    tokio::time::sleep(Duration::from_secs(5)).await;
    const IDLE: u64 = 60;
    let before = workers.each_ref().map(cpu_of_worker);
    tokio::time::sleep(Duration::from_secs(IDLE)).await;
    let after = workers.each_ref().map(cpu_of_worker);
    let idle = after.iter().zip(before).map(|(after, before)| (after - before) / IDLE as f64);
    let idle = idle.fold(0.0, f64::max);
    // The first job needs almost no computation. The second has the default schedule or one with fewer deep passes.
    let scene = Scene { frames: 10, height: 1024, width: 1024, snapshots: 1 };
    let (_, measurement) = app.scene(&scene).await;
    let nothing = json!({"measurement": measurement, "algorithm": "gap-tv", "schedule": {"stages": [
        {"prior": "tv", "iterations": 1, "tv_weight": 0.05, "tv_updates": 1}]}});
    let mut deep = json!({"measurement": measurement, "algorithm": "pnp-tv-fastdvdnet"});
    if let Ok(passes) = std::env::var("SCI_RECON_CLUSTER_PASSES") {
        let passes: u32 = passes.parse().unwrap();
        deep["schedule"] = json!({"stages": [
            {"prior": "tv", "iterations": 20, "tv_weight": 0.1},
            {"prior": "tv+fastdvdnet", "iterations": passes, "sigma": [0.2, 0.05], "tv_weight": 0.02}]});
    }
    let [base_server, base_nats, base_workers, base_tiles, _] =
        cost(&app, &nats, &workers, &nothing).await;
    let [server, nats_cpu, workers_cpu, tiles, home] = cost(&app, &nats, &workers, &deep).await;
    let total = server + nats_cpu + workers_cpu;
    // Time of the workers outside tiles, and for their inputs.
    let outside = (server - home) + nats_cpu + (workers_cpu - tiles) + base_tiles;
    let share = outside / total;
    let ok = share <= 0.02 && idle < 0.002;
    let round = |value: f64| (value * 1e4).round() / 1e4;
    let line = json!({
        "target": "cluster_overhead", "ok": ok, "idle_worker_cores": round(idle),
        "deep_passes": deep["schedule"]["stages"][1]["iterations"],
        "job_cpu_seconds": round(total), "server": round(server), "pilot_and_preview": round(home), "nats": round(nats_cpu),
        "workers": round(workers_cpu), "tiles": round(tiles), "share_outside": round(share),
        "next_to_nothing": {"server": round(base_server), "nats": round(base_nats),
            "workers": round(base_workers), "tiles": round(base_tiles)},
    });
    println!("{line}");
    assert!(ok, "{line}");
}
