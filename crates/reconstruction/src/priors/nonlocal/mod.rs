//! A nonlocal low-rank prior that learns from the snapshot itself.
//!
//! Similar patches of several frames, stacked as the columns of a matrix `Y`, span few directions.
//! Each group is filtered by its covariance, as in nonlocal Bayes (Lebrun, Buades and Morel,
//! SIAM J. Imaging Sciences 2013) and in rank minimization for snapshots (Liu, Yuan, Suo, Brady and
//! Dai, TPAMI 2019). Instead of singular values that are thresholded one by one, the filter is
//! `G^2 (G^2 + tau^2)^-1` with `G = Y Y^T`: nearly as sharp (of second order in the eigenvalues),
//! and one Cholesky factorisation instead of an eigenvalue problem.

mod layout;
mod low_rank;
#[cfg(feature = "gpu")]
pub(crate) mod on_gpu;
mod search;
mod spec;
mod temporal_shrinkage;

use ndarray::{Array3, ArrayView2, ArrayView3, ShapeBuilder};
use pulp::{Arch, Simd, WithSimd};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Size, noise_levels};
use crate::cores::{Cores, share_with};
use crate::motion::Motion;
use layout::{BATCH, PATCHES, PIXELS, SIDE, place_of, row_length};
use low_rank::{BATCH_VALUES, Filter};
use search::{Best, Line};
use temporal_shrinkage::TemporalShrinkage;

/// Parameters of the nonlocal low-rank prior.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct NonlocalSpec {
    /// Noise level on [0, 1] at the first and the last iteration, geometric between them.
    #[schemars(transform = noise_levels)]
    pub sigma: [f32; 2],
    /// Temporal shrinkage: DCT-II coefficients of a pixel along time, with mean square e over 5x5 pixels, lose the share
    /// l^4 / (l^4 + e^2), where l is temporal_shrinkage times sigma; 0 for none. An adaptive schedule multiplies it by 4,
    /// then by 8, where that is better.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 1e6))]
    pub temporal_shrinkage: f32,
    /// Temporal shrinkage of static regions, only beside temporal_shrinkage. The stage is then run twice from its start,
    /// with either shrinkage, and blended. The temporal changes before the stage and after its first run are compared
    /// over 17x17 pixels. With a correlation below 0.65 a region is static, above 0.8 it is moving. With null the stage
    /// is run once. An adaptive schedule sets it where strong shrinkage is better.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 1e6))]
    pub static_shrinkage: Option<f32>,
    /// True if the whole picture is static: the result is that of the second run, and the first only serves to
    /// estimate the error. Only beside static_shrinkage. An adaptive schedule sets it for a stage that stops in its first
    /// half, when changes are mostly noise.
    #[serde(default)]
    pub all_static: bool,
    /// True if search windows follow the estimated motion.
    #[serde(default = "yes")]
    pub motion_compensation: bool,
    /// A pixel further than this times sigma outside the range of its eight neighbours is clamped; null clamps none.
    #[serde(default = "default_outlier_limit")]
    #[schemars(range(min = 0.0, max = 1e6))]
    pub outlier_limit: Option<f32>,
}

fn yes() -> bool {
    true
}

fn default_outlier_limit() -> Option<f32> {
    Some(OUTLIER_LIMIT)
}

impl NonlocalSpec {
    /// Parameters with this noise level and shrinkage, and the default of all others.
    pub fn new(sigma: [f32; 2], temporal_shrinkage: f32) -> Self {
        Self {
            sigma,
            temporal_shrinkage,
            static_shrinkage: None,
            all_static: false,
            motion_compensation: true,
            outlier_limit: default_outlier_limit(),
        }
    }
}

