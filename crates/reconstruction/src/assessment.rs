//! Features of reconstructed frames from which the quality model ([`super::quality`]) predicts their error.
//!
//! A lab has no true frames, but several features correlate with the error. Features of the frames are their texture,
//! their temporal changes, their distance from the frames after total variation, and activations of the denoiser's
//! first layers. The contrast of the masks and estimates from hold-out pixels ([`super::signs`]) complete them.

use std::ops::Range;

use ndarray::{Array1, Array2, Array3, Array4, ArrayView1, ArrayView2, ArrayView3, Axis, Zip};
use serde::{Deserialize, Serialize};

use super::error::Result;
use super::hold_out::Prediction;
use super::motion::Steps;
use super::operator::SensingOperator;
use super::order::Order;
pub use super::priors::BLOCK;
use super::priors::Encoder;
use super::signs::Signs;

/// Features of a block of a frame that follow from the clip alone. Each is the decimal logarithm of an energy or a ratio.
/// Temporal changes that no motion explains indicate an error best.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ClipFeatures {
    /// Gradient of the frame.
    pub gradient: f32,
    /// Second differences of the frame.
    pub curvature: f32,
    /// Change from frame to frame.
    pub change: f32,
    /// Deviation from the snapshot's mean over time.
    pub variance: f32,
    /// Gradient of the snapshot's mean over time.
    pub mean_gradient: f32,
    /// Squared speed of the motion that explains the change best.
    pub motion: f32,
    /// Share of the change that this motion leaves unexplained.
    pub unexplained_change: f32,
    /// Gradient relative to all frames of the snapshot.
    pub relative_gradient: f32,
    /// Change relative to all frames of the snapshot.
    pub relative_change: f32,
}

/// Features of a block of a frame, each the decimal logarithm of an energy or a ratio.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct BlockFeatures {
    /// Features of the result's clip.
    pub clip: ClipFeatures,
    /// Distance from the frames after total variation, if other priors followed.
    pub distance: f32,
    /// Energy of the frame.
    pub brightness: f32,
    /// Part of the Gram diagonal that changes from mask to mask, relative to the masks' energy.
    pub mask_contrast: f32,
    /// Gradient of the masks, relative to their energy.
    pub mask_gradient: f32,
    /// Number of frames in a snapshot.
    pub frames: f32,
    /// Gradient of the whole frame.
    pub whole_gradient: f32,
    /// Change of the whole frame.
    pub whole_change: f32,
    /// Distance of the whole frame.
    pub whole_distance: f32,
    /// Features of the clip after total variation; 0 unless other priors followed.
    pub early: ClipFeatures,
}

impl ClipFeatures {
    fn values(&self) -> [f32; 9] {
        [
            self.gradient,
            self.curvature,
            self.change,
            self.variance,
            self.mean_gradient,
            self.motion,
            self.unexplained_change,
            self.relative_gradient,
            self.relative_change,
        ]
    }
}

impl BlockFeatures {
    /// The features as inputs of the networks, in the order of the fields.
    pub fn values(&self) -> Vec<f32> {
        let own = [
            self.distance,
            self.brightness,
            self.mask_contrast,
            self.mask_gradient,
            self.frames,
            self.whole_gradient,
            self.whole_change,
            self.whole_distance,
        ];
        [&self.clip.values()[..], &own, &self.early.values()].concat()
    }
}

/// Features of the frames of a run, or of a piece of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Features {
    /// Position of the first frame in the run.
    pub first_frame: usize,
    /// Features of each block \[S B, rows, columns\].
    pub blocks: Array3<BlockFeatures>,
    /// The encoder's features \[[`CHANNELS`](super::priors::CHANNELS), S B, rows, columns\], if a stage runs a network.
    pub encoded: Option<Array4<f32>>,
    /// The first run of a stage that was run twice.
    pub first_run: Option<Box<FirstRun>>,
    /// True if predictions are uncertain behind the masks; they are blurred, leak, or have a constant sum.
    pub unfamiliar: bool,
}

