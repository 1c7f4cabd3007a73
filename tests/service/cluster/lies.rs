//! Workers that report what can't be: made by hand, against a real message server and a real `serve`.

use std::time::{Duration, Instant};

use async_nats::Client;
use async_nats::jetstream::{AckKind, Context, Message};
use futures_util::StreamExt;
use rustix::process::Signal;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use sqlx::Row;

use super::nodes::{Nats, RemoteWorker};
use super::rounds::database;
use super::scale::residual;
use super::{figure, job, local, until, with_iterations, worker};
use crate::app::{TestApp, id};
use crate::faults::{results, results_of};
use crate::samples::Scene;

/// Bytes of a chunk, and of the header of a prepared array.
const CHUNK: usize = 512 * 1024;
const HEADER: usize = 32;

/// A server whose tiles leave the machine, with this share of them computed twice.
async fn served(nats: &Nats, fraction: &str) -> TestApp {
    let url = nats.url();
    TestApp::with(&[
        "--workers",
        "0",
        "--nats",
        &url,
        "--ack-wait",
        "5",
        "--verify-fraction",
        fraction,
    ])
    .await
}

/// The description of its program that a real worker sends.
async fn program(nats: &Nats) -> Value {
    let client = nats.client().await;
    let mut hellos = client.subscribe("sci.v1.hello.test").await.unwrap();
    client.flush().await.unwrap();
    let mut model = worker(nats, &[]);
    let hello = hellos.next().await.unwrap();
    model.kill();
    let hello: Value = serde_json::from_slice(&hello.payload).unwrap();
    hello["program"].clone()
}

/// A worker by hand.
struct Liar {
    client: Client,
    context: Context,
    pool: &'static str,
    id: String,
}

/// A tile that it has.
struct Tile {
    message: Message,
    task: String,
    attempt: u64,
    seq: u64,
    delivery: i64,
    masks: Vec<u8>,
    snapshot: Vec<u8>,
    /// Frames, rows and columns.
    shape: [usize; 3],
}

impl Liar {
    /// Introduces itself, once the server listens.
    async fn enter(nats: &Nats, pool: &'static str, program: &Value) -> Self {
        let client = nats.client().await;
        let context = async_nats::jetstream::new(client.clone());
        let liar = Self { client, context, pool, id: uuid::Uuid::now_v7().to_string() };
        let hello = json!({"worker": liar.id, "host": "elsewhere", "pid": 1, "device": "cpu",
            "program": program});
        until("it is welcome", async || {
            let answer = liar.ask("hello", &hello).await;
            answer.is_some_and(|answer| answer["welcome"].is_object())
        })
        .await;
        liar
    }

    async fn ask(&self, what: &str, message: &Value) -> Option<Value> {
        let subject = format!("sci.v1.{what}.{}", self.pool);
        let answer = self.client.request(subject, message.to_string().into()).await.ok()?;
        serde_json::from_slice(&answer.payload).ok()
    }

    async fn beat(&self) {
        self.sign(false).await;
    }

    async fn leave(&self) {
        self.sign(true).await;
    }

    async fn sign(&self, leaves: bool) {
        let beat = json!({"worker": self.id, "tile": null, "leaves": leaves});
        let subject = format!("sci.v1.beat.{}", self.pool);
        self.client.publish(subject, beat.to_string().into()).await.unwrap();
    }

    /// Waits for a tile, and begins with it.
    async fn take(&self) -> Tile {
        let start = Instant::now();
        loop {
            assert!(start.elapsed() < Duration::from_secs(60), "there is no tile");
            self.beat().await;
            let Some(message) = self.pull().await else { continue };
            let body: Value = serde_json::from_slice(&message.payload).unwrap();
            let (seq, delivery) = {
                let info = message.info().unwrap();
                (info.stream_sequence, info.delivered)
            };
            let task = body["task"].as_str().unwrap().to_owned();
            let begin = json!({"task": task, "attempt": body["attempt"], "seq": seq,
                "delivery": delivery, "worker": self.id});
            let answer = self.ask("begin", &begin).await.unwrap();
            let Some(attempt) = answer["go"].as_u64() else {
                if answer == "another" {
                    let later = AckKind::Nak(Some(Duration::from_millis(200)));
                    message.ack_with(later).await.unwrap();
                } else {
                    message.ack().await.unwrap();
                }
                continue;
            };
            let (masks, snapshot) =
                (self.input(&body["masks"]).await, self.input(&body["snapshots"]).await);
            let side = |name: &str| body["tile"]["tile"][name].as_u64().unwrap() as usize;
            let (height, width) = (side("height"), side("width"));
            let shape = [(masks.len() - HEADER) / 4 / height / width, height, width];
            return Tile { message, task, attempt, seq, delivery, masks, snapshot, shape };
        }
    }

