//! How near frames come to the truth, told without it.
//!
//! A lab has no truth. What can be seen are the frames themselves: how much changes in them from pixel to pixel
//! and from frame to frame, how far the priors have moved them since total variation, what the denoiser's own first
//! layers see in them, how well the masks can tell frames apart, and the [`super::signs`] of pixels
//! that were held out. Block by block the expected error follows from these by a small network that was fitted to
//! simulated snapshots of many scenes; `docs/BENCHMARKS.md` states how well it does on others.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::LazyLock;

use ndarray::{
    Array1, Array2, Array3, Array4, ArrayView1, ArrayView2, ArrayView3, ArrayView4, ArrayViewMut4,
    Axis, Zip, concatenate, s,
};
use serde::{Deserialize, Serialize};

use super::error::{ReconError, Result, shape_text};
use super::motion::Steps;
use super::operator::SensingOperator;
pub use super::priors::BLOCK;
use super::priors::nonlocal::NonlocalSpec;
use super::priors::registry::PriorSpec;
use super::priors::{CHANNELS, Encoder};
use super::schedule::{Method, Schedule};
use super::signs::Signs;
use super::stage::Stage;

/// What is seen of a block of a frame, each the decimal logarithm of an energy or of a ratio: of the frames
/// of the result, and of those that total variation alone had left, where other priors followed. Nothing
/// betrays frames that are wrong as much as motion that does not explain how they change.
pub const FEATURES: [&str; 26] = [
    "gradient",
    "curvature",
    "change in time",
    "variance over time",
    "gradient of the mean over time",
    "motion",
    "change that is no motion",
    "gradient beside other frames",
    "change in time beside other frames",
    "distance from total variation",
    "brightness",
    "mask contrast",
    "mask gradient",
    "frames",
    "gradient of the whole frame",
    "change in time of the whole frame",
    "distance of the whole frame",
    "gradient after total variation",
    "curvature after total variation",
    "change in time after total variation",
    "variance over time after total variation",
    "gradient of the mean over time after total variation",
    "motion after total variation",
    "change that is no motion after total variation",
    "gradient beside other frames after total variation",
    "change in time beside other frames after total variation",
];

/// How many are seen of the frames of a clip by themselves, and the first ones of the other kinds.
const OF_CLIP: usize = 9;
const OF_RESULT: usize = 9;
const OF_WHOLE: usize = 14;
const OF_EARLY: usize = 17;

/// Below this, energies are rounding.
const FLOOR: f32 = 1e-7;

/// Rows and columns of blocks of a picture of `height` x `width` pixels; those at the far edges may be smaller.
pub fn blocks(height: usize, width: usize) -> (usize, usize) {
    (height.div_ceil(BLOCK), width.div_ceil(BLOCK))
}

/// What is seen of each block of each frame \[features, S B, rows, columns\], of the frames \[S B,H,W\] of a
/// reconstruction and those that total variation alone had left, if other priors followed; all on the scale
/// on which the scene is on \[0,1\].
pub fn features(
    op: &SensingOperator,
    early: Option<ArrayView3<'_, f32>>,
    frames: ArrayView3<'_, f32>,
) -> Array4<f32> {
    let (count, height, width) = frames.dim();
    let (rows, columns) = blocks(height, width);
    let ratio = op.masks().len_of(Axis(0));
    let mut all = Array4::zeros((FEATURES.len(), count, rows, columns));
    of_clip(frames, ratio, all.slice_mut(s![..OF_CLIP, .., .., ..]));
    if let Some(early) = early {
        of_clip(early, ratio, all.slice_mut(s![OF_EARLY..OF_EARLY + OF_CLIP, .., .., ..]));
    }
    let (contrast, roughness) = of_masks(op);
    let ratio = (ratio as f32).log10();
    for (k, frame) in frames.outer_iter().enumerate() {
        let early = early.map(|early| early.index_axis_move(Axis(0), k));
        let distance = over_blocks((height, width), |i, j| {
            early.map_or(0.0, |early| (frame[[i, j]] - early[[i, j]]).powi(2))
        });
        let brightness = over_blocks((height, width), |i, j| frame[[i, j]].powi(2));
        let of_block = [
            distance.mapv(logarithm),
            brightness.mapv(logarithm),
            contrast.clone(),
            roughness.clone(),
        ];
        for (index, value) in of_block.into_iter().enumerate() {
            all.slice_mut(s![OF_RESULT + index, k, .., ..]).assign(&value);
        }
        all.slice_mut(s![OF_RESULT + 4, k, .., ..]).fill(ratio);
        let whole = |feature: usize| {
            let of_blocks = all.slice(s![feature, k, .., ..]).mapv(|energy| 10f32.powf(energy));
            logarithm(of_blocks.mean().unwrap_or(0.0))
        };
        for (index, value) in [whole(0), whole(2), whole(OF_RESULT)].into_iter().enumerate() {
            all.slice_mut(s![OF_WHOLE + index, k, .., ..]).fill(value);
        }
    }
    all
}