/// The first run of a stage that was run twice.
#[derive(Debug, Clone, PartialEq)]
pub struct FirstRun {
    /// Features of its frames.
    pub features: Features,
    /// Decimal logarithm of the mean squared distance between the frames of both runs \[S B, rows, columns\].
    pub distance: Array3<f32>,
}

impl Features {
    /// Features of the frames \[S B,H,W\]. `early` are the frames after total variation, if other priors followed. All are on
    /// the scale on which the scene is on \[0,1\].
    ///
    /// # Errors
    /// The encoder fails.
    pub fn of(
        op: &SensingOperator,
        early: Option<ArrayView3<'_, f32>>,
        frames: ArrayView3<'_, f32>,
        encoder: Option<&mut dyn Encoder>,
    ) -> Result<Self> {
        let encoded = encoder.map(|encoder| encoder.encode(frames)).transpose()?;
        let blocks = block_features(op, early, frames);
        let unfamiliar = unfamiliar_masks(&blocks) || have_constant_sum(op.masks());
        Ok(Self { first_frame: 0, blocks, encoded, first_run: None, unfamiliar })
    }

    /// Adds the features of the weakly shrunk first run. `frames` are those of the result, `weak` those of that run.
    #[must_use]
    pub fn with_first_run(
        self,
        features: Self,
        frames: ArrayView3<'_, f32>,
        weak: ArrayView3<'_, f32>,
    ) -> Self {
        let mut distance = Array3::zeros(self.blocks.raw_dim());
        let pairs = frames.outer_iter().zip(weak.outer_iter());
        for (mut distance, (frame, weak)) in distance.outer_iter_mut().zip(pairs) {
            distance.assign(&log_distance(frame, weak));
        }
        Self { first_run: Some(Box::new(FirstRun { features, distance })), ..self }
    }
}

/// Energies below this are rounding errors.
const FLOOR: f32 = 1e-7;

/// Rows and columns of blocks of a picture of `height` x `width` pixels. Blocks at the far edges may be smaller.
pub fn blocks(height: usize, width: usize) -> (usize, usize) {
    (height.div_ceil(BLOCK), width.div_ceil(BLOCK))
}

/// The information of a measurement on a block of a snapshot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Coverage {
    /// Enough of its pixels were measured.
    Measured,
    /// All measured pixels of the whole snapshot are 0.
    Dark,
    /// Hardly any of its pixels was measured, so that its frames are a guess.
    Unmeasured,
    /// In hardly any of its pixels a mask is open, so that its frames are black.
    Closed,
}

/// Smallest share of the pixels of a block that must be measured.
const MIN_MEASURED: f32 = 1.0 / 16.0;

/// Pixels that were not measured are closed if all their masks are below this value. The intake leaves such pixels out.
const OPEN: f32 = 0.05;

/// The coverage of each block \[S, rows, columns\] by the snapshots `y` \[S,H,W\] behind masks whose largest value at each
/// pixel is `largest` \[H,W\]. NaN of `y` were not measured, also where all masks are 0: they may be unknown there.
pub fn coverage(y: ArrayView3<'_, f32>, largest: ArrayView2<'_, f32>) -> Array3<Coverage> {
    let (snapshots, height, width) = y.dim();
    let (rows, columns) = blocks(height, width);
    let mut all = Array3::from_elem((snapshots, rows, columns), Coverage::Measured);
    let share = |is: &dyn Fn(usize, usize) -> bool| {
        over_blocks((height, width), |i, j| f32::from(u8::from(is(i, j))))
    };
    for (y, mut all) in y.outer_iter().zip(all.outer_iter_mut()) {
        let is_dark = y.iter().all(|value| value.is_nan() || *value == 0.0);
        let measured = share(&|i, j| largest[[i, j]] > 0.0 && !y[[i, j]].is_nan());
        let closed = share(&|i, j| match y[[i, j]].is_nan() {
            true => (f32::MIN_POSITIVE..OPEN).contains(&largest[[i, j]]),
            false => largest[[i, j]] == 0.0,
        });
        Zip::from(&mut all).and(&measured).and(&closed).for_each(|block, measured, closed| {
            *block = match () {
                () if *measured < MIN_MEASURED && *closed > 0.5 => Coverage::Closed,
                () if *measured < MIN_MEASURED => Coverage::Unmeasured,
                () if is_dark => Coverage::Dark,
                () => Coverage::Measured,
            }
        });
    }
    all
}

