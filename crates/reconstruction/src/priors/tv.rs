//! Isotropic total variation, frame by frame (Chambolle, "An algorithm for total variation minimization and
//! applications", 2004), after total variation along time where that has a weight.

use std::ops::{Deref, DerefMut, Range};

use multiversion::multiversion;
use ndarray::{Array3, Axis};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::temporal::{self, TemporalVariation};
use super::{Family, Networks, Prior, Size, Spec};
use crate::error::Result;
use crate::projection::Projection;

/// Parameters of total variation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct TvSpec {
    /// Weight of the total variation of each frame on the [0, 1] scale; 0 for none.
    #[schemars(range(min = 0.0, max = 1e6))]
    pub tv_weight: f32,
    /// Dual (Chambolle) updates in each iteration.
    #[serde(default = "four")]
    #[schemars(range(min = 1, max = 1000))]
    pub tv_updates: usize,
    /// Weight of the total variation along time, pixel by pixel, which precedes that of each frame and takes as many
    /// dual updates; 0 for none. An adaptive schedule drops it where it is worse.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 1e6))]
    pub temporal_weight: f32,
}

fn four() -> usize {
    4
}

/// Cost of one dual update, CPU-nanoseconds per voxel.
const UPDATE_NS: f64 = 0.56;
/// Values of a strip of all frames: three arrays of strips (frames, masks, projection) stay in a second-level cache.
const STRIP_VALUES: usize = 48 * 1024;
/// Smallest height of a strip: with fewer rows, going from frame to frame costs more than the cache saves.
const MIN_STRIP_ROWS: usize = 16;

impl Spec for TvSpec {
    fn family(&self) -> Family {
        Family::TotalVariation
    }

    fn has_total_variation(&self) -> bool {
        self.tv_weight > 0.0
    }

    fn iteration_ns(&self) -> f64 {
        let temporal_ns = if self.temporal_weight > 0.0 { temporal::UPDATE_NS } else { 0.0 };
        (UPDATE_NS + temporal_ns) * self.tv_updates as f64
    }

    fn looks_along_time(&self) -> bool {
        self.temporal_weight > 0.0
    }

    fn start<'n>(&self, size: Size, _: &'n mut dyn Networks) -> Result<Box<dyn Prior + 'n>> {
        Ok(Box::new(TvPrior::new(self, size)))
    }
}

/// Total variation along time, then of each frame.
pub(super) struct TvPrior {
    spec: TvSpec,
    temporal: TemporalVariation,
    spatial: TotalVariation,
}

impl TvPrior {
    pub(super) fn new(spec: &TvSpec, size: Size) -> Self {
        let (temporal, spatial) = (TemporalVariation::new(size.0), TotalVariation::new(size));
        Self { spec: spec.clone(), temporal, spatial }
    }

    /// Denoises the rows of a strip, the strips above having come before. Reports for each frame the rows that are
    /// complete now; they lag behind the strip by the number of dual updates.
    fn denoise_strip(
        &mut self,
        frames: &mut Array3<f32>,
        strip: Range<usize>,
        mut completed: impl FnMut(&Array3<f32>, usize, Range<usize>),
    ) {
        let TvSpec { tv_weight, tv_updates, temporal_weight } = self.spec;
        if temporal_weight > 0.0 {
            self.temporal.denoise(frames, strip.clone(), temporal_weight, tv_updates);
        }
        for k in 0..frames.dim().0 {
            let rows = self.spatial.advance(k, frames, strip.clone(), tv_weight, tv_updates);
            completed(frames, k, rows);
        }
    }
}

impl Prior for TvPrior {
    fn denoise(&mut self, frames: &mut Array3<f32>, _: f32) -> Result<()> {
        self.denoise_strip(frames, 0..frames.dim().1, |_, _, _| ());
        Ok(())
    }

    /// Strip by strip, so that projection, denoising and the comparison with the last iterate find a strip in cache.
    fn step(&mut self, projection: &mut Projection<'_>, _: f32) -> Result<Array3<f32>> {
        let (count, height, width) = projection.size();
        let strip_rows = (STRIP_VALUES / (count * width)).max(MIN_STRIP_ROWS);
        let mut frames = projection.take_buffer();
        for start in (0..height).step_by(strip_rows) {
            let strip = start..height.min(start + strip_rows);
            projection.rows(strip.clone(), &mut frames);
            self.denoise_strip(&mut frames, strip, |frames, k, rows| {
                projection.compare(frames, k, rows);
            });
        }
        Ok(frames)
    }
}

