//! A nonlocal low-rank prior that learns from the snapshot itself.
//!
//! Similar patches of several frames, stacked as the columns of a matrix `Y`, span few directions.
//! Each group is filtered by its own covariance, as in nonlocal Bayes (Lebrun, Buades and Morel,
//! SIAM J. Imaging Sciences 2013) and in rank minimization for snapshots (Liu, Yuan, Suo, Brady and
//! Dai, TPAMI 2019). Instead of singular values that are thresholded one by one, the filter is
//! `G^2 (G^2 + tau^2)^-1` with `G = Y Y^T`: nearly as sharp (of second order in the eigenvalues),
//! and one Cholesky factorisation instead of an eigenvalue problem.

use std::ops::Range;

use multiversion::multiversion;
use ndarray::Array3;

use super::{Memory, Networks, Parameter, Pass, Prior, Ready, SIGMA, Settings};
use crate::recon::error::ReconError;

/// Groups of similar patches, filtered by their own covariance.
pub const NONLOCAL: NonlocalPrior = NonlocalPrior;

/// See [`NONLOCAL`].
pub struct NonlocalPrior;

impl Prior for NonlocalPrior {
    fn name(&self) -> &'static str {
        "nonlocal"
    }

    fn summary(&self) -> &'static str {
        "groups of similar patches, filtered by their own covariance"
    }

    fn parameters(&self) -> Vec<&'static Parameter> {
        vec![&SIGMA]
    }

    fn cost(&self, _: &Settings) -> f64 {
        1_700.0
    }

    /// Four clips with margins, and 40 indices for each 16 pixels.
    fn memory(&self) -> Memory {
        Memory { per_voxel: 30, per_network_pixel: 0 }
    }

    fn begin(&self, size: (usize, usize, usize)) -> Box<dyn Pass> {
        Box::new(Nonlocal::new(size))
    }
}

impl Pass for Nonlocal {
    fn apply(
        &mut self,
        x: &mut Array3<f32>,
        rows: Range<usize>,
        settings: &Settings,
        _: &mut dyn Networks,
        ready: &mut Ready<'_>,
    ) -> Result<(), ReconError> {
        self.denoise(x, settings.sigma);
        (0..x.dim().0).for_each(|k| ready(x, k, rows.clone()));
        Ok(())
    }
}

/// Height and width of a patch, pixels.
const SIDE: usize = 6;
/// Pixels of a patch.
const PIXELS: usize = SIDE * SIDE;
/// Patches of a group.
const PATCHES: usize = 40;
/// Distance of neighbouring reference patches, pixels.
const STRIDE: usize = 4;
/// Height and width of the window that is searched in each frame, in positions of patches.
const WINDOW: usize = 16;
/// Frames before and after the reference that are searched.
const REACH: usize = 3;
/// Passes for which the groups are kept.
const REFRESH: usize = 4;
/// `tau` in units of `PATCHES sigma^2`, the eigenvalue that noise alone would have.
const STRENGTH: f32 = 4.0;
/// Groups that are filtered at once, one in each lane of the vector registers.
const LANES: usize = 16;

/// One number of each of the groups that are filtered at once.
type Lanes = [f32; LANES];

/// The prior with its groups and working memory, for clips of one size.
#[derive(Debug)]
pub struct Nonlocal {
    frames: usize,
    height: usize,
    width: usize,
    passes: usize,
    /// The clip; all clips here have a margin on the right, so that a search reads whole vectors.
    noisy: Vec<f32>,
    /// The result of the pass before: patches are compared in it.
    guide: Vec<f32>,
    sum: Vec<f32>,
    /// How many patches cover a pixel.
    cover: Vec<f32>,
    /// Top left pixels of all patches, `PATCHES` for a group.
    groups: Vec<u32>,
    filter: Box<Filter>,
}

impl Nonlocal {
    /// For clips of `frames` frames of `height` x `width` pixels.
    pub fn new((frames, height, width): (usize, usize, usize)) -> Self {
        let size = frames * height * row_length(width) + row_length(width);
        Self {
            frames,
            height,
            width,
            passes: 0,
            noisy: vec![0.0; size],
            guide: vec![0.0; size],
            sum: vec![0.0; size],
            cover: vec![0.0; size],
            groups: Vec::new(),
            filter: Box::default(),
        }
    }

