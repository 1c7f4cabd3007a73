//! Devices of networks: a missing one, and the WebGPU provider on software Vulkan.

use std::path::Path;
use std::process::{Command, Output};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
#[cfg(feature = "gpu")]
use sqlx::ConnectOptions;
#[cfg(feature = "gpu")]
use sqlx::sqlite::SqliteConnectOptions;

use crate::app::{TestApp, has_onnxruntime, skip};
use crate::pipeline::{psnr, values};
use crate::samples::Scene;

/// The software Vulkan of Debian's package chromium.
const ICD: &str = "/usr/lib/chromium/vk_swiftshader_icd.json";
/// Largest difference between CPU and GPU on frames of [0, 1].
const TOLERANCE: f32 = 1e-4;
/// Time for a driver that compiles its kernels on a busy machine.
const PATIENCE: Duration = Duration::from_secs(300);
/// Few passes of the default's priors, with the 32-bit network and without a pilot.
const SCHEDULE: &str = r#"{"adaptive": false, "stages": [
    {"prior": "tv", "iterations": 4, "tv_weight": 0.15, "tolerance": 0},
    {"prior": "nonlocal", "iterations": 1, "sigma": [0.05, 0.05], "tolerance": 0},
    {"prior": "fastdvdnet", "iterations": 1, "sigma": [0.05, 0.05], "tolerance": 0}]}"#;

fn sci_recon(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_sci-recon")).args(arguments).output().unwrap()
}

/// The library with the WebGPU provider, where it and software Vulkan are installed.
fn webgpu() -> Option<String> {
    let library = std::env::var("SCI_RECON_GPU_RUNTIME").unwrap_or_default();
    let exists = Path::new(&library).is_file() && Path::new(ICD).is_file();
    if !exists {
        skip(&format!(
            "SCI_RECON_GPU_RUNTIME names no libonnxruntime with WebGPU ({library:?}), or there is no {ICD}: run \
             scripts/fetch-onnxruntime.sh --gpu FOLDER and apt-get install chromium libvulkan1"
        ));
    }
    exists.then_some(library)
}

#[tokio::test]
async fn a_missing_device_stops_its_workers_at_the_start() {
    if !has_onnxruntime() {
        return;
    }
    for device in ["cuda:0", "gpu"] {
        let app = TestApp::with(&["--workers", "1", "--device", device]).await;
        let start = Instant::now();
        let ready = loop {
            let ready = app.get("/readyz").await.json();
            if ready["device"].as_str().is_some_and(|state| state.contains("refused")) {
                break ready;
            }
            assert!(start.elapsed() < PATIENCE, "{ready}");
            tokio::time::sleep(Duration::from_millis(100)).await;
        };
        assert_eq!(ready["degraded"], json!(true), "{ready}");
        let reason = ready["networks"].as_str().unwrap();
        assert!(reason.contains(device) && reason.contains("fetch-onnxruntime.sh"), "{reason}");
        // The worker for short tasks runs on the CPU, so uploads are still checked.
        let (_, measurement) = app.scene(&Scene::SMALL).await;
        let body = json!({"measurement": measurement, "algorithm": "pnp-tv-fastdvdnet"});
        let detail = app.post("/v1/jobs", &body).await.problem(422, "invalid_request");
        assert!(detail.contains(device), "{detail}");
        let system = app.get("/v1/system").await.expect(200).json();
        let workers = system["workers"].as_array().unwrap();
        assert!(workers.iter().all(|worker| worker["device"] == "cpu"), "{system}");
        assert!(system["degraded"].to_string().contains(device), "{system}");
    }
}

#[test]
fn commands_name_the_remedy_of_a_missing_device() {
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().to_str().unwrap();
    for device in ["cuda:0", "gpu"] {
        let output = sci_recon(&["worker", "--data", data, "--device", device]);
        let message = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert!(message.contains("--device cpu"), "{message}");
    }
    let output = sci_recon(&["serve", "--data", data, "--device", "tpu"]);
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{message}");
    assert!(message.contains("cuda:N"), "{message}");
    let output = sci_recon(&["devices", "--json", "--onnxruntime", "/nowhere/lib.so"]);
    assert_eq!(output.status.code(), Some(1));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    let trials = report["devices"].as_array().unwrap();
    assert_eq!(trials.len(), 3);
    assert!(trials.iter().all(|trial| trial["usable"] == false), "{report}");
}

