//! The sensing operator of a snapshot camera and its projection.

use std::ops::Range;

use multiversion::multiversion;
#[cfg(feature = "gpu")]
use ndarray::ArrayView1;
use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis};
use std::f32::consts::PI;

use super::error::{ReconError, Result, shape_text};

/// The operator `H` of `y_s = sum_k C_k x_(sB+k)`, for masks `C` \[B,H,W\] on \[0,1\] and a run of `S` snapshots with the
/// frames `x` \[S B,H,W\]: block by block it is the operator of one snapshot.
///
/// `H H^T` is diagonal with `sum_k C_k^2` on it: the sum of *squares*, which is the sum of the masks only if they are binary.
/// A pixel with 0 there is dead: no frame reaches it, and the projection leaves it alone.
#[derive(Debug, Clone)]
pub struct SensingOperator {
    masks: Array3<f32>,
    gram: Array2<f32>,
    /// For each snapshot \[S,H,W\]: they differ where pixels are held out.
    inverse_gram: Array3<f32>,
}

impl SensingOperator {
    /// The operator of one snapshot behind masks \[B,H,W\].
    ///
    /// # Errors
    /// No frame or pixel, a mask value that is not finite, or masks that are 0 everywhere.
    pub fn new(masks: Array3<f32>) -> Result<Self> {
        let (frames, height, width) = masks.dim();
        if frames == 0 || height == 0 || width == 0 {
            return Err(ReconError::Shape {
                what: "the mask stack",
                found: shape_text(masks.shape()),
                expected: "at least one frame of one pixel".into(),
            });
        }
        if let Some(((k, i, j), value)) = masks.indexed_iter().find(|(_, v)| !v.is_finite()) {
            return Err(ReconError::Parameter {
                name: "a mask value".into(),
                value: format!("{value} at frame {k}, row {i}, column {j}"),
                range: "finite".into(),
            });
        }
        let masks = masks.as_standard_layout().into_owned();
        let mut gram = Array2::zeros((height, width));
        for mask in masks.outer_iter() {
            gram.zip_mut_with(&mask, |sum: &mut f32, &c| *sum += c * c);
        }
        if gram.iter().all(|&g| g == 0.0) {
            return Err(ReconError::DarkMasks { frames });
        }
        let inverse_gram = invert(&gram, 1);
        Ok(Self { masks, gram, inverse_gram })
    }

    /// The operator of a run of snapshots behind the same masks.
    ///
    /// # Errors
    /// A number of 0.
    pub fn over(self, snapshots: usize) -> Result<Self> {
        if snapshots == 0 {
            return Err(ReconError::Parameter {
                name: "the number of snapshots".into(),
                value: snapshots.to_string(),
                range: "at least 1".into(),
            });
        }
        let inverse_gram = invert(&self.gram, snapshots);
        Ok(Self { inverse_gram, ..self })
    }

    /// Holds out some pixels of the measurement, given by snapshot, row and column: the projection treats them as dead.
    pub(super) fn without(mut self, pixels: &[(usize, usize, usize)]) -> Self {
        for &pixel in pixels {
            self.inverse_gram[pixel] = 0.0;
        }
        self
    }

    /// True if the projection uses a pixel, given by snapshot, row and column: light reaches it, and it is not held out.
    pub(super) fn uses(&self, pixel: (usize, usize, usize)) -> bool {
        self.inverse_gram[pixel] > 0.0
    }

