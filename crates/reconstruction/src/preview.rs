//! A coarse reconstruction in about a second, for display while the full one runs.
//!
//! Within a block of `s` x `s` pixels each frame is taken as flat. The `s^2` pixels are then equations `y_p = sum_k
//! C_kp x_k` for `B` unknowns, which least squares solve. Summing masks and measurement over the block first
//! (binning) would leave a single equation: on street (Cr 10, independent masks, `s` = 7) total variation then
//! reaches 21.8 dB, this method 28.4 dB.

use ndarray::{Array2, Array3, ArrayView2, ArrayView3, s};

use super::error::{Result, check_shape, shape_text};
use super::operator::SensingOperator;
use super::priors::tv::TotalVariation;
use super::schedule::Schedule;
use super::solver;

/// Number of voxels that total variation solves in a second or two; larger pictures are solved by blocks.
pub const WHOLE: usize = 8 << 20;
/// Iterations for a picture that is not divided into blocks.
const ITERATIONS: usize = 40;
/// Approximate longer side of a preview by blocks, in pixels.
const LONGER_SIDE: usize = 640;
/// Weight of the deviation from the block's mean over all frames, in units of the masks' squares.
const RIDGE: f32 = 1.0;
/// Total variation after the blocks: weight on the \[0,1\] scale, and dual updates.
const SMOOTHING: (f32, usize) = (0.05, 4);
/// Number of values in a register, or two.
const LANES: usize = 16;

/// Side of the blocks for frames of this size; 1 for a picture that is not divided.
pub fn block(frames: usize, height: usize, width: usize) -> usize {
    if frames * height * width <= WHOLE {
        return 1;
    }
    // Twice as many equations as unknowns.
    let enough = (1..).find(|side| side * side >= 2 * frames).unwrap_or(1);
    enough.max(height.max(width).div_ceil(LONGER_SIDE))
}

/// Frames of a small picture, by a few iterations of GAP-TV. `y` \[S,H,W\] is on the scale on which the scene is on
/// \[0,1\].
///
/// # Errors
/// As [`solver::reconstruct`].
pub fn whole(op: &SensingOperator, y: ArrayView3<'_, f32>) -> Result<Array3<f32>> {
    let schedule = Schedule::gap_tv().with_iterations(ITERATIONS);
    Ok(solver::reconstruct(op, y, &schedule, &mut (), &mut ())?.frames)
}

/// Least squares, block by block, for a row of blocks.
#[derive(Debug)]
pub struct Blocks {
    side: usize,
    frames: usize,
    /// Masks of the block \[B, pixels\], rounded up to whole registers with zeros.
    masks: Vec<f32>,
    /// Residual of the measurement.
    residual: Vec<f32>,
    /// Lower triangle of the normal matrix \[B,B\], and then its Cholesky factor.
    normal: Vec<f32>,
    solution: Vec<f32>,
}

impl Blocks {
    /// A solver for blocks of `side` x `side` pixels of `frames` frames.
    pub fn new(frames: usize, side: usize) -> Self {
        let pixels = (side * side).next_multiple_of(LANES);
        Self {
            side,
            frames,
            masks: vec![0.0; frames * pixels],
            residual: vec![0.0; pixels],
            normal: vec![0.0; frames * frames],
            solution: vec![0.0; frames],
        }
    }

    /// Solves one row of blocks: masks \[B,h,W\] and measurement \[h,W\] of at most `side` rows give frames \[B, W /
    /// side rounded up\]. The last block may be narrower.
    ///
    /// # Errors
    /// Sizes that disagree.
    pub fn row(
        &mut self,
        masks: ArrayView3<'_, f32>,
        y: ArrayView2<'_, f32>,
    ) -> Result<Array2<f32>> {
        let (frames, height, width) = masks.dim();
        let fits = y.dim() == (height, width) && frames == self.frames && height <= self.side;
        let found = format!("{} and {}", shape_text(masks.shape()), shape_text(y.shape()));
        let expected = format!("{} masks of at most {} rows", self.frames, self.side);
        check_shape(fits, "a row of blocks", found, expected)?;
        let mut row = Array2::zeros((frames, width.div_ceil(self.side)));
        for (index, mut out) in row.columns_mut().into_iter().enumerate() {
            let columns = index * self.side..width.min((index + 1) * self.side);
            self.gather(masks.slice(s![.., .., columns.clone()]), y.slice(s![.., columns]));
            self.solve();
            out.iter_mut().zip(&self.solution).for_each(|(out, &value)| *out = value);
        }
        Ok(row)
    }

    /// Pixels that were not measured (NaN) become dark in mask and measurement.
    fn gather(&mut self, masks: ArrayView3<'_, f32>, y: ArrayView2<'_, f32>) {
        let pixels = self.residual.len();
        self.masks.fill(0.0);
        self.residual.fill(0.0);
        for (residual, &y) in self.residual.iter_mut().zip(y) {
            *residual = if y.is_nan() { 0.0 } else { y };
        }
        for (line, mask) in self.masks.chunks_exact_mut(pixels).zip(masks.outer_iter()) {
            for ((value, &c), y) in line.iter_mut().zip(mask).zip(y) {
                *value = if y.is_nan() { 0.0 } else { c };
            }
        }
    }