/// The same, followed by what the encoder sees of the blocks of the result, if there is one
/// \[features and [`CHANNELS`], S B, rows, columns\].
/// Errors: those of the encoder.
pub fn encoded_features(
    op: &SensingOperator,
    early: Option<ArrayView3<'_, f32>>,
    frames: ArrayView3<'_, f32>,
    encoder: Option<&mut dyn Encoder>,
) -> Result<Array4<f32>> {
    let seen = features(op, early, frames);
    let Some(encoder) = encoder else { return Ok(seen) };
    let encoded = encoder.encode(frames)?;
    concatenate(Axis(0), &[seen.view(), encoded.view()]).map_err(|_| ReconError::Shape {
        what: "what the encoder gave",
        found: shape_text(encoded.shape()),
        expected: shape_text(&[&[CHANNELS], &seen.shape()[1..]].concat()),
    })
}

/// What is seen of a result, followed by what is seen of the first run of its last stage and by the decimal logarithm of
/// the mean squared distance between the frames of both \[2 times as many and 1, S B, rows, columns\].
/// Errors: sizes that disagree.
pub(super) fn with_first_run(
    result: &Array4<f32>,
    first: &Array4<f32>,
    (frames, first_frames): (ArrayView3<'_, f32>, ArrayView3<'_, f32>),
) -> Result<Array4<f32>> {
    let (_, height, width) = frames.dim();
    let (_, count, rows, columns) = result.dim();
    let mut distance = Array4::zeros((1, count, rows, columns));
    for (k, (one, other)) in frames.outer_iter().zip(first_frames.outer_iter()).enumerate() {
        let squares = over_blocks((height, width), |i, j| (one[[i, j]] - other[[i, j]]).powi(2));
        distance.slice_mut(s![0, k, .., ..]).assign(&squares.mapv(logarithm));
    }
    let all = concatenate(Axis(0), &[result.view(), first.view(), distance.view()]);
    all.map_err(|_| ReconError::Shape {
        what: "what is seen of a stage's first run",
        found: shape_text(first.shape()),
        expected: shape_text(result.shape()),
    })
}

/// What is seen of the frames of snapshots of `ratio` frames by themselves, into \[features, S B, rows, columns\].
fn of_clip(clip: ArrayView3<'_, f32>, ratio: usize, mut all: ArrayViewMut4<'_, f32>) {
    let (count, height, width) = clip.dim();
    for first in (0..count).step_by(ratio) {
        let snapshot = first..count.min(first + ratio);
        let frames = snapshot.len() as f32;
        let mut mean = Array2::zeros((height, width));
        for k in snapshot.clone() {
            mean.scaled_add(1.0 / frames, &clip.index_axis(Axis(0), k));
        }
        let energies: Vec<Array2<Energies>> =
            snapshot.clone().map(|k| Energies::of_blocks(clip, k, mean.view())).collect();
        let of_mean = over_blocks((height, width), |i, j| gradient(mean.view(), i, j));
        for ((row, column), of_mean) in of_mean.indexed_iter() {
            let here = |k: usize| &energies[k - first][[row, column]];
            let beside = |energy: fn(&Energies) -> f32| {
                snapshot.clone().map(|k| energy(here(k))).sum::<f32>() / frames
            };
            let (gradients, changes) = (beside(Energies::gradient), beside(|e| e.change));
            for k in snapshot.clone() {
                let energies = here(k);
                let (speed, rest) = energies.motion();
                let (gradient, change) =
                    (logarithm(energies.gradient()), logarithm(energies.change));
                let values = [
                    gradient,
                    logarithm(energies.curvature),
                    change,
                    logarithm(energies.variance),
                    logarithm(*of_mean),
                    speed,
                    rest,
                    gradient - logarithm(gradients),
                    change - logarithm(changes),
                ];
                all.slice_mut(s![.., k, row, column]).assign(&ArrayView1::from(&values));
            }
        }
    }
}

/// Energies of a block of a frame, in the mean over its pixels.
#[derive(Debug, Clone, Copy, Default)]
struct Energies {
    steps: Steps,
    curvature: f32,
    /// Of the steps to the frames beside.
    change: f32,
    /// Of what differs from the mean over time.
    variance: f32,
}

