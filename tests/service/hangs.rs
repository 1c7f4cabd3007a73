//! Tasks and workers that hang or crash in native code. Test libraries take the place of ONNX
//! Runtime.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use engine::pipeline::usage::peak_rss_of;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::{Value, json};

use crate::app::{TestApp, id};
use crate::faults::children;
use crate::samples::Scene;

/// Builds a library with this body of its entry point.
pub fn library(folder: &Path, body: &str) -> PathBuf {
    let (source, library) = (folder.join("fake.c"), folder.join("libfake.so"));
    let code = format!(
        "#include <stdlib.h>\n#include <unistd.h>\nconst void *OrtGetApiBase(void) {{ {body} }}\n"
    );
    std::fs::write(&source, code).unwrap();
    let mut cc = Command::new("cc");
    let status = cc.args(["-shared", "-fPIC", "-o"]).arg(&library).arg(&source).status().unwrap();
    assert!(status.success());
    library
}

fn number(process: &Pid) -> u32 {
    process.as_raw_nonzero().get().unsigned_abs()
}

fn deep(measurement: &str) -> Value {
    json!({
        "measurement": measurement,
        "algorithm": "pnp-tv-fastdvdnet",
        "snapshots": 0,
        "schedule": {"stages": [{"prior": "fastdvdnet", "iterations": 1, "sigma": [0.2, 0.1]}]},
    })
}

async fn with_library(body: &str, stall_seconds: &str) -> (tempfile::TempDir, TestApp) {
    let folder = tempfile::tempdir().unwrap();
    let library = library(folder.path(), body);
    let library = library.to_str().unwrap();
    let arguments = ["--workers", "1", "--stall-seconds", stall_seconds, "--onnxruntime", library];
    let arguments = [&arguments[..], &["--check-seconds", "8"]].concat();
    (folder, TestApp::with(&arguments).await)
}

#[tokio::test]
async fn a_hanging_task_is_retried_and_abandoned() {
    let (folder, app) = with_library("for (;;) pause();", "1").await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let done = app.ended(&app.submit(&deep(&measurement)).await).await;
    assert_eq!(done["state"], "failed", "{done:#}");
    let error = done["error"].as_str().unwrap();
    assert!(error.contains("no progress") && error.contains("(3 attempts)"), "{error}");
    assert!(!error.contains(folder.path().to_str().unwrap()), "{error}");
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    assert_eq!(app.ended(&app.submit(&body).await).await["state"], "succeeded");
}

#[tokio::test]
async fn a_task_that_kills_its_workers_is_abandoned() {
    let (_folder, app) = with_library("abort();", "1").await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let done = app.ended(&app.submit(&deep(&measurement)).await).await;
    assert_eq!(done["state"], "failed", "{done:#}");
    let error = done["error"].as_str().unwrap();
    assert!(error.contains("SIGABRT") && error.contains("(3 attempts)"), "{error}");
    // The job and the list state the same problem.
    let problem = &done["problem"];
    assert_eq!(problem["code"], "worker_crashed", "{problem:#}");
    assert_eq!(problem["detail"], error);
    assert_eq!(
        (&problem["stage"], &problem["snapshot"], &problem["tile"]),
        (&json!("tile"), &json!(0), &json!(0))
    );
    assert_eq!((&problem["attempts"], &problem["retryable"]), (&json!(3), &json!(true)));
    assert!(problem["remedy"].as_str().unwrap().contains("Retry the job"), "{problem:#}");
    let list = app.get("/v1/jobs").await.expect(200).json();
    assert_eq!(list["items"][0]["problem"], *problem);
}

#[tokio::test]
async fn hanging_networks_delay_no_other_work_and_are_refused() {
    let (_folder, app) = with_library("for (;;) pause();", "1").await;
    let (calibration, measurement) = app.scene(&Scene::SMALL).await;
    let model = async |content: &[u8]| {
        let file = app.upload(content.to_vec()).await;
        app.post("/v1/models", &json!({"calibration": calibration, "file": file})).await
    };
    let hanging = async {
        let refused = tokio::join!(model(b"one"), model(b"two"));
        (refused, Instant::now())
    };
    let others = async {
        tokio::time::sleep(Duration::from_secs(1)).await;
        let masks = app.upload(Scene::SMALL.masks()).await;
        app.post("/v1/calibrations", &json!({"masks": masks})).await.expect(201);
        app.measure(&calibration, Scene::SMALL.snapshots()).await.expect(201);
        let job = app.submit(&json!({"measurement": measurement, "algorithm": "gap-tv"})).await;
        assert_eq!(app.ended(&job).await["state"], "succeeded");
        Instant::now()
    };
    let (((one, two), end), done) = tokio::join!(hanging, others);
    assert!(done < end, "other work waited for a network");
    for refused in [one, two] {
        let detail = refused.problem(422, "invalid_content");
        assert!(detail.contains("one run of the network takes more than"), "{detail}");
    }
    assert_eq!(app.get("/v1/models").await.json()["items"], json!([]));
}