/// Step of the dual ascent: 1 / (2 * dimensions).
const TAU: f32 = 0.25;
/// Added to squares, so that the inverse of their root is finite.
const MIN_SQUARE: f32 = 1e-30;
/// Values in a cache line.
const LINE: usize = 16;

/// The dual fields of a few rows of every frame, kept so that the loop allocates nothing.
///
/// All dual updates of a frame are made in one sweep: update `k` follows `k` rows behind the row
/// that arrives, so a frame is read and written once and everything else stays in cache.
#[derive(Debug)]
pub struct TotalVariation {
    height: usize,
    width: usize,
    /// For each frame the rows after each number of updates; after none, the dual fields are 0.
    frames: Vec<Vec<FieldRows>>,
    zeros: Vec<f32>,
}

/// The two latest rows of the fields after some number of updates, by the parity of the row.
#[derive(Debug)]
struct FieldRows {
    /// Dual field along rows (downwards).
    down: [Row; 2],
    /// Dual field along columns, after a 0.
    right: [Row; 2],
    /// `u = x + div p`, and its last value once more.
    primal: [Row; 2],
}

impl FieldRows {
    fn new(width: usize) -> Self {
        let rows = |length, aligned| [Row::new(length, aligned), Row::new(length, aligned)];
        Self { down: rows(width, 0), right: rows(width + 1, 1), primal: rows(width + 1, 0) }
    }
}

/// Values aligned so that one of them begins a cache line: loading a register of them is then one access.
#[derive(Debug)]
struct Row {
    values: Vec<f32>,
    start: usize,
}

impl Row {
    fn new(length: usize, aligned: usize) -> Self {
        let mut values = vec![0.0; length + LINE];
        let address = values.as_ptr().addr() / size_of::<f32>() + aligned;
        let start = (LINE - address % LINE) % LINE;
        values.truncate(start + length);
        Self { values, start }
    }
}

impl Deref for Row {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        &self.values[self.start..]
    }
}

impl DerefMut for Row {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.values[self.start..]
    }
}

impl TotalVariation {
    /// For `frames` frames of `height` x `width` pixels.
    pub fn new((frames, height, width): (usize, usize, usize)) -> Self {
        let frames = (0..frames).map(|_| vec![FieldRows::new(width)]).collect();
        Self { height, width, frames, zeros: vec![0.0; width] }
    }

    /// Minimises `||u - x||^2 / 2 + weight * TV(u)` for every frame of `frames` \[B,H,W\], in
    /// place, with a fixed number of dual updates starting from 0 (scikit-image's
    /// `denoise_tv_chambolle` with `max_num_iter = updates + 1` does as many).
    pub fn denoise(&mut self, frames: &mut Array3<f32>, weight: f32, updates: usize) {
        for k in 0..self.frames.len() {
            self.advance(k, frames, 0..self.height, weight, updates);
        }
    }

    /// Denoises frame `k` as far as the rows up to `arriving.end` allow: frames come strip by strip, in order. Returns the
    /// rows that are complete now.
    fn advance(
        &mut self,
        k: usize,
        frames: &mut Array3<f32>,
        arriving: Range<usize>,
        weight: f32,
        updates: usize,
    ) -> Range<usize> {
        debug_assert_eq!(frames.dim(), (self.frames.len(), self.height, self.width));
        if weight <= 0.0 || updates == 0 {
            return arriving;
        }
        let (width, height) = (self.width, self.height);
        let levels = &mut self.frames[k];
        levels.resize_with((updates + 1).max(levels.len()), || FieldRows::new(width));
        let end = if arriving.end == height { height + updates } else { arriving.end };
        if let Some(frame) = frames.index_axis_mut(Axis(0), k).as_slice_mut() {
            let levels = &mut levels[..=updates];
            sweep(frame, levels, &self.zeros, arriving.start..end, TAU / weight);
        }
        arriving.start.saturating_sub(updates)..end.saturating_sub(updates)
    }
}

/// Makes the dual updates that the arriving rows allow, and writes `u` over the rows that are complete: row `i` is
/// complete when row `i + updates` arrives, or would arrive.
#[multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma"))]
fn sweep(
    image: &mut [f32],
    levels: &mut [FieldRows],
    zeros: &[f32],
    arriving: Range<usize>,
    step: f32,
) {
    if multiversion::target::target_cfg_f!(target_feature = "fma") {
        sweep_rows::<true>(image, levels, zeros, arriving, step);
    } else {
        sweep_rows::<false>(image, levels, zeros, arriving, step);
    }
}

