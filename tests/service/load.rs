//! Load tests, run by `make load` because they take minutes and gigabytes.

use std::time::{Duration, Instant};

use base64::Engine;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use bytes::Bytes;
use reqwest::{Body, Method};
use serde_json::{Value, json};
use sqlx::Connection;

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
    // Each job has 729 tiles.
    let scene = Scene { frames: 4, height: 440, width: 440, snapshots: 1 };
    long_queue("load_large_jobs", scene, setting("SCI_RECON_LOAD_LARGE", 800)).await;
}

#[tokio::test]
#[ignore = "minutes; run by make load"]
async fn small_jobs_in_a_long_queue_do_not_slow_answers() {
    let scene = Scene { frames: 4, height: 24, width: 24, snapshots: 1 };
    long_queue("load_small_jobs", scene, setting("SCI_RECON_LOAD_SMALL", 20_000)).await;
}

/// Statements that copy a finished job, a waiting job and a measurement. Parameters: the numbers of copies.
const COPIES: [&str; 13] = [
    "PRAGMA synchronous = OFF",
    "CREATE TEMP TABLE numbers AS
         WITH RECURSIVE number(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM number WHERE n < max(?1 + ?2, ?3))
         SELECT n FROM number",
    "CREATE TEMP TABLE copies AS
         SELECT n, printf('01a00000-0000-7000-8000-%012d', n) AS job,
             (SELECT min(id) FROM jobs WHERE state = iif(n <= ?1, 'succeeded', 'queued')) AS original
         FROM numbers WHERE n <= ?1 + ?2",
    "INSERT INTO jobs (id, lab, calibration, measurement, spec, state, priority, disk_bytes, result_bytes,
         assessment, created_at, started_at, finished_at)
     SELECT job, lab, calibration, measurement, spec, state, priority, 1000, result_bytes,
         assessment, created_at, started_at, finished_at
     FROM copies JOIN jobs ON id = original",
    "INSERT INTO tasks (id, job, lab, ordinal, kind, light, snapshot, snapshots, tile, state, priority, cost,
         attempt, iterations, passes, fraction, seconds, record, history)
     SELECT printf('01a00000-0000-7000-%04d-%012d', 8000 + ordinal, n), copies.job, lab, ordinal, kind, light,
         snapshot, snapshots, tile, state, priority, cost, attempt, iterations, passes, fraction, seconds, record,
         history
     FROM copies JOIN tasks ON tasks.job = original",
    "INSERT INTO attempts (task, attempt, worker, started_at, ended_at, outcome, reason)
     SELECT printf('01a00000-0000-7000-%04d-%012d', 8000 + ordinal, n), attempts.attempt, attempts.worker,
         started_at, ended_at, outcome, reason
     FROM copies JOIN tasks ON tasks.job = original JOIN attempts ON task = tasks.id",
    "INSERT INTO job_sums
     SELECT copies.job, cost, tiles_left, tiles_longest, others_left, others_longest, tiles_total,
         tiles_done, tile_seconds, tile_cost, prepared, previews_done, snapshots_done, iterations, passes
     FROM copies JOIN job_sums ON job_sums.job = original",
    "INSERT INTO result_files (job, snapshot, name, size, sha256, crc32, derived)
     SELECT copies.job, snapshot, name, size, sha256, crc32, derived
     FROM copies JOIN result_files ON result_files.job = original",
    "INSERT INTO blobs (sha256, size, origin, created_at, touched_at)
     SELECT printf('%064x', n), 1000, iif(n % 2, 'upload', 'prepared'), created_at, touched_at
     FROM numbers, (SELECT * FROM blobs LIMIT 1) WHERE n <= 2 * ?3",
    "INSERT INTO holdings (lab, sha256, created_at, touched_at)
     SELECT 'local', sha256, created_at, touched_at FROM blobs WHERE origin = 'upload' AND size = 1000",
    "INSERT INTO requests (id, what, lab, calibration, request, limits, created_at, prepared, facts)
     SELECT printf('01a00000-0000-7000-9000-%012d', n), what, lab, calibration, request, limits, created_at,
         printf('%064x', 2 * n), json_set(facts, '$.data', printf('%064x', 2 * n - 1))
     FROM numbers, (SELECT * FROM requests WHERE what = 'measurement' LIMIT 1) WHERE n <= ?3",
    "INSERT INTO request_files (id, sha256)
     SELECT printf('01a00000-0000-7000-9000-%012d', n), printf('%064x', 2 * n - 1) FROM numbers WHERE n <= ?3",
    "DROP TABLE temp.numbers",
];

