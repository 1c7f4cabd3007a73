//! The kernels against the readable reference, on any Vulkan device, for example SwiftShader.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::Ordering;
use std::sync::{Arc, OnceLock};

use ndarray::{Array3, s};
use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};
use serde_json::json;
use wgpu::{BufferUsages, MemoryHints};

use super::adapter::Gpu;
use super::nonlocal::Clip;
use crate::error::{ReconError, Result};
use crate::gap::{Solver, run_stage};
use crate::hold_out::HoldOut;
use crate::operator::SensingOperator;
use crate::priors::network::ClipDenoiser;
use crate::priors::onnx::{Device, Runtime};
use crate::priors::{Denoiser, Network, Networks};
use crate::reference::{Problem, Pull, max_difference};
use crate::schedule::Schedule;
use crate::solver::{Control, Observer, Outcome, Progress, reconstruct};
use crate::stage::Stage;
use crate::state::State;
use crate::tile::{Tile, TilePlan, Window};
use crate::unmeasured::Measured;
use crate::{admm, gap, pilot, projection, speed};

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

/// Networks with a denoiser on the CPU, on a machine with or without a GPU.
struct Pulling(Option<Arc<Gpu>>, Pull);

impl Networks for Pulling {
    fn network(&mut self, _: Network) -> Result<&mut dyn Denoiser> {
        Ok(&mut self.1)
    }

