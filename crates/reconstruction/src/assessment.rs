//! The quality model: predicts the error of frames without the true ones.
//!
//! A lab has no true frames, but several features correlate with the error. Features of the frames are their texture,
//! their temporal changes, their distance from the frames after total variation, and activations of the denoiser's
//! first layers. The contrast of the masks and estimates from hold-out pixels ([`super::signs`]) complete them. Small
//! networks predict the error of each block from these features. They were fitted to simulated snapshots of many
//! scenes. `docs/BENCHMARKS.md` states their error on other scenes.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::LazyLock;

use ndarray::{
    Array1, Array2, Array3, Array4, ArrayView1, ArrayView2, ArrayView3, ArrayView4, ArrayViewMut4,
    Axis, Zip, concatenate, s,
};
use serde::{Deserialize, Serialize};

use super::error::{ReconError, Result, shape_text};
use super::hold_out::Prediction;
use super::motion::Steps;
use super::operator::SensingOperator;
use super::order::Order;
pub use super::priors::BLOCK;
use super::priors::nonlocal::NonlocalSpec;
use super::priors::registry::PriorSpec;
use super::priors::{CHANNELS, Encoder};
use super::schedule::{Method, Schedule};
use super::signs::Signs;
use super::stage::Stage;

/// Features of a block of a frame, each the decimal logarithm of an energy or a ratio. The last nine belong to the frames
/// after total variation, if other priors followed. Temporal changes that no motion explains indicate an error best.
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

/// Number of features computed from a clip alone.
const CLIP_FEATURES: usize = 9;
/// Index of the first feature of the result beyond those of its clip.
const RESULT: usize = 9;
/// Index of the first feature of the whole frame.
const WHOLE: usize = 14;
/// Index of the first feature of the frames after total variation.
const EARLY: usize = 17;

/// Energies below this are rounding errors.
const FLOOR: f32 = 1e-7;

/// Rows and columns of blocks of a picture of `height` x `width` pixels. Blocks at the far edges may be smaller.
pub fn blocks(height: usize, width: usize) -> (usize, usize) {
    (height.div_ceil(BLOCK), width.div_ceil(BLOCK))
}

/// Features of each block \[features, S B, rows, columns\] of the frames \[S B,H,W\] of a reconstruction. `early` are the
/// frames after total variation, if other priors followed. All are on the scale on which the scene is on \[0,1\].
pub fn features(
    op: &SensingOperator,
    early: Option<ArrayView3<'_, f32>>,
    frames: ArrayView3<'_, f32>,
) -> Array4<f32> {
    let (count, height, width) = frames.dim();
    let (rows, columns) = blocks(height, width);
    let ratio = op.masks().len_of(Axis(0));
    let mut all = Array4::zeros((FEATURES.len(), count, rows, columns));
    clip_features(frames, ratio, all.slice_mut(s![..CLIP_FEATURES, .., .., ..]));
    if let Some(early) = early {
        clip_features(early, ratio, all.slice_mut(s![EARLY..EARLY + CLIP_FEATURES, .., .., ..]));
    }
    let (contrast, mask_gradient) = mask_features(op);
    let ratio = (ratio as f32).log10();
    for (k, frame) in frames.outer_iter().enumerate() {
        let early = early.map(|early| early.index_axis_move(Axis(0), k));
        let distance = over_blocks((height, width), |i, j| {
            early.map_or(0.0, |early| (frame[[i, j]] - early[[i, j]]).powi(2))
        });
        let brightness = over_blocks((height, width), |i, j| frame[[i, j]].powi(2));
        let result_features = [
            distance.mapv(logarithm),
            brightness.mapv(logarithm),
            contrast.clone(),
            mask_gradient.clone(),
        ];
        for (index, value) in result_features.into_iter().enumerate() {
            all.slice_mut(s![RESULT + index, k, .., ..]).assign(&value);
        }
        all.slice_mut(s![RESULT + 4, k, .., ..]).fill(ratio);
        let whole = |feature: usize| {
            let energies = all.slice(s![feature, k, .., ..]).mapv(|energy| 10f32.powf(energy));
            logarithm(energies.mean().unwrap_or(0.0))
        };
        for (index, value) in [whole(0), whole(2), whole(RESULT)].into_iter().enumerate() {
            all.slice_mut(s![WHOLE + index, k, .., ..]).fill(value);
        }
    }
    all
}