    /// The masks \[B,H,W\].
    pub fn masks(&self) -> ArrayView3<'_, f32> {
        self.masks.view()
    }

    /// Number of snapshots of the run.
    pub fn snapshots(&self) -> usize {
        self.inverse_gram.dim().0
    }

    /// (frames of all snapshots, height, width).
    pub fn dim(&self) -> (usize, usize, usize) {
        let (frames, height, width) = self.masks.dim();
        (self.snapshots() * frames, height, width)
    }

    /// The size of the measurement: (snapshots, height, width).
    pub(super) fn measurement_dim(&self) -> (usize, usize, usize) {
        self.inverse_gram.dim()
    }

    /// The diagonal of `H H^T` \[H,W\], the same for each snapshot: `sum_k C_k^2`.
    pub fn gram(&self) -> ArrayView2<'_, f32> {
        self.gram.view()
    }

    /// Largest factor from a measured value to a frame's value in a projection that starts from frames of 0.
    pub fn largest_gain(&self) -> f32 {
        let pixels = self.gram.iter().zip(&self.inverse_gram);
        pixels.map(|(gram, inverse)| gram.sqrt() * inverse).fold(0.0, f32::max)
    }

    /// Share of the masks' energy that changes from frame to frame: 0 for equal masks, about 1/2 for independent masks that
    /// are open in half of their pixels.
    fn contrast(&self) -> f32 {
        (1.0 - self.static_gram().sum() / self.gram.sum()).max(0.0)
    }

    /// The static part of the Gram diagonal \[H,W\]: `B` times the square of the mean mask.
    pub(super) fn static_gram(&self) -> Array2<f32> {
        let frames = self.masks.dim().0 as f32;
        let mean = self.masks.mean_axis(Axis(0)).unwrap_or_default();
        mean.mapv(|mean| frames * mean.powi(2))
    }

    /// Covariance `R = Psi^T diag(s, 1, 2^-DECAY, .., (B-1)^-DECAY) Psi` \[B,B\] of the errors of a snapshot's frames at a
    /// pixel, with the DCT-II matrix `Psi`, and `s` = `static_variance` times [`static_share`].
    ///
    /// Highly correlated masks measure the static part of the frames well and its changes hardly. So the error is in the
    /// changes, mainly in the slow ones. A projection along the masks themselves puts nearly the whole residual into the
    /// static part, and the prior has to remove it again.
    pub(super) fn error_covariance(&self, static_variance: f32) -> Array2<f32> {
        let frames = self.masks.dim().0;
        let share = static_share(self.contrast(), frames);
        let static_part = (static_variance * share).max(MIN_STATIC_VARIANCE);
        let count = frames as f32;
        let cosine = |m: usize, k: usize| {
            let norm = if m == 0 { 1.0 / count } else { 2.0 / count }.sqrt();
            norm * (PI * m as f32 * (k as f32 + 0.5) / count).cos()
        };
        let variance = |m: usize| if m == 0 { static_part } else { (m as f32).powf(-DECAY) };
        Array2::from_shape_fn((frames, frames), |(j, k)| {
            (0..frames).map(|m| variance(m) * cosine(m, j) * cosine(m, k)).sum()
        })
    }

    /// Number of pixels that no mask reaches.
    pub fn dead_pixels(&self) -> usize {
        self.gram.iter().filter(|&&g| g == 0.0).count()
    }

    /// `Hx` \[S,H,W\] of frames `x` \[S B,H,W\].
    ///
    /// # Errors
    /// Frames of another size.
    pub fn forward(&self, frames: ArrayView3<'_, f32>) -> Result<Array3<f32>> {
        let (count, height, width) = self.dim();
        self.check("the frame stack", frames.shape(), &[count, height, width])?;
        let mut y = Array3::zeros(self.inverse_gram.raw_dim());
        let blocks = frames.axis_chunks_iter(Axis(0), self.masks.dim().0);
        for (mut y, block) in y.outer_iter_mut().zip(blocks) {
            for (mask, frame) in self.masks.outer_iter().zip(block.outer_iter()) {
                ndarray::azip!((sum in &mut y, &c in &mask, &x in &frame) *sum += c * x);
            }
        }
        Ok(y)
    }

    /// `H^T y` \[S B,H,W\] of a measurement `y` \[S,H,W\].
    ///
    /// # Errors
    /// A measurement of another size.
    pub fn adjoint(&self, y: ArrayView3<'_, f32>) -> Result<Array3<f32>> {
        self.check("the measurement", y.shape(), self.inverse_gram.shape())?;
        let mut frames = Array3::zeros(self.dim());
        for (mut block, y) in
            frames.axis_chunks_iter_mut(Axis(0), self.masks.dim().0).zip(y.outer_iter())
        {
            for (mut frame, mask) in block.outer_iter_mut().zip(self.masks.outer_iter()) {
                ndarray::azip!((x in &mut frame, &c in &mask, &y in &y) *x = c * y);
            }
        }
        Ok(frames)
    }

    /// One projection of GAP: `x = v + R H^T (H R H^T + gamma)^-1 (t - H v)` with the target `t = y` or, accelerated,
    /// `t = y1` after `y1 = y + memory (y1 - H v)`. With `memory` 1 that is the published `y1 += y - H v` (Liao et al.
    /// 2014), with 0 it is plain GAP. [`MAX_OPPOSITION`] bounds `R H^T`.
    ///
    /// Only `rows` of each snapshot are computed; they depend on no other rows. `y` and `y1` are \[S,H,W\], `v` and `x`
    /// \[S B,H,W\], all of the operator's size and in standard layout. Returns `||y - H v||^2` of the rows.
    pub(crate) fn project(
        &self,
        rows: Range<usize>,
        y: &Array3<f32>,
        accumulation: Option<Accumulation<'_>>,
        statistics: &Statistics,
        v: &Array3<f32>,
        x: &mut Array3<f32>,
    ) -> f64 {
        let (frames, height, width) = self.masks.dim();
        let plane = height * width;
        let (Some(masks), Some(inverse), Some(y), Some(v), Some(x)) = (
            self.masks.as_slice(),
            self.inverse_gram.as_slice(),
            y.as_slice(),
            v.as_slice(),
            x.as_slice_mut(),
        ) else {
            unreachable!("arrays of the solver are in standard layout")
        };
        let mut accumulation =
            accumulation.and_then(|Accumulation { y1, memory }| Some((y1.as_slice_mut()?, memory)));
        let covariance = statistics.covariance.as_ref().and_then(|matrix| matrix.as_slice());
        let gamma = statistics.gamma;
        let mut sum = vec![0.0f32; width];
        // `R C` of a row of all frames, and the inverse Gram diagonal that belongs to it.
        let mut directions = vec![0.0f32; if covariance.is_some() { frames * width } else { 0 }];
        let (mut weights, mut bounds) = (vec![0.0f32; width], vec![0.0f32; width]);
        let mut squares = 0.0f64;
        for snapshot in 0..self.snapshots() {
            let block = snapshot * frames * plane..(snapshot + 1) * frames * plane;
            let (v, x) = (&v[block.clone()], &mut x[block]);
            // Row by row over all frames: a row of v and of the masks is still in cache when the correction is added.
            for start in rows.clone().map(|row| row * width) {
                let stack = Stack { plane, start, width, frames };
                let row = snapshot * plane + start..snapshot * plane + start + width;
                let target = accumulation
                    .as_mut()
                    .map(|(y1, memory)| Target { y1: &mut y1[row.clone()], memory: *memory });
                let (y, inverse) = (&y[row.clone()], &inverse[row]);
                let correction = match covariance {
                    None if gamma == 0.0 => Correction { directions: masks, stack, inverse },
                    None => {
                        add_noise(gamma, inverse, &mut weights);
                        Correction { directions: masks, stack, inverse: &weights }
                    }
                    Some(covariance) => {
                        let out = RowDirections {
                            directions: &mut directions,
                            weights: &mut weights,
                            bounds: &mut bounds,
                        };
                        directions_of_row(masks, stack, covariance, gamma, inverse, out);
                        let stack = Stack { plane: width, start: 0, ..stack };
                        Correction { directions: &directions, stack, inverse: &weights }
                    }
                };
                squares += project_row(stack, masks, v, x, y, target, correction, &mut sum);
            }
        }
        squares
    }

    /// All that a projection needs besides the masks: `R C` \[B,H,W\], unless `R` is 1, and `(H R H^T + gamma)^-1`
    /// \[S,H,W\].
    #[cfg(feature = "gpu")]
    pub(crate) fn corrections(
        &self,
        statistics: &Statistics,
    ) -> (Option<Array3<f32>>, Array3<f32>) {
        let Statistics { covariance, gamma } = statistics;
        let mut weights = self.inverse_gram.clone();
        let matrix = covariance.as_ref().and_then(|matrix| matrix.as_slice());
        let (Some(covariance), Some(masks)) = (matrix, self.masks.as_slice()) else {
            if *gamma > 0.0 {
                weights.mapv_inplace(|inverse| 1.0 / (1.0 / inverse + gamma));
            }
            return (None, weights);
        };
        let (frames, height, width) = self.masks.dim();
        let mut all = Array3::zeros((frames, height, width));
        let mut directions = vec![0.0; frames * width];
        let (mut of_row, mut bounds) = (vec![0.0; width], vec![0.0; width]);
        for row in 0..height {
            // Snapshots differ only in hold-out pixels, which are 0.
            let inverses = self.inverse_gram.index_axis(Axis(1), row);
            let inverse = inverses.fold_axis(Axis(0), 0.0f32, |one, other| one.max(*other));
            let stack = Stack { plane: height * width, start: row * width, width, frames };
            let out = RowDirections {
                directions: &mut directions,
                weights: &mut of_row,
                bounds: &mut bounds,
            };
            directions_of_row(masks, stack, covariance, *gamma, &inverse.to_vec(), out);
            for (direction, mut all) in directions.chunks(width).zip(all.outer_iter_mut()) {
                all.row_mut(row).assign(&ArrayView1::from(direction));
            }
            for mut snapshot in weights.outer_iter_mut() {
                for (weight, new) in snapshot.row_mut(row).iter_mut().zip(&of_row) {
                    *weight = if *weight > 0.0 { *new } else { 0.0 };
                }
            }
        }
        (Some(all), weights)
    }

    fn check(&self, what: &'static str, found: &[usize], expected: &[usize]) -> Result<()> {
        if found == expected {
            return Ok(());
        }
        Err(ReconError::Shape { what, found: shape_text(found), expected: shape_text(expected) })
    }
}