    /// Removes noise of level `sigma` from frames \[B,H,W\] on \[0,1\], in place. Frames smaller
    /// than a patch (6x6) are left as they are.
    ///
    /// Passes of one object belong to one clip: patches are compared in the result of the pass
    /// before, and the groups are kept for a few passes.
    pub fn denoise(&mut self, frames: &mut Array3<f32>, sigma: f32) {
        debug_assert_eq!(frames.dim(), (self.frames, self.height, self.width));
        if self.height < SIDE || self.width < SIDE {
            return;
        }
        let row_length = row_length(self.width);
        let rows = self.noisy.chunks_exact_mut(row_length);
        for (row, source) in rows.zip(frames.rows()) {
            row.iter_mut().zip(source).for_each(|(value, &x)| *value = x);
        }
        if self.passes == 0 {
            self.guide.copy_from_slice(&self.noisy);
        }
        if self.passes.is_multiple_of(REFRESH) {
            self.search();
        }
        self.passes += 1;
        self.filter_groups(sigma);
        let filtered = self.guide.chunks_exact_mut(row_length);
        let sums = self.sum.chunks_exact(row_length).zip(self.cover.chunks_exact(row_length));
        for ((mut row, guide), (sum, cover)) in
            frames.rows_mut().into_iter().zip(filtered).zip(sums)
        {
            for (((value, guide), sum), cover) in row.iter_mut().zip(guide).zip(sum).zip(cover) {
                *value = sum / cover;
                *guide = *value;
            }
        }
    }

    /// Finds the patches most similar to each reference patch, near it in space and time.
    fn search(&mut self) {
        let row_length = row_length(self.width);
        let plane = self.height * row_length;
        let mut candidates: Vec<(f32, u32)> = Vec::new();
        self.groups.clear();
        self.cover.fill(0.0);
        let (rows, columns) = (positions(self.height), positions(self.width));
        for frame in 0..self.frames {
            let near = frame.saturating_sub(REACH)..(frame + REACH + 1).min(self.frames);
            for (&row, &column) in rows.iter().flat_map(|row| columns.iter().map(move |c| (row, c)))
            {
                let (top, left) = (window(row, self.height), window(column, self.width));
                let reference = frame * plane + row * row_length + column;
                candidates.clear();
                for start in near.clone().flat_map(|k| top.clone().map(move |i| (k, i))) {
                    let start = start.0 * plane + start.1 * row_length + left.start;
                    let distances = distances(&self.guide, reference, start, row_length);
                    let places = distances.iter().zip(start as u32..).take(left.len());
                    candidates.extend(places.map(|(&distance, place)| {
                        // The reference comes first even among its equals: every pixel is covered.
                        (if place as usize == reference { -1.0 } else { distance }, place)
                    }));
                }
                let last = PATCHES.min(candidates.len()) - 1;
                candidates.select_nth_unstable_by(last, |a, b| a.0.total_cmp(&b.0));
                // A clip too small for a full group repeats what it has.
                let members = candidates[..=last].iter().map(|&(_, place)| place).cycle();
                self.groups.extend(members.take(PATCHES));
            }
        }
        for &place in &self.groups {
            for i in 0..SIDE {
                let row = &mut self.cover[place as usize + i * row_length..][..SIDE];
                row.iter_mut().for_each(|cover| *cover += 1.0);
            }
        }
    }

    fn filter_groups(&mut self, sigma: f32) {
        let Self { noisy, sum, groups, filter, width, .. } = self;
        let row_length = row_length(*width);
        let tau = STRENGTH * PATCHES as f32 * sigma * sigma;
        sum.fill(0.0);
        for batch in groups.chunks(LANES * PATCHES) {
            for (index, &place) in batch.iter().enumerate() {
                let (lane, patch) = (index / PATCHES, index % PATCHES);
                for i in 0..SIDE {
                    let row = &noisy[place as usize + i * row_length..][..SIDE];
                    for (j, &value) in row.iter().enumerate() {
                        filter.patches[i * SIDE + j][patch][lane] = value;
                    }
                }
            }
            low_rank(filter, tau);
            for (index, &place) in batch.iter().enumerate() {
                let (lane, patch) = (index / PATCHES, index % PATCHES);
                for i in 0..SIDE {
                    let row = &mut sum[place as usize + i * row_length..][..SIDE];
                    for (j, value) in row.iter_mut().enumerate() {
                        *value += filter.patches[i * SIDE + j][patch][lane];
                    }
                }
            }
        }
    }
}