/// As [`features`], followed by the encoder's features of the result, if there is an encoder: \[features and
/// [`CHANNELS`], S B, rows, columns\].
///
/// # Errors
/// The encoder fails.
pub fn encoded_features(
    op: &SensingOperator,
    early: Option<ArrayView3<'_, f32>>,
    frames: ArrayView3<'_, f32>,
    encoder: Option<&mut dyn Encoder>,
) -> Result<Array4<f32>> {
    let features = features(op, early, frames);
    let Some(encoder) = encoder else { return Ok(features) };
    let encoded = encoder.encode(frames)?;
    concatenate(Axis(0), &[features.view(), encoded.view()]).map_err(|_| ReconError::Shape {
        what: "the encoder's output",
        found: shape_text(encoded.shape()),
        expected: shape_text(&[&[CHANNELS], &features.shape()[1..]].concat()),
    })
}

/// Features of a stage that was run twice \[2 x features + 1, S B, rows, columns\]: those of the result, then those of the
/// first run. The last one is the decimal logarithm of the mean squared distance between the frames of both.
///
/// # Errors
/// Sizes that disagree.
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
        what: "the features of a stage's first run",
        found: shape_text(first.shape()),
        expected: shape_text(result.shape()),
    })
}

/// Writes the features that follow from a clip alone into `all` \[features, S B, rows, columns\]. A snapshot has `ratio`
/// frames.
fn clip_features(clip: ArrayView3<'_, f32>, ratio: usize, mut all: ArrayViewMut4<'_, f32>) {
    let (count, height, width) = clip.dim();
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
                let (speed, unexplained) = energies.motion();
                let (gradient, change) =
                    (logarithm(energies.gradient()), logarithm(energies.change));
                let values = [
                    gradient,
                    logarithm(energies.curvature),
                    change,
                    logarithm(energies.variance),
                    logarithm(*mean_gradient),
                    speed,
                    unexplained,
                    gradient - logarithm(gradients),
                    change - logarithm(changes),
                ];
                all.slice_mut(s![.., k, row, column]).assign(&ArrayView1::from(&values));
            }
        }
    }
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

/// True if predictions are uncertain behind the masks of these [`features`]. Such masks are blurred, or leak light through
/// closed pixels, until they are at least as highly correlated as those of the hybrid coded aperture.
pub fn unfamiliar_masks(features: &Array4<f32>) -> bool {
    let in_blocks = |feature: usize| features.slice(s![RESULT + feature, 0, .., ..]);
    // A block that no light reaches has no contrast.
    let lit = in_blocks(2).mapv(|contrast| f32::from(u8::from(contrast > logarithm(0.0))));
    let mean = |feature: usize| (&in_blocks(feature) * &lit).sum() / lit.sum();
    let (contrast, sharpness) = (mean(2), mean(3) - mean(2));
    let known = contrast >= APERTURE_CONTRAST.end
        || contrast >= APERTURE_CONTRAST.start && sharpness >= APERTURE_SHARPNESS;
    !known
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
    /// Values of [`FEATURES`], means over the blocks of the crop.
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
    /// Evidence from signs and features \[features, B, rows, columns\] of the same crop.
    pub(super) fn new(signs: Signs, features: &Array4<f32>) -> Self {
        let mean = |values: ArrayView3<'_, f32>| values.mean().unwrap_or(0.0);
        let features = features.outer_iter().map(mean).collect();
        Self { signs, features, prediction: None, order: None, first: None }
    }
}