/// Number of iterations for which groups are kept.
pub(crate) const REFRESH: usize = 4;
/// `tau` in units of `PATCHES sigma^2`, the eigenvalue that noise alone would have.
const STRENGTH: f32 = 4.0;
/// Distance by which a pixel may exceed the range of its eight neighbours, in units of `sigma`. An isolated outlier spans
/// a separate direction of its group, so the filter never removes it. Behind highly correlated masks, where the projection
/// does not fix a single frame, such outliers grow.
const OUTLIER_LIMIT: f32 = 4.0;
/// Number of batches that several cores filter before their patches are accumulated: enough that the cores rarely wait for
/// each other. The patches then take 6 MB.
const BATCHES_AT_ONCE: usize = 64;
/// Step between the patches by which the accumulation is divided among cores. It is prime, so that it meets all places of a
/// group.
const SAMPLE_STEP: usize = 61;

/// The prior with its groups and working memory, for clips of one size.
#[derive(Debug)]
pub struct Nonlocal {
    frames: usize,
    height: usize,
    width: usize,
    /// Number of calls of [`Nonlocal::denoise`].
    passes: usize,
    /// The input clip. All clips here have a margin to the right and below, so that a search reads whole vectors and blocks
    /// of rows.
    noisy: Vec<f32>,
    /// The previous result, in which patches are compared.
    guide: Vec<f32>,
    sum: Vec<f32>,
    temporal_shrinkage: TemporalShrinkage,
    /// Number of patches that cover a pixel.
    cover: Vec<f32>,
    /// Top left pixels of all patches, `PATCHES` for a group.
    groups: Vec<u32>,
    /// The patches of the batches that are filtered together.
    patches: Vec<f32>,
    /// Working memory of each core.
    filters: Vec<Filter>,
    cores: Cores,
    /// The vector instructions of this machine.
    arch: Arch,
    /// True if search windows follow the motion.
    motion_compensation: bool,
    /// See [`OUTLIER_LIMIT`].
    outlier_limit: f32,
}

impl Nonlocal {
    /// For clips of `frames` frames of `height` x `width` pixels.
    pub fn new((frames, height, width): (usize, usize, usize)) -> Self {
        let size = (frames * height + search::ROWS + SIDE) * row_length(width);
        Self {
            frames,
            height,
            width,
            passes: 0,
            noisy: vec![0.0; size],
            guide: vec![0.0; size],
            sum: vec![0.0; size],
            temporal_shrinkage: TemporalShrinkage::new((frames, height, width)),
            cover: vec![0.0; size],
            groups: Vec::new(),
            patches: Vec::new(),
            filters: Vec::new(),
            cores: Cores::default(),
            arch: Arch::new(),
            motion_compensation: true,
            outlier_limit: OUTLIER_LIMIT,
        }
    }