    fn gpu(&mut self) -> Result<Option<Arc<Gpu>>> {
        Ok(self.0.clone())
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

/// The GPU with a limit for the bytes of a buffer.
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

/// A prior on the CPU between kernels: the projection, then change, norm and extrapolation.
#[test]
fn iterations_with_another_prior_are_those_of_the_equations() {
    let Some(gpu) = gpu() else { return };
    for seed in 0..8 {
        let method = ["gap", "admm"][seed as usize % 2];
        let problem = Problem::random(seed, method);
        let reference = match method {
            "gap" => gap::tests::reference(&problem),
            _ => admm::tests::reference(&problem),
        };
        let frames = problem.solve_with(&mut Pulling(Some(Arc::clone(&gpu)), Pull));
        let difference = relative_difference(&frames, &reference);
        assert!(difference < TOLERANCE, "{seed}: {difference}, {:?}", problem.schedule);
    }
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

/// Residual and change of each iteration, and the squared residuals of the hold-out pixels after it.
fn judged(networks: &mut dyn Networks) -> (Vec<[f32; 2]>, Vec<Vec<f64>>) {
    let (whole, y) = scene();
    let Measured { op: whole, y } = Measured::new(&whole, y.view());
    let hold_out = HoldOut::draw(&whole, 0);
    let operator = whole.into_owned().without(&hold_out.pixels);
    let problem = projection::Problem { operator: &operator, y: &y };
    let mut schedule = Schedule::pnp_ffdnet();
    schedule.stages[1].iterations = 5;
    let mut solver = Solver::new(problem, &schedule, networks).unwrap();
    let (mut steps, mut errors) = (Steps(Vec::new()), Vec::new());
    for (index, stage) in schedule.stages.iter().enumerate() {
        let stage = Stage { iterations: stage.iterations.min(40), tolerance: 0.0, ..stage.clone() };
        let after = |state: &State| {
            errors.push(state.hold_out_residuals(problem, &hold_out)?);
            Ok(ControlFlow::Continue(()))
        };
        run_stage(&mut solver, index, &stage, &mut steps, after).unwrap();
    }
    (steps.0, errors)
}

#[test]
fn norms_and_hold_out_errors_are_those_of_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let (expected_steps, expected_errors) = judged(&mut Pulling(None, Pull));
    let (steps, errors) = judged(&mut Pulling(Some(Arc::clone(&gpu)), Pull));
    assert_eq!((steps.len(), errors.len()), (45, 6));
    for (step, expected) in steps.iter().zip(&expected_steps) {
        for (value, expected) in step.iter().zip(expected) {
            // Changes below 0.1 % suffer from the rounding of the frames.
            let difference = (value - expected).abs();
            assert!(difference < 1e-4 * expected.max(1e-3), "{step:?}, not {expected}");
        }
    }
    for (squares, expected) in errors.iter().zip(&expected_errors) {
        let (sum, expected_sum): (f64, f64) = (squares.iter().sum(), expected.iter().sum());
        assert!(expected_sum > 0.0 && (sum / expected_sum - 1.0).abs() < TOLERANCE, "{sum}");
        let largest = expected.iter().fold(0.0, |one: f64, other| one.max(*other));
        for (square, expected) in squares.iter().zip(expected) {
            assert!((square - expected).abs() < TOLERANCE * largest, "{square}, not {expected}");
        }
    }
    let again = judged(&mut Pulling(Some(gpu), Pull));
    assert_eq!((steps, errors), again, "runs differ");
}

/// Candidates are tried from a copy of the variables, and the best frames are kept.
#[test]
fn a_pilot_decides_as_on_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let (operator, y) = scene();
    let mut schedule = Schedule::pnp_ffdnet();
    schedule.stages[0] = Schedule::gap_tv3d().stages.remove(0);
    schedule.stages[0].iterations = 30;
    schedule.stages[1].iterations = 6;
    let decided = |gpu| {
        let mut networks = Pulling(gpu, Pull);
        pilot::decide(&operator, y.view(), &schedule, &mut networks, &mut ()).unwrap()
    };
    let (one, expected) = (decided(Some(gpu)), decided(None));
    assert_eq!(one.stages.len(), 2);
    for (one, expected) in one.stages.iter().zip(&expected.stages) {
        assert_eq!((&one.stage, one.end), (&expected.stage, expected.end));
        let difference = one.error_after / expected.error_after - 1.0;
        assert!(difference.abs() < TOLERANCE, "{difference}");
    }
    assert!(one.evidence.is_some());
}

/// Frames are copied to the host at the end, for the motion of a search, and around a prior on the CPU.
#[test]
fn variables_stay_on_the_gpu_from_stage_to_stage() {
    let Some(gpu) = gpu() else { return };
    let read_bytes = |stages: &[serde_json::Value]| {
        let schedule = json!({"method": "gap", "accelerated": true, "stages": stages});
        let schedule: Schedule = serde_json::from_value(schedule).unwrap();
        // Other tests use the shared GPU.
        let gpu = Arc::new(Gpu::open().unwrap());
        let (operator, y) = scene();
        let mut networks = Pulling(Some(Arc::clone(&gpu)), Pull);
        reconstruct(&operator, y.view(), &schedule, &mut networks, &mut ()).unwrap();
        gpu.read_bytes.load(Ordering::Relaxed)
    };
    drop(gpu);
    let frames = 4 * scene().0.masks().len() as u64;
    let sums = 4096;
    let tv = json!({"prior": "tv", "iterations": 2, "tv_weight": 0.1, "momentum": 0.2});
    let one = read_bytes(std::slice::from_ref(&tv));
    assert!((frames..frames + sums).contains(&one), "{one}");
    let other = json!({"prior": "tv", "iterations": 3, "tv_weight": 0.05, "static_variance": 0.2});
    let two = read_bytes(&[tv.clone(), other]);
    assert!((frames..frames + sums).contains(&two), "{two}");
    let nonlocal = |iterations: usize| json!({"prior": "nonlocal", "iterations": iterations, "sigma": [0.1, 0.1], "motion_compensation": false});
    // A search reads the places of patches, a pass only its sums.
    let (pass, passes) =
        (read_bytes(&[tv.clone(), nonlocal(1)]), read_bytes(&[tv.clone(), nonlocal(3)]));
    assert!(pass < passes && passes < pass + sums, "{pass} {passes}");
    let network = json!({"prior": "ffdnet", "iterations": 2, "sigma": [0.1, 0.1]});
    let network = read_bytes(&[tv, network]);
    assert!((3 * frames..3 * frames + sums).contains(&network), "{network}");
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
    // At its start, in another prior, and in total variation.
    let nonlocal = json!({"prior": "nonlocal", "iterations": 1, "sigma": [0.1, 0.1]});
    let nonlocal = json!({"method": "gap", "accelerated": true, "stages": [nonlocal]});
    let nonlocal: Schedule = serde_json::from_value(nonlocal).unwrap();
    for schedule in [Schedule::gap_tv(), nonlocal, Schedule::gap_tv()] {
        let ended = solve(&schedule, &mut On(Arc::clone(&gpu)));
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

/// Networks of a machine: on a GPU or without.
struct Machine {
    gpu: Option<Arc<Gpu>>,
    network: Option<ClipDenoiser>,
}

impl Machine {
    /// FastDVDNet is loaded if SCI_RECON_GPU_RUNTIME names a libonnxruntime with WebGPU.
    fn new(gpu: Option<Arc<Gpu>>) -> Self {
        let library = std::env::var_os("SCI_RECON_GPU_RUNTIME").filter(|path| !path.is_empty());
        let network = library.map(|library| {
            let device = if gpu.is_some() { Device::Gpu } else { Device::Cpu };
            let runtime = Runtime::open(Path::new(&library), device).unwrap();
            let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/fastdvdnet-gray");
            let file = |name| std::fs::read(Path::new(folder).join(name)).unwrap().into();
            let files = ["stage1.onnx", "stage2.onnx"].map(file);
            ClipDenoiser::load(&runtime, Network::FastDvdNet, files).unwrap()
        });
        Self { gpu, network }
    }
}

impl Networks for Machine {
    fn network(&mut self, _: Network) -> Result<&mut dyn Denoiser> {
        let network = self.network.as_mut().ok_or(ReconError::NoDenoiser)?;
        Ok(network)
    }

    fn gpu(&mut self) -> Result<Option<Arc<Gpu>>> {
        Ok(self.gpu.clone())
    }
}

/// Neighbouring tiles, one from the CPU and one from the GPU, by total variation, the nonlocal prior and, where its library
/// is, FastDVDNet.
#[test]
fn tiles_of_both_devices_have_no_seam() {
    let Some(gpu) = gpu() else { return };
    let mut machines = [Machine::new(None), Machine::new(Some(gpu))];
    let mut stages = json!([
        {"prior": "tv", "iterations": 20, "tv_weight": 0.1, "temporal_weight": 0.01},
        {"prior": "nonlocal", "iterations": 2, "sigma": [0.05, 0.05], "temporal_shrinkage": 0.4}]);
    if machines[0].network.is_some() {
        let network = json!({"prior": "fastdvdnet", "iterations": 1, "sigma": [0.05, 0.05]});
        stages.as_array_mut().unwrap().push(network);
    } else {
        eprintln!("without a network: SCI_RECON_GPU_RUNTIME names no library");
    }
    let schedule = json!({"method": "gap", "accelerated": true, "stages": stages});
    let schedule: Schedule = serde_json::from_value(schedule).unwrap();
    let size = (3, 32, 56);
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let masks = Array3::from_shape_simple_fn(size, || rng.random::<f32>().round());
    let truth = Array3::from_shape_fn(size, |(k, i, j)| {
        0.5 + 0.4 * ((i + 2 * j) as f32 / 5.0 + k as f32 / 2.0).sin()
    });
    let y = SensingOperator::new(masks.clone()).unwrap().forward(truth.view()).unwrap();
    let plan = TilePlan::new(size.1, size.2, 32, 8).unwrap();
    assert_eq!(plan.len(), 2);
    let mut solve = |tile: &Tile, machine: usize| {
        let Window { rows, columns, .. } = tile.window();
        let masks = masks.slice(s![.., rows.clone(), columns.clone()]).to_owned();
        let operator = SensingOperator::new(masks).unwrap();
        let y = y.slice(s![.., rows, columns]);
        reconstruct(&operator, y, &schedule, &mut machines[machine], &mut ()).unwrap().frames
    };
    let mut picture = |devices: [usize; 2]| {
        let mut whole = Array3::<f32>::zeros(size);
        for (tile, machine) in plan.tiles().zip(devices) {
            let frames = solve(&tile, machine);
            for (part, whole) in frames.outer_iter().zip(whole.outer_iter_mut()) {
                plan.blend(&tile, part, whole);
            }
        }
        whole
    };
    let (cpu, mixed) = (picture([0, 0]), picture([0, 1]));
    let seam = (&cpu - &mixed).mapv(f32::abs).fold(0.0, |one: f32, other| one.max(*other));
    let psnr = |frames: &Array3<f32>| {
        -10.0 * (frames - &truth).mapv(|error| error * error).mean().unwrap().log10()
    };
    eprintln!("largest difference {seam:e}, {} and {} dB", psnr(&cpu), psnr(&mixed));
    assert!(seam > 0.0 && seam < 1e-3, "{seam}");
    assert!(psnr(&cpu) > 20.0 && (psnr(&cpu) - psnr(&mixed)).abs() < 0.01);
    assert_eq!(picture([0, 1]), mixed, "runs differ");
}

#[test]
fn every_kernel_is_measured() {
    let Some(gpu) = gpu() else { return };
    let speeds = speed::measure(&gpu, 2, 30).unwrap();
    let names: Vec<_> = speeds.iter().map(|speed| speed.kernel).collect();
    let variation = ["loop", "projection", "total variation along time", "total variation", "sums"];
    let nonlocal = [
        "nonlocal prior",
        "nonlocal: outlier limits",
        "nonlocal: temporal shrinkage",
        "nonlocal: search",
        "nonlocal: low-rank filter",
        "nonlocal: aggregation",
    ];
    assert_eq!(names, [&variation[..], &nonlocal].concat());
    assert!(speeds.iter().all(|speed| speed.mvoxel_per_s > 0.0), "{speeds:?}");
}

/// Environment of a process with a driver that fails on request (`tests/service/shim/faulty_gpu.c`).
fn faulty_driver(icd: &Path, folder: &Path) -> [(&'static str, PathBuf); 4] {
    let manifest = std::fs::read(icd).unwrap();
    let mut manifest: serde_json::Value = serde_json::from_slice(&manifest).unwrap();
    let library = manifest["ICD"]["library_path"].as_str().unwrap();
    let original = icd.with_file_name(library);
    let (shim, own) = (folder.join("libfaulty_gpu.so"), folder.join("icd.json"));
    let source = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/service/shim/faulty_gpu.c");
    let mut cc = Command::new("cc");
    cc.args(["-shared", "-fPIC", "-O1", "-o"]).arg(&shim).args([source, "-ldl"]);
    assert!(cc.status().unwrap().success());
    manifest["ICD"]["library_path"] = json!(shim);
    std::fs::write(&own, manifest.to_string()).unwrap();
    [
        ("VK_ICD_FILENAMES", own),
        ("FAULTY_GPU_DRIVER", original),
        ("FAULTY_GPU_MEMORY", folder.join("memory")),
        ("FAULTY_GPU_LOSS", folder.join("loss")),
    ]
}

/// Runs in a process with the driver of [`faulty_driver`].
#[test]
#[ignore = "a_full_device_is_used_in_bands_and_a_reset_is_reported runs it in another process"]
fn on_a_faulty_device() {
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
    let mut on = On(gpu);
    let ended = reconstruct(&operator, y.view(), &Schedule::gap_tv(), &mut on, &mut ());
    let error = ended.map(|_| ()).unwrap_err();
    assert!(matches!(error, ReconError::DeviceFull(_)), "{error:?}");
    let error = error.to_string();
    assert!(error.contains("too little free memory") && error.contains("smaller tiles"), "{error}");
    // A buffer that is allocated without an error scope.
    let _ = on.0.buffer(8 << 20, BufferUsages::STORAGE);
    let checked = on.0.check();
    assert!(matches!(checked, Err(ReconError::DeviceFull(_))), "{checked:?}");
    std::fs::remove_file(&memory).unwrap();
    solve(&Schedule::gap_tv().with_iterations(2), &mut on).unwrap();
    std::fs::write(std::env::var("FAULTY_GPU_LOSS").unwrap(), "").unwrap();
    for _ in 0..2 {
        let ended = solve(&Schedule::gap_tv(), &mut on).map(|_| ());
        assert!(matches!(ended, Err(ReconError::DeviceLost(_))), "{ended:?}");
    }
}

#[test]
fn a_full_device_is_used_in_bands_and_a_reset_is_reported() {
    let Some(icd) = std::env::var_os("VK_ICD_FILENAMES").filter(|_| gpu().is_some()) else {
        eprintln!("skipped: VK_ICD_FILENAMES names no driver");
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", "gpu::tests::on_a_faulty_device", "--ignored"]);
    let output = command.envs(faulty_driver(Path::new(&icd), folder.path())).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success() && text.contains("1 passed"), "{text}");
}
