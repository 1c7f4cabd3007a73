//! The kernels against the readable reference, on any Vulkan device, for example SwiftShader.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, OnceLock};

use ndarray::{Array3, s};
use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};
use serde_json::json;
use wgpu::MemoryHints;

use super::adapter::Gpu;
use super::nonlocal::Clip;
use super::speed;
use crate::error::{ReconError, Result};
use crate::operator::SensingOperator;
use crate::priors::{Denoiser, Network, Networks};
use crate::reference::{Problem, max_difference};
use crate::schedule::Schedule;
use crate::solver::{Control, Observer, Outcome, Progress, reconstruct};
use crate::{admm, gap};

/// Largest difference, relative to the largest value.
const TOLERANCE: f64 = 1e-4;

/// Networks of a machine with this GPU.
pub(crate) struct On(pub(crate) Arc<Gpu>);

impl Networks for On {
    fn network(&mut self, _: Network) -> Result<&mut dyn Denoiser> {
        Err(ReconError::NoDenoiser)
    }

    fn gpu(&mut self) -> Result<Option<Arc<Gpu>>> {
        Ok(Some(Arc::clone(&self.0)))
    }
}

fn is_missing(error: &ReconError) -> bool {
    error.to_string().contains("no GPU with a Vulkan driver")
}

/// The GPU of this machine. Without one, tests pass, except in CI.
pub(crate) fn gpu() -> Option<Arc<Gpu>> {
    static GPU: OnceLock<Option<Arc<Gpu>>> = OnceLock::new();
    let open = || match Gpu::open() {
        Ok(gpu) => Some(Arc::new(gpu)),
        Err(error) if is_missing(&error) && std::env::var_os("CI").is_none() => {
            eprintln!("skipped: {error}");
            None
        }
        Err(error) => panic!("{error}"),
    };
    GPU.get_or_init(open).clone()
}

/// The GPU with buffers of at most so many bytes.
pub(crate) fn small_gpu(bytes: u64) -> Arc<Gpu> {
    let gpu = Gpu::open_with(|request| {
        request.required_limits.max_storage_buffer_binding_size = bytes;
    });
    Arc::new(gpu.unwrap())
}

fn relative_difference(frames: &Array3<f32>, reference: &[f64]) -> f64 {
    let largest = reference.iter().fold(0.0, |one: f64, other| one.max(other.abs()));
    max_difference(frames, reference) / largest
}

/// Projection (with and without covariance, acceleration, noise), total variation along time and of frames, extrapolation.
#[test]
fn iterations_are_those_of_the_equations() {
    let Some(gpu) = gpu() else { return };
    let (mut on, mut largest) = (On(gpu), 0.0f64);
    for seed in 0..16 {
        let generator = || ChaCha8Rng::seed_from_u64(seed);
        let mut rng = generator();
        let method = ["gap", "admm"][seed as usize % 2];
        let mut problem = match seed {
            0 => Problem::with_size((8, 64, 64), generator(), method),
            1 => Problem::with_size((3, 1, 1), generator(), method),
            _ => Problem::random(seed, method),
        };
        let mut schedule = serde_json::to_value(&problem.schedule).unwrap();
        let stage = &mut schedule["stages"][0];
        let spatial = [0.1, 0.3, 0.0][rng.random_range(0..3)];
        let along_time = [0.0, 0.02][rng.random_range(0..2)];
        stage["prior"] = json!("tv");
        stage["tv_weight"] = json!(spatial);
        stage["temporal_weight"] = json!(along_time);
        stage["tv_updates"] = json!(rng.random_range(1..15));
        stage.as_object_mut().unwrap().remove("sigma");
        problem.schedule = serde_json::from_value(schedule).unwrap();
        let reference = match method {
            "gap" => gap::tests::reference(&problem),
            _ => admm::tests::reference(&problem),
        };
        for (place, frames) in [("GPU", problem.solve_with(&mut on)), ("CPU", problem.solve())] {
            let difference = relative_difference(&frames, &reference);
            assert!(difference < TOLERANCE, "{place} {seed}: {difference}, {:?}", problem.schedule);
            largest = largest.max(difference);
        }
    }
    eprintln!("largest difference from the reference, relative to the largest value: {largest:e}");
}