    /// Removes noise of level `sigma` from frames \[B,H,W\] on \[0,1\], in place, after temporal shrinkage at the level of
    /// `shrinkage` times `sigma`, if that is not 0. Frames smaller than a patch (6x6) are left unchanged.
    ///
    /// All calls of one object belong to one clip: patches are compared in the previous result, and the groups are kept for
    /// a few iterations.
    pub fn denoise(&mut self, frames: &mut Array3<f32>, sigma: f32, shrinkage: f32) {
        debug_assert_eq!(frames.dim(), (self.frames, self.height, self.width));
        if self.height < SIDE || self.width < SIDE {
            return;
        }
        let row_length = row_length(self.width);
        let planes = self.noisy.chunks_exact_mut(self.height * row_length);
        let margin = self.outlier_limit * sigma;
        self.cores.share(planes.zip(frames.outer_iter()), |(plane, frame)| {
            limit_outliers(frame, margin, plane.chunks_exact_mut(row_length));
        });
        if shrinkage > 0.0 {
            self.temporal_shrinkage.shrink(&mut self.noisy, row_length, shrinkage * sigma);
        }
        if self.passes == 0 {
            self.guide.copy_from_slice(&self.noisy);
        }
        let refresh = self.passes.is_multiple_of(REFRESH);
        self.work(if refresh { &Part::ALL } else { &Part::ALL[1..] }, sigma);
        self.passes += 1;
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

    /// Runs some parts of an iteration on the current clip, for benchmarks.
    pub fn work(&mut self, parts: &[Part], sigma: f32) {
        if parts.contains(&Part::Search) {
            self.search();
        }
        self.filter(parts, sigma);
    }

    /// Finds the groups of all reference patches, and counts how many patches cover each pixel.
    fn search(&mut self) {
        let Self { guide, groups, cover, cores, arch, .. } = self;
        let size = (self.frames, self.height, self.width);
        let row_length = row_length(size.2);
        let strides = (size.1 * row_length, row_length, 1);
        let clip = ArrayView3::from_shape(size.strides(strides), guide.as_slice())
            .expect("a clip with a margin");
        let motion =
            if self.motion_compensation { Motion::of(clip, cores) } else { Motion::none() };
        let lines = search::lines(size, self.passes / REFRESH);
        groups.resize(lines.iter().map(Line::len).sum::<usize>() * PATCHES, 0);
        let mut rest = groups.as_mut_slice();
        let parts = lines.iter().map(|line| {
            let slots = rest.split_off_mut(..line.len() * PATCHES).unwrap_or_default();
            (line, slots)
        });
        let clip = (guide.as_slice(), size);
        let mut memories: Vec<Best> = (0..cores.count()).map(|_| Best::default()).collect();
        share_with(&mut memories, parts, |best, (line, groups)| {
            arch.dispatch(Search { clip, line, motion: &motion, best, groups });
        });
        search::count_cover(groups, cover, row_length);
    }

    /// Filters the groups, and accumulates their patches in the order of the groups, whatever the number of cores.
    fn filter(&mut self, parts: &[Part], sigma: f32) {
        let Self { noisy, sum, groups, patches, filters, cores, arch, .. } = self;
        let row_length = row_length(self.width);
        let tau = STRENGTH * PATCHES as f32 * sigma * sigma;
        let count = cores.count();
        // A single core accumulates the patches of a batch while they are in cache.
        let at_once = if count > 1 { BATCHES_AT_ONCE } else { 1 };
        filters.resize_with(count, Filter::default);
        patches.resize(at_once * BATCH_VALUES, 0.0);
        sum.fill(0.0);
        for groups in groups.chunks(at_once * BATCH * PATCHES) {
            let batches =
                groups.chunks(BATCH * PATCHES).zip(patches.chunks_exact_mut(BATCH_VALUES));
            share_with(filters, batches, |filter, (groups, patches)| {
                let clip = noisy.as_slice();
                arch.dispatch(Work { clip, row_length, groups, patches, filter, parts, tau });
            });
            if parts.contains(&Part::Scatter) {
                let strips = strips(sum, row_length, groups, count);
                share_with(&mut vec![(); count], strips.into_iter(), |(), strip| {
                    arch.dispatch(Accumulate { patches, row_length, groups, strip });
                });
            }
        }
    }
}

/// Rows of a clip.
struct Strip<'a> {
    /// Index of the first value in the clip.
    first: usize,
    values: &'a mut [f32],
}

/// Divides a clip into `count` strips of whole rows that contain about as many of the patches each.
fn strips<'a>(
    mut clip: &'a mut [f32],
    row_length: usize,
    groups: &[u32],
    count: usize,
) -> Vec<Strip<'a>> {
    let mut sample: Vec<u32> = groups.iter().step_by(SAMPLE_STEP).copied().collect();
    sample.sort_unstable();
    let mut strips = Vec::with_capacity(count);
    let mut first = 0;
    for part in 1..count {
        let row = sample[part * sample.len() / count] as usize / row_length;
        let (values, rest) = clip.split_at_mut(row * row_length - first);
        strips.push(Strip { first, values });
        (first, clip) = (row * row_length, rest);
    }
    strips.push(Strip { first, values: clip });
    strips
}