/// The square of the least motion that is told from rest, in pixels a frame, and the least share of the change that is
/// told from none.
const REST: f32 = 1e-4;
const LEFT: f32 = 1e-3;

impl Energies {
    /// Of the blocks of frame `k`, whose snapshot has this mean over time.
    fn of_blocks(clip: ArrayView3<'_, f32>, k: usize, mean: ArrayView2<'_, f32>) -> Array2<Self> {
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

    /// Logarithms of the squared speed of the motion that explains the slope along time best, and of the share of the
    /// slope that it leaves.
    fn motion(&self) -> (f32, f32) {
        let ((down, right), share) = self.steps.motion();
        ((down * down + right * right + REST).log10(), (share + LEFT).log10())
    }
}

/// The part of the gram diagonal that changes from mask to mask, and the energy of the masks' gradient, both
/// relative to the masks' energy, of each block.
fn of_masks(op: &SensingOperator) -> (Array2<f32>, Array2<f32>) {
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

/// Decimal logarithms: between these lies the contrast of the hybrid coded aperture, whose gradient is so far above it, at
/// least. Behind masks of more contrast, sharp or not, predictions are as good as behind independent pixels.
const APERTURE_CONTRAST: Range<f32> = -1.6..-1.0;
const APERTURE_SHARPNESS: f32 = 0.28;

/// Whether predictions are uncertain behind these masks, by what is seen of them in [`features`]: masks that are blurred, or
/// let light through closed pixels, until they are as much alike as those of the hybrid coded aperture, or more.
pub fn unfamiliar_masks(features: &Array4<f32>) -> bool {
    let of_blocks = |feature: usize| features.slice(s![OF_RESULT + feature, 0, .., ..]);
    // Of a block that no light reaches there is nothing to tell.
    let lit = of_blocks(2).mapv(|contrast| f32::from(u8::from(contrast > logarithm(0.0))));
    let mean = |feature: usize| (&of_blocks(feature) * &lit).sum() / lit.sum();
    let (contrast, sharpness) = (mean(2), mean(3) - mean(2));
    let known = contrast >= APERTURE_CONTRAST.end
        || contrast >= APERTURE_CONTRAST.start && sharpness >= APERTURE_SHARPNESS;
    !known
}

fn logarithm(energy: f32) -> f32 {
    energy.max(FLOOR).log10()
}

/// Half of the squared steps to the next pixel of both axes.
fn gradient(frame: ArrayView2<'_, f32>, i: usize, j: usize) -> f32 {
    let (height, width) = frame.dim();
    let here = frame[[i, j]];
    let down = if i + 1 < height { frame[[i + 1, j]] - here } else { 0.0 };
    let right = if j + 1 < width { frame[[i, j + 1]] - here } else { 0.0 };
    0.5 * (down * down + right * right)
}

/// Half of the squared second differences of both axes.
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

/// The means of a value over the pixels of each block \[rows, columns\].
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

/// What a piece of a measurement tells of the error of all of it: by pixels that were held out there, and by
/// what is seen of its frames, each in the mean over its blocks. Signs tell of frames like these.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Evidence {
    /// What the held-out pixels tell.
    pub signs: Signs,
    /// Values of [`FEATURES`].
    pub features: Vec<f32>,
    /// The same of the first run of a stage that is run twice.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub first: Option<Box<Evidence>>,
}

impl Evidence {
    /// Of signs and features \[features, B, rows, columns\] of the same piece.
    pub(super) fn new(signs: Signs, seen: &Array4<f32>) -> Self {
        let mean = |of_feature: ArrayView3<'_, f32>| of_feature.mean().unwrap_or(0.0);
        Self { signs, features: seen.outer_iter().map(mean).collect(), first: None }
    }
}

/// What errors are predicted by: `assessment.json`, which `research/training/assessment.py` fits. The mean of some
/// networks of a few neurons, of what is seen of a block, of its means over the blocks around and over these
/// in all frames, of the white level, of the evidence, and of what the encoder sees of the block.
#[derive(Debug, Deserialize)]
pub struct Model {
    features: Scaling,
    signs: Scaling,
    /// Of results that a network has had a part in.
    encoding: Option<Encoding>,
    networks: Vec<Vec<Layer>>,
    /// What is added to the predicted PSNR for the ends of the interval in which four of five true values lie,
    /// in dB.
    pub interval: [f64; 2],
    /// Where [`unfamiliar_masks`] says so.
    pub unfamiliar: Unfamiliar,
}

/// What is different behind masks that predictions are uncertain behind.
#[derive(Debug, Deserialize)]
pub struct Unfamiliar {
    /// What is added to the predicted PSNR, in dB.
    pub offset: f32,
    /// As that of the model.
    pub interval: [f64; 2],
}

/// Inputs are shifted, scaled and bounded first.
#[derive(Debug, Deserialize)]
struct Scaling {
    mean: Vec<f32>,
    scale: Vec<f32>,
}

/// Principal components of what the encoder sees: of each channel a weight for each of them. What they give is bounded.
#[derive(Debug, Deserialize)]
struct Encoding {
    mean: Vec<f32>,
    components: Vec<Vec<f32>>,
}

/// Neurons: of each input a weight for each of them.
#[derive(Debug, Deserialize)]
struct Layer {
    weights: Vec<Vec<f32>>,
    bias: Vec<f32>,
}

/// Shrinkage along time, in units of `sigma`, above which frames have a model of their own: where masks are much
/// alike, motion that was shrunk away may leave nothing behind that looks wrong.
const SHRUNK: f32 = 1.0;

/// The model of frames that were shrunk less.
const LITTLE_SHRUNK: &str = "pnp-tv-fastdvdnet";

/// Inputs further from the mean than in any fit, in their scale, count as that far.
const FARTHEST: f32 = 3.0;

static MODELS: LazyLock<BTreeMap<String, Model>> = LazyLock::new(|| {
    #[allow(clippy::expect_used)] // a test reads it
    serde_json::from_str(include_str!("assessment.json"))
        .expect("assessment.json is a map of models")
});

impl Model {
    /// The model that was fitted to results of such schedules, as they were run, if there is one: of total
    /// variation alone, or of total variation with what may follow in the default schedule, little shrunk along
    /// time or much.
    pub fn of(schedule: &Schedule) -> Option<&'static Self> {
        if schedule.method != Method::Gap {
            return None;
        }
        let (first, rest) = schedule.stages.split_first()?;
        let known = |stage: &Stage| {
            use PriorSpec::{Fastdvdnet, FastdvdnetInt8, Nonlocal};
            matches!(stage.prior, Fastdvdnet(_) | FastdvdnetInt8(_) | Nonlocal(_))
        };
        if !matches!(first.prior, PriorSpec::Tv(_)) || !rest.iter().all(known) {
            return None;
        }
        let strongly_shrunk = |stage: &Stage| {
            let nonlocal = stage.prior.nonlocal();
            let level = |nonlocal: &NonlocalSpec| {
                nonlocal.static_shrinkage.unwrap_or(nonlocal.temporal_shrinkage)
            };
            nonlocal.is_some_and(|nonlocal| level(nonlocal) > SHRUNK)
        };
        MODELS.get(match rest {
            [] => "gap-tv",
            _ if rest.iter().any(strongly_shrunk) => "pnp-tv-fastdvdnet, shrunk",
            _ => LITTLE_SHRUNK,
        })
    }

