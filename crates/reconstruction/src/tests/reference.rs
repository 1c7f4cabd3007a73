//! A slow, readable solver's parts, for the tests of GAP and ADMM.

use crate::ReconError;
use crate::operator::{
    DECAY, HIGH_CONTRAST, INDEPENDENT_CONTRAST, MAX_OPPOSITION, MIN_STATIC_SHARE,
    MIN_STATIC_VARIANCE, REFERENCE_RATIO, SensingOperator,
};
use crate::priors::tv::TvSpec;
use crate::priors::{Denoiser, Network, Networks};
use crate::schedule::Schedule;
use crate::solver::reconstruct;
use ndarray::Array3;
use rand::{RngExt, SeedableRng};
use serde_json::json;
use std::f64::consts::PI;

/// A small random problem, with a denoiser that pulls every voxel towards a grey.
pub(crate) struct Problem {
    pub(crate) schedule: Schedule,
    masks: Array3<f32>,
    /// [S,H,W].
    y: Array3<f32>,
}

const GREY: f64 = 0.4;
const PULL: f64 = 0.25;
/// Step of the dual ascent of total variation.
const TAU: f64 = 0.25;

pub(crate) struct Pull;

impl Denoiser for Pull {
    fn denoise(&mut self, frames: &mut Array3<f32>, _: f32) -> Result<(), ReconError> {
        frames.mapv_inplace(|x| x + PULL as f32 * (GREY as f32 - x));
        Ok(())
    }
}

impl Networks for Pull {
    fn network(&mut self, _: Network) -> Result<&mut dyn Denoiser, ReconError> {
        Ok(self)
    }
}

impl Problem {
    pub(crate) fn random(seed: u64, method: &str) -> Self {
        let mut rng = rand::rngs::ChaCha8Rng::seed_from_u64(seed);
        let size = (rng.random_range(1..5), rng.random_range(1..8), rng.random_range(1..40));
        Self::with_size(size, rng, method)
    }

    /// A problem with masks of this size.
    pub(crate) fn with_size(
        size: (usize, usize, usize),
        mut rng: impl RngExt,
        method: &str,
    ) -> Self {
        let masks = Array3::from_shape_simple_fn(size, || 0.2 + 0.8 * rng.random::<f32>());
        let snapshots = rng.random_range(1..4);
        let y = (snapshots, size.1, size.2);
        let y = Array3::from_shape_simple_fn(y, || 2.0 * rng.random::<f32>());
        let memory: f32 = rng.random();
        let variance = rng.random::<bool>().then(|| rng.random_range(0.1..1.0f32));
        let stage = json!({"prior": "ffdnet", "iterations": 7, "sigma": [0.1, 0.1],
            "memory": memory, "momentum": 0.5 * rng.random::<f32>(), "static_variance": variance,
            "gamma": rng.random::<bool>().then(|| 0.5 * rng.random::<f32>())});
        let schedule = json!({"method": method, "accelerated": rng.random::<bool>(),
            "gamma": 0.3 * rng.random::<f32>(), "stages": [stage]});
        Self { schedule: serde_json::from_value(schedule).unwrap(), masks, y }
    }

    /// The solver's frames.
    pub(crate) fn solve(&self) -> Array3<f32> {
        self.solve_with(&mut Pull)
    }

    /// The frames of the solver with these networks.
    pub(crate) fn solve_with(&self, networks: &mut dyn Networks) -> Array3<f32> {
        let op = SensingOperator::new(self.masks.clone()).unwrap();
        let op = op.over(self.y.dim().0).unwrap();
        reconstruct(&op, self.y.view(), &self.schedule, networks, &mut ()).unwrap().frames
    }

    pub(crate) fn pixels(&self) -> usize {
        self.y.len()
    }

    pub(crate) fn zeros(&self) -> Vec<f64> {
        vec![0.0; self.y.dim().0 * self.masks.len()]
    }

    /// The prior of the schedule: total variation, or the denoiser.
    pub(crate) fn denoise(&self, x: &mut [f64]) {
        match self.schedule.stages[0].prior.tv() {
            None => x.iter_mut().for_each(|x| *x += PULL * (GREY - *x)),
            Some(tv) => {
                let (_, height, width) = self.masks.dim();
                variation_along_time(x, height * width, tv);
                x.chunks_mut(height * width).for_each(|frame| variation(frame, width, tv));
            }
        }
    }

