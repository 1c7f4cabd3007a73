//! Load tests, run by `make load` because they take minutes and gigabytes.

use std::time::{Duration, Instant};

use bytes::Bytes;
use reqwest::{Body, Method};
use serde_json::{Value, json};

use crate::app::TestApp;
use crate::crashes::Shim;
use crate::downloads::{ask_during_slow_downloads, touch_all};
use crate::samples::{Scene, npy_header};

fn setting(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |text| text.parse().unwrap())
}

/// A job that keeps both cores busy during the whole test.
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

/// The value below which `of_hundred` per cent of the sorted durations lie.
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
        // One request per second and client, at different moments.
        tokio::time::sleep(Duration::from_millis(client * 5)).await;
        while Instant::now() < end {
            let start = Instant::now();
            let answer = app.request(Method::GET, &path).send().await;
            let is_complete = match answer {
                Ok(answer) if answer.status() == 200 => answer.bytes().await.is_ok(),
                _ => false,
            };
            times.push(start.elapsed());
            errors += u64::from(!is_complete);
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
#[ignore = "minutes; run by make load"]
async fn two_hundred_slow_clients_download_while_another_lab_asks() {
    const CLIENTS: usize = 200;
    let seconds = setting("SCI_RECON_LOAD_SLOW_SECONDS", 120);
    let answers = ask_during_slow_downloads(CLIENTS, Duration::from_secs(seconds)).await;
    let errors = answers.iter().filter(|(status, _)| *status != 200).count();
    let mut times: Vec<Duration> = answers.into_iter().map(|(_, took)| took).collect();
    times.sort();
    let p99 = percentile(&times, 99.0);
    let ok = p99 < 100.0 && errors == 0 && times.len() as u64 > 10 * seconds;
    println!(
        "{}",
        json!({"target": "load_slow_downloads", "ok": ok, "clients": CLIENTS, "seconds": seconds,
               "requests": times.len(), "errors": errors, "p50_ms": percentile(&times, 50.0),
               "p99_ms": p99, "max_ms": percentile(&times, 100.0)})
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
        // The first pixels make the files different.
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

#[tokio::test]
#[ignore = "gigabytes; run by make load"]
async fn a_large_file_comes_from_a_slow_disk() {
    const PIECE: usize = 1 << 20;
    const BYTES_PER_SECOND: u64 = 100_000_000;
    let size = setting("SCI_RECON_LOAD_FILE_BYTES", 4 << 30).next_multiple_of(PIECE as u64);
    let (shim, rate) = (Shim::build(), BYTES_PER_SECOND.to_string());
    let slow = shim.file("slow");
    let faults = [("FAULT_SLOW", slow.to_str().unwrap()), ("FAULT_RATE", &rate)];
    let app = shim.service(&["--workers", "0", "--scrub-bytes", "0"], &faults).await;
    let piece = Bytes::from(vec![0x5au8; PIECE]);
    let pieces = (0..size / PIECE as u64).map(move |_| Ok::<_, std::io::Error>(piece.clone()));
    let body = Body::wrap_stream(futures_util::stream::iter(pieces));
    let request = app.request(Method::POST, "/v1/blobs").header("content-length", size).body(body);
    let sent = app.send(request).await.expect(201).json();
    let path = format!("/v1/blobs/{}/content", sent["sha256"].as_str().unwrap());
    std::fs::write(&slow, []).unwrap();
    let mut first_byte = Vec::new();
    let mut first = async || {
        let start = Instant::now();
        let answer = app.request(Method::GET, &path).send().await.unwrap();
        first_byte.push(start.elapsed().as_secs_f64());
        answer
    };
    // The hash is known from the upload; unknown; known from the last read.
    let mut answers = vec![first().await];
    touch_all(&app.data().join("blobs"));
    answers.push(first().await);
    answers.push(first().await);
    let good = answers.iter().filter(|answer| answer.status() == 200).count();
    let mut last = answers.pop().unwrap();
    drop(answers);
    let (start, mut bytes) = (Instant::now(), 0);
    while let Ok(Some(chunk)) = last.chunk().await {
        bytes += chunk.len() as u64;
    }
    let ok = good == 3 && bytes == size && first_byte[0] < 1.0 && first_byte[2] < 1.0;
    println!(
        "{}",
        json!({"target": "load_large_file", "ok": ok, "bytes": size, "good": good,
               "disk_bytes_per_second": BYTES_PER_SECOND, "seconds_to_first_byte": first_byte,
               "seconds_to_last_byte": start.elapsed().as_secs_f64(),
               "peak_memory_mib": app.peak_memory()})
    );
    assert!(ok);
}

#[tokio::test]
#[ignore = "minutes; run by make load"]
async fn large_jobs_in_a_long_queue_do_not_slow_answers() {
    // 729 tiles each.
    let scene = Scene { frames: 4, height: 440, width: 440, snapshots: 1 };
    long_queue("load_large_jobs", scene, setting("SCI_RECON_LOAD_LARGE", 800)).await;
}

#[tokio::test]
#[ignore = "minutes; run by make load"]
async fn small_jobs_in_a_long_queue_do_not_slow_answers() {
    let scene = Scene { frames: 4, height: 24, width: 24, snapshots: 1 };
    long_queue("load_small_jobs", scene, setting("SCI_RECON_LOAD_SMALL", 20_000)).await;
}

/// Submits jobs, then lets 50 clients request one of them and the list once a second, while more
/// jobs are submitted.
async fn long_queue(target: &str, scene: Scene, jobs: u64) {
    const CLIENTS: u64 = 50;
    const SUBMITTERS: u64 = 4;
    let seconds = setting("SCI_RECON_LOAD_QUEUE_SECONDS", 30);
    let app = TestApp::with(&["--workers", "0", "--max-jobs", "1000000"]).await;
    let (_, measurement) = app.scene(&scene).await;
    let app = &app;
    let job = json!({"measurement": measurement, "algorithm": "gap-tv",
                     "tile": {"size": 24, "overlap": 8}});
    let submit = || {
        let request = app.request(Method::POST, "/v1/jobs").json(&job);
        async move {
            let start = Instant::now();
            let answer = request.send().await.unwrap();
            let status = answer.status();
            let job: Value = answer.json().await.unwrap();
            assert_eq!(status, 201, "{job}");
            (job["id"].as_str().unwrap().to_owned(), start.elapsed())
        }
    };
    let started = Instant::now();
    let fill = |_| async move {
        let mut ids = Vec::new();
        for _ in 0..jobs / SUBMITTERS {
            ids.push(submit().await.0);
        }
        ids
    };
    let ids = futures_util::future::join_all((0..SUBMITTERS).map(fill)).await.concat();
    let filled = started.elapsed();
    let end = Instant::now() + Duration::from_secs(seconds);
    let ids = &ids;
    let ask = |path: String| async move {
        let start = Instant::now();
        let answer = app.request(Method::GET, &path).send().await.unwrap();
        assert_eq!(answer.status(), 200);
        answer.bytes().await.unwrap();
        start.elapsed()
    };
    let poll = |client: u64| async move {
        let mut times = Vec::new();
        tokio::time::sleep(Duration::from_millis(client * 20)).await;
        while Instant::now() < end {
            let start = Instant::now();
            let id = &ids[(client as usize * 7919) % ids.len()];
            times.push(ask(format!("/v1/jobs/{id}")).await);
            times.push(ask("/v1/jobs?limit=50".into()).await);
            tokio::time::sleep(Duration::from_secs(1).saturating_sub(start.elapsed())).await;
        }
        times
    };
    let more = async {
        let mut times = Vec::new();
        while Instant::now() < end {
            times.push(submit().await.1);
            tokio::time::sleep(Duration::from_millis(500)).await;
        }
        times
    };
    let polled = futures_util::future::join_all((0..CLIENTS).map(poll));
    let (polled, mut posts) = futures_util::future::join(polled, more).await;
    let mut gets = polled.concat();
    gets.sort();
    posts.sort();
    let (get, post) = (percentile(&gets, 99.0), percentile(&posts, 99.0));
    let ok = get < 50.0 && post < 50.0;
    println!(
        "{}",
        json!({"target": target, "ok": ok, "jobs": ids.len(), "seconds_to_fill": filled.as_secs_f64(),
               "gets": gets.len(), "get_p50_ms": percentile(&gets, 50.0), "get_p99_ms": get,
               "posts": posts.len(), "post_p50_ms": percentile(&posts, 50.0), "post_p99_ms": post,
               "peak_memory_mib": app.peak_memory()})
    );
    assert!(ok);
}