#[inline(always)]
fn sweep_rows<const FMA: bool>(
    image: &mut [f32],
    levels: &mut [FieldRows],
    zeros: &[f32],
    arriving: Range<usize>,
    step: f32,
) {
    let width = zeros.len();
    let height = image.len() / width;
    let updates = levels.len() - 1;
    for arriving in arriving {
        if arriving < height {
            let row = &image[arriving * width..(arriving + 1) * width];
            let primal = &mut levels[0].primal[arriving % 2];
            primal[..width].copy_from_slice(row);
            primal[width] = row[width - 1];
        }
        for level in 1.max((arriving + 1).saturating_sub(height))..=updates.min(arriving) {
            let i = arriving - level;
            let (before, after) = levels.split_at_mut(level);
            let (old, new) = (&before[level - 1], &mut after[0]);
            let [even, odd] = &mut new.down;
            let (down, above) = if i.is_multiple_of(2) { (even, &**odd) } else { (odd, &**even) };
            let right = &mut new.right[i % 2];
            let here = &old.primal[i % 2];
            let below = if i + 1 < height { &old.primal[(i + 1) % 2] } else { here };
            let field = (&old.down[i % 2][..], &old.right[i % 2][..]);
            dual_row::<FMA>(here, below, field, (down, right), step);
            let above = if i > 0 { above } else { zeros };
            let x = &mut image[i * width..(i + 1) * width];
            if level < updates {
                primal_row(x, above, (down, right), &mut new.primal[i % 2]);
            } else {
                add_divergence(x, above, (down, right));
            }
        }
    }
}

/// `p = (p - tau grad u) / (1 + tau/weight |grad u|)` for one row. Differences are forward, and 0 at the far edges;
/// `step` is `tau / weight`.
#[inline(always)]
fn dual_row<const FMA: bool>(
    here: &[f32],
    below: &[f32],
    (down, right): (&[f32], &[f32]),
    (new_down, new_right): (&mut [f32], &mut [f32]),
    step: f32,
) {
    // All loops run over the whole width, which fills whole registers for most sizes.
    let width = new_down.len();
    let (here, ahead, below) = (&here[..width], &here[1..=width], &below[..width]);
    let (down, right, new_right) = (&down[..width], &right[1..=width], &mut new_right[1..=width]);
    for j in 0..width {
        let (g0, g1) = (below[j] - here[j], ahead[j] - here[j]);
        let squares = add_product::<FMA>(add_product::<FMA>(MIN_SQUARE, g0, g0), g1, g1);
        let norm = root::<FMA>(squares);
        let scale = inverse::<FMA>(add_product::<FMA>(1.0, step, norm));
        new_down[j] = add_product::<FMA>(down[j], -TAU, g0) * scale;
        new_right[j] = add_product::<FMA>(right[j], -TAU, g1) * scale;
    }
}

/// A row of `u = x + div p`, given the rows of `p` and the row of its downward part above.
#[inline(always)]
fn primal_row(x: &[f32], above: &[f32], (down, right): (&[f32], &[f32]), out: &mut [f32]) {
    let width = x.len();
    let (above, down, left, right) =
        (&above[..width], &down[..width], &right[..width], &right[1..=width]);
    let row = &mut out[..width];
    for j in 0..width {
        row[j] = x[j] + (above[j] - down[j]) + (left[j] - right[j]);
    }
    out[width] = out[width - 1];
}

/// Writes that row of `u` in place of `x`.
#[inline(always)]
fn add_divergence(x: &mut [f32], above: &[f32], (down, right): (&[f32], &[f32])) {
    let width = x.len();
    let (above, down, left, right) =
        (&above[..width], &down[..width], &right[..width], &right[1..=width]);
    for j in 0..width {
        x[j] += (above[j] - down[j]) + (left[j] - right[j]);
    }
}

