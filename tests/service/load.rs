//! Load: run by `make load`, for it takes minutes and gigabytes.

use std::time::{Duration, Instant};

use bytes::Bytes;
use reqwest::{Body, Method};
use serde_json::{Value, json};

use crate::app::TestApp;
use crate::samples::{Scene, npy_header};

fn setting(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |text| text.parse().unwrap())
}

/// A job that keeps both cores busy for as long as the test takes.
fn endless(measurement: &str) -> Value {
    json!({
        "measurement": measurement,
        "algorithm": "gap-tv",
        "tile": {"size": 24, "overlap": 8},
        "schedule": {"stages": [
            {"prior": "tv", "iterations": 10000, "tv_weight": 0.05, "tv_updates": 500},
        ]},
    })
}

/// The figure that so many of a hundred are below.
fn percentile(sorted: &[Duration], of_hundred: f64) -> f64 {
    let at = ((sorted.len() as f64 * of_hundred / 100.0).ceil() as usize).clamp(1, sorted.len());
    sorted[at - 1].as_secs_f64() * 1000.0
}

#[tokio::test]
#[ignore = "minutes; run by make load"]
async fn two_hundred_clients_poll_while_all_cores_compute() {
    const CLIENTS: u64 = 200;
    let seconds = setting("SCI_RECON_LOAD_SECONDS", 300);
    let app = TestApp::with(&["--workers", "2"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let mut jobs = Vec::new();
    for _ in 0..20 {
        jobs.push(app.submit(&endless(&measurement)).await);
    }
    app.when(&jobs[0], |job| job["progress"]["tiles_running"].as_u64() >= Some(2)).await;
    let end = Instant::now() + Duration::from_secs(seconds);
    let (app, jobs) = (&app, &jobs);
    let poll = |client: u64| async move {
        let path = format!("/v1/jobs/{}", jobs[client as usize % jobs.len()]);
        let (mut times, mut errors) = (Vec::new(), 0u64);
        // Once a second each, but not all at the same moment.
        tokio::time::sleep(Duration::from_millis(client * 5)).await;
        while Instant::now() < end {
            let start = Instant::now();
            let answer = app.request(Method::GET, &path).send().await;
            let whole = match answer {
                Ok(answer) if answer.status() == 200 => answer.bytes().await.is_ok(),
                _ => false,
            };
            times.push(start.elapsed());
            errors += u64::from(!whole);
            tokio::time::sleep(Duration::from_secs(1).saturating_sub(start.elapsed())).await;
        }
        (times, errors)
    };
    let polled = futures_util::future::join_all((0..CLIENTS).map(poll)).await;
    let job = app.get(&format!("/v1/jobs/{}", jobs[0])).await.expect(200).json();
    let errors: u64 = polled.iter().map(|(_, errors)| errors).sum();
    let mut times: Vec<Duration> = polled.into_iter().flat_map(|(times, _)| times).collect();
    times.sort();
    let p99 = percentile(&times, 99.0);
    let computing = job["state"] == "running" || job["state"] == "succeeded";
    let ok = p99 < 50.0 && errors == 0 && computing && times.len() as u64 > CLIENTS * seconds / 2;
    println!(
        "{}",
        json!({"target": "load_polling", "ok": ok, "clients": CLIENTS, "seconds": seconds,
               "requests": times.len(), "errors": errors, "p50_ms": percentile(&times, 50.0),
               "p99_ms": p99, "max_ms": percentile(&times, 100.0),
               "peak_memory_mib": app.peak_memory()})
    );
    assert!(ok);
}

#[tokio::test]
#[ignore = "gigabytes; run by make load"]
async fn large_uploads_at_once_take_little_memory() {
    const SIDE: usize = 2240;
    const FRAMES: usize = 60;
    let uploads = setting("SCI_RECON_LOAD_UPLOADS", 20);
    let app = TestApp::with(&["--workers", "0"]).await;
    let header = npy_header("<u2", &[FRAMES, SIDE, SIDE]);
    let frame = Bytes::from(vec![0x5au8; SIDE * SIDE * 2]);
    let size = header.len() + FRAMES * frame.len();
    let app = &app;
    let upload = |number: u64| {
        // The first pixels tell the files apart.
        let first = [Bytes::from(header.clone()), Bytes::from(number.to_le_bytes().to_vec())];
        let rest = frame.slice(8..);
        let mut chunks: Vec<_> =
            first.into_iter().chain([rest]).map(Ok::<_, std::io::Error>).collect();
        chunks.extend((1..FRAMES).map(|_| Ok(frame.clone())));
        let body = Body::wrap_stream(futures_util::stream::iter(chunks));
        let request = app.request(Method::POST, "/v1/blobs");
        async move {
            let answer = request.header("content-length", size).body(body).send().await;
            answer.is_ok_and(|answer| answer.status() == 201)
        }
    };
    let start = Instant::now();
    let done = futures_util::future::join_all((0..uploads).map(upload)).await;
    let seconds = start.elapsed().as_secs_f64();
    let stored = done.iter().filter(|good| **good).count() as u64;
    let peak = app.peak_memory();
    let ok = stored == uploads && peak < 300 && size > 600_000_000;
    println!(
        "{}",
        json!({"target": "load_uploads", "ok": ok, "uploads": uploads, "bytes_each": size,
               "stored": stored, "seconds": seconds, "peak_memory_mib": peak})
    );
    assert!(ok);
}
