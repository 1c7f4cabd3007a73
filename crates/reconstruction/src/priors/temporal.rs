//! Total variation along time, pixel by pixel.

use std::ops::Range;

use multiversion::multiversion;
use ndarray::{Array3, Axis};

/// Cost of one dual update, CPU-nanoseconds per voxel.
pub(super) const UPDATE_NS: f64 = 0.21;
/// Step of the dual ascent, `1 / ||D||^2`. The difference `D` along one dimension has a squared norm below 4 for any
/// number of frames.
const TAU: f32 = 0.25;
/// Pixels processed at once: their values in all frames stay in the first-level cache.
const LANES: usize = 64;

/// Guaranteed by the solver.
const CONTIGUOUS: &str = "frames are in standard layout";

/// The values of `LANES` pixels in one frame.
type Lanes = [f32; LANES];

/// Working memory, kept so that the loop allocates nothing.
#[derive(Debug)]
pub struct TemporalVariation {
    /// The input `x`, a row for each frame.
    values: Vec<Lanes>,
    /// The dual field between a frame and the next one; the last stays 0.
    dual: Vec<Lanes>,
}

impl TemporalVariation {
    /// For clips of `frames` frames.
    pub fn new(frames: usize) -> Self {
        Self { values: vec![[0.0; LANES]; frames], dual: vec![[0.0; LANES]; frames] }
    }

    /// Approximates the minimum of `||u - x||^2 / 2 + weight * sum_k |u_(k+1) - u_k|` for each pixel of some rows of
    /// `frames` \[B,H,W\], in place, by `updates` steps of projected gradient ascent on the dual from 0:
    /// `p <- clamp(p - tau (u_(k+1) - u_k), +-weight)`, `u_k = x_k - p_k + p_(k-1)`.
    ///
    /// # Panics
    /// If the frames are not in standard layout.
    pub fn denoise(
        &mut self,
        frames: &mut Array3<f32>,
        rows: Range<usize>,
        weight: f32,
        updates: usize,
    ) {
        let (count, _, width) = frames.dim();
        debug_assert_eq!(count, self.values.len());
        let end = rows.end * width;
        for start in (rows.start * width..end).step_by(LANES) {
            let pixels = start..end.min(start + LANES);
            for (values, frame) in self.values.iter_mut().zip(frames.axis_iter(Axis(0))) {
                let frame = frame.to_slice().unwrap_or_else(|| unreachable!("{CONTIGUOUS}"));
                values[..pixels.len()].copy_from_slice(&frame[pixels.clone()]);
            }
            self.dual.fill([0.0; LANES]);
            (0..updates).for_each(|_| update(&self.values, &mut self.dual, weight));
            let mut before = &[0.0; LANES];
            let sums = self.values.iter().zip(&self.dual);
            for ((values, dual), mut frame) in sums.zip(frames.axis_iter_mut(Axis(0))) {
                let frame = frame.as_slice_mut().unwrap_or_else(|| unreachable!("{CONTIGUOUS}"));
                let lanes = values.iter().zip(dual).zip(before);
                for (out, ((x, after), before)) in frame[pixels.clone()].iter_mut().zip(lanes) {
                    *out = x - after + before;
                }
                before = dual;
            }
        }
    }
}

/// One update of the dual field of all pixels.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn update(values: &[Lanes], dual: &mut [Lanes], weight: f32) {
    // `u` of this frame and the dual field before it, both from before the update.
    let (mut here, mut before) = ([0.0; LANES], [0.0; LANES]);
    for k in 0..values.len() {
        let field = dual[k];
        for lane in 0..LANES {
            let u = values[k][lane] - field[lane] + before[lane];
            if let Some(previous) = k.checked_sub(1) {
                let moved = before[lane] - TAU * (u - here[lane]);
                dual[previous][lane] = moved.clamp(-weight, weight);
            }
            here[lane] = u;
        }
        before = field;
    }
}

#[cfg(test)]
mod tests {
    use super::TemporalVariation;
    use ndarray::{Array3, Axis, s};
    use rand::{RngExt, SeedableRng};

    fn random(size: (usize, usize, usize)) -> Array3<f32> {
        let mut rng = rand::rngs::ChaCha8Rng::seed_from_u64(1);
        Array3::from_shape_simple_fn(size, || rng.random())
    }

    fn denoised(clip: &Array3<f32>, weight: f32, updates: usize) -> Array3<f32> {
        let mut out = clip.clone();
        let rows = 0..clip.dim().1;
        TemporalVariation::new(clip.dim().0).denoise(&mut out, rows, weight, updates);
        out
    }

    fn energy(u: &Array3<f32>, x: &Array3<f32>, weight: f32) -> f32 {
        let steps = &u.slice(s![1.., .., ..]) - &u.slice(s![..-1, .., ..]);
        (u - x).mapv(|d| d * d).sum() / 2.0 + weight * steps.mapv(f32::abs).sum()
    }

    #[test]
    fn many_updates_reach_the_least_energy() {
        // Two frames: both go towards their mean by the weight, as far as they are apart.
        let pair = Array3::from_shape_vec((2, 1, 2), vec![0.2, 0.5, 0.8, 0.52]).unwrap();
        let expected = Array3::from_shape_vec((2, 1, 2), vec![0.3, 0.51, 0.7, 0.51]).unwrap();
        let worst = (denoised(&pair, 0.1, 60) - expected).mapv(f32::abs);
        assert!(worst.iter().all(|&d| d < 1e-5), "{worst}");

        let clip = random((9, 7, 11));
        let (few, many) = (denoised(&clip, 0.1, 4), denoised(&clip, 0.1, 400));
        assert!(energy(&few, &clip, 0.1) < energy(&clip, &clip, 0.1));
        let least = energy(&many, &clip, 0.1);
        assert!(least < energy(&few, &clip, 0.1));
        for shift in random((9, 7, 11)).mapv(|r| 0.02 * (r - 0.5)).outer_iter() {
            let other = &many + &shift.broadcast(many.dim()).unwrap();
            assert!(energy(&other, &clip, 0.1) >= least * 0.9999);
        }
    }

    #[test]
    fn rows_and_widths_do_not_matter_and_brightness_stays() {
        for size in [(1, 3, 5), (4, 6, 64), (3, 5, 77)] {
            let clip = random(size);
            let whole = denoised(&clip, 0.03, 4);
            let mut strips = clip.clone();
            let mut prior = TemporalVariation::new(size.0);
            for row in 0..size.1 {
                prior.denoise(&mut strips, row..row + 1, 0.03, 4);
            }
            assert_eq!(strips, whole, "{size:?}");
            let drift = whole.sum_axis(Axis(0)) - clip.sum_axis(Axis(0));
            assert!(drift.iter().all(|d| d.abs() < 1e-5));
            if size.0 == 1 {
                assert_eq!(whole, clip, "one frame has nothing beside it");
            }
        }
    }
}