/// Length of a row with its margin.
fn row_length(width: usize) -> usize {
    width + WINDOW + SIDE
}

/// Positions of the reference patches along an axis, the last one at its end.
fn positions(length: usize) -> Vec<usize> {
    let last = length - SIDE;
    let mut all: Vec<usize> = (0..last).step_by(STRIDE).collect();
    all.push(last);
    all
}

/// Positions that are searched around `at`.
fn window(at: usize, length: usize) -> Range<usize> {
    let count = length - SIDE + 1;
    let start = at.saturating_sub(WINDOW / 2).min(count.saturating_sub(WINDOW));
    start..(start + WINDOW).min(count)
}

/// Squared distances of the patch at `reference` to `WINDOW` patches side by side from `start`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn distances(clip: &[f32], reference: usize, start: usize, row_length: usize) -> [f32; WINDOW] {
    let mut sums = [0.0f32; WINDOW];
    for i in 0..SIDE {
        let patch = &clip[reference + i * row_length..][..SIDE];
        let row = &clip[start + i * row_length..][..SIDE + WINDOW];
        for (j, &value) in patch.iter().enumerate() {
            for (sum, other) in sums.iter_mut().zip(&row[j..j + WINDOW]) {
                *sum += (other - value) * (other - value);
            }
        }
    }
    sums
}

/// The patches of `LANES` groups and what their filter needs.
#[derive(Debug)]
struct Filter {
    /// `Y`, a row for each pixel of a patch.
    patches: [[Lanes; PATCHES]; PIXELS],
    gram: [[Lanes; PIXELS]; PIXELS],
    /// Lower triangle of the Cholesky factor, with the reciprocals of its diagonal.
    factor: [[Lanes; PIXELS]; PIXELS],
    solved: [[Lanes; PATCHES]; PIXELS],
}

impl Default for Filter {
    fn default() -> Self {
        let (rows, square) = ([[[0.0; LANES]; PATCHES]; PIXELS], [[[0.0; LANES]; PIXELS]; PIXELS]);
        Self { patches: rows, gram: square, factor: square, solved: rows }
    }
}

/// `Y <- mean + G^2 (G^2 + tau^2)^-1 (Y - mean)` with `G` of the patches less their mean, in every
/// lane: the same as `Y - tau^2 (G^2 + tau^2)^-1 (Y - mean)`.
// With AVX-512 the compiler gathers across groups instead of using a register a group: 4 times slower.
#[multiversion(targets("x86_64+avx2+fma"))]
#[allow(clippy::needless_range_loop)] // the indices of the algebra
fn low_rank(filter: &mut Filter, tau: f32) {
    let Filter { patches, gram, factor, solved } = filter;
    for (row, centred) in patches.iter().zip(solved.iter_mut()) {
        let mut mean = [0.0; LANES];
        row.iter().for_each(|value| each(&mut mean, value, |mean, value| mean + value));
        mean.iter_mut().for_each(|mean| *mean /= PATCHES as f32);
        for (centred, value) in centred.iter_mut().zip(row) {
            *centred = *value;
            each(centred, &mean, |value, mean| value - mean);
        }
    }
    for i in 0..PIXELS {
        for j in 0..=i {
            gram[i][j] = dot(&solved[i], &solved[j]);
            gram[j][i] = gram[i][j];
        }
    }
    // Far below the largest eigenvalue the square is lost in rounding: the filter passes nothing there.
    let mut trace = [0.0; LANES];
    (0..PIXELS).for_each(|i| each(&mut trace, &gram[i][i], |trace, value| trace + value));
    let square = trace.map(|trace| (tau * tau).max(4e-6 * trace * trace));
    for i in 0..PIXELS {
        for j in 0..=i {
            let mut value = dot(&gram[i], &gram[j]);
            let (above, below) = factor.split_at_mut(i);
            let row = &mut below[0];
            if i == j {
                each(&mut value, &square, |value, square| value + square);
                each(&mut value, &dot(&row[..j], &row[..j]), |value, part| value - part);
                // The pivots of a sum with tau^2 are at least that, but for rounding.
                each(&mut value, &square, |pivot, least| 1.0 / pivot.max(0.1 * least).sqrt());
            } else {
                each(&mut value, &dot(&row[..j], &above[j][..j]), |value, part| value - part);
                each(&mut value, &above[j][j], |value, diagonal| value * diagonal);
            }
            row[j] = value;
        }
    }
    for i in 0..PIXELS {
        let (done, rest) = solved.split_at_mut(i);
        for (j, done) in done.iter().enumerate() {
            subtract(&mut rest[0], done, &factor[i][j]);
        }
        rest[0].iter_mut().for_each(|value| each(value, &factor[i][i], |value, f| value * f));
    }
    for i in (0..PIXELS).rev() {
        let (rest, done) = solved.split_at_mut(i + 1);
        for (j, done) in done.iter().enumerate() {
            subtract(&mut rest[i], done, &factor[i + 1 + j][i]);
        }
        rest[i].iter_mut().for_each(|value| each(value, &factor[i][i], |value, f| value * f));
    }
    for (row, solved) in patches.iter_mut().zip(solved) {
        subtract(row, solved, &square);
    }
}