/// Features of each block \[S B, rows, columns\]; see [`Features::of`].
pub fn block_features(
    op: &SensingOperator,
    early: Option<ArrayView3<'_, f32>>,
    frames: ArrayView3<'_, f32>,
) -> Array3<BlockFeatures> {
    let ratio = op.masks().len_of(Axis(0));
    let clip = clip_features(frames, ratio);
    let early_clip = early.map(|early| clip_features(early, ratio));
    let (contrast, mask_gradient) = mask_features(op);
    let mut all = Array3::default(clip.raw_dim());
    for (k, mut blocks) in all.outer_iter_mut().enumerate() {
        let (frame, clip) = (frames.index_axis(Axis(0), k), clip.index_axis(Axis(0), k));
        let early = early.map_or(frame, |early| early.index_axis_move(Axis(0), k));
        let distance = log_distance(frame, early);
        let brightness = over_blocks(frame.dim(), |i, j| frame[[i, j]].powi(2)).mapv(logarithm);
        let whole = |logarithms: Array2<f32>| {
            logarithm(logarithms.mapv(|energy| 10f32.powf(energy)).mean().unwrap_or(0.0))
        };
        let whole_gradient = whole(clip.map(|features| features.gradient));
        let whole_change = whole(clip.map(|features| features.change));
        let whole_distance = whole(distance.clone());
        for (at, block) in blocks.indexed_iter_mut() {
            let (row, column) = at;
            *block = BlockFeatures {
                clip: clip[at],
                distance: distance[at],
                brightness: brightness[at],
                mask_contrast: contrast[at],
                mask_gradient: mask_gradient[at],
                frames: (ratio as f32).log10(),
                whole_gradient,
                whole_change,
                whole_distance,
                early: early_clip.as_ref().map(|early| early[[k, row, column]]).unwrap_or_default(),
            };
        }
    }
    all
}

/// Decimal logarithm of the mean squared distance in each block.
fn log_distance(one: ArrayView2<'_, f32>, other: ArrayView2<'_, f32>) -> Array2<f32> {
    over_blocks(one.dim(), |i, j| (one[[i, j]] - other[[i, j]]).powi(2)).mapv(logarithm)
}

/// Features of the blocks \[S B, rows, columns\] of a clip with `ratio` frames in a snapshot.
fn clip_features(clip: ArrayView3<'_, f32>, ratio: usize) -> Array3<ClipFeatures> {
    let (count, height, width) = clip.dim();
    let (rows, columns) = blocks(height, width);
    let mut all = Array3::default((count, rows, columns));
    for first in (0..count).step_by(ratio) {
        let snapshot = first..count.min(first + ratio);
        let frames = snapshot.len() as f32;
        let mut mean = Array2::zeros((height, width));
        for k in snapshot.clone() {
            mean.scaled_add(1.0 / frames, &clip.index_axis(Axis(0), k));
        }
        let energies: Vec<Array2<Energies>> =
            snapshot.clone().map(|k| Energies::in_blocks(clip, k, mean.view())).collect();
        let mean_gradients = over_blocks((height, width), |i, j| gradient(mean.view(), i, j));
        for ((row, column), mean_gradient) in mean_gradients.indexed_iter() {
            let here = |k: usize| &energies[k - first][[row, column]];
            let snapshot_mean = |energy: fn(&Energies) -> f32| {
                snapshot.clone().map(|k| energy(here(k))).sum::<f32>() / frames
            };
            let (gradients, changes) =
                (snapshot_mean(Energies::gradient), snapshot_mean(|e| e.change));
            for k in snapshot.clone() {
                let energies = here(k);
                let (motion, unexplained_change) = energies.motion();
                let (gradient, change) =
                    (logarithm(energies.gradient()), logarithm(energies.change));
                all[[k, row, column]] = ClipFeatures {
                    gradient,
                    curvature: logarithm(energies.curvature),
                    change,
                    variance: logarithm(energies.variance),
                    mean_gradient: logarithm(*mean_gradient),
                    motion,
                    unexplained_change,
                    relative_gradient: gradient - logarithm(gradients),
                    relative_change: change - logarithm(changes),
                };
            }
        }
    }
    all
}