    /// `x = m + (C C^T + ridge)^-1 C (y - C^T m)` with the block's mean `m` of all frames.
    fn solve(&mut self) {
        let (frames, pixels) = (self.frames, self.residual.len());
        let light: f32 = self.masks.iter().sum();
        let mean = if light > 0.0 { self.residual.iter().sum::<f32>() / light } else { 0.0 };
        for mask in self.masks.chunks_exact(pixels) {
            self.residual.iter_mut().zip(mask).for_each(|(residual, &c)| *residual -= c * mean);
        }
        let mask = |k: usize| &self.masks[k * pixels..(k + 1) * pixels];
        for i in 0..frames {
            for j in 0..=i {
                self.normal[i * frames + j] = dot(mask(i), mask(j));
            }
            self.normal[i * frames + i] += RIDGE;
            self.solution[i] = dot(mask(i), &self.residual);
        }
        cholesky(&mut self.normal, &mut self.solution);
        self.solution.iter_mut().for_each(|value| *value += mean);
    }
}

/// Smoothes coarse frames \[B,h,w\] on \[0,1\], in place.
pub fn smooth(frames: &mut Array3<f32>) {
    let (weight, updates) = SMOOTHING;
    TotalVariation::new(frames.dim()).denoise(frames, weight, updates);
}

#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0f32; LANES];
    for (a, b) in a.chunks_exact(LANES).zip(b.chunks_exact(LANES)) {
        for (sum, (a, b)) in sums.iter_mut().zip(a.iter().zip(b)) {
            *sum += a * b;
        }
    }
    sums.iter().sum()
}

/// Solves `A x = b` in place of `b` for a positive definite `A`, given by its lower triangle, which is overwritten.
fn cholesky(a: &mut [f32], b: &mut [f32]) {
    let n = b.len();
    for i in 0..n {
        for j in 0..=i {
            let known: f32 = (0..j).map(|k| a[i * n + k] * a[j * n + k]).sum();
            let remainder = a[i * n + j] - known;
            // The ridge keeps the diagonal above 0.
            a[i * n + j] = if i == j { remainder.sqrt() } else { remainder / a[j * n + j] };
        }
    }
    for i in 0..n {
        let known: f32 = (0..i).map(|k| a[i * n + k] * b[k]).sum();
        b[i] = (b[i] - known) / a[i * n + i];
    }
    for i in (0..n).rev() {
        let known: f32 = (i + 1..n).map(|k| a[k * n + i] * b[k]).sum();
        b[i] = (b[i] - known) / a[i * n + i];
    }
}

#[cfg(test)]
mod tests {
    use super::{Blocks, block, smooth};
    use ndarray::{Array3, s};
    use optics::{iid_masks, measure};

    #[test]
    fn large_pictures_are_solved_by_blocks_with_enough_equations() {
        assert_eq!(block(10, 256, 256), 1);
        assert_eq!(block(10, 3200, 3200), 5);
        assert_eq!(block(30, 3200, 3200), 8);
        assert_eq!(block(8, 6400, 3200), 10);
    }

    #[test]
    fn flat_blocks_are_recovered_and_the_last_may_be_narrower() {
        let (side, frames) = (6, 8);
        let masks = iid_masks(frames, 12, 27, 5).unwrap();
        let truth = Array3::from_shape_fn((frames, 12, 27), |(k, i, j)| {
            0.2 + 0.1 * ((k + i / side + 2 * (j / side)) % 7) as f32
        });
        let y = measure(masks.view(), truth.view()).unwrap();
        let mut blocks = Blocks::new(frames, side);
        for start in [0, side] {
            let rows = s![start..start + side, ..];
            let found = blocks.row(masks.slice(s![.., start..start + side, ..]), y.slice(rows));
            let found = found.unwrap();
            assert_eq!(found.dim(), (frames, 5));
            for ((k, j), &value) in found.indexed_iter().filter(|((_, j), _)| *j < 4) {
                let expected = truth[[k, start, j * side]];
                assert!((value - expected).abs() < 0.12, "{k} {j} {value} {expected}");
            }
        }
        assert!(blocks.row(masks.view(), y.view()).is_err());
    }

    #[test]
    fn darkness_stays_dark() {
        let dark = Array3::zeros((4, 5, 5));
        let row = Blocks::new(4, 5).row(dark.view(), dark.index_axis(ndarray::Axis(0), 0)).unwrap();
        assert!(row.iter().all(|&value| value == 0.0));
        let mut frames = Array3::from_elem((2, 6, 6), 0.5);
        smooth(&mut frames);
        assert!(frames.iter().all(|&value| (value - 0.5).abs() < 1e-6));
    }
}