/// A quality model from `assessment.json`, which `research/training/assessment.py` fits.
///
/// It averages small networks. Their inputs are the features of a block, their means over the blocks around it, in its
/// frame and in all frames, the evidence, and the encoder's features of the block. They were fitted with the white level as a
/// further input, which takes its mean: the stated full scale of a measurement must not change a relative error.
#[derive(Debug, Deserialize)]
pub struct Model {
    features: Scaling,
    signs: Scaling,
    /// The encoder's part, for results of schedules with a network.
    encoding: Option<Encoding>,
    networks: Vec<Vec<Layer>>,
    /// Ends of the interval that contains four of five true values, in dB relative to the predicted PSNR.
    pub interval: [f64; 2],
    /// The correction behind [`unfamiliar_masks`].
    pub unfamiliar: Unfamiliar,
}

/// Correction of a prediction behind unfamiliar masks.
#[derive(Debug, Deserialize)]
pub struct Unfamiliar {
    /// Correction of the predicted PSNR in dB.
    pub offset: f32,
    /// The interval in place of the model's.
    pub interval: [f64; 2],
}

/// Shift and scale of inputs, which are bounded afterwards.
#[derive(Debug, Deserialize)]
struct Scaling {
    mean: Vec<f32>,
    scale: Vec<f32>,
}

/// Principal components of the encoder's features: for each channel a weight in each component. Values are clamped.
#[derive(Debug, Deserialize)]
struct Encoding {
    mean: Vec<f32>,
    components: Vec<Vec<f32>>,
}

/// A layer of neurons: for each input a weight in each neuron.
#[derive(Debug, Deserialize)]
struct Layer {
    weights: Vec<Vec<f32>>,
    bias: Vec<f32>,
}

/// Temporal shrinkage, in units of `sigma`, above which a separate model predicts the error. Behind highly correlated masks
/// it may remove motion without leaving a trace.
const STRONG_SHRINKAGE: f32 = 1.0;

/// Name of the model of weakly shrunk frames.
const WEAKLY_SHRUNK: &str = "pnp-tv-fastdvdnet";

/// Largest deviation of an input from its mean, in units of its scale. Fits contain no larger ones.
const MAX_DEVIATION: f32 = 3.0;

static MODELS: LazyLock<BTreeMap<String, Model>> = LazyLock::new(|| {
    #[allow(clippy::expect_used)] // a test reads it
    serde_json::from_str(include_str!("assessment.json"))
        .expect("assessment.json is a map of models")
});