/// Energies of a block of a frame: means over its pixels.
#[derive(Debug, Clone, Copy, Default)]
struct Energies {
    steps: Steps,
    curvature: f32,
    /// Energy of the differences to the frames before and after.
    change: f32,
    /// Energy of the deviation from the mean over time.
    variance: f32,
}

/// Smallest squared motion that is distinguished from none, in pixels per frame.
const MIN_SQUARED_SPEED: f32 = 1e-4;
/// Smallest unexplained share of a temporal change that is distinguished from none.
const MIN_UNEXPLAINED: f32 = 1e-3;

impl Energies {
    /// Energies of the blocks of frame `k`; `mean` is its snapshot's mean over time.
    fn in_blocks(clip: ArrayView3<'_, f32>, k: usize, mean: ArrayView2<'_, f32>) -> Array2<Self> {
        let (count, height, width) = clip.dim();
        let frame = clip.index_axis(Axis(0), k);
        let before = k.checked_sub(1).map(|k| clip.index_axis(Axis(0), k));
        let after = (k + 1 < count).then(|| clip.index_axis(Axis(0), k + 1));
        let pixel = |sum: &mut Self, i: usize, j: usize| {
            let here = frame[[i, j]];
            let down = if i + 1 < height { frame[[i + 1, j]] - here } else { 0.0 };
            let right = if j + 1 < width { frame[[i, j + 1]] - here } else { 0.0 };
            let back = before.map(|before| here - before[[i, j]]);
            let forth = after.map(|after| after[[i, j]] - here);
            let (slope, change) = match (back, forth) {
                (Some(a), Some(b)) => ((a + b) / 2.0, (a * a + b * b) / 2.0),
                (Some(step), None) | (None, Some(step)) => (step, step * step),
                (None, None) => (0.0, 0.0),
            };
            sum.steps.add(down, right, slope);
            sum.curvature += curvature(frame, i, j);
            sum.change += change;
            sum.variance += (here - mean[[i, j]]).powi(2);
        };
        Array2::from_shape_fn(blocks(height, width), |at| {
            let mut sum = Self::default();
            let (rows, columns) = pixels_of(at, (height, width));
            for i in rows.clone() {
                columns.clone().for_each(|j| pixel(&mut sum, i, j));
            }
            sum.over((rows.len() * columns.len()) as f32)
        })
    }

    fn over(self, pixels: f32) -> Self {
        Self {
            steps: self.steps.over(pixels),
            curvature: self.curvature / pixels,
            change: self.change / pixels,
            variance: self.variance / pixels,
        }
    }

    fn gradient(&self) -> f32 {
        0.5 * (self.steps.down + self.steps.right)
    }

    /// Logarithms of the squared speed of the motion that explains the slope along time best, and of the share that it
    /// leaves unexplained.
    fn motion(&self) -> (f32, f32) {
        let ((down, right), share) = self.steps.motion();
        (
            (down * down + right * right + MIN_SQUARED_SPEED).log10(),
            (share + MIN_UNEXPLAINED).log10(),
        )
    }
}