/// Copies a frame \[H,W\], at least 2x2, into rows of at least its width, and clamps each pixel to the range of its eight
/// neighbours, extended by `margin` on both sides. The frame is reflected at its edges.
fn limit_outliers<'a>(
    frame: ArrayView2<'_, f32>,
    margin: f32,
    rows: impl Iterator<Item = &'a mut [f32]>,
) {
    let (height, width) = frame.dim();
    // Minimum and maximum of the pixels above and below, and of these with the pixel between them.
    let (mut pairs, mut triples) = (vec![[0.0f32; 2]; width], vec![[0.0f32; 2]; width + 2]);
    for (i, row) in rows.take(height).enumerate() {
        let above = frame.row(if i == 0 { 1 } else { i - 1 });
        let below = frame.row(if i + 1 == height { i - 1 } else { i + 1 });
        let here = frame.row(i);
        let columns = above.iter().zip(&below).zip(&here);
        let found = pairs.iter_mut().zip(&mut triples[1..]);
        for (((&a, &b), &x), (pair, triple)) in columns.zip(found) {
            *pair = [a.min(b), a.max(b)];
            *triple = [pair[0].min(x), pair[1].max(x)];
        }
        (triples[0], triples[width + 1]) = (triples[2], triples[width - 1]);
        let around = triples.windows(3).zip(&pairs);
        for ((value, &x), (sides, pair)) in row.iter_mut().zip(&here).zip(around) {
            let least = pair[0].min(sides[0][0]).min(sides[2][0]);
            let greatest = pair[1].max(sides[0][1]).max(sides[2][1]);
            *value = x.max(least - margin).min(greatest + margin);
        }
    }
}

/// The parts of an iteration, in their order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// Finds the patches of each group.
    Search,
    /// Copies the patches from the clip.
    Gather,
    /// Computes `G = Y Y^T` of the centred patches.
    Gram,
    /// Computes the Cholesky factor of `G^2 + tau^2`.
    Factor,
    /// Computes the filtered patches.
    Solve,
    /// Accumulates the patches in the clip.
    Scatter,
}

impl Part {
    /// A whole iteration.
    pub const ALL: [Self; 6] =
        [Self::Search, Self::Gather, Self::Gram, Self::Factor, Self::Solve, Self::Scatter];
}

/// The search of a line of references.
struct Search<'a> {
    clip: (&'a [f32], Size),
    line: &'a Line,
    motion: &'a Motion,
    best: &'a mut Best,
    groups: &'a mut [u32],
}

impl WithSimd for Search<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        search::search(simd, self.clip, self.line, self.motion, self.best, self.groups);
    }
}

/// The filter of a batch of groups.
struct Work<'a> {
    clip: &'a [f32],
    row_length: usize,
    groups: &'a [u32],
    patches: &'a mut [f32],
    filter: &'a mut Filter,
    parts: &'a [Part],
    tau: f32,
}

impl WithSimd for Work<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { clip, row_length, groups, patches, filter, parts, tau } = self;
        for part in parts {
            match part {
                Part::Search | Part::Scatter => {}
                Part::Gather => gather::<S>(clip, row_length, groups, patches),
                Part::Gram => low_rank::multiply(simd, patches, filter),
                Part::Factor => low_rank::factorize(simd, patches, filter, tau),
                Part::Solve => low_rank::solve(simd, patches, filter, tau),
            }
        }
    }
}

/// The accumulation of the patches of several batches in a strip.
struct Accumulate<'a> {
    patches: &'a [f32],
    row_length: usize,
    groups: &'a [u32],
    strip: Strip<'a>,
}

impl WithSimd for Accumulate<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { patches, row_length, groups, mut strip } = self;
        let batches = groups.chunks(BATCH * PATCHES).zip(patches.chunks_exact(BATCH_VALUES));
        for (batch, patches) in batches {
            scatter::<S>(patches, row_length, batch, &mut strip);
        }
    }
}

// Patch by patch, not group by group, so that writes fill whole cache lines.
#[inline(always)]
fn gather<S: Simd>(clip: &[f32], row_length: usize, batch: &[u32], patches: &mut [f32]) {
    for patch in 0..PATCHES {
        for (index, group) in batch.chunks_exact(PATCHES).enumerate() {
            let values = &mut patches[place_of::<S>(index, patch)..][..span::<S>()];
            let start = group[patch] as usize;
            for i in 0..SIDE {
                let row = &clip[start + i * row_length..][..SIDE];
                for (j, &pixel) in row.iter().enumerate() {
                    values[(i * SIDE + j) * PATCHES * S::F32_LANES] = pixel;
                }
            }
        }
    }
}