/// A moving grating behind random masks; some pixels are not measured.
fn scene() -> (SensingOperator, Array3<f32>) {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let masks = Array3::from_shape_simple_fn((4, 40, 32), || rng.random::<f32>().round());
    let operator = SensingOperator::new(masks).unwrap();
    let frames = Array3::from_shape_fn((4, 40, 32), |(k, i, j)| {
        0.5 + 0.4 * ((i + 2 * j) as f32 / 5.0 + k as f32 / 2.0).sin()
    });
    let mut y = operator.forward(frames.view()).unwrap();
    y.slice_mut(s![.., 20..23, 22..26]).fill(f32::NAN);
    (operator, y)
}

/// Residuals and changes of all iterations.
struct Steps(Vec<[f32; 2]>);

impl Observer for Steps {
    fn iteration(&mut self, progress: &Progress) -> Control {
        self.0.push([progress.residual, progress.change]);
        Control::Continue
    }
}

fn solve(schedule: &Schedule, networks: &mut dyn Networks) -> Result<(Outcome, Vec<[f32; 2]>)> {
    let (operator, y) = scene();
    let mut steps = Steps(Vec::new());
    let outcome = reconstruct(&operator, y.view(), schedule, networks, &mut steps)?;
    Ok((outcome, steps.0))
}

#[test]
fn a_reconstruction_stops_where_that_of_the_cpu_stops() {
    let Some(gpu) = gpu() else { return };
    let mut on = On(gpu);
    for mut schedule in [Schedule::gap_tv3d(), Schedule::admm_tv()] {
        // Convergence at iteration 40, between two reads of the sums.
        let (_, fixed) = solve(&schedule.clone().with_iterations(40), &mut ()).unwrap();
        schedule.stages[0].tolerance = (fixed[38][1] * fixed[39][1]).sqrt();
        let (cpu, cpu_steps) = solve(&schedule, &mut ()).unwrap();
        let (one, steps) = solve(&schedule, &mut on).unwrap();
        assert_eq!((cpu.iterations, cpu_steps.len()), (40, 40));
        assert_eq!((one.iterations, steps.len()), (40, 40));
        assert_eq!(one.stop_reason, cpu.stop_reason);
        for (step, expected) in steps.iter().flatten().zip(cpu_steps.iter().flatten()) {
            assert!((step / expected - 1.0).abs() < 1e-3, "{step}, not {expected}");
        }
        let reference: Vec<f64> = cpu.frames.iter().map(|&value| f64::from(value)).collect();
        let difference = relative_difference(&one.frames, &reference);
        assert!(difference < TOLERANCE, "{difference}, {schedule:?}");
        let (other, other_steps) = solve(&schedule, &mut on).unwrap();
        assert_eq!((one.frames, steps), (other.frames, other_steps), "runs differ");
    }
}

#[test]
fn a_measurement_that_is_not_finite_diverges() {
    let Some(gpu) = gpu() else { return };
    let (operator, mut y) = scene();
    y[[0, 5, 5]] = f32::INFINITY;
    let schedule = Schedule::gap_tv();
    let ended = reconstruct(&operator, y.view(), &schedule, &mut On(gpu), &mut ());
    assert!(matches!(ended, Err(ReconError::Diverged { iteration: 1, .. })), "{ended:?}");
}

#[test]
fn a_small_device_is_refused_in_words() {
    if gpu().is_none() {
        return;
    }
    let error = solve(&Schedule::gap_tv(), &mut On(small_gpu(16 << 10))).unwrap_err().to_string();
    assert!(error.contains("16384 bytes") && error.contains("smaller tiles"), "{error}");
    let opened = Gpu::open_with(|request| {
        request.required_limits.max_storage_buffers_per_shader_stage = u32::MAX;
    });
    let error = opened.unwrap_err().to_string();
    assert!(error.contains("can't run"), "{error}");
}

#[test]
fn a_lost_device_is_reported_as_lost() {
    if gpu().is_none() {
        return;
    }
    let gpu = Arc::new(Gpu::open().unwrap());
    solve(&Schedule::gap_tv().with_iterations(2), &mut On(Arc::clone(&gpu))).unwrap();
    gpu.device.destroy();
    for _ in 0..2 {
        let ended = solve(&Schedule::gap_tv(), &mut On(Arc::clone(&gpu)));
        let ended = ended.map(|(outcome, _)| outcome.iterations);
        assert!(matches!(ended, Err(ReconError::DeviceLost(_))), "{ended:?}");
    }
}