/// Logarithms, for each block, of the part of the Gram diagonal that changes from mask to mask, and of the energy of the
/// masks' gradient. Both are relative to the masks' energy.
fn mask_features(op: &SensingOperator) -> (Array2<f32>, Array2<f32>) {
    let masks = op.masks();
    let (_, height, width) = masks.dim();
    let (gram, steady) = (op.gram(), op.static_gram());
    let energy = over_blocks((height, width), |i, j| gram[[i, j]]);
    let steady = over_blocks((height, width), |i, j| steady[[i, j]]);
    let steps = over_blocks((height, width), |i, j| {
        masks.outer_iter().map(|mask| gradient(mask, i, j)).sum::<f32>()
    });
    let share = |part: &Array2<f32>| {
        Zip::from(part).and(&energy).map_collect(|part, all| logarithm(part / all.max(FLOOR)))
    };
    (share(&(&energy - &steady)), share(&steps))
}

/// Decimal logarithm of the mask contrast of the hybrid coded aperture. Behind masks of higher contrast, sharp or blurred,
/// predictions are as good as behind independent pixels.
const APERTURE_CONTRAST: Range<f32> = -1.6..-1.0;
/// Smallest distance of the hybrid aperture's mask gradient above its contrast, in decimal logarithms.
const APERTURE_SHARPNESS: f32 = 0.28;

/// Mask gradient that a block with light does not reach, in decimal logarithms. An isolated open pixel has 0.3.
const DARK_GRADIENT: f32 = 1.0;

/// True if predictions are uncertain behind the masks of these [`block_features`]. Such masks are blurred, or leak light
/// through closed pixels, until they are at least as highly correlated as those of the hybrid coded aperture.
fn unfamiliar_masks(features: &Array3<BlockFeatures>) -> bool {
    let blocks = features.index_axis(Axis(0), 0);
    // A block that no light reaches has no contrast, and only beside light a gradient. Equal masks have no contrast.
    let is_lit = |block: &&BlockFeatures| {
        let floor = logarithm(0.0);
        block.mask_contrast > floor
            || block.mask_gradient > floor && block.mask_gradient < DARK_GRADIENT
    };
    let lit = || blocks.iter().filter(is_lit);
    let mean =
        |value: fn(&BlockFeatures) -> f32| lit().map(value).sum::<f32>() / lit().count() as f32;
    let contrast = mean(|block| block.mask_contrast);
    let sharpness = mean(|block| block.mask_gradient) - contrast;
    let known = contrast >= APERTURE_CONTRAST.end
        || contrast >= APERTURE_CONTRAST.start && sharpness >= APERTURE_SHARPNESS;
    !known
}

/// Masks whose sum has this share of the gradients of independent masks have a nearly constant sum.
const CONSTANT_SUM: f32 = 0.3;

/// True if the sum of the masks \[B,H,W\] hardly changes from pixel to pixel, as that of complementary patterns. The quality
/// model knows no such masks: it expects several dB too much.
fn have_constant_sum(masks: ArrayView3<'_, f32>) -> bool {
    let steps = |image: ArrayView2<'_, f32>| {
        let squares = |row: ArrayView1<'_, f32>| {
            row.windows(2).into_iter().map(|pair| (pair[1] - pair[0]).powi(2)).sum::<f32>()
        };
        image.outer_iter().map(squares).sum::<f32>()
    };
    let independent: f32 = masks.outer_iter().map(steps).sum();
    let sum = masks.sum_axis(Axis(0));
    masks.len_of(Axis(0)) > 1 && steps(sum.view()) < CONSTANT_SUM * independent
}

fn logarithm(energy: f32) -> f32 {
    energy.max(FLOOR).log10()
}