/// Adds the rows of patches that are in the strip.
#[inline(always)]
fn scatter<S: Simd>(patches: &[f32], row_length: usize, batch: &[u32], strip: &mut Strip<'_>) {
    let end = strip.first + strip.values.len();
    for patch in 0..PATCHES {
        for (index, group) in batch.chunks_exact(PATCHES).enumerate() {
            let start = group[patch] as usize;
            if start >= end || start + SIDE * row_length <= strip.first {
                continue;
            }
            let values = &patches[place_of::<S>(index, patch)..][..span::<S>()];
            for i in 0..SIDE {
                // Below 0 it is a large number, which is outside as well.
                let at = (start + i * row_length).wrapping_sub(strip.first);
                let Some(row) = strip.values.get_mut(at..at.wrapping_add(SIDE)) else { continue };
                for (j, pixel) in row.iter_mut().enumerate() {
                    *pixel += values[(i * SIDE + j) * PATCHES * S::F32_LANES];
                }
            }
        }
    }
}

/// Distance from the first number of a patch to the end of its last one.
#[inline(always)]
fn span<S: Simd>() -> usize {
    (PIXELS - 1) * PATCHES * S::F32_LANES + 1
}

#[cfg(test)]
mod tests {
    use super::layout::{BATCH, PATCHES, PIXELS, REACH, SIDE, positions, shift};
    use super::search::window;
    use super::{
        BATCHES_AT_ONCE, Nonlocal, OUTLIER_LIMIT, REFRESH, STRENGTH, limit_outliers,
        temporal_shrinkage,
    };
    use ndarray::{Array2, Array3};
    use pulp::Arch;
    use rand::{RngExt, SeedableRng};