/// A stated 8-bit network is replaced for all tiles, the manifest says what ran where, and the frames are those of the
/// CPU.
#[tokio::test]
async fn a_job_on_a_gpu_gives_the_frames_of_the_cpu() {
    let Some(library) = webgpu() else { return };
    let options = ["--workers", "1", "--device", "gpu", "--onnxruntime", &library];
    let app = TestApp::in_environment(&options, &[("VK_ICD_FILENAMES", ICD)]).await;
    let scene = Scene { frames: 8, height: 64, width: 64, ..Scene::SMALL };
    let (_, measurement) = app.scene(&scene).await;
    let schedule: Value =
        serde_json::from_str(&SCHEDULE.replace("fastdvdnet", "fastdvdnet-int8")).unwrap();
    let body = json!({"measurement": measurement, "algorithm": "pnp-tv-fastdvdnet", "snapshots": 0, "schedule": schedule});
    let job = app.submit(&body).await;
    let done = app.ended(&job).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    assert_eq!(done["schedule"]["stages"][2]["prior"], "fastdvdnet", "{done:#}");
    let export = |format: &str| format!("/v1/jobs/{job}/snapshots/0/exports/{format}");
    let manifest = app.get(&export("manifest")).await.expect(200).json();
    let models = manifest["content"]["models"].as_array().unwrap();
    assert_eq!((models.len(), &models[0]["name"]), (1, &json!("fastdvdnet-gray")), "{manifest}");
    assert_eq!(manifest["run"]["provider"], "WebGpuExecutionProvider");
    let gpu = manifest["run"]["gpu"].as_str().unwrap_or_default();
    assert_eq!(gpu.contains("SwiftShader"), cfg!(feature = "gpu"), "{manifest}");
    let computed = values(&app.get(&export("npy")).await.expect(200).bytes);

    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    std::fs::write(file("masks.npy"), scene.masks()).unwrap();
    std::fs::write(file("snapshots.npy"), scene.snapshots()).unwrap();
    std::fs::write(file("schedule.json"), SCHEDULE).unwrap();
    let output = sci_recon(&[
        "reconstruct",
        "--masks",
        &file("masks.npy"),
        "--measurement",
        &file("snapshots.npy"),
        "--json",
        "--algorithm",
        "pnp-tv-fastdvdnet",
        "--schedule",
        &file("schedule.json"),
        "--onnxruntime",
        &library,
        "--device",
        "cpu",
        "--out",
        &file("cpu"),
    ]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["provider"], "CPUExecutionProvider");
    let expected = values(&std::fs::read(folder.path().join("cpu/frames.npy")).unwrap());
    let differences = expected.iter().zip(&computed).map(|(one, other)| (one - other).abs());
    let largest = differences.fold(0.0, f32::max);
    let quality = |frames: &[f32]| psnr(scene, 0, frames);
    let decibels = (quality(&expected) - quality(&computed)).abs();
    assert!(decibels < 0.01, "{decibels} dB");
    eprintln!("largest difference between software Vulkan and the CPU: {largest:e}");
    assert!(largest <= TOLERANCE && expected.len() == computed.len(), "{largest}");
}

/// A driver with faults (`shim/faulty_gpu.c`).
#[cfg(feature = "gpu")]
struct FaultyDriver {
    folder: tempfile::TempDir,
    original: std::path::PathBuf,
}

