//! How near frames come to the truth, told without it.
//!
//! A lab has no truth. What can be seen are the frames themselves: how much changes in them from pixel to pixel
//! and from frame to frame, how far the priors have moved them since total variation, how well the masks
//! can tell frames apart, and the [`super::signs`] of pixels that were held out. Block by block the expected error
//! follows from these by a small network that was fitted to simulated snapshots of many scenes; `docs/benchmarks.md` says
//! how well it does on others.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use ndarray::{Array2, Array3, Array4, ArrayView2, ArrayView3, Axis, s};
use serde::Deserialize;

use super::schedule::{Method, Schedule, Stage};
use super::sensing::SensingOperator;
use super::signs::Signs;

/// Side of the blocks in pixels.
pub const BLOCK: usize = 16;

/// What is seen of a block, each the decimal logarithm of an energy or of a ratio.
pub const FEATURES: [&str; 11] = [
    "gradient",
    "curvature",
    "change in time",
    "distance from total variation",
    "brightness",
    "mask contrast",
    "mask gradient",
    "frames",
    "gradient of the whole frame",
    "change in time of the whole frame",
    "distance of the whole frame",
];

/// Below this, energies are rounding.
const FLOOR: f32 = 1e-7;

/// Rows and columns of blocks of a picture of `height` x `width` pixels; those at the far edges may be smaller.
pub fn blocks(height: usize, width: usize) -> (usize, usize) {
    (height.div_ceil(BLOCK), width.div_ceil(BLOCK))
}