#[test]
fn a_missing_device_is_reported_with_the_remedy() {
    if gpu().is_none() {
        return;
    }
    // The Vulkan loader reads the list of drivers once in a process.
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", "gpu::tests::a_small_device_is_refused_in_words", "--nocapture"]);
    let nowhere = "/dev/null/nowhere.json";
    command.envs([("VK_ICD_FILENAMES", nowhere), ("VK_DRIVER_FILES", nowhere), ("CI", "true")]);
    let output = command.output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success(), "{text}");
    assert!(text.contains("no GPU with a Vulkan driver") && text.contains("libvulkan1"), "{text}");
}

#[test]
fn every_kernel_is_measured() {
    let Some(gpu) = gpu() else { return };
    let speeds = speed::measure(&gpu, 2, 30).unwrap();
    let names: Vec<_> = speeds.iter().map(|speed| speed.kernel).collect();
    let kernels = ["loop", "projection", "total variation along time", "total variation", "sums"];
    assert_eq!(names, kernels);
    assert!(speeds.iter().all(|speed| speed.mvoxel_per_s > 0.0), "{speeds:?}");
}

/// Environment of a process with a driver that fails on request (`tests/service/shim/faulty_gpu.c`).
fn faulty_driver(folder: &Path) -> Vec<(&'static str, PathBuf)> {
    let icd = std::env::var("VK_ICD_FILENAMES").expect("the manifest of the driver");
    let manifest = std::fs::read(&icd).unwrap();
    let mut manifest: serde_json::Value = serde_json::from_slice(&manifest).unwrap();
    let library = manifest["ICD"]["library_path"].as_str().unwrap();
    let original = Path::new(&icd).with_file_name(library);
    let (shim, own) = (folder.join("libfaulty_gpu.so"), folder.join("icd.json"));
    let source = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/service/shim/faulty_gpu.c");
    let mut cc = Command::new("cc");
    cc.args(["-shared", "-fPIC", "-O1", "-o"]).arg(&shim).args([source, "-ldl"]);
    assert!(cc.status().unwrap().success());
    manifest["ICD"]["library_path"] = json!(shim);
    std::fs::write(&own, manifest.to_string()).unwrap();
    vec![
        ("VK_ICD_FILENAMES", own),
        ("FAULTY_GPU_DRIVER", original),
        ("FAULTY_GPU_MEMORY", folder.join("memory")),
    ]
}

/// Runs in a process with the driver of [`faulty_driver`].
#[test]
#[ignore = "a_full_device_is_used_in_bands_or_refused_in_words runs it in another process"]
fn on_a_device_with_limited_memory() {
    let memory = std::env::var("FAULTY_GPU_MEMORY").unwrap();
    let limit = |bytes: u64| std::fs::write(&memory, bytes.to_string()).unwrap();
    let gpu = Gpu::open_with(|request| {
        // Larger buffers are allocated alone.
        let suballocated_device_memory_block_size = 4 << 20..4 << 20;
        request.memory_hints = MemoryHints::Manual { suballocated_device_memory_block_size };
    });
    let gpu = Arc::new(gpu.unwrap());
    // Each patch near its own place, in 4 groups for each row.
    let size = (2, 600, 40);
    let place = |index: usize| (index / 40 / 4 * 40 + index % 30) as u32;
    let groups: Vec<u32> = (0..2 * 594 * 4 * 40).map(place).collect();
    let mut clip = Clip::new(Arc::clone(&gpu), size, &[0.5; 2]).unwrap();
    let bands = |clip: &mut Clip| clip.divide(&groups).map(|()| clip.band_count());
    assert_eq!(bands(&mut clip).unwrap(), 1);
    // The patches take 27 MB.
    limit(16 << 20);
    assert_eq!(bands(&mut clip).unwrap(), 2);
    limit(6 << 20);
    assert_eq!(bands(&mut clip).unwrap(), 8);
    limit(1 << 10);
    let masks = Array3::from_elem((4, 640, 640), 1.0);
    let operator = SensingOperator::new(masks).unwrap();
    let y = Array3::zeros((1, 640, 640));
    let ended = reconstruct(&operator, y.view(), &Schedule::gap_tv(), &mut On(gpu), &mut ());
    let error = ended.map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("too little free memory") && error.contains("smaller tiles"), "{error}");
}

#[test]
fn a_full_device_is_used_in_bands_or_refused_in_words() {
    if gpu().is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", "gpu::tests::on_a_device_with_limited_memory", "--ignored"]);
    let output = command.envs(faulty_driver(folder.path())).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success() && text.contains("1 passed"), "{text}");
}