#[cfg(feature = "gpu")]
impl FaultyDriver {
    fn build() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let mut cc = Command::new("cc");
        cc.args(["-shared", "-fPIC", "-O1", "-o"]).arg(folder.path().join("libfaulty_gpu.so"));
        let status = cc.args(["tests/service/shim/faulty_gpu.c", "-ldl"]).status().unwrap();
        assert!(status.success());
        let manifest = |path: &Path| -> Value {
            serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
        };
        let mut own = manifest(Path::new(ICD));
        let original = Path::new(ICD).with_file_name(own["ICD"]["library_path"].as_str().unwrap());
        own["ICD"]["library_path"] = json!(folder.path().join("libfaulty_gpu.so"));
        std::fs::write(folder.path().join("icd.json"), own.to_string()).unwrap();
        Self { folder, original }
    }

    fn file(&self, name: &str) -> String {
        self.folder.path().join(name).to_str().unwrap().to_owned()
    }

    async fn service(&self, arguments: &[&str]) -> TestApp {
        let environment = [
            ("VK_ICD_FILENAMES", self.file("icd.json")),
            ("FAULTY_GPU_DRIVER", self.original.to_str().unwrap().to_owned()),
            ("FAULTY_GPU_LOSS", self.file("loss")),
            ("FAULTY_GPU_FULL", self.file("full")),
        ];
        let environment: Vec<_> =
            environment.iter().map(|(name, value)| (*name, &**value)).collect();
        TestApp::in_environment(arguments, &environment).await
    }

    /// Requests a fault, and waits until it has occurred: `loss` at the next work, or `full` at the next allocation.
    async fn fail(&self, fault: &str) {
        std::fs::write(self.file(fault), "").unwrap();
        let start = Instant::now();
        while Path::new(&self.file(fault)).exists() {
            assert!(start.elapsed() < PATIENCE, "no work reaches the driver");
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    }
}