    /// `P(w)` along the masks, or along `R C` (cosine by cosine, and bounded), with the target `y` or, accelerated,
    /// `y1 = y + memory (y1 - H w)`.
    pub(crate) fn project(&self, w: &[f64], y1: &mut [f64]) -> Vec<f64> {
        let plane = self.masks.dim().1 * self.masks.dim().2;
        let stage = &self.schedule.stages[0];
        let projection = stage.projection;
        let (gamma, memory) = (projection.gamma.unwrap_or(self.schedule.gamma), projection.memory);
        let mask: Vec<f64> = self.masks.iter().map(|&c| f64::from(c)).collect();
        // `R C`.
        let mut direction = mask.clone();
        if let Some(variance) = projection.static_variance {
            let frames = self.masks.dim().0;
            let sum = |pixel: usize, power: i32| -> f64 {
                (0..frames).map(|k| mask[k * plane + pixel].powi(power)).sum()
            };
            let gram: f64 = (0..plane).map(|pixel| sum(pixel, 2)).sum();
            let steady: f64 = (0..plane).map(|pixel| sum(pixel, 1).powi(2)).sum();
            let contrast = 1.0 - steady / (frames as f64 * gram);
            let count = frames as f64;
            let by_count = (f64::from(REFERENCE_RATIO) / count).sqrt();
            let independent = f64::from(INDEPENDENT_CONTRAST) * (1.0 - 1.0 / count);
            let share =
                (by_count * (contrast / independent).powf(0.9)).max(MIN_STATIC_SHARE.into());
            let share = share.min(by_count).min((contrast / f64::from(HIGH_CONTRAST)).powf(1.5));
            let variance = f64::from(variance) * share;
            let cosine =
                |m: usize, k: usize| (PI * m as f64 * (k as f64 + 0.5) / frames as f64).cos();
            direction.fill(0.0);
            for m in 0..frames {
                let square: f64 = (0..frames).map(|k| cosine(m, k).powi(2)).sum();
                let variance = if m == 0 {
                    variance.max(MIN_STATIC_VARIANCE.into())
                } else {
                    (m as f64).powf(-f64::from(DECAY))
                };
                for pixel in 0..plane {
                    let part = |k: usize| cosine(m, k) * mask[k * plane + pixel];
                    let part = variance / square * (0..frames).map(part).sum::<f64>();
                    for k in 0..frames {
                        direction[k * plane + pixel] += cosine(m, k) * part;
                    }
                }
            }
        }
        let mut x = w.to_vec();
        for (p, &y) in self.y.iter().enumerate() {
            // The snapshot's own frames at this pixel, and the masks there.
            let (first, pixel) = (p / plane * mask.len(), p % plane);
            let voxels = || (pixel..mask.len()).step_by(plane);
            let measured: f64 = voxels().map(|voxel| mask[voxel] * w[first + voxel]).sum();
            let total_of = |part: &dyn Fn(usize) -> f64| -> f64 {
                voxels().map(|voxel| mask[voxel] * part(voxel)).sum::<f64>() + f64::from(gamma)
            };
            let least = -f64::from(MAX_OPPOSITION) * total_of(&|voxel| direction[voxel]);
            let bounded = |voxel: usize| direction[voxel].max(least / mask[voxel]);
            let total = total_of(&bounded);
            let mut target = f64::from(y);
            if self.schedule.accelerated {
                y1[p] = target + f64::from(memory) * (y1[p] - measured);
                target = y1[p];
            }
            for voxel in voxels() {
                x[first + voxel] += bounded(voxel) * (target - measured) / total;
            }
        }
        x
    }
}

/// Total variation of a frame: whole-image differences, as in the paper of Chambolle.
pub(crate) fn variation(frame: &mut [f64], width: usize, tv: &TvSpec) {
    let weight = f64::from(tv.tv_weight);
    if weight == 0.0 {
        return;
    }
    let count = frame.len();
    let is_last = |pixel: usize| pixel % width + 1 == width;
    let (mut down, mut right) = (vec![0.0; count], vec![0.0; count]);
    let primal = |down: &[f64], right: &[f64]| -> Vec<f64> {
        let at = |pixel: usize| {
            let above = pixel.checked_sub(width).map_or(0.0, |above| down[above]);
            let left = if pixel.is_multiple_of(width) { 0.0 } else { right[pixel - 1] };
            frame[pixel] - down[pixel] + above - right[pixel] + left
        };
        (0..count).map(at).collect()
    };
    for _ in 0..tv.tv_updates {
        let u = primal(&down, &right);
        for pixel in 0..count {
            let below = u.get(pixel + width).map_or(0.0, |below| below - u[pixel]);
            let ahead = if is_last(pixel) { 0.0 } else { u[pixel + 1] - u[pixel] };
            let norm = 1.0 + TAU / weight * below.hypot(ahead);
            down[pixel] = (down[pixel] - TAU * below) / norm;
            right[pixel] = (right[pixel] - TAU * ahead) / norm;
        }
    }
    let result = primal(&down, &right);
    frame.copy_from_slice(&result);
}

/// Total variation along time of a clip with `plane` pixels in a frame.
fn variation_along_time(clip: &mut [f64], plane: usize, tv: &TvSpec) {
    let weight = f64::from(tv.temporal_weight);
    let mut dual = vec![0.0; clip.len() + plane];
    // The dual field before a frame, then that after it.
    let primal = |clip: &[f64], dual: &[f64]| -> Vec<f64> {
        let fields = dual.iter().zip(&dual[plane..]);
        clip.iter().zip(fields).map(|(x, (before, after))| x + before - after).collect()
    };
    for _ in 0..tv.tv_updates {
        let u = primal(clip, &dual);
        for voxel in plane..clip.len() {
            let moved = dual[voxel] - TAU * (u[voxel] - u[voxel - plane]);
            dual[voxel] = moved.clamp(-weight, weight);
        }
    }
    let result = primal(clip, &dual);
    clip.copy_from_slice(&result);
}

/// Largest difference between two clips.
pub(crate) fn max_difference(frames: &Array3<f32>, reference: &[f64]) -> f64 {
    let pairs = frames.iter().zip(reference);
    pairs.map(|(&a, b)| (f64::from(a) - b).abs()).fold(0.0, f64::max)
}