    async fn pull(&self) -> Option<Message> {
        let consumer = self
            .context
            .get_consumer_from_stream::<async_nats::jetstream::consumer::pull::Config, _, _>(
                self.pool,
                "SCI_TASKS",
            )
            .await
            .ok()?;
        let batch = consumer.batch().max_messages(1).expires(Duration::from_secs(2));
        batch.messages().await.ok()?.next().await?.ok()
    }

    /// A file of the stream of inputs; it is one chunk.
    async fn input(&self, input: &Value) -> Vec<u8> {
        let subject = format!("sci.v1.in.{}.{}.0", self.pool, input["sha256"].as_str().unwrap());
        let stream = self.context.get_stream_no_info("SCI_IN").await.unwrap();
        stream.direct_get_last_for_subject(subject).await.unwrap().payload.to_vec()
    }

    async fn put(&self, tile: &Tile, n: usize, chunk: &[u8]) {
        let (pool, id) = (self.pool, &self.id);
        let subject = format!("sci.v1.out.{pool}.{}.{}.{id}.{n}", tile.task, tile.attempt);
        let sent = self.context.publish(subject, chunk.to_vec().into()).await.unwrap();
        sent.await.unwrap();
    }

    /// Puts frames and returns what an event says of them.
    async fn put_frames(&self, tile: &Tile, frames: &[u8]) -> Value {
        for (n, chunk) in frames.chunks(CHUNK).enumerate() {
            self.put(tile, n, chunk).await;
        }
        json!({"sha256": hex::encode(Sha256::digest(frames)), "bytes": frames.len()})
    }

    /// Reports, and lets the message go.
    async fn report(&self, tile: &Tile, end: Value) {
        let event = json!({"task": tile.task, "attempt": tile.attempt, "worker": self.id,
            "seq": tile.seq, "delivery": tile.delivery, "end": end});
        self.send(event.to_string()).await;
        tile.message.double_ack().await.unwrap();
    }

    async fn send(&self, event: String) {
        let subject = format!("sci.v1.event.{}", self.pool);
        self.context.publish(subject, event.into()).await.unwrap().await.unwrap();
    }
}

impl Tile {
    /// An end that says nothing impossible, for these frames.
    fn done(&self, frames: &[u8], put: Value) -> Value {
        let [count, height, width] = self.shape;
        let size = (height.div_ceil(16), width.div_ceil(16));
        let record = json!({
            "iterations": 3, "tv_iterations": 3, "denoiser_passes": 0, "stop_reason": "max-iterations",
            "residual": residual(&self.masks, frames, &self.snapshot), "solved": [0],
            "assessment": {"size": [size.0, size.1], "motion": 0.5, "unfamiliar": false,
                "levels": "40".repeat(count * size.0 * size.1)},
            "provider": null, "onnxruntime": null, "cpu_seconds": 0.25, "peak_rss_bytes": 1 << 20,
        });
        json!({"done": {"frames": put, "record": record, "history": "[[1,0.5,0.1,null]]",
            "progress": {"stage": "tv", "iterations": 3, "passes": 0, "fraction": 1.0}}})
    }

    /// Frames that pass every check, and are wrong: the masks, dimmed.
    fn plausible(&self) -> Vec<u8> {
        self.with(|k, _| 0.5 * self.mask(k))
    }

    fn mask(&self, k: usize) -> f32 {
        f32::from_le_bytes(self.masks[HEADER + 4 * k..][..4].try_into().unwrap())
    }

    /// An array of the tile's shape by index and by column.
    fn with(&self, value: impl Fn(usize, usize) -> f32) -> Vec<u8> {
        let [frames, height, width] = self.shape;
        let mut bytes = self.masks[..HEADER].to_vec();
        let values = (0..frames * height * width).map(|k| value(k, k % width));
        bytes.extend(values.flat_map(f32::to_le_bytes));
        bytes
    }