impl Model {
    /// The model for results of a fixed schedule, if there is one. There are models for total variation alone, and
    /// for total variation followed by priors of the default schedule, with weak or strong temporal shrinkage.
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
            nonlocal.is_some_and(|nonlocal| level(nonlocal) > STRONG_SHRINKAGE)
        };
        MODELS.get(match rest {
            [] => "gap-tv",
            _ if rest.iter().any(strongly_shrunk) => "pnp-tv-fastdvdnet, shrunk",
            _ => WEAKLY_SHRUNK,
        })
    }

    /// Decimal logarithm of the expected squared error of each block \[S B, rows, columns\]. `features` are those of
    /// [`encoded_features`], or for a stage that was run twice those of both runs. Errors are on the scale of the solver.
    ///
    /// Without evidence the signs take their means in the fit, and the features of the whole picture replace those of the
    /// crop. Without an encoder its components take their means.
    pub fn log_errors(&self, features: &Array4<f32>, evidence: Option<&Evidence>) -> Array3<f32> {
        let all = features.len_of(Axis(0));
        if [FEATURES.len(), FEATURES.len() + CHANNELS].contains(&all) {
            return self.log_errors_of_one(features.view(), evidence);
        }
        let (result, others) = features.view().split_at(Axis(0), all / 2);
        let (first, distance) = others.split_at(Axis(0), all / 2);
        let log_errors = self.log_errors_of_one(result, evidence);
        let Some(model) = MODELS.get(WEAKLY_SHRUNK) else { return log_errors };
        let evidence = evidence.and_then(|evidence| evidence.first.as_deref());
        let first = model.log_errors_of_one(first, evidence);
        combine_runs(&log_errors, &first, distance.index_axis(Axis(0), 0))
    }

    /// As [`Model::log_errors`], from the features of a single run.
    fn log_errors_of_one(
        &self,
        features: ArrayView4<'_, f32>,
        evidence: Option<&Evidence>,
    ) -> Array3<f32> {
        let (_, frames, rows, columns) = features.dim();
        let encoded = features.slice(s![FEATURES.len().., .., .., ..]);
        let mut own = features.slice(s![..FEATURES.len(), .., .., ..]).to_owned();
        for mut block in own.lanes_mut(Axis(0)) {
            let scaled = self.features.of(block.to_vec());
            block.assign(&Array1::from(scaled));
        }
        let neighbourhood = neighbourhood_means(&own);
        let over_time = neighbourhood.sum_axis(Axis(1)) / frames as f32;
        let blocks = (frames * rows * columns) as f32;
        let mut signs = vec![self.signs.mean[0]];
        let mut shared: Vec<f32> = match evidence {
            Some(evidence) => {
                signs.extend(evidence.signs.0);
                self.features.of(evidence.features.clone())
            }
            None => {
                signs.extend(&self.signs.mean[1..]);
                own.outer_iter().map(|feature| feature.sum() / blocks).collect()
            }
        };
        shared.extend(self.signs.of(signs));
        Array3::from_shape_fn((frames, rows, columns), |(k, row, column)| {
            let mut inputs = own.slice(s![.., k, row, column]).to_vec();
            inputs.extend(neighbourhood.slice(s![.., k, row, column]));
            inputs.extend(over_time.slice(s![.., row, column]));
            inputs.extend(&shared);
            if let Some(encoding) = &self.encoding {
                inputs.extend(encoding.of(encoded.slice(s![.., k, row, column])));
            }
            let outputs = self.networks.iter().map(|layers| output(layers, &inputs));
            outputs.sum::<f32>() / self.networks.len() as f32
        })
    }
}

/// Excess, in dB, of the first run's expected error over the squared distance of both runs, above which the scene moved.
/// Determined on 75 simulated scenes.
const MOTION_DB: f32 = 3.0;
/// Width of the transition around [`MOTION_DB`], in dB.
const MOTION_WIDTH_DB: f32 = 0.3;
/// Smallest share of the first run's error that remains in the result where something moves.
const MIN_SHARE: f32 = 0.1;

/// Expected error of a stage that was run twice, from the predictions for both runs and from their distance; all are
/// logarithms \[S B, rows, columns\].
///
/// In a static scene the second run removes error, so the first run is as far from the result as from the true frames.
/// If it removes motion, the first run's error exceeds the distance by the error that both runs share. The weakly shrunk
/// frames of the first run show that error.
fn combine_runs(
    result: &Array3<f32>,
    first: &Array3<f32>,
    distance: ArrayView3<'_, f32>,
) -> Array3<f32> {
    let energy = |logs: ArrayView3<'_, f32>| logs.iter().map(|log| 10f32.powf(*log)).sum::<f32>();
    let excess = 10.0 * (energy(first.view()) / energy(distance)).log10();
    let share = 1.0 / (1.0 + (-(excess - MOTION_DB) / MOTION_WIDTH_DB).exp());
    Zip::from(result).and(first).and(distance).map_collect(|result, first, distance| {
        let error = 10f32.powf(*first);
        let remaining = (error - 10f32.powf(*distance)).max(MIN_SHARE * error).log10();
        share * remaining + (1.0 - share) * result
    })
}

/// Means over each block and the blocks that touch it, in the same frame.
fn neighbourhood_means(features: &Array4<f32>) -> Array4<f32> {
    let (_, _, rows, columns) = features.dim();
    let adjacent = |at: usize, length: usize| at.saturating_sub(1)..length.min(at + 2);
    Array4::from_shape_fn(features.dim(), |(feature, k, row, column)| {
        let place = s![feature, k, adjacent(row, rows), adjacent(column, columns)];
        features.slice(place).mean().unwrap_or(0.0)
    })
}