/// What is seen of each block of each frame \[features, S B, rows, columns\], of the frames \[S B,H,W\] of a
/// reconstruction and those that total variation alone had left, if others priors followed; all on the scale on which the
/// scene is on \[0,1\].
pub fn features(
    op: &SensingOperator,
    early: Option<ArrayView3<'_, f32>>,
    frames: ArrayView3<'_, f32>,
) -> Array4<f32> {
    let (count, height, width) = frames.dim();
    let (rows, columns) = blocks(height, width);
    let mut all = Array4::zeros((FEATURES.len(), count, rows, columns));
    let (contrast, roughness) = of_masks(op);
    let ratio = (op.masks().len_of(Axis(0)) as f32).log10();
    for (k, frame) in frames.outer_iter().enumerate() {
        let neighbours = [k.checked_sub(1), Some(k + 1).filter(|next| *next < count)];
        let beside = neighbours.into_iter().flatten().map(|at| frames.index_axis(Axis(0), at));
        let beside: Vec<_> = beside.collect();
        let early = early.map(|early| early.index_axis_move(Axis(0), k));
        let mut put = |feature: usize, whole: Option<usize>, energy: Block| {
            all.slice_mut(s![feature, k, .., ..]).assign(&energy.0.mapv(logarithm));
            if let Some(whole) = whole {
                let mean = logarithm(energy.0.mean().unwrap_or(0.0));
                all.slice_mut(s![whole, k, .., ..]).fill(mean);
            }
        };
        put(0, Some(8), Block::of(height, width, |i, j| gradient(frame, i, j)));
        put(1, None, Block::of(height, width, |i, j| curvature(frame, i, j)));
        let change = |i, j| {
            let sum = beside.iter().map(|other| (frame[[i, j]] - other[[i, j]]).powi(2));
            sum.sum::<f32>() / beside.len().max(1) as f32
        };
        put(2, Some(9), Block::of(height, width, change));
        let distance = |i: usize, j: usize| {
            early.map_or(0.0, |early: ArrayView2<'_, f32>| (frame[[i, j]] - early[[i, j]]).powi(2))
        };
        put(3, Some(10), Block::of(height, width, distance));
        put(4, None, Block::of(height, width, |i, j| frame[[i, j]].powi(2)));
        all.slice_mut(s![5, k, .., ..]).assign(&contrast.0);
        all.slice_mut(s![6, k, .., ..]).assign(&roughness.0);
        all.slice_mut(s![7, k, .., ..]).fill(ratio);
    }
    all
}

/// The part of the gram diagonal that changes from mask to mask, and the energy of the masks' gradient relative to
/// their own.
fn of_masks(op: &SensingOperator) -> (Block, Block) {
    let masks = op.masks();
    let (_, height, width) = masks.dim();
    let (gram, steady) = (op.gram(), op.steady_gram());
    let energy = Block::of(height, width, |i, j| gram[[i, j]]);
    let steady = Block::of(height, width, |i, j| steady[[i, j]]);
    let steps = Block::of(height, width, |i, j| {
        masks.outer_iter().map(|mask| gradient(mask, i, j)).sum::<f32>()
    });
    let share = |part: &Array2<f32>| {
        ndarray::Zip::from(part)
            .and(&energy.0)
            .map_collect(|part, all| logarithm(part / all.max(FLOOR)))
    };
    let varying = &energy.0 - &steady.0;
    (Block(share(&varying)), Block(share(&steps.0)))
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

/// Means over blocks \[rows, columns\].
struct Block(Array2<f32>);

impl Block {
    fn of(height: usize, width: usize, value: impl Fn(usize, usize) -> f32) -> Self {
        let (rows, columns) = blocks(height, width);
        Self(Array2::from_shape_fn((rows, columns), |(r, c)| {
            let (across, down) =
                (c * BLOCK..width.min((c + 1) * BLOCK), r * BLOCK..height.min((r + 1) * BLOCK));
            let pixels = across.len() * down.len();
            let row = |i: usize| across.clone().map(|j| value(i, j)).sum::<f32>();
            down.map(row).sum::<f32>() / pixels as f32
        }))
    }
}

/// What errors are predicted by: `assessment.json`, which `training/assessment.py` fits. The mean of some networks of a
/// few neurons, of what is seen of a block, of the mean of that over all blocks, of the white level, and of the signs.
#[derive(Debug, Deserialize)]
pub struct Model {
    features: Scaling,
    signs: Scaling,
    networks: Vec<Vec<Layer>>,
    /// What is added to the predicted PSNR for the ends of its interval, in dB.
    pub interval: [f64; 2],
}

/// Inputs are shifted, scaled and bounded first.
#[derive(Debug, Deserialize)]
struct Scaling {
    mean: Vec<f32>,
    scale: Vec<f32>,
}

/// Neurons, each with as many weights as there are inputs.
#[derive(Debug, Deserialize)]
struct Layer {
    weights: Vec<Vec<f32>>,
    bias: Vec<f32>,
}

/// Inputs further from the mean than in any fit, in their scale, count as that far.
const FARTHEST: f32 = 3.0;

static MODELS: LazyLock<BTreeMap<String, Model>> = LazyLock::new(|| {
    #[allow(clippy::expect_used)] // a test reads it
    serde_json::from_str(include_str!("assessment.json"))
        .expect("assessment.json is a map of models")
});

impl Model {
    /// The model that was fitted to results of such schedules, if there is one: of total variation alone, or of
    /// total variation with what may follow in the default schedule.
    pub fn of(schedule: &Schedule) -> Option<&'static Self> {
        if schedule.method != Method::Gap {
            return None;
        }
        let first = schedule.stages.first()?.prior.name();
        let known = |stage: &Stage| {
            ["fastdvdnet", "fastdvdnet-int8", "nonlocal"].contains(&stage.prior.name())
        };
        let rest = &schedule.stages[1..];
        match (first, rest.iter().all(known), rest.is_empty()) {
            ("tv", true, true) => MODELS.get("gap-tv"),
            ("tv", true, false) => MODELS.get("pnp-tv-fastdvdnet"),
            _ => None,
        }
    }

    /// The decimal logarithm of the expected squared error of each block \[S B, rows, columns\], from what is seen of
    /// them. Signs that are not known count as in the mean of the fit. `white` is the scene's white level.
    pub fn log_errors(
        &self,
        features: &Array4<f32>,
        signs: Option<&Signs>,
        white: f32,
    ) -> Array3<f32> {
        let (count, frames, rows, columns) = features.dim();
        let blocks = frames * rows * columns;
        let seen = |block: usize| {
            let (k, place) = (block / (rows * columns), block % (rows * columns));
            let of_block = features.slice(s![.., k, place / columns, place % columns]);
            self.features.of(of_block.iter().copied().collect())
        };
        let mut mean = vec![0.0; count];
        for block in 0..blocks {
            let values = seen(block);
            mean.iter_mut().zip(values).for_each(|(mean, value)| *mean += value / blocks as f32);
        }
        let mut known = vec![20.0 * white.log10()];
        known.extend(signs.map_or(self.signs.mean[1..].to_vec(), |signs| signs.0.to_vec()));
        let rest = [mean, self.signs.of(known)].concat();
        let errors = (0..blocks).map(|block| {
            let inputs = [seen(block), rest.clone()].concat();
            let told = self.networks.iter().map(|layers| output(layers, inputs.clone()));
            told.sum::<f32>() / self.networks.len() as f32
        });
        let errors = Array3::from_shape_vec((frames, rows, columns), errors.collect());
        errors.unwrap_or_else(|_| unreachable!("as many errors as blocks"))
    }
}

impl Scaling {
    fn of(&self, values: Vec<f32>) -> Vec<f32> {
        let scaled = values.iter().zip(self.mean.iter().zip(&self.scale));
        scaled.map(|(x, (mean, s))| ((x - mean) / s).clamp(-FARTHEST, FARTHEST)).collect()
    }
}

/// What the last of some layers gives.
fn output(layers: &[Layer], inputs: Vec<f32>) -> f32 {
    let outputs = layers
        .iter()
        .enumerate()
        .fold(inputs, |inputs, (index, layer)| layer.outputs(&inputs, index + 1 < layers.len()));
    outputs.first().copied().unwrap_or_default()
}

impl Layer {
    /// `W x + b`, and of all layers but the last its product with its sigmoid.
    fn outputs(&self, inputs: &[f32], inner: bool) -> Vec<f32> {
        let neuron = |(weights, bias): (&Vec<f32>, &f32)| {
            let sum = bias + weights.iter().zip(inputs).map(|(w, x)| w * x).sum::<f32>();
            if inner { sum / (1.0 + (-sum).exp()) } else { sum }
        };
        self.weights.iter().zip(&self.bias).map(neuron).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::{FEATURES, MODELS, Model, features};
    use crate::optics::iid_masks;
    use crate::recon::schedule::Schedule;
    use crate::recon::sensing::SensingOperator;
    use crate::recon::signs::{SIGNS, Signs};
    use ndarray::{Array3, s};

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
        near(3, (3, 2, 0), 1e-2);
        // One mask of four is open: 1 - 4 * (1/4)^2 of the gram differs from mask to mask.
        near(5, (0, 0, 0), 0.75);
        near(7, (0, 0, 0), 4.0);
        assert!(seen.slice(s![6, .., .., ..]).iter().all(|&gradient| gradient == -7.0));
    }

    #[test]
    fn results_of_known_schedules_have_a_model_and_no_others() {
        assert_eq!(MODELS.len(), 2);
        let has = |schedule: Schedule| Model::of(&schedule).is_some();
        assert!(has(Schedule::gap_tv()) && has(Schedule::pnp_tv_fastdvdnet()));
        assert!(!has(Schedule::admm_tv()) && !has(Schedule::pnp_ffdnet()));
        for model in MODELS.values() {
            let inputs = 2 * FEATURES.len() + 1 + SIGNS.len();
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
                    assert!(layer.weights.iter().all(|weights| weights.len() == before));
                    assert_eq!(layer.weights.len(), layer.bias.len());
                    before = layer.bias.len();
                }
                assert_eq!(before, 1, "the last layer has one neuron");
            }
            assert!(model.interval[0] < 0.0 && model.interval[1] > 0.0);
        }
    }

    /// Moving texture of a tenth, and of a hundredth, that the priors have moved by a fifth.
    #[test]
    fn more_texture_lets_expect_more_error() {
        let op = SensingOperator::new(iid_masks(4, 48, 48, 1).unwrap()).unwrap();
        let error = |texture: f32| {
            let frame = |(k, i, j): (usize, usize, usize)| {
                let phase = i as f32 * 0.4 + (j as f32 - k as f32) * 0.3;
                0.5 + texture * phase.sin()
            };
            let frames = Array3::from_shape_fn((4, 48, 48), frame);
            let early = frames.mapv(|x| 0.5 + 0.8 * (x - 0.5));
            let seen = features(&op, Some(early.view()), frames.view());
            let model = Model::of(&Schedule::pnp_tv_fastdvdnet()).unwrap();
            model.log_errors(&seen, None, 1.0)[[1, 1, 1]]
        };
        let (much, little) = (error(0.1), error(0.01));
        assert!(much > little + 0.3 && much < -1.0 && little > -6.0, "{much}, {little}");
    }

    /// What held-out pixels say of the error moves the prediction.
    #[test]
    fn a_larger_held_out_error_lets_expect_more_error() {
        let op = SensingOperator::new(iid_masks(4, 40, 36, 1).unwrap()).unwrap();
        let seen = features(&op, Some(ramp().view()), ramp().view());
        for model in MODELS.values() {
            let error = |decibels: f32| {
                let signs = Signs([decibels; SIGNS.len()]);
                model.log_errors(&seen, Some(&signs), 1.0).mean().unwrap()
            };
            assert!(error(-20.0) > error(-35.0), "{}, {}", error(-20.0), error(-35.0));
        }
    }
}