/// Fills the database of a stopped service with `finished` finished and `waiting` waiting jobs, and a measurement for
/// every second finished job.
async fn fill(app: &TestApp, finished: u64, waiting: u64) {
    let mut database = app.database().await;
    // The trigger would write the row of the job again for each of its files.
    let trigger = "SELECT sql FROM sqlite_master WHERE name = 'result_files_add'";
    let trigger: String = sqlx::query_scalar(trigger).fetch_one(&mut database).await.unwrap();
    sqlx::query("DROP TRIGGER result_files_add").execute(&mut database).await.unwrap();
    for text in COPIES {
        let copy = sqlx::query(text).bind(finished as i64).bind(waiting as i64);
        copy.bind(finished as i64 / 2).execute(&mut database).await.unwrap();
    }
    sqlx::query(sqlx::AssertSqlSafe(trigger)).execute(&mut database).await.unwrap();
    database.close().await.unwrap();
    for job in 1..=finished {
        let folder = format!("results/01a00000-0000-7000-8000-{job:012}");
        std::fs::create_dir(app.data().join(folder)).unwrap();
    }
}

#[tokio::test]
#[ignore = "minutes; run by make load"]
async fn finished_jobs_do_not_slow_answers() {
    const REQUESTS: usize = 200;
    let finished = setting("SCI_RECON_LOAD_FINISHED", 100_000);
    let waiting = setting("SCI_RECON_LOAD_WAITING", 20_000);
    let most = (2 * waiting + 1000).to_string();
    let idle = ["--workers", "0", "--scrub-bytes", "0", "--max-jobs", &most];
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene { snapshots: 1, ..Scene::SMALL }).await;
    let request = json!({"measurement": measurement, "algorithm": "gap-tv"});
    let model = app.submit(&request).await;
    assert_eq!(app.ended(&model).await["state"], "succeeded");
    let mut app = app.again(&idle).await;
    app.submit(&request).await;
    assert!(app.stop().success());
    let start = Instant::now();
    fill(&app, finished, waiting).await;
    let seconds_to_fill = start.elapsed().as_secs_f64();
    let start = Instant::now();
    let app = app.again(&idle).await;
    let seconds_to_start = start.elapsed().as_secs_f64();
    let database_bytes = std::fs::metadata(app.data().join("sci-recon.db")).unwrap().len();
    // An open dashboard listens.
    let events = app.request(Method::GET, "/v1/events").send().await.unwrap();
    let counted = app.get("/v1/system").await.expect(200).json();
    assert_eq!(counted["jobs"]["succeeded"], finished + 1);
    assert_eq!(counted["jobs"]["queued"], waiting + 1);
    let middle = format!("01a00000-0000-7000-8000-{:012}", finished / 2);
    let deep = format!("/v1/jobs?cursor={}", URL_SAFE_NO_PAD.encode(middle));
    let last = format!("/v1/jobs/01a00000-0000-7000-8000-{:012}", finished + waiting);
    let paths = [
        "/v1/jobs",
        "/v1/jobs?limit=200",
        "/v1/jobs?state=failed",
        "/v1/jobs?state=queued",
        "/v1/jobs?search=nothing",
        "/v1/jobs?label=nothing",
        &deep,
        &format!("/v1/jobs/{model}"),
        &last,
        "/v1/measurements",
        "/v1/calibrations",
        "/v1/models",
        "/v1/blobs",
        "/v1/uploads",
        "/v1/labs",
        "/v1/labs/local",
        "/v1/me",
        "/v1/system",
        "/readyz",
        "/metrics",
    ];
    let mut ok = seconds_to_start < 2.0 && database_bytes < 1_000_000_000;
    let mut figures = serde_json::Map::new();
    let mut times =
        async |name: &str, request: &dyn Fn() -> reqwest::RequestBuilder, status: u16| {
            let mut times = Vec::new();
            for _ in 0..REQUESTS {
                let start = Instant::now();
                let answer = request().send().await.unwrap();
                assert_eq!(answer.status(), status, "{name}");
                answer.bytes().await.unwrap();
                times.push(start.elapsed());
            }
            times.sort();
            let (p50, p99) = (percentile(&times, 50.0), percentile(&times, 99.0));
            ok &= match name {
                "POST" => p50 < 20.0,
                "/metrics" => p99 < 100.0,
                _ => p99 < 50.0,
            };
            figures.insert(name.into(), json!({"p50_ms": p50, "p99_ms": p99}));
        };
    for path in paths {
        // Without workers the service is not ready.
        let status = if path == "/readyz" { 503 } else { 200 };
        times(path, &|| app.request(Method::GET, path), status).await;
    }
    times("POST", &|| app.request(Method::POST, "/v1/jobs").json(&request), 201).await;
    drop(events);
    println!(
        "{}",
        json!({"target": "load_finished_jobs", "ok": ok, "finished": finished, "waiting": waiting,
               "seconds_to_fill": seconds_to_fill, "seconds_to_start": seconds_to_start,
               "database_bytes": database_bytes, "answers": figures,
               "peak_memory_mib": app.peak_memory()})
    );
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