/// Smallest divisor, relative to the largest Gram value. At darker pixels noise outweighs light, and the division would
/// amplify it a thousandfold.
const MIN_RELATIVE_GRAM: f32 = 1e-3;
/// Smallest divisor of all.
const MIN_GRAM: f32 = 1e-6;

/// `(H H^T)^-1` \[S,H,W\], bounded where hardly any light arrives.
fn invert(gram: &Array2<f32>, snapshots: usize) -> Array3<f32> {
    let brightest = gram.iter().copied().fold(0.0, f32::max);
    let least = (MIN_RELATIVE_GRAM * brightest).max(MIN_GRAM);
    let inverse = gram.mapv(|g| if g > 0.0 { 1.0 / g.max(least) } else { 0.0 });
    let mut all = Array3::zeros((snapshots, gram.nrows(), gram.ncols()));
    all.outer_iter_mut().for_each(|mut of_one| of_one.assign(&inverse));
    all
}

/// Statistics that a projection assumes of the frames' errors and of the noise, both in the same unit.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Statistics {
    /// Covariance `R` \[B,B\] of the frames' errors at a pixel of a snapshot; the identity if none.
    pub(crate) covariance: Option<Array2<f32>>,
    /// Variance of a measured pixel's noise. With 0 plain GAP forces `y = Hx`.
    pub(crate) gamma: f32,
}