    /// The decimal logarithm of the expected squared error of each block \[S B, rows, columns\], from what is
    /// seen of them ([`encoded_features`]), and of the frames of the first run of a stage that was run twice.
    /// Without evidence signs count as in the mean of the fit, and the features of the whole stand for those of the
    /// piece; without an encoder its components count as in the mean. `white` is the scene's white level.
    pub fn log_errors(
        &self,
        features: &Array4<f32>,
        evidence: Option<&Evidence>,
        white: f32,
    ) -> Array3<f32> {
        let all = features.len_of(Axis(0));
        if [FEATURES.len(), FEATURES.len() + CHANNELS].contains(&all) {
            return self.log_errors_of_one(features.view(), evidence, white);
        }
        let (result, others) = features.view().split_at(Axis(0), all / 2);
        let (first, distance) = others.split_at(Axis(0), all / 2);
        let told = self.log_errors_of_one(result, evidence, white);
        let Some(model) = MODELS.get(LITTLE_SHRUNK) else { return told };
        let evidence = evidence.and_then(|evidence| evidence.first.as_deref());
        let of_first = model.log_errors_of_one(first, evidence, white);
        apart(&told, &of_first, distance.index_axis(Axis(0), 0))
    }

    /// The same from what is seen of one result.
    fn log_errors_of_one(
        &self,
        features: ArrayView4<'_, f32>,
        evidence: Option<&Evidence>,
        white: f32,
    ) -> Array3<f32> {
        let (_, frames, rows, columns) = features.dim();
        let encoded = features.slice(s![FEATURES.len().., .., .., ..]);
        let mut seen = features.slice(s![..FEATURES.len(), .., .., ..]).to_owned();
        for mut of_block in seen.lanes_mut(Axis(0)) {
            let scaled = self.features.of(of_block.to_vec());
            of_block.assign(&Array1::from(scaled));
        }
        let around = around(&seen);
        let always = around.sum_axis(Axis(1)) / frames as f32;
        let blocks = (frames * rows * columns) as f32;
        let mut known = vec![20.0 * white.log10()];
        let mut rest: Vec<f32> = match evidence {
            Some(evidence) => {
                known.extend(evidence.signs.0);
                self.features.of(evidence.features.clone())
            }
            None => {
                known.extend(&self.signs.mean[1..]);
                seen.outer_iter().map(|of_feature| of_feature.sum() / blocks).collect()
            }
        };
        rest.extend(self.signs.of(known));
        Array3::from_shape_fn((frames, rows, columns), |(k, row, column)| {
            let mut inputs = seen.slice(s![.., k, row, column]).to_vec();
            inputs.extend(around.slice(s![.., k, row, column]));
            inputs.extend(always.slice(s![.., row, column]));
            inputs.extend(&rest);
            if let Some(encoding) = &self.encoding {
                inputs.extend(encoding.of(encoded.slice(s![.., k, row, column])));
            }
            let told = self.networks.iter().map(|layers| output(layers, &inputs));
            told.sum::<f32>() / self.networks.len() as f32
        })
    }
}