/// The task of a lost device is lost, not failed: another worker with another device does it at once.
#[cfg(feature = "gpu")]
#[tokio::test]
async fn a_worker_is_replaced_after_the_loss_of_its_device() {
    let Some(library) = webgpu() else { return };
    let driver = FaultyDriver::build();
    let options = ["--workers", "1", "--device", "gpu", "--onnxruntime", &library];
    let app = driver.service(&options).await;
    let scene = Scene { frames: 4, height: 48, width: 48, ..Scene::SMALL };
    let (_, measurement) = app.scene(&scene).await;
    let body = variation(&measurement, 1500, 64);
    let job = app.submit(&body).await;
    let start = Instant::now();
    loop {
        let tiles =
            app.get(&format!("/view/jobs/{job}/snapshots/0/tiles")).await.expect(200).json();
        if tiles["items"][0]["iterations"].as_u64() > Some(0) {
            break;
        }
        assert!(start.elapsed() < PATIENCE, "{tiles}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    driver.fail("loss").await;
    let done = app.ended(&job).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    let figures = String::from_utf8(app.get("/metrics").await.expect(200).bytes).unwrap();
    let exits = "sci_recon_worker_exits_total{reason=\"device_lost\"} 1";
    assert!(figures.lines().any(|line| line == exits), "{figures}");
    let lost = texts(&app, "SELECT reason FROM attempts WHERE outcome = 'lost'").await;
    assert_eq!(lost, ["the GPU of the worker was lost"]);
}

/// A request for a job of total variation, in tiles with sides of up to `tile` pixels.
#[cfg(feature = "gpu")]
fn variation(measurement: &str, iterations: u32, tile: u32) -> Value {
    let stage = json!({"prior": "tv", "iterations": iterations, "tv_weight": 0.1, "tolerance": 0});
    json!({"measurement": measurement, "algorithm": "gap-tv", "snapshots": 0,
        "tile": {"size": tile, "overlap": 8}, "schedule": {"adaptive": false, "stages": [stage]}})
}

/// The texts that a query of the service's database finds.
#[cfg(feature = "gpu")]
async fn texts(app: &TestApp, query: &'static str) -> Vec<String> {
    let options = SqliteConnectOptions::new().filename(app.data().join("sci-recon.db"));
    let mut database = options.connect().await.unwrap();
    sqlx::query_scalar(query).fetch_all(&mut database).await.unwrap()
}

/// Waits until all workers live, and returns their devices.
#[cfg(feature = "gpu")]
async fn devices(app: &TestApp) -> Vec<String> {
    let start = Instant::now();
    loop {
        let system = app.get("/v1/system").await.expect(200).json();
        let workers = system["workers"].as_array().unwrap();
        if system["workers_wanted"] == json!(workers.len()) {
            let device = |worker: &Value| worker["device"].as_str().unwrap().to_owned();
            return workers.iter().map(device).collect();
        }
        assert!(start.elapsed() < PATIENCE, "{system:#}");
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

/// Workers on the GPU take the pilot and the tiles, and workers on the CPU the other tasks. The rates of both are learned
/// apart.
#[cfg(feature = "gpu")]
#[tokio::test]
async fn workers_on_the_cpu_take_the_other_tasks() {
    let Some(library) = webgpu() else { return };
    let options = ["--workers", "2", "--device", "gpu", "--onnxruntime", &library];
    let app = TestApp::in_environment(&options, &[("VK_ICD_FILENAMES", ICD)]).await;
    let found = devices(&app).await;
    let on_gpu = found.iter().filter(|device| *device == "gpu").count();
    assert!(on_gpu == 2 && (3..=6).contains(&found.len()), "{found:?}");
    let scene = Scene { frames: 4, height: 64, width: 176, ..Scene::SMALL };
    let (_, measurement) = app.scene(&scene).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv3d", "snapshots": 0,
        "tile": {"size": 64, "overlap": 8}});
    let job = app.submit(&body).await;
    let done = app.ended(&job).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    let on_gpu = "SELECT kind FROM rates WHERE device = 'gpu' ORDER BY kind";
    assert_eq!(texts(&app, on_gpu).await, ["pilot", "tile"]);
    let on_cpu = texts(&app, "SELECT kind FROM rates WHERE device = 'cpu'").await;
    for kind in ["prepare", "preview", "white", "assemble", "manifest"] {
        assert!(on_cpu.iter().any(|found| found == kind), "{kind} is not in {on_cpu:?}");
    }
    assert!(!on_cpu.iter().any(|kind| kind == "tile" || kind == "pilot"), "{on_cpu:?}");
}

/// A tile runs again if the GPU was full for a moment.
#[cfg(feature = "gpu")]
#[tokio::test]
async fn a_tile_on_a_full_gpu_runs_again_without_networks() {
    let Some(library) = webgpu() else { return };
    let driver = FaultyDriver::build();
    let options = ["--workers", "1", "--device", "gpu", "--onnxruntime", &library];
    let app = driver.service(&options).await;
    devices(&app).await;
    // The arrays of a tile exceed the memory that the driver keeps.
    let scene = Scene { frames: 8, height: 256, width: 256, ..Scene::SMALL };
    let (_, measurement) = app.scene(&scene).await;
    let job = app.submit(&variation(&measurement, 3, 256)).await;
    driver.fail("full").await;
    let done = app.ended(&job).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    let failures = "SELECT coalesce(reason, outcome) FROM attempts WHERE outcome <> 'done'";
    assert_eq!(texts(&app, failures).await, [""; 0]);
}

/// All steps of the script for machines with a card, with few iterations.
#[cfg(feature = "gpu")]
#[test]
fn the_check_of_a_gpu_runs_all_steps() {
    let Some(library) = webgpu() else { return };
    let mut script = Command::new("scripts/gpu-check.sh");
    script.args(["--short", "--seconds", "900", "--library", &library]);
    script.args(["--program", env!("CARGO_BIN_EXE_sci-recon")]);
    let output = script.env("VK_ICD_FILENAMES", ICD).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stdout));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&report["agrees"], &report["skipped"]), (&json!(true), &json!([])), "{report:#}");
    let kernels = report["kernels"]["mvoxel_per_s"]["16"].as_object().unwrap();
    assert!(kernels.contains_key("loop") && kernels.contains_key("nonlocal prior"), "{report:#}");
    for size in ["16", "32"] {
        assert!(report["speed"][size]["job_seconds"].as_f64() > Some(0.0), "{report:#}");
    }
}