/// Decay of the variance of the error's DCT coefficients along time: `m^-DECAY` for coefficient `m`. Measured after total
/// variation and after the network, behind all kinds of masks, it decays with exponents of 0 to 2.6. For the projection,
/// more than 0.5 gains less, and 0 is worse with noise.
pub(crate) const DECAY: f32 = 0.4;
/// Contrast above which masks distinguish frames well.
pub(crate) const HIGH_CONTRAST: f32 = 0.125;
/// Nine tenths of the contrast of independent binary masks, for many frames.
pub(crate) const INDEPENDENT_CONTRAST: f32 = 0.45;
/// Compression ratio for which a static variance is stated.
pub(crate) const REFERENCE_RATIO: f32 = 10.0;
/// Smallest share of the static variance for masks above [`HIGH_CONTRAST`].
pub(crate) const MIN_STATIC_SHARE: f32 = 0.551;

/// Share of the static variance for `B` masks of contrast `c`: `min((c / 0.125)^1.5, n, max(n (c / c0)^0.9, 0.551))` with
/// `n = (10 / B)^0.5` and `c0 = 0.45 (1 - 1 / B)`.
///
/// With the default's 0.55 the best static variance is 0.07 at a contrast of 0.03, 0.1 at 0.043, 0.15 to 0.2 at 0.06,
/// 0.3 at 0.084, 0.25 to 0.3 from there to 0.17, and 0.3 to 0.4 at 0.25, where optics blur binary masks or closed pixels
/// leak light. Behind independent binary masks (0.45) it is 0.6 to 0.7 at Cr 6 and 8, and 0.3 to 0.45 from Cr 16 on
/// (`research/NOTEBOOK.md`).
fn static_share(contrast: f32, frames: usize) -> f32 {
    let count = frames as f32;
    let by_count = (REFERENCE_RATIO / count).sqrt();
    let low_contrast = (contrast / HIGH_CONTRAST).powf(1.5);
    let independent = INDEPENDENT_CONTRAST * (1.0 - 1.0 / count);
    let blurred = by_count * (contrast / independent).powf(0.9);
    low_contrast.min(by_count).min(blurred.max(MIN_STATIC_SHARE))
}

