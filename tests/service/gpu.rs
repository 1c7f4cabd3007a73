//! Devices of networks: a missing one, and the WebGPU provider on software Vulkan.

use std::path::Path;
use std::process::{Command, Output};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::app::{TestApp, has_onnxruntime, skip};
use crate::pipeline::{psnr, values};
use crate::samples::Scene;

/// The software Vulkan of Debian's package chromium.
const ICD: &str = "/usr/lib/chromium/vk_swiftshader_icd.json";
/// Largest difference between CPU and GPU on frames of [0, 1].
const TOLERANCE: f32 = 1e-4;
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
            assert!(start.elapsed() < Duration::from_secs(60), "{ready}");
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
        assert_eq!(system["workers"], json!([]));
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