/// Half of the squared differences to the next pixels along both axes.
fn gradient(frame: ArrayView2<'_, f32>, i: usize, j: usize) -> f32 {
    let (height, width) = frame.dim();
    let here = frame[[i, j]];
    let down = if i + 1 < height { frame[[i + 1, j]] - here } else { 0.0 };
    let right = if j + 1 < width { frame[[i, j + 1]] - here } else { 0.0 };
    0.5 * (down * down + right * right)
}

/// Half of the squared second differences along both axes.
fn curvature(frame: ArrayView2<'_, f32>, i: usize, j: usize) -> f32 {
    let (height, width) = frame.dim();
    let here = 2.0 * frame[[i, j]];
    let inside = |at: usize, length: usize| at > 0 && at + 1 < length;
    let down = if inside(i, height) { frame[[i - 1, j]] - here + frame[[i + 1, j]] } else { 0.0 };
    let right = if inside(j, width) { frame[[i, j - 1]] - here + frame[[i, j + 1]] } else { 0.0 };
    0.5 * (down * down + right * right)
}

/// Rows and columns of the pixels of a block of a picture of `height` x `width` pixels.
fn pixels_of(
    (row, column): (usize, usize),
    (height, width): (usize, usize),
) -> (Range<usize>, Range<usize>) {
    let of = |at: usize, length: usize| at * BLOCK..length.min((at + 1) * BLOCK);
    (of(row, height), of(column, width))
}

/// Means of a value over the pixels of each block \[rows, columns\].
fn over_blocks(
    (height, width): (usize, usize),
    value: impl Fn(usize, usize) -> f32,
) -> Array2<f32> {
    Array2::from_shape_fn(blocks(height, width), |at| {
        let (down, across) = pixels_of(at, (height, width));
        let pixels = down.len() * across.len();
        let row = |i: usize| across.clone().map(|j| value(i, j)).sum::<f32>();
        down.map(row).sum::<f32>() / pixels as f32
    })
}

/// Hold-out evidence, from a crop of a measurement, of the error of the whole.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Evidence {
    /// Error estimates from the hold-out pixels.
    pub signs: Signs,
    /// Values of [`BlockFeatures`], means over the blocks of the crop.
    pub features: Vec<f32>,
    /// Prediction of the hold-out pixels by the frames, and without masks.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub prediction: Option<Prediction>,
    /// The order of the frames after the first stage, if its prior has no link along time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub order: Option<Order>,
    /// Evidence of the first run of a stage that is run twice.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub first: Option<Box<Evidence>>,
}

impl Evidence {
    /// Evidence from signs and the features of the same crop.
    pub(super) fn new(signs: Signs, blocks: &Array3<BlockFeatures>) -> Self {
        let mut features = Array1::zeros(BlockFeatures::default().values().len());
        blocks.iter().for_each(|block| features += &Array1::from(block.values()));
        let features = (features / blocks.len() as f32).to_vec();
        Self { signs, features, prediction: None, order: None, first: None }
    }
}

#[cfg(test)]
mod tests {
    use super::{BlockFeatures, Features, block_features};
    use crate::operator::SensingOperator;
    use ndarray::{Array3, s};
    use optics::{iid_masks, random_squares, soften};

    /// A ramp of 0.01 a column that brightens by 0.02 a frame.
    fn ramp() -> Array3<f32> {
        Array3::from_shape_fn((4, 40, 36), |(k, _, j)| 0.1 + 0.02 * k as f32 + 0.01 * j as f32)
    }