/// Smallest static variance: behind equal masks only the static part can be observed, so it must not be 0.
pub(crate) const MIN_STATIC_VARIANCE: f32 = 0.01;

/// The accumulated residual of accelerated GAP.
pub(crate) struct Accumulation<'a> {
    /// The target `y1` \[S,H,W\].
    pub(crate) y1: &'a mut Array3<f32>,
    /// The share of the residual that is kept.
    pub(crate) memory: f32,
}

/// A row of an [`Accumulation`].
struct Target<'a> {
    y1: &'a mut [f32],
    memory: f32,
}

/// Directions and weights by which a row's residual is distributed over the frames.
struct Correction<'a> {
    /// `R C` of the frames, at the places that `stack` gives.
    directions: &'a [f32],
    stack: Stack,
    /// `(H R H^T + gamma)^-1` \[W\].
    inverse: &'a [f32],
}

/// The results of [`directions_of_row`].
struct RowDirections<'a> {
    /// `R C` \[B,W\].
    directions: &'a mut [f32],
    /// `(H R H^T + gamma)^-1` \[W\].
    weights: &'a mut [f32],
    /// Working memory \[W\].
    bounds: &'a mut [f32],
}

/// One row through all frames of a stack in standard layout.
#[derive(Clone, Copy)]
struct Stack {
    plane: usize,
    start: usize,
    width: usize,
    frames: usize,
}

/// Bound on the correction of a frame against the sign of the residual, as a share of the total correction. A covariance
/// lets a residual raise frames whose masks are more open than others, and lower the rest. Where a prior removes the error
/// of some frames and keeps that of others, the remaining error `e` is multiplied by `1 - sum c d / (C R C^T)`, summed over
/// the frames that keep it, in each iteration: with `c d < 0` it grows. Behind highly correlated masks single pixels of
/// still fine texture reached values of -6 and 9 that way, at a loss of up to 11 dB.
pub(crate) const MAX_OPPOSITION: f32 = 0.02;