/// From so many decibels on that the error of the first run's frames is expected to be above their distance from the
/// result's, they moved; within so many there is doubt. Found on 75 simulated scenes.
const MOVES: f32 = 3.0;
const DOUBT: f32 = 0.3;
/// The least share of the first run's error that its second run leaves where something moves.
const LEAST: f32 = 0.1;

/// What the result of a stage that was run twice is expected to be off by, by what it is by itself, `told`, by the errors
/// of its first run, which shrank little, and by the distance of both results; all logarithms \[S B, rows, columns\].
///
/// What the second run has taken away was error where the scene is at rest: then the first run's frames are as far from
/// the result's as from the truth. Where it was motion, they are further from the truth than that, by what both results
/// have wrong; and frames from which motion was not shrunk away show that they are.
fn apart(told: &Array3<f32>, of_first: &Array3<f32>, distance: ArrayView3<'_, f32>) -> Array3<f32> {
    let energy = |logs: ArrayView3<'_, f32>| logs.iter().map(|log| 10f32.powf(*log)).sum::<f32>();
    let further = 10.0 * (energy(of_first.view()) / energy(distance)).log10();
    let share = 1.0 / (1.0 + (-(further - MOVES) / DOUBT).exp());
    Zip::from(told).and(of_first).and(distance).map_collect(|told, first, distance| {
        let error = 10f32.powf(*first);
        let left = (error - 10f32.powf(*distance)).max(LEAST * error).log10();
        share * left + (1.0 - share) * told
    })
}

/// The means over each block and those that touch it, of the same frame.
fn around(seen: &Array4<f32>) -> Array4<f32> {
    let (_, _, rows, columns) = seen.dim();
    let beside = |at: usize, length: usize| at.saturating_sub(1)..length.min(at + 2);
    Array4::from_shape_fn(seen.dim(), |(feature, k, row, column)| {
        let place = s![feature, k, beside(row, rows), beside(column, columns)];
        seen.slice(place).mean().unwrap_or(0.0)
    })
}

impl Scaling {
    fn of(&self, values: Vec<f32>) -> Vec<f32> {
        let scaled = values.iter().zip(self.mean.iter().zip(&self.scale));
        scaled.map(|(x, (mean, s))| ((x - mean) / s).clamp(-FARTHEST, FARTHEST)).collect()
    }
}

impl Encoding {
    /// The components; all 0, as in the mean, where the encoder has seen nothing.
    fn of(&self, encoded: ArrayView1<'_, f32>) -> Vec<f32> {
        let mut values = vec![0.0; self.components.first().map_or(0, Vec::len)];
        let moved = encoded.iter().zip(&self.mean).map(|(x, mean)| x - mean);
        add_weighted(&mut values, moved, &self.components);
        values.iter().map(|value| value.clamp(-FARTHEST, FARTHEST)).collect()
    }
}

/// Adds to each sum all inputs by their weights for it, sum beside sum: that vectorises, and is the same on
/// every machine.
fn add_weighted(sums: &mut [f32], inputs: impl Iterator<Item = f32>, weights: &[Vec<f32>]) {
    for (input, weights) in inputs.zip(weights) {
        sums.iter_mut().zip(weights).for_each(|(sum, weight)| *sum += weight * input);
    }
}

/// What the last of some layers gives.
fn output(layers: &[Layer], inputs: &[f32]) -> f32 {
    let outputs = layers.iter().enumerate().fold(inputs.to_vec(), |inputs, (index, layer)| {
        layer.outputs(&inputs, index + 1 < layers.len())
    });
    outputs.first().copied().unwrap_or_default()
}