    pub(super) fn noisy(size: (usize, usize, usize), sigma: f32) -> (Array3<f32>, Array3<f32>) {
        let mut rng = rand::rngs::ChaCha8Rng::seed_from_u64(5);
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
    fn an_isolated_outlier_is_removed() {
        let ramp = Array2::from_shape_fn((8, 9), |(i, j)| 0.01 * (3 * i + j) as f32);
        for (at, greatest) in [((4, 4), 0.2), ((0, 0), 0.04), ((7, 8), 0.28), ((3, 8), 0.2)] {
            let mut frame = ramp.clone();
            frame[at] = 5.0;
            let mut rows = vec![7.0; 8 * 16];
            limit_outliers(frame.view(), 0.1, rows.chunks_exact_mut(16));
            let limited = Array2::from_shape_fn((8, 9), |(i, j)| rows[16 * i + j]);
            assert!((limited[at] - greatest - 0.1).abs() < 1e-6, "{at:?}: {}", limited[at]);
            frame[at] = limited[at];
            assert_eq!(limited, frame);
            assert!(rows[9..16].iter().all(|&beyond| beyond == 7.0));
        }
        let size = (3, 24, 24);
        let (clean, mut video) = noisy(size, 0.02);
        video[[1, 12, 12]] = 4.0;
        Nonlocal::new(size).denoise(&mut video, 0.02, 0.0);
        assert!((video[[1, 12, 12]] - clean[[1, 12, 12]]).abs() < 0.15, "{}", video[[1, 12, 12]]);
    }

    #[test]
    fn noise_falls_for_any_size_and_any_number_of_frames() {
        for size in [(1, 24, 24), (3, 33, 46), (9, 17, 50), (2, 6, 7)] {
            let (clean, mut video) = noisy(size, 0.1);
            let before = mean_square(&video, &clean);
            let mut prior = Nonlocal::new(size);
            prior.denoise(&mut video, 0.1, 0.0);
            let after = mean_square(&video, &clean);
            // A handful of patches removes little noise.
            let least = if size.1 < 10 { 1.0 } else { 0.25 };
            assert!(after < least * before, "{size:?}: {before} to {after}");
        }
    }

    /// The prior in 64 bits: every distance, every group and every system of equations one after the other.
    pub(super) struct Reference {
        guide: Array3<f32>,
        /// Frames, rows and columns of the patches of each group.
        groups: Vec<Vec<(usize, usize, usize)>>,
        passes: usize,
    }

    /// Pixels no further than `margin` outside the range of those around them, in a clip reflected at its edges.
    fn limited(clip: &Array3<f32>, margin: f32) -> Array3<f32> {
        let (_, height, width) = clip.dim();
        let reflected = |at: usize, step: usize, length: usize| match at + step {
            0 => 1,
            beside if beside > length => length - 2,
            beside => beside - 1,
        };
        let steps = (0..9).map(|step| (step / 3, step % 3)).filter(|&step| step != (1, 1));
        Array3::from_shape_fn(clip.dim(), |(k, i, j)| {
            let beside = steps.clone().map(|(down, right)| {
                clip[[k, reflected(i, down, height), reflected(j, right, width)]]
            });
            let least = beside.clone().fold(f32::INFINITY, f32::min);
            let greatest = beside.fold(f32::NEG_INFINITY, f32::max);
            clip[[k, i, j]].clamp(least - margin, greatest + margin)
        })
    }

    impl Reference {
        pub(super) fn new(clip: &Array3<f32>) -> Self {
            Self { guide: clip.clone(), groups: Vec::new(), passes: 0 }
        }

        pub(super) fn denoise(&mut self, clip: &mut Array3<f32>, sigma: f32, shrinkage: f32) {
            *clip = limited(clip, OUTLIER_LIMIT * sigma);
            if shrinkage > 0.0 {
                *clip = temporal_shrinkage::tests::shrunk(clip, f64::from(shrinkage * sigma));
            }
            if self.passes == 0 {
                self.guide = clip.clone();
            }
            if self.passes.is_multiple_of(REFRESH) {
                self.search(self.passes / REFRESH);
            }
            self.passes += 1;
            let tau = f64::from(STRENGTH * PATCHES as f32 * sigma * sigma);
            let mut sum = Array3::<f64>::zeros(clip.dim());
            let mut cover = sum.clone();
            for group in &self.groups {
                let patch = |&(k, i, j): &(usize, usize, usize)| {
                    (0..PIXELS).map(move |p| [k, i + p / SIDE, j + p % SIDE])
                };
                let columns: Vec<Vec<f64>> = group
                    .iter()
                    .map(|place| patch(place).map(|voxel| f64::from(clip[voxel])).collect())
                    .collect();
                for (place, column) in group.iter().zip(filtered(columns, tau)) {
                    for (voxel, value) in patch(place).zip(column) {
                        sum[voxel] += value;
                        cover[voxel] += 1.0;
                    }
                }
            }
            *clip = (sum / cover).mapv(|value| value as f32);
            self.guide.assign(clip);
        }

        fn search(&mut self, searches: usize) {
            let (frames, height, width) = self.guide.dim();
            self.groups.clear();
            let places = |k| {
                let (down, right) = shift(k, searches);
                let columns = move |i| positions(width, right).into_iter().map(move |j| (k, i, j));
                positions(height, down).into_iter().flat_map(columns)
            };
            for (k, i, j) in (0..frames).flat_map(places) {
                let distance = |(other, row, column): (usize, usize, usize)| -> f64 {
                    let pixels = (0..PIXELS).map(|p| (p / SIDE, p % SIDE));
                    let differences = pixels.map(|(di, dj)| {
                        self.guide[[other, row + di, column + dj]] - self.guide[[k, i + di, j + dj]]
                    });
                    differences.map(|d| f64::from(d).powi(2)).sum()
                };
                let near = k.saturating_sub(REACH)..frames.min(k + REACH + 1);
                let mut candidates: Vec<_> = near
                    .flat_map(|other| window(i, height).map(move |row| (other, row)))
                    .flat_map(|(other, row)| {
                        window(j, width).map(move |column| (other, row, column))
                    })
                    .map(|place| (place != (k, i, j), distance(place), place))
                    .collect();
                candidates.sort_by(|a, b| a.partial_cmp(b).unwrap());
                candidates.truncate(PATCHES);
                self.groups.push(candidates.iter().map(|c| c.2).cycle().take(PATCHES).collect());
            }
        }
    }

    /// `Y - tau^2 (G^2 + tau^2)^-1 (Y - mean)` of a group of columns, by Gaussian elimination.
    #[allow(clippy::needless_range_loop)] // the indices of the algebra
    fn filtered(columns: Vec<Vec<f64>>, tau: f64) -> Vec<Vec<f64>> {
        let count = columns.len() as f64;
        let mean = |i: usize| columns.iter().map(|column| column[i]).sum::<f64>() / count;
        let means: Vec<f64> = (0..PIXELS).map(mean).collect();
        let centred: Vec<Vec<f64>> = columns
            .iter()
            .map(|column| column.iter().zip(&means).map(|(value, mean)| value - mean).collect())
            .collect();
        let gram = |i: usize, j: usize| centred.iter().map(|y| y[i] * y[j]).sum::<f64>();
        let gram: Vec<Vec<f64>> =
            (0..PIXELS).map(|i| (0..PIXELS).map(|j| gram(i, j)).collect()).collect();
        let trace: f64 = (0..PIXELS).map(|i| gram[i][i]).sum();
        let square = (tau * tau).max(4e-6 * trace * trace);
        // [G^2 + tau^2, Y - mean], a row for each pixel.
        let mut rows: Vec<Vec<f64>> = (0..PIXELS)
            .map(|i| {
                let products =
                    |j: usize| gram[i].iter().zip(&gram[j]).map(|(a, b)| a * b).sum::<f64>();
                let system = (0..PIXELS).map(|j| products(j) + if i == j { square } else { 0.0 });
                system.chain(centred.iter().map(|column| column[i])).collect()
            })
            .collect();
        for pivot in 0..PIXELS {
            let scale = 1.0 / rows[pivot][pivot];
            rows[pivot].iter_mut().for_each(|value| *value *= scale);
            let line = rows[pivot].clone();
            for (i, row) in rows.iter_mut().enumerate().filter(|(i, _)| *i != pivot) {
                let factor = row[pivot];
                debug_assert!(i < PIXELS);
                row.iter_mut().zip(&line).for_each(|(value, line)| *value -= factor * line);
            }
        }
        let solved = |patch: usize, i: usize| rows[i][PIXELS + patch];
        let one = |(patch, column): (usize, &Vec<f64>)| {
            column.iter().enumerate().map(|(i, value)| value - square * solved(patch, i)).collect()
        };
        columns.iter().enumerate().map(one).collect()
    }

    /// Values whose distances have no rounding: the search must find the same patches.
    pub(super) fn coarse(size: (usize, usize, usize)) -> Array3<f32> {
        noisy(size, 0.1).1.mapv(|x| (x * 256.0).round() / 256.0)
    }

    #[test]
    fn passes_are_those_of_the_reference() {
        // Odd sizes, windows that are cut, fewer candidates than a group has patches, more than a batch of groups.
        for size in [(2, 23, 26), (5, 12, 17), (1, 6, 9)] {
            let mut expected = coarse(size);
            let mut found = expected.clone();
            let mut prior = Nonlocal::new(size);
            let mut reference = Reference::new(&found);
            for (pass, shrinkage) in [0.0, 1.5].into_iter().enumerate() {
                prior.denoise(&mut found, 0.08, shrinkage);
                reference.denoise(&mut expected, 0.08, shrinkage);
                let worst = (&found - &expected).mapv(f32::abs).fold(0.0, |a: f32, &b| a.max(b));
                assert!(worst < 2e-5, "{size:?} pass {pass}: {worst}");
            }
        }
    }

    /// More batches of groups than are filtered at once.
    #[test]
    fn the_number_of_cores_does_not_matter() {
        let size = (5, 90, 85);
        let passes = |counts: [usize; 2]| {
            let (_, mut clip) = noisy(size, 0.1);
            let mut prior = Nonlocal::new(size);
            for pass in 0..REFRESH + 2 {
                prior.cores.set(counts[pass % 2]);
                prior.denoise(&mut clip, 0.05, 0.4);
            }
            assert!(prior.groups.len() > BATCHES_AT_ONCE * BATCH * PATCHES);
            clip
        };
        let alone = passes([1, 1]);
        for counts in [[2, 2], [3, 8], [1, 2]] {
            assert_eq!(passes(counts), alone, "{counts:?} cores");
        }
    }

    /// All vector instructions with fused multiplication give the same bits.
    #[test]
    fn vector_instructions_do_not_matter() {
        let size = (4, 27, 38);
        let passes = |arch: Arch| {
            let mut clip = noisy(size, 0.1).1;
            let mut prior = Nonlocal { arch, ..Nonlocal::new(size) };
            (0..REFRESH + 2).for_each(|_| prior.denoise(&mut clip, 0.05, 0.4));
            clip
        };
        let own = passes(Arch::new());
        let scalar = passes(Arch::Scalar);
        let worst = (&own - &scalar).mapv(f32::abs).fold(0.0, |a: f32, &b| a.max(b));
        assert!(worst < 1e-4, "{worst}");
        #[cfg(target_arch = "x86_64")]
        if let Some(avx2) = pulp::x86::V3::try_new() {
            assert_eq!(passes(Arch::V3(avx2)), own);
        }
    }

    /// Texture that moves out of the search window within two frames, and does not repeat.
    #[test]
    fn patches_are_found_along_their_motion() {
        let size = (6, 72, 96);
        let mut rng = rand::rngs::ChaCha8Rng::seed_from_u64(6);
        let fine = Array2::from_shape_fn((120, 120), |_| rng.random::<f32>());
        let mut video = Array3::from_shape_fn(size, |(k, i, j)| {
            let (i, j) = (i + 40 - 6 * k, j + 3 * k);
            0.3 * fine[[i, j]] + 0.2 * ((i as f32 / 9.0).sin() + (j as f32 / 11.0).cos())
        });
        let mut prior = Nonlocal::new(size);
        prior.denoise(&mut video, 0.01, 0.0);
        let row_length = super::row_length(size.2);
        let place = |k: usize, i: usize, j: usize| ((k * size.1 + i) * row_length + j) as u32;
        let groups: Vec<&[u32]> = prior.groups.chunks_exact(PATCHES).collect();
        let (down, right) = shift(1, 0);
        let (rows, columns) = (positions(size.1, down), positions(size.2, right));
        let first = positions(size.1, shift(0, 0).0).len() * positions(size.2, shift(0, 0).1).len();
        let mut missed = 0;
        let mut inner = 0;
        for (row, &i) in rows.iter().enumerate().filter(|(_, i)| (4..44).contains(*i)) {
            for (column, &j) in columns.iter().enumerate().filter(|(_, j)| (12..84).contains(*j)) {
                let group = groups[first + row * columns.len() + column];
                assert!(group.contains(&place(1, i, j)));
                inner += 1;
                missed += usize::from(!group.contains(&place(3, i + 12, j - 6)));
            }
        }
        assert!(inner > 80 && missed == 0, "{missed} of {inner}");
    }

    #[test]
    fn repeated_passes_keep_a_clean_clip_nearly_as_it_is() {
        let size = (4, 32, 40);
        let (clean, _) = noisy(size, 0.0);
        let mut video = clean.clone();
        let mut prior = Nonlocal::new(size);
        for _ in 0..6 {
            prior.denoise(&mut video, 0.01, 0.4);
        }
        assert!(mean_square(&video, &clean) < 1e-4, "{}", mean_square(&video, &clean));
    }

    #[test]
    fn frames_smaller_than_a_patch_and_frames_without_contrast_stay() {
        for size in [(2, 5, 30), (3, 30, 30)] {
            let mut video = Array3::from_elem(size, 0.25f32);
            Nonlocal::new(size).denoise(&mut video, 0.05, 0.4);
            assert!(video.iter().all(|&x| (x - 0.25).abs() < 1e-5), "{size:?}");
        }
    }

    #[test]
    fn reference_patches_reach_both_ends() {
        assert_eq!(positions(6, 3), [0]);
        assert_eq!(positions(17, 0), [0, 5, 10, 11]);
        assert_eq!(positions(17, 3), [0, 3, 8, 11]);
    }
}