/// Computes `R C` \[B,W\] of a row, with each product with `C` at least -[`MAX_OPPOSITION`] times their sum, and
/// `(H R H^T + gamma)^-1` \[W\]. `inverse` is `(H H^T)^-1`, which [`invert`] has bounded; where it is 0 the result is 0.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn directions_of_row(
    masks: &[f32],
    stack: Stack,
    covariance: &[f32],
    gamma: f32,
    inverse: &[f32],
    out: RowDirections<'_>,
) {
    let Stack { plane, start, width, frames } = stack;
    let RowDirections { directions, weights, bounds } = out;
    let mask = |k: usize| &masks[k * plane + start..][..width];
    // The noise first, and the part that `invert` added.
    weights.iter_mut().zip(inverse).for_each(|(weight, &inverse)| *weight = 1.0 / inverse + gamma);
    for k in 0..frames {
        let direction = &mut directions[k * width..][..width];
        direction.fill(0.0);
        for (j, &r) in covariance[k * frames..][..frames].iter().enumerate() {
            for (d, &c) in direction.iter_mut().zip(mask(j)) {
                *d += r * c;
            }
        }
        for ((weight, &d), &c) in weights.iter_mut().zip(&*direction).zip(mask(k)) {
            *weight += c * (d - c);
        }
    }
    bounds.iter_mut().zip(&*weights).for_each(|(bound, weight)| *bound = -MAX_OPPOSITION * weight);
    for k in 0..frames {
        let direction = &mut directions[k * width..][..width];
        let parts = direction.iter_mut().zip(mask(k)).zip(&*bounds);
        for (((d, &c), &bound), weight) in parts.zip(&mut *weights) {
            // Raise products below the bound to it; a closed pixel has none.
            let missing = (bound - c * *d).max(0.0);
            *weight += missing;
            *d += if c > 0.0 { missing / c } else { 0.0 };
        }
    }
    for (weight, &inverse) in weights.iter_mut().zip(inverse) {
        *weight = if inverse > 0.0 { 1.0 / *weight } else { 0.0 };
    }
}

/// `(H H^T + gamma)^-1` \[W\] of a row from `(H H^T)^-1`; 0 where that is 0.
fn add_noise(gamma: f32, inverse: &[f32], weights: &mut [f32]) {
    for (weight, &inverse) in weights.iter_mut().zip(inverse) {
        *weight = inverse / (1.0 + gamma * inverse);
    }
}

#[allow(clippy::too_many_arguments)] // one kernel over plain slices, so that it vectorises
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn project_row(
    stack: Stack,
    masks: &[f32],
    v: &[f32],
    x: &mut [f32],
    y: &[f32],
    target: Option<Target<'_>>,
    correction: Correction<'_>,
    sum: &mut [f32],
) -> f64 {
    let Stack { plane, start, width, frames } = stack;
    let Correction { directions, stack: along, inverse } = correction;
    sum.fill(0.0);
    for k in 0..frames {
        let row = k * plane + start..k * plane + start + width;
        for ((s, &c), &value) in sum.iter_mut().zip(&masks[row.clone()]).zip(&v[row]) {
            *s += c * value;
        }
    }
    let squares = squared_distance(y, sum);
    match target {
        Some(Target { y1, memory }) => {
            for (((s, &y), t), &inverse) in sum.iter_mut().zip(y).zip(y1).zip(inverse) {
                *t = y + memory * (*t - *s);
                *s = (*t - *s) * inverse;
            }
        }
        None => {
            for ((s, &y), &inverse) in sum.iter_mut().zip(y).zip(inverse) {
                *s = (y - *s) * inverse;
            }
        }
    }
    for k in 0..frames {
        let row = k * plane + start..k * plane + start + width;
        let (v, x) = (&v[row.clone()], &mut x[row]);
        let direction = &directions[k * along.plane + along.start..][..width];
        for (((x, &v), &d), &s) in x.iter_mut().zip(v).zip(direction).zip(&*sum) {
            *x = v + d * s;
        }
    }
    f64::from(squares)
}