impl Layer {
    /// `W x + b`, and of all layers but the last its product with its sigmoid.
    fn outputs(&self, inputs: &[f32], inner: bool) -> Vec<f32> {
        let mut sums = self.bias.clone();
        add_weighted(&mut sums, inputs.iter().copied(), &self.weights);
        if inner {
            sums.iter_mut().for_each(|sum| *sum /= 1.0 + (-*sum).exp());
        }
        sums
    }
}

#[cfg(test)]
mod tests {
    use super::{
        Evidence, FEATURES, MODELS, Model, OF_CLIP, OF_EARLY, apart, around, encoded_features,
        features, unfamiliar_masks, with_first_run,
    };
    use crate::error::ReconError;
    use crate::operator::SensingOperator;
    use crate::priors::{CHANNELS, Encoder};
    use crate::schedule::Schedule;
    use crate::signs::{SIGNS, Signs};
    use ndarray::{Array3, Array4, ArrayView3, s};
    use optics::{iid_masks, random_squares, soften};

    /// A ramp of 0.01 a column that brightens by 0.02 a frame.
    fn ramp() -> Array3<f32> {
        Array3::from_shape_fn((4, 40, 36), |(k, _, j)| 0.1 + 0.02 * k as f32 + 0.01 * j as f32)
    }

    #[test]
    fn features_are_means_over_blocks_and_those_at_the_edge_are_smaller() {
        let masks = Array3::from_shape_fn((4, 40, 36), |(k, _, _)| if k == 0 { 1.0 } else { 0.0 });
        let op = SensingOperator::new(masks).unwrap();
        let early = ramp() - 0.1;
        let seen = features(&op, Some(early.view()), ramp().view());
        assert_eq!(seen.dim(), (FEATURES.len(), 4, 3, 3));
        let near = |feature: usize, at: (usize, usize, usize), energy: f32| {
            let found = seen[[feature, at.0, at.1, at.2]];
            assert!((found - energy.log10()).abs() < 1e-3, "{}: {found}", FEATURES[feature]);
        };
        // Half of a squared step; the last column of the picture has no next one.
        near(0, (1, 0, 0), 0.5 * 1e-4);
        near(0, (1, 2, 2), 0.5 * 1e-4 * 0.75);
        near(2, (0, 1, 1), 4e-4);
        near(2, (2, 1, 1), 4e-4);
        // 0.02 times -1.5, -0.5, 0.5 and 1.5 from the mean over time, whose gradient is that of each frame.
        near(3, (0, 0, 0), 9e-4);
        near(4, (1, 0, 0), 0.5 * 1e-4);
        // A ramp of 0.01 a column that brightens by 0.02 a frame moves by two columns a frame, but where the
        // last column has no next one.
        assert!((seen[[5, 2, 0, 0]] - 4f32.log10()).abs() < 0.02, "{}", seen[[5, 2, 0, 0]]);
        assert!(seen[[6, 2, 0, 0]] < -1.8 && seen[[6, 2, 0, 2]] > -1.0, "{seen:?}");
        near(7, (2, 1, 0), 1.0);
        near(8, (2, 1, 0), 1.0);
        near(9, (3, 2, 0), 1e-2);
        // One mask of four is open: 1 - 4 * (1/4)^2 of the gram differs from mask to mask.
        near(11, (0, 0, 0), 0.75);
        near(13, (0, 0, 0), 4.0);
        assert!(seen.slice(s![12, .., .., ..]).iter().all(|&gradient| gradient == -7.0));
        // The frames before are as far from each other as those of the result.
        for (feature, name) in FEATURES.iter().enumerate().take(OF_CLIP) {
            let early = seen.slice(s![OF_EARLY + feature, .., .., ..]);
            let difference = &early - &seen.slice(s![feature, .., .., ..]);
            assert!(difference.iter().all(|d| d.abs() < 1e-3), "{name}");
        }
    }

    /// An encoder to which all blocks look the same.
    struct Alike(Vec<f32>);

    impl Encoder for Alike {
        fn encode(&mut self, frames: ArrayView3<'_, f32>) -> Result<Array4<f32>, ReconError> {
            let (count, height, width) = frames.dim();
            let size = (self.0.len(), count, height.div_ceil(16), width.div_ceil(16));
            Ok(Array4::from_shape_fn(size, |(channel, ..)| self.0[channel]))
        }
    }