#[tokio::test]
async fn a_network_that_floods_its_output_is_refused_with_little_memory() {
    let flood = "static char block[1 << 20]; for (int i = 0; i < 512; i++)
        for (size_t done = 0; done < sizeof block;) {
            ssize_t n = write(1 + i % 2, block + done, sizeof block - done);
            if (n < 0) _exit(7);
            done += n;
        }
        abort();";
    let (_folder, app) = with_library(flood, "60").await;
    let (calibration, measurement) = app.scene(&Scene::SMALL).await;
    let job = json!({"measurement": measurement, "algorithm": "gap-tv"});
    assert_eq!(app.ended(&app.submit(&job).await).await["state"], "succeeded");
    let workers = || children(app.pid()).iter().map(number).collect();
    let processes = || [vec![app.pid()], workers()].concat();
    let before = processes();
    let peaks = |of: &[u32]| of.iter().map(|one| peak_rss_of(*one) >> 20).collect::<Vec<_>>();
    let first = peaks(&before);
    let file = app.upload(b"one".to_vec()).await;
    let refused = app.post("/v1/models", &json!({"calibration": calibration, "file": file})).await;
    let detail = refused.problem(422, "invalid_content");
    assert!(detail.contains("SIGABRT"), "{detail}");
    assert_eq!(processes(), before, "no process has ended");
    let then = peaks(&before);
    eprintln!("peak memory before {first:?} MiB, after {then:?} MiB");
    assert!(first.iter().zip(&then).all(|(first, then)| then - first < 32), "{first:?} {then:?}");
}

#[tokio::test]
async fn a_stop_does_not_wait_for_a_hanging_task() {
    let folder = tempfile::tempdir().unwrap();
    let library = library(folder.path(), "for (;;) pause();");
    let library = library.to_str().unwrap();
    let mut app = TestApp::with(&["--workers", "1", "--onnxruntime", library]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let job = app.submit(&deep(&measurement)).await;
    app.when(&job, |job| job["progress"]["tiles_running"] == 1).await;
    let start = Instant::now();
    assert!(app.stop().success());
    let took = start.elapsed();
    assert!((4..8).contains(&took.as_secs()), "a worker returns its task within 5 s: {took:?}");
}

#[tokio::test]
async fn a_hanging_worker_is_replaced() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let start = Instant::now();
    while app.workers().is_empty() {
        assert!(start.elapsed() < Duration::from_secs(10), "a worker should run");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    // The worker has started, and computes.
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    assert_eq!(app.ended(&app.submit(&body).await).await["state"], "succeeded");
    kill_process(app.workers()[0], Signal::STOP).unwrap();
    // The worker may have been stopped while it wrote to the database.
    let start = Instant::now();
    let job = loop {
        let answer = app.post("/v1/jobs", &body).await;
        if answer.status != 503 || start.elapsed() > Duration::from_secs(60) {
            break id(&answer.expect(201));
        }
        tokio::time::sleep(Duration::from_millis(200)).await;
    };
    assert_eq!(app.ended(&job).await["state"], "succeeded");
}

/// A memory control group below that of the tests.
struct Group(PathBuf);

impl Group {
    /// Creates a group with a memory limit in bytes. Prints a message and returns `None` if this machine does not allow
    /// it.
    fn new(bytes: u64) -> Option<Self> {
        let groups = std::fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
        let group = groups.lines().find_map(|line| {
            let (controllers, path) = line.split_once(':')?.1.split_once(':')?;
            let (root, limit) = match controllers {
                "memory" => ("/sys/fs/cgroup/memory", "memory.limit_in_bytes"),
                "" => ("/sys/fs/cgroup", "memory.max"),
                _ => return None,
            };
            let name = format!("{root}{path}/sci-recon-{}", std::process::id());
            std::fs::create_dir(&name).ok()?;
            // From here on, dropping the group removes it.
            let group = Self(name.into());
            std::fs::write(group.0.join(limit), bytes.to_string()).ok()?;
            Some(group)
        });
        if group.is_none() {
            eprintln!("SKIPPED: this machine allows no control group for memory");
        }
        group
    }

    fn add(&self, process: u32) {
        std::fs::write(self.0.join("cgroup.procs"), process.to_string()).unwrap();
    }
}

impl Drop for Group {
    fn drop(&mut self) {
        // The kernel releases the group a moment after its last process.
        for _ in 0..100 {
            if std::fs::remove_dir(&self.0).is_ok() {
                return;
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        eprintln!("{} is left", self.0.display());
    }
}

#[tokio::test]
async fn a_task_that_exceeds_the_memory_limit_is_abandoned() {
    let Some(group) = Group::new(300 << 20) else { return };
    let greedy = "for (;;) { char *p = malloc(1 << 20); if (!p) abort();
        for (int i = 0; i < 1 << 20; i += 4096) p[i] = 1; usleep(2000); }";
    let (_folder, app) = with_library(greedy, "60").await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    // Child processes inherit the group. The worker that runs already is outside.
    group.add(app.pid());
    app.kill_worker(0);
    let job = app.submit(&deep(&measurement)).await;
    let done = app.ended(&job).await;
    assert_eq!(done["state"], "failed", "{done:#}");
    let error = done["error"].as_str().unwrap();
    assert!(error.contains("no memory left") && error.contains(" attempts)"), "{error}");
    let peak = error.split("it used ").nth(1).and_then(|text| text.split(' ').next());
    let peak: u64 = peak.and_then(|peak| peak.parse().ok()).unwrap_or_default();
    // The limit also counts pages of the program file, which another group may have loaded.
    assert!((1..=450).contains(&peak), "{error}");
    // The service was not killed, and continues.
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    assert_eq!(app.ended(&app.submit(&body).await).await["state"], "succeeded");
    let figures = String::from_utf8(app.get("/metrics").await.expect(200).bytes).unwrap();
    let exits = "sci_recon_worker_exits_total{reason=\"starved\"} ";
    let exits = figures.lines().find_map(|line| line.strip_prefix(exits)?.parse().ok());
    // The task takes five workers. The group may also end a worker that waits.
    assert!(matches!(exits, Some(5..=10)), "{figures}");
    drop(app);
}
