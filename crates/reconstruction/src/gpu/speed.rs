//! Speed of the kernels.

use std::ops::Range;
use std::sync::Arc;
use std::time::{Duration, Instant};

use ndarray::Array3;

use super::adapter::Gpu;
use super::resident::{Resident, Variation};
use crate::error::Result;
use crate::iterate::{Iterate, Variables};
use crate::operator::{SensingOperator, Statistics};
use crate::projection::{Problem, Settings};

/// Shortest measurement.
const MIN_TIME: Duration = Duration::from_millis(200);

/// Speed of a kernel, or of the loop of all kernels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Speed {
    /// Name of the kernel; `loop` for whole iterations of total variation along time and of each frame.
    pub kernel: &'static str,
    /// Millions of voxels per second in one iteration.
    pub mvoxel_per_s: f64,
}

/// Measures the kernels on a snapshot of `frames` frames of `side` x `side` pixels, in accelerated GAP with four dual
/// updates.
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
    let stage = Variation {
        weight: 0.15,
        temporal_weight: 0.004,
        updates: 4,
        iterations: usize::MAX,
        tolerance: 0.0,
    };
    let iterate = Iterate::zeros(&operator, Variables { y1: true, w: false, u: false });
    let resident = Resident::new(Arc::clone(gpu), problem, &settings, stage, &iterate)?;
    let speed = |kernel, passes: Range<usize>| {
        resident.repeat(passes.clone())?;
        let (start, mut iterations) = (Instant::now(), 0);
        while start.elapsed() < MIN_TIME {
            iterations += resident.repeat(passes.clone())?;
        }
        let voxels = iterations as f64 * scene.len() as f64;
        Ok(Speed { kernel, mvoxel_per_s: voxels / start.elapsed().as_secs_f64() / 1e6 })
    };
    let names: Vec<_> = resident.passes.iter().map(|pass| pass.name).collect();
    let mut speeds = vec![speed("loop", 0..names.len())?];
    for (index, name) in names.into_iter().enumerate() {
        speeds.push(speed(name, index..index + 1)?);
    }
    Ok(speeds)
}