    #[test]
    fn what_the_encoder_sees_moves_the_prediction_and_without_it_counts_as_in_the_mean() {
        let op = SensingOperator::new(iid_masks(4, 40, 36, 1).unwrap()).unwrap();
        let model = Model::of(&Schedule::pnp_tv_fastdvdnet()).unwrap();
        let see = |values: Option<Vec<f32>>| {
            let mut encoder = values.map(Alike);
            let encoder = encoder.as_mut().map(|encoder| encoder as &mut dyn Encoder);
            encoded_features(&op, Some(ramp().view()), ramp().view(), encoder)
        };
        let told = |values| model.log_errors(&see(values).unwrap(), None, 1.0);
        let mean = model.encoding.as_ref().unwrap().mean.clone();
        assert_eq!(told(None), told(Some(mean.clone())));
        assert_ne!(told(None), told(Some(mean.iter().map(|value| value + 1.0).collect())));
        assert_eq!(see(Some(mean)).unwrap().len_of(ndarray::Axis(0)), FEATURES.len() + CHANNELS);
    }

    #[test]
    fn results_of_known_schedules_have_a_model_and_no_others() {
        assert_eq!(MODELS.len(), 3);
        let has = |schedule: Schedule| Model::of(&schedule).is_some();
        assert!(has(Schedule::gap_tv()) && has(Schedule::pnp_tv_fastdvdnet()));
        assert!(!has(Schedule::admm_tv()) && !has(Schedule::pnp_ffdnet()));
        for model in MODELS.values() {
            let encoding = model.encoding.as_ref();
            let components = encoding.map_or(0, |encoding| encoding.components[0].len());
            let inputs = 4 * FEATURES.len() + 1 + SIGNS.len() + components;
            assert_eq!(
                (model.features.mean.len(), model.features.scale.len()),
                (FEATURES.len(), FEATURES.len())
            );
            assert_eq!(
                (model.signs.mean.len(), model.signs.scale.len()),
                (1 + SIGNS.len(), 1 + SIGNS.len())
            );
            for layers in &model.networks {
                let mut before = inputs;
                for layer in layers {
                    assert_eq!(layer.weights.len(), before);
                    let neurons = layer.bias.len();
                    assert!(layer.weights.iter().all(|weights| weights.len() == neurons));
                    before = layer.bias.len();
                }
                assert_eq!(before, 1, "the last layer has one neuron");
            }
            if let Some(encoding) = &model.encoding {
                assert_eq!(encoding.mean.len(), CHANNELS);
                assert_eq!(encoding.components.len(), CHANNELS);
                assert!(encoding.components.iter().all(|weights| weights.len() == components));
            }
            let [low, high] = model.interval;
            let [lower, higher] = model.unfamiliar.interval;
            assert!(lower < low && low < 0.0 && 0.0 < high && high < higher);
        }
    }

    #[test]
    fn frames_whose_changes_were_shrunk_far_have_a_model_of_their_own() {
        let mut schedule = Schedule::pnp_tv_fastdvdnet();
        let low = |schedule: &Schedule| Model::of(schedule).unwrap().interval[0];
        let planned = low(&schedule);
        let nonlocal = schedule.stages.last_mut().unwrap().prior.nonlocal_mut().unwrap();
        nonlocal.static_shrinkage = Some(4.0 * nonlocal.temporal_shrinkage);
        assert!(low(&schedule) < planned, "it knows less");
    }

    #[test]
    fn what_a_second_run_has_shrunk_away_was_motion_or_error() {
        let of = |log: f32| Array3::from_elem((2, 1, 3), log);
        let told = |first, distance: f32| apart(&of(-4.0), &of(first), of(distance).view());
        let near = |found: Array3<f32>, log: f32| found.iter().all(|f| (f - log).abs() < 0.01);
        assert!(near(told(-3.0, -3.0), -4.0), "error: the result is what it looks like");
        let left = (10f32.powf(-2.0) - 10f32.powf(-3.0)).log10();
        assert!(near(told(-2.0, -3.0), left), "motion: that, and what both have wrong");
        let mut distance = of(-4.0);
        distance[[0, 0, 0]] = -2.0;
        let found = apart(&of(-4.0), &of(-2.0), distance.view());
        assert!((found[[0, 0, 0]] + 3.0).abs() < 0.01, "never nothing: {found}");
    }