impl Scaling {
    fn of(&self, values: Vec<f32>) -> Vec<f32> {
        let scaled = values.iter().zip(self.mean.iter().zip(&self.scale));
        scaled.map(|(x, (mean, s))| ((x - mean) / s).clamp(-MAX_DEVIATION, MAX_DEVIATION)).collect()
    }
}

impl Encoding {
    /// The components; without the encoder's features all are 0, their mean.
    fn of(&self, encoded: ArrayView1<'_, f32>) -> Vec<f32> {
        let mut values = vec![0.0; self.components.first().map_or(0, Vec::len)];
        let shifted = encoded.iter().zip(&self.mean).map(|(x, mean)| x - mean);
        add_weighted(&mut values, shifted, &self.components);
        values.iter().map(|value| value.clamp(-MAX_DEVIATION, MAX_DEVIATION)).collect()
    }
}

/// Adds all weighted inputs to each sum. The sums are side by side, which vectorises and is the same on every machine.
fn add_weighted(sums: &mut [f32], inputs: impl Iterator<Item = f32>, weights: &[Vec<f32>]) {
    for (input, weights) in inputs.zip(weights) {
        sums.iter_mut().zip(weights).for_each(|(sum, weight)| *sum += weight * input);
    }
}

/// Output of the last layer.
fn output(layers: &[Layer], inputs: &[f32]) -> f32 {
    let outputs = layers.iter().enumerate().fold(inputs.to_vec(), |inputs, (index, layer)| {
        layer.outputs(&inputs, index + 1 < layers.len())
    });
    outputs.first().copied().unwrap_or_default()
}

impl Layer {
    /// `W x + b`; an inner layer multiplies it by its sigmoid (SiLU).
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
        CLIP_FEATURES, EARLY, Evidence, FEATURES, MODELS, Model, combine_runs, encoded_features,
        features, neighbourhood_means, unfamiliar_masks, with_first_run,
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
    fn features_are_means_over_blocks() {
        let masks = Array3::from_shape_fn((4, 40, 36), |(k, _, _)| if k == 0 { 1.0 } else { 0.0 });
        let op = SensingOperator::new(masks).unwrap();
        let early = ramp() - 0.1;
        let features = features(&op, Some(early.view()), ramp().view());
        assert_eq!(features.dim(), (FEATURES.len(), 4, 3, 3));
        let assert_energy = |feature: usize, at: (usize, usize, usize), energy: f32| {
            let found = features[[feature, at.0, at.1, at.2]];
            assert!((found - energy.log10()).abs() < 1e-3, "{}: {found}", FEATURES[feature]);
        };
        // Half of a squared step; the last column of the picture has no next one.
        assert_energy(0, (1, 0, 0), 0.5 * 1e-4);
        assert_energy(0, (1, 2, 2), 0.5 * 1e-4 * 0.75);
        assert_energy(2, (0, 1, 1), 4e-4);
        assert_energy(2, (2, 1, 1), 4e-4);
        // The frames deviate from their mean by 0.02 times -1.5, -0.5, 0.5 and 1.5, and all have its gradient.
        assert_energy(3, (0, 0, 0), 9e-4);
        assert_energy(4, (1, 0, 0), 0.5 * 1e-4);
        // A ramp of 0.01 per column that brightens by 0.02 per frame moves by two columns per frame. The last column has no
        // gradient.
        assert!((features[[5, 2, 0, 0]] - 4f32.log10()).abs() < 0.02, "{}", features[[5, 2, 0, 0]]);
        assert!(features[[6, 2, 0, 0]] < -1.8 && features[[6, 2, 0, 2]] > -1.0, "{features:?}");
        assert_energy(7, (2, 1, 0), 1.0);
        assert_energy(8, (2, 1, 0), 1.0);
        assert_energy(9, (3, 2, 0), 1e-2);
        // One mask of four is open, so the share 1 - 4 (1/4)^2 of the Gram diagonal changes from mask to mask.
        assert_energy(11, (0, 0, 0), 0.75);
        assert_energy(13, (0, 0, 0), 4.0);
        assert!(features.slice(s![12, .., .., ..]).iter().all(|&gradient| gradient == -7.0));
        // The early frames change as much as those of the result.
        for (feature, name) in FEATURES.iter().enumerate().take(CLIP_FEATURES) {
            let early = features.slice(s![EARLY + feature, .., .., ..]);
            let difference = &early - &features.slice(s![feature, .., .., ..]);
            assert!(difference.iter().all(|d| d.abs() < 1e-3), "{name}");
        }
    }