/// `a <- f(a, b)` in every lane.
#[inline(always)]
fn each(a: &mut Lanes, b: &Lanes, f: impl Fn(f32, f32) -> f32) {
    for lane in 0..LANES {
        a[lane] = f(a[lane], b[lane]);
    }
}

#[inline(always)]
fn dot(a: &[Lanes], b: &[Lanes]) -> Lanes {
    let mut sum = [0.0; LANES];
    for (a, b) in a.iter().zip(b) {
        for lane in 0..LANES {
            sum[lane] += a[lane] * b[lane];
        }
    }
    sum
}

/// `row <- row - factor other`.
#[inline(always)]
fn subtract(row: &mut [Lanes], other: &[Lanes], factor: &Lanes) {
    for (value, other) in row.iter_mut().zip(other) {
        for lane in 0..LANES {
            value[lane] -= factor[lane] * other[lane];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Filter, LANES, Nonlocal, PATCHES, PIXELS, low_rank, positions, window};
    use ndarray::Array3;
    use rand::{Rng, SeedableRng};

    fn noisy(size: (usize, usize, usize), sigma: f32) -> (Array3<f32>, Array3<f32>) {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        let clean = Array3::from_shape_fn(size, |(k, i, j)| {
            0.5 + 0.3 * ((i + 2 * k) as f32 * 0.25).sin() * ((j + k) as f32 * 0.2).cos()
        });
        // Uniform noise has the deviation of its width by the root of 12.
        let width = sigma * 12.0f32.sqrt();
        let noisy = clean.mapv(|x: f32| x + width * (rng.random::<f32>() - 0.5));
        (clean, noisy)
    }

    fn mean_square(a: &Array3<f32>, b: &Array3<f32>) -> f32 {
        (a - b).mapv(|d| d * d).mean().unwrap()
    }

    #[test]
    fn noise_falls_for_any_size_and_any_number_of_frames() {
        for size in [(1, 24, 24), (3, 33, 46), (9, 17, 50), (2, 6, 7)] {
            let (clean, mut video) = noisy(size, 0.1);
            let before = mean_square(&video, &clean);
            let mut prior = Nonlocal::new(size);
            prior.denoise(&mut video, 0.1);
            let after = mean_square(&video, &clean);
            // A handful of patches tells little.
            let least = if size.1 < 10 { 1.0 } else { 0.25 };
            assert!(after < least * before, "{size:?}: {before} to {after}");
        }
    }

    /// Eigenvalues and eigenvectors (rows) of a symmetric matrix, by Jacobi's rotations.
    #[allow(clippy::needless_range_loop)] // the indices of the algebra
    fn eigen(mut a: Vec<Vec<f64>>) -> (Vec<f64>, Vec<Vec<f64>>) {
        let n = a.len();
        let mut vectors: Vec<Vec<f64>> =
            (0..n).map(|i| (0..n).map(|j| f64::from(u8::from(i == j))).collect()).collect();
        for (p, q) in (0..12).flat_map(|_| (0..n).flat_map(|q| (0..q).map(move |p| (p, q)))) {
            let angle = 0.5 * (2.0 * a[p][q]).atan2(a[q][q] - a[p][p]);
            let (s, c) = angle.sin_cos();
            for k in 0..n {
                (a[k][p], a[k][q]) = (c * a[k][p] - s * a[k][q], s * a[k][p] + c * a[k][q]);
            }
            for rows in [&mut a, &mut vectors] {
                for k in 0..n {
                    let (x, y) = (rows[p][k], rows[q][k]);
                    (rows[p][k], rows[q][k]) = (c * x - s * y, s * x + c * y);
                }
            }
        }
        ((0..n).map(|i| a[i][i]).collect(), vectors)
    }

    /// Each eigenvector `e` of `G = Y Y^T` with the eigenvalue `l` keeps the share `l^2 / (l^2 + tau^2)`.
    #[test]
    fn the_filter_is_that_of_the_eigenvalues() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(7);
        let (mut filter, tau) = (Box::<Filter>::default(), 0.9);
        for lane in 0..LANES {
            // Few directions and noise, as in a group of similar patches.
            let directions: Vec<f32> = (0..3 * PIXELS).map(|_| rng.random::<f32>() - 0.5).collect();
            for patch in 0..PATCHES {
                let shares: [f32; 3] = rng.random();
                for i in 0..PIXELS {
                    let signal: f32 = (0..3).map(|d| shares[d] * directions[d * PIXELS + i]).sum();
                    let noise = 0.3 * (rng.random::<f32>() - 0.5);
                    filter.patches[i][patch][lane] = 0.5 + signal + noise;
                }
            }
        }
        let before = filter.patches;
        low_rank(&mut filter, tau);
        for lane in [0, 5, LANES - 1] {
            let mean = |i: usize| {
                (0..PATCHES).map(|k| f64::from(before[i][k][lane])).sum::<f64>() / PATCHES as f64
            };
            let centred: Vec<Vec<f64>> = (0..PIXELS)
                .map(|i| (0..PATCHES).map(|k| f64::from(before[i][k][lane]) - mean(i)).collect())
                .collect();
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            let gram = centred.iter().map(|a| centred.iter().map(|b| dot(a, b)).collect());
            let (values, vectors) = eigen(gram.collect());
            assert!(values.iter().any(|l| *l > 2.0) && values.iter().any(|l| *l < 0.5));
            for k in 0..PATCHES {
                let patch: Vec<f64> = centred.iter().map(|row| row[k]).collect();
                for i in 0..PIXELS {
                    let kept = values.iter().zip(&vectors).map(|(value, vector)| {
                        let square = value * value;
                        square / (square + f64::from(tau * tau)) * dot(vector, &patch) * vector[i]
                    });
                    let expected = mean(i) + kept.sum::<f64>();
                    let found = f64::from(filter.patches[i][k][lane]);
                    assert!((found - expected).abs() < 1e-4, "{lane} {k} {i}: {found} {expected}");
                }
            }
        }
    }

    #[test]
    fn repeated_passes_keep_a_clean_clip_nearly_as_it_is() {
        let size = (4, 32, 40);
        let (clean, _) = noisy(size, 0.0);
        let mut video = clean.clone();
        let mut prior = Nonlocal::new(size);
        for _ in 0..6 {
            prior.denoise(&mut video, 0.01);
        }
        assert!(mean_square(&video, &clean) < 1e-4, "{}", mean_square(&video, &clean));
    }

    #[test]
    fn frames_smaller_than_a_patch_and_frames_without_contrast_stay() {
        for size in [(2, 5, 30), (3, 30, 30)] {
            let mut video = Array3::from_elem(size, 0.25f32);
            Nonlocal::new(size).denoise(&mut video, 0.05);
            assert!(video.iter().all(|&x| (x - 0.25).abs() < 1e-5), "{size:?}");
        }
    }

    #[test]
    fn a_group_has_more_patches_than_dimensions_and_windows_stay_inside() {
        const { assert!(PATCHES > PIXELS) };
        assert_eq!(positions(6), [0]);
        assert_eq!(positions(17), [0, 4, 8, 11]);
        assert_eq!((window(0, 40), window(20, 40), window(34, 40)), (0..16, 12..28, 19..35));
        assert_eq!(window(1, 8), 0..3);
    }
}