    /// Why its attempt failed, once it has.
    async fn reason(&self, app: &TestApp) -> String {
        let start = Instant::now();
        let mut connection = database(app.data()).await;
        loop {
            let row =
                sqlx::query("SELECT outcome, reason FROM attempts WHERE task = ? AND attempt = ?")
                    .bind(&self.task)
                    .bind(self.attempt as i64)
                    .fetch_one(&mut connection)
                    .await
                    .unwrap();
            if let Some(outcome) = row.get::<Option<String>, _>("outcome") {
                return format!(
                    "{outcome}: {}",
                    row.get::<Option<String>, _>("reason").unwrap_or_default()
                );
            }
            assert!(start.elapsed() < Duration::from_secs(20), "the attempt does not end");
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }
}

/// Frames and end of a tile, and the reason for which they are to be rejected.
type Lie = (&'static str, Box<dyn Fn(&Tile) -> Vec<u8>>, Box<dyn Fn(&mut Value)>);

fn lies() -> Vec<Lie> {
    let frames = |reason, frames: fn(&Tile) -> Vec<u8>| -> Lie {
        (reason, Box::new(frames), Box::new(|_| {}))
    };
    let field = |reason, pointer: &'static str, value: Value| -> Lie {
        let change = move |end: &mut Value| *end.pointer_mut(pointer).unwrap() = value.clone();
        (reason, Box::new(Tile::plausible), Box::new(change))
    };
    let speck = |tile: &Tile, value: f32| {
        tile.with(|k, _| if k == 100 { value } else { 0.5 * tile.mask(k) })
    };
    vec![
        (
            "column 4 is NaN",
            Box::new(move |tile| speck(tile, f32::NAN)),
            Box::new(|end| end["done"]["record"]["residual"] = json!(0.02)),
        ),
        (
            "column 4 is 3",
            Box::new(move |tile| speck(tile, 3e38)),
            Box::new(|end| end["done"]["record"]["residual"] = json!(0.02)),
        ),
        (
            "it states a residual of 2.0000e-2",
            Box::new(|tile| tile.with(|_, _| 0.25)),
            Box::new(|end| end["done"]["record"]["residual"] = json!(0.02)),
        ),
        frames("but 4 frames of 24x24 pixels have", |tile| {
            let mut bytes = tile.plausible();
            bytes[12..16].copy_from_slice(&8u32.to_le_bytes());
            bytes.extend(bytes[HEADER..].to_vec());
            bytes
        }),
        // As many bytes of another shape.
        frames("the frames are 8 frames of 12x24 pixels", |tile| {
            let mut bytes = tile.plausible();
            bytes[12..16].copy_from_slice(&8u32.to_le_bytes());
            bytes[16..20].copy_from_slice(&12u32.to_le_bytes());
            bytes
        }),
        frames("signature", |tile| vec![0; tile.masks.len()]),
        field("cpu_seconds", "/done/record/cpu_seconds", json!(1e300)),
        field("cpu_seconds", "/done/record/cpu_seconds", json!(-1.0)),
        field("peak_rss_bytes", "/done/record/peak_rss_bytes", json!(u64::MAX)),
        field("iterations", "/done/record/iterations", json!(4_000_000)),
        field("tv_iterations", "/done/record/tv_iterations", json!(4_000_000)),
        field("stop_reason", "/done/record/stop_reason", json!("<b>bored</b>")),
        field("solved", "/done/record/solved", json!([7])),
        field("assessment", "/done/record/assessment", Value::Null),
        field("assessment", "/done/record/assessment/levels", json!("ff")),
        field("assessment", "/done/record/assessment/motion", json!(1e30)),
        field("provider", "/done/record/provider", json!("x".repeat(1000))),
        field("can't be read", "/done/record", json!({"residual": 0.1})),
        field("progress", "/done/progress/fraction", json!(-1e300)),
        field("progress", "/done/progress/iterations", json!(u32::MAX)),
        field("passes", "/done/progress/passes", json!(50_000)),
        field("history", "/done/history", json!("{\"not\": \"a history\"}")),
        field("it has 2684354560 bytes", "/done/frames/bytes", json!(2_684_354_560u64)),
        field("lost: its frames", "/done/frames/sha256", json!("ab".repeat(32))),
    ]
}

#[tokio::test]
async fn results_that_can_not_be_cost_an_attempt_each() {
    let Some(nats) = Nats::start(1) else { return };
    let expected = local().await;
    let program = program(&nats).await;
    let app = served(&nats, "0").await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let lies = lies();
    // A job gives up a tile after three failures: few lies to each, and then a worker that does its work.
    for (n, some) in lies.chunks(8).enumerate() {
        let liar = Liar::enter(&nats, "test", &program).await;
        let id = app.submit(&job(&measurement)).await;
        for (reason, frames, change) in some {
            let tile = liar.take().await;
            let frames = frames(&tile);
            let put = liar.put_frames(&tile, &frames).await;
            let mut end = tile.done(&frames, put);
            change(&mut end);
            liar.report(&tile, end).await;
            let found = tile.reason(&app).await;
            assert!(found.contains(reason), "{reason}: {found}");
            eprintln!("{found}");
        }
        // A first chunk that is too short, and one that is too long.
        for length in [100, 100_000].into_iter().skip(n) {
            let tile = liar.take().await;
            let frames = tile.plausible();
            let put = liar.put_frames(&tile, &frames).await;
            liar.put(&tile, 0, &vec![0; length]).await;
            liar.report(&tile, tile.done(&frames, put)).await;
            assert!(tile.reason(&app).await.contains("lost: its frames"));
        }
        liar.leave().await;
        let mut honest = worker(&nats, &[]);
        let done = app.ended(&id).await;
        assert_eq!(done["state"], "succeeded", "{done:#}");
        assert_eq!(results(&app, &id).await, *expected);
        honest.process.signal(Signal::TERM);
        honest.process.ended(Duration::from_secs(10));
    }
    let rejected = figure(&app, "sci_recon_cluster_rejected_total").await;
    assert_eq!(rejected, lies.len() as f64 - 1.0, "frames that are damaged are lost");
    let seconds = figure(&app, "sci_recon_lab_cpu_seconds_total{lab=\"local\"}").await;
    assert!(seconds < 1000.0, "{seconds}");
    nats.emptied().await;
}

#[tokio::test]
async fn a_result_is_taken_of_the_worker_that_began_and_its_residual_is_the_servers() {
    let Some(nats) = Nats::start(1) else { return };
    let program = program(&nats).await;
    let app = served(&nats, "0").await;
    let first = Liar::enter(&nats, "test", &program).await;
    let second = Liar::enter(&nats, "test", &program).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let id = app.submit(&with_iterations(&measurement, 9000)).await;
    let tile = first.take().await;
    let frames = tile.plausible();
    // Reports and beats of another worker change nothing.
    let put = second.put_frames(&tile, &frames).await;
    let done = tile.done(&frames, put);
    let junk = ["", "{", "[[[[", "null", "{\"task\": 1}"].map(str::to_owned);
    let unknown =
        json!({"task": uuid::Uuid::now_v7(), "attempt": 1, "worker": second.id, "end": done});
    let forged = json!({"task": tile.task, "attempt": tile.attempt, "worker": second.id,
        "seq": tile.seq, "delivery": tile.delivery, "end": done});
    let failed = json!({"task": tile.task, "attempt": tile.attempt, "worker": second.id,
        "end": {"failed": {"reason": "forged", "retry": false}}});
    let of_no_attempt =
        json!({"task": tile.task, "attempt": u32::MAX, "worker": first.id, "end": done});
    let deep = "[".repeat(100_000);
    let events: Vec<String> = junk
        .into_iter()
        .chain([deep])
        .chain([unknown, forged, failed, of_no_attempt].map(|event| event.to_string()))
        .collect();
    for event in &events {
        second.send(event.clone()).await;
    }
    until("all are refused", async || {
        figure(&app, "sci_recon_cluster_refused_total").await == events.len() as f64
    })
    .await;
    // A beat for it is not the other's, either.
    let beat = json!({"worker": second.id, "leaves": false, "tile": {"task": tile.task,
        "attempt": tile.attempt, "history": null,
        "progress": {"stage": "tv", "iterations": 77, "passes": 0, "fraction": 0.9}}});
    second.client.publish("sci.v1.beat.test", beat.to_string().into()).await.unwrap();
    second.client.flush().await.unwrap();
    // Rounding in the statement is not seen in the manifest.
    let put = first.put_frames(&tile, &frames).await;
    let mut end = tile.done(&frames, put);
    let exact = residual(&tile.masks, &frames, &tile.snapshot);
    end["done"]["record"]["residual"] = json!(exact * 1.005);
    tokio::time::sleep(Duration::from_millis(1200)).await;
    let mut connection = database(app.data()).await;
    let row = sqlx::query("SELECT iterations, record FROM tasks WHERE id = ?").bind(&tile.task);
    let iterations: i64 = row.fetch_one(&mut connection).await.unwrap().get("iterations");
    assert_ne!(iterations, 77);
    first.report(&tile, end).await;
    assert_eq!(tile.reason(&app).await, "done: ");
    let row = sqlx::query("SELECT record ->> '$.residual' AS residual FROM tasks WHERE id = ?");
    let stored: f64 =
        row.bind(&tile.task).fetch_one(&mut connection).await.unwrap().get("residual");
    assert_eq!(stored as f32, exact);
    app.post(&format!("/v1/jobs/{id}/cancel"), &json!({})).await.expect(202);
}

#[tokio::test]
async fn a_huge_answer_leaves_the_server_alive_and_small() {
    let Some(nats) = Nats::start(1) else { return };
    let program = program(&nats).await;
    let app = served(&nats, "0").await;
    let liar = Liar::enter(&nats, "test", &program).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    app.submit(&with_iterations(&measurement, 9000)).await;
    let tile = liar.take().await;
    let frames = tile.plausible();
    let before = app.peak_memory();
    // Each chunk is there, and the hash is right.
    let (chunk, count) = (vec![0x5a; CHUNK], 400);
    let mut hasher = Sha256::new();
    for n in 0..count {
        liar.put(&tile, n, &chunk).await;
        hasher.update(&chunk);
    }
    let put = json!({"sha256": hex::encode(hasher.finalize()), "bytes": count * CHUNK});
    liar.report(&tile, tile.done(&frames, put)).await;
    let reason = tile.reason(&app).await;
    assert!(reason.contains("209715200 bytes"), "{reason}");
    let grown = app.peak_memory().saturating_sub(before);
    eprintln!("200 MiB were stated, the server grew by {} MiB", grown >> 20);
    assert!(grown < 64 << 20, "{grown}");
}

#[tokio::test]
async fn missing_frames_of_one_pool_hold_up_no_other() {
    let Some(nats) = Nats::start(1) else { return };
    let program = program(&nats).await;
    let app = served(&nats, "0").await;
    let mut slow = Vec::new();
    for _ in 0..3 {
        slow.push(Liar::enter(&nats, "slow", &program).await);
    }
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    app.submit(&with_iterations(&measurement, 9000)).await;
    let mut held = Vec::new();
    for n in 0..6 {
        held.push(slow[n % 3].take().await);
    }
    let quick = Liar::enter(&nats, "test", &program).await;
    let tile = quick.take().await;
    let frames = tile.plausible();
    let put = quick.put_frames(&tile, &frames).await;
    for (n, held) in held.iter().enumerate() {
        let (frames, nothing) =
            (held.plausible(), json!({"sha256": "ab".repeat(32), "bytes": held.masks.len()}));
        slow[n % 3].report(held, held.done(&frames, nothing)).await;
    }
    let start = Instant::now();
    quick.report(&tile, tile.done(&frames, put)).await;
    assert_eq!(tile.reason(&app).await, "done: ");
    let took = start.elapsed();
    eprintln!("the tile of the other pool was accepted after {took:?}");
    assert!(took < Duration::from_secs(2), "{took:?}");
    for held in &held {
        assert!(held.reason(&app).await.contains("lost: its frames"));
    }
}

/// The residual of each tile, and the hash of each file.
async fn found(app: &TestApp, body: &Value, snapshots: usize) -> (Vec<Value>, Value) {
    let id = app.submit(body).await;
    let done = app.ended(&id).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    let mut residuals = Vec::new();
    for snapshot in 0..snapshots {
        let tiles = app.get(&format!("/v1/jobs/{id}/snapshots/{snapshot}/tiles")).await;
        let tiles = tiles.expect(200).json()["items"].as_array().unwrap().clone();
        residuals.extend(tiles.iter().map(|tile| tile["residual"].clone()));
    }
    (residuals, json!(results_of(app, &id, snapshots).await))
}

#[tokio::test]
async fn runs_with_cuts_and_mosaics_are_accepted_with_the_same_residuals() {
    let Some(nats) = Nats::start(1) else { return };
    let app = TestApp::with(&["--workers", "2"]).await;
    let scene = Scene { snapshots: 7, ..Scene::SMALL };
    let calibration = id(&app.calibrate(scene.masks()).await);
    let measurement = id(&app.measure(&calibration, scene.with_a_cut(3)).await);
    let sequence = json!({"measurement": measurement, "algorithm": "pnp-nonlocal",
        "tile": {"size": 40, "overlap": 8}, "schedule": {"stages": [
            {"prior": "tv", "iterations": 20, "tv_weight": 0.1, "temporal_weight": 0.004},
            {"prior": "nonlocal", "iterations": 6, "sigma": [0.2, 0.02], "memory": 0.6}]}});
    let masks = app.upload(scene.masks()).await;
    let mosaic = json!({"masks": masks, "mosaic": "rggb"});
    let calibration = id(&app.post("/v1/calibrations", &mosaic).await.expect(201));
    let measurement = id(&app.measure(&calibration, scene.snapshots()).await);
    let mut colours = with_iterations(&measurement, 30);
    colours["schedule"]["method"] = json!("admm");
    colours["snapshots"] = json!(0);
    let expected = [found(&app, &sequence, 7).await, found(&app, &colours, 1).await];
    let url = nats.url();
    let line = ["--workers", "0", "--nats", &url, "--verify-fraction", "0"];
    let app = app.again(&line).await;
    let _workers = [worker(&nats, &[]), worker(&nats, &[])];
    assert_eq!([found(&app, &sequence, 7).await, found(&app, &colours, 1).await], expected);
    assert_eq!(figure(&app, "sci_recon_cluster_rejected_total").await, 0.0);
}

#[tokio::test]
async fn two_workers_that_agree_are_believed() {
    let Some(nats) = Nats::start(1) else { return };
    let expected = local().await;
    let app = served(&nats, "1").await;
    let _workers = [worker(&nats, &[]), worker(&nats, &[])];
    until("both are known", || async { super::workers(&app).await.len() == 2 }).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let id = app.submit(&job(&measurement)).await;
    let start = Instant::now();
    let done = app.ended(&id).await;
    eprintln!("all tiles were computed twice in {:?}", start.elapsed());
    assert_eq!(done["state"], "succeeded", "{done:#}");
    assert_eq!(results(&app, &id).await, *expected);
    let tiles = done["progress"]["tiles_total"].as_f64().unwrap();
    assert_eq!(figure(&app, "sci_recon_cluster_replayed_total").await, tiles);
    assert_eq!(figure(&app, "sci_recon_cluster_mismatched_total").await, 0.0);
    assert_eq!(figure(&app, "sci_recon_cluster_rejected_total").await, 0.0);
    nats.emptied().await;
}

#[tokio::test]
async fn plausible_frames_that_are_wrong_are_found_by_a_second_worker() {
    let Some(nats) = Nats::start(1) else { return };
    let expected = local().await;
    let program = program(&nats).await;
    let app = served(&nats, "1").await;
    let liar = Liar::enter(&nats, "test", &program).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let id = app.submit(&job(&measurement)).await;
    let tile = liar.take().await;
    // The honest worker is there before the result.
    let url = nats.url();
    let _worker = RemoteWorker::start(&["--nats", &url, "--pool", "test"]);
    until("it has come", || async { super::workers(&app).await.len() == 2 }).await;
    let frames = tile.plausible();
    let put = liar.put_frames(&tile, &frames).await;
    liar.report(&tile, tile.done(&frames, put)).await;
    until("the results are compared", async || {
        liar.beat().await;
        figure(&app, "sci_recon_cluster_mismatched_total").await == 1.0
    })
    .await;
    assert_eq!(tile.reason(&app).await, "released: ");
    let second = Tile { attempt: tile.attempt + 1, ..tile };
    let reason = second.reason(&app).await;
    assert!(reason.contains(&format!("worker {} disagrees", liar.id)), "{reason}");
    liar.leave().await;
    let done = app.ended(&id).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    assert_eq!(results(&app, &id).await, *expected);
}