    /// An encoder with the same features for all blocks.
    struct Constant(Vec<f32>);

    impl Encoder for Constant {
        fn encode(&mut self, frames: ArrayView3<'_, f32>) -> Result<Array4<f32>, ReconError> {
            let (count, height, width) = frames.dim();
            let size = (self.0.len(), count, height.div_ceil(16), width.div_ceil(16));
            Ok(Array4::from_shape_fn(size, |(channel, ..)| self.0[channel]))
        }
    }

    #[test]
    fn a_missing_encoder_is_replaced_by_its_mean() {
        let op = SensingOperator::new(iid_masks(4, 40, 36, 1).unwrap()).unwrap();
        let model = Model::of(&Schedule::pnp_tv_fastdvdnet()).unwrap();
        let encoded = |values: Option<Vec<f32>>| {
            let mut encoder = values.map(Constant);
            let encoder = encoder.as_mut().map(|encoder| encoder as &mut dyn Encoder);
            encoded_features(&op, Some(ramp().view()), ramp().view(), encoder)
        };
        let log_errors = |values| model.log_errors(&encoded(values).unwrap(), None);
        let mean = model.encoding.as_ref().unwrap().mean.clone();
        assert_eq!(log_errors(None), log_errors(Some(mean.clone())));
        let other = mean.iter().map(|value| value + 1.0).collect();
        assert_ne!(log_errors(None), log_errors(Some(other)));
        assert_eq!(
            encoded(Some(mean)).unwrap().len_of(ndarray::Axis(0)),
            FEATURES.len() + CHANNELS
        );
    }