/// The square root of `q` > 0 to a relative error of 5e-7. The exponent gives an estimate `e` of
/// `1 / sqrt(q)` to 6 % but for a factor (Moroz et al., "Fast calculation of inverse square root with the
/// use of magic constant", 2018); `1 / sqrt(q) = e / sqrt(q e^2)`, and the latter root is a cubic's (fitted:
/// least largest relative error for `q e^2` from 0.75 to 0.844). The processors' own root and division
/// share one slow unit; this and [`inverse`] take half as long and are the same on every processor.
#[inline(always)]
fn root<const FMA: bool>(q: f32) -> f32 {
    let estimate = f32::from_bits(0x5F20_0000_u32.wrapping_sub(q.to_bits() >> 1));
    let root = q * estimate;
    let h = root * estimate;
    let p = add_product::<FMA>(2.322_586, h, -0.694_116_83);
    let p = add_product::<FMA>(-3.082_193_1, h, p);
    root * add_product::<FMA>(2.452_720_8, h, p)
}

/// `1 / d` for `d` >= 1 to a relative error of 1e-6, by the method of [`root`]: `e / (d e)` with a parabola for `d e`
/// from 0.707 to 0.7285.
#[inline(always)]
fn inverse<const FMA: bool>(d: f32) -> f32 {
    let estimate = f32::from_bits(0x7EB5_0000_u32.wrapping_sub(d.to_bits()));
    let h = d * estimate;
    let p = add_product::<FMA>(-5.824_188_6, h, 2.704_798_2);
    estimate * add_product::<FMA>(4.180_136_6, h, p)
}

/// `a + b c`, rounded once where the processor computes it in one step, which is faster.
#[inline(always)]
fn add_product<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA { b.mul_add(c, a) } else { a + b * c }
}

#[cfg(test)]
mod tests {
    use super::{TotalVariation, TvSpec};
    use crate::reference::{max_difference, variation};
    use ndarray::{Array3, Axis};
    use rand::{Rng, SeedableRng};

    #[test]
    fn fast_kernel_equals_the_reference() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        for (h, w) in [(1, 1), (1, 7), (9, 1), (2, 2), (17, 33), (40, 64)] {
            let frames = Array3::from_shape_fn((2, h, w), |_| rng.random::<f32>());
            for updates in [1, 2, 4, 20] {
                let mut fast = frames.clone();
                TotalVariation::new((2, h, w)).denoise(&mut fast, 0.1, updates);
                let tv = TvSpec { tv_weight: 0.1, tv_updates: updates, temporal_weight: 0.0 };
                let mut slow: Vec<f64> = frames.iter().map(|&value| f64::from(value)).collect();
                slow.chunks_mut(h * w).for_each(|frame| variation(frame, w, &tv));
                let worst = max_difference(&fast, &slow);
                assert!(worst < 2e-6, "{h}x{w}, {updates} updates: {worst}");
            }
        }
    }

    #[test]
    fn strips_of_any_height_give_the_same_frames() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(3);
        for (height, updates) in [(1, 4), (3, 4), (23, 4), (40, 7)] {
            let frames = Array3::from_shape_fn((2, height, 19), |_| rng.random::<f32>());
            let mut whole = frames.clone();
            TotalVariation::new(frames.dim()).denoise(&mut whole, 0.1, updates);
            for rows in [1, 2, 5, 16, 64] {
                let (mut strips, mut tv) = (frames.clone(), TotalVariation::new(frames.dim()));
                let mut done = vec![0; 2];
                for start in (0..height).step_by(rows) {
                    for (k, done) in done.iter_mut().enumerate() {
                        let strip = start..height.min(start + rows);
                        let ready = tv.advance(k, &mut strips, strip, 0.1, updates);
                        assert_eq!(ready.start, *done, "every row is reported once");
                        *done = ready.end;
                    }
                }
                assert_eq!(done, [height; 2]);
                assert_eq!(strips, whole, "{height} rows in strips of {rows}");
            }
        }
    }

    #[test]
    fn constant_images_stay_and_noise_falls() {
        let mut flat = Array3::from_elem((1, 8, 8), 0.4f32);
        TotalVariation::new((1, 8, 8)).denoise(&mut flat, 0.1, 10);
        assert!(flat.iter().all(|&x| (x - 0.4).abs() < 1e-6));

        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(2);
        let mut noisy = Array3::from_shape_fn((1, 32, 32), |_| 0.5 + 0.1 * rng.random::<f32>());
        let before = noisy.index_axis(Axis(0), 0).var(0.0);
        TotalVariation::new((1, 32, 32)).denoise(&mut noisy, 0.1, 20);
        assert!(noisy.var(0.0) < 0.3 * before);
    }
}