    #[test]
    fn features_are_means_over_blocks() {
        let masks = Array3::from_shape_fn((4, 40, 36), |(k, _, _)| if k == 0 { 1.0 } else { 0.0 });
        let op = SensingOperator::new(masks).unwrap();
        let early = ramp() - 0.1;
        let features = block_features(&op, Some(early.view()), ramp().view());
        assert_eq!(features.dim(), (4, 3, 3));
        let assert_energy = |logarithm: f32, energy: f32| {
            assert!((logarithm - energy.log10()).abs() < 1e-3, "{logarithm} for {energy}");
        };
        // Half of a squared step; the last column of the picture has no next one.
        assert_energy(features[[1, 0, 0]].clip.gradient, 0.5 * 1e-4);
        assert_energy(features[[1, 2, 2]].clip.gradient, 0.5 * 1e-4 * 0.75);
        assert_energy(features[[0, 1, 1]].clip.change, 4e-4);
        assert_energy(features[[2, 1, 1]].clip.change, 4e-4);
        // The frames deviate from their mean by 0.02 times -1.5, -0.5, 0.5 and 1.5, and all have its gradient.
        assert_energy(features[[0, 0, 0]].clip.variance, 9e-4);
        assert_energy(features[[1, 0, 0]].clip.mean_gradient, 0.5 * 1e-4);
        // A ramp of 0.01 per column that brightens by 0.02 per frame moves by two columns per frame. The last column has no
        // gradient.
        let motion = features[[2, 0, 0]].clip.motion;
        assert!((motion - 4f32.log10()).abs() < 0.02, "{motion}");
        let unexplained = |column| features[[2, 0, column]].clip.unexplained_change;
        assert!(unexplained(0) < -1.8 && unexplained(2) > -1.0, "{features:?}");
        assert_energy(features[[2, 1, 0]].clip.relative_gradient, 1.0);
        assert_energy(features[[2, 1, 0]].clip.relative_change, 1.0);
        assert_energy(features[[3, 2, 0]].distance, 1e-2);
        assert_energy(features[[3, 2, 0]].whole_distance, 1e-2);
        assert_energy(features[[1, 0, 0]].whole_change, 4e-4);
        // One mask of four is open, so the share 1 - 4 (1/4)^2 of the Gram diagonal changes from mask to mask.
        assert_energy(features[[0, 0, 0]].mask_contrast, 0.75);
        assert_energy(features[[0, 0, 0]].frames, 4.0);
        assert!(features.iter().all(|block| block.mask_gradient == -7.0));
        // The early frames change as much as those of the result.
        for BlockFeatures { clip, early, .. } in &features {
            let pairs = clip.values().into_iter().zip(early.values());
            assert!(pairs.into_iter().all(|(a, b)| (a - b).abs() < 1e-3), "{clip:?}, {early:?}");
        }
    }

    #[test]
    fn blurred_and_leaking_masks_are_unfamiliar() {
        let unfamiliar = |masks: Array3<f32>| {
            let frames = Array3::zeros(masks.raw_dim());
            let op = SensingOperator::new(masks).unwrap();
            Features::of(&op, None, frames.view(), None).unwrap().unfamiliar
        };
        let half = iid_masks(5, 64, 64, 3).unwrap();
        let paired = ndarray::concatenate![ndarray::Axis(0), half, 1.0 - &half];
        assert!(unfamiliar(paired), "complementary patterns");
        let iid = || iid_masks(10, 64, 64, 3).unwrap();
        let squares = || random_squares(10, 64, 64, 3).unwrap().0;
        let softened = |mut masks: Array3<f32>, blur, leak| {
            soften(&mut masks, blur, leak).unwrap();
            unfamiliar(masks)
        };
        assert!(!softened(iid(), 0.0, 0.0));
        assert!(!softened(iid(), 0.6, 0.0));
        assert!(!softened(iid(), 0.0, 0.3));
        assert!(softened(iid(), 1.2, 0.0));
        assert!(!softened(squares(), 0.0, 0.0));
        let row = iid_masks(1, 1, 64, 3).unwrap();
        let equal = row.broadcast((10, 64, 64)).unwrap().to_owned();
        assert!(unfamiliar(equal), "equal masks");
        // A corner without light.
        let mut dark = squares();
        dark.slice_mut(s![.., ..32, ..32]).fill(0.0);
        assert!(!softened(dark, 0.0, 0.0));
        assert!(softened(squares(), 0.7, 0.0));
        assert!(softened(squares(), 0.0, 0.4));
    }
}
