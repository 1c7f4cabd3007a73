//! Speed of the kernels of a GPU.

use std::ops::Range;
use std::sync::Arc;
use std::time::{Duration, Instant};

use ndarray::Array3;

use crate::error::Result;
use crate::gpu::adapter::Gpu;
use crate::gpu::frames::DeviceFrames;
use crate::gpu::nonlocal::NamedKernel;
use crate::iterate::Variables;
use crate::operator::{SensingOperator, Statistics};
use crate::priors::Prior;
use crate::priors::nonlocal::on_gpu::OnGpu;
use crate::priors::nonlocal::{Nonlocal, REFRESH};
use crate::priors::registry::PriorSpec;
use crate::priors::tv::TvSpec;
use crate::projection::{Problem, Settings};
use crate::resident::Resident;
use crate::schedule::Schedule;

/// Shortest measurement.
const MIN_TIME: Duration = Duration::from_millis(200);

/// Speed of a kernel, or of the loop of all kernels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Speed {
    /// Name of the kernel; `loop` for whole iterations of total variation along time and of each frame, `nonlocal prior` for
    /// passes of that prior with the part of the host.
    pub kernel: &'static str,
    /// Millions of voxels per second in one iteration.
    pub mvoxel_per_s: f64,
}

/// Measures the kernels on a snapshot of `frames` frames of `side` x `side` pixels: accelerated GAP with four dual updates,
/// then the nonlocal prior.
///
/// # Errors
/// The GPU is too small or lost.
pub fn measure(gpu: &Arc<Gpu>, frames: usize, side: usize) -> Result<Vec<Speed>> {
    let size = (frames, side, side);
    // Each bit of a multiplicative hash opens half of the pixels.
    let is_open = |index: usize| (index as u32).wrapping_mul(0x9E37_79B1) >> 31;
    let masks = Array3::from_shape_fn(size, |(k, i, j)| is_open((k * side + i) * side + j) as f32);
    let operator = SensingOperator::new(masks)?;
    let scene = Array3::from_shape_fn(size, |(k, i, j)| ((i + j + k) % 32) as f32 / 32.0);
    let y = operator.forward(scene.view())?;
    let problem = Problem { operator: &operator, y: &y };
    let settings = Settings { memory: 1.0, momentum: 0.0, statistics: Statistics::default() };
    let tv = TvSpec { tv_weight: 0.15, temporal_weight: 0.004, tv_updates: 4 };
    let mut stage = Schedule::gap_tv3d().stages.remove(0);
    (stage.prior, stage.tolerance) = (PriorSpec::Tv(tv), 0.0);
    let variables = Variables { y1: true, w: false, u: false };
    let mut resident = Resident::new(Arc::clone(gpu), problem, variables)?;
    resident.start(problem, &settings, &stage)?;
    let speed = |kernel, passes: Range<usize>| {
        resident.repeat(passes.clone())?;
        let (start, mut iterations) = (Instant::now(), 0);
        while start.elapsed() < MIN_TIME {
            iterations += resident.repeat(passes.clone())?;
        }
        let voxels = iterations as f64 * scene.len() as f64;
        Ok(Speed { kernel, mvoxel_per_s: voxels / start.elapsed().as_secs_f64() / 1e6 })
    };
    let names: Vec<_> = resident.iterations.passes.iter().map(|pass| pass.name).collect();
    let mut speeds = vec![speed("loop", 0..names.len())?];
    for (index, name) in names.into_iter().enumerate() {
        speeds.push(speed(name, index..index + 1)?);
    }
    speeds.extend(nonlocal(gpu, &scene)?);
    Ok(speeds)
}

/// Noise level of the measurement of the nonlocal prior, and its temporal shrinkage.
const NONLOCAL_LEVELS: [f32; 2] = [0.05, 0.4];

/// Measures passes of the nonlocal prior, each with its share of a search, and its kernels.
fn nonlocal(gpu: &Arc<Gpu>, scene: &Array3<f32>) -> Result<Vec<Speed>> {
    let [sigma, shrinkage] = NONLOCAL_LEVELS;
    let frames = DeviceFrames::zeros(Arc::clone(gpu), scene.dim())?;
    frames.write(scene);
    let mut prior = OnGpu::new(Arc::clone(gpu), Nonlocal::new(scene.dim()), shrinkage)?;
    let speed = |kernel, seconds: f64| {
        let mvoxel_per_s = scene.len() as f64 / seconds / 1e6;
        Speed { kernel, mvoxel_per_s }
    };
    let period = mean_time(|| {
        (0..REFRESH).try_for_each(|_| prior.denoise_on_gpu(&frames, sigma))?;
        gpu.wait()
    })?;
    let mut speeds = vec![speed("nonlocal prior", period / REFRESH as f64)];
    for NamedKernel { name, run } in prior.kernels(&frames, sigma) {
        let seconds = mean_time(|| {
            run();
            gpu.wait()
        })?;
        speeds.push(speed(name, seconds));
    }
    Ok(speeds)
}

/// Mean seconds of an action after its first run, which may compile or allocate.
fn mean_time(mut action: impl FnMut() -> Result<()>) -> Result<f64> {
    action()?;
    let (start, mut count) = (Instant::now(), 0);
    while start.elapsed() < MIN_TIME {
        action()?;
        count += 1;
    }
    Ok(start.elapsed().as_secs_f64() / f64::from(count))
}