/// `||a - b||^2`.
#[inline(always)]
fn squared_distance(a: &[f32], b: &[f32]) -> f32 {
    // Independent sums, which do not wait for each other.
    let mut sums = [0.0f32; 128];
    for (a, b) in a.chunks(128).zip(b.chunks(128)) {
        for (sum, (a, b)) in sums.iter_mut().zip(a.iter().zip(b)) {
            *sum += (a - b) * (a - b);
        }
    }
    sums.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::{Accumulation, MIN_STATIC_SHARE, SensingOperator, Statistics};
    use ndarray::Array3;
    use proptest::prelude::{any, proptest};

    fn random(seed: u64, dim: (usize, usize, usize)) -> Array3<f32> {
        use rand::{RngExt, SeedableRng};
        let mut rng = rand::rngs::ChaCha8Rng::seed_from_u64(seed);
        Array3::from_shape_fn(dim, |_| rng.random::<f32>())
    }

    proptest! {
        #[test]
        fn adjoint_is_the_adjoint(
            seed in any::<u64>(),
            snapshots in 1usize..4,
            dim in (1usize..5, 1usize..9, 1usize..9),
        ) {
            let op = SensingOperator::new(random(seed, dim)).unwrap().over(snapshots).unwrap();
            let x = random(seed ^ 1, op.dim());
            let y = random(seed ^ 2, (snapshots, dim.1, dim.2));
            let left: f32 = (&op.forward(x.view()).unwrap() * &y).sum();
            let right: f32 = (&op.adjoint(y.view()).unwrap() * &x).sum();
            assert!((left - right).abs() <= 1e-4 * left.abs().max(1.0), "{left} {right}");
        }

        #[test]
        fn plain_projection_meets_the_measurement(
            seed in any::<u64>(),
            snapshots in 1usize..4,
            dim in (1usize..5, 1usize..9, 1usize..20),
        ) {
            let op = SensingOperator::new(random(seed, dim)).unwrap().over(snapshots).unwrap();
            let truth = random(seed ^ 1, op.dim());
            let y = op.forward(truth.view()).unwrap();
            let v = random(seed ^ 2, op.dim());
            let mut x = Array3::zeros(op.dim());
            let squares = op.project(0..dim.1, &y, None, &Statistics::default(), &v, &mut x);
            let before = &y - &op.forward(v.view()).unwrap();
            let after = &y - &op.forward(x.view()).unwrap();
            let expected: f64 = before.iter().map(|&r| f64::from(r * r)).sum();
            assert!((squares - expected).abs() <= 1e-4 * expected.max(1e-3));
            let dark = op.gram().iter().copied().fold(0.0, f32::max) * super::MIN_RELATIVE_GRAM;
            for after in after.outer_iter() {
                for (residual, gram) in after.iter().zip(op.gram()) {
                    assert!(residual.abs() < 1e-4 || *gram <= dark, "{residual} {gram}");
                }
            }
        }
    }

    /// The sum of the covariance is the static variance times the number of frames.
    #[test]
    fn correlated_masks_have_a_smaller_static_variance() {
        let static_variance = |masks: Array3<f32>| {
            let frames = masks.dim().0 as f32;
            SensingOperator::new(masks).unwrap().error_covariance(0.5).sum() / frames
        };
        let assert_close = |variance: f32, expected: f32| {
            assert!((variance - expected).abs() < 0.02, "{variance}, not {expected}")
        };
        let masks = |contrast: f32| random(3, (4, 32, 32)).mapv(|c| 1.0 + contrast * (c - 0.5));
        // Three quarters of the variance of four independent frames are changes.
        assert_close(static_variance(masks(1.0)), 0.5 * (0.0577f32 / 0.125).powf(1.5));
        assert_close(static_variance(masks(0.0)), 0.01);
        let binary = |frames: usize| random(3, (frames, 32, 32)).mapv(f32::round);
        assert_close(static_variance(binary(4)), 0.5 * 2.5f32.sqrt());
        assert_close(static_variance(binary(20)), 0.5 * 0.5f32.sqrt());
        // Light through closed pixels: half and a third of the contrast of binary masks.
        let leaking = |frames: usize, light: f32| {
            static_variance(random(3, (frames, 32, 32)).mapv(|c| light + (1.0 - light) * c.round()))
        };
        assert_close(leaking(10, 0.23), 0.5 * 0.65);
        assert_close(leaking(10, 0.42), 0.5 * MIN_STATIC_SHARE);
    }

    /// A prior that removes the error of all frames but one leaves that one to the projection.
    #[test]
    fn an_error_that_a_prior_keeps_in_some_frames_does_not_grow() {
        // Correlated like the masks of a hybrid coded aperture.
        let masks = random(5, (16, 12, 12)).mapv(|c| 0.4 + 0.3 * c);
        let op = SensingOperator::new(masks).unwrap();
        let covariance = Some(op.error_covariance(0.5));
        let statistics = Statistics { covariance, gamma: 0.0 };
        let y = Array3::zeros((1, 12, 12));
        for kept in 0..16 {
            let mut v = Array3::zeros((16, 12, 12));
            v.slice_mut(ndarray::s![kept, .., ..]).fill(1.0);
            let mut x = Array3::zeros((16, 12, 12));
            for _ in 0..65 {
                op.project(0..12, &y, None, &statistics, &v, &mut x);
                v.slice_mut(ndarray::s![kept, .., ..]).assign(&x.slice(ndarray::s![kept, .., ..]));
            }
            // 1.02^65.
            let error = v.iter().copied().fold(0.0, f32::max);
            assert!(error < 3.63, "frame {kept}: {error}");
        }
    }

    #[test]
    fn dead_pixels_are_left_alone() {
        let mut masks = random(3, (2, 3, 3));
        masks.slice_mut(ndarray::s![.., 1, 1]).fill(0.0);
        let op = SensingOperator::new(masks).unwrap();
        assert_eq!(op.dead_pixels(), 1);
        let v = random(4, (2, 3, 3));
        let mut x = Array3::zeros((2, 3, 3));
        let mut y1 = Array3::from_elem((1, 3, 3), 5.0);
        op.project(
            0..3,
            &Array3::from_elem((1, 3, 3), 1.0),
            Some(Accumulation { y1: &mut y1, memory: 1.0 }),
            &Statistics::default(),
            &v,
            &mut x,
        );
        assert_eq!(x[[0, 1, 1]], v[[0, 1, 1]]);
        assert!(x.iter().all(|value| value.is_finite()));
        assert!(op.over(0).is_err());
    }

    #[test]
    fn noise_of_dark_pixels_is_not_amplified() {
        let mut masks = random(3, (4, 3, 3));
        masks.slice_mut(ndarray::s![.., 1, 1]).fill(1e-7);
        let op = SensingOperator::new(masks).unwrap();
        let v = random(4, (4, 3, 3));
        let mut y = op.forward(v.view()).unwrap();
        y[[0, 1, 1]] += 0.04;
        let mut x = Array3::zeros((4, 3, 3));
        op.project(0..3, &y, None, &Statistics::default(), &v, &mut x);
        let change = (&x - &v).mapv(f32::abs);
        assert!(change.iter().all(|change| *change < 1e-3), "{change}");
    }

    #[test]
    fn dark_and_broken_masks_are_refused() {
        let dark = SensingOperator::new(Array3::zeros((4, 2, 2))).unwrap_err();
        assert!(dark.to_string().contains("all 4 frames"), "{dark}");
        let mut masks = Array3::ones((1, 2, 2));
        masks[[0, 1, 0]] = f32::NAN;
        let broken = SensingOperator::new(masks).unwrap_err();
        assert!(broken.to_string().contains("frame 0, row 1, column 0"), "{broken}");
    }

    #[test]
    fn the_adjoint_belongs_to_the_forward_model_of_the_optics() {
        use rand::SeedableRng;
        // <H x, y> = <x, H^T y>, with masks of the whole chain of optics.
        let (masks, _) = optics::random_squares(4, 12, 9, 3).unwrap();
        let mut rng = rand::rngs::ChaCha8Rng::seed_from_u64(8);
        let frames =
            Array3::from_shape_simple_fn((4, 12, 9), || rand::RngExt::random::<f32>(&mut rng));
        let y = ndarray::Array2::from_shape_simple_fn((12, 9), || {
            rand::RngExt::random::<f32>(&mut rng) - 0.5
        });
        let forward = optics::measure(masks.view(), frames.view()).unwrap();
        let op = SensingOperator::new(masks).unwrap();
        let adjoint = op.adjoint(y.view().insert_axis(ndarray::Axis(0))).unwrap();
        let (left, right) = ((&forward * &y).sum(), (&frames * &adjoint).sum());
        assert!((left - right).abs() < 1e-4 * left.abs().max(1.0), "{left} {right}");
    }
}