    #[test]
    fn only_known_schedules_have_a_model() {
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
    fn strongly_shrunk_frames_have_a_separate_model() {
        let mut schedule = Schedule::pnp_tv_fastdvdnet();
        let low = |schedule: &Schedule| Model::of(schedule).unwrap().interval[0];
        let planned = low(&schedule);
        let nonlocal = schedule.stages.last_mut().unwrap().prior.nonlocal_mut().unwrap();
        nonlocal.static_shrinkage = Some(4.0 * nonlocal.temporal_shrinkage);
        assert!(low(&schedule) < planned, "its interval is wider");
    }

    #[test]
    fn a_second_run_removes_motion_or_error() {
        let uniform = |log: f32| Array3::from_elem((2, 1, 3), log);
        let combined = |first, distance: f32| {
            combine_runs(&uniform(-4.0), &uniform(first), uniform(distance).view())
        };
        let is_close = |logs: Array3<f32>, log: f32| logs.iter().all(|f| (f - log).abs() < 0.01);
        assert!(is_close(combined(-3.0, -3.0), -4.0), "error: the prediction for the result holds");
        let remaining = (10f32.powf(-2.0) - 10f32.powf(-3.0)).log10();
        assert!(
            is_close(combined(-2.0, -3.0), remaining),
            "motion: the error that both runs share"
        );
        let mut distance = uniform(-4.0);
        distance[[0, 0, 0]] = -2.0;
        let found = combine_runs(&uniform(-4.0), &uniform(-2.0), distance.view());
        assert!((found[[0, 0, 0]] + 3.0).abs() < 0.01, "at least the smallest share: {found}");
    }

    #[test]
    fn a_first_run_is_predicted_by_the_model_of_weak_shrinkage() {
        let op = SensingOperator::new(iid_masks(4, 40, 36, 1).unwrap()).unwrap();
        let mut ripple = ramp();
        for ((k, i, j), value) in ripple.indexed_iter_mut() {
            *value += 0.1 * ((i * j + k) as f32).sin();
        }
        let features_of = |frames: &Array3<f32>| features(&op, Some(ramp().view()), frames.view());
        let (result, first) = (features_of(&ramp()), features_of(&ripple));
        let mut schedule = Schedule::pnp_tv_fastdvdnet();
        let weak = Model::of(&schedule).unwrap();
        let nonlocal = schedule.stages.last_mut().unwrap().prior.nonlocal_mut().unwrap();
        nonlocal.static_shrinkage = Some(4.0 * nonlocal.temporal_shrinkage);
        let strong = Model::of(&schedule).unwrap();
        let with = |frames: &Array3<f32>| {
            let frames = (ramp(), frames.clone());
            with_first_run(&result, &first, (frames.0.view(), frames.1.view())).unwrap()
        };
        let alone = strong.log_errors(&result, None);
        let distant = with(&(ramp() + 1.0));
        assert_eq!(strong.log_errors(&distant, None), alone, "large distance: a static scene");
        let moving = strong.log_errors(&with(&(ramp() + 1e-3)), None);
        let expected = weak.log_errors(&first, None);
        let difference =
            (&moving - &expected).iter().fold(0.0, |largest: f32, d| largest.max(d.abs()));
        assert!(difference < 0.02, "small distance, large error: {difference}");
        let evidence = Evidence::new(Signs([-10.0; SIGNS.len()]), &result);
        let first = Some(Box::new(evidence.clone()));
        let features = with(&(ramp() + 1e-3));
        let known = strong.log_errors(&features, Some(&Evidence { first, ..evidence.clone() }));
        assert_ne!(known, strong.log_errors(&features, Some(&evidence)));
    }

    #[test]
    fn blocks_at_the_edge_have_fewer_neighbours() {
        let features =
            Array4::from_shape_fn((1, 2, 3, 4), |(_, k, i, j)| (100 * k + 10 * i + j) as f32);
        let means = neighbourhood_means(&features);
        assert_eq!((means[[0, 0, 0, 0]], means[[0, 1, 1, 2]]), (5.5, 112.0));
        assert_eq!((means[[0, 0, 2, 1]], means[[0, 1, 2, 3]]), (16.0, 117.5));
    }

    #[test]
    fn blurred_and_leaking_masks_are_unfamiliar() {
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

    /// Fine moving texture of two amplitudes. The priors have changed both by a fifth.
    #[test]
    fn more_texture_raises_the_expected_error() {
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
            let features = features(&op, early, frames.view());
            Model::of(schedule).unwrap().log_errors(&features, None)[[1, 1, 1]]
        };
        for schedule in [Schedule::gap_tv(), Schedule::pnp_tv_fastdvdnet()] {
            let (much, little) = (error(&schedule, 0.1), error(&schedule, 0.01));
            assert!(much > little + 0.3 && much < -1.0 && little > -6.0, "{much}, {little}");
        }
    }

    #[test]
    fn a_larger_hold_out_error_raises_the_expected_error() {
        let op = SensingOperator::new(iid_masks(4, 40, 36, 1).unwrap()).unwrap();
        let features = features(&op, Some(ramp().view()), ramp().view());
        for model in MODELS.values() {
            let error = |decibels: f32| {
                let evidence = Evidence::new(Signs([decibels; SIGNS.len()]), &features);
                model.log_errors(&features, Some(&evidence)).mean().unwrap()
            };
            assert!(error(-20.0) > error(-35.0), "{}, {}", error(-20.0), error(-35.0));
        }
    }
}