    #[test]
    fn frames_of_a_first_run_are_told_by_the_other_model() {
        let op = SensingOperator::new(iid_masks(4, 40, 36, 1).unwrap()).unwrap();
        let mut ripple = ramp();
        for ((k, i, j), value) in ripple.indexed_iter_mut() {
            *value += 0.1 * ((i * j + k) as f32).sin();
        }
        let see = |frames: &Array3<f32>| features(&op, Some(ramp().view()), frames.view());
        let (result, first) = (see(&ramp()), see(&ripple));
        let mut schedule = Schedule::pnp_tv_fastdvdnet();
        let little = Model::of(&schedule).unwrap();
        let nonlocal = schedule.stages.last_mut().unwrap().prior.nonlocal_mut().unwrap();
        nonlocal.static_shrinkage = Some(4.0 * nonlocal.temporal_shrinkage);
        let much = Model::of(&schedule).unwrap();
        let with = |frames: &Array3<f32>| {
            let frames = (ramp(), frames.clone());
            with_first_run(&result, &first, (frames.0.view(), frames.1.view())).unwrap()
        };
        let alone = much.log_errors(&result, None, 1.0);
        let apart_far = with(&(ramp() + 1.0));
        assert_eq!(much.log_errors(&apart_far, None, 1.0), alone, "far apart: at rest");
        let told = much.log_errors(&with(&(ramp() + 1e-3)), None, 1.0);
        let of_first = little.log_errors(&first, None, 1.0);
        let furthest = (&told - &of_first).iter().fold(0.0, |most: f32, d| most.max(d.abs()));
        assert!(furthest < 0.02, "near each other, and off: {furthest}");
        let evidence = Evidence::new(Signs([-10.0; SIGNS.len()]), &result);
        let first = Some(Box::new(evidence.clone()));
        let seen = with(&(ramp() + 1e-3));
        let known = much.log_errors(&seen, Some(&Evidence { first, ..evidence.clone() }), 1.0);
        assert_ne!(known, much.log_errors(&seen, Some(&evidence), 1.0));
    }

    #[test]
    fn blocks_at_the_edge_have_fewer_around_them() {
        let seen =
            Array4::from_shape_fn((1, 2, 3, 4), |(_, k, i, j)| (100 * k + 10 * i + j) as f32);
        let around = around(&seen);
        assert_eq!((around[[0, 0, 0, 0]], around[[0, 1, 1, 2]]), (5.5, 112.0));
        assert_eq!((around[[0, 0, 2, 1]], around[[0, 1, 2, 3]]), (16.0, 117.5));
    }

    #[test]
    fn masks_that_predictions_are_uncertain_behind_are_told_apart() {
        let unfamiliar = |masks: Array3<f32>| {
            let frames = Array3::zeros(masks.raw_dim());
            let op = SensingOperator::new(masks).unwrap();
            unfamiliar_masks(&features(&op, None, frames.view()))
        };
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
        // A corner without light.
        let mut dark = squares();
        dark.slice_mut(s![.., ..32, ..32]).fill(0.0);
        assert!(!softened(dark, 0.0, 0.0));
        assert!(softened(squares(), 0.7, 0.0));
        assert!(softened(squares(), 0.0, 0.4));
    }

    /// Fine moving texture of a tenth, and of a hundredth, that the priors have moved by a fifth.
    #[test]
    fn more_texture_lets_expect_more_error() {
        let op = SensingOperator::new(iid_masks(4, 48, 48, 1).unwrap()).unwrap();
        let error = |schedule: &Schedule, texture: f32| {
            let frame = |(k, i, j): (usize, usize, usize)| {
                let phase = i as f32 * 1.1 + (j as f32 - k as f32) * 0.9;
                0.5 + texture * phase.sin()
            };
            let frames = Array3::from_shape_fn((4, 48, 48), frame);
            let early = frames.mapv(|x| 0.5 + 0.8 * (x - 0.5));
            let deep = schedule.stages.len() > 1;
            let early = deep.then(|| early.view());
            let seen = features(&op, early, frames.view());
            Model::of(schedule).unwrap().log_errors(&seen, None, 1.0)[[1, 1, 1]]
        };
        for schedule in [Schedule::gap_tv(), Schedule::pnp_tv_fastdvdnet()] {
            let (much, little) = (error(&schedule, 0.1), error(&schedule, 0.01));
            assert!(much > little + 0.3 && much < -1.0 && little > -6.0, "{much}, {little}");
        }
    }

    /// What held-out pixels say of the error moves the prediction.
    #[test]
    fn a_larger_held_out_error_lets_expect_more_error() {
        let op = SensingOperator::new(iid_masks(4, 40, 36, 1).unwrap()).unwrap();
        let seen = features(&op, Some(ramp().view()), ramp().view());
        for model in MODELS.values() {
            let error = |decibels: f32| {
                let evidence = Evidence::new(Signs([decibels; SIGNS.len()]), &seen);
                model.log_errors(&seen, Some(&evidence), 1.0).mean().unwrap()
            };
            assert!(error(-20.0) > error(-35.0), "{}, {}", error(-20.0), error(-35.0));
        }
    }
}
